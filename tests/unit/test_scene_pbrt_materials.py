"""Materials and textures of pbrt-v4 in the terms of glTF's model."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from bokehguide.color import srgb_to_linear
from bokehguide.errors import BokehguideError
from bokehguide.render.textures import TextureAtlas
from bokehguide.scene import load_scene
from bokehguide.scene.anisotropy import to_alphas
from bokehguide.scene.pbrt.materials import internal_reflectance
from bokehguide.scene.types import Material, Scene, Texture

HEAD = 'Camera "perspective"\nWorldBegin\n'


def read(folder, body: str) -> Scene:
    (folder / "scene.pbrt").write_text(HEAD + body)
    return load_scene(str(folder / "scene.pbrt"))


def material(folder, text: str, before: str = "", shape: str = 'Shape "sphere"') -> Material:
    scene = read(folder, f"{before}\nMaterial {text}\n{shape}\n")
    return scene.materials[scene.meshes[0].material]


def test_diffuse(tmp_path):
    found = material(tmp_path, '"diffuse"')
    assert (found.base_color, found.specular, found.metallic) == ((0.5, 0.5, 0.5), 0.0, 0.0)
    assert material(tmp_path, '"diffuse" "rgb reflectance" [0.1 0.2 0.3]').base_color == (0.1, 0.2, 0.3)
    spectrum = '"diffuse" "spectrum reflectance" [360 0.4 830 0.4]'
    assert material(tmp_path, spectrum).base_color == pytest.approx((0.4, 0.4, 0.4), abs=1e-3)
    red = material(tmp_path, '"diffuse" "spectrum reflectance" [360 0 590 0 600 1 830 1]').base_color
    assert red[0] > 0.8 and red[2] < 0.05
    default = read(tmp_path, 'Shape "sphere"')
    assert default.materials[0].base_color == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(("remap", "alpha"), [("", math.sqrt(0.25)), ('"bool remaproughness" false', 0.25)])
def test_roughness(tmp_path, remap, alpha):
    """The square of glTF's roughness is α; that of pbrt is α², unless it is not remapped."""
    for kind in ("conductor", "dielectric", "coateddiffuse"):
        assert material(tmp_path, f'"{kind}" "float roughness" 0.25 {remap}').roughness ** 2 == pytest.approx(alpha)
    both = material(tmp_path, f'"conductor" "float uroughness" 0.25 "float vroughness" 0.25 {remap}')
    assert both.roughness**2 == pytest.approx(alpha)


def test_reflectances_above_1_are_told(tmp_path):
    scene = read(tmp_path, 'Material "diffuse" "rgb reflectance" [2 0.5 0.1]\nShape "sphere"\n')
    assert "reflectances above 1: 1 in their place (diffuse)" in "\n".join(scene.warnings)
    assert scene.materials[scene.meshes[0].material].base_color == (1.0, 0.5, 0.1)
    scene = read(tmp_path, 'Material "diffuse" "rgb reflectance" [1 0.5 0.1]\nShape "sphere"\n')
    assert "reflectances" not in "\n".join(scene.warnings)


def test_materials_of_older_versions_name_the_converter(tmp_path):
    with pytest.raises(BokehguideError, match="'matte': unknown in pbrt-v4; convert the file with pbrt --upgrade"):
        material(tmp_path, '"matte"')
    with pytest.raises(BokehguideError, match="did you mean 'diffuse'"):
        material(tmp_path, '"difuse"')


def test_metals(tmp_path):
    """Named metals against a spectrum of the same η and k, and copper as the default."""
    gold = material(tmp_path, '"conductor" "spectrum eta" "metal-Au-eta" "spectrum k" "metal-Au-k"')
    assert gold.metallic == 1.0 and gold.base_color == pytest.approx((1.0, 0.78, 0.34), abs=0.01)
    assert material(tmp_path, '"conductor"').base_color == pytest.approx((0.955, 0.638, 0.538), abs=0.01)
    flat = material(tmp_path, '"conductor" "spectrum eta" [360 1.5 830 1.5] "spectrum k" [360 2 830 2]')
    assert flat.base_color == pytest.approx((4.25 / 10.25,) * 3, abs=1e-3)
    colored = material(tmp_path, '"conductor" "rgb eta" [1.5 1 0.2] "rgb k" [2 0 3]').base_color
    assert colored == pytest.approx((4.25 / 10.25, 0.0, 9.64 / 10.44), abs=1e-6)
    assert material(tmp_path, '"conductor" "rgb reflectance" [0.9 0.8 0.7]').base_color == (0.9, 0.8, 0.7)
    coated = material(tmp_path, '"coatedconductor" "float interface.roughness" 0.0016 "float conductor.roughness" 0.01')
    assert (coated.clearcoat, coated.metallic) == (1.0, 1.0)
    assert coated.single_scattering and gold.single_scattering
    assert (coated.clearcoat_roughness**2, coated.roughness**2) == pytest.approx((0.04, 0.1))


def test_glass(tmp_path):
    glass = material(tmp_path, '"dielectric"')
    assert (glass.transmission, glass.ior, glass.roughness, glass.thin) == (1.0, 1.5, 0.0, False)
    assert material(tmp_path, '"dielectric" "float eta" 1.33').ior == 1.33
    assert material(tmp_path, '"dielectric" "spectrum eta" "glass-BK7"').ior == pytest.approx(1.5168, abs=2e-3)
    thin = material(tmp_path, '"thindielectric" "float eta" 1.4')
    assert (thin.transmission, thin.ior, thin.thin) == (1.0, 1.4, True)


def test_the_denser_medium_in_front(tmp_path):
    """A sphere of air in water, seen from the water, is a sphere of index 4/3 turned inside out."""
    scene = read(tmp_path, 'Material "dielectric" "float eta" 0.75\nShape "sphere"\nMaterial "dielectric"\nShape "sphere"\n')
    assert [scene.materials[mesh.material].ior for mesh in scene.meshes] == pytest.approx([4.0 / 3.0, 1.5])
    for mesh, side in zip(scene.meshes, (-1.0, 1.0)):
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
        facing = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1)
        assert (side * facing[np.abs(facing) > 1e-6] > 0.0).all()


def test_coated_diffuse_surfaces_keep_light_inside(tmp_path):
    """The share of diffuse light that a boundary of index 1.5 reflects inside is 0.596 (Judd 1942)."""
    assert internal_reflectance(1.5) == pytest.approx(0.596, abs=2e-3)
    assert internal_reflectance(1.0) == pytest.approx(0.0, abs=1e-9)
    found = material(tmp_path, '"coateddiffuse" "rgb reflectance" [1 0.5 0]')
    assert found.base_color == pytest.approx((1.0, 0.5 * 0.404 / (1.0 - 0.298), 0.0), abs=3e-3)
    assert found.ior == 1.5 and found.specular == 1.0


def test_mixtures_and_named_materials(tmp_path):
    parts = (
        'MakeNamedMaterial "a" "string type" "diffuse" "rgb reflectance" [1 0 0]\n'
        'MakeNamedMaterial "b" "string type" "conductor"\n'
    )
    assert material(tmp_path, '"mix" "string materials" ["a" "b"] "float amount" 0.3', parts).base_color == (1.0, 0.0, 0.0)
    assert material(tmp_path, '"mix" "string materials" ["a" "b"] "float amount" 1', parts).metallic == 1.0
    loop = 'MakeNamedMaterial "c" "string type" "mix" "string materials" ["c" "c"]\nNamedMaterial "c"\nShape "sphere"'
    with pytest.raises(Exception, match="refer to each other"):
        read(tmp_path, loop)
    scene = read(tmp_path, parts + 'NamedMaterial "a"\nShape "sphere"\nShape "disk"\nNamedMaterial "b"\nShape "sphere"\n')
    assert [mesh.material for mesh in scene.meshes] == [0, 0, 1]


def test_substitutes_are_told(tmp_path):
    scene = read(
        tmp_path,
        'Material "hair"\nShape "sphere"\nMaterial "measured" "string filename" "x.bsdf"\nShape "sphere"\n'
        'Material "subsurface"\nShape "sphere"\nMaterial "diffusetransmission"\nShape "disk"\n'
        'Material "interface"\nShape "sphere"\n'
        'Shape "heightfield"\n',
    )
    assert len(scene.meshes) == 4
    assert [line.removeprefix("scene.pbrt: ") for line in scene.warnings] == [
        "material hair: a diffuse surface in its place (hair)",
        "material measured: a diffuse surface in its place (measured)",
        "subsurface scattering: a coated diffuse surface in its place (subsurface)",
        "shapes of the type heightfield: left out (scene.pbrt:13)",
    ]
    leaf = scene.materials[scene.meshes[3].material]
    assert (leaf.base_color, leaf.diffuse_transmission, leaf.transmission) == ((0.5, 0.5, 0.5), 0.5, 0.0)


def test_diffuse_transmission_keeps_reflectance_and_transmittance(tmp_path):
    given = '"rgb reflectance" [0.3 0.2 0.1] "rgb transmittance" [0.2 0.6 0.4] "float scale" 0.5'
    leaf = read(tmp_path, f'Material "diffusetransmission" {given}\nShape "disk"').materials[0]
    share = leaf.diffuse_transmission
    np.testing.assert_allclose(np.multiply(leaf.base_color, 1.0 - share), [0.15, 0.1, 0.05], rtol=1e-3)
    np.testing.assert_allclose(np.multiply(leaf.diffuse_transmission_color, share), [0.1, 0.3, 0.2], rtol=1e-3)


def color_at(texture: Texture, u: float, v: float) -> np.ndarray:
    """The texture of a mesh at pbrt's (u, v), v upwards, by the renderer's own lookup."""
    atlas = TextureAtlas()
    number = atlas.add(texture)
    built = atlas.build(torch.device("cpu"))
    return built.lookup(torch.tensor([number]), torch.tensor([[u], [1.0 - v]]))[:3, 0].numpy()


PICTURE = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [128, 128, 128]]], np.uint8)


def textured(folder, parameters: str, kind: str = "imagemap") -> Texture:
    Image.fromarray(PICTURE).save(folder / "a.png")
    before = f'Texture "t" "spectrum" "{kind}" {parameters}'
    found = material(folder, '"diffuse" "texture reflectance" "t"', before).base_color_texture
    assert found is not None
    return found


def test_image_maps(tmp_path):
    """The first row of the file is at v = 1; colours are sRGB, scaled, then inverted."""
    texture = textured(tmp_path, '"string filename" "a.png"')
    np.testing.assert_allclose(color_at(texture, 0.25, 0.75), (1, 0, 0), atol=2e-3)
    np.testing.assert_allclose(color_at(texture, 0.25, 0.25), (0, 0, 1), atol=2e-3)
    grey = float(srgb_to_linear(np.array(128 / 255)))
    np.testing.assert_allclose(color_at(texture, 0.75, 0.25), (grey,) * 3, atol=2e-3)
    linear = textured(tmp_path, '"string filename" "a.png" "string encoding" "linear" "float scale" 0.5')
    np.testing.assert_allclose(color_at(linear, 0.75, 0.25), (64 / 255,) * 3, atol=2e-3)
    inverted = textured(tmp_path, '"string filename" "a.png" "string encoding" "gamma 2" "float scale" 0.5 "bool invert" true')
    np.testing.assert_allclose(color_at(inverted, 0.75, 0.25), (1.0 - 0.5 * (128 / 255) ** 2,) * 3, atol=2e-3)
    moved = textured(
        tmp_path, '"string filename" "a.png" "float uscale" 2 "float vscale" 2 "float udelta" 0.5 "float vdelta" 0.25'
    )
    plain = textured(tmp_path, '"string filename" "a.png"')
    for u, v in ((0.1, 0.3), (0.45, 0.2), (0.9, 0.6)):
        np.testing.assert_allclose(color_at(moved, u, v), color_at(plain, 2 * u + 0.5, 2 * v + 0.25), atol=2e-3)
    assert textured(tmp_path, '"string filename" "a.png" "string wrap" "clamp"').wrap == ("clamp", "clamp")


def test_computed_textures(tmp_path):
    checks = textured(tmp_path, '"rgb tex1" [1 0 0] "rgb tex2" [0 0 1] "float uscale" 4 "float vscale" 2', "checkerboard")
    for u, v in ((0.1, 0.1), (0.3, 0.1), (0.3, 0.7), (0.9, 0.6), (0.6, 0.2)):
        first = (math.floor(4 * u) + math.floor(2 * v)) % 2 == 0
        np.testing.assert_allclose(color_at(checks, u, v), (1, 0, 0) if first else (0, 0, 1), atol=2e-3)
    Image.fromarray(PICTURE).save(tmp_path / "a.png")
    before = 'Texture "i" "spectrum" "imagemap" "string filename" "a.png"\n'
    before += 'Texture "m" "spectrum" "mix" "rgb tex1" [0 1 0] "texture tex2" "i" "float amount" 0.25\n'
    before += 'Texture "t" "spectrum" "scale" "texture tex" "m" "float scale" 0.5\n'
    mixed = material(tmp_path, '"diffuse" "texture reflectance" "t"', before).base_color_texture
    assert mixed is not None
    np.testing.assert_allclose(color_at(mixed, 0.25, 0.75), (0.125, 0.375, 0), atol=2e-3)
    constant = 'Texture "c" "spectrum" "constant" "rgb value" [0.2 0.4 0.6]\nTexture "t" "spectrum" "mix" "texture tex1" "c" '
    found = material(tmp_path, '"diffuse" "texture reflectance" "t"', constant + '"rgb tex2" [1 1 1]')
    assert found.base_color == pytest.approx((0.6, 0.7, 0.8)) and found.base_color_texture is None
    lost = read(tmp_path, 'Texture "t" "spectrum" "marble"\nMaterial "diffuse" "texture reflectance" "t"\nShape "sphere"')
    assert lost.warnings == ("scene.pbrt: texture marble: grey in its place (scene.pbrt:3)",)


def test_maps_of_roughness_normals_and_opacity(tmp_path):
    Image.fromarray(PICTURE).save(tmp_path / "a.png")
    before = 'Texture "f" "float" "imagemap" "string filename" "a.png" "string encoding" "linear"'
    rough = material(tmp_path, '"conductor" "texture roughness" "f" "string normalmap" "a.png"', before)
    assert rough.metallic_roughness_texture is not None and rough.normal_texture is not None
    np.testing.assert_allclose(rough.metallic_roughness_texture.image[1, 1, 1], (128 / 255) ** 0.25, rtol=1e-5)
    np.testing.assert_allclose(rough.metallic_roughness_texture.image[..., 2], 1.0)
    np.testing.assert_allclose(rough.normal_texture.image, PICTURE / 255.0, rtol=1e-5)
    veil = material(tmp_path, '"diffuse" "rgb reflectance" [0.2 0.4 0.6]', before, 'Shape "disk" "texture alpha" "f"')
    assert veil.alpha_mode == "blend" and veil.base_color == (0.2, 0.4, 0.6)
    assert veil.base_color_texture is not None
    np.testing.assert_allclose(veil.base_color_texture.image[1, 1], (1, 1, 1, 128 / 255), rtol=1e-5)
    glazed = material(tmp_path, '"diffuse"', "", 'Shape "disk" "float alpha" 0.25')
    assert (glazed.alpha_mode, glazed.opacity) == ("blend", 0.25)
    assert len(read(tmp_path, 'Shape "disk" "float alpha" 0\nShape "sphere"').meshes) == 1


def test_the_same_scene_in_toml(tmp_path):
    """A pbrt scene with a right-handed world, and the same scene as a TOML file."""
    (tmp_path / "scene.pbrt").write_text(
        "Scale -1 1 1\nLookAt 1 2 5 0 0.5 0 0 1 0\n"
        'Camera "perspective" "float fov" 30 "float lensradius" 0.1 "float focaldistance" 4\n'
        'Film "rgb" "integer xresolution" 64 "integer yresolution" 64\nIntegrator "path" "integer maxdepth" 3\nWorldBegin\n'
        'LightSource "infinite" "rgb L" [0.1 0.2 0.3]\nMaterial "diffuse" "rgb reflectance" [0.5 0.25 0.125]\n'
        'Shape "bilinearmesh" "point3 P" [-1 -1 0 1 -1 0 -1 1 0 1 1 0]\n'
    )
    (tmp_path / "scene.toml").write_text(
        "[camera]\nposition = [1.0, 2.0, 5.0]\ntarget = [0.0, 0.5, 0.0]\n"
        "fov = 30.0\naperture_radius = 0.1\nfocus_distance = 4.0\n"
        "[film]\nwidth = 64\nheight = 64\nmax_depth = 4\n[environment]\ncolor = [0.1, 0.2, 0.3]\n"
        "[materials.wall]\nbase_color = [0.5, 0.25, 0.125]\nspecular = 0.0\n"
        '[[object]]\nshape = "rectangle"\nmaterial = "wall"\n'
    )
    ours, theirs = (load_scene(str(tmp_path / name)) for name in ("scene.pbrt", "scene.toml"))
    assert ours.film == theirs.film
    camera, wanted = ours.camera, theirs.camera
    assert camera.position == pytest.approx(wanted.position) and camera.fov == pytest.approx(wanted.fov)
    assert (camera.aperture_radius, camera.focus_distance) == pytest.approx((wanted.aperture_radius, wanted.focus_distance))
    towards = [np.subtract(each.target, each.position) for each in (camera, wanted)]
    np.testing.assert_allclose(*(each / np.linalg.norm(each) for each in towards), atol=1e-6)
    assert ours.environment is not None and theirs.environment is not None
    np.testing.assert_array_equal(ours.environment.radiance, theirs.environment.radiance)
    for first, second in zip(ours.meshes, theirs.meshes, strict=True):
        corners = [mesh.vertices[mesh.triangles] for mesh in (first, second)]
        np.testing.assert_array_equal(*(np.sort(each.reshape(-1, 3), axis=0) for each in corners))
        np.testing.assert_array_equal(*(np.sign(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])) for c in corners))
        one, other = (scene.materials[mesh.material] for scene, mesh in ((ours, first), (theirs, second)))
        assert (one.base_color, one.specular, one.roughness) == (other.base_color, other.specular, other.roughness)


@pytest.mark.parametrize("u, v, rotation", [(0.25, 0.04, 0.0), (0.04, 0.25, 90.0), (0.09, 0.09, 0.0)])
def test_anisotropic_roughness_is_kept(tmp_path, u, v, rotation):
    """pbrt's α is the square root of its roughness; the larger α lies along u, or along v after a quarter turn."""
    rough = f'"float uroughness" {u} "float vroughness" {v}'
    scene = read(tmp_path, f'Material "conductor" {rough}\nShape "sphere"\nMaterial "dielectric" {rough}\nShape "sphere"')
    metal, glass = scene.materials
    most, least = to_alphas(metal.roughness, metal.anisotropy)
    np.testing.assert_allclose((most, least), (max(u, v) ** 0.5, min(u, v) ** 0.5), rtol=1e-6)
    assert metal.anisotropy_rotation == rotation and glass.anisotropy == 0.0
    assert any("anisotropic roughness of dielectrics" in line for line in scene.warnings) == (u != v)


def older(folder, text: str, before: str = "", shape: str = 'Shape "sphere"') -> Material:
    """A material of pbrt-v3."""
    return material(folder, text, before, f"{shape}\nWorldEnd")


def alpha_of(roughness: float) -> float:
    """pbrt-v3's `TrowbridgeReitzDistribution::RoughnessToAlpha`."""
    x = math.log(max(roughness, 1e-3))
    return 1.62142 + 0.819955 * x + 0.1734 * x**2 + 0.0171201 * x**3 + 0.000640711 * x**4


OLDER = {
    '"matte"': {"base_color": (0.5, 0.5, 0.5), "specular": 0.0},
    '"none"': {"emission": (1.0, 1.0, 1.0), "specular": 0.0},
    '"plastic"': {"base_color": (0.25,) * 3, "specular_color": (0.25,) * 3, "roughness": math.sqrt(alpha_of(0.1))},
    '"plastic" "float roughness" 0.04 "bool remaproughness" "false"': {"roughness": 0.2},
    '"substrate" "rgb Ks" [0.04 0.08 1]': {"base_color": (0.5,) * 3, "specular_color": (1.0, 2.0, 25.0), "ior": 1.5},
    '"metal"': {"base_color": (0.9553, 0.6376, 0.5382), "metallic": 1.0, "roughness": math.sqrt(alpha_of(0.01))},
    '"metal" "spectrum eta" "spds/Au.eta.spd" "spectrum k" "spds/Au.k.spd"': {"base_color": (1.0, 0.7825, 0.3434)},
    '"mirror"': {"base_color": (0.9,) * 3, "metallic": 1.0, "roughness": 0.0},
    '"shinymetal" "color Ks" [0.1 0.2 0.3]': {"base_color": (0.1, 0.2, 0.3), "metallic": 1.0},
    '"glass" "rgb Kt" [0.1 0.2 0.3] "float index" 1.7': {"base_color": (0.1, 0.2, 0.3), "transmission": 1.0, "ior": 1.7},
    '"glass" "float eta" 1.6 "float uroughness" 0.3 "float vroughness" 0.3': {"roughness": math.sqrt(alpha_of(0.3)), "ior": 1.6},
    '"uber" "rgb opacity" [0.5 0.5 0.5]': {"alpha_mode": "blend", "opacity": 0.5, "specular_color": (0.25,) * 3},
    '"uber" "rgb Kr" [0.5 0.5 0.5] "rgb Ks" [0 0 0]': {"roughness": 0.0, "specular_color": (0.5,) * 3},
    '"uber" "rgb Kd" [0.1 0.1 0.1] "rgb Kt" [0.3 0.3 0.3]': {"base_color": (0.4,) * 3, "transmission": 0.75},
    '"translucent" "rgb Kd" [0.8 0.4 0.8]': {"base_color": (0.8, 0.4, 0.8), "diffuse_transmission": 0.5},
    '"kdsubsurface" "rgb Kd" [0.1 0.2 0.3]': {"base_color": (0.1, 0.2, 0.3), "ior": 1.33},
    '"hair" "rgb color" [0.1 0.2 0.3]': {"base_color": (0.1, 0.2, 0.3)},
    '"disney" "rgb color" [0.1 0.2 0.3] "float metallic" 0.5 "float clearcoat" 1': {
        "base_color": (0.1, 0.2, 0.3),
        "metallic": 0.5,
        "roughness": 0.5,
        "clearcoat": 0.25,
    },
    '"velvet" "rgb Kd" [0.1 0.2 0.3]': {"base_color": (0.1, 0.2, 0.3)},
    '"matte" "xyz Kd" [0.4124 0.2126 0.0193]': {"base_color": (1.0, 0.0, 0.0)},
}


@pytest.mark.parametrize("text", OLDER)
def test_materials_of_pbrt_v3(tmp_path, text):
    found = older(tmp_path, text, shape='AreaLightSource "diffuse"\nShape "sphere"' if "none" in text else 'Shape "sphere"')
    for key, wanted in OLDER[text].items():
        assert getattr(found, key) == pytest.approx(wanted, abs=1e-3) if key != "alpha_mode" else found.alpha_mode == wanted


def test_losses_of_materials_of_pbrt_v3_are_told(tmp_path):
    materials = (
        '"matte" "float sigma" 20',
        '"plastic" "texture bumpmap" "b"',
        '"velvet"',
        '"uber" "rgb Kr" [1 1 1]',
        '"kdsubsurface"',
    )
    texture = 'Texture "b" "float" "constant" "float value" 1\n'
    scene = read(tmp_path, texture + "".join(f'Material {text}\nShape "sphere"\n' for text in materials) + "WorldEnd\n")
    told = "\n".join(scene.warnings)
    for words in ("sigma of matte", "bump maps", "unknown type velvet", "Ks and Kr of uber", "subsurface scattering"):
        assert words in told


def test_mixtures_of_pbrt_v3(tmp_path):
    """`amount` is the share of the first material."""
    named = "".join(
        f'MakeNamedMaterial "{name}" "string type" "matte" "rgb Kd" [{color}]\n'
        for name, color in (("a", "1 0 0"), ("b", "0 1 0"))
    )
    mixture = '"mix" "string namedmaterial1" "a" "string namedmaterial2" "b" "rgb amount"'
    assert older(tmp_path, f"{mixture} [0.8 0.8 0.8]", named).base_color == (1.0, 0.0, 0.0)
    assert older(tmp_path, f"{mixture} [0.2 0.2 0.2]", named).base_color == (0.0, 1.0, 0.0)


def test_textures_of_pbrt_v3(tmp_path):
    """`scale` multiplies two colours, and `gamma` false reads linear texels."""
    Image.new("RGB", (1, 1), (128, 128, 128)).save(tmp_path / "grey.png")
    product = 'Texture "x" "color" "scale" "color tex1" [0.5 0.5 1] "color tex2" [0.5 1 1]'
    assert older(tmp_path, '"matte" "texture Kd" "x"', product).base_color == (0.25, 0.5, 1.0)
    for gamma, wanted in (("", 0.2158), ('"bool gamma" "false"', 0.502)):
        texture = f'Texture "x" "color" "imagemap" "string filename" "grey.png" {gamma}'
        assert older(tmp_path, '"matte" "texture Kd" "x"', texture).base_color == pytest.approx((wanted,) * 3, abs=1e-3)


@pytest.mark.parametrize("name", ["grey.tga", "grey.png"])
def test_gamma_of_images_before_pbrt_v4(tmp_path, name):
    """A flag in pbrt-v3 for all files of 8 bits, and an exponent in pbrt-v2."""
    Image.new("RGB", (1, 1), (128, 128, 128)).save(tmp_path / name)
    for gamma, wanted in (('"bool gamma" "false"', 0.502), ('"bool gamma" "true"', 0.2158), ('"float gamma" [3]', 0.1265)):
        texture = f'Texture "x" "color" "imagemap" "string filename" "{name}" {gamma}'
        assert older(tmp_path, '"matte" "texture Kd" "x"', texture).base_color == pytest.approx((wanted,) * 3, abs=1e-3)
