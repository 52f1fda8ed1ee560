"""The models against slow and readable references in double precision."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.models import candidates
from bokehguide.models.candidates import MAX_CANDIDATES, draw_candidates
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.gaussian_mixture import GaussianMixture
from bokehguide.models.polynomial_offset import PolynomialOffset, exponents
from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.render.camera import ThinLensCamera
from tests.support.gaussians import CAMERA, FAR_GAUSSIANS, scattered_field, single_precision_error
from tests.support.lens_cases import LENS


def directional_density(direction: np.ndarray, viewpoint: np.ndarray, mean: np.ndarray, sigma: float) -> float:
    """F(ω) of Eq. 21: the Gaussian's mass per solid angle, ∫ t² N(o + tω; μ, σ²) dt over t > 0."""
    to_mean = mean - viewpoint
    a = float(to_mean @ direction)
    s = float(np.linalg.norm(np.cross(to_mean, direction)))
    along = a * sigma**2 * math.exp(-(a**2) / (2.0 * sigma**2)) + (sigma**2 + a**2) * sigma * math.sqrt(math.pi / 2.0) * (
        1.0 + math.erf(a / (math.sqrt(2.0) * sigma))
    )
    return (2.0 * math.pi * sigma**2) ** -1.5 * math.exp(-(s**2) / (2.0 * sigma**2)) * along


def both_directions(lens_point: np.ndarray, focus: np.ndarray, mean: np.ndarray, sigma: float) -> float:
    """Eq. 16 and 17: F(ω) + F(-ω) per unit area of the lens plane."""
    ray = np.append(lens_point, 0.0) - focus
    distance = float(np.linalg.norm(ray))
    omega = ray / distance
    both = directional_density(omega, focus, mean, sigma) + directional_density(-omega, focus, mean, sigma)
    return both * (focus[2] / distance) / distance**2


def reference_pdf(distribution: GaussianMixture, start: Tensor, weight: Tensor, beta: Tensor, points: Tensor) -> np.ndarray:
    """q of Eq. 26 pixel by pixel and candidate by candidate, culled by Eq. 22."""
    lens = distribution.lens
    focus, mean, sigma = (x.double().numpy() for x in (distribution.focus, distribution.mean, distribution.sigma))
    density = np.zeros(len(beta))
    for pixel in range(len(beta)):
        x_f, point = focus[:, pixel], points[:, pixel].double().numpy()
        mixture = total = 0.0
        for i in range(int(start[pixel]), int(start[pixel + 1])):
            k = x_f[2] / (x_f[2] - mean[2, i])
            projected = x_f[:2] * (1.0 - k) + mean[:2, i] * k
            if np.hypot(*projected) < lens.radius + abs(k) * sigma[i]:
                mixture += float(weight[i]) * both_directions(point, x_f, mean[:, i], float(sigma[i]))
                total += float(weight[i])
        uniform = float(np.hypot(*point) <= lens.radius) / lens.area
        b = float(beta[pixel])
        density[pixel] = b * mixture / total + (1.0 - b) * uniform if total > 0.0 else uniform
    return density


def test_density_is_equation_21_in_both_directions():
    """Also where a Gaussian reaches over the focal plane, and the error functions count."""
    generator = np.random.default_rng(5)
    for sigma in (0.003, 0.05, 0.5, 3.0):
        focus = np.append(generator.uniform(-0.5, 0.5, 2), 2.0)
        for _ in range(20):
            mean = focus + generator.normal(0.0, 1.0, 3)
            point = project_to_lens(*(torch.tensor(x)[:, None] for x in (mean, focus)))[:, 0].numpy()
            point = point + generator.normal(0.0, sigma, 2)
            columns = (torch.tensor(x)[:, None] for x in (point, focus, mean))
            found = lens_density(*columns, torch.tensor([sigma], dtype=torch.float64))
            assert float(found) == pytest.approx(both_directions(point, focus, mean, sigma), rel=1e-9, abs=1e-300)


def test_mixture_pdf_is_the_sum_over_each_pixels_candidates():
    generator = torch.Generator().manual_seed(6)
    pixels = 200
    counts = torch.randint(0, 6, (pixels,), generator=generator)
    start = torch.cat((torch.zeros(1, dtype=torch.int64), counts.cumsum(0)))
    total = int(start[-1])
    focus = torch.cat((torch.rand(2, pixels, generator=generator) - 0.5, torch.full((1, pixels), 2.0)))
    owner = torch.repeat_interleave(counts)
    depth = torch.rand(total, generator=generator) * 4.0 + 2.5
    k = 2.0 / (2.0 - depth)
    lens_point = (torch.rand(2, total, generator=generator) - 0.5) * 0.5  # some are culled
    mean = torch.cat((focus[:2, owner] + (lens_point - focus[:2, owner]) / k, depth[None]))
    sigma = 0.02 + 0.05 * torch.rand(total, generator=generator)
    weight = torch.exp(12.0 * torch.randn(total, generator=generator))  # thirty decades and more
    beta = 0.05 + 0.9 * torch.rand(pixels, generator=generator)
    distribution = GaussianMixture(LENS, focus, beta, start, mean, sigma, weight)
    points = torch.randn(2, pixels, generator=generator) * 0.07
    found = distribution.pdf(points).double().numpy()
    reference = reference_pdf(distribution, start, weight, beta, points)
    assert 20 < int(distribution.guided.sum()) < pixels and (distribution.weight == 0.0).sum() > 20
    np.testing.assert_allclose(found, reference, rtol=2e-4, atol=1e-5)
    sums = torch.zeros(pixels).index_add_(0, owner, distribution.weight)
    torch.testing.assert_close(sums, distribution.guided.float(), rtol=0.0, atol=1e-5)
    uniforms = torch.rand(pixels, generator=generator)
    chosen = distribution.choose(uniforms)
    for pixel in distribution.guided.nonzero()[:, 0].tolist():
        low, high = start[pixel : pixel + 2].tolist()
        below = distribution.weight[low:high].double().cumsum(0).numpy()
        expected = low + int(np.searchsorted(below, float(uniforms[pixel]), side="right"))
        assert int(chosen[pixel]) == expected and distribution.weight[expected] > 0.0


@pytest.mark.parametrize("depth, sigma, tolerance", FAR_GAUSSIANS)
def test_single_precision_is_enough_for_small_far_gaussians(depth, sigma, tolerance):
    assert single_precision_error(depth, sigma) < tolerance


def kept_by_pixel(field: GaussianField, camera: ThinLensCamera, raster: Tensor) -> Tensor:
    """Eq. 22 as a full table, bool `[G, pixels]`, in double precision."""
    focus = camera.focus_points(raster).double()[:, None]
    mean, sigma = field.mean.double()[:, :, None], field.sigma.double()[:, None]
    k = focus[2] / (focus[2] - mean[2])
    projected = focus[:2] * (1.0 - k) + mean[:2] * k
    return projected.square().sum(0).sqrt() < camera.lens.radius + k.abs() * sigma


@pytest.mark.parametrize("count", [1, 40, 300])
def test_candidates_are_those_of_the_full_table(count):
    """At random positions within the pixels: the Gaussians that the table keeps, up to the 16 strongest."""
    camera = ThinLensCamera(CAMERA, 48, 27)
    pixels = camera.width * camera.height
    field = scattered_field(count, seed=8)
    candidates = draw_candidates(field, camera)
    start, gaussian = candidates.batch(slice(0, pixels))
    strength = field.lens_weights(2.0)
    generator = torch.Generator().manual_seed(9)
    corner = torch.stack((torch.arange(pixels) % camera.width, torch.arange(pixels) // camera.width))
    for _ in range(8):
        jitter = torch.rand(2, pixels, generator=generator)
        raster = corner + torch.where(torch.rand(2, pixels, generator=generator) < 0.3, jitter.round() * 0.999999, jitter)
        table = kept_by_pixel(field, camera, raster)
        for pixel in range(pixels):
            listed = gaussian[start[pixel] : start[pixel + 1]]
            assert len(listed) <= MAX_CANDIDATES and len(listed.unique()) == len(listed)
            kept = set(table[:, pixel].nonzero()[:, 0].tolist())
            missed = kept - set(listed.tolist())
            assert not missed or len(listed) == MAX_CANDIDATES
            assert all(strength[i] <= strength[listed].min() for i in missed)


def test_candidates_are_strongest_first_and_within_their_discs():
    camera = ThinLensCamera(CAMERA, 48, 27)
    field = scattered_field(300, seed=10)
    candidates = draw_candidates(field, camera)
    strength = field.lens_weights(2.0)[candidates.gaussian.long()]
    counts = candidates.counts()
    owner = torch.repeat_interleave(counts)
    assert int(counts.max()) == MAX_CANDIDATES  # the limit was at work
    assert bool((strength[1:] <= strength[:-1])[owner[1:] == owner[:-1]].all())
    center, radius = field.footprints(camera)
    middle = torch.stack((owner % camera.width, owner // camera.width)) + 0.5
    away = (middle - center[:, candidates.gaussian.long()]).square().sum(0).sqrt()
    assert bool((away <= radius[candidates.gaussian.long()] + 0.71).all())


@pytest.mark.slow
@pytest.mark.parametrize("rows, pixels", [(90, 5000), (7, 1 << 21), (7, 300), (1, 1)])
def test_rasterising_discs_in_chunks_changes_nothing(rows, pixels, monkeypatch):
    """More overlapping discs than a pixel keeps: rasterised all at once, and in strips of rows and chunks of discs."""
    camera = ThinLensCamera(CAMERA, 160, 90)
    field = scattered_field(400, seed=3)
    excluded = torch.rand(160 * 90, generator=torch.Generator().manual_seed(4)) < 0.2
    whole = draw_candidates(field, camera, excluded=excluded)
    monkeypatch.setattr(candidates, "STRIP_PIXELS", 160 * rows)
    monkeypatch.setattr(candidates, "CHUNK_PIXELS", pixels)
    parts = draw_candidates(field, camera, excluded=excluded)
    assert not bool(parts.counts()[excluded].any())
    assert int((whole.start[1:] - whole.start[:-1]).max()) == MAX_CANDIDATES
    assert torch.equal(whole.start, parts.start) and torch.equal(whole.gaussian, parts.gaussian)


def test_batches_cut_the_list_without_loss():
    camera = ThinLensCamera(CAMERA, 48, 27)
    candidates = draw_candidates(scattered_field(40, seed=11), camera)
    parts = [candidates.batch(slice(first, first + 324)) for first in range(0, 1296, 324)]
    assert torch.equal(torch.cat([gaussian for _, gaussian in parts]), candidates.gaussian.long())
    assert all(int(start[0]) == 0 and int(start[-1]) == len(gaussian) for start, gaussian in parts)


def test_scattered_pixels_keep_their_own_candidates():
    camera = ThinLensCamera(CAMERA, 48, 27)
    candidates = draw_candidates(scattered_field(300, seed=11), camera)
    pixels = torch.arange(5, 1296, 7)
    start, gaussian = candidates.batch(pixels)
    assert len(start) == len(pixels) + 1 and int(start[-1]) == len(gaussian) > 500
    for i, pixel in enumerate(pixels.tolist()):
        assert torch.equal(gaussian[start[i] : start[i + 1]], candidates.batch(slice(pixel, pixel + 1))[1])


def test_offsets_are_the_polynomials_of_equation_29():
    camera = ThinLensCamera(CAMERA, 48, 27)
    field = scattered_field(5, seed=12)
    offsets = PolynomialOffset(field, camera)
    assert not offsets.coefficients.any()
    generator = torch.Generator().manual_seed(13)
    coefficients = torch.randn(3, 6, 5, generator=generator)
    offsets.load_state_dict({**offsets.state_dict(), "coefficients": coefficients})
    gaussian = torch.arange(5)
    center, radius = field.footprints(camera)
    raster = center + (2.0 * torch.rand(2, 5, generator=generator) - 1.0) * radius
    found = offsets(gaussian, raster).detach()
    for g in range(5):
        x, y = ((raster[:, g] - center[:, g]) / radius[g]).tolist()
        for axis in range(3):
            polynomial = sum(float(coefficients[axis, n, g]) * x**i * y**j for n, (i, j) in enumerate(exponents(2)))
            assert float(found[axis, g]) == pytest.approx(float(field.radius[g]) * polynomial, rel=1e-4, abs=1e-6)
