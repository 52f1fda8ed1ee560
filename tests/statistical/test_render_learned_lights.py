"""Learned choices of lights with suns, textures, shadows and stratified numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.guiding.cluster_lights import ClusterSample, MixtureLights
from bokehguide.render.lights.distant import DistantLight
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime import native
from bokehguide.scene.types import Environment, Material, Scene, Sun, Texture
from bokehguide.train import RenderLoop, RenderSettings
from tests.support.choice_cases import OneTable, traced, under
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import DOWN, UP, agreement, emitter, matte, rectangle, scene, sky

METAL = Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)
RAY = ((1.0, 1.0, 1.0), (-1.0, -1.0, -1.0))
SUNS = (Sun((-0.5, 0.6, -0.62), 30.0, (1.0, 2.0, 3.0)), Sun((0.0, 0.6, -0.8), 50.0, (3.0, 2.0, 1.0)))
WEIGHTS = (1.0, 4.0)


def drawn(tracer: PathTracer, lights: MixtureLights, points: torch.Tensor, uniforms: torch.Tensor) -> ClusterSample:
    return lights.draw(tracer.lights.query(points), uniforms)


def window() -> Environment:
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = 5.0
    return Environment(radiance, 40.0)


@pytest.mark.parametrize("map_", [None, window()], ids=["suns", "map and suns"])
def test_the_density_of_a_sun_is_the_share_of_learned_draws_that_fall_into_it(map_):
    tracer, count = PathTracer(under(scene([rectangle(0, rotate=UP)], [matte()], map_), SUNS)), 200_000
    points = torch.tensor([[0.1], [0.0], [0.2]]).expand(3, count)
    lights = OneTable(tracer, np.linspace(1.0, 4.0, tracer.lights.clusters.count)).at(points)
    draws = drawn(tracer, lights, points, PixelRandom(0, 0, torch.arange(count)).uniform(0, 6))
    places = PixelRandom(1, 0, torch.arange(count)).uniform(0, 2)
    for disc in map(DistantLight, SUNS):
        within = disc.contains(draws.direction).double()
        density = lights.environment_pdf(points, disc.sample(places)).double() / disc.density
        error = ((within.var() + density.var()) / count).sqrt()
        assert float(within.mean()) > 0.01
        assert z_test((within.mean() - density.mean()).numpy(), error.numpy()) > SIGNIFICANCE


@pytest.mark.parametrize("map_", [None, window()], ids=["suns", "map and suns"])
def test_suns_in_glossy_metal_count_once_under_a_learned_choice(map_):
    lit = under(scene([rectangle(0, rotate=UP, scale=2.0)], [METAL], map_), SUNS)
    clusters = PathTracer(lit).lights.clusters.count
    weights = np.append(np.full(clusters - 2, 0.1), WEIGHTS)
    assert agreement(light(lit, RAY, weights=weights), light(lit, RAY, learned=False, seed=1)) > SIGNIFICANCE


def light(lit: Scene, ray, **how) -> np.ndarray:
    """Radiance `[3, N]` along many copies of a ray."""
    return traced(lit, ray, 100_000, **how).paths.radiance.double().numpy()


def half_hidden() -> Scene:
    """A floor below a large emitter, of which a card hides the half at negative z."""
    meshes = [rectangle(0, rotate=UP, scale=2.0), rectangle(1, (0.0, 1.0, 0.0), DOWN, 0.8), rectangle(2, (0.0, 0.9, -1.0), DOWN)]
    return scene(meshes, [matte(0.8), emitter(3.0), matte(0.0)])


def two_coloured() -> Scene:
    """A floor below a large emitter, one half of which is red and the other green, of one luminance."""
    texture = np.zeros((2, 2, 3), np.float32)
    texture[0], texture[1] = (0.7152, 0.0, 0.0), (0.0, 0.2126, 0.0)
    glowing = Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(20.0, 20.0, 20.0), emission_texture=Texture(texture))
    return scene([rectangle(0, rotate=UP, scale=2.0), rectangle(1, (0.0, 1.0, 0.0), DOWN, 0.8)], [matte(0.8), glowing])


LOW_RAY = ((1.5, 0.5, 0.0), (-1.5, -0.5, 0.0))


@pytest.mark.parametrize("lit", [half_hidden(), two_coloured()], ids=["half hidden", "two-coloured"])
def test_the_kept_candidate_is_independent_of_its_place_on_the_emitter(lit):
    """The mean of each colour is that of light samples without resampling."""
    plain = light(lit, LOW_RAY, learned=False, seed=1)
    assert plain.mean() > 0.05
    assert agreement(light(lit, LOW_RAY), plain) > SIGNIFICANCE


def everything() -> Scene:
    """Glass, a translucent card, emitters, a sun and a map, with long paths."""
    glass = Material("glass", (1.0, 1.0, 1.0), roughness=0.2, transmission=0.7)
    translucent = Material("translucent", (0.4, 0.4, 0.4), opacity=0.5, alpha_mode="blend")
    meshes = [
        rectangle(0, (0.0, -0.5, -3.0), UP, 4.0),
        rectangle(1, (0.0, 0.0, -2.0), scale=0.7),
        rectangle(2, (0.3, 0.0, -1.5), scale=0.5),
        rectangle(3, (0.0, 1.5, -3.0), DOWN, 0.5),
    ]
    lit = under(scene(meshes, [matte(0.8), glass, translucent, emitter(5.0)], window(), max_depth=6), SUNS)
    return replace(lit, camera=replace(lit.camera, fov=50.0, aperture_radius=0.1, focus_distance=1.0))


@pytest.mark.parametrize("mode", ["uniform", "lis-b", "guided"])
def test_no_random_dimension_of_a_path_is_used_twice(mode, monkeypatch):
    """Of one step of one batch, in PyTorch: the native core has the same dimensions, as its agreement shows."""
    monkeypatch.setenv(native.SWITCH, "0")
    used: list[tuple[str, int, int]] = []

    def noted(name, draw):
        def called(self, dimension, count, first=1, number=0):
            used.extend((name, each, number) for each in range(dimension, dimension + count))
            return draw(self, dimension, count, *((first, number) if name == "stratified" else ()))

        return called

    loop = RenderLoop(everything(), RenderSettings(mode, seed=1, threads=1))
    for _ in range(4):
        loop.step()
    for name in ("uniform", "stratified"):
        monkeypatch.setattr(PixelRandom, name, noted(name, getattr(PixelRandom, name)))
    loop.step()
    twice = [key for key in used if used.count(key) > 1]
    assert len(used) > 40 and not twice


def repeats(cells: list[torch.Tensor]) -> tuple[float, float]:
    """How often the first of some `[N]` is among the others of the same pixel, and of the next pixel."""
    first, *others = cells
    return tuple(float((torch.stack(others) == one).any(0).double().mean()) for one in (first, first.roll(1)))


FOUR_LAMPS = [rectangle(1, (x, 1.0, z), DOWN, 0.2) for x in (-0.6, 0.6) for z in (-0.6, 0.6)]


def test_numbers_of_an_epoch_are_independent_of_the_epoch_before():
    """The step before the epoch repeats its draws as often as chance does: of lights, and of first bounces.

    A sequence over both epochs would repeat them less often.
    """
    lit, count = scene([rectangle(0, rotate=UP, scale=2.0), *FOUR_LAMPS], [matte(0.8), emitter(2.0)]), 40_000
    steps = [(4, 3), (5, 5), (6, 5), (7, 5), (8, 5)]
    samples = [traced(lit, RAY, count, step=step, epoch=epoch, candidates=1, split=True) for step, epoch in steps]
    clusters = [found.lights.samples[0].cluster for found in samples]
    assert int(torch.stack(clusters).max()) == 7
    scattered = [found.paths.primary_hits.scattered_direction for found in samples]
    sectors = [(4.0 / torch.pi * torch.atan2(way[2], way[0])).floor() for way in scattered]
    heights = [(8.0 * way[1].square()).floor() for way in scattered]
    for cells in (clusters, sectors, heights):
        own, other = repeats(cells)
        assert 0.3 < other < 0.7
        assert z_test(own - other, np.sqrt((own - own**2 + other - other**2) / count)) > SIGNIFICANCE


def test_paths_by_power_have_one_sequence_for_all_steps():
    lit = scene([rectangle(0, rotate=UP, scale=2.0)], [matte(0.8)], sky(1.0))
    samples = [traced(lit, RAY, 64, learned=False, step=step, split=True) for step in range(1, 65)]
    scattered = [found.paths.primary_hits.scattered_direction for found in samples]
    heights = torch.stack([(8.0 * way[1].square()).floor().clamp(0, 7) for way in scattered]).long()
    assert bool((torch.stack([row.bincount(minlength=8) for row in heights.T]) == 8).all())
