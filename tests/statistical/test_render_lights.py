"""Light sampling: what a draw is worth, and the density it is weighed with."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.guiding.cluster_lights import VOXEL_SHARE
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.lights.scene_lights import MIN_SHARE, Lights
from bokehguide.render.vector import dot
from bokehguide.scene.types import Sun, Texture
from tests.support.choice_cases import learned_choice
from tests.support.light_cases import DRAWS, ORIGIN, at, emitters, sampled, window
from tests.support.sphere import SphereGrid
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import DOWN, emitter, inward, matte, rectangle, scene, sky, sphere

SUNS = (Sun((0.6, 0.8, 0.0), 8.0, (2.0, 2.0, 2.0)), Sun((0.0, -0.6, -0.8), 12.0, (1.0, 1.0, 0.5)))
PLACES = [ORIGIN, (0.6, 0.1, 1.6), (-30.0, 20.0, 9.0)]
"""Amid the emitters, between two of them, and far outside the grid."""


def seen_from(place, directions: torch.Tensor, geometry: Geometry):
    """Hits of rays from a point, and the cosines and radiance at those that hit."""
    hit = geometry.tracer.intersect(at(place, directions.shape[1]), directions)
    met = hit.triangle >= 0
    cosine, radiance = torch.zeros(len(met)), torch.zeros_like(directions)
    inside = type(hit)(*(field[met] for field in hit))
    cosine[met] = -dot(geometry.face_normals(inside.triangle), directions[:, met])
    radiance[:, met] = geometry.emission(inside, (cosine[met] > 0.0).float(), -directions[:, met])
    return hit, met, cosine, radiance


def unoccluded(light, geometry: Geometry, place=ORIGIN) -> torch.Tensor:
    return geometry.tracer.visible(at(place, len(light.pdf)), light.direction, light.distance * (1.0 - 1e-4))


def environment_share(lights: Lights, points: torch.Tensor) -> torch.Tensor:
    """Share of the draws at `points` `[3, N]` that go to the environment."""
    direction, pdf = lights.sampled_environment.sample(torch.full((5, 1), 0.3))
    return PowerLightSampler(lights).environment_pdf(points, direction.expand_as(points)) / pdf


@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize("environment", [None, window()], ids=["emitters", "emitters and sky"])
@pytest.mark.parametrize("place", PLACES[:2])
def test_weighted_draws_add_up_to_the_light_of_each_part_of_the_sphere(environment, place, learnt):
    """Of the sky, what exceeds its mean."""
    power, geometry, _, light = sampled(emitters(environment), place=place, learnt=learnt)
    lights = power.lights
    grid = SphereGrid(8, 16, 48)
    _, met, _, radiance = seen_from(place, grid.directions, geometry)
    if environment:
        sky = grid.directions[:, ~met]
        radiance[:, ~met] = lights.environment.radiance(sky) * (lights.environment.pdf(sky) > 0.0)
    worth = (light.radiance[1] / light.pdf * unoccluded(light, geometry, place)).double().numpy()
    expected = grid.cell_integrals(radiance[1])
    cell = grid.cells(light.direction)
    mean = np.bincount(cell, worth, 128) / DRAWS
    error = np.sqrt(np.bincount(cell, worth**2, 128) / DRAWS - mean**2) / math.sqrt(DRAWS)
    quadrature = 0.02 * expected + 2e-4  # edges of emitters cross its points
    assert z_test(mean - expected, error + quadrature) > SIGNIFICANCE
    total_error = np.sqrt((error**2).sum()) + 2e-3 * expected.sum()
    assert z_test((mean - expected).sum(), total_error) > SIGNIFICANCE


@pytest.mark.parametrize("suns", [(), SUNS], ids=["no sun", "suns"])
@pytest.mark.parametrize("place, learnt", [*((place, False) for place in PLACES), (ORIGIN, True), ((0.4, 0.1, 0.6), True)])
def test_the_density_of_a_draw_is_the_one_that_a_ray_finds_there(place, learnt, suns):
    _, geometry, lights, light = sampled(replace(emitters(window()), suns=suns), place=place, learnt=learnt)
    hit, met, cosine, _ = seen_from(place, light.direction, geometry)
    there = unoccluded(light, geometry, place) > 0.0
    points = at(place, DRAWS)
    found = lights.environment_pdf(points, light.direction)
    triangles = hit.triangle.clamp(min=0)
    found = torch.where(met, lights.triangle_pdf(points, triangles, hit.distance, cosine), found)
    apart = (found[there] / light.pdf[there] - 1.0).abs() > 1e-2
    assert there.float().mean() > 0.5
    assert apart.float().mean() < 1e-3  # rounding across an edge


@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize("place", [ORIGIN, (0.9, -0.5, 0.2), (-0.2, 0.3, -1.1)])
def test_densities_over_the_whole_sphere_integrate_to_one(place, learnt):
    """Inside a closed emitter, with a map that gets its share of the draws though none of it is seen."""
    shell = scene([inward(sphere(0, (0.2, 0.1, -0.3), 1.5))], [emitter()], window())
    geometry = Geometry(shell)
    lights = Lights(shell, geometry)
    grid = SphereGrid(32, 64, 12)
    hit, met, cosine, _ = seen_from(place, grid.directions, geometry)
    assert met.all()
    points = at(place, len(met))
    share = float(environment_share(lights, points[:, :1]))
    distribution = PowerLightSampler(lights)
    if learnt:
        distribution = learned_choice(distribution, 1, spread=0.2).select(torch.zeros(len(met), dtype=torch.int64))
        clusters = torch.arange(lights.clusters.triangles, lights.clusters.count)
        of_sky = float(distribution.probability(clusters, torch.zeros_like(clusters)).sum())
        share = VOXEL_SHARE * share + (1.0 - VOXEL_SHARE) * of_sky
    near = grid.integral(distribution.triangle_pdf(points, hit.triangle, hit.distance, cosine))
    far = grid.integral(distribution.environment_pdf(points, grid.directions))
    assert far == pytest.approx(share, abs=1e-3)
    assert near == pytest.approx(1.0 - share, abs=1e-3)


def test_where_all_else_is_equal_triangles_are_chosen_by_the_power_they_emit():
    """Five rectangles whose first triangles have one centre; at one metre under no angle the
    density is the choice over the area."""
    checkers = np.tile(np.array([[[1.0], [0.0]], [[0.0], [1.0]]], np.float32), (8, 8, 3))
    materials = [emitter(1.0), emitter(4.0), emitter(1.0, double_sided=True), emitter(1.0, emission_texture=Texture(checkers))]
    materials.append(emitter(1.0, opacity=0.25, alpha_mode="blend"))
    first = rectangle(0)
    center = first.vertices[first.triangles[0]].mean(axis=0)
    heights = np.array([0.5, 1.5, 2.5, 3.5, 4.5])
    meshes = [rectangle(i, center * (0.0, 1.0 - h, 0.0), scale=(1.0, h, 1.0)) for i, h in enumerate(heights)]
    lit = scene(meshes, materials)
    lights = PowerLightSampler(Lights(lit, Geometry(lit)))
    ones = torch.ones(10)
    above = (*center[:2].tolist(), 3.0)
    density = lights.triangle_pdf(at(above, 10), torch.arange(10), ones, ones).double().numpy()
    relative = density[::2] / density[0]
    np.testing.assert_allclose(relative[[0, 1, 2, 4]], [1.0, 4.0, 2.0, 0.25], rtol=1e-3)
    assert relative[3] == pytest.approx(0.5, rel=0.1)  # half lit, looked at in a few points
    assert density @ (2.0 * np.repeat(heights, 2)) == pytest.approx(1.0, rel=1e-5)


def test_whatever_emits_may_be_drawn_everywhere_and_nothing_else():
    """Also from behind, from far away, and where a million times brighter emitters are near."""
    black = replace(emitter(), emission_texture=Texture(np.zeros((2, 2, 3), np.float32)))
    turned = (0.0, 0.0, 180.0, 0.0)
    meshes = [rectangle(i, (2.0 * i, 0.0, -1.0), (turned[i], 0.0, 0.0), 0.5) for i in range(4)]
    lit = scene(meshes, [emitter(1e-3), matte(), emitter(1e3), black])
    lights = PowerLightSampler(Lights(lit, Geometry(lit)))
    for points in (torch.randn(3, 1000, generator=torch.Generator().manual_seed(1)) * s for s in (1.0, 10.0, 1e4)):
        ones = torch.ones(points.shape[1])
        for triangle, emits in enumerate(np.repeat([True, False, True, False], 2)):
            density = lights.triangle_pdf(points, torch.full((1000,), triangle), ones, ones)
            assert bool((density > 0.0).all()) == bool(emits) and bool(density.any()) == bool(emits)


def test_a_lamp_seen_from_behind_is_black_unless_double_sided():
    for double_sided in (False, True):
        away = scene([rectangle(0, (0, 0, 1.0))], [emitter(2.0, double_sided=double_sided)])
        *_, light = sampled(away, 1000)
        assert bool(light.radiance.any()) == double_sided
        facing = scene([rectangle(0, (0, 0, 1.0), (180.0, 0.0, 0.0))], [emitter(2.0, double_sided=double_sided)])
        *_, light = sampled(facing, 1000)
        assert torch.equal(light.radiance, torch.tensor([2.0, 4.0, 6.0])[:, None].expand(3, 1000))


def test_draws_lie_on_the_lamp_at_the_given_distance():
    ball = scene([sphere(0, (0.0, 0.0, 3.0), 0.5)], [emitter()])
    *_, light = sampled(ball, 10_000)
    point = light.direction * light.distance
    radius = (point - torch.tensor([[0.0], [0.0], [3.0]])).norm(dim=0)
    assert ((radius - 0.5).abs() < 5e-3).all()
    assert (light.direction.norm(dim=0) - 1.0).abs().max() < 1e-5


@pytest.mark.parametrize(
    "environment, material, empty",
    [(None, matte(), True), (sky(0.0), matte(), True), (None, emitter(), False), (window(), matte(), False)],
)
def test_whether_there_is_anything_to_sample(environment, material, empty):
    lit = scene([rectangle(0)], [material], environment)
    assert Lights(lit, Geometry(lit)).empty == empty


@pytest.mark.parametrize("power, share", [(1e-9, 1.0 - MIN_SHARE), (1e9, MIN_SHARE)])
def test_neither_the_sky_nor_the_lamps_are_starved(power, share):
    lit = scene([rectangle(0, rotate=DOWN)], [emitter(power, double_sided=True)], window())
    lights = Lights(lit, Geometry(lit))
    points = torch.randn(3, 1000, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(environment_share(lights, points), torch.full((1000,), share))


def test_the_sky_gets_fewer_draws_near_the_lamps():
    """Halves of the room lit by an emitter each, one a hundred times the other."""
    meshes = [rectangle(0, (-3.0, 1.0, 0.0), DOWN, 0.3), rectangle(1, (3.0, 1.0, 0.0), DOWN, 0.3)]
    lit = scene(meshes, [emitter(10.0), emitter(1000.0)], window())
    points = torch.tensor([[3.0, 3.0, 0.0, -3.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    share = environment_share(Lights(lit, Geometry(lit)), points)
    assert (share.diff() >= 0.0).all() and share[0] == pytest.approx(MIN_SHARE)
    assert share[0] < 0.5 * share[-1]


def test_a_textured_lamp_whose_light_lies_between_the_points_looked_at_is_no_light_but_still_shines():
    """One lit texel of 64 × 64: no draw finds it, so its density is 0 and a path that meets it counts in full."""
    texture = np.zeros((64, 64, 3), np.float32)
    texture[1, 1] = 1.0
    lit = scene([rectangle(0, (0, 0, 1.0))], [replace(emitter(), emission_texture=Texture(texture))])
    lights = Lights(lit, Geometry(lit))
    one = torch.ones(2)
    assert lights.empty
    assert not PowerLightSampler(lights).triangle_pdf(at(ORIGIN, 2), torch.arange(2), one, one).any()
