"""Gaussian fields and guides of a small camera, and the rounding errors of a density."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bokehguide.guiding import gaussian_guide as guide_module
from bokehguide.guiding.gaussian_guide import GaussianGuide
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.projection import lens_density, project_to_lens
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera
from tests.support.guides import gaussian_guide

WIDTH, HEIGHT = 32, 18
CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.1, focus_distance=2.0)


FAR_GAUSSIANS = [
    pytest.param(6.0, 0.005, 2e-3, id="emitter"),
    pytest.param(100.0, 0.02, 2e-2, id="far emitter"),
    pytest.param(2000.0, 1.0, 1e-2, id="environment, at 1000 focus distances"),
]


def use_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let PyTorch hold the mixtures of Gaussians, for tests that replace its functions."""
    monkeypatch.setattr(guide_module, "native", SimpleNamespace(core_on=lambda device: None))


def small_camera() -> ThinLensCamera:
    return ThinLensCamera(CAMERA, WIDTH, HEIGHT)


def scattered_field(count: int, seed: int) -> GaussianField:
    """Gaussians before and behind the focal plane, in and around the frame of CAMERA."""
    generator = torch.Generator().manual_seed(seed)
    depth = torch.where(
        torch.rand(count, generator=generator) < 0.3,
        0.4 + 1.4 * torch.rand(count, generator=generator),
        2.2 + 20.0 * torch.rand(count, generator=generator).square(),
    )
    slope = (torch.rand(2, count, generator=generator) - 0.5) * torch.tensor([[1.0], [0.6]])
    radius = 0.002 + 0.03 * torch.rand(count, generator=generator)
    energy = torch.exp(2.0 * torch.randn(count, generator=generator))
    field = GaussianField()
    field.assign(torch.cat((slope * depth, depth[None])), radius, 0.5 * radius, energy)
    return field


def frozen_guide(seed: int = 1) -> GaussianGuide:
    """A guide of `lis-o` with three frozen Gaussians that many pixels see, and random offsets and β."""
    guide = gaussian_guide(small_camera(), "lis-o")
    mean = torch.tensor([[0.1, -0.4, 0.05], [0.05, 0.2, -0.1], [5.0, 6.0, 1.2]])
    radius = torch.tensor([0.06, 0.1, 0.02])
    guide.field.assign(mean, radius, 0.5 * radius, torch.tensor([1.0, 2.0, 0.5]))
    guide.freeze()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        guide.offsets.coefficients.copy_(0.3 * torch.randn(guide.offsets.coefficients.shape, generator=generator))
        guide.blend.logit.copy_(torch.randn(guide.blend.logit.shape, generator=generator))
    return guide


def single_precision_error(depth: float, sigma: float, density: Callable[..., Tensor] = lens_density) -> float:
    """Mean relative error of a density in float32 over the bulk of a Gaussian, seen by many pixels."""
    generator = torch.Generator().manual_seed(7)
    count = 20_000
    focus = torch.cat((torch.rand(2, count, generator=generator) - 0.5, torch.full((1, count), 2.0)))
    k = 2.0 / (2.0 - depth)
    mean = torch.cat((focus[:2] * (1.0 - 1.0 / k), torch.full((1, count), depth)))
    points = project_to_lens(mean, focus) + abs(k) * sigma * torch.randn(2, count, generator=generator)
    gaussian = (points, focus, mean, torch.full((count,), sigma))
    double = lens_density(*(value.double() for value in gaussian))
    return float(((density(*gaussian) - double).abs() / double).mean())
