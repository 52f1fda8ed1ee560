"""`[[light]]` tables: power, colour, strings of lights, and errors in one line."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bokehguide.color import LUMINANCE, blackbody
from bokehguide.errors import BokehguideError
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.strings import String
from bokehguide.scene.types import Cone, Mesh, Scene
from tests.support.scene_text import BALL, CAMERA, load
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import estimates, mean_test

SHAPES = {
    "sphere": "radius = 0.03",
    "disc": 'shape = "disc"\nradius = 0.2\ndirection = [1.0, 2.0, -0.5]',
    "ellipse": 'shape = "ellipse"\nsize = [0.4, 0.1]\ndirection = [0.0, 0.0, 3.0]',
    "rectangle": 'shape = "rectangle"\nsize = [0.4, 0.1]\ndirection = [0.0, 0.0, 3.0]',
}


def scene_with(folder, light: str) -> Scene:
    return load(folder, f"{CAMERA}{BALL}[[light]]\n{light}\n")


def light_of(folder, light: str) -> tuple[Mesh, np.ndarray]:
    """The mesh of the only light of a scene, and its radiance."""
    scene = scene_with(folder, light)
    mesh = scene.meshes[-1]
    return mesh, np.array(scene.materials[mesh.material].emission)


def flux(mesh: Mesh, radiance: np.ndarray) -> float:
    """∫∫ L cos dω dA of the front, in luminance, by quadrature over the directions of each triangle."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    theta = (np.arange(2000) + 0.5) / 2000 * math.pi / 2.0
    projected = 2.0 * math.pi * (np.cos(theta) * np.sin(theta)).sum() * math.pi / 4000
    return float(areas.sum() * projected * (LUMINANCE @ radiance))


def intensity(mesh: Mesh, radiance: np.ndarray, direction: np.ndarray) -> float:
    """∫ L cos dA towards a distant point, in luminance."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    return float((0.5 * np.cross(b - a, c - a) @ direction).clip(min=0.0).sum() * (LUMINANCE @ radiance))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("color", ["", "kelvin = 2700.0", "color = [0.1, 0.2, 3.0]"])
def test_the_flux_is_that_of_the_watts(tmp_path, shape, color):
    mesh, radiance = light_of(tmp_path, f"{SHAPES[shape]}\nposition = [40.0, 2.0, -30.0]\nwatts = 5.0\n{color}")
    assert flux(mesh, radiance) == pytest.approx(5.0, rel=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_photometric_units(tmp_path, shape):
    """683 lm are 1 W; the intensity of a sphere is its flux over 4π, that of a plane along its normal is its flux over π."""
    text = f"{SHAPES[shape]}\nposition = [0.0, 2.0, -3.0]\nkelvin = 3000.0\n"
    mesh, by_lumens = light_of(tmp_path, f"{text}lumens = 800.0")
    assert flux(mesh, by_lumens) == pytest.approx(800.0 / 683.0, rel=1e-5)
    mesh, by_candela = light_of(tmp_path, f"{text}candela = 50.0")
    normal = {"sphere": (0.6, 0.0, 0.8), "disc": np.array((1.0, 2.0, -0.5)) / math.sqrt(5.25)}.get(shape, (0.0, 0.0, 1.0))
    assert intensity(mesh, by_candela, np.array(normal)) == pytest.approx(50.0 / 683.0, rel=2e-3)
    solid = 4.0 * math.pi if shape == "sphere" else math.pi
    np.testing.assert_allclose(by_lumens / by_candela, 800.0 / (50.0 * solid), rtol=1e-5)


def test_the_light_of_a_bulb_arrives(tmp_path):
    """The irradiance 2 m below a bulb of 8 W is 8 / (4π 2²), and a grey floor reflects half of it."""
    text = f"""{CAMERA}[materials.grey]
base_color = [0.5, 0.5, 0.5]
specular = 0.0
[[object]]
shape = "rectangle"
material = "grey"
rotate = [-90.0, 0.0, 0.0]
scale = 5.0
[[light]]
radius = 0.01
position = [0.0, 2.0, 0.0]
watts = 8.0
"""
    samples = estimates(load(tmp_path, text), (0.0, 0.5, 0.0), (0.0, -1.0, 0.0))
    expected = 0.5 / math.pi * 8.0 / (4.0 * math.pi * 4.0)
    assert mean_test(samples, expected, 2e-3) > SIGNIFICANCE


def test_a_radiance_as_a_number_and_as_three(tmp_path):
    place = "radius = 0.1\nposition = [0.0, 2.0, 0.0]\n"
    assert light_of(tmp_path, f"{place}radiance = [4.0, 2.0, 1.0]")[1].tolist() == [4.0, 2.0, 1.0]
    radiance = light_of(tmp_path, f"{place}radiance = 7.0\ncolor = [2.0, 1.0, 0.5]")[1]
    assert LUMINANCE @ radiance == pytest.approx(7.0)
    np.testing.assert_allclose(radiance / radiance[1], [2.0, 1.0, 0.5])


def test_names_and_shapes(tmp_path):
    scene = scene_with(tmp_path, 'name = "lamp"\nradius = 0.1\nposition = [0.0, 2.0, 0.0]\nwatts = 1.0')
    assert scene.meshes[-1].name == "lamp" and scene.materials[-1].name == "lamp"
    scene = scene_with(tmp_path, "radius = 0.1\npositions = [[0.0, 2.0, 0.0], [1.0, 2.0, 0.0], [2.0, 2.0, 0.0]]\nwatts = 1.0")
    assert scene.meshes[-1].name == "light[0]"
    emitters = find_emitters(scene)
    np.testing.assert_allclose(emitters.centres, [[0.0, 2.0, 0.0], [1.0, 2.0, 0.0], [2.0, 2.0, 0.0]], atol=1e-5)


def test_a_rectangle_has_its_size_and_faces_its_direction(tmp_path):
    mesh, _ = light_of(tmp_path, f"{SHAPES['rectangle']}\nup = [0.0, 5.0, 0.0]\nposition = [0.0, 0.0, 0.0]\nwatts = 1.0")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.4, 0.1, 0.0], atol=1e-6)
    a, b, c = mesh.vertices[mesh.triangles[0]]
    np.testing.assert_allclose(np.cross(b - a, c - a)[:2], 0.0, atol=1e-7)
    assert np.cross(b - a, c - a)[2] > 0.0


SUPPORTS = np.array([[0.0, 3.0, 0.0], [3.0, 2.0, 4.0], [3.0, 2.5, 10.0]])


@pytest.mark.parametrize("sag", [0.0, 1e-3, 0.1, 0.9, 20.0])
def test_points_along_a_string(sag):
    """A dense string: even steps, both ends of each span, the sag in the middle, and the shape of a hanging chain."""
    string = String(SUPPORTS, sag)
    spacing = float(string._ends[-1]) / 20_000
    points = string.points(spacing)
    assert len(points) == string.count(spacing) == 20_001
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(np.delete(steps, np.argsort(steps)[:2]), spacing, rtol=1e-3)  # two steps cross the support
    assert np.linalg.norm(points[-1] - SUPPORTS[-1]) < 1e-6
    assert np.linalg.norm(points - SUPPORTS[1], axis=1).min() <= spacing
    across = points[:, 2] / 4.0
    middle = points[np.argmin(np.abs(across - 0.5))]
    assert 2.5 - middle[1] == pytest.approx(sag, abs=2.0 * spacing)
    first = points[: np.argmin(np.linalg.norm(points - SUPPORTS[1], axis=1))]
    assert np.abs(np.cross(first - SUPPORTS[0], [3.0, 0.0, 4.0])[:, 1]).max() < 1e-9  # in the upright plane of the span


def test_a_hanging_string_is_a_catenary():
    """y = a cosh(x / a): y'' is √(1 + y'²) / a everywhere."""
    points = String(np.array([[0.0, 1.0, 0.0], [2.0, 1.4, 0.0]]), 0.5).points(1e-3)
    x, y = points[:, 0], points[:, 1]
    slope = np.gradient(y, x)
    curvature = np.gradient(slope, x)[5:-5] / np.sqrt(1.0 + slope[5:-5] ** 2)
    np.testing.assert_allclose(curvature, curvature.mean(), rtol=2e-3)


def test_an_ellipse_fills_the_rectangle_of_its_size(tmp_path):
    mesh, radiance = light_of(tmp_path, f"{SHAPES['ellipse']}\nup = [0.0, 5.0, 0.0]\nposition = [1.0, 0.0, 2.0]\nradiance = 3.0")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (0.4, 0.1, 0.0), atol=2e-3)
    assert flux(mesh, radiance) == pytest.approx(3.0 * math.pi * math.pi * 0.2 * 0.05, rel=3e-3)


def test_a_cone_makes_a_spotlight_of_the_same_intensity_on_its_axis(tmp_path):
    cone = "cone = { inner = 10.0, outer = 20.0, smooth = true }\ndirection = [0.0, -3.0, 4.0]"
    light = "radius = 0.03\nposition = [0.0, 2.0, -3.0]\nwatts = 5.0"
    scene = scene_with(tmp_path, f"{light}\n{cone}")
    material = scene.materials[scene.meshes[-1].material]
    assert material.emission_cone == Cone((0.0, -0.6, 0.8), 10.0, 20.0, smooth=True)
    np.testing.assert_array_equal(material.emission, light_of(tmp_path, light)[1])


def test_lights_on_a_string(tmp_path):
    text = "radius = 0.01\npath = [[0.0, 2.0, 0.0], [1.0, 2.0, 0.0]]\nsag = 0.25\nspacing = 0.1\nwatts = 0.5"
    scene = scene_with(tmp_path, text)
    centres = find_emitters(scene).centres
    expected = String(np.array([[0.0, 2.0, 0.0], [1.0, 2.0, 0.0]]), 0.25).points(0.1)
    np.testing.assert_allclose(centres, expected, atol=1e-4)
    assert len(centres) == 12  # 1.15 m of string


def test_many_lights_have_fewer_triangles_and_the_same_flux(tmp_path):
    text = "radius = 0.01\npath = [[0.0, 2.0, 0.0], [7.0, 2.0, 0.0]]\nspacing = 0.1\nwatts = 0.5"
    mesh, radiance = light_of(tmp_path, text)
    assert len(mesh.triangles) == 71 * 320
    assert flux(mesh, radiance) == pytest.approx(71 * 0.5, rel=1e-5)


def test_a_file_with_too_many_lights(tmp_path):
    table = "[[light]]\nradius = 0.01\npath = [[0.0, 2.0, 0.0], [7.0, 2.0, 0.0]]\nspacing = 1e-3\nwatts = 0.5\n"
    with pytest.raises(BokehguideError, match=r"light\[1\]\.spacing: 0\.001 makes 7,001 more lights; give fewer; a file has at"):
        load(tmp_path, f"{CAMERA}{BALL}{table}{table}")


def test_the_colour_of_a_black_body():
    """Known chromaticities (CIE 15: illuminant A at 2856 K, and black bodies), and luminance 1 at any temperature."""
    for kelvin, x, y in ((2856.0, 0.4476, 0.4074), (4000.0, 0.3805, 0.3768), (6500.0, 0.3135, 0.3237), (10000.0, 0.2807, 0.2884)):
        rgb = blackbody(kelvin)
        xyz = np.linalg.inv([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]) @ rgb
        np.testing.assert_allclose(xyz[:2] / xyz.sum(), (x, y), atol=6e-4)
    for kelvin in (1000.0, 1850.0, 2700.0, 15000.0):
        assert LUMINANCE @ blackbody(kelvin) == pytest.approx(1.0) and (blackbody(kelvin) >= 0.0).all()
    red, green, blue = blackbody(2000.0)
    assert red > green > blue


@pytest.mark.parametrize(
    ("light", "named"),
    [
        ("radius = 0.1\nwatts = 1", "light[0].position: missing; give [x, y, z], or positions, or a path with a spacing"),
        ("position = [0, 1, 0]\nwatts = 1", "light[0].radius: missing; give metres"),
        ("radius = 0.1\nposition = [0, 1, 0]", "light[0].watts: missing; give one of radiance, watts, lumens, candela"),
        ("radius = 0.1\nposition = [0, 1, 0]\nwatts = -1", "light[0].watts: -1 is out of range"),
        (
            "radius = 0.1\nposition = [0, 1, 0]\nwatts = 1\nlumens = 5",
            "light[0].watts: 1 and lumens = 5 are both given; keep one",
        ),
        ("radius = 0.1\nposition = [0, 1, 0]\nwatts = 1\nkelvin = 500", "light[0].kelvin: 500 is out of range; give kelvin from"),
        ("radius = 0.1\nposition = [0, 1, 0]\nwatts = 1\nkelvin = 2700\ncolor = [1, 1, 1]", "keep one"),
        ("radius = 0.1\nposition = [0, 1, 0]\nwatts = 1\ncolor = [0, 0, 0]", "light[0].color: [0, 0, 0] is black"),
        ("radius = 0.1\nposition = [0, 1, 0]\nradiance = [1, 1, 1]\nkelvin = 2700", "light[0].kelvin: 2700 has no effect beside"),
        ("radius = 1e-6\nposition = [0, 1, 0]\nwatts = 1e9", "light[0].watts: 1000000000.0 makes a radiance of"),
        ("radius = 1e-6\nposition = [9e3, 9e3, 9e3]\nwatts = 1", "is too far from the origin"),
        ('shape = "cube"\nposition = [0, 1, 0]\nwatts = 1', "light[0].shape: 'cube' is not the shape of a light"),
        (
            'shape = "disc"\nradius = 0.1\ncone = {}\nposition = [0, 1, 0]\nwatts = 1',
            "light[0].cone: {} has no effect on a disc; it is for a light of shape sphere; leave it out",
        ),
        (
            "radius = 0.1\ncone = { inner = 50 }\nposition = [0, 1, 0]\nwatts = 1",
            "light[0].cone.outer: 45 is not above inner, 50; give a larger angle",
        ),
        (
            "radius = 0.1\ndirection = [1, 0, 0]\nposition = [0, 1, 0]\nwatts = 1",
            "light[0].direction: [1, 0, 0] has no effect on a sphere",
        ),
        ("radius = 0.1\nsize = [1, 1]\nposition = [0, 1, 0]\nwatts = 1", "light[0].size: [1, 1] has no effect on a sphere"),
        (
            'shape = "rectangle"\nsize = [1, 0]\nposition = [0, 1, 0]\nwatts = 1',
            "light[0].size: [1, 0] is not a width and a height",
        ),
        ('shape = "rectangle"\nposition = [0, 1, 0]\nwatts = 1', "light[0].size: missing; give [width, height] in metres"),
        (
            'shape = "rectangle"\nsize = [1, 1]\ndirection = [0, 1, 0]\nup = [0, 2, 0]\nposition = [0, 1, 0]\nwatts = 1',
            "light[0].up: [0, 2, 0] is parallel to the direction",
        ),
        ("radius = 0.1\npositions = []\nwatts = 1", "light[0].positions: [] is no list of points; give 1 or more"),
        ("radius = 0.1\npositions = [[0, 1, 0], [1, 2]]\nwatts = 1", "light[0].positions[1]: [1, 2] is not three numbers"),
        ("radius = 0.1\npath = [[0, 1, 0]]\nspacing = 1\nwatts = 1", "light[0].path: [[0, 1, 0]] is no list of points; give 2"),
        ("radius = 0.1\npath = [[0, 1, 0], [1, 1, 0]]\nwatts = 1", "light[0].spacing: missing"),
        ("radius = 0.1\npath = [[0, 1, 0], [0, 1, 0]]\nspacing = 1\nwatts = 1", "two neighbouring supports are one point"),
        ("radius = 0.1\npath = [[0, 1, 0], [0, 2, 0]]\nspacing = 1\nsag = 1\nwatts = 1", "a span stands upright"),
        ("radius = 0.1\nposition = [0, 1, 0]\nspacing = 1\nwatts = 1", "light[0].spacing: 1 has no path beside it"),
        (
            "radius = 0.1\npath = [[0, 1, 0], [1, 1, 0]]\nspacing = 1e-9\nwatts = 1",
            "light[0].spacing: 1e-09 makes 1,000,000,002 more lights; give fewer",
        ),
        ("radius = 0.1\nposition = [0, 1, 0]\nwats = 1", "light[0].wats: unknown key; did you mean 'watts'?"),
    ],
)
def test_a_wrong_light_is_named(tmp_path, light, named):
    with pytest.raises(BokehguideError) as caught:
        scene_with(tmp_path, light)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path}/scene.toml: light[0]") and named in message
    assert len(message.splitlines()) == 1


def test_a_single_light_table_needs_double_brackets(tmp_path):
    with pytest.raises(BokehguideError, match=r"light: .* is not a list of tables; write \[\[light\]\]"):
        load(tmp_path, f"[light]\nradius = 1.0\n{CAMERA}{BALL}")
