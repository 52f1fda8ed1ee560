"""Radiance along single rays, against answers known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render import path_tracer
from bokehguide.render.observer import PathObserver
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.paths import Paths
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Environment, Material
from tests.support.light_checks import (
    LIGHT,
    RECTANGLE,
    direct_light,
    glass,
    polygon_irradiance,
    reflectance,
    shadow,
    under_a_rectangle,
)
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import DOWN, UP, emitter, estimates, inward, matte, mean_test, rectangle, scene, sky, sphere, trace

OBLIQUE = (0.3, -0.5, -0.8)


def furnace(albedo: float, max_depth: int, emission: float = 0.2):
    """The inside of a closed ball that reflects `albedo` and emits."""
    wall = matte(albedo, emission=(emission, 2.0 * emission, 3.0 * emission))
    return scene([inward(sphere(0))], [wall], max_depth=max_depth)


@pytest.mark.parametrize("max_depth", [1, 2, 3, 4, 7])
def test_a_closed_furnace_sums_the_series_up_to_the_longest_path(max_depth):
    samples = estimates(furnace(0.6, max_depth), (0.1, 0.2, 0.3), OBLIQUE)
    series = sum(0.6**bounce for bounce in range(max_depth))
    assert mean_test(samples, 0.2 * series * LIGHT) > SIGNIFICANCE


def test_a_closed_furnace_converges_to_the_whole_series():
    samples = estimates(furnace(0.8, 100), (0.1, 0.2, 0.3), OBLIQUE)
    assert mean_test(samples, 0.2 / (1.0 - 0.8) * LIGHT) > SIGNIFICANCE


@pytest.mark.parametrize("first", [1, 2, 1000])
def test_russian_roulette_keeps_the_mean(first, monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    monkeypatch.setattr(path_tracer, "ROULETTE_DEPTH", first)
    samples = estimates(furnace(0.7, 12), (0.1, 0.2, 0.3), OBLIQUE)
    assert mean_test(samples, 0.2 * (1.0 - 0.7**12) / (1.0 - 0.7) * LIGHT) > SIGNIFICANCE


def test_a_matte_plane_under_a_constant_sky_shows_its_base_colour():
    ground = scene([rectangle(0, rotate=UP, scale=10.0)], [matte((0.8, 0.4, 0.1))], sky(2.0))
    samples = estimates(ground, (0.0, 1.0, 0.0), (0.1, -1.0, 0.2), 5000)
    assert mean_test(samples, [1.6, 0.8, 0.2], tolerance=1e-5) > SIGNIFICANCE
    np.testing.assert_allclose(estimates(ground, (0, 1, 0), (0.1, 1.0, 0.2), 10), 2.0, rtol=1e-6)


def test_a_matte_plane_under_a_sky_of_one_bright_spot():
    """Row 2 of 32: its texel, interpolated, against the cosine-weighted sum over a fine grid."""
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[2, 40] = (200.0, 100.0, 50.0)
    ground = scene([rectangle(0, rotate=UP, scale=10.0)], [matte(0.5)], Environment(radiance, 25.0))
    v = (np.arange(1024) + 0.5) / 2048
    weight = np.maximum(0.0, 1.0 - np.abs(v * 32 - 2.5))
    cosine = np.cos(np.pi * v) * np.sin(np.pi * v) * np.pi / 2048 * (2.0 * np.pi / 64)
    spot = (weight * cosine).sum()
    expected = 0.5 * (0.1 + (np.array([200.0, 100.0, 50.0]) - 0.1) * spot / np.pi)
    samples = estimates(ground, (0.0, 1.0, 0.0), (0.1, -1.0, 0.2), 50_000)
    assert mean_test(samples, expected, tolerance=3e-4) > SIGNIFICANCE


def test_direct_light_of_a_rectangle():
    assert direct_light() > SIGNIFICANCE


def test_direct_light_of_a_sphere():
    """The ball hangs at 2 m under 30 degrees; irradiance (r / d)² cos, tessellated to 0.1 %."""
    centre = (1.0, math.sqrt(3.0), 0.0)
    ball = scene([rectangle(0, rotate=UP, scale=20.0), sphere(1, centre, 0.4)], [matte(0.7), emitter(5.0)])
    expected = 0.7 * 5.0 * LIGHT * (0.4 / 2.0) ** 2 * math.cos(math.radians(30.0))
    samples = estimates(ball, (0.0, 0.5, 0.0), (0.0, -1.0, 0.0), 50_000)
    assert mean_test(samples, expected, tolerance=1e-3) > SIGNIFICANCE


def test_the_half_of_a_lamp_behind_a_card_casts_no_light():
    assert shadow() > SIGNIFICANCE


def test_light_from_below_does_not_reach_the_top():
    ground = rectangle(0, rotate=UP, scale=2.0)
    below = scene([ground, rectangle(1, (0, -1, 0), UP)], [matte(0.8), emitter(5.0)])
    assert not estimates(below, (0.0, 1.0, 0.0), (0.1, -1.0, 0.0), 1000).any()


def test_paths_of_one_segment_see_emission_alone_and_of_two_direct_light():
    wall = matte(0.5, emission=(0.25, 0.5, 0.75))
    assert (estimates(under_a_rectangle(wall, 1), (0, 0.5, 0), (0, -1, 0), 10).T == [0.25, 0.5, 0.75]).all()
    np.testing.assert_allclose(estimates(under_a_rectangle(wall, 1), (0.3, 0.5, 0.1), (0, 1, 0), 1).ravel(), 5.0 * LIGHT)
    lit_by_sky = scene([rectangle(0, rotate=UP)], [wall], sky(1.0), max_depth=1)
    assert (estimates(lit_by_sky, (0, 0.5, 0), (0, -1, 0), 10).T == [0.25, 0.5, 0.75]).all()


def test_two_facing_walls_exchange_light_only_from_the_third_segment_on():
    """The emitter is seen by the upper wall alone, so the lower one is dark with two segments."""
    meshes = [rectangle(0, rotate=UP, scale=5.0), rectangle(0, (0, 2, 0), DOWN, 5.0), rectangle(1, (0, 1, 0), UP, 0.5)]
    for max_depth, dark in ((2, True), (3, False)):
        samples = estimates(scene(meshes, [matte(0.5), emitter()], max_depth=max_depth), (3, 0.5, 0), (0, -1, 0), 2000)
        assert (samples.mean() == 0.0) == dark


@pytest.mark.parametrize("double_sided", [False, True])
def test_emission_leaves_the_front_or_both_faces(double_sided):
    light = emitter(5.0, double_sided=double_sided)
    facing = scene([rectangle(0)], [light])
    np.testing.assert_allclose(estimates(facing, (0, 0, 1), (0, 0, -1), 1).ravel(), 5.0 * LIGHT)
    np.testing.assert_allclose(estimates(facing, (0, 0, -1), (0, 0, 1), 1).ravel(), 5.0 * LIGHT * double_sided)
    ground, hung = rectangle(0, rotate=UP, scale=20.0), rectangle(1, (0.3, 1.0, 0.1), UP, 0.5)
    samples = estimates(scene([ground, hung], [matte(0.7), light]), (0, 0.5, 0), (0.0, -1.0, 0.0))
    expected = 0.7 / math.pi * 5.0 * LIGHT * polygon_irradiance(RECTANGLE, np.array([0.0, 1.0, 0.0])) * double_sided
    assert mean_test(samples, expected) > SIGNIFICANCE


@pytest.mark.parametrize("degrees", [0.0, 50.0, 80.0])
@pytest.mark.parametrize("thin", [True, False])
def test_a_lamp_behind_a_pane_is_dimmed_by_what_the_pane_reflects(degrees, thin):
    """A sheet, or a slab of two faces with all the orders between them: both pass (1 - R) / (1 + R)."""
    angle = math.radians(degrees)
    origin, direction = (math.tan(angle), 0.0, 1.0), (-math.sin(angle), 0.0, -math.cos(angle))
    panes = [rectangle(0, scale=50.0)]
    if not thin:
        panes.append(rectangle(0, (0.0, 0.0, -0.1), (0.0, 180.0, 0.0), 50.0))
    behind = scene([*panes, rectangle(1, (0.0, 0.0, -1.0), scale=100.0)], [glass(thin=thin), emitter()], max_depth=40)
    single = reflectance(degrees, 1.5)
    assert mean_test(estimates(behind, origin, direction), (1.0 - single) / (1.0 + single) * LIGHT) > SIGNIFICANCE


def test_radiance_shrinks_by_the_square_of_the_index_on_its_way_out():
    """An emitter inside the glass: what leaves is (1 - R) L / η²."""
    embedded = scene([rectangle(0, scale=50.0), rectangle(1, (0.0, 0.0, -1.0), scale=50.0)], [glass(ior=1.8), emitter()])
    expected = (1.0 - reflectance(0.0, 1.8)) / 1.8**2 * LIGHT
    assert mean_test(estimates(embedded, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), expected) > SIGNIFICANCE


@pytest.mark.parametrize("roughness", [0.0, 0.2])
def test_a_ball_of_glass_vanishes_in_a_furnace(roughness):
    """Smooth glass loses nothing; rough glass only what masking without a second bounce takes."""
    material = Material("glass", (1.0, 1.0, 1.0), roughness=roughness, transmission=1.0)
    ball = scene([sphere(0)], [material], sky(1.0), max_depth=60)
    samples = estimates(ball, (0.3, 0.2, 4.0), (0.0, 0.0, -1.0))
    assert mean_test(samples, 1.0, tolerance=1e-4 if roughness == 0.0 else 2e-3) > SIGNIFICANCE


def test_a_mirror_shows_the_lamp_in_its_colour():
    gold = Material("gold", (0.9, 0.6, 0.3), metallic=1.0, roughness=0.0)
    room = scene([rectangle(0), rectangle(1, (0.0, 0.0, 3.0), (0.0, 180.0, 0.0))], [gold, emitter()])
    samples = estimates(room, (0.1, 0.1, 2.0), (0.0, 0.0, -1.0), 100_000)
    assert mean_test(samples, LIGHT * [0.9, 0.6, 0.3], tolerance=2e-4) > SIGNIFICANCE


def test_half_transparent_is_the_mean_of_matte_and_clear():
    emitters = [rectangle(1, (0.0, 0.0, -1.0), scale=100.0), rectangle(1, (0.0, 0.0, 2.0), (0.0, 180.0, 0.0), 100.0)]
    results = []
    for transmission in (0.0, 1.0, 0.4):
        pane = Material("pane", (0.5, 0.5, 0.5), 0.0, 0.5, transmission=transmission, thin=True)
        results.append(estimates(scene([rectangle(0), *emitters], [pane, emitter()]), (0.0, 0.1, 1.0), OBLIQUE, 50_000))
    opaque, clear, mixed = results
    variance = (0.36 * opaque.var(axis=1) + 0.16 * clear.var(axis=1)) / opaque.shape[1]
    expected = 0.6 * opaque.mean(axis=1) + 0.4 * clear.mean(axis=1)
    assert mean_test(mixed, expected, tolerance=float((np.sqrt(variance) / expected).max())) > SIGNIFICANCE


def test_tilted_shading_normals_let_no_light_through_a_wall():
    """The emitter behind the wall lies above the horizon of the shading normal only."""
    tilt = np.array([math.sin(1.2), 0.0, math.cos(1.2)], np.float32)
    wall = replace(rectangle(0), normals=np.tile(tilt, (4, 1)))
    emitters = [rectangle(1, (2.0, 0.0, -0.3), (0.0, -90.0, 0.0), 0.3)]
    for roughness in (0.1, 1.0):
        material = Material("wall", (0.8, 0.8, 0.8), roughness=roughness)
        hidden = scene([wall, *emitters], [material, emitter(50.0, double_sided=True)], max_depth=5)
        assert not estimates(hidden, (0.5, 0.0, 1.0), (-0.4, 0.1, -1.0), 5000).any()


def test_the_first_surface_is_reported():
    red = Material("red", (0.9, 0.1, 0.2))
    found = trace(scene([rectangle(0, (0.0, 0.0, -1.0))], [red], sky(1.0)), (0.0, 0.0, 1.0), (0.3, 0.0, -1.0), 5)
    assert torch.allclose(found.distance, torch.tensor(2.0 * math.sqrt(1.09)))
    assert torch.allclose(found.normal, torch.tensor([0.0, 0.0, 1.0])[:, None].expand(3, 5))
    assert torch.allclose(found.albedo, torch.tensor([0.9, 0.1, 0.2])[:, None].expand(3, 5))
    missed = trace(scene([rectangle(0)], [red]), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 5)
    assert (missed.distance == MISS_DISTANCE).all()
    assert not missed.radiance.any() and not missed.normal.any() and not missed.albedo.any()
    assert missed.rays == 5


class Arrivals(PathObserver):
    """Distances of the emitters that paths meet after their primary hits."""

    def arrival(self, paths: torch.Tensor, distance: torch.Tensor, radiance: torch.Tensor) -> None:
        self.distance = distance


def test_distances_of_emitters_are_those_from_the_vertex():
    """From 20 km away, rays leave the floor by 0.2 m; the emitter is at a height of 1 m."""
    lit = scene([rectangle(0, rotate=UP, scale=9.0), rectangle(1, (30.0, 1.0, 0.0), DOWN, 30.0)], [matte(), emitter()])
    origin, direction = (torch.tensor(part)[:, None].repeat(1, 1000) for part in ((-2e4, 4e3, 0.0), (2e4, -4e3, 0.0)))
    found, random = Arrivals(), PixelRandom(0, 1, torch.arange(1000))
    rays = origin, torch.nn.functional.normalize(direction, dim=0)
    PathTracer(lit).trace(*rays, random, PhaseTimer(), observers=(found,))
    assert len(found.distance) > 300 and 0.99 < float(found.distance.min()) < 1.1


def test_a_throughput_of_nan_makes_the_radiance_of_an_ended_path_nan():
    throughput, tracer = torch.ones(3, 3), PathTracer(furnace(0.5, 2))
    throughput[1, 1] = math.nan
    random = PixelRandom(0, 1, torch.arange(3))
    paths = Paths(torch.zeros(3, 3), torch.arange(3), throughput, torch.full((3, 3), 2.0), random, tracer.light_sampler)
    paths.end(torch.tensor([0, 1]))
    expected = torch.tensor([[2.0, 2.0, 0.0], [2.0, math.nan, 0.0], [2.0, 2.0, 0.0]])
    torch.testing.assert_close(paths.collected, expected, equal_nan=True)


def test_a_path_does_not_depend_on_those_beside_it():
    """The same pixels traced in a smaller batch bring back the same radiance."""
    tracer = PathTracer(furnace(0.7, 6))
    directions = torch.nn.functional.normalize(torch.randn(3, 3000, generator=torch.Generator().manual_seed(1)), dim=0)
    origins, random = torch.zeros(3, 3000), PixelRandom(0, 1, torch.arange(3000))
    whole = tracer.trace(origins, directions, random, PhaseTimer())
    index = torch.arange(0, 3000, 7)
    part = tracer.trace(origins[:, index], directions[:, index], random.select(index), PhaseTimer())
    torch.testing.assert_close(part.radiance, whole.radiance[:, index], rtol=1e-5, atol=1e-6)
