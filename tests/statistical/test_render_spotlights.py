"""Spotlights: what they send where, and how they are sampled."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.lights.scene_lights import Lights
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Cone, Material
from tests.support.rooms import bsdf_sampling_only
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import UP, agreement, emitter, estimates, matte, mean_test, rectangle, scene, sky, sphere

RADIUS = 0.004
PLACE = np.array([0.3, 2.0, -0.2])


def spot(axis, inner: float, outer: float, radiance: float = 1000.0, **others) -> Material:
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    return replace(emitter(radiance, **others), emission_cone=Cone(tuple(axis), inner, outer))


def falloff(angle: float, inner: float, outer: float) -> float:
    """Of KHR_lights_punctual, angles in degrees."""
    angle, inner, outer = (math.cos(math.radians(a)) for a in (angle, inner, outer))
    return min(max((angle - outer) / max(0.001, inner - outer), 0.0), 1.0) ** 2


def lit_floor(spots, environment=None, max_depth: int = 2):
    """A grey floor under spherical highlight_cells in one place."""
    meshes = [rectangle(0, rotate=UP, scale=6.0), *(sphere(1 + i, PLACE, RADIUS) for i in range(len(spots)))]
    return scene(meshes, [matte(0.5), *spots], environment, max_depth)


def irradiance(material: Material, point: np.ndarray) -> float:
    """On the floor at `point`, in the red channel: I cos / d², of intensity I = pi r² L."""
    offset = np.asarray(point) - PLACE
    distance = np.linalg.norm(offset)
    cone = material.emission_cone
    angle = math.degrees(math.acos(min(1.0, offset @ np.asarray(cone.axis) / distance)))
    intensity = math.pi * RADIUS**2 * material.emission[0] * falloff(angle, cone.inner, cone.outer)
    return intensity * -offset[1] / distance**3


def seen_at(lit, point, count: int = 20_000) -> np.ndarray:
    origin = np.asarray(point) + (0.5, 0.5, 0.5)
    return estimates(lit, origin, np.asarray(point) - origin, count)


@pytest.mark.parametrize("axis", [(0.0, -1.0, 0.0), (0.6, -1.0, 0.3)])
@pytest.mark.parametrize("turn", [0.0, 15.0, 22.0, 27.0, 29.0, 32.0])
def test_irradiance_falls_off_as_the_extension_has_it(axis, turn):
    light = spot(axis, 20.0, 30.0)
    along = np.asarray(light.emission_cone.axis)
    aside = np.cross(along, (1.0, 0.2, 0.4))
    aside /= np.linalg.norm(aside)
    ray = math.cos(math.radians(turn)) * along + math.sin(math.radians(turn)) * aside
    point = PLACE - ray * PLACE[1] / ray[1]
    expected = 0.5 / math.pi * irradiance(light, point) * np.array([1.0, 2.0, 3.0])
    found = seen_at(lit_floor([light]), point, 80_000)
    if turn > 30.0:
        assert not found.any() and not expected.any()
    else:
        # Towards the cone's edge it matters that the emitter is no point.
        assert mean_test(found, expected, 2e-3 if turn < 25.0 else 2e-2) > SIGNIFICANCE
        assert found[0].mean() == pytest.approx(expected[0], rel=0.03)


def test_spotlights_in_one_place_add_up():
    spots = [
        spot((0.0, -1.0, 0.0), 20.0, 40.0),
        spot((0.8, -1.0, 0.0), 10.0, 30.0, 3000.0),
        spot((-1.0, -1.0, 0.1), 0.0, 20.0),
    ]
    lit = lit_floor(spots)
    for point in ((0.3, 0.0, -0.2), (0.9, 0.0, -0.3), (1.9, 0.0, -0.2), (-1.5, 0.0, 0.0)):
        expected = 0.5 / math.pi * sum(irradiance(light, point) for light in spots) * np.array([1.0, 2.0, 3.0])
        assert expected.any()
        assert mean_test(seen_at(lit, point, 50_000), expected, 2e-2) > SIGNIFICANCE


@pytest.mark.parametrize("axis", [(0.0, -1.0, 0.0), (0.5, -1.0, 0.4)])
@pytest.mark.parametrize("distance", [0.1, 1.0, 3.0])
def test_draws_within_a_cone_are_not_wasted_on_what_shines_elsewhere(axis, distance):
    """At all sides of the cone, however far beyond the grid of cells."""
    light = spot(axis, 20.0, 30.0)
    lit = lit_floor([light])
    power = PowerLightSampler(Lights(lit, Geometry(lit)))
    along, uniforms = np.asarray(light.emission_cone.axis), PixelRandom(0, 0, torch.arange(2000)).uniform(0, 6)
    for aside in np.random.default_rng(3).normal(size=(12, 3)):
        aside = np.cross(along, aside / np.linalg.norm(aside))
        point = torch.from_numpy((PLACE + distance * (along + 0.3 * aside)).astype(np.float32))
        light = power.draw(power.lights.query(point[:, None].repeat(1, 2000)), uniforms)
        assert (light.radiance[0] > 0.0).float().mean() > 0.95


@pytest.mark.slow
def test_both_techniques_together_agree_with_one_alone(monkeypatch):
    """Of a large, double-sided spotlight with a soft edge over a glossy plate, under a dim sky."""
    light = spot((0.3, -1.0, 0.2), 5.0, 50.0, 5.0, double_sided=True)
    meshes = [rectangle(0, rotate=UP, scale=3.0), rectangle(1, (0.0, 1.0, 0.0), (70.0, 20.0, 0.0), 0.5)]
    glossy = Material("glossy", (0.9, 0.7, 0.4), metallic=0.5, roughness=0.3)
    lit = scene(meshes, [glossy, light], sky(0.05), max_depth=3)
    ray = (1.0, 1.0, 1.0), (-0.8, -1.0, -0.8)
    together = estimates(lit, *ray, 50_000)
    bsdf_sampling_only(monkeypatch)
    assert agreement(together, estimates(lit, *ray, 200_000, 1)) > SIGNIFICANCE
