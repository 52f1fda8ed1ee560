"""Normal maps against tangent frames worked out one triangle at a time, and against tilted geometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.scene.types import Material, Mesh, Texture
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import agreement, emitter, estimates, found, matte, mean_test, rectangle, scene, sky


def normal_map(*normal: float, **others) -> Texture:
    """A map of one tangent-space normal."""
    normal = np.array(normal) / np.linalg.norm(normal)
    return Texture((0.5 * normal[None, None] + 0.5).astype(np.float32), **others)


def patches(count: int) -> Mesh:
    """Unconnected triangles about the xy plane with normals, uvs and sides of their own, some mirrored in uv."""
    generator = np.random.default_rng(11)
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]) + generator.uniform(-0.3, 0.3, (count, 3, 3))
    corners[:, :, 0] += 4.0 * np.arange(count)[:, None]
    normals = generator.normal(0.0, 0.2, (count, 3, 3)) + [0.0, 0.0, 1.0]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    uvs = generator.uniform(-1.0, 1.0, (count, 3, 2, 2))
    order = np.arange(3 * count).reshape(count, 3)
    order[::2] = order[::2, ::-1]  # half of them show their backs
    normals[::2] *= -1.0
    flat = (array.reshape(3 * count, *array.shape[2:]).astype(np.float32) for array in (corners, normals, uvs))
    vertices, normals, uvs = flat
    return Mesh(vertices, order.astype(np.int32), 0, normals, uvs)


def reference(mesh: Mesh, triangle: int, point: np.ndarray, local: np.ndarray, material: Material) -> np.ndarray:
    """The bent normal on the side of +z at a point of a triangle, where the map says `local`."""
    corners = mesh.vertices[mesh.triangles[triangle]].astype(float)
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    (u, v), *_ = np.linalg.lstsq(np.stack((first, second), axis=1), point - corners[0], rcond=None)
    weights = np.array([1.0 - u - v, u, v])
    normal = weights @ mesh.normals[mesh.triangles[triangle]].astype(float)
    normal /= np.linalg.norm(normal)
    if mesh.tangents is not None:
        tangents = mesh.tangents[mesh.triangles[triangle]].astype(float)
        tangent, sign = weights @ tangents[:, :3], tangents[0, 3]
    else:
        texture = material.normal_texture
        a, b, _, d, e, _ = texture.transform
        uvs = mesh.uvs[mesh.triangles[triangle], texture.uv_set].astype(float) @ np.array([[a, d], [b, e]])
        uvs[:, 1] *= -1.0  # v upwards
        edges = np.stack((uvs[1] - uvs[0], uvs[2] - uvs[0]))
        tangent = np.linalg.solve(edges, np.stack((first, second)))[0]
        sign = np.sign(np.linalg.det(edges))
    tangent = tangent - normal * (normal @ tangent)
    tangent /= np.linalg.norm(tangent)
    local = local * [material.normal_scale, material.normal_scale, 1.0]
    bent = local[0] * tangent + local[1] * sign * np.cross(normal, tangent) + local[2] * normal
    front = np.cross(first, second)[2] > 0.0
    return bent / np.linalg.norm(bent) * (1.0 if front else -1.0)


def with_tangents(mesh: Mesh) -> Mesh:
    generator = np.random.default_rng(12)
    tangents = generator.normal(size=(len(mesh.vertices) // 3, 3, 3)) * 0.2 + [1.0, 0.5, 0.0]
    tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
    signs = np.repeat(generator.choice([-1.0, 1.0], (len(tangents), 1, 1)), 3, axis=1)
    return replace(mesh, tangents=np.concatenate((tangents, signs), axis=2).reshape(-1, 4).astype(np.float32))


@pytest.mark.parametrize("tangents", ["from the uvs", "from a turned uv set", "given"])
def test_bent_normals_are_those_of_the_slow_way(tangents):
    mesh = patches(60)
    local = np.array([0.3, -0.2, 0.9])
    local /= np.linalg.norm(local)
    others = {"uv_set": 1, "transform": (1.0, -2.0, 0.3, 0.5, 1.0, 0.0)} if "turned" in tangents else {}
    material = Material("bent", normal_texture=normal_map(*local, **others), normal_scale=0.7)
    if tangents == "given":
        mesh = with_tangents(mesh)
    centres = mesh.vertices[mesh.triangles].mean(axis=1).astype(float)
    _, surface = found(Geometry(scene([mesh], [material])), centres + [0.0, 0.0, 3.0], np.tile([[0, 0, -1]], (60, 1)))
    assert set(surface.front.tolist()) == {0.0, 1.0}
    expected = [reference(mesh, i, surface.position[:, i].numpy().astype(float), local, material) for i in range(60)]
    np.testing.assert_allclose(surface.normal.T.numpy(), expected, atol=2e-4)


def test_a_clear_coats_normals_are_those_of_its_own_map():
    """Maps with different scales and uv sets: each has the tangents of its own."""
    mesh, local = patches(60), np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    turned = {"uv_set": 1, "transform": (1.0, -2.0, 0.3, 0.5, 1.0, 0.0)}
    under = Material("under", normal_texture=normal_map(*local), normal_scale=0.7)
    over = Material("over", normal_texture=normal_map(*local, **turned), normal_scale=-0.5)
    coated = replace(under, clearcoat=1.0, clearcoat_normal_texture=over.normal_texture, clearcoat_normal_scale=-0.5)
    centres = mesh.vertices[mesh.triangles].mean(axis=1).astype(float)
    _, surface = found(Geometry(scene([mesh], [coated])), centres + [0.0, 0.0, 3.0], np.tile([[0, 0, -1]], (60, 1)))
    for normals, material in ((surface.normal, under), (surface.clearcoat_normal, over)):
        expected = [reference(mesh, i, surface.position[:, i].numpy().astype(float), local, material) for i in range(60)]
        np.testing.assert_allclose(normals.T.numpy(), expected, atol=2e-4)


def test_a_clear_coat_has_normals_of_its_own_only_where_some_coats_differ_from_what_is_beneath():
    texture = normal_map(0.6, 0.0, 0.8)
    bent, maps = {"normal_texture": texture}, {"clearcoat_normal_texture": texture}
    shared, plain = Material("shared", clearcoat=1.0, **bent, **maps), Material("plain", clearcoat=0.5)
    beneath, above = Material("beneath", clearcoat=1.0, **bent), Material("above", clearcoat=1.0, **maps)
    uncoated, scaled = Material("uncoated", **bent, **maps), replace(shared, clearcoat_normal_scale=0.0)
    tilt, none = [0.6, 0.0, 0.8], [0.0, 0.0, 1.0]
    for materials, expected in (
        ((shared, plain, uncoated), None),
        ((shared, uncoated, beneath), [tilt, none, none]),
        ((above, plain, beneath), [tilt, none, none]),
        ((plain, shared, scaled), [none, tilt, none]),
    ):
        plates = [rectangle(number, (5.0 * number, 0, 0)) for number in range(3)]
        rays = [[5.0 * number + 0.1, 0.2, 1] for number in range(3)], [[0, 0, -1]] * 3
        _, surface = found(Geometry(scene(plates, materials)), *rays)
        assert (surface.clearcoat_normal is None) == (expected is None)
        bases = [tilt if material.normal_texture else none for material in materials]
        np.testing.assert_allclose(surface.normal.T.numpy(), bases, atol=1e-3)
        if expected is not None:
            np.testing.assert_allclose(surface.clearcoat_normal.T.numpy(), expected, atol=1e-3)
            assert torch.equal(surface.select(torch.tensor([2])).clearcoat_normal, surface.clearcoat_normal[:, 2:])


def test_red_tilts_to_the_right_of_a_texture_and_green_to_its_top():
    for local, expected in (((0.6, 0.0, 0.8), (0.6, 0.0, 0.8)), ((0.0, 0.6, 0.8), (0.0, 0.6, 0.8))):
        geometry = Geometry(scene([rectangle(0)], [Material("bent", normal_texture=normal_map(*local))]))
        _, surface = found(geometry, [[0.1, 0.2, 1.0]], [[0, 0, -1]])
        np.testing.assert_allclose(surface.normal[:, 0].numpy(), expected, atol=1e-3)


def test_without_a_direction_of_u_the_normal_stays():
    flat_uvs = replace(rectangle(0), uvs=np.full((4, 1, 2), 0.5, np.float32))
    none, other_set = replace(rectangle(0, (5, 0, 0)), uvs=None), rectangle(1, (10, 0, 0))
    texture = normal_map(0.6, 0.0, 0.8)
    materials = [Material("bent", normal_texture=texture), Material("lost", normal_texture=replace(texture, uv_set=1))]
    geometry = Geometry(scene([flat_uvs, none, other_set], materials))
    _, surface = found(geometry, [[0.1, 0.2, 1], [5.1, 0.2, 1], [10.1, 0.2, 1]], [[0, 0, -1]] * 3)
    assert surface.normal.T.tolist() == [[0.0, 0.0, 1.0]] * 3


def test_a_bent_normal_that_faces_away_from_the_viewer_gives_way():
    geometry = Geometry(scene([rectangle(0)], [Material("bent", normal_texture=normal_map(0.8, 0.0, 0.6))]))
    _, surface = found(geometry, [[0.5, 0, 0.3], [-0.5, 0, 0.3]], [[-1, 0, -0.6], [1, 0, -0.6]])
    np.testing.assert_allclose(surface.normal.T.numpy(), [[0.8, 0.0, 0.6], [0.0, 0.0, 1.0]], atol=1e-3)


METAL = Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.4)
COAT = Material("coat", (0.0, 0.0, 0.0), specular=0.0, clearcoat=1.0, clearcoat_roughness=0.4)


@pytest.mark.parametrize("material", [matte(0.7), METAL, COAT], ids=["matte", "metal", "coat"])
def test_a_map_of_one_tilt_shines_like_a_tilted_rectangle(material):
    """Both seen at their common middle, under an emitter above both horizons."""
    degrees = 25.0
    angle = math.radians(degrees)
    light = rectangle(1, (1.0, 0.4, 2.0), (180.0, 0.0, 0.0), 0.3)
    ray = ((0.02, 0.01, 1.0), (-0.02, -0.01, -1.0))
    slot = "clearcoat_normal_texture" if material.clearcoat else "normal_texture"
    bent = replace(material, **{slot: normal_map(math.sin(angle), 0.0, math.cos(angle))})
    mapped = estimates(scene([rectangle(0), light], [bent, emitter(5.0)]), *ray, count=40_000)
    turned = rectangle(0, rotate=(0.0, degrees, 0.0))
    tilted = estimates(scene([turned, light], [material, emitter(5.0)]), *ray, count=40_000, seed=1)
    level = estimates(scene([rectangle(0), light], [material, emitter(5.0)]), *ray, count=40_000, seed=1)
    assert agreement(mapped, tilted) > SIGNIFICANCE
    assert agreement(mapped, level) < SIGNIFICANCE


@pytest.mark.parametrize("degrees", [0.0, 40.0, 75.0])
def test_bent_normals_create_no_light(degrees):
    """Of a Lambertian's cosine about the bent normal the part below the surface is lost: (1 + cos) / 2 stays."""
    angle = math.radians(degrees)
    texture = normal_map(math.sin(angle), 0.0, math.cos(angle))
    plate = scene([rectangle(0)], [replace(matte(0.8), normal_texture=texture)], sky(1.0), max_depth=4)
    samples = estimates(plate, (0.5, 0.0, 0.5), (-0.5, 0.0, -0.5), 40_000)
    assert mean_test(samples, 0.8 * (1.0 + math.cos(angle)) / 2.0, tolerance=1e-3) > SIGNIFICANCE
    shiny = Material("metal", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.3, normal_texture=texture)
    samples = estimates(scene([rectangle(0)], [shiny], sky(1.0), max_depth=4), (0.5, 0.0, 0.5), (-0.5, 0.0, -0.5), 20_000)
    assert samples.mean() < 1.001
