"""Lights of pbrt-v4: irradiance against closed forms, colours of spectra, and octahedral environment maps."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from bokehguide.color import LUMINANCE, blackbody
from bokehguide.errors import BokehguideError
from bokehguide.image.exr import write_exr
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.scene import load_scene
from bokehguide.scene.pbrt.octahedral import bilinear, equirectangular, sphere_from_square, square_from_sphere
from bokehguide.scene.types import Scene
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import estimates, mean_test

HEAD = 'Scale -1 1 1\nLookAt 0 1 0 0 0 0 0 0 1\nCamera "perspective"\nIntegrator "path" "integer maxdepth" 1\nWorldBegin\n'
"""A right-handed world, in which the scene has the coordinates of the file."""
FLOOR = (
    'AttributeBegin Material "diffuse" "rgb reflectance" [0.5 0.5 0.5]\n'
    'Shape "trianglemesh" "point3 P" [-20 0 -20 -20 0 20 20 0 20 20 0 -20] "integer indices" [0 1 2 0 2 3] AttributeEnd\n'
)


def read(folder, body: str) -> Scene:
    (folder / "scene.pbrt").write_text(HEAD + FLOOR + body)
    return load_scene(str(folder / "scene.pbrt"))


def square(side: float, height: float) -> str:
    """A square emitter above the floor that faces down."""
    a = side / 2.0
    corners = f"{-a} {height} {-a} {a} {height} {-a} {a} {height} {a} {-a} {height} {a}"
    return f'Shape "trianglemesh" "point3 P" [{corners}] "integer indices" [0 1 2 0 2 3]\n'


def under_a_square(side: float, height: float) -> float:
    """The irradiance below the middle of a square of radiance 1, by Lambert's formula."""
    x = 0.5 * side / height
    return 4.0 * x / math.sqrt(1.0 + x * x) * math.atan(x / math.sqrt(1.0 + x * x))


RED = np.array((2.0, 1.0, 0.5))
LIGHTS = {
    "distant": ('LightSource "distant" "rgb L" [2 1 0.5] "point3 from" [0 3 5] "float scale" 2', 2.0 * RED * 0.6),
    "illuminance": ('LightSource "distant" "rgb L" [1 1 1] "point3 from" [0 3 5] "float illuminance" 5', np.full(3, 3.0)),
    "turned": ('Rotate 90 1 0 0 LightSource "distant" "rgb L" [2 1 0.5] "point3 to" [0 0 1]', RED),
    "infinite": ('LightSource "infinite" "rgb L" [2 1 0.5] "float scale" 0.5', 0.5 * RED * math.pi),
    "sum": ('LightSource "infinite" "rgb L" [1 1 1] LightSource "infinite" "rgb L" [1 0 0]', math.pi * np.array((2.0, 1.0, 1.0))),
    "sky": ('LightSource "infinite" "float illuminance" 3', np.full(3, 3.0)),
    "point": ('Translate 0 1 0 LightSource "point" "rgb I" [2 1 0.5] "point3 from" [0 1 0]', RED / 4.0),
    "power": ('LightSource "point" "float power" 50 "point3 from" [0 2 0]', np.full(3, 50.0 / (16.0 * math.pi))),
    "spot": ('LightSource "spot" "rgb I" [2 1 0.5] "point3 from" [0 2 0] "point3 to" [0 0 0]', RED / 4.0),
    "area": (
        f'AreaLightSource "diffuse" "rgb L" [2 1 0.5] "float scale" 3\n{square(1.0, 2.0)}',
        3.0 * RED * under_a_square(1.0, 2.0),
    ),
    "blackbody": (
        f'AreaLightSource "diffuse" "blackbody L" 3000 "float scale" 3\n{square(1.0, 2.0)}',
        3.0 * blackbody(3000.0) * under_a_square(1.0, 2.0),
    ),
    "two triangles of power": (
        f'AreaLightSource "diffuse" "float power" 6\n{square(1.0, 2.0)}',
        np.full(3, 6.0 / (math.pi * 0.5) * under_a_square(1.0, 2.0)),
    ),
    "wrong side": (f'AreaLightSource "diffuse" "rgb L" [2 1 0.5]\nReverseOrientation\n{square(1.0, 2.0)}', np.zeros(3)),
    "two sides": (
        f'AreaLightSource "diffuse" "rgb L" [2 1 0.5] "bool twosided" true\nReverseOrientation\n{square(1.0, 2.0)}',
        RED * under_a_square(1.0, 2.0),
    ),
}


@pytest.mark.parametrize("kind", LIGHTS)
def test_the_irradiance_of_each_light(tmp_path, kind):
    """The radiance of a grey floor of reflectance 0.5 below the light is E / 2π."""
    body, irradiance = LIGHTS[kind]
    scene = read(tmp_path, body)
    samples = estimates(scene, (0.0, 0.5, 0.0), (0.0, -1.0, 0.0), 20_000)
    expected = 0.5 / math.pi * irradiance
    assert mean_test(samples, expected, 2e-3) > SIGNIFICANCE, (samples.mean(axis=1), expected)


NEGATIVE = {
    "distant": 'LightSource "distant" "float scale" -2',
    "infinite": 'LightSource "infinite" "float scale" -2',
    "map": 'LightSource "infinite" "string filename" "sky.png" "float scale" -2',
    "point": 'LightSource "point" "float scale" -2',
    "diffuse": f'AreaLightSource "diffuse" "float scale" -2 {square(1.0, 2.0)}',
}


@pytest.mark.parametrize("kind", NEGATIVE)
def test_a_negative_scale_is_told(tmp_path, kind):
    Image.new("RGB", (4, 4), (200, 100, 50)).save(tmp_path / "sky.png")
    scene = read(tmp_path, NEGATIVE[kind])
    name = "infinite" if kind == "map" else kind
    assert f"scene.pbrt: negative scales of lights: 0 in their place ({name}, scene.pbrt:8)" in scene.warnings
    assert not scene.suns and (scene.environment is None or not scene.environment.radiance.any())
    assert not any(material.emits for material in scene.materials)
    assert not any("negative" in line for line in read(tmp_path, NEGATIVE[kind].replace("-2", "2")).warnings)


def test_the_power_of_a_goniometric_light_includes_its_image(tmp_path):
    """pbrt-v4 divides the power by 4π times the mean of the image."""
    Image.new("L", (4, 4), 89).save(tmp_path / "dim.png")
    light = 'LightSource "goniometric" {} "string filename" "dim.png"'

    def intensity(given: str) -> np.ndarray:
        scene = read(tmp_path, light.format(given))
        mesh = scene.meshes[-1]
        radius = 0.5 * float(np.ptp(mesh.vertices[:, 0]))
        return np.array(scene.materials[mesh.material].emission) * math.pi * radius**2

    np.testing.assert_allclose(intensity('"float power" 100'), 100.0 / (4.0 * math.pi), rtol=0.02)
    np.testing.assert_allclose(intensity('"rgb I" [2 1 0.5]'), RED * ((89.0 / 255.0 + 0.055) / 1.055) ** 2.4, rtol=0.02)


def test_the_cone_of_a_spot_is_that_of_pbrt(tmp_path):
    """A smoothstep in the cosine between coneangle - conedeltaangle and coneangle."""
    cone = '"float coneangle" 40 "float conedeltaangle" 30'
    scene = read(tmp_path, f'LightSource "spot" "rgb I" [4 4 4] "point3 from" [0 2 0] "point3 to" [0 0 0] {cone}')
    inside, outside = math.cos(math.radians(10.0)), math.cos(math.radians(40.0))
    for degrees in (5.0, 25.0, 45.0):
        cosine = math.cos(math.radians(degrees))
        t = min(max((cosine - outside) / (inside - outside), 0.0), 1.0)
        expected = 0.5 / math.pi * 4.0 * t * t * (3.0 - 2.0 * t) * cosine**3 / 4.0
        samples = estimates(scene, (2.0 * math.tan(math.radians(degrees)), 0.5, 0.0), (0.0, -1.0, 0.0), 4000)
        assert mean_test(samples, expected, 5e-3) > SIGNIFICANCE


def test_the_cone_of_a_spot_before_pbrt_v4_is_quartic(tmp_path):
    """pbrt-v3's lights/spot.cpp: t⁴ of t in the cosine. The cone has its flux, and its intensity within 5 % of the greatest."""
    cone = '"float coneangle" 40 "float conedeltaangle" 30'
    scene = older(tmp_path, f'LightSource "spot" "rgb I" [1 1 1] "point from" [0 2 0] "point to" [0 0 0] {cone}')
    material = scene.materials[scene.meshes[-1].material]
    inside, outside = math.cos(math.radians(10.0)), math.cos(math.radians(40.0))
    cosines = np.linspace(0.0, 1.0, 100001)
    wanted = ((cosines - outside) / (inside - outside)).clip(0.0, 1.0) ** 4
    inner, outer = (math.cos(math.radians(getattr(material.emission_cone, key))) for key in ("inner", "outer"))
    t = ((cosines - outer) / (inner - outer)).clip(0.0, 1.0)
    found = t * t * (3.0 - 2.0 * t) if material.emission_cone.smooth else t * t
    assert found.mean() == pytest.approx(wanted.mean(), rel=1e-3)
    assert np.abs(found - wanted).max() < 0.05


@pytest.mark.parametrize(("size", "kind"), [((8, 4), ""), ((4, 8), ""), ((8, 4), "power")])
def test_projections_are_spots_of_the_same_flux(tmp_path, size, kind):
    """The flux of the image by integration over its window: dω = cos³θ dA, as in pbrt-v4's ProjectionLight."""
    texels = np.random.default_rng(1).integers(20, 255, (size[1], size[0], 3)).astype(np.uint8)
    Image.fromarray(texels).save(tmp_path / "slide.png")
    power = '"float power" 100' if kind else ""
    light = f'LightSource "projection" "string filename" "slide.png" "float fov" 50 "float scale" 2 {power}'
    scene = read(tmp_path, f"Translate 0 1 0 {light}")
    radius = 0.5 * float(np.ptp(scene.meshes[-1].vertices[:, 0]))
    material = scene.materials[scene.meshes[-1].material]
    cone = material.emission_cone
    found = np.array(material.emission) * math.pi * radius**2 * 2.0 * math.pi * (1.0 - math.cos(math.radians(cone.outer)))
    linear = ((texels / 255.0 + 0.055) / 1.055) ** 2.4
    tangent, steps = math.tan(math.radians(25.0)), 100
    x, y = (tangent * (side / min(size)) * ((np.arange(side * steps) + 0.5) / (side * steps) * 2.0 - 1.0) for side in size)
    area = (x[1] - x[0]) * (y[1] - y[0])
    solid = area * (1.0 + x**2 + y[:, None] ** 2) ** -1.5
    flux = (linear.repeat(steps, 0).repeat(steps, 1) * solid[..., None]).sum(axis=(0, 1))
    wanted = 2.0 * flux if not kind else 200.0 * flux / (flux @ LUMINANCE)
    np.testing.assert_allclose(found, wanted, rtol=0.04)
    np.testing.assert_allclose(cone.axis, (0.0, 0.0, 1.0), atol=1e-6)
    assert any("images of projection lights: a round spot of their mean colour (slide.png)" in line for line in scene.warnings)


def test_images_of_lights_before_pbrt_v4_are_linear(tmp_path):
    """pbrt-v3 decodes sRGB in textures alone, and its goniometric maps are equirectangular."""
    texels = np.zeros((8, 16), np.uint8)
    texels[:4] = 128
    texels[0] = 255
    Image.fromarray(texels).save(tmp_path / "map.png")
    rows = np.cos(math.pi * np.arange(9) / 8.0)
    wanted = float((texels[:, 0] / 255.0 * -np.diff(rows)).sum() / 2.0)
    scene = older(tmp_path, 'LightSource "goniometric" "rgb I" [1 2 3] "string mapname" "map.png" "point from" [0 3 0]')
    radius = 0.5 * float(np.ptp(scene.meshes[-1].vertices, axis=0).max())
    emitted = np.array(scene.materials[scene.meshes[-1].material].emission) * math.pi * radius**2
    np.testing.assert_allclose(emitted, wanted * np.array((1.0, 2.0, 3.0)), rtol=0.02)
    sky = older(tmp_path, 'LightSource "infinite" "string mapname" "map.png"').environment
    assert sky is not None and np.median(sky.radiance[sky.radiance > 0.0]) == pytest.approx(128.0 / 255.0, rel=0.01)


def emission(folder, text: str) -> np.ndarray:
    scene = read(folder, f'AreaLightSource "diffuse" {text}\n{square(1.0, 2.0)}')
    return np.array(scene.materials[scene.meshes[-1].material].emission)


def test_colours_of_emitters(tmp_path):
    """Luminance 1 for spectra, and the RGB itself for colours of the colour space."""
    np.testing.assert_allclose(emission(tmp_path, '"spectrum L" "stdillum-D65"'), 1.0)
    warm = emission(tmp_path, '"spectrum L" "stdillum-A"')
    assert pytest.approx(1.0, abs=1e-3) == LUMINANCE @ warm
    np.testing.assert_allclose(warm, blackbody(2856.0), atol=0.02)
    kelvin = np.arange(360.0, 831.0, 10.0)
    planck = (kelvin / 560.0) ** -5 / (np.exp(1.4388e7 / (kelvin * 2856.0)) - 1.0)
    pairs = " ".join(f"{a:g} {b:g}" for a, b in zip(kelvin, planck * 1e3))
    np.testing.assert_allclose(emission(tmp_path, f'"spectrum L" [{pairs}]'), warm, atol=0.02)
    (tmp_path / "lamp.spd").write_text("# nm power\n" + pairs.replace(" ", "\n"))
    np.testing.assert_allclose(emission(tmp_path, '"spectrum L" "lamp.spd"'), warm, atol=0.02)
    np.testing.assert_allclose(emission(tmp_path, '"rgb L" [3 2 1] "float scale" 2'), (6.0, 4.0, 2.0))


def test_colour_spaces(tmp_path):
    """White stays white; the red of Rec. 2020 lies outside of Rec. 709: 1.6605 there (ITU-R BT.2087)."""
    wide = 'AttributeBegin ColorSpace "rec2020" AreaLightSource "diffuse" "rgb L" [{}]\n' + square(1.0, 2.0) + "AttributeEnd"
    scene = read(tmp_path, wide.format("1 0 0"))
    assert scene.materials[scene.meshes[-1].material].emission == pytest.approx((1.6605, 0.0, 0.0), abs=2e-3)
    scene = read(tmp_path, wide.format("1 1 1").replace("rec2020", "aces2065-1"))
    assert scene.materials[scene.meshes[-1].material].emission == pytest.approx((1.0, 1.0, 1.0), abs=1e-6)


def test_the_octahedral_map():
    """Known points, the inverse, and equal areas."""
    points = np.array([(0.5, 0.5), (0.0, 0.0), (1.0, 1.0), (1.0, 0.5), (0.5, 1.0), (0.0, 0.5), (0.75, 0.5)])
    wanted = [(0, 0, 1), (0, 0, -1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (math.sqrt(1.0 - 0.75**2), 0, 0.75)]
    np.testing.assert_allclose(sphere_from_square(points), wanted, atol=1e-7)
    inside = np.random.default_rng(0).random((10_000, 2)) * 0.98 + 0.01
    np.testing.assert_allclose(square_from_sphere(sphere_from_square(inside)), inside, atol=1e-6)
    step = 1e-5
    u, v = (sphere_from_square(inside + offset) - sphere_from_square(inside) for offset in ((step, 0), (0, step)))
    areas = np.linalg.norm(np.cross(u, v), axis=1) / step**2
    kept = np.abs(areas / (4.0 * math.pi) - 1.0) < 1e-3  # the map bends along the diagonals and axes
    assert kept.mean() > 0.999


def map_of(folder, image: np.ndarray, before: str = "") -> Scene:
    write_exr(folder / "sky.exr", {"beauty": image.astype(np.float32)})
    return read(folder, f'{before} LightSource "infinite" "string filename" "sky.exr" "float scale" 2\n')


def radiance(scene: Scene, direction) -> np.ndarray:
    unit = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return EnvironmentLight(scene.environment).radiance(torch.tensor(unit, dtype=torch.float32)[:, None]).numpy()[:, 0]


def test_a_constant_map_is_a_constant_sky(tmp_path):
    scene = map_of(tmp_path, np.full((16, 16, 3), (0.25, 0.5, 1.0)))
    np.testing.assert_allclose(scene.environment.radiance.reshape(-1, 3), np.tile((0.5, 1.0, 2.0), (32 * 64, 1)), rtol=1e-5)


@pytest.mark.parametrize("before", ["", "Rotate 90 -1 0 0", "Scale -1 1 1 Rotate 30 0 1 0"])
def test_a_bright_direction_of_a_map(tmp_path, before):
    """The texel of the map about (0.75, 0.5) lies at (0.66, 0, 0.75) of the light's space, and has the 1/4096 of the sphere."""
    image = np.zeros((64, 64, 3))
    image[32, 48] = 1.0
    scene = map_of(tmp_path, image, before)
    local = sphere_from_square(np.array((48.5 / 64.0, 32.5 / 64.0)))
    quarter, half = math.sqrt(0.75), 0.5
    turn = {
        "": np.eye(3),
        "Rotate 90 -1 0 0": np.array([(1, 0, 0), (0, 0, 1), (0, -1, 0)]),
        "Scale -1 1 1 Rotate 30 0 1 0": np.diag((-1.0, 1.0, 1.0))
        @ np.array([(quarter, 0, half), (0, 1, 0), (-half, 0, quarter)]),
    }[before]
    towards = turn @ local
    assert radiance(scene, towards)[0] > 1.0
    for other in (-towards, towards[[1, 2, 0]]):
        assert radiance(scene, other)[0] == 0.0
    texels = scene.environment.radiance[..., 0]
    height, width = texels.shape
    weights = np.sin(math.pi * (np.arange(height) + 0.5) / height)[:, None] * math.pi / height * 2.0 * math.pi / width
    assert (texels * weights).sum() == pytest.approx(2.0 * 4.0 * math.pi / 4096.0, rel=2e-3)
    phi = 2.0 * math.pi * (np.arange(width) + 0.5) / width - math.pi
    theta = math.pi * (np.arange(height)[:, None] + 0.5) / height
    axes = np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))
    middle = np.array([(axis * texels * weights).sum() for axis in axes])
    assert float(middle @ towards) / np.linalg.norm(middle) > math.cos(math.radians(0.5))


def test_edges_of_the_map_meet(tmp_path):
    """A smooth function of the direction, sampled by the map, comes back everywhere."""
    middles = (np.arange(64) + 0.5) / 64.0
    directions = sphere_from_square(np.stack(np.meshgrid(middles, middles), axis=-1))
    found = equirectangular(1.0 + 0.5 * directions, np.eye(3))
    height, width = found.shape[:2]
    phi = 2.0 * math.pi * (np.arange(width) + 0.5) / width - math.pi
    theta = math.pi * (np.arange(height)[:, None] + 0.5) / height
    axes = np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi))
    np.testing.assert_allclose(found, 1.0 + 0.5 * np.stack(axes, axis=-1), atol=0.02)


def test_neighbours_across_an_edge():
    """The edge points at t and 1 - t are one direction: both texels count half there."""
    image = np.random.default_rng(2).random((4, 4, 3))
    for point, first, second in (((1.0, 0.375), (1, 3), (2, 3)), ((0.375, 0.0), (0, 1), (0, 2))):
        np.testing.assert_allclose(bilinear(image, np.array(point)), 0.5 * (image[first] + image[second]))


def test_shapes_with_the_same_light_share_a_material(tmp_path):
    both = square(1.0, 2.0) + square(1.0, 3.0)
    scene = read(tmp_path, f'AreaLightSource "diffuse" "rgb L" [2 1 1]\n{both}AreaLightSource "diffuse" "rgb L" [1 1 1]\n{both}')
    assert [mesh.material for mesh in scene.meshes] == [0, 1, 1, 2, 2]


def test_losses_are_told(tmp_path):
    hidden = f'AreaLightSource "diffuse"\nAttribute "shape" "float alpha" 0\n{square(1.0, 2.0)}'
    assert read(tmp_path, hidden).warnings == ("scene.pbrt: invisible area lights: visible ones in their place (scene.pbrt:10)",)
    scene = read(tmp_path, 'LightSource "laser"\nMakeNamedMedium "fog" "string type" "homogeneous"\nMediumInterface "fog" ""\n')
    assert scene.warnings == (
        "scene.pbrt: media: left out (fog)",
        "scene.pbrt: light sources of the type laser: left out (scene.pbrt:8)",
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_maps_in_pfm(tmp_path, order):
    """The rows of a PFM file go from the bottom to the top."""
    image = np.random.default_rng(1).random((8, 8, 3)).astype(np.float32)
    header = f"PF\n8 8\n{'-' if order == '<' else ''}1.0\n".encode()
    (tmp_path / "sky.pfm").write_bytes(header + image[::-1].astype(f"{order}f4").tobytes())
    scene = read(tmp_path, 'LightSource "infinite" "string filename" "sky.pfm"\n')
    assert scene.environment is not None
    np.testing.assert_allclose(scene.environment.radiance, equirectangular(image.astype(np.float64), np.diag((1.0, 1.0, 1.0))))
    for damage in (b"P6\n8 8\n255\n", header + b"\0" * 100, header + np.full((8, 8, 3), np.nan, f"{order}f4").tobytes()):
        (tmp_path / "sky.pfm").write_bytes(damage)
        with pytest.raises(BokehguideError, match=r"sky\.pfm"):
            load_scene(str(tmp_path / "scene.pbrt"))


def older(folder, body: str) -> Scene:
    """A scene of pbrt-v3."""
    return read(folder, f"{body}\nWorldEnd\n")


def test_colours_of_lights_before_pbrt_v4(tmp_path):
    """A colour `scale` multiplies a colour; spectra keep their luminance, and black bodies have the peak 1."""

    def emitted(parameters: str) -> tuple[float, ...]:
        scene = older(tmp_path, f'AreaLightSource "diffuse" {parameters} Shape "sphere"')
        return scene.materials[scene.meshes[-1].material].emission

    assert emitted('"color L" [1 2 3] "color scale" [2 2 0.5]') == pytest.approx((2.0, 4.0, 1.5))
    assert emitted('"rgb L" [1 2 3]') == pytest.approx((1.0, 2.0, 3.0))
    assert LUMINANCE @ emitted('"spectrum L" [360 3 830 3]') == pytest.approx(3.0, rel=0.01)
    wavelengths = np.arange(380.0, 781.0, 5.0)
    planck = wavelengths**-5 / np.expm1(1.4388e7 / (wavelengths * 5200.0))
    grid = np.linspace(300.0, 900.0, 6001)
    peak = (grid**-5 / np.expm1(1.4388e7 / (grid * 5200.0))).max()
    efficiency = np.exp(-0.5 * ((wavelengths - 559.0) / 42.0) ** 2)
    wanted = 2.0 * float((planck / peak * efficiency).sum() / efficiency.sum())
    assert LUMINANCE @ emitted('"blackbody L" [5200 2]') == pytest.approx(wanted, rel=0.01)


def test_a_point_light_before_pbrt_v4(tmp_path):
    """The intensity is a colour times a colour `scale`."""
    scene = older(tmp_path, 'LightSource "point" "rgb I" [1 2 3] "rgb scale" [2 2 2] "point from" [0 3 0]')
    radius = 0.5 * float(np.ptp(scene.meshes[-1].vertices, axis=0).max())
    emission = np.array(scene.materials[scene.meshes[-1].material].emission)
    np.testing.assert_allclose(emission * math.pi * radius**2, (2.0, 4.0, 6.0), rtol=0.01)


@pytest.mark.parametrize("turn", ["", "Rotate 90 -1 0 0", "Scale -1 1 1 Rotate 90 0 0 1"])
def test_maps_before_pbrt_v4_are_equirectangular(tmp_path, turn):
    """The top of the map is +z, its left edge +x, and columns turn from +x to +y."""
    image = np.zeros((64, 128, 3), np.float32)
    image[16, 8] = 1.0
    write_exr(tmp_path / "map.exr", {"beauty": image})
    body = f'AttributeBegin {turn}\nLightSource "infinite" "string mapname" "map.exr" "rgb L" [2 2 2] AttributeEnd'
    scene = older(tmp_path, body)
    theta, phi = math.pi * 16.5 / 64.0, 2.0 * math.pi * 8.5 / 128.0
    local = np.array((math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)))
    matrix = {
        "": np.eye(3),
        "Rotate 90 -1 0 0": np.array([(1, 0, 0), (0, 0, 1), (0, -1, 0)]),
        "Scale -1 1 1 Rotate 90 0 0 1": np.diag((-1.0, 1.0, 1.0)) @ np.array([(0, -1, 0), (1, 0, 0), (0, 0, 1)]),
    }[turn]
    assert radiance(scene, matrix @ local)[0] > 1.0
    for other in (-local, local[[1, 2, 0]]):
        assert radiance(scene, matrix @ other)[0] == 0.0
    texels = scene.environment.radiance[..., 0]
    weights = np.sin(math.pi * (np.arange(len(texels)) + 0.5) / len(texels))
    found, wanted = (texels.mean(axis=1) * weights).sum() / weights.sum(), 2.0 * math.sin(theta) / 128.0
    assert found == pytest.approx(wanted / np.sin(math.pi * (np.arange(64) + 0.5) / 64.0).sum(), rel=1e-3)


def test_a_light_at_the_camera_is_behind_the_camera(tmp_path):
    """The sphere of a headlight would hide the scene."""
    scene = read(tmp_path, 'AttributeBegin CoordSysTransform "camera" LightSource "point" AttributeEnd')
    radius = 0.5 * float(np.ptp(scene.meshes[-1].vertices, axis=0).max())
    middle = 0.5 * (scene.meshes[-1].vertices.min(axis=0) + scene.meshes[-1].vertices.max(axis=0))
    away = np.array(scene.camera.position) - np.array(scene.camera.target)
    np.testing.assert_allclose(middle - scene.camera.position, 2.0 * radius * away / np.linalg.norm(away), atol=0.05 * radius)
    assert scene.likely_mistakes == () and any("behind the camera" in line for line in scene.warnings)
