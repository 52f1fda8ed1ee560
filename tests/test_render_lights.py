"""Light sampling: what a draw is worth, and the density it is weighed with."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.lights import CANDIDATES, MIN_SHARE, Lights
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot
from bokehguide.scene.types import Environment, Scene
from tests.sphere import SphereGrid, surface
from tests.statistical import SIGNIFICANCE, z_test
from tests.tracing import DOWN, inward, lamp, matte, rectangle, scene, sky, sphere

DRAWS = 200_000
TEXTURE = np.zeros((4, 4, 3), np.float32)
TEXTURE[::2, ::2], TEXTURE[1::2, 1::2] = (1.0, 0.5, 0.2), (0.1, 0.5, 1.0)


def window() -> Environment:
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[2:6, 3:9] = 5.0
    return Environment(radiance, 40.0)


def lamps(environment: Environment | None) -> Scene:
    """Lamps around the origin: plain, textured, seen from behind, double-sided, one behind another; and a wall."""
    materials = [lamp(5.0), lamp(8.0, emission_texture=TEXTURE), lamp(3.0, double_sided=True), matte(0.5)]
    meshes = [
        rectangle(0, (0.5, 0.2, 1.0), (180.0, 0.0, 0.0), 0.4),
        rectangle(1, (-1.0, 0.5, 0.8), (30.0, 90.0, 0.0), 0.5),
        rectangle(0, (0.0, -1.0, 0.5), (90.0, 0.0, 0.0), 0.3),  # shows its back
        rectangle(2, (0.0, 1.5, 0.6), (-90.0, 0.0, 0.0), 0.3),
        rectangle(0, (1.0, 0.4, 2.0), (180.0, 0.0, 0.0), 0.6),
        sphere(0, (0.2, -0.5, -1.0), 0.2),
        rectangle(3, (1.2, -0.6, 0.4), (0.0, -90.0, 0.0), 0.4),
    ]
    return scene(meshes, materials, environment)


def sampled(scene: Scene, count: int = DRAWS, transmission: float = 1.0):
    """The lights, the geometry, and light samples at the origin, whose normal is z."""
    geometry = Geometry(scene)
    lights = Lights(scene, geometry)
    uniforms = PixelRandom(0, 0, torch.arange(count)).uniform(0, 6)
    return lights, geometry, lights.sample(surface(count, transmission=transmission), uniforms)


def from_origin(directions: torch.Tensor, geometry: Geometry):
    """Hits of rays from the origin, and the cosines and radiance at those that hit."""
    origins = torch.zeros_like(directions)
    hit = geometry.tracer.intersect(origins, directions)
    met = hit.triangle >= 0
    cosine, radiance = torch.zeros(len(met)), torch.zeros_like(directions)
    inside = type(hit)(*(field[met] for field in hit))
    cosine[met] = -dot(geometry.face_normals(inside.triangle), directions[:, met])
    radiance[:, met] = geometry.emission(inside, (cosine[met] > 0.0).float())
    return hit, met, cosine, radiance


def unoccluded(light, geometry: Geometry) -> torch.Tensor:
    return geometry.tracer.visible(torch.zeros_like(light.direction), light.direction, light.distance * (1.0 - 1e-4))


@pytest.mark.parametrize("environment", [None, window()], ids=["lamps", "lamps and sky"])
@pytest.mark.parametrize("transmission", [0.0, 1.0])
def test_weighted_draws_add_up_to_the_light_of_each_part_of_the_sphere(environment, transmission):
    """Through an opaque surface only the upper half counts; of the sky, what exceeds its mean."""
    lights, geometry, light = sampled(lamps(environment), transmission=transmission)
    grid = SphereGrid(8, 16, 48)
    _, met, _, radiance = from_origin(grid.directions, geometry)
    if environment:
        sky = grid.directions[:, ~met]
        radiance[:, ~met] = lights.environment.radiance(sky) * (lights.environment_pdf(sky) > 0.0)
    worth = (light.radiance[1] * light.weight * unoccluded(light, geometry)).double().numpy()
    expected = grid.cell_integrals(radiance[1])
    cell = grid.cells(light.direction)
    mean = np.bincount(cell, worth, 128) / DRAWS
    error = np.sqrt(np.bincount(cell, worth**2, 128) / DRAWS - mean**2) / math.sqrt(DRAWS)
    counted = slice(0, 128 if transmission else 64)
    quadrature = 0.02 * expected + 2e-4  # edges of lamps cross its points
    assert z_test((mean - expected)[counted], (error + quadrature)[counted]) > SIGNIFICANCE
    total_error = np.sqrt((error[counted] ** 2).sum()) + 2e-3 * expected.sum()
    assert z_test((mean - expected)[counted].sum(), total_error) > SIGNIFICANCE


def test_the_density_of_a_draw_is_the_one_that_a_ray_finds_there():
    lights, geometry, light = sampled(lamps(window()))
    hit, met, cosine, _ = from_origin(light.direction, geometry)
    there = unoccluded(light, geometry) > 0.0
    found = lights.environment_pdf(light.direction)
    triangles = hit.triangle.clamp(min=0)
    found = torch.where(met, lights.triangle_pdf(triangles, hit.distance, cosine), found)
    apart = (found[there] / light.pdf[there] - 1.0).abs() > 1e-2
    assert there.float().mean() > 0.5
    assert apart.float().mean() < 1e-3  # rounding across an edge


def test_densities_over_the_whole_sphere_integrate_to_the_number_of_candidates():
    """Inside a closed lamp, with a map that gets its share of the draws though none of it is seen."""
    shell = scene([inward(sphere(0, (0.2, 0.1, -0.3), 1.5))], [lamp()], window())
    geometry = Geometry(shell)
    lights = Lights(shell, geometry)
    grid = SphereGrid(32, 64, 12)
    hit, met, cosine, _ = from_origin(grid.directions, geometry)
    assert met.all()
    near = grid.integral(lights.triangle_pdf(hit.triangle, hit.distance, cosine))
    far = grid.integral(lights.environment_pdf(grid.directions))
    assert far == pytest.approx(lights.environment_share, abs=1e-3)
    assert near == pytest.approx(CANDIDATES * (1.0 - lights.environment_share), abs=1e-3 * CANDIDATES)


def test_triangles_are_chosen_by_the_power_they_emit():
    """At one metre under no angle the density is the choice over the area."""
    checkers = np.tile(np.array([[[1.0], [0.0]], [[0.0], [1.0]]], np.float32), (8, 8, 3))
    materials = [lamp(1.0), lamp(4.0), lamp(1.0, double_sided=True), lamp(1.0, emission_texture=checkers)]
    meshes = [rectangle(i, (3.0 * i, 0.0, 0.0), scale=(1.0, 0.5 + i, 1.0)) for i in range(4)]
    lit = scene(meshes, materials)
    lights = Lights(lit, Geometry(lit))
    ones = torch.ones(8)
    density = lights.triangle_pdf(torch.arange(8), ones, ones).double().numpy()
    relative = np.repeat([1.0, 4.0, 2.0, 0.5], 2)
    area = 2.0 * np.repeat([0.5, 1.5, 2.5, 3.5], 2)
    np.testing.assert_allclose(density[:6], relative[:6] * (density[0] / relative[0]), rtol=1e-5)
    np.testing.assert_allclose(density[6:], 0.5 * density[0], rtol=0.1)  # half lit, looked at in a few points
    assert density @ area == pytest.approx(CANDIDATES, rel=1e-5)


def test_a_lamp_seen_from_behind_is_black_unless_double_sided():
    for double_sided in (False, True):
        away = scene([rectangle(0, (0, 0, 1.0))], [lamp(2.0, double_sided=double_sided)])
        _, _, light = sampled(away, 1000)
        assert bool(light.radiance.any()) == double_sided
        facing = scene([rectangle(0, (0, 0, 1.0), (180.0, 0.0, 0.0))], [lamp(2.0, double_sided=double_sided)])
        _, _, light = sampled(facing, 1000)
        assert torch.equal(light.radiance, torch.tensor([2.0, 4.0, 6.0])[:, None].expand(3, 1000))


def test_draws_lie_on_the_lamp_at_the_given_distance():
    ball = scene([sphere(0, (0.0, 0.0, 3.0), 0.5)], [lamp()])
    _, _, light = sampled(ball, 10_000)
    point = light.direction * light.distance
    radius = (point - torch.tensor([[0.0], [0.0], [3.0]])).norm(dim=0)
    assert ((radius - 0.5).abs() < 5e-3).all()
    assert (light.direction.norm(dim=0) - 1.0).abs().max() < 1e-5


@pytest.mark.parametrize(
    "environment, material, empty",
    [(None, matte(), True), (sky(0.0), matte(), True), (None, lamp(), False), (window(), matte(), False)],
)
def test_whether_there_is_anything_to_sample(environment, material, empty):
    lit = scene([rectangle(0)], [material], environment)
    assert Lights(lit, Geometry(lit)).empty == empty


@pytest.mark.parametrize("power, share", [(1e-9, 1.0 - MIN_SHARE), (1e9, MIN_SHARE)])
def test_neither_the_sky_nor_the_lamps_are_starved(power, share):
    lit = scene([rectangle(0, rotate=DOWN)], [lamp(power)], window())
    assert Lights(lit, Geometry(lit)).environment_share == pytest.approx(share)


def test_a_textured_lamp_whose_light_lies_between_the_points_looked_at_is_no_light_but_still_shines():
    """One lit texel of 64 × 64: no draw finds it, so its density is 0 and a path that meets it counts in full."""
    texture = np.zeros((64, 64, 3), np.float32)
    texture[1, 1] = 1.0
    lit = scene([rectangle(0, (0, 0, 1.0))], [replace(lamp(), emission_texture=texture)])
    lights = Lights(lit, Geometry(lit))
    one = torch.ones(2)
    assert lights.empty
    assert not lights.triangle_pdf(torch.arange(2), one, one).any()
