"""glTF materials and textures, extensions included."""

import math
from io import BytesIO

import numpy as np
import OpenImageIO as oiio
import pygltflib
import pytest
from fuzzing.ktx2_samples import ETC1S, UASTC
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene, summarize
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from tests.support.gltf_builder import UVS, Builder

GREY = 0.5029  # what 188 of 255 means


def picture(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    file = BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def square(builder: Builder, **mesh) -> Builder:
    builder.node(mesh=builder.mesh(material=0, **({"TEXCOORD_0": UVS} | mesh)))
    return builder


def only_material(builder, path):
    return load_scene(square(builder).save(path)).materials[0]


def test_every_term_of_the_extensions(tmp_path):
    builder = Builder()
    image = builder.texture(picture(Image.new("RGBA", (2, 2), (188, 188, 188, 51))))
    texture = {"index": image}
    builder.material(
        {"metallicFactor": 0.25},
        name="all",
        alphaMode="MASK",
        alphaCutoff=0.3,
        normalTexture=pygltflib.NormalMaterialTexture(index=image, scale=0.7),
        occlusionTexture=pygltflib.OcclusionTextureInfo(index=image),
        extensions={
            "KHR_materials_clearcoat": {
                "clearcoatFactor": 0.5,
                "clearcoatRoughnessFactor": 0.1,
                "clearcoatTexture": texture,
                "clearcoatRoughnessTexture": texture,
                "clearcoatNormalTexture": texture | {"scale": -0.6},
            },
            "KHR_materials_specular": {
                "specularFactor": 0.4,
                "specularColorFactor": [1.5, 0.5, 0],
                "specularTexture": texture,
                "specularColorTexture": texture,
            },
            "KHR_materials_transmission": {"transmissionFactor": 0.6, "transmissionTexture": texture},
            "KHR_materials_volume": {"thicknessFactor": 1, "attenuationDistance": 3, "attenuationColor": [1, 0.5, 0]},
            "KHR_materials_ior": {"ior": 1.7},
            "KHR_materials_sheen": {
                "sheenColorFactor": [0.1, 0.2, 0.3],
                "sheenRoughnessFactor": 0.35,
                "sheenColorTexture": texture,
                "sheenRoughnessTexture": texture,
            },
            "KHR_materials_anisotropy": {
                "anisotropyStrength": 0.45,
                "anisotropyRotation": math.pi / 6.0,
                "anisotropyTexture": texture,
            },
            "KHR_materials_iridescence": {
                "iridescenceFactor": 0.65,
                "iridescenceIor": 1.55,
                "iridescenceThicknessMinimum": 150.0,
                "iridescenceThicknessMaximum": 650.0,
                "iridescenceTexture": texture,
                "iridescenceThicknessTexture": texture,
            },
            "KHR_materials_dispersion": {"dispersion": 1.25},
            "KHR_materials_diffuse_transmission": {
                "diffuseTransmissionFactor": 0.55,
                "diffuseTransmissionColorFactor": [0.7, 0.8, 0.9],
                "diffuseTransmissionTexture": texture,
                "diffuseTransmissionColorTexture": texture,
            },
        },
    )
    scene = load_scene(square(builder).save(tmp_path / "all.glb"))
    (m,) = scene.materials
    glass = "has no effect on the transmissive part of a material (all)"
    assert scene.warnings == tuple(f"all.glb: KHR_materials_{name}: {glass}" for name in ("specular", "clearcoat", "sheen"))
    assert (m.metallic, m.alpha_mode, m.alpha_cutoff, m.normal_scale) == (0.25, "mask", 0.3, 0.7)
    assert m.clearcoat_normal_scale == -0.6
    assert (m.clearcoat, m.clearcoat_roughness, m.specular, m.specular_color) == (0.5, 0.1, 0.4, (1.5, 0.5, 0.0))
    assert (m.transmission, m.thin, m.ior) == (0.6, False, 1.7)
    assert (m.attenuation_distance, m.attenuation_color) == (3.0, (1.0, 0.5, 0.0))
    assert (m.sheen_color, m.sheen_roughness, m.anisotropy) == ((0.1, 0.2, 0.3), 0.35, 0.45)
    assert m.anisotropy_rotation == pytest.approx(30.0)
    assert (m.iridescence, m.iridescence_ior, m.iridescence_thickness, m.dispersion) == (0.65, 1.55, (150.0, 650.0), 1.25)
    for texture in (m.iridescence_texture, m.iridescence_thickness_texture):
        np.testing.assert_allclose(texture.image, 188 / 255, rtol=1e-6)
    assert (m.diffuse_transmission, m.diffuse_transmission_color) == (0.55, (0.7, 0.8, 0.9))
    for texture in (m.sheen_color_texture, m.diffuse_transmission_color_texture):
        np.testing.assert_allclose(texture.image, GREY, atol=1e-4)
    for texture in (m.sheen_roughness_texture, m.diffuse_transmission_texture):
        np.testing.assert_allclose(texture.image[..., 3], 0.2, rtol=1e-6)
    np.testing.assert_allclose(m.anisotropy_texture.image, 188 / 255, rtol=1e-6)
    coat = (m.clearcoat_texture, m.clearcoat_roughness_texture, m.clearcoat_normal_texture)
    for texture in (m.normal_texture, *coat, m.transmission_texture):
        np.testing.assert_allclose(texture.image, 188 / 255, rtol=1e-6)
        assert texture.image is m.normal_texture.image, "decoded once"
    np.testing.assert_allclose(m.specular_color_texture.image, GREY, atol=1e-4)
    np.testing.assert_allclose(m.specular_texture.image[..., 3], 0.2, rtol=1e-6)
    said = summarize(scene)
    for part in (
        "clearcoat (1)",
        "transmission (1)",
        "alpha modes: mask (1)",
        "textures from 1 images",
        "normal (1)",
        "clearcoat normal (1)",
    ):
        assert part in said, said


def test_a_volume_without_a_distance_absorbs_nothing(tmp_path):
    builder = Builder()
    builder.material(extensions={"KHR_materials_volume": {"thicknessFactor": 1}})
    assert only_material(builder, tmp_path / "clear.glb").attenuation_distance == math.inf


@pytest.mark.parametrize(("mode", "channels"), [("OPAQUE", 3), ("MASK", 4), ("BLEND", 4)])
def test_alpha_is_read_where_it_counts(tmp_path, mode, channels):
    builder = Builder()
    texture = builder.texture(picture(Image.new("RGBA", (1, 1), (188, 0, 255, 51))))
    pbr = {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": pygltflib.TextureInfo(index=texture)}
    builder.material(pbr, alphaMode=mode)
    material = only_material(builder, tmp_path / "alpha.glb")
    assert (material.alpha_mode, material.opacity) == (mode.lower(), 0.5)
    np.testing.assert_allclose(material.base_color_texture.image[0, 0], [GREY, 0, 1, 0.2][:channels], atol=1e-4)


def test_unlit_emits_its_base_colour_and_reflects_nothing(tmp_path):
    builder = Builder()
    texture = builder.texture(picture(Image.new("RGB", (1, 1), (188, 0, 0))))
    pbr = {"baseColorFactor": [0.5, 0.25, 1, 1], "baseColorTexture": pygltflib.TextureInfo(index=texture)}
    builder.material(pbr, extensions={"KHR_materials_unlit": {}})
    scene = load_scene(square(builder, COLOR_0=np.ones((4, 4), np.float32)).save(tmp_path / "sign.glb"))
    (sign,) = scene.materials
    assert sign.emission == (0.5, 0.25, 1.0) and sign.emission_texture is not None
    assert (sign.base_color, sign.specular, sign.metallic) == ((0.0, 0.0, 0.0), 0.0, 0.0)
    assert sign.tint_emission and scene.warnings == ()


def test_samplers_sets_and_transforms(tmp_path):
    builder = Builder()
    texture = builder.texture(picture(Image.new("RGB", (1, 1))), sampler=0)
    builder.gltf.samplers.append(pygltflib.Sampler(wrapS=33071, wrapT=33648))
    moved = {"offset": [0.1, 0.2], "rotation": math.pi / 2, "scale": [2, 3], "texCoord": 2}
    info = {"index": texture, "texCoord": 1}
    builder.material(
        {"baseColorTexture": pygltflib.TextureInfo(**info, extensions={"KHR_texture_transform": moved})},
        emissiveTexture=pygltflib.TextureInfo(**info),
    )
    scene = load_scene(square(builder, TEXCOORD_1=UVS + 1, TEXCOORD_2=UVS + 2).save(tmp_path / "moved.glb"))
    (material,) = scene.materials
    base, emission = material.base_color_texture, material.emission_texture
    assert base.wrap == ("clamp", "mirror") and (base.uv_set, emission.uv_set) == (2, 1)
    # Scaled, turned from +u towards -v, as v points down, then moved.
    np.testing.assert_allclose(np.reshape(base.transform, (2, 3)), [[0, 3, 0.1], [-2, 0, 0.2]], atol=1e-12)
    assert emission.transform == (1, 0, 0, 0, 1, 0)
    np.testing.assert_array_equal(scene.meshes[0].uvs, np.stack([UVS, UVS + 1, UVS + 2], axis=1))


def test_texture_coordinates_that_are_not_there(tmp_path):
    builder = Builder()
    texture = builder.texture(picture(Image.new("RGB", (1, 1))))
    builder.material({"baseColorTexture": pygltflib.TextureInfo(index=texture, texCoord=1)})
    path = square(builder).save(tmp_path / "lost.glb")
    scene = load_scene(path)
    np.testing.assert_array_equal(scene.meshes[0].uvs[:, 1], 0.0)
    assert scene.warnings == ("lost.glb: textures without their TEXCOORD_1: their first texel is used (meshes[0])",)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "AVIF"])
def test_kinds_of_images(tmp_path, kind):
    builder = Builder()
    data = picture(Image.new("RGB", (8, 8), (188, 188, 188)), kind)
    number = builder.texture(data)
    if kind in ("WEBP", "AVIF"):
        name = f"EXT_texture_{kind.lower()}"
        builder.gltf.textures[number] = pygltflib.Texture(extensions={name: {"source": 0}})
        builder.gltf.extensionsRequired.append(name)
    builder.material({"baseColorTexture": pygltflib.TextureInfo(index=number)})
    material = only_material(builder, tmp_path / "image.glb")
    np.testing.assert_allclose(material.base_color_texture.image, GREY, atol=1e-2)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_kept(tmp_path, channels):
    texels = np.random.default_rng(channels).integers(0, 65536, (3, 5, channels)).astype(np.uint16)
    spec = oiio.ImageSpec(5, 3, channels, "uint16")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    out = oiio.ImageOutput.create("deep.png")
    assert out.open(str(tmp_path / "deep.png"), spec) and out.write_image(texels)
    out.close()
    read = load_texture(tmp_path / "deep.png", SceneFiles(tmp_path), srgb=False, alpha=True)
    colors = texels[..., [0] * 3] if channels < 3 else texels[..., :3]
    wanted = colors if channels in (1, 3) else np.concatenate([colors, texels[..., -1:]], axis=2)
    np.testing.assert_allclose(read, wanted / 65535, rtol=1e-5, atol=1e-9)
    assert load_texture(tmp_path / "deep.png", SceneFiles(tmp_path), srgb=False).shape == (3, 5, 3)


def test_eight_bits_of_palettes_and_greys(tmp_path):
    Image.new("L", (2, 2), 188).save(tmp_path / "grey.png")
    np.testing.assert_allclose(load_texture(tmp_path / "grey.png", SceneFiles(tmp_path), srgb=True), GREY, atol=1e-4)
    Image.new("P", (2, 2), 0).save(tmp_path / "palette.png", transparency=0)
    assert load_texture(tmp_path / "palette.png", SceneFiles(tmp_path), srgb=True, alpha=True).shape == (2, 2, 4)


@pytest.mark.parametrize(("data", "near"), [(ETC1S, 3), (UASTC, 1)])
def test_ktx2(tmp_path, data, near):
    """The extension's image replaces the other one. Alpha stays where the material needs it, without sRGB."""
    builder = Builder()
    number = builder.texture(picture(Image.new("RGB", (1, 1), (188, 188, 188))))
    builder.gltf.images.append(pygltflib.Image(bufferView=builder.view(data), mimeType="image/ktx2"))
    builder.gltf.textures[number].extensions = {"KHR_texture_basisu": {"source": 1}}
    builder.gltf.extensionsRequired.append("KHR_texture_basisu")
    builder.material({"baseColorTexture": pygltflib.TextureInfo(index=number)}, alphaMode="MASK")
    material = only_material(builder, tmp_path / "k.glb")
    corners = material.base_color_texture.image[[1, 1, 6, 6], [1, 6, 1, 6]]
    wanted = [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 128 / 255]]
    np.testing.assert_allclose(corners, wanted, atol=near * 2.3 / 255)
    assert load_texture(_file(tmp_path, data), SceneFiles(tmp_path), srgb=False).shape == (8, 8, 3)


def _file(folder, data: bytes):
    (folder / "texture.ktx2").write_bytes(data)
    return folder / "texture.ktx2"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda data: data[:60], "cut short"),
        (lambda data: data[:200], "not a valid|corrupt|could not"),
        (lambda data: data[:20] + b"\0\0\0\1" + data[24:], "not a valid|size|level"),
        (lambda data: data[:12] + b"\x17" + data[13:], "pixels of VkFormat 23; encode the texture as ETC1S or UASTC"),
        (lambda data: data[:36] + b"\6" + data[37:], "no single two-dimensional image"),
        (lambda data: data[:98] + b"\xff" + data[99:], "a level is larger than the image"),
    ],
)
def test_damaged_ktx2(tmp_path, change, reason):
    with pytest.raises(BokehguideError, match=rf"texture\.ktx2: unreadable texture \(.*({reason})"):
        load_texture(_file(tmp_path, change(UASTC)), SceneFiles(tmp_path), srgb=False)


def test_a_huge_ktx2_is_refused_before_it_is_decoded(tmp_path):
    data = bytearray(UASTC)
    data[20:28] = np.array([2**15, 2**15], np.uint32).tobytes()
    with pytest.raises(BokehguideError, match=r"more than any picture needs|unreadable texture"):
        load_texture(_file(tmp_path, bytes(data)), SceneFiles(tmp_path), srgb=False)


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"junk", "give a PNG, a JPEG or a WebP"), (picture(Image.new("RGB", (64, 64)))[:60], "unreadable texture")],
)
def test_a_damaged_image(tmp_path, data, reason):
    builder = Builder()
    builder.material({"baseColorTexture": pygltflib.TextureInfo(index=builder.texture(data))})
    with pytest.raises(BokehguideError, match=rf"bad\.glb: images\[0\]: .*{reason}") as caught:
        load_scene(square(builder).save(tmp_path / "bad.glb"))
    assert "\n" not in str(caught.value)


def test_a_damaged_image_of_sixteen_bits(tmp_path):
    texels = np.random.default_rng(1).integers(0, 65536, (40, 40, 3)).astype(np.uint16)
    oiio.ImageBuf(texels).write(str(tmp_path / "deep.png"), "uint16")
    whole = (tmp_path / "deep.png").read_bytes()
    for share in (0.01, 0.1, 0.9):
        (tmp_path / "deep.png").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(BokehguideError, match=r"deep\.png: unreadable texture"):
            load_texture(tmp_path / "deep.png", SceneFiles(tmp_path), srgb=False)


@pytest.mark.parametrize("transmission, factor, lines", [(0.0, 0.5, 0), (1.0, 1.0, 0), (1.0, 0.5, 1)])
def test_layers_that_glass_lacks_are_told(tmp_path, transmission, factor, lines):
    builder = Builder()
    terms = {
        "KHR_materials_transmission": {"transmissionFactor": transmission},
        "KHR_materials_specular": {"specularFactor": factor},
    }
    builder.material({}, name="pane", extensions=terms)
    assert len(load_scene(square(builder).save(tmp_path / "pane.glb")).warnings) == lines


@pytest.mark.parametrize(
    "extras, expected", [({"bokehguide_single_scattering": True}, True), ({"other": 1}, False), ([1, 2], False), ("text", False)]
)
def test_extras_switch_multiple_scattering_off(tmp_path, extras, expected):
    builder = Builder()
    builder.material({"metallicFactor": 1.0}, extras=extras)
    assert only_material(builder, tmp_path / "metal.glb").single_scattering is expected
