"""The closed gradients of the one-sample KL: against autograd, finite differences and quadrature.

The reference is q in double precision from the equations, with β's logit and the polynomial coefficients as leaves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.models.base import LensDensity
from bokehguide.models.blend_weight import MAX_BLEND, MIN_BLEND, BlendWeightMap
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.kl import blend_gradient, offset_gradient, one_sample_kl
from bokehguide.models.polynomial_offset import PolynomialOffset, monomials
from bokehguide.models.projection import lens_density, log_density_gradient
from bokehguide.render.camera import ThinLensCamera
from tests.support.gaussians import CAMERA
from tests.support.lens_cases import PolarGrid
from tests.support.statistical import SIGNIFICANCE, z_test

PIXEL_RASTER = (16.3, 8.6)
GAUSSIANS = 3
DRAWS = 300_000


@dataclass
class Pixel:
    """One pixel that sees three Gaussians; gradients are by `logit` and `coefficients`."""

    camera: ThinLensCamera
    field: GaussianField
    offsets: PolynomialOffset
    logit: Tensor

    def coefficients(self) -> Tensor:
        return self.offsets.coefficients.detach().double()

    def raster(self, count: int) -> Tensor:
        return torch.tensor(PIXEL_RASTER)[:, None].expand(2, count).contiguous()

    def gaussians(self, count: int) -> Tensor:
        return torch.arange(GAUSSIANS).repeat(count)

    def distribution(self, count: int) -> GaussianMixture:
        """The pixel's mixture, `count` times."""
        gaussian = self.gaussians(count)
        raster = self.raster(count)
        mean = self.field.mean[:, gaussian] + self.offsets(gaussian, raster.repeat_interleave(GAUSSIANS, 1)).detach()
        weight = self.field.lens_weights(self.camera.lens.focus_distance)[gaussian]
        beta = MIN_BLEND + (MAX_BLEND - MIN_BLEND) * self.logit.sigmoid().float().expand(count)
        start = torch.arange(count + 1) * GAUSSIANS
        return GaussianMixture(
            self.camera.lens, self.camera.focus_points(raster), beta, start, mean, self.field.sigma[gaussian], weight
        )

    def reference(self, points: Tensor, logit: Tensor, coefficients: Tensor) -> Tensor:
        """log(A q) `[N]` at `points` `[2, N]`, in double; only the strongest Gaussian's coefficients are leaves."""
        count, lens = points.shape[1], self.camera.lens
        raster = self.raster(1).double()
        center, radius = (value.double() for value in self.field.footprints(self.camera))
        basis = monomials((raster - center) / radius) * self.field.radius.double()  # [6, G]
        focus = self.camera.focus_points(raster.float()).double().expand(3, count)
        weight = self.field.lens_weights(lens.focus_distance).double()

        def parts(coefficients: Tensor) -> Tensor:
            mean = self.field.mean.double() + (coefficients * basis).sum(1)
            densities = [
                lens_density(points, focus, mean[:, g, None].expand(3, count), self.field.sigma[g].double().expand(count))
                for g in range(GAUSSIANS)
            ]
            return torch.stack(densities) * (weight / weight.sum())[:, None]

        still, moving = parts(self.coefficients()), parts(coefficients)
        strongest = still.argmax(0, keepdim=True)
        mixture = torch.where(torch.arange(GAUSSIANS)[:, None] == strongest, moving, still).sum(0)
        beta = MIN_BLEND + (MAX_BLEND - MIN_BLEND) * logit.sigmoid()
        inside = (points.square().sum(0) <= lens.radius**2).double() / lens.area
        return (lens.area * (beta * mixture + (1.0 - beta) * inside)).log()


@pytest.fixture(scope="module")
def pixel() -> Pixel:
    camera = ThinLensCamera(CAMERA, 32, 18)
    focus = camera.focus_points(torch.tensor(PIXEL_RASTER)[:, None])
    depth = torch.tensor([1.2, 5.0, 9.0])
    k = 2.0 / (2.0 - depth)
    on_lens = torch.tensor([[0.04, -0.05, 0.07], [0.03, 0.01, -0.06]])
    mean = torch.cat((focus[:2] + (on_lens - focus[:2]) / k, depth[None]))
    field = GaussianField()
    field.assign(mean, torch.tensor([0.02, 0.08, 0.2]), torch.tensor([0.01, 0.04, 0.1]), torch.tensor([0.3, 1.0, 6.0]))
    offsets = PolynomialOffset(field, camera)
    with torch.no_grad():
        offsets.coefficients.copy_(0.2 * torch.randn(offsets.coefficients.shape, generator=torch.Generator().manual_seed(1)))
    return Pixel(camera, field, offsets, torch.tensor(0.7, dtype=torch.float64))


def radiance(points: Tensor) -> Tensor:
    """The pixel's radiance at each lens point: a bright emitter before a dim background, smooth at its rim."""
    away = ((points[0] + 0.045).square() + (points[1] - 0.02).square()).sqrt()
    return 0.3 + 8.0 * torch.sigmoid((0.02 - away) / 0.003)


def draw(pixel: Pixel, count: int, seed: int) -> tuple[GaussianMixture, LensDensity, Tensor]:
    """Draws from the pixel: distribution, densities and ratio, as a step makes them."""
    guide = pixel.distribution(count)
    points = guide.sample(torch.rand(5, count, generator=torch.Generator().manual_seed(seed)).clamp(1e-6, 1.0 - 1e-6)).points
    at = guide.evaluate(points)
    ratio = radiance(points) * guide.lens.contains(points) / (guide.lens.area * at.density)
    return guide, at, ratio


def test_blend_gradient_is_autograds(pixel):
    guide, at, ratio = draw(pixel, 500, seed=2)
    found = blend_gradient(guide, ratio, at)
    logit = pixel.logit.clone().expand(500).clone().requires_grad_()
    with_zero = pixel.reference(at.points.double(), logit, pixel.coefficients())
    (-(ratio.double() * with_zero)[ratio > 0.0]).sum().backward()
    assert float(found.abs().max()) > 0.1 and bool((ratio == 0.0).any())
    np.testing.assert_allclose(found.numpy(), logit.grad.numpy(), rtol=1e-3, atol=1e-4)


def test_offset_gradient_is_autograds(pixel):
    guide, at, ratio = draw(pixel, 500, seed=3)
    found = offset_gradient(guide, pixel.offsets, pixel.gaussians(500), pixel.raster(500), ratio, at)
    coefficients = pixel.coefficients().requires_grad_()
    log_q = pixel.reference(at.points.double(), pixel.logit, coefficients)
    (-(ratio.double() * log_q)[ratio > 0.0]).sum().backward()
    scale = float(coefficients.grad.abs().max())
    assert bool((coefficients.grad.abs().amax((0, 1)) > 1e-3 * scale).all())  # every Gaussian learns
    np.testing.assert_allclose(found.numpy(), coefficients.grad.numpy(), rtol=2e-3, atol=1e-4 * scale)


def test_loss_is_that_of_the_gradients(pixel):
    _, at, ratio = draw(pixel, 500, seed=4)
    log_q = pixel.reference(at.points.double(), pixel.logit, pixel.coefficients())
    expected = -float((ratio.double() * log_q)[ratio > 0.0].sum())
    assert float(one_sample_kl(ratio, at.density, pixel.camera.lens.area)) == pytest.approx(expected, rel=1e-4)


def test_autograd_of_the_reference_is_finite_differences(pixel):
    points = torch.tensor([[0.03, -0.05, 0.0], [0.02, 0.03, -0.08]], dtype=torch.float64)
    coefficients = pixel.coefficients().requires_grad_()
    logit = pixel.logit.clone().requires_grad_()

    assert torch.autograd.gradcheck(lambda x: pixel.reference(points, x, pixel.coefficients()), logit)
    assert torch.autograd.gradcheck(lambda x: pixel.reference(points, pixel.logit, x), coefficients)


@pytest.mark.parametrize("sigma", [0.01, 0.3])
def test_log_density_gradient_is_autograds(sigma):
    generator = torch.Generator().manual_seed(5)
    focus = torch.tensor([[0.2], [-0.1], [2.0]], dtype=torch.float64).expand(3, 200)
    mean = focus + torch.randn(3, 200, generator=generator, dtype=torch.float64)
    points = torch.randn(2, 200, generator=generator, dtype=torch.float64)
    sigmas = torch.full((200,), sigma, dtype=torch.float64)
    leaf = mean.clone().requires_grad_()
    density = lens_density(points, focus, leaf, sigmas)
    seen = density > 1e-200
    density[seen].log().sum().backward()
    found = log_density_gradient(points, focus, mean, sigmas)
    assert int(seen.sum()) > 10
    torch.testing.assert_close(found[:, seen], leaf.grad[:, seen], rtol=1e-7, atol=1e-7)


def expected_gradients(pixel: Pixel) -> tuple[float, np.ndarray]:
    """-∫ L/A ∇ log q over the aperture, for the logit and for the coefficients `[3, 6, G]`."""
    points, area = PolarGrid(pixel.camera.lens.radius * np.linspace(0.0, 1.0, 31), sectors=60).nodes(order=6)
    area = torch.from_numpy(area.ravel())
    logit = pixel.logit.clone().requires_grad_()
    coefficients = pixel.coefficients().requires_grad_()
    log_q = pixel.reference(points, logit, coefficients)
    (-(area * radiance(points) / pixel.camera.lens.area * log_q)).sum().backward()
    return float(logit.grad), coefficients.grad.numpy()


def test_expected_gradients_are_those_of_the_kl(pixel):
    """The mean over draws from q of the one-sample gradients, against quadrature over the aperture."""
    logit, coefficients = expected_gradients(pixel)
    guide, at, ratio = draw(pixel, DRAWS, seed=6)
    sample = blend_gradient(guide, ratio, at).double().numpy()
    assert abs(logit) > 20.0 * sample.std() / DRAWS**0.5  # the gradient is not 0
    assert z_test(sample.mean() - logit, sample.std() / DRAWS**0.5) > SIGNIFICANCE
    batches = [slice(first, first + 3000) for first in range(0, DRAWS, 3000)]
    sums = []
    for part in batches:
        guide, at, ratio = draw(pixel, 3000, seed=1000 + part.start)
        gradient = offset_gradient(guide, pixel.offsets, pixel.gaussians(3000), pixel.raster(3000), ratio, at)
        sums.append(gradient.double().numpy() / 3000)
    means = np.stack(sums)
    error = means.std(0, ddof=1) / len(batches) ** 0.5
    assert z_test(means.mean(0) - coefficients, error) > SIGNIFICANCE


def test_a_draw_of_density_0_has_no_gradient(pixel):
    """A uniform draw may be rounded over the rim: its q and its ratio are 0, and the gradient is 0, not NaN."""
    guide = pixel.distribution(2)
    zero = torch.zeros(2)
    assert torch.equal(blend_gradient(guide, zero, LensDensity(guide.focus[:2], zero, zero, zero)).abs(), zero)
    assert float(one_sample_kl(zero, zero, guide.lens.area)) == 0.0


def test_slope_is_the_derivative_of_beta():
    blend = BlendWeightMap(5)
    with torch.no_grad():
        blend.logit.copy_(torch.linspace(-4.0, 4.0, 5))
    blend().sum().backward()
    torch.testing.assert_close(BlendWeightMap.slope(blend().detach()), blend.logit.grad)
