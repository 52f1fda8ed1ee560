"""What rays find where they hit: sides, normals, textures, emission, and how new rays leave."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render.geometry import Geometry
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import dot
from bokehguide.scene.types import Cone, Material, Texture
from tests.support.tracing import UP, found, matte, rectangle, scene, sphere


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
    _, surface = found(geometry, np.c_[points, np.ones(200)], np.tile([[0, 0, -1]], (200, 1)))
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
    assert surface.facing.tolist() == [1.0, 0.0]


@pytest.mark.parametrize("slot", ["normal_texture", "clearcoat_normal_texture"])
def test_so_does_one_that_a_map_bends_away(slot):
    """Before the vertices' normal does; and that one before the geometry."""
    bent = Texture(np.array([[[0.5 + 0.5 * math.sin(1.2), 0.5, 0.5 + 0.5 * math.cos(1.2)]]], np.float32))
    vertices = np.tile(np.array([[-math.sin(0.9), 0.0, math.cos(0.9)]], np.float32), (4, 1))
    material = matte(clearcoat=1.0, **{slot: bent})
    geometry = Geometry(scene([replace(rectangle(0), normals=vertices)], [material]))
    angles = np.radians([-80.0, -30.0, 30.0, 80.0])  # of the rays; the normals lie at -52 and about +17 degrees
    ways = np.stack((-np.sin(angles), 0.0 * angles, -np.cos(angles)), axis=1)
    hit, surface = found(geometry, -ways, ways)
    assert surface.facing.tolist() == [0.0, 1.0, 1.0, 0.0]
    names = ["normal_texture", "clearcoat_normal_texture", "vertices"]
    slopes = {name: normals[0] / normals[2] for name, normals in zip(names, geometry.own_normals(surface, hit), strict=True)}
    bent, interpolated = slopes[slot], slopes["vertices"]
    torch.testing.assert_close(interpolated, torch.full((4,), -math.tan(0.9)))
    torch.testing.assert_close(bent[1:3], torch.full((2,), math.tan(1.2 - 0.9)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(bent[0], torch.tensor(-math.tan(0.9)))


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
    """Hit halfway between two rows that are alike, as processors differ in the last bit of where a ray hits."""
    texture = np.repeat(np.array([[[1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]]], np.float32), 2, axis=0)
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


def test_a_clear_coat_dims_what_shines_through_it():
    """By one minus Schlick's reflectance under the viewer's angle, with the coat's weight and texture."""
    halves = Texture(np.array([[[1.0, 0.0, 0.0], [0.5, 0.0, 0.0]]], np.float32))
    coated = Material("neon", emission=(2.0, 4.0, 8.0), clearcoat=0.8, clearcoat_texture=halves, double_sided=True)
    geometry = Geometry(scene([rectangle(0), rectangle(1, (5, 0, 0))], [coated, replace(coated, clearcoat=0.0)]))
    targets = np.array([[-0.5, 0, 0], [-0.5, 0, 0], [0.5, 0, 0], [-0.5, 0, 0], [4.5, 0, 0]])
    directions = np.array([[0, 0, -1], [0.96, 0, -0.28], [0.96, 0, -0.28], [0, 0.96, 0.28], [0.96, 0, -0.28]])
    hit, surface = found(geometry, targets - directions, directions)
    weights, cosines = np.array([0.8, 0.8, 0.4, 0.8, 0.0]), np.abs(directions[:, 2])
    passing = 1.0 - weights * (0.04 + 0.96 * (1.0 - cosines) ** 5)
    emission = geometry.emission(hit, surface.front, surface.outgoing).T.numpy()
    np.testing.assert_allclose(emission, passing[:, None] * (2.0, 4.0, 8.0), rtol=1e-4)


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


def parts(metallic: float, transmission: float) -> dict[str, float]:
    """Share of glass in a surface, and share of metal in the rest."""
    glass = transmission * (1.0 - metallic)
    return {"transmission": glass, "metallic": metallic / (1.0 - glass)}


def test_every_slot_multiplies_its_factor_by_its_channels():
    """Beside each other: a material with all textures, and one with none."""
    generator = np.random.default_rng(5)
    slots = ("base_color", "metallic_roughness", "specular", "specular_color", "transmission", "clearcoat", "clearcoat_roughness")
    texels = {slot: generator.uniform(0.2, 1.0, 4).astype(np.float16).astype(np.float32) for slot in slots}
    textures = {f"{slot}_texture": Texture(texels[slot][None, None]) for slot in slots}
    factors = {
        "specular": 0.8,
        "specular_color": (0.9, 0.5, 1.0),
        "transmission": 0.6,
        "clearcoat": 0.7,
        "clearcoat_roughness": 0.9,
    }
    painted = Material("painted", (0.5, 0.8, 1.0), 0.6, 0.9, **factors, **textures)
    plain = Material("plain", (0.5, 0.8, 1.0), 0.6, 0.9, **factors)
    geometry = Geometry(scene([rectangle(0), rectangle(1, (5, 0, 0))], [painted, plain]))
    _, surface = found(geometry, [[0.2, 0.1, 1], [5, 0, 1]], [[0, 0, -1]] * 2)
    expected = {
        "base_color": np.array([0.5, 0.8, 1.0]) * texels["base_color"][:3],
        "alpha": (0.9 * texels["metallic_roughness"][1]) ** 2,
        "specular": 0.8 * texels["specular"][3],
        "specular_color": np.array([0.9, 0.5, 1.0]) * texels["specular_color"][:3],
        **parts(0.6 * texels["metallic_roughness"][2], 0.6 * texels["transmission"][0]),
        "clearcoat": 0.7 * texels["clearcoat"][0],
        "clearcoat_alpha": (0.9 * texels["clearcoat_roughness"][1]) ** 2,
    }
    untouched = {**factors, **parts(0.6, 0.6), "base_color": (0.5, 0.8, 1.0), "alpha": 0.81, "clearcoat_alpha": 0.81}
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(surface, name)[..., 0].numpy(), value, rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(getattr(surface, name)[..., 1].numpy(), untouched[name], rtol=1e-5, err_msg=name)


def test_textures_of_what_a_material_has_not_are_left_out():
    texture = Texture(np.full((1, 1, 3), 0.5, np.float32))
    slots = ("emission", "transmission", "clearcoat", "clearcoat_roughness", "clearcoat_normal")
    textures = {f"{slot}_texture": texture for slot in slots}
    geometry = Geometry(scene([rectangle(0)], [Material("none of it", **textures)]))
    assert geometry.materials.atlas.texels.shape == (0,)
    _, surface = found(geometry, [[0.2, 0.1, 1]], [[0, 0, -1]])
    assert surface.clearcoat is None and surface.clearcoat_normal is None and surface.transmission.tolist() == [0.0]


def test_each_texture_reads_its_own_uv_set():
    """Set 0 runs as the rectangle's, set 2 the other way; the third rectangle lacks it."""
    texture = np.array([[[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]], np.float32)
    uvs = rectangle(0).uvs
    sets = np.concatenate((uvs, np.zeros_like(uvs), 1.0 - uvs), axis=1)
    one = Material("one", (1.0,) * 3, base_color_texture=Texture(texture))
    other = Texture(texture, 2, ("clamp", "clamp"))
    two = Material("two", (1.0,) * 3, base_color_texture=other, metallic=1.0, metallic_roughness_texture=Texture(texture))
    meshes = [replace(rectangle(material, (x, 0, 0)), uvs=sets) for material, x in ((0, 0), (1, 5))] + [rectangle(1, (10, 0, 0))]
    _, surface = found(Geometry(scene(meshes, [one, two])), [[-0.5, 0, 1], [4.5, 0, 1], [9.5, 0, 1]], [[0, 0, -1]] * 3)
    assert surface.base_color[0].tolist() == [1.0, 0.0, 1.0]
    assert surface.metallic.tolist() == [0.0, 1.0, 1.0]


def test_vertex_colours_multiply_base_colour_and_opacity():
    colors = np.random.default_rng(6).uniform(0.1, 1.0, (4, 4)).astype(np.float32)
    material = Material("painted", (0.5, 0.8, 1.0), opacity=0.5, alpha_mode="blend")
    geometry = Geometry(scene([rectangle(0, (5, 0, 0)), replace(rectangle(0), colors=colors)], [material]))
    hit, surface = found(geometry, [[0.5, -0.2, 1], [5, 0, 1]], [[0, 0, -1]] * 2)
    a, b = 0.75, 0.4  # the corners are (-1, -1), (1, -1), (1, 1), (-1, 1); x > y is the triangle 0 1 2
    color = np.array([1 - a, a - b, b, 0.0]) @ colors
    np.testing.assert_allclose(surface.base_color.T.numpy(), [color[:3] * (0.5, 0.8, 1.0), (0.5, 0.8, 1.0)], rtol=1e-5)
    np.testing.assert_allclose(geometry.opacity(hit).numpy(), [0.5 * color[3], 0.5], rtol=1e-5)


def test_vertex_colours_multiply_the_emission_where_the_material_says_so():
    colors = np.array([[1.0, 0.5, 0.25, 0.1]] * 4, np.float32)
    plain = Material("emitter", emission=(2.0, 2.0, 2.0))
    meshes = [replace(rectangle(number, (5 * number, 0, 0)), colors=colors) for number in range(2)]
    geometry = Geometry(scene(meshes, [plain, replace(plain, tint_emission=True)]))
    hit, surface = found(geometry, [[0.5, 0, 1], [5.5, 0, 1]], [[0, 0, -1]] * 2)
    emission = geometry.emission(hit, surface.front, surface.outgoing).T.numpy()
    np.testing.assert_allclose(emission, [[2, 2, 2], [2, 1, 0.5]], rtol=1e-6)


@pytest.mark.parametrize("mode", ["opaque", "mask", "blend"])
def test_opacity_is_factor_times_alpha_and_means_what_the_mode_says(mode):
    alpha = np.array([0.0, 0.4, 0.7, 1.0])
    image = np.concatenate((np.ones((1, 4, 3)), alpha[None, :, None]), axis=2).astype(np.float32)
    material = Material("leaf", base_color_texture=Texture(image), opacity=0.8, alpha_mode=mode, alpha_cutoff=0.5)
    geometry = Geometry(scene([rectangle(0)], [material]))
    hit, _ = found(geometry, [[x, 0, 1] for x in (-0.75, -0.25, 0.25, 0.75)], [[0, 0, -1]] * 4)
    expected = {"opaque": [1, 1, 1, 1], "mask": [0, 0, 1, 1], "blend": 0.8 * alpha}[mode]
    np.testing.assert_allclose(geometry.opacity(hit).numpy(), expected, atol=1e-3)
    assert geometry.is_translucent(hit.triangle).tolist() == [mode != "opaque"] * 4


def test_materials_without_a_hole_are_opaque():
    """Full alpha everywhere, or none below the cutoff, costs nothing."""
    full, half = np.ones((2, 2, 4), np.float32), np.full((2, 2, 4), 0.6, np.float32)
    solid = [
        Material("full", base_color_texture=Texture(full), alpha_mode="blend"),
        Material("above", base_color_texture=Texture(half), alpha_mode="mask"),
        Material("no alpha", base_color_texture=Texture(half[..., :3].copy()), alpha_mode="blend"),
    ]
    translucent = [
        replace(solid[0], opacity=0.9),
        replace(solid[1], alpha_cutoff=0.7),
        replace(solid[0], base_color_texture=Texture(half)),
        Material("vertices", alpha_mode="blend"),
    ]
    clear = np.array([[1, 1, 1, 1]] * 3 + [[1, 1, 1, 0.5]], np.float32)
    meshes = [rectangle(i) for i in range(6)] + [replace(rectangle(6), colors=clear)]
    geometry = Geometry(scene(meshes, solid + translucent))
    assert geometry.materials.translucent.tolist() == [False] * 3 + [True] * 4


def punctual_falloff(degrees: float, inner: float, outer: float) -> float:
    """KHR_lights_punctual's reference code, before the square."""
    scale = 1.0 / max(0.001, math.cos(math.radians(inner)) - math.cos(math.radians(outer)))
    offset = -math.cos(math.radians(outer)) * scale
    return min(1.0, max(0.0, math.cos(math.radians(degrees)) * scale + offset))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_cone_shapes_the_emission_by_its_direction(smooth):
    axis = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    spot = Material("spot", emission=(2.0, 4.0, 8.0), emission_cone=Cone(tuple(axis), 20.0, 35.0, smooth))
    geometry = Geometry(scene([rectangle(0), rectangle(1, (5, 0, 0))], [spot, Material("bulb", emission=(1.0, 1.0, 1.0))]))
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.array([0.0, 15.0, 22.0, 30.0, 34.0, 36.0, 30.0])
    directions = np.cos(np.radians(angles))[:, None] * axis + np.sin(np.radians(angles))[:, None] * side
    targets = np.array([[0.1, 0.2, 0.0]] * 6 + [[5.1, 0.2, 0.0]])
    hit, surface = found(geometry, targets + 2.0 * directions, -directions)
    shares = [punctual_falloff(angle, 20.0, 35.0) for angle in angles[:6]]
    shares = [3.0 * t**2 - 2.0 * t**3 if smooth else t**2 for t in shares]
    expected = [np.array([2.0, 4.0, 8.0]) * share for share in shares] + [np.ones(3)]
    np.testing.assert_allclose(geometry.emission(hit, surface.front, surface.outgoing).T.numpy(), expected, rtol=1e-3, atol=1e-4)
    along = geometry.emission(hit, surface.front, None)
    np.testing.assert_allclose(along[0].numpy(), [2.0] * 6 + [1.0])
