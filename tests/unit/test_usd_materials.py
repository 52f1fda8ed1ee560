"""UsdPreviewSurface as `Material`: constants, textures and their channels, what is told, and textures inside of packages."""

import math

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pxr")

from pxr import Gf, Sdf, UsdShade, UsdUtils

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from tests.support.usd_stages import add_mesh, add_primvar, loaded, new_stage, saved

TYPES = Sdf.ValueTypeNames
KINDS = {
    **dict.fromkeys(("diffuseColor", "specularColor", "emissiveColor"), TYPES.Color3f),
    "normal": TYPES.Normal3f,
    "useSpecularWorkflow": TYPES.Int,
    "opacityMode": TYPES.Token,
}


class Look:
    """A square with a UsdPreviewSurface."""

    def __init__(self, **inputs):
        self.stage = new_stage()
        mesh = self.mesh = add_mesh(self.stage, "/mesh")
        add_primvar(mesh, "st", TYPES.TexCoord2fArray, [Gf.Vec2f(*xy) for xy in ((0, 0), (1, 0), (1, 1), (0, 1))], "vertex")
        self.material = UsdShade.Material.Define(self.stage, "/look")
        self.surface = UsdShade.Shader.Define(self.stage, "/look/surface")
        self.surface.SetShaderId("UsdPreviewSurface")
        self.material.CreateSurfaceOutput().ConnectToSource(self.surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(self.material)
        for name, value in inputs.items():
            self.input(name).Set(value)

    def input(self, name: str):
        return self.surface.CreateInput(name, KINDS.get(name, TYPES.Float))

    def texture(self, name: str, output: str, file: str, **values) -> UsdShade.Shader:
        """Connect an input to an output of a new UsdUVTexture."""
        image = UsdShade.Shader.Define(self.stage, f"/look/{name}_image")
        image.SetShaderId("UsdUVTexture")
        image.CreateInput("file", TYPES.Asset).Set(file)
        for key, value in values.items():
            kind = TYPES.Float4 if key in ("scale", "bias") else TYPES.Token
            image.CreateInput(key, kind).Set(Gf.Vec4f(*value) if kind == TYPES.Float4 else value)
        kind = TYPES.Float3 if output == "rgb" else TYPES.Float
        self.input(name).ConnectToSource(image.CreateOutput(output, kind))
        return image

    def scene(self, folder):
        return loaded(self.stage, folder)

    def of(self, folder):
        scene = self.scene(folder)
        return scene.materials[scene.meshes[0].material]


def linear(level: float) -> float:
    """Linear value of an sRGB level."""
    level /= 255
    return level / 12.92 if level <= 0.04045 else ((level + 0.055) / 1.055) ** 2.4


def painted(folder, name: str, *pixels, mode: str = "RGB", size=(2, 1)) -> str:
    image = Image.new(mode, size)
    image.putdata(list(pixels))
    image.save(folder / name)
    return f"./{name}"


def test_constants(tmp_path):
    look = Look(
        diffuseColor=Gf.Vec3f(0.1, 0.2, 0.3), metallic=0.25, roughness=0.75, ior=1.8, clearcoat=0.5, clearcoatRoughness=0.3
    )
    look.input("emissiveColor").Set(Gf.Vec3f(2, 3, 4))
    found = look.of(tmp_path)
    assert found.base_color == pytest.approx((0.1, 0.2, 0.3)) and found.emission == (2, 3, 4)
    numbers = (found.metallic, found.roughness, found.ior, found.clearcoat, found.clearcoat_roughness)
    assert numbers == pytest.approx((0.25, 0.75, 1.8, 0.5, 0.3)) and found.alpha_mode == "opaque"
    assert found.name == "look" and look.scene(tmp_path).warnings == ()


def test_the_defaults_are_those_of_the_specification(tmp_path):
    found = Look().of(tmp_path)
    assert found.base_color == pytest.approx((0.18,) * 3)
    assert (found.roughness, found.metallic, found.ior, found.clearcoat) == (0.5, 0.0, 1.5, 0.0)
    assert found.clearcoat_roughness == pytest.approx(0.01)


def test_wrong_constants_are_clamped(tmp_path):
    look = Look(roughness=-3.0, metallic=float("nan"), diffuseColor=Gf.Vec3f(7, -1, 0.5), ior=0.0)
    found, text = look.of(tmp_path), "\n".join(look.scene(tmp_path).warnings)
    assert (found.roughness, found.metallic, found.ior) == (0, 0, 1) and found.base_color == (1, 0, 0.5)
    for part in ("roughness outside 0 to 1: the nearest limit", "diffuse colours above 1", "colours below 0", "ior outside 1 to"):
        assert part in text


def test_the_specular_workflow(tmp_path):
    look = Look(useSpecularWorkflow=1, diffuseColor=Gf.Vec3f(0.5), specularColor=Gf.Vec3f(0.1, 0.2, 0.3), metallic=1.0, ior=2.0)
    found = look.of(tmp_path)
    f0 = ((found.ior - 1) / (found.ior + 1)) ** 2
    assert np.multiply(found.specular_color, f0) == pytest.approx((0.1, 0.2, 0.3)) and found.metallic == 0


@pytest.mark.parametrize("name", ["scene.usda", "scene.usdc"])
def test_textures_are_files_of_the_scene(name, tmp_path):
    """Commands refuse to replace these. Another process reads binary stages."""
    look = Look()
    look.texture("diffuseColor", "rgb", painted(tmp_path, "a.png", (128, 0, 255), (0, 0, 0)))
    scene = load_scene(saved(look.stage, tmp_path, name))
    assert {(tmp_path / each).resolve() for each in (name, "a.png")} <= scene.files


@pytest.mark.parametrize(("space", "wanted"), [("sRGB", linear(128)), ("auto", linear(128)), ("raw", 128 / 255)])
def test_the_color_space_of_a_texture(space, wanted, tmp_path):
    look = Look()
    look.texture("diffuseColor", "rgb", painted(tmp_path, "a.png", (128, 0, 255), (0, 0, 0)), sourceColorSpace=space)
    found = look.of(tmp_path)
    assert found.base_color == (1, 1, 1) and found.base_color_texture.image[0, 0] == pytest.approx((wanted, 0, 1), abs=1e-5)


def test_grey_textures_are_linear_by_default(tmp_path):
    look = Look()
    look.texture("roughness", "r", painted(tmp_path, "a.png", 128, 255, mode="L"))
    assert look.of(tmp_path).metallic_roughness_texture.image[0, 0, 1] == pytest.approx(128 / 255)


def test_scale_and_bias(tmp_path):
    look = Look()
    file = painted(tmp_path, "a.png", (102, 51, 0), (255, 255, 255))
    look.texture("diffuseColor", "rgb", file, scale=(0.5, 1, 1, 1), bias=(0.1, 0.2, 0.3, 0), sourceColorSpace="raw")
    texels = look.of(tmp_path).base_color_texture.image[0]
    np.testing.assert_allclose(texels, [(0.3, 0.4, 0.3), (0.6, 1.0, 1.0)], atol=1e-5)


def test_channels_of_one_image_for_roughness_metal_and_clearcoat(tmp_path):
    look = Look(roughness=0.1)
    file = painted(tmp_path, "orm.png", (10, 20, 30), (40, 50, 60))
    for name, output in (("roughness", "g"), ("metallic", "b"), ("clearcoat", "r"), ("clearcoatRoughness", "g")):
        look.texture(name, output, file, sourceColorSpace="raw")
    found = look.of(tmp_path)
    assert (found.roughness, found.metallic, found.clearcoat, found.clearcoat_roughness) == (1, 1, 1, 1)
    np.testing.assert_allclose(found.metallic_roughness_texture.image[0, :, 1:] * 255, [(20, 30), (50, 60)], atol=1e-3)
    assert found.clearcoat_texture.image[0, 0, 0] * 255 == pytest.approx(10)
    assert found.clearcoat_roughness_texture.image[0, 0, 1] * 255 == pytest.approx(20)


def test_a_roughness_texture_leaves_the_metal_constant(tmp_path):
    look = Look(metallic=0.4)
    look.texture("roughness", "g", painted(tmp_path, "a.png", (10, 20, 30), (0, 0, 0)), sourceColorSpace="raw")
    found = look.of(tmp_path)
    assert found.metallic == pytest.approx(0.4) and found.metallic_roughness_texture.image[0, 0, 2] == 1


def test_emission_textures_above_one(tmp_path):
    look = Look()
    look.texture("emissiveColor", "rgb", painted(tmp_path, "a.png", (255, 0, 0), (0, 0, 255)), scale=(8, 8, 4, 1))
    found = look.of(tmp_path)
    np.testing.assert_allclose(found.emission_texture.image[0] * found.emission, [(8, 0, 0), (0, 0, 4)], atol=1e-5)


@pytest.mark.parametrize("flipped", [False, True])
def test_normal_maps(flipped, tmp_path):
    """The usual scale of 2 and bias of -1 keep the texels; a scale of -2 flips the green channel."""
    look = Look()
    scale, bias = ((2, -2, 2, 1), (-1, 1, -1, 0)) if flipped else ((2, 2, 2, 1), (-1, -1, -1, 0))
    look.texture("normal", "rgb", painted(tmp_path, "n.png", (128, 200, 255), (0, 0, 0)), scale=scale, bias=bias)
    texel = look.of(tmp_path).normal_texture.image[0, 0] * 255
    assert texel == pytest.approx((128, 55 if flipped else 200, 255), abs=1e-2)


@pytest.mark.parametrize(("threshold", "mode"), [(0.0, "blend"), (0.3, "mask")])
def test_opacity_textures(threshold, mode, tmp_path):
    look = Look(opacityThreshold=threshold)
    file = painted(tmp_path, "a.png", (255, 255, 255, 51), (0, 0, 0, 255), mode="RGBA")
    look.texture("diffuseColor", "rgb", file)
    look.texture("opacity", "a", file)
    found = look.of(tmp_path)
    assert found.alpha_mode == mode and found.base_color_texture.image[0, :, 3] == pytest.approx((0.2, 1.0))
    assert mode == "blend" or found.alpha_cutoff == pytest.approx(0.3)


def test_opacity_textures_of_another_size_and_without_a_color_texture(tmp_path):
    look = Look(diffuseColor=Gf.Vec3f(0.2, 0.4, 0.6))
    look.texture("opacity", "r", painted(tmp_path, "a.png", 0, 255, mode="L"))
    found = look.of(tmp_path)
    assert found.base_color == pytest.approx((0.2, 0.4, 0.6)) and found.base_color_texture.image[0, 0] == pytest.approx(
        (1, 1, 1, 0)
    )
    colors = [(number * 10, 0, 0) for number in range(8)]
    look.texture("diffuseColor", "rgb", painted(tmp_path, "b.png", *colors, size=(4, 2)), sourceColorSpace="raw")
    texels = look.of(tmp_path).base_color_texture.image
    assert texels.shape == (2, 4, 4) and texels[1, :, 3].tolist() == [0, 0, 1, 1]


def test_constant_opacity_is_glass_or_presence(tmp_path):
    glass = Look(opacity=0.0, ior=1.33).of(tmp_path)
    assert (glass.transmission, glass.ior, glass.base_color) == (1.0, pytest.approx(1.33), (1, 1, 1))
    present = Look(opacity=0.25, opacityMode="presence").of(tmp_path)
    assert (present.alpha_mode, present.opacity, present.transmission) == ("blend", 0.25, 0.0)
    assert Look(opacity=0.25, opacityThreshold=0.5).of(tmp_path).alpha_mode == "mask"


def test_display_colors_through_a_reader(tmp_path):
    look = Look()
    reader = UsdShade.Shader.Define(look.stage, "/look/reader")
    reader.SetShaderId("UsdPrimvarReader_float3")
    reader.CreateInput("varname", TYPES.String).Set("paint")
    look.input("diffuseColor").ConnectToSource(reader.CreateOutput("result", TYPES.Float3))
    add_primvar(look.mesh, "paint", TYPES.Color3fArray, [Gf.Vec3f(0.1, 0.2, 0.3)] * 4, "vertex")
    scene = look.scene(tmp_path)
    assert scene.meshes[0].colors[0] == pytest.approx((0.1, 0.2, 0.3, 1.0)) and scene.materials[0].base_color == (1, 1, 1)


@pytest.mark.parametrize(("mode", "wanted"), [("repeat", "repeat"), ("mirror", "mirror"), ("clamp", "clamp"), ("black", "clamp")])
def test_wrapping(mode, wanted, tmp_path):
    look = Look()
    look.texture("diffuseColor", "rgb", painted(tmp_path, "a.png", (1, 2, 3), (4, 5, 6)), wrapS=mode, wrapT="repeat")
    scene = look.scene(tmp_path)
    assert scene.materials[0].base_color_texture.wrap == (wanted, "repeat")
    assert (mode == "black") == any("black outside" in line for line in scene.warnings)


def test_transforms_of_texture_coordinates(tmp_path):
    """The specification: scale, then rotate anticlockwise, then translate, with v upwards."""
    look = Look()
    image = look.texture("diffuseColor", "rgb", painted(tmp_path, "a.png", (1, 2, 3), (4, 5, 6)))
    move = UsdShade.Shader.Define(look.stage, "/look/move")
    move.SetShaderId("UsdTransform2d")
    move.CreateInput("rotation", TYPES.Float).Set(30.0)
    move.CreateInput("scale", TYPES.Float2).Set(Gf.Vec2f(2, 3))
    move.CreateInput("translation", TYPES.Float2).Set(Gf.Vec2f(0.1, 0.2))
    image.CreateInput("st", TYPES.Float2).ConnectToSource(move.CreateOutput("result", TYPES.Float2))
    a, b, c, d, e, f = look.of(tmp_path).base_color_texture.transform
    for s, t in ((0.0, 0.0), (0.3, 0.8), (1.0, 0.2)):
        x, y, angle = 2 * s, 3 * t, math.radians(30)
        wanted = math.cos(angle) * x - math.sin(angle) * y + 0.1, math.sin(angle) * x + math.cos(angle) * y + 0.2
        u, v = s, 1 - t
        assert (a * u + b * v + c, 1 - (d * u + e * v + f)) == pytest.approx(wanted)


def test_inputs_through_node_graphs(tmp_path):
    look = Look()
    public = look.material.CreateInput("tint", TYPES.Color3f)
    public.Set(Gf.Vec3f(0.3, 0.2, 0.1))
    look.input("diffuseColor").ConnectToSource(public)
    assert look.of(tmp_path).base_color == pytest.approx((0.3, 0.2, 0.1))


def test_what_is_lost_is_told(tmp_path):
    look = Look(displacement=0.5)
    node = UsdShade.Shader.Define(look.stage, "/look/noise")
    node.SetShaderId("SomeNoise")
    look.input("roughness").ConnectToSource(node.CreateOutput("out", TYPES.Float))
    look.texture("diffuseColor", "rgb", "./gone.png")
    other = UsdShade.Material.Define(look.stage, "/other")
    UsdShade.MaterialBindingAPI.Apply(add_mesh(look.stage, "/second").GetPrim()).Bind(other)
    text = "\n".join(look.scene(tmp_path).warnings)
    for part in (
        "displacement: left out (look)",
        "nodes of the type SomeNoise at roughness: left out (look)",
        "missing textures: left out (./gone.png)",
        "materials without a surface that is read: the display colour in their place (/other)",
    ):
        assert part in text


def test_textures_stay_in_the_folder(tmp_path):
    folder = tmp_path / "inside"
    folder.mkdir()
    painted(tmp_path, "out.png", (1, 2, 3), (4, 5, 6))
    for file in ("../out.png", str(tmp_path / "out.png")):
        look = Look()
        look.texture("diffuseColor", "rgb", file)
        path = saved(look.stage, folder)
        with pytest.raises(BokehguideError, match="lies outside the scene's folder"):
            load_scene(path)
        assert load_scene(path, allow_outside=True).materials[0].base_color_texture is not None


def test_unreadable_textures_are_refused(tmp_path):
    (tmp_path / "junk.png").write_bytes(b"junk")
    look = Look()
    look.texture("diffuseColor", "rgb", "./junk.png")
    with pytest.raises(BokehguideError, match=r"/look/diffuseColor_image: unreadable texture"):
        look.scene(tmp_path)


def test_textures_inside_of_packages(tmp_path):
    (tmp_path / "textures").mkdir()
    painted(tmp_path, "textures/a.png", (255, 0, 0), (0, 255, 0))
    look = Look()
    look.texture("diffuseColor", "rgb", "./textures/a.png")
    source = saved(look.stage, tmp_path, "scene.usdc")
    assert UsdUtils.CreateNewUsdzPackage(source, str(tmp_path / "packed.usdz"))
    for name in ("scene.usdc", "textures/a.png"):
        (tmp_path / name).unlink()
    texture = load_scene(str(tmp_path / "packed.usdz")).materials[0].base_color_texture
    np.testing.assert_allclose(texture.image[0], [(1, 0, 0), (0, 1, 0)], atol=1e-6)


def test_a_binding_to_a_missing_material_is_told(tmp_path):
    stage = new_stage()
    prim = add_mesh(stage, "/World/square").GetPrim()
    UsdShade.MaterialBindingAPI.Apply(prim).GetDirectBindingRel().SetTargets([Sdf.Path("/World/Gold")])
    (line,) = [line for line in loaded(stage, tmp_path).warnings if "bindings to materials" in line]
    assert "/World/square: /World/Gold" in line
