"""What rays find where they hit: sides, normals, textures, emission, and how new rays leave."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot
from bokehguide.scene.types import Material, Texture
from tests.tracing import UP, matte, rectangle, scene, sphere


def found(geometry: Geometry, origins, directions):
    """Hits and surfaces of rays `[N, 3]` that all hit."""
    origins = torch.tensor(np.asarray(origins).T.copy(), dtype=torch.float32)
    directions = torch.nn.functional.normalize(torch.tensor(np.asarray(directions).T.copy(), dtype=torch.float32), dim=0)
    hit = geometry.tracer.intersect(origins, directions)
    assert (hit.triangle >= 0).all()
    return hit, geometry.surface(origins, directions, hit)


def test_normals_face_the_viewer_and_the_front_is_known():
    geometry = Geometry(scene([rectangle(0, rotate=UP)], [matte()]))
    _, surface = found(geometry, [[0.1, 1, 0.2], [0.1, -1, 0.2]], [[0, -1, 0], [0, 1, 0]])
    assert surface.front.tolist() == [1.0, 0.0]
    expected = torch.tensor([[0.0, 0.0], [1.0, -1.0], [0.0, 0.0]])
    torch.testing.assert_close(surface.geometric_normal, expected)
    torch.testing.assert_close(surface.normal, expected)
    torch.testing.assert_close(surface.outgoing, expected)
    torch.testing.assert_close(surface.position, torch.tensor([[0.1, 0.1], [0.0, 0.0], [0.2, 0.2]]), atol=1e-6, rtol=0.0)


def test_shading_normals_are_interpolated_between_the_corners():
    corners = np.array([[-0.3, 0.0, 1.0], [0.4, 0.1, 1.0], [0.2, 0.5, 1.0], [0.0, -0.4, 1.0]], np.float32)
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    geometry = Geometry(scene([sphere(0, (9, 9, 9)), replace(rectangle(0), normals=corners)], [matte()]))
    points = np.random.default_rng(1).uniform(-0.9, 0.9, (200, 2))
    hit, surface = found(geometry, np.c_[points, np.ones(200)], np.tile([[0, 0, -1]], (200, 1)))
    expected = []
    for x, y in points:  # the corners are (-1, -1), (1, -1), (1, 1), (-1, 1); the triangles 0 1 2 and 0 2 3
        a, b = ((1 + x) / 2, (1 + y) / 2)
        weights = (1 - a, a - b, b, 0.0) if a > b else (1 - b, 0.0, a, b - a)
        normal = np.array(weights) @ corners
        expected.append(normal / np.linalg.norm(normal))
    np.testing.assert_allclose(surface.normal.T.numpy(), expected, atol=1e-5)
    assert torch.equal(surface.geometric_normal[2], torch.ones(200))


def test_a_sphere_has_radial_normals_from_outside_and_inside():
    geometry = Geometry(scene([sphere(0, (1.0, 2.0, 3.0), 2.0)], [matte()]))
    directions = np.random.default_rng(2).normal(size=(500, 3))
    _, inside = found(geometry, np.tile([[1.0, 2.0, 3.0]], (500, 1)), directions)
    radial = torch.nn.functional.normalize(torch.tensor(directions.T, dtype=torch.float32), dim=0)
    assert (dot(inside.normal, -radial) > 0.9999).all() and not inside.front.any()
    _, outside = found(geometry, np.array([[1.0, 2.0, 3.0]]) + 5.0 * radial.T.numpy(), -directions)
    assert (dot(outside.normal, radial) > 0.9999).all() and outside.front.all()


def test_a_shading_normal_that_faces_away_from_the_viewer_gives_way():
    tilt = np.tile(np.array([[math.sin(1.4), 0.0, math.cos(1.4)]], np.float32), (4, 1))
    geometry = Geometry(scene([replace(rectangle(0), normals=tilt)], [matte()]))
    _, surface = found(geometry, [[0.5, 0, 0.5], [-0.5, 0, 0.5]], [[-1, 0, -0.6], [1, 0, -0.6]])
    torch.testing.assert_close(surface.normal[:, 0], torch.from_numpy(tilt[0]))
    torch.testing.assert_close(surface.normal[:, 1], torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("away", [0.0, 100.0, 10_000.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_rays_that_leave_do_not_meet_the_surface_they_leave(away, side):
    """A slanted plate far from the origin; new rays go to all directions of one side, grazing ones too."""
    plate = rectangle(0, (away, -away, 0.3 * away), (-50.0, 30.0, 10.0), 1.0 + 0.1 * away)
    geometry = Geometry(scene([plate], [matte()]))
    _, surface = found(geometry, np.array([[away + 1.0, 1.5 - away, 0.3 * away + 2.0]] * 5000), np.array([[-1, -1.5, -2]] * 5000))
    uniforms = PixelRandom(0, 0, torch.arange(5000)).uniform(0, 3)
    direction = torch.nn.functional.normalize(uniforms - 0.5, dim=0)
    cosine = dot(direction, surface.geometric_normal)
    direction = direction * torch.sign(cosine) * side
    again = geometry.tracer.intersect(surface.leave(direction), direction)
    assert (again.triangle < 0).all()


def test_textures_multiply_their_factors_at_the_hits_uv():
    """A 2 × 1 texture: the left half of the rectangle has u below one half; green is roughness, blue metal."""
    color = np.array([[[1.0, 0.5, 0.25], [0.0, 1.0, 0.5]]], np.float32)
    packed = np.array([[[0.9, 0.5, 1.0], [0.9, 1.0, 0.5]]], np.float32)
    painted = Material(
        "painted", (0.5, 0.8, 1.0), 0.6, 0.8, base_color_texture=Texture(color), metallic_roughness_texture=Texture(packed)
    )
    plain = Material("plain", (0.1, 0.2, 0.3), 0.4, 0.5)
    geometry = Geometry(scene([rectangle(1, (5, 0, 0)), rectangle(0)], [painted, plain]))
    _, surface = found(geometry, [[-0.5, 0.3, 1], [0.5, -0.3, 1], [0, 0, 1], [5, 0, 1]], [[0, 0, -1]] * 4)
    expected = [[0.5, 0.4, 0.25], [0.0, 0.8, 0.5], [0.25, 0.6, 0.375], [0.1, 0.2, 0.3]]
    np.testing.assert_allclose(surface.base_color.T.numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(surface.alpha.numpy(), np.array([0.4, 0.8, 0.6, 0.5]) ** 2, atol=1e-5)
    np.testing.assert_allclose(surface.metallic.numpy(), [0.6, 0.3, 0.45, 0.4], atol=1e-5)


def test_the_first_row_of_a_texture_is_its_top():
    texture = np.array([[[1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]]], np.float32)
    poster = Material("poster", (1.0, 1.0, 1.0), base_color_texture=Texture(texture))
    geometry = Geometry(scene([rectangle(0)], [poster]))
    _, surface = found(geometry, [[0.2, 0.5, 1], [0.2, -0.5, 1]], [[0, 0, -1]] * 2)
    assert surface.base_color[0].tolist() == [1.0, 0.0]


def test_emission_is_textured_and_leaves_the_front():
    texture = np.array([[[1.0, 0.5, 0.25], [0.0, 0.0, 1.0]]], np.float32)
    screen = Material("screen", emission=(2.0, 4.0, 8.0), emission_texture=Texture(texture))
    both = replace(screen, double_sided=True)
    geometry = Geometry(scene([rectangle(0), rectangle(1, (5, 0, 0)), rectangle(2, (10, 0, 0))], [screen, both, matte()]))
    hit, surface = found(
        geometry,
        [[-0.5, 0, 1], [0.5, 0, 1], [-0.5, 0, -1], [4.5, 0, -1], [10, 0, 1]],
        [[0, 0, -1], [0, 0, -1], [0, 0, 1], [0, 0, 1], [0, 0, -1]],
    )
    expected = [[2, 2, 2], [0, 0, 8], [0, 0, 0], [2, 2, 2], [0, 0, 0]]
    np.testing.assert_allclose(geometry.emission(hit, surface.front, surface.outgoing).T.numpy(), expected, atol=1e-5)


def test_materials_belong_to_their_meshes():
    materials = [Material("a", (0.1, 0.1, 0.1), ior=1.2), Material("b", (0.2, 0.2, 0.2), transmission=0.7, thin=True)]
    geometry = Geometry(scene([rectangle(1), rectangle(0, (5, 0, 0)), sphere(1, (10, 0, 0))], materials))
    _, surface = found(geometry, [[0, 0.1, 2], [5, 0.1, 2], [10, 0.1, 2]], [[0, 0, -1]] * 3)
    np.testing.assert_allclose(surface.base_color[0].numpy(), [0.2, 0.1, 0.2])
    np.testing.assert_allclose(surface.ior.numpy(), [1.5, 1.2, 1.5])
    np.testing.assert_allclose(surface.transmission.numpy(), [0.7, 0.0, 0.7])
    assert surface.thin.tolist() == [1.0, 0.0, 1.0]


def test_rare_terms_are_none_unless_a_material_of_the_scene_has_them():
    ray = [[0, 0.1, 2], [5, 0.1, 2]], [[0, 0, -1]] * 2
    _, surface = found(Geometry(scene([rectangle(0), rectangle(0, (5, 0, 0))], [matte()])), *ray)
    assert surface.specular_color is None and surface.clearcoat is None and surface.clearcoat_alpha is None
    coated = Material("coated", specular_color=(1.0, 0.5, 0.2), clearcoat=0.7, clearcoat_roughness=0.5)
    _, surface = found(Geometry(scene([rectangle(0), rectangle(1, (5, 0, 0))], [matte(), coated])), *ray)
    surface = surface.select(torch.tensor([1, 0]))
    np.testing.assert_allclose(surface.specular_color.T.numpy(), [[1.0, 0.5, 0.2], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(surface.clearcoat.numpy(), [0.7, 0.0])
    np.testing.assert_allclose(surface.clearcoat_alpha.numpy(), [0.25, 1e-3])
