"""Lights of USD against closed forms of their irradiance, and dome lights against the schema's orientation."""

import math

import numpy as np
import OpenEXR
import pytest
from PIL import Image

pytest.importorskip("pxr")

from pxr import Gf, Sdf, UsdGeom, UsdLux, UsdShade

from bokehguide import render
from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from bokehguide.scene.usd.domes import turned_map
from tests.support.usd_stages import add_mesh, loaded, new_stage, saved

ALBEDO, HEIGHT = 0.5, 2.0


def matte(stage, gprim) -> None:
    """A diffuse surface without a reflection: its refractive index is 1."""
    material = UsdShade.Material.Define(stage, "/matte")
    shader = UsdShade.Shader.Define(stage, "/matte/surface")
    shader.SetShaderId("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set((ALBEDO,) * 3)
    shader.CreateInput("ior", Sdf.ValueTypeNames.Float).Set(1.0)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)


def floor_stage(unit: float = 1.0, up: str = "Y"):
    """A small matte square around the origin that faces +z, and a camera that sees its middle, in metres with y up."""
    stage = new_stage(unit, up)
    world = UsdGeom.Xform.Define(stage, "/world")
    if up == "Z":
        world.AddRotateXOp().Set(90.0)
    world.AddScaleOp().Set(Gf.Vec3f(1.0 / unit))
    floor = add_mesh(stage, "/world/floor", [(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.1, 0.1, 0), (-0.1, 0.1, 0)])
    matte(stage, floor)
    camera = UsdGeom.Camera.Define(stage, "/world/camera")
    camera.AddTransformOp().Set(Gf.Matrix4d().SetLookAt(Gf.Vec3d(3, 0, 3), Gf.Vec3d(0), Gf.Vec3d(0, 1, 0)).GetInverse())
    camera.CreateFocalLengthAttr(5000.0)
    camera.CreateFStopAttr(0.0)
    return stage


def above(light, height: float = HEIGHT):
    """A light over the floor; its -z axis points down already."""
    light.AddTranslateOp().Set(Gf.Vec3d(0, 0, height))
    return light


def irradiance(stage, folder, spp: int = 256) -> np.ndarray:
    """The irradiance `[3]` in the middle of the floor, from its radiance in a picture."""
    picture = render(saved(stage, folder), mode="uniform", spp=spp, size=(8, 8), quiet=True)
    return picture.beauty.mean(axis=(0, 1)) * math.pi / ALBEDO


def rectangle_irradiance(width: float, height: float, distance: float) -> float:
    """The irradiance of a rectangle of radiance 1 below its middle, by the midpoint rule."""
    x, y = (side * ((np.arange(400) + 0.5) / 400 - 0.5) for side in (width, height))
    squared = x[:, None] ** 2 + y**2 + distance**2
    return float((distance**2 / squared**2).mean() * width * height)


def test_a_sphere(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.SphereLight.Define(stage, "/world/light"))
    light.CreateRadiusAttr(0.5)
    light.CreateIntensityAttr(3.0)
    light.CreateExposureAttr(2.0)
    light.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 0.25))
    wanted = math.pi * 3.0 * 4.0 * np.array([1.0, 0.5, 0.25]) * (0.5 / HEIGHT) ** 2
    np.testing.assert_allclose(irradiance(stage, tmp_path), wanted, rtol=0.01)


def test_a_disc(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.DiskLight.Define(stage, "/world/light"))
    light.CreateRadiusAttr(0.7)
    light.CreateIntensityAttr(5.0)
    wanted = math.pi * 5.0 * 0.7**2 / (0.7**2 + HEIGHT**2)
    np.testing.assert_allclose(irradiance(stage, tmp_path), wanted, rtol=0.01)


def test_a_rectangle_shines_along_minus_z_alone(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.RectLight.Define(stage, "/world/light"))
    light.CreateWidthAttr(1.5)
    light.CreateHeightAttr(0.4)
    light.CreateIntensityAttr(2.0)
    np.testing.assert_allclose(irradiance(stage, tmp_path), 2.0 * rectangle_irradiance(1.5, 0.4, HEIGHT), rtol=0.01)
    light.AddRotateXOp().Set(180.0)
    assert irradiance(stage, tmp_path, 4).max() == 0.0


def test_a_cylinder_along_x(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.CylinderLight.Define(stage, "/world/light"), 6.0)
    light.CreateLengthAttr(2.0)
    light.CreateRadiusAttr(0.05)
    light.CreateIntensityAttr(10.0)
    x = np.linspace(-1.0, 1.0, 2001)
    squared = x**2 + 36.0
    wanted = 10.0 * 0.1 * np.trapezoid(36.0 / squared**2, x)  # a thin tube: its projected width is 2 r cos
    np.testing.assert_allclose(irradiance(stage, tmp_path), wanted, rtol=0.02)


@pytest.mark.parametrize("kind", ["SphereLight", "DiskLight", "RectLight", "CylinderLight"])
def test_normalized_lights_divide_by_their_area(kind, tmp_path):
    stage = floor_stage()
    light = above(getattr(UsdLux, kind).Define(stage, "/world/light"))
    light.AddScaleOp().Set(Gf.Vec3f(2.0))
    light.CreateNormalizeAttr(True)
    light.CreateIntensityAttr(7.0)
    areas = {"SphereLight": 4 * math.pi, "DiskLight": math.pi, "RectLight": 4.0, "CylinderLight": 2 * math.pi * 2.0}
    scene = loaded(stage, tmp_path)
    assert scene.materials[scene.meshes[-1].material].emission == pytest.approx([7.0 / areas[kind]] * 3, rel=2e-3)


@pytest.mark.parametrize(("angle", "normalized"), [(20.0, False), (20.0, True), (0.0, False), (0.53, False)])
def test_a_distant_light(angle, normalized, tmp_path):
    stage = floor_stage()
    light = UsdLux.DistantLight.Define(stage, "/world/light")
    light.CreateAngleAttr(angle)
    light.CreateNormalizeAttr(normalized)
    light.CreateIntensityAttr(4.0)
    size = math.pi * math.sin(math.radians(angle / 2)) ** 2
    wanted = 4.0 if normalized or angle == 0.0 else 4.0 * size
    np.testing.assert_allclose(irradiance(stage, tmp_path), wanted, rtol=0.01)
    light.AddRotateYOp().Set(60.0)
    assert loaded(stage, tmp_path).suns[0].direction == pytest.approx((math.sin(math.pi / 3), 0, 0.5), abs=1e-6)


def test_a_constant_dome(tmp_path):
    stage = floor_stage()
    UsdLux.DomeLight.Define(stage, "/world/light").CreateIntensityAttr(0.3)
    np.testing.assert_allclose(irradiance(stage, tmp_path), 0.3 * math.pi, rtol=0.01)


def test_the_color_temperature_is_that_of_usd(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.SphereLight.Define(stage, "/world/light"))
    light.CreateColorTemperatureAttr(3000.0)
    scene = loaded(stage, tmp_path)
    assert scene.materials[-1].emission == (1, 1, 1)
    light.CreateEnableColorTemperatureAttr(True)
    emission = loaded(stage, tmp_path).materials[-1].emission
    assert emission == pytest.approx(tuple(UsdLux.BlackbodyTemperatureAsRgb(3000.0)), rel=1e-6) and emission[0] > emission[2]


def test_cones_of_spotlights(tmp_path):
    stage = floor_stage()
    light = above(UsdLux.SphereLight.Define(stage, "/world/light"))
    shaping = UsdLux.ShapingAPI.Apply(light.GetPrim())
    assert loaded(stage, tmp_path).materials[-1].emission_cone is None
    shaping.CreateShapingConeAngleAttr(30.0)
    shaping.CreateShapingConeSoftnessAttr(0.4)
    cone = loaded(stage, tmp_path).materials[-1].emission_cone
    assert (cone.inner, cone.outer, cone.smooth) == (pytest.approx(18.0), pytest.approx(30.0), True)
    assert cone.axis == pytest.approx((0, 0, -1))
    shaping.CreateShapingConeSoftnessAttr(0.0)
    cone = loaded(stage, tmp_path).materials[-1].emission_cone
    assert cone.inner == pytest.approx(30.0, abs=0.02) and cone.outer == pytest.approx(30.0)
    full = irradiance(stage, tmp_path)
    light.AddRotateXOp().Set(60.0)
    assert full.min() > 0 and irradiance(stage, tmp_path, 4).max() == 0.0
    shaping.CreateShapingFocusAttr(2.0)
    assert any("focus of lights: left out (light)" in line for line in loaded(stage, tmp_path).warnings)


def test_dark_lights_and_unknown_ones_are_told(tmp_path):
    stage = floor_stage()
    UsdLux.SphereLight.Define(stage, "/world/dark").CreateIntensityAttr(0.0)
    UsdLux.PortalLight.Define(stage, "/world/portal")
    scene = loaded(stage, tmp_path)
    assert any("without an intensity: left out (dark)" in line for line in scene.warnings)
    assert any("PortalLight: left out (portal)" in line for line in scene.warnings)


@pytest.mark.parametrize(("unit", "up"), [(0.01, "Z"), (1.0, "Z"), (0.01, "Y")])
def test_the_same_scene_in_other_units(unit, up, tmp_path):
    """The same picture, except for normalized lights: their area counts in scene units."""

    def lit(unit: float, up: str):
        stage = floor_stage(unit, up)
        UsdLux.SphereLight.Define(stage, "/world/lights/a").AddTranslateOp().Set(Gf.Vec3d(0.5, 0, 1.5))
        normalized = UsdLux.RectLight.Define(stage, "/world/lights/b")
        normalized.AddTranslateOp().Set(Gf.Vec3d(-1, 0, 2))
        normalized.CreateNormalizeAttr(True)
        normalized.CreateIntensityAttr(3.0 / unit**2)
        sun = UsdLux.DistantLight.Define(stage, "/world/lights/c")
        sun.AddRotateYOp().Set(30.0)
        sun.CreateIntensityAttr(30_000.0)
        dome = UsdLux.DomeLight.Define(stage, "/world/lights/d")
        dome.CreateTextureFileAttr("sky.exr")
        return stage

    pixels = np.random.default_rng(3).random((8, 16, 3), np.float32) ** 4
    OpenEXR.File({}, {"RGB": pixels}).write(str(tmp_path / "sky.exr"))
    first, second = (
        render(saved(lit(*given), tmp_path), mode="uniform", spp=32, size=(8, 8), quiet=True).beauty
        for given in ((1.0, "Y"), (unit, up))
    )
    # A map whose pole is turned is resampled, which blurs it.
    np.testing.assert_allclose(first.mean(axis=(0, 1)), second.mean(axis=(0, 1)), rtol=0.03 if up == "Z" else 2e-3)


def marked(folder) -> None:
    """A map of one bright pixel for each axis: up, down, the centre, and the left and the right quarter."""
    pixels = np.full((65, 128, 3), 0.01, np.float32)
    for row, column, channel in ((0, slice(None), 0), (32, slice(62, 66), 1), (32, slice(30, 34), 2)):
        pixels[row, column, channel] = 50.0
    OpenEXR.File({}, {"RGB": pixels}).write(str(folder / "sky.exr"))


def brightest(environment, channel: int) -> np.ndarray:
    """The direction of the brightest texel of a channel of a map, by the rule of `Environment`."""
    row, column = np.unravel_index(np.argmax(environment.radiance[..., channel]), environment.radiance.shape[:2])
    theta = math.pi * (0.5 - (row + 0.5) / environment.radiance.shape[0])
    phi = 2.0 * math.pi * ((column + 0.5) / environment.radiance.shape[1] - 0.5)
    x, y, z = math.cos(theta) * math.sin(phi), math.sin(theta), -math.cos(theta) * math.cos(phi)
    angle = math.radians(environment.rotation)
    return np.array([math.cos(angle) * x + math.sin(angle) * z, y, -math.sin(angle) * x + math.cos(angle) * z])


DOME_CASES = [
    # The pole of a dome is its y axis, the centre of the map its z axis, the left quarter its x axis.
    ("DomeLight", "Y", None, (0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ("DomeLight", "Z", None, (0, 0, -1), (0, 1, 0), (1, 0, 0)),  # stage y is -z of the picture, stage z is y
    ("DomeLight", "Y", (0, 90, 0), (0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ("DomeLight", "Y", (90, 0, 0), (0, 0, 1), (0, -1, 0), (1, 0, 0)),
    ("DomeLight", "Z", (90, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ("DomeLight_1", "Z", None, (0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ("DomeLight_1", "Y", None, (0, 1, 0), (0, 0, 1), (1, 0, 0)),
]


@pytest.mark.parametrize(("kind", "up", "turn", "pole", "centre", "left"), DOME_CASES)
def test_the_pole_and_the_centre_of_a_dome(kind, up, turn, pole, centre, left, tmp_path):
    marked(tmp_path)
    stage = new_stage(1.0, up)
    add_mesh(stage, "/mesh")
    dome = getattr(UsdLux, kind).Define(stage, "/dome")
    dome.CreateTextureFileAttr("./sky.exr")
    dome.CreateIntensityAttr(2.0)
    if turn is not None:
        dome.AddRotateXYZOp().Set(Gf.Vec3f(*turn))
    environment = loaded(stage, tmp_path).environment
    for channel, wanted in enumerate((pole, centre, left)):
        assert brightest(environment, channel) @ wanted > 0.99, f"channel {channel}"
    assert environment.radiance[..., 1].max() == pytest.approx(100.0, rel=0.6)


def test_a_turned_map_keeps_its_light():
    height = 32
    theta = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    image = np.broadcast_to((2.0 + np.sin(theta))[:, None, None], (height, 2 * height, 3)).astype(np.float32)
    turned = turned_map(image, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    phi = 2.0 * math.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    z = -np.cos(theta)[:, None] * np.cos(phi)
    np.testing.assert_allclose(turned[..., 0], 2.0 + z, atol=0.01)


def test_the_picture_of_a_rectangle_stands_upright(tmp_path):
    """The first pixel of the texture lies at +x, +y: at the upper left, seen from the lit side."""
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0, 0] = (255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    stage = new_stage()
    add_mesh(stage, "/mesh")
    light = UsdLux.RectLight.Define(stage, "/light")
    light.CreateTextureFileAttr("a.png")
    light.CreateIntensityAttr(6.0)
    scene = loaded(stage, tmp_path)
    mesh = scene.meshes[-1]
    material = scene.materials[mesh.material]
    corner = int(np.argmin(np.linalg.norm(mesh.vertices - (0.5, 0.5, 0.0), axis=1)))
    assert mesh.uvs[corner, 0] == pytest.approx((0.0, 0.0))
    assert material.emission == pytest.approx((6, 6, 6)) and material.emission_texture.image[0, 0] == pytest.approx((1, 0, 0))


def test_textures_of_lights_outside_the_folder_are_refused(tmp_path):
    folder = tmp_path / "inside"
    folder.mkdir()
    marked(tmp_path)
    stage = new_stage()
    add_mesh(stage, "/mesh")
    UsdLux.DomeLight.Define(stage, "/dome").CreateTextureFileAttr("../sky.exr")
    path = saved(stage, folder)
    with pytest.raises(BokehguideError, match="lies outside the scene's folder"):
        load_scene(path)
    assert load_scene(path, allow_outside=True).environment.radiance.shape == (65, 128, 3)
