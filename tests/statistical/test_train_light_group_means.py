"""Each light group has the mean of a render with its lights alone, and exactly the light of a replay of the same paths."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

from bokehguide.render.light_groups import GroupedLights
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.light_groups import find_light_groups
from bokehguide.scene.types import Scene
from bokehguide.train import RenderSettings
from tests.support.group_cases import NAMES, grouped, only, rendered
from tests.support.statistical import SIGNIFICANCE, block_means, z_test

RENDERS, SPP, BLOCK = 16, 9, 8


def settings_of(mode: str, seed: int, groups: bool) -> RenderSettings:
    return RenderSettings(mode, seed=seed, light_groups=groups, threads=1)


@cache
def grouped_means(mode: str) -> dict[str, np.ndarray]:
    """Means of the groups over blocks of luminance, of independent renders, `[renders, blocks, blocks]`."""
    found = [rendered(grouped(), SPP, settings_of(mode, seed, True)).picture().light_groups() for seed in range(RENDERS)]
    return {name: np.stack([block_means(one[name].mean(2), BLOCK) for one in found]) for name in NAMES}


def alone(mode: str, scene: Scene) -> np.ndarray:
    """As `grouped_means`, of the radiance of renders without groups."""
    pictures = (rendered(scene, SPP, settings_of(mode, 1000 + seed, False)).picture() for seed in range(RENDERS))
    return np.stack([block_means(each.radiance().numpy().mean(2), BLOCK) for each in pictures])


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """p-value of equal means."""
    error = np.sqrt((one.var(0, ddof=1) + other.var(0, ddof=1)) / RENDERS)
    return z_test(one.mean(0) - other.mean(0), error)


def rays_into(scene: Scene, count: int) -> tuple[torch.Tensor, torch.Tensor, PixelRandom]:
    """Rays from the camera into its half of space, and random numbers."""
    generator = torch.Generator().manual_seed(5)
    direction = torch.randn(3, count, generator=generator) * 0.4 + torch.tensor([[0.0], [0.0], [-1.0]])
    origin = torch.tensor(scene.camera.position)[:, None].expand(3, count).contiguous()
    return origin, direction / direction.norm(dim=0), PixelRandom(0, 3, torch.arange(count))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_a_group_has_the_mean_of_its_lights_alone(mode, name):
    assert difference(grouped_means(mode)[name], alone(mode, only(grouped(), name))) > SIGNIFICANCE


def test_a_doubled_layer_is_a_render_with_doubled_lights():
    found, expected = grouped_means("guided")["neon"], alone("guided", only(grouped(), "neon", 2.0))
    assert difference(2.0 * found, expected) > SIGNIFICANCE
    assert difference(found, expected) < SIGNIFICANCE


@pytest.mark.parametrize("name", NAMES)
def test_a_group_is_a_replay_with_its_lights_alone(name, monkeypatch):
    """Radiance of other lights is 0 in the tables of the tracer; light samples and their densities stay."""
    monkeypatch.setattr(native, "core", lambda: None)
    scene = grouped()
    groups = find_light_groups(scene)
    number = groups.names.index(name)
    rays = rays_into(scene, 3000)
    tracer = PathTracer(scene)
    by_group = tracer.trace(*rays, PhaseTimer(), groups=GroupedLights(groups, tracer.geometry, tracer.lights)).groups
    assert by_group is not None
    replay = PathTracer(scene)
    geometry, lights = replay.geometry, replay.lights
    environment = lights.sampled_environment
    dark = torch.tensor([group != number for group in groups.materials])
    geometry.materials.emission[:3, dark] = 0.0
    lights.rows[9:12, dark[geometry.material[lights.triangles].long()]] = 0.0
    if groups.environment != number:
        assert environment.map is not None
        environment.map.texels[:, :3] *= 0.0
    for sun, light in zip(groups.suns, environment.distant):
        light.radiance *= float(sun == number)
    expected = replay.trace(*rays, PhaseTimer()).radiance
    assert float(expected.mean()) > 1e-3
    torch.testing.assert_close(by_group.rays[number], expected, rtol=1e-5, atol=1e-6)
