"""One deliberate defect at a time: the check that guards against it must fail.

Every defect here leaves a picture that looks plausible.
"""

from __future__ import annotations

import numpy as np
import pytest
import render_checks
import torch
from lens_cases import LensCase, grid, histogram_check, seen_by_pixel
from render_checks import furnace, learning, means_check, one_everywhere
from statistical import SIGNIFICANCE
from test_models_density import CASES
from test_models_modules import WIDTH, frozen_guide
from test_models_reference import FAR_SPOTS, single_precision_error

from bokehguide.models import lens_distribution
from bokehguide.models.lens_distribution import GuidedLensDistribution
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import lens_density
from bokehguide.render.film import Film
from bokehguide.render.vector import dot

DRAWS = 1_000_000


def case(name: str) -> LensCase:
    return next(case for case in CASES if case.name == name)


def chi_square_of(case: LensCase) -> float:
    """What `test_draws_follow_the_density` looks at."""
    cells = grid(case)
    return histogram_check(cells.count(case.draw(DRAWS, seed=1)), cells.integrate(case.pdf))


def without_cosine(points, focus, mean, sigma):
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    return lens_density(points, focus, mean, sigma) * dot(ray, ray).sqrt() / focus[2]


def without_the_way_back(points, focus, mean, sigma):
    """F(ω) alone, towards the Gaussian: half of what is in focus is lost."""
    ray = torch.cat((points - focus[:2], -focus[2:3]))
    a = dot(mean - focus, ray) / dot(ray, ray).sqrt()
    return lens_density(points, focus, mean, sigma) * 0.5 * (1.0 + torch.erf(a.abs() / (2.0**0.5 * sigma)))


def by_pythagoras(points, focus, mean, sigma):
    """s² as |e|² - a²: right on paper, lost in single precision."""
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
        (without_the_way_back, "almost in focus"),
    ],
)
def test_a_wrong_density_fails_the_chi_square(density, name, monkeypatch):
    monkeypatch.setattr(lens_distribution, "lens_density", density)
    assert chi_square_of(case(name)) < SIGNIFICANCE


@pytest.mark.parametrize("depth, sigma, tolerance", FAR_SPOTS)
def test_the_wrong_form_of_s_fails_in_single_precision(depth, sigma, tolerance):
    assert single_precision_error(depth, sigma, by_pythagoras) > tolerance


def test_counting_culled_candidates_fails_the_chi_square(monkeypatch):
    """The density of a mixture that still has what Eq. 22 culls."""

    def unculled(self, components):
        mixture = torch.zeros(self.focus.shape[1])
        weight = torch.tensor([5.0, 1.0]).repeat(self.focus.shape[1]) / 6.0
        return mixture.index_add_(0, self.owner, weight * components)

    monkeypatch.setattr(GuidedLensDistribution, "mixture_pdf", unculled)
    assert chi_square_of(case("one of two culled")) < SIGNIFICANCE


def test_drawing_again_inside_the_lens_fails_the_chi_square(monkeypatch):
    sample = GuidedLensDistribution.sample

    def redrawn(self, uniforms):
        points = sample(self, uniforms)
        return torch.where(self.lens.contains(points), points, self.lens.sample(uniforms[2:4]))

    monkeypatch.setattr(GuidedLensDistribution, "sample", redrawn)
    assert chi_square_of(case("blend")) < SIGNIFICANCE


def test_a_density_without_the_offsets_fails_the_chi_square():
    """Drawn with offsets, weighed without them."""
    guide = frozen_guide()
    drawn = seen_by_pixel(guide, 9 * WIDTH + 17)
    with torch.no_grad():
        guide.offsets.coefficients.zero_()
    weighed = seen_by_pixel(guide, 9 * WIDTH + 17)
    cells = grid(drawn)
    assert histogram_check(cells.count(drawn.draw(DRAWS, seed=5)), cells.integrate(weighed.pdf)) < SIGNIFICANCE


def drop_density(monkeypatch) -> None:
    """Samples inside the lens count 1, whatever q drew them."""
    monkeypatch.setattr(
        GuidedLensDistribution, "blend", lambda self, points, mixture: torch.full_like(mixture, 1.0 / self.lens.area)
    )


def drop_zero_samples(monkeypatch) -> None:
    """Draws outside the lens do not count in N."""
    add = Film.add

    def counted_inside(self, pixels, samples, *rest):
        good = add(self, pixels, samples, *rest)
        self._count[pixels] -= (samples.weight == 0.0).float()
        return good

    monkeypatch.setattr(Film, "add", counted_inside)


def drop_cosine(monkeypatch) -> None:
    monkeypatch.setattr(lens_distribution, "lens_density", without_cosine)


def drop_uniform_part(monkeypatch) -> None:
    """q without (1 - β) / A, though such draws are made."""
    monkeypatch.setattr(
        GuidedLensDistribution, "blend", lambda self, points, mixture: torch.where(self.guided, mixture, 1.0 / self.lens.area)
    )


def other_blend_weight(monkeypatch) -> None:
    """A β in the density that is a little off the one drawn with."""
    blend = GuidedLensDistribution.blend

    def later(self, points, mixture):
        beta, self.beta = self.beta, 0.9 * self.beta
        density = blend(self, points, mixture)
        self.beta = beta
        return density

    monkeypatch.setattr(GuidedLensDistribution, "blend", later)


def draw_on_the_rim(monkeypatch) -> None:
    """Draws outside are moved onto the rim."""
    sample = GuidedLensDistribution.sample

    def clamped(self, uniforms):
        points = sample(self, uniforms)
        return points * (0.9999 * self.lens.radius / points.norm(dim=0)).clamp(max=1.0)

    monkeypatch.setattr(GuidedLensDistribution, "sample", clamped)


MUTATIONS = [drop_density, drop_zero_samples, drop_cosine, drop_uniform_part, other_blend_weight, draw_on_the_rim]


@pytest.mark.parametrize("mutate", MUTATIONS, ids=lambda mutate: mutate.__name__)
def test_a_wrong_estimator_fails_the_furnace(mutate, monkeypatch):
    mutate(monkeypatch)
    assert one_everywhere(furnace("lis")) < SIGNIFICANCE


@pytest.mark.parametrize(
    "mutate", [drop_density, drop_zero_samples, other_blend_weight, draw_on_the_rim], ids=lambda mutate: mutate.__name__
)
def test_a_wrong_estimator_fails_the_means(mutate, monkeypatch):
    """The other two are left to the furnace: in a lens this small the cosine is 1 within 0.1 %,
    and fireflies without bound swamp every variance."""
    render_checks.uniform_reference()
    mutate(monkeypatch)
    assert means_check(learning("lis-b")) < SIGNIFICANCE


def test_offsets_in_half_of_the_estimator_fail_the_means(monkeypatch):
    """Drawn with the offsets, weighed without them, while they learn."""
    render_checks.uniform_reference()
    component_pdf = GuidedLensDistribution.component_pdf
    offsets: list[torch.Tensor] = []
    forward = PolynomialOffset.forward

    def remembered(self, gaussian, raster):
        offsets[:] = [5.0 * forward(self, gaussian, raster)]
        return offsets[0]

    def unshifted(self, points):
        mean = self.mean
        if offsets:
            self.mean = mean - offsets[0]
        found = component_pdf(self, points)
        self.mean = mean
        return found

    monkeypatch.setattr(PolynomialOffset, "forward", remembered)
    monkeypatch.setattr(GuidedLensDistribution, "component_pdf", unshifted)
    assert means_check(learning("lis-o")) < SIGNIFICANCE
