"""One deliberate defect at a time must fail the check that guards against the defect.

Every defect leaves a picture that looks plausible.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bokehguide.models import gaussian_mixture
from bokehguide.models.base import LensSample
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import lens_density
from bokehguide.render.film import Film
from bokehguide.render.vector import dot
from tests.support import render_checks
from tests.support.gaussians import FAR_GAUSSIANS, WIDTH, frozen_guide, single_precision_error, use_pytorch
from tests.support.lens_cases import CASES, LensCase, grid, histogram_check, seen_by_pixel
from tests.support.render_checks import furnace, learning, means_check, one_everywhere
from tests.support.statistical import SIGNIFICANCE

DRAWS = 1_000_000


@pytest.fixture(autouse=True)
def in_pytorch(monkeypatch):
    """Mixtures of Gaussians in PyTorch, whose functions the defects replace."""
    use_pytorch(monkeypatch)


def case(name: str) -> LensCase:
    return next(case for case in CASES if case.name == name)


def chi_square_of(case: LensCase) -> float:
    """The p-value of `test_draws_follow_the_density`."""
    cells = grid(case)
    return histogram_check(cells.count(case.draw(DRAWS, seed=1)), cells.integrate(case.pdf))


def without_cosine(points, focus, mean, sigma):
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    return lens_density(points, focus, mean, sigma) * dot(ray, ray).sqrt() / focus[2]


def without_opposite_cone(points, focus, mean, sigma):
    """F(ω) alone, towards the Gaussian: half of the density of a Gaussian in focus is lost."""
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    a = dot(mean - focus, ray) / dot(ray, ray).sqrt()
    return lens_density(points, focus, mean, sigma) * 0.5 * (1.0 + torch.erf(a.abs() / (2.0**0.5 * sigma)))


def by_pythagoras(points, focus, mean, sigma):
    """s² as |e|² - a²: right in exact arithmetic, and lost in single precision."""
    e, ray = mean - focus, torch.cat((points - focus[:2], -focus[2:3]))
    distance = dot(ray, ray).sqrt()
    a = dot(e, ray) / distance
    peak = (sigma * sigma + a * a) / (2.0 * np.pi * sigma * sigma)
    return peak * torch.exp(-0.5 * (dot(e, e) - a * a) / (sigma * sigma)) * focus[2] / distance**3


@pytest.mark.parametrize(
    "density, name",
    [
        (without_cosine, "a wide lens"),
        (without_cosine, "almost in focus"),
        (without_opposite_cone, "almost in focus"),
    ],
)
def test_a_wrong_density_fails_the_chi_square(density, name, monkeypatch):
    monkeypatch.setattr(gaussian_mixture, "lens_density", density)
    assert chi_square_of(case(name)) < SIGNIFICANCE


@pytest.mark.parametrize("depth, sigma, tolerance", FAR_GAUSSIANS)
def test_the_wrong_form_of_s_fails_in_single_precision(depth, sigma, tolerance):
    assert single_precision_error(depth, sigma, by_pythagoras) > tolerance


def test_counting_culled_candidates_fails_the_chi_square(monkeypatch):
    """The density of a mixture with the candidates that Eq. 22 excludes."""

    def unculled(self, components):
        mixture = torch.zeros(self.focus.shape[1])
        weight = torch.tensor([5.0, 1.0]).repeat(self.focus.shape[1]) / 6.0
        return mixture.index_add_(0, self.owner, weight * components)

    monkeypatch.setattr(GaussianMixture, "mixture_pdf", unculled)
    assert chi_square_of(case("one of two culled")) < SIGNIFICANCE


def test_drawing_again_inside_the_lens_fails_the_chi_square(monkeypatch):
    sample = GaussianMixture.sample

    def redrawn(self, uniforms):
        points = sample(self, uniforms).points
        return LensSample(torch.where(self.lens.contains(points), points, self.lens.sample(uniforms[2:4])))

    monkeypatch.setattr(GaussianMixture, "sample", redrawn)
    assert chi_square_of(case("blend")) < SIGNIFICANCE


def test_a_density_without_the_offsets_fails_the_chi_square():
    """Draws with offsets, and a density without them."""
    guide = frozen_guide()
    drawn = seen_by_pixel(guide, 9 * WIDTH + 17)
    with torch.no_grad():
        guide.offsets.coefficients.zero_()
    weighed = seen_by_pixel(guide, 9 * WIDTH + 17)
    cells = grid(drawn)
    assert histogram_check(cells.count(drawn.draw(DRAWS, seed=5)), cells.integrate(weighed.pdf)) < SIGNIFICANCE


def drop_density(monkeypatch) -> None:
    """Samples inside the lens have the weight 1, whatever the density."""
    monkeypatch.setattr(GaussianMixture, "blend", lambda self, points, mixture: torch.full_like(mixture, 1.0 / self.lens.area))


def drop_zero_samples(monkeypatch) -> None:
    """Draws outside the lens do not count as samples."""
    add = Film.add

    def counted_inside(self, pixels, samples, *rest):
        good = add(self, pixels, samples, *rest)
        self._count[pixels] -= (samples.weight == 0.0).float()
        return good

    monkeypatch.setattr(Film, "add", counted_inside)


def drop_cosine(monkeypatch) -> None:
    monkeypatch.setattr(gaussian_mixture, "lens_density", without_cosine)


def drop_uniform_part(monkeypatch) -> None:
    """The density lacks (1 - β) / A, and draws have the uniform part."""
    monkeypatch.setattr(
        GaussianMixture, "blend", lambda self, points, mixture: torch.where(self.guided, mixture, 1.0 / self.lens.area)
    )


def other_blend_weight(monkeypatch) -> None:
    """The density has another β than the draws."""
    blend = GaussianMixture.blend

    def later(self, points, mixture):
        beta, self.beta = self.beta, 0.9 * self.beta
        density = blend(self, points, mixture)
        self.beta = beta
        return density

    monkeypatch.setattr(GaussianMixture, "blend", later)


def draw_on_the_rim(monkeypatch) -> None:
    """Draws outside the lens are moved onto the rim."""
    sample = GaussianMixture.sample

    def clamped(self, uniforms):
        points = sample(self, uniforms).points
        return LensSample(points * (0.9999 * self.lens.radius / points.norm(dim=0)).clamp(max=1.0))

    monkeypatch.setattr(GaussianMixture, "sample", clamped)


MUTATIONS = [drop_density, drop_zero_samples, drop_cosine, drop_uniform_part, other_blend_weight, draw_on_the_rim]


@pytest.mark.slow
@pytest.mark.parametrize("mutate", MUTATIONS, ids=lambda mutate: mutate.__name__)
def test_a_wrong_estimator_fails_the_furnace(mutate, monkeypatch):
    mutate(monkeypatch)
    assert one_everywhere(furnace("lis")) < SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutate", [drop_density, drop_zero_samples, other_blend_weight, draw_on_the_rim], ids=lambda mutate: mutate.__name__
)
def test_a_wrong_estimator_fails_the_means(mutate, monkeypatch):
    """The furnace shows the other two: in a lens this small the cosine is 1 within 0.1 %, and samples without the uniform part
    have no bounded weight."""
    render_checks.uniform_reference()
    mutate(monkeypatch)
    assert means_check(learning("lis-b")) < SIGNIFICANCE


@pytest.mark.slow
def test_offsets_in_half_of_the_estimator_fail_the_means(monkeypatch):
    """Draws with the offsets, and a density without them, while the offsets learn."""
    render_checks.uniform_reference()
    component_pdf = GaussianMixture.component_pdf
    offsets: list[torch.Tensor] = []
    forward = PolynomialOffset.forward

    def recorded(self, gaussian, raster):
        offsets[:] = [5.0 * forward(self, gaussian, raster)]
        return offsets[0]

    def unshifted(self, points):
        mean = self.mean
        if offsets:
            self.mean = mean - offsets[0]
        found = component_pdf(self, points)
        self.mean = mean
        return found

    monkeypatch.setattr(PolynomialOffset, "forward", recorded)
    monkeypatch.setattr(GaussianMixture, "component_pdf", unshifted)
    assert means_check(learning("lis-o")) < SIGNIFICANCE
