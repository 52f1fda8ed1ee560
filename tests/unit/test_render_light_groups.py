"""Emitters of light samples, by which the path tracer finds their light groups."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.light_sampler import LearnedLightSampler
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.observer import PathObserver
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import Surface
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.runtime.timer import PhaseTimer
from tests.support.group_cases import grouped


class LightSamples(PathObserver):
    """Light samples at primary hits: points, and triangles."""

    def vertex(self, paths: Tensor, hit: Hit, surface: Surface, owner: Tensor | None) -> None:
        self._position = surface.position

    def light_sample(self, paths: Tensor, light: DirectLight, contribution: Tensor, visibility: Tensor) -> None:
        self.far = light.distance == MISS_DISTANCE
        self.points = (self._position + light.direction * light.distance)[:, ~self.far]
        self.triangle, self.far_triangle = light.triangle[~self.far], light.triangle[self.far]


@pytest.mark.parametrize("learned", [False, True])
def test_light_samples_lie_on_their_triangles(learned):
    """Also where resampling keeps one of several light samples."""
    scene = grouped()
    tracer, samples = PathTracer(scene), LightSamples()
    generator = torch.Generator().manual_seed(2)
    direction = torch.randn(3, 4000, generator=generator) * 0.3 + torch.tensor([[0.0], [0.0], [-1.0]])
    origin = torch.tensor(scene.camera.position)[:, None].expand(3, 4000).contiguous()
    rays = origin, direction / direction.norm(dim=0), PixelRandom(0, 1, torch.arange(4000))
    camera = ThinLensCamera(scene.camera, 24, 16)
    sampler = LearnedLightSampler(camera, tracer.light_sampler, GuidedConfig()) if learned else None
    tracer.trace(*rays, PhaseTimer(), light_sampler=sampler, max_depth=2, observers=(samples,))
    assert (samples.far_triangle == -1).all() and len(samples.far_triangle) > 100
    corners = tracer.geometry.corners(samples.triangle)
    assert len(samples.triangle.unique()) == 6 and corners.shape[2] > 100
    first, second, offset = corners[1] - corners[0], corners[2] - corners[0], samples.points - corners[0]
    normal = torch.linalg.cross(first, second, dim=0)
    area = (normal * normal).sum(0)
    u = (torch.linalg.cross(offset, second, dim=0) * normal).sum(0) / area
    v = (torch.linalg.cross(first, offset, dim=0) * normal).sum(0) / area
    height = (offset * normal).sum(0).abs() / area.sqrt()
    assert float(height.max()) < 1e-4
    assert float(torch.stack((u, v, 1.0 - u - v)).min()) > -1e-3
