"""Materials of MaterialX in USD stages: documents, surface nodes, image nodes, what is lost, and files that are refused."""

import math

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pxr")
pytest.importorskip("MaterialX")

import MaterialX
from pxr import Gf, Sdf, Usd, UsdShade

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from bokehguide.scene.usd.materialx_surfaces import SURFACES, TERMS
from tests.support.usd_stages import add_mesh, add_primvar, new_stage, saved

TYPES = Sdf.ValueTypeNames
SRGB_HALF = ((128 / 255 + 0.055) / 1.055) ** 2.4
HEAD = '<materialx version="1.39" xmlns:xi="http://www.w3.org/2001/XInclude"'
IMAGE = '<image name="picture" type="color3"><input name="file" type="filename" value="a.png" {}/></image>'
SURFACE = '<standard_surface name="coat" type="surfaceshader"><input name="base_color" type="color3" {}/></standard_surface>'
LOOK = (
    '<surfacematerial name="look" type="material">'
    '<input name="surfaceshader" type="surfaceshader" nodename="coat"/></surfacematerial>'
)


SIZED = (
    '<tiledimage name="picture" type="color3"><input name="file" type="filename" value="a.png"/>'
    '<input name="realworldimagesize" type="float" value="2"/></tiledimage>'
)


def whole(*parts: str, attributes: str = "") -> str:
    """The text of a document with a material called look."""
    return f'<?xml version="1.0"?>{HEAD} {attributes}>{"".join(parts)}{LOOK}</materialx>'


def document(folder, *parts: str, attributes: str = "", name: str = "look.mtlx") -> None:
    """A file of MaterialX with a material called look."""
    (folder / name).write_text(whole(*parts, attributes=attributes))


def bound(target: str = "/World/Looks/look") -> Usd.Stage:
    """A stage with a square that binds a material."""
    stage = new_stage()
    mesh = add_mesh(stage, "/World/mesh")
    add_primvar(mesh, "st", TYPES.TexCoord2fArray, [Gf.Vec2f(*xy) for xy in ((0, 0), (1, 0), (1, 1), (0, 1))], "vertex")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).GetDirectBindingRel().SetTargets([Sdf.Path(target)])
    return stage


def referring(folder, asset: str = "./look.mtlx", name: str = "scene.usda") -> str:
    """A stage file whose materials come from a document."""
    stage = bound()
    stage.DefinePrim("/World/Looks").GetReferences().AddReference(asset, "/MaterialX/Materials")
    return saved(stage, folder, name)


def read(folder, *parts: str, **options):
    """The material of a document, and the warnings."""
    document(folder, *parts, **options)
    scene = load_scene(referring(folder))
    return scene.materials[scene.meshes[0].material], "\n".join(scene.warnings)


def painted(folder, *pixels, name: str = "a.png", size=(2, 1)) -> None:
    image = Image.new("RGB", size)
    image.putdata(list(pixels))
    image.save(folder / name)


class Network:
    """A square with a surface node inside of a USD file."""

    def __init__(self, kind: str = "standard_surface", **constants):
        self.stage = bound("/World/look")
        self.material = UsdShade.Material.Define(self.stage, "/World/look")
        self.surface = self.node("surface", f"ND_{kind}_surfaceshader", **constants)
        self.material.CreateSurfaceOutput("mtlx").ConnectToSource(self.surface.CreateOutput("out", TYPES.Token))

    def node(self, name: str, kind: str, **inputs) -> UsdShade.Shader:
        """A node. inputs: values, or the outputs of other nodes."""
        shader = UsdShade.Shader.Define(self.stage, f"/World/look/{name}")
        shader.SetShaderId(kind)
        for key, value in inputs.items():
            if isinstance(value, UsdShade.Output):
                shader.CreateInput(key, value.GetTypeName()).ConnectToSource(value)
            elif isinstance(value, str):
                shader.CreateInput(key, TYPES.Asset if key == "file" else TYPES.String).Set(value)
            elif isinstance(value, tuple):
                kinds = {2: TYPES.Float2, 3: TYPES.Color3f}
                shader.CreateInput(key, kinds[len(value)]).Set(value)
            else:
                shader.CreateInput(key, {bool: TYPES.Bool, int: TYPES.Int}.get(type(value), TYPES.Float)).Set(value)
        return shader

    def output(self, name: str, kind: str, output: str = "out", **inputs) -> UsdShade.Output:
        """The output of a new node."""
        types = {"float": TYPES.Float, "color3": TYPES.Color3f, "vector2": TYPES.Float2, "vector3": TYPES.Float3}
        return self.node(name, kind, **inputs).CreateOutput(output, types.get(kind.rpartition("_")[2], TYPES.Float))

    def feed(self, **inputs: UsdShade.Output) -> None:
        for key, output in inputs.items():
            self.surface.CreateInput(key, output.GetTypeName()).ConnectToSource(output)

    def read(self, folder):
        """The material, and the warnings."""
        scene = load_scene(saved(self.stage, folder))
        return scene.materials[scene.meshes[0].material], "\n".join(scene.warnings)


@pytest.mark.parametrize("kind", SURFACES)
def test_the_defaults_are_those_of_the_node_definitions(kind):
    library = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library)
    inputs = {each.getName(): each for each in library.getNodeDef(kind).getActiveInputs()}
    for term in TERMS:
        name, default = SURFACES[kind].term(term)
        if name:
            wanted = inputs[name].getValue()
            wanted = wanted.asTuple() if hasattr(wanted, "asTuple") else wanted
            wanted = float(wanted) if isinstance(wanted, bool) else wanted
            assert default == pytest.approx(wanted) if wanted is not None else default in (None, 0.0), name
    assert all(name in inputs for name in SURFACES[kind].ignored)


def test_a_document_becomes_a_material(tmp_path):
    painted(tmp_path, (128, 0, 255), (0, 0, 0))
    surface = SURFACE.format('nodename="picture"')
    found, warnings = read(tmp_path, IMAGE.format('colorspace="srgb_texture"'), surface)
    assert found.name == "look" and found.base_color == (1, 1, 1) and warnings == ""
    assert found.base_color_texture.image[0, 0] == pytest.approx((SRGB_HALF, 0, 1), abs=1e-5)
    assert (found.metallic, found.roughness, found.ior, found.specular) == (0.0, pytest.approx(0.2), 1.5, 1.0)


def test_the_structure_is_that_of_the_plugin_of_openusd(tmp_path):
    """Stages override the inputs of a material, and bind /MaterialX/Materials."""
    document(tmp_path, SURFACE.format('value="0.1, 0.2, 0.3"'))
    stage = bound("/MaterialX/Materials/look")
    stage.DefinePrim("/MaterialX").GetReferences().AddReference("./look.mtlx")
    over = stage.OverridePrim("/MaterialX/Materials/look")
    over.CreateAttribute("inputs:specular_roughness", TYPES.Float).Set(0.75)
    (found,) = load_scene(saved(stage, tmp_path)).materials
    assert found.base_color == pytest.approx((0.1, 0.2, 0.3)) and found.roughness == 0.75


@pytest.mark.parametrize("name", ["scene.usda", "scene.usdc"])
def test_the_names_of_documents_are_put_back(name, tmp_path):
    document(tmp_path, SURFACE.format('value="0.1, 0.2, 0.3"'))
    path = referring(tmp_path, name=name)
    layer = Sdf.Layer.FindOrOpen(path)
    for _ in range(2):
        assert load_scene(path).materials[0].base_color == pytest.approx((0.1, 0.2, 0.3))
        assert layer.GetCompositionAssetDependencies() == ["./look.mtlx"]


def test_node_graphs_and_prefixes(tmp_path):
    """The file prefix and the colour space of the document, and an interface of the graph."""
    (tmp_path / "maps").mkdir()
    painted(tmp_path / "maps", (128, 128, 128), (0, 0, 0))
    graph = (
        '<nodegraph name="graph"><input name="tint" type="color3" value="0.5, 0.5, 0.5" colorspace="lin_rec709"/>'
        + IMAGE.format("")
        + '<multiply name="both" type="color3"><input name="in1" type="color3" nodename="picture"/>'
        '<input name="in2" type="color3" interfacename="tint"/></multiply>'
        '<output name="result" type="color3" nodename="both"/></nodegraph>'
    )
    surface = SURFACE.format('nodegraph="graph" output="result"')
    found, warnings = read(tmp_path, graph, surface, attributes='colorspace="srgb_texture" fileprefix="maps/"')
    texel = np.multiply(found.base_color_texture.image[0, 0], found.base_color)
    assert texel == pytest.approx((SRGB_HALF / 2,) * 3, abs=1e-5) and warnings == ""


def test_prefixes_that_are_repeated_in_the_name(tmp_path):
    """The plugin of OpenUSD ignores prefixes, so that documents repeat them."""
    (tmp_path / "maps").mkdir()
    painted(tmp_path / "maps", (255, 0, 0), (0, 0, 0))
    image = IMAGE.format("").replace("a.png", "maps/a.png")
    found, warnings = read(tmp_path, image, SURFACE.format('nodename="picture"'), attributes='fileprefix="maps/"')
    assert found.base_color_texture is not None and warnings == ""


def test_documents_include_others(tmp_path):
    (tmp_path / "shared").mkdir()
    painted(tmp_path / "shared", (255, 0, 0), (0, 0, 0))
    (tmp_path / "shared/other.mtlx").write_text(f"{HEAD}>{IMAGE.format('')}</materialx>")
    found, _ = read(tmp_path, '<xi:include href="shared/other.mtlx"/>', SURFACE.format('nodename="picture"'))
    assert found.base_color_texture.image[0, 0] == pytest.approx((1, 0, 0))


def test_missing_documents_are_told(tmp_path):
    found, warnings = read(tmp_path, '<xi:include href="stdlib/gone.mtlx"/>', SURFACE.format('value="0.1, 0.2, 0.3"'))
    assert found.base_color == pytest.approx((0.1, 0.2, 0.3))
    assert "included MaterialX documents that are missing: left out (stdlib/gone.mtlx)" in warnings
    (tmp_path / "look.mtlx").unlink()
    assert "Could not open asset @look.mtlx@" in "\n".join(load_scene(str(tmp_path / "scene.usda")).warnings)


def test_documents_inside_of_packages(tmp_path):
    painted(tmp_path, (255, 0, 0), (0, 0, 0))
    document(tmp_path, IMAGE.format(""), SURFACE.format('nodename="picture"'))
    with Sdf.ZipFileWriter.CreateNew(str(tmp_path / "packed.usdz")) as packed:
        for name in (referring(tmp_path, name="scene.usdc"), str(tmp_path / "look.mtlx"), str(tmp_path / "a.png")):
            packed.AddFile(name, name.rpartition("/")[2])
    for name in ("scene.usdc", "look.mtlx", "a.png"):
        (tmp_path / name).unlink()
    (found,) = load_scene(str(tmp_path / "packed.usdz")).materials
    assert found.base_color_texture.image[0, 0] == pytest.approx((1, 0, 0))


@pytest.mark.parametrize("what", ["document", "include", "texture"])
def test_files_outside_of_the_folder_are_refused(what, tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    painted(tmp_path, (255, 0, 0), (0, 0, 0))
    (tmp_path / "other.mtlx").write_text(f"{HEAD}>{IMAGE.format('')}</materialx>")
    surface = SURFACE.format('nodename="picture"')
    document(tmp_path, IMAGE.format(""), surface)
    if what == "include":
        document(inside, '<xi:include href="../other.mtlx"/>', surface)
    elif what == "texture":
        document(inside, IMAGE.format("").replace("a.png", "../a.png"), surface)
    path = referring(inside, "../look.mtlx" if what == "document" else "./look.mtlx")
    with pytest.raises(BokehguideError, match="lies outside the scene's folder"):
        load_scene(path)
    assert load_scene(path, allow_outside=True).materials[0].base_color_texture is not None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("junk", "not a readable MaterialX document"),
        ("<other/>", "not a readable MaterialX document"),
        ("<materialx>" + "<nodegraph>" * 200 + "</nodegraph>" * 200 + "</materialx>", "elements within each other"),
        (f'{HEAD}><xi:include href="look.mtlx"/></materialx>', "not a readable MaterialX document"),
        (whole(SURFACE.format('value="0.1, 0.2"')), r"coat/base_color: '0.1, 0.2' is no value of the type color3"),
        (whole(SURFACE.format('value="red"')), r"coat/base_color: 'red' is no value of the type color3"),
        (whole(SURFACE.format("").replace("base_color", "0.5")), "invalid name 'inputs:0.5'"),
        (whole(IMAGE.format(""), SURFACE.format('nodename="picture" output="a b"')), "Cannot set connection"),
        (whole(SIZED, SURFACE.format('nodename="picture"')), "picture/realworldimagesize: '2' is no value of the type vector2"),
    ],
)
def test_damaged_documents_are_refused(text, problem, tmp_path):
    (tmp_path / "look.mtlx").write_text(text)
    with pytest.raises(BokehguideError, match=problem) as caught:
        load_scene(referring(tmp_path))
    assert "look.mtlx" in str(caught.value) and "repair it" in str(caught.value)


def test_a_connection_to_an_output_of_its_own_graph_is_left_out(tmp_path):
    graph = (
        '<nodegraph name="graph"><invert name="turned" type="color3"><input name="in" type="color3" nodename="{}"/></invert>'
        '<input name="given" type="color3" value="1, 1, 1"/><output name="result" type="color3" nodename="turned"/></nodegraph>'
    )
    for name in ("result", "given"):
        _, warnings = read(tmp_path, graph.format(name), SURFACE.format('nodegraph="graph" output="result"'))
        assert "connections of MaterialX nodes to missing nodes: left out (graph/turned/in)" in warnings


def test_without_the_package_the_remedy_is_told(tmp_path, monkeypatch):
    document(tmp_path, SURFACE.format('value="0.1, 0.2, 0.3"'))
    monkeypatch.setattr("bokehguide.scene.usd.documents.find_spec", lambda name: None)
    warnings = load_scene(referring(tmp_path)).warnings
    (line,) = [line for line in warnings if "mtlx" in line]
    assert "run pip install 'bokehguide[usd]'" in line and "./look.mtlx" in line


def test_variants_choose_among_documents(tmp_path):
    for name, value in (("one", "0.1, 0.1, 0.1"), ("two", "0.2, 0.2, 0.2")):
        document(tmp_path, SURFACE.format(f'value="{value}"'), name=f"{name}.mtlx")
    stage = bound()
    looks = stage.DefinePrim("/World/Looks")
    variants = looks.GetVariantSets().AddVariantSet("shading")
    for name in ("one", "two"):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            looks.GetReferences().AddReference(f"./{name}.mtlx", "/MaterialX/Materials")
    for name, wanted in (("one", 0.1), ("two", 0.2)):
        variants.SetVariantSelection(name)
        assert load_scene(saved(stage, tmp_path)).materials[0].base_color == pytest.approx((wanted,) * 3)


def test_lengths_of_tiles_have_units(tmp_path):
    painted(tmp_path, (255, 0, 0), (0, 0, 0))
    tiled = (
        '<tiledimage name="picture" type="color3"><input name="file" type="filename" value="a.png"/>'
        '<input name="realworldimagesize" type="vector2" value="0.5, 0.25" unit="foot" unittype="distance"/>'
        '<input name="realworldtilesize" type="vector2" value="0.5, 0.25" unit="inch" unittype="distance"/></tiledimage>'
    )
    found, _ = read(tmp_path, tiled, SURFACE.format('nodename="picture"'))
    a, _, _, _, e, _ = found.base_color_texture.transform
    assert (a, e) == pytest.approx((1 / 12, 1 / 12))


def test_standard_surface(tmp_path):
    found, warnings = Network(
        base=0.5,
        base_color=(0.4, 0.6, 0.8),
        metalness=0.25,
        specular=0.5,
        specular_color=(0.9, 0.8, 0.7),
        specular_IOR=1.7,
        coat=0.5,
        coat_color=(0.5, 1.0, 1.0),
        coat_roughness=0.3,
        sheen=0.5,
        sheen_color=(1.0, 0.5, 0.0),
        sheen_roughness=0.25,
        thin_film_thickness=300.0,
        emission=2.0,
        emission_color=(1.0, 2.0, 3.0),
        opacity=(0.5, 0.5, 0.5),
        diffuse_roughness=0.5,
    ).read(tmp_path)
    assert found.base_color == pytest.approx((0.2 * 0.75, 0.3, 0.4))
    assert (found.metallic, found.specular, found.ior) == pytest.approx((0.25, 0.5, 1.7))
    assert found.specular_color == pytest.approx((0.9, 0.8, 0.7))
    assert (found.clearcoat, found.clearcoat_roughness) == pytest.approx((0.5, 0.3))
    assert found.sheen_color == pytest.approx((0.5, 0.25, 0.0)) and found.sheen_roughness == pytest.approx(0.5)
    assert (found.iridescence, found.iridescence_ior, found.iridescence_thickness[1]) == pytest.approx((1.0, 1.5, 300.0))
    assert found.emission == pytest.approx((2.0, 4.0, 6.0)) and (found.alpha_mode, found.opacity) == ("blend", 0.5)
    assert "diffuse_roughness: left out (look)" in warnings and "specular weights and colours of metals" in warnings


def test_glass_of_standard_surface(tmp_path):
    """The tint at the surface, or that of the medium at a depth in scene units."""
    clear = Network(base_color=(0.1, 0.1, 0.1), transmission=1.0, transmission_color=(0.5, 0.6, 0.7))
    found, _ = clear.read(tmp_path)
    assert found.transmission == 1.0 and not found.thin and found.base_color == pytest.approx((0.5, 0.6, 0.7))
    assert math.isinf(found.attenuation_distance)
    deep = Network(transmission=1.0, transmission_color=(0.5, 0.6, 0.7), transmission_depth=4.0, transmission_dispersion=40.0)
    deep.stage.SetMetadata("metersPerUnit", 0.01)
    found, _ = deep.read(tmp_path)
    assert found.base_color == (1, 1, 1) and found.attenuation_color == pytest.approx((0.5, 0.6, 0.7))
    assert (found.attenuation_distance, found.dispersion) == pytest.approx((0.04, 0.5))
    assert Network(transmission=1.0, thin_walled=True).read(tmp_path)[0].thin


def test_anisotropy(tmp_path):
    """The larger α of a `Material` is α + (1 - α) anisotropy²."""

    def alphas(found):
        least = found.roughness**2
        return least + (1.0 - least) * found.anisotropy**2, least

    found, _ = Network(specular_roughness=0.5, specular_anisotropy=0.75, specular_rotation=0.25).read(tmp_path)
    assert alphas(found) == pytest.approx((0.5, 0.125)) and found.anisotropy_rotation == pytest.approx(-90.0)
    found, _ = Network("open_pbr_surface", specular_roughness=0.5, specular_roughness_anisotropy=0.5).read(tmp_path)
    along = 0.25 * math.sqrt(2.0 / 1.25)
    assert alphas(found) == pytest.approx((along, along / 2.0))
    found, _ = Network("gltf_pbr", roughness=0.5, anisotropy_strength=0.5, anisotropy_rotation=math.pi / 2).read(tmp_path)
    assert (found.roughness, found.anisotropy, found.anisotropy_rotation) == pytest.approx((0.5, 0.5, 90.0))


def test_open_pbr_surface(tmp_path):
    found, warnings = Network(
        "open_pbr_surface",
        base_weight=0.5,
        base_color=(0.4, 0.6, 0.8),
        subsurface_weight=0.5,
        subsurface_color=(1.0, 1.0, 1.0),
        coat_weight=1.0,
        fuzz_weight=0.25,
        thin_film_weight=0.5,
        thin_film_thickness=0.25,
        emission_luminance=3.0,
        geometry_opacity=0.25,
        transmission_dispersion_scale=0.5,
    ).read(tmp_path)
    assert found.base_color == pytest.approx((0.6, 0.65, 0.7)) and found.roughness == pytest.approx(0.3)
    assert (found.clearcoat, found.clearcoat_roughness) == (1.0, 0.0) and found.sheen_color == pytest.approx((0.25,) * 3)
    assert (found.iridescence, found.iridescence_ior) == pytest.approx((0.5, 1.4))
    assert found.iridescence_thickness[1] == pytest.approx(250.0) and found.emission == pytest.approx((3.0,) * 3)
    assert (found.opacity, found.dispersion) == pytest.approx((0.25, 0.5))
    for part in ("subsurface scattering: diffuse reflection of its colour", "refractive indices of coats: 1.5 in their place"):
        assert part in warnings


def test_gltf_pbr(tmp_path):
    found, warnings = Network(
        "gltf_pbr",
        metallic=0.0,
        transmission=1.0,
        thickness=0.1,
        attenuation_color=(0.5, 0.6, 0.7),
        attenuation_distance=2.0,
        sheen_color=(0.1, 0.2, 0.3),
        sheen_roughness=0.25,
        iridescence=0.5,
        iridescence_thickness=200.0,
        emissive=(1.0, 0.5, 0.25),
        emissive_strength=4.0,
        alpha=0.5,
        alpha_mode=1,
        alpha_cutoff=0.25,
        dispersion=0.3,
    ).read(tmp_path)
    assert (found.roughness, found.transmission, found.thin, found.attenuation_distance) == (1.0, 1.0, False, 2.0)
    assert found.sheen_roughness == 0.25 and found.iridescence_thickness[1] == pytest.approx(200.0)
    assert found.emission == pytest.approx((4.0, 2.0, 1.0)) and found.dispersion == pytest.approx(0.3) and warnings == ""
    assert (found.alpha_mode, found.alpha_cutoff, found.opacity) == ("mask", 0.25, 0.5)
    assert Network("gltf_pbr", alpha=0.5).read(tmp_path)[0].alpha_mode == "opaque"


@pytest.mark.parametrize("kind", ["normalmap", "normalmap_float", "gltf_normalmap_vector3_1_0", "UsdUVTexture"])
def test_normal_maps_keep_their_texels(kind, tmp_path):
    painted(tmp_path, (128, 200, 255), (0, 0, 0))
    network = Network()
    if kind == "gltf_normalmap_vector3_1_0":
        normal, scale = network.output("normal", f"ND_{kind}", file="./a.png"), 1.0
    elif kind == "UsdUVTexture":
        image = network.node("normal", f"ND_{kind}", file="./a.png")
        image.CreateInput("scale", TYPES.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        image.CreateInput("bias", TYPES.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        normal, scale = image.CreateOutput("rgb", TYPES.Float3), 1.0
    else:
        texels = network.output("image", "ND_image_vector3", file="./a.png")
        normal, scale = network.output("normal", f"ND_{kind}", **{"in": texels, "scale": 0.5}), 0.5
    network.feed(normal=normal, coat_normal=normal)
    network.surface.CreateInput("coat", TYPES.Float).Set(1.0)
    found, warnings = network.read(tmp_path)
    assert found.normal_texture.image[0, 0] * 255 == pytest.approx((128, 200, 255), abs=1e-2) and warnings == ""
    assert found.clearcoat_normal_texture is not None
    assert (found.normal_scale, found.clearcoat_normal_scale) == (scale, scale)


def test_channels_of_images(tmp_path):
    painted(tmp_path, (10, 20, 30), (40, 50, 60))
    network = Network()
    orm = network.output("orm", "ND_image_vector3", file="./a.png")
    network.feed(
        specular_roughness=network.output("rough", "ND_extract_vector3", **{"in": orm, "index": 1}),
        metalness=network.output("metal", "ND_separate3_vector3", "outz", **{"in": orm}),
        coat=network.output("red", "ND_separate3_vector3", "outx", **{"in": orm}),
        transmission=network.output("clear", "ND_image_float", file="./a.png"),
        sheen=network.output("sheen_weight", "ND_image_float", file="./a.png"),
    )
    found, _ = network.read(tmp_path)
    assert (found.roughness, found.metallic, found.clearcoat) == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(found.metallic_roughness_texture.image[0, :, 1:] * 255, [(20, 30), (50, 60)], atol=1e-3)
    assert found.clearcoat_texture.image[0, 0, 0] * 255 == pytest.approx(10)
    assert found.transmission_texture.image[0, 1, 0] * 255 == pytest.approx(40)
    assert found.sheen_color_texture.image[0, 0] * 255 == pytest.approx((10,) * 3)


@pytest.mark.parametrize(
    ("kind", "inputs", "wanted"),
    [
        ("multiply_color3", {"in1": "image", "in2": (0.5, 1.0, 0.0)}, (0.25, 1.0, 0.0)),
        ("multiply_color3FA", {"in1": "image", "in2": 0.5}, (0.25, 0.5, 0.0)),
        ("multiply_color3", {"in1": "image", "in2": "image"}, (0.25, 1.0, 0.0)),
        ("divide_color3FA", {"in1": "image", "in2": 2.0}, (0.25, 0.5, 0.0)),
        ("add_color3FA", {"in1": "image", "in2": 0.25}, (0.75, 1.0, 0.25)),
        ("subtract_color3FA", {"in1": "image", "in2": 0.25}, (0.25, 0.75, 0.0)),
        ("invert_color3", {"in": "image"}, (0.5, 0.0, 1.0)),
        ("power_color3FA", {"in1": "image", "in2": 2.0}, (0.25, 1.0, 0.0)),
        ("clamp_color3FA", {"in": "image", "low": 0.25, "high": 0.75}, (0.5, 0.75, 0.25)),
        ("mix_color3", {"fg": "image", "bg": (1.0, 1.0, 1.0), "mix": 0.25}, (0.875, 1.0, 0.75)),
        ("dot_color3", {"in": "image"}, (0.5, 1.0, 0.0)),
        ("convert_vector3_color3", {"in": "image"}, (0.5, 1.0, 0.0)),
    ],
)
def test_arithmetic_with_images_and_constants(kind, inputs, wanted, tmp_path):
    painted(tmp_path, (128, 255, 0), (0, 0, 0))
    network = Network()
    image = network.output("image", "ND_image_vector3", file="./a.png")
    given = {key: image if value == "image" else value for key, value in inputs.items()}
    network.feed(base_color=network.output("result", f"ND_{kind}", **given))
    found, warnings = network.read(tmp_path)
    assert np.multiply(found.base_color_texture.image[0, 0], found.base_color) == pytest.approx(wanted, abs=5e-3)
    assert warnings == ""


def test_constant_nodes(tmp_path):
    network = Network()
    number = network.output("number", "ND_constant_float", value=0.5)
    network.feed(
        specular_roughness=number,
        base_color=network.output("grey", "ND_convert_float_color3", **{"in": number}),
    )
    found, _ = network.read(tmp_path)
    assert found.roughness == 0.5 and found.base_color == pytest.approx((0.5,) * 3)


@pytest.mark.parametrize(
    ("space", "wanted"),
    [
        ("srgb_texture", (SRGB_HALF, 1, 0)),
        ("lin_rec709", (128 / 255, 1, 0)),
        ("g22_rec709", ((128 / 255) ** 2.2, 1, 0)),
        ("acescg", (0.2341, 1.0, 0.0)),
        (None, (SRGB_HALF, 1, 0)),
    ],
)
def test_color_spaces(space, wanted, tmp_path):
    painted(tmp_path, (128, 255, 0), (0, 0, 0))
    network = Network()
    image = network.node("image", "ND_image_color3", file="./a.png")
    constant = network.surface.CreateInput("specular_color", TYPES.Color3f)
    constant.Set(Gf.Vec3f(128 / 255, 1.0, 0.0))
    for attribute in (image.GetInput("file").GetAttr(), constant.GetAttr()) if space else ():
        attribute.SetColorSpace(space)
    network.feed(base_color=image.CreateOutput("out", TYPES.Color3f))
    found, _ = network.read(tmp_path)
    assert found.base_color_texture.image[0, 0] == pytest.approx(wanted, abs=1e-3)
    assert space is None or np.clip(found.specular_color, 0, 1) == pytest.approx(wanted, abs=1e-3)


def test_unknown_color_spaces_are_told(tmp_path):
    painted(tmp_path, (128, 255, 0), (0, 0, 0))
    network = Network()
    image = network.node("image", "ND_image_color3", file="./a.png")
    image.GetInput("file").GetAttr().SetColorSpace("lin_displayp3")
    network.feed(base_color=image.CreateOutput("out", TYPES.Color3f))
    found, warnings = network.read(tmp_path)
    assert found.base_color_texture.image[0, 0, 0] == pytest.approx(128 / 255)
    assert "colour space lin_displayp3: lin_rec709 in its place" in warnings


def test_texture_coordinates(tmp_path):
    """The graph of place2d in MaterialX: minus the pivot, by the scale, turned clockwise, minus the offset, plus the pivot."""
    painted(tmp_path, (1, 2, 3), (4, 5, 6))
    network = Network()
    add_primvar(network.stage.GetPrimAtPath("/World/mesh"), "other", TYPES.TexCoord2fArray, [Gf.Vec2f(0, 0)] * 4, "vertex")
    reader = network.output("reader", "ND_geompropvalue_vector2", geomprop="other")
    place = {"pivot": (0.5, 0.25), "scale": (2.0, 4.0), "rotate": 30.0, "offset": (0.1, 0.2)}
    placed = network.output("place", "ND_place2d_vector2", texcoord=reader, **place)
    image = network.output(
        "image", "ND_tiledimage_color3", file="./a.png", texcoord=placed, uvtiling=(3.0, 2.0), uvoffset=(0.3, 0.4)
    )
    network.feed(base_color=image)
    scene = load_scene(saved(network.stage, tmp_path))
    assert scene.warnings == () and scene.meshes[0].uvs.max() <= 1.0
    a, b, c, d, e, f = scene.materials[0].base_color_texture.transform
    sin, cos = math.sin(math.radians(30)), math.cos(math.radians(30))
    for s, t in ((0.0, 0.0), (0.3, 0.8), (1.0, 0.2)):
        x, y = (s - 0.5) / 2, (t - 0.25) / 4
        x, y = cos * x + sin * y - 0.1 + 0.5, -sin * x + cos * y - 0.2 + 0.25
        x, y = x * 3 - 0.3, y * 2 - 0.4
        assert (a * s + b * (1 - t) + c, 1 - (d * s + e * (1 - t) + f)) == pytest.approx((x, y))


def test_transforms_and_addressing_of_gltf_images(tmp_path):
    """KHR_texture_transform moves and scales from the top left corner."""
    painted(tmp_path, (1, 2, 3), (4, 5, 6))
    network = Network("gltf_pbr")
    place = {"scale": (2.0, 4.0), "offset": (0.1, 0.2), "uaddressmode": "clamp", "vaddressmode": "mirror"}
    place["factor"] = (0.5, 1.0, 1.0)
    network.feed(base_color=network.output("image", "ND_gltf_image_color3_color3_1_0", file="./a.png", **place))
    found, _ = network.read(tmp_path)
    assert found.base_color_texture.transform == pytest.approx((2, 0, 0.1, 0, 4, 0.2))
    assert found.base_color_texture.wrap == ("clamp", "mirror") and found.base_color == (0.5, 1, 1)


def test_vertex_colors(tmp_path):
    network = Network()
    add_primvar(network.stage.GetPrimAtPath("/World/mesh"), "paint", TYPES.Color3fArray, [Gf.Vec3f(0.1, 0.2, 0.3)] * 4, "vertex")
    network.feed(base_color=network.output("reader", "ND_geompropvalue_color3", geomprop="paint"))
    scene = load_scene(saved(network.stage, tmp_path))
    assert scene.meshes[0].colors[0] == pytest.approx((0.1, 0.2, 0.3, 1.0)) and scene.materials[0].base_color == (1, 1, 1)


def test_what_is_lost_is_told(tmp_path):
    painted(tmp_path, (1, 2, 3), (4, 5, 6))
    network = Network()
    network.feed(
        base_color=network.output("noise", "ND_noise2d_color3"),
        specular_IOR=network.output("image", "ND_image_float", file="./a.png"),
        metalness=network.output("gone", "ND_image_float", file="./gone.png"),
        normal=network.output("bump", "ND_bump_vector3"),
    )
    height = network.output("height", "ND_displacement_float", displacement=0.1)
    network.material.CreateDisplacementOutput("mtlx").ConnectToSource(height)
    found, warnings = network.read(tmp_path)
    assert found.base_color == pytest.approx((0.8,) * 3) and (found.ior, found.metallic) == (1.5, 0.0)
    for part in (
        "nodes of the type ND_noise2d_color3: the default of the input in their place (/World/look/noise)",
        "textures of specular_IOR: 1.5 in their place (look)",
        "missing textures: left out (./gone.png)",
        "nodes of the type ND_bump_vector3 at normal: left out",
        "displacement: left out (look)",
    ):
        assert part in warnings


def test_nodes_that_lead_to_themselves_and_long_chains(tmp_path):
    network = Network()
    first, second = (network.node(name, "ND_dot_color3") for name in ("first", "second"))
    for node, source in ((first, second), (second, first)):
        node.CreateInput("in", TYPES.Color3f).ConnectToSource(source.CreateOutput("out", TYPES.Color3f))
    last = network.output("n0", "ND_constant_float", value=0.5)
    for number in range(1, 500):
        last = network.output(f"n{number}", "ND_add_float", in1=last, in2=last)
    network.feed(base_color=first.GetOutput("out"), specular_roughness=last)
    found, warnings = network.read(tmp_path)
    assert found.base_color == pytest.approx((0.8,) * 3) and "chains of more than 64 nodes: left out" in warnings


def test_preview_surfaces_with_nodes_of_materialx(tmp_path):
    painted(tmp_path, (128, 255, 0), (0, 0, 0))
    network = Network("UsdPreviewSurface", ior=1.7)
    image = network.output("image", "ND_image_vector3", file="./a.png")
    network.feed(
        diffuseColor=network.output("half", "ND_multiply_vector3FA", in1=image, in2=0.5),
        roughness=network.output("number", "ND_constant_float", value=0.25),
        normal=network.output("normal", "ND_normalmap", **{"in": image}),
    )
    found, warnings = network.read(tmp_path)
    assert found.base_color_texture.image[0, 0] == pytest.approx((64 / 255, 0.5, 0.0), abs=1e-5)
    assert (found.roughness, found.ior) == pytest.approx((0.25, 1.7)) and found.normal_texture is not None and warnings == ""


def test_the_surface_of_materialx_comes_before_that_for_all_renderers(tmp_path):
    network = Network(base_color=(0.1, 0.2, 0.3))
    preview = network.node("preview", "UsdPreviewSurface", diffuseColor=(0.9, 0.9, 0.9))
    network.material.CreateSurfaceOutput().ConnectToSource(preview.CreateOutput("surface", TYPES.Token))
    assert network.read(tmp_path)[0].base_color == pytest.approx((0.1, 0.2, 0.3))
    network.surface.SetShaderId("ND_lama_surface")
    assert network.read(tmp_path)[0].base_color == pytest.approx((0.9,) * 3)


def test_the_color_of_a_coat_tints_the_base(tmp_path):
    painted(tmp_path, (128, 255, 0), (0, 0, 0))
    network = Network(base_color=(0.5, 1.0, 1.0), metalness=1.0, coat=1.0)
    network.feed(coat_color=network.output("image", "ND_image_vector3", file="./a.png"))
    found, _ = network.read(tmp_path)
    texel = np.multiply(found.base_color_texture.image[0, 0], found.base_color)
    assert texel == pytest.approx((64 / 255, 1.0, 0.0), abs=1e-5) and found.clearcoat == 1.0
