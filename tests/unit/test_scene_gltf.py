"""glTF: factors, textures, nodes, extensions and warnings."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene, summarize
from bokehguide.scene.framing import SOFT_SKY
from tests.support.gltf_square import CORNERS, TEXCOORDS, write_gltf


def test_factors_and_extensions_come_unquantised(tmp_path):
    material = {
        "name": "glow",
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.001, 0.5001, 0.25, 1.0],
            "metallicFactor": 0.3,
            "roughnessFactor": 0.123,
        },
        "emissiveFactor": [1.0, 0.5, 0.001],
        "doubleSided": True,
        "extensions": {
            "KHR_materials_emissive_strength": {"emissiveStrength": 20.0},
            "KHR_materials_transmission": {"transmissionFactor": 0.75},
            "KHR_materials_ior": {"ior": 1.33},
            "KHR_materials_specular": {"specularFactor": 0.25},
        },
    }
    scene = load_scene(write_gltf(tmp_path / "glow.gltf", material))
    (glow,) = scene.materials
    assert glow.name == "glow" and glow.base_color == (0.001, 0.5001, 0.25)
    assert (glow.metallic, glow.roughness, glow.specular) == (0.3, 0.123, 0.25)
    assert glow.emission == pytest.approx((20.0, 10.0, 0.02))
    assert (glow.transmission, glow.ior, glow.thin, glow.double_sided) == (0.75, 1.33, True, True)
    assert scene.environment is None, "a model that emits brings its own light"


def test_a_glow_does_not_replace_the_sky(tmp_path):
    """Labels, screens and unlit surfaces light nothing: the sky stays up to an emission of 1."""

    def environment(strength, emissive=(1.0, 0.5, 0.0), **extra):
        extensions = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
        material = {"emissiveFactor": [*emissive], "extensions": extensions}
        return load_scene(write_gltf(tmp_path / "label.gltf", material, **extra)).environment

    assert environment(1.0) is SOFT_SKY
    assert environment(1.01) is None and environment(10.0, (0.0, 0.0, 0.2)) is None, "the strongest channel counts"
    lights = {"KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 1e-3}]}}
    nodes = [{"mesh": 0}, {"translation": [0, 0, 2], "extensions": {"KHR_lights_punctual": {"light": 0}}}]
    assert environment(1.0, nodes=nodes, extensions=lights) is None, "a light of the file counts however dim"
    far = [{"mesh": 0}, {"mesh": 1, "translation": [0.0, 40.0, 0.0]}]
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}
    meshes = [{"primitives": [primitive | {"material": 0}]}, {"primitives": [primitive]}]
    assert environment(1.01, nodes=far, meshes=meshes) is None, "4.04 of 1,768"
    assert environment(1.01, nodes=[far[0], far[1] | {"translation": [0, 80, 0]}], meshes=meshes) is SOFT_SKY, "4.04 of 6,728"
    unlit = load_scene(write_gltf(tmp_path / "unlit.gltf", {"extensions": {"KHR_materials_unlit": {}}}))
    assert unlit.environment is SOFT_SKY and unlit.materials[0].emits


@pytest.mark.slow
def test_thickness_makes_a_solid_that_absorbs(tmp_path):
    volume = {"thicknessFactor": 0.5, "attenuationColor": [1, 0, 0], "attenuationDistance": 2.5}
    extensions = {"KHR_materials_transmission": {"transmissionFactor": 1.0}, "KHR_materials_volume": volume}
    path = write_gltf(tmp_path / "glass.gltf", {"extensions": extensions}, extensionsUsed=[*extensions])
    scene = load_scene(path)
    (glass,) = scene.materials
    assert not glass.thin and glass.attenuation_color == (1.0, 0.0, 0.0) and glass.attenuation_distance == 2.5
    assert scene.warnings == ()
    volume["thicknessFactor"] = 0.0
    (sheet,) = load_scene(write_gltf(tmp_path / "sheet.gltf", {"extensions": extensions})).materials
    assert sheet.thin


def test_gltf_defaults(tmp_path):
    """Without a material, and with an empty one, every factor is 1."""
    for material in (None, {}):
        (loaded,) = load_scene(write_gltf(tmp_path / "plain.gltf", material)).materials
        assert loaded.base_color == (1.0, 1.0, 1.0)
        assert (loaded.metallic, loaded.roughness, loaded.ior) == (1.0, 1.0, 1.5)
        assert not loaded.emits and not loaded.double_sided


def test_materials_of_one_name_stay_distinct(tmp_path):
    path = write_gltf(tmp_path / "twins.gltf", {"name": "same"})
    document = json.loads(Path(path).read_text())
    document["materials"] = [{"name": "same", "pbrMetallicRoughness": {"roughnessFactor": roughness}} for roughness in (0.1, 0.9)]
    first = document["meshes"][0]["primitives"][0]
    document["meshes"].append({"primitives": [first | {"material": 1}]})
    document["nodes"] = [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, -3]}]
    document["scenes"] = [{"nodes": [0, 1]}]
    Path(path).write_text(json.dumps(document))
    scene = load_scene(path)
    depths = {float(mesh.vertices[0, 2]): scene.materials[mesh.material].roughness for mesh in scene.meshes}
    assert depths == {0.0: 0.1, -3.0: 0.9}


def test_textures_are_decoded_and_the_right_way_up(tmp_path):
    image = Image.new("RGB", (1, 2), (188, 188, 188))
    image.putpixel((0, 1), (0, 255, 64))
    image.save(tmp_path / "image.png")
    material = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 0},
        },
        "emissiveTexture": {"index": 0},
        "emissiveFactor": [1, 1, 1],
    }
    textures = {"textures": [{"source": 0}], "images": [{"uri": "image.png"}]}
    scene = load_scene(write_gltf(tmp_path / "square.gltf", material, **textures))
    (loaded,) = scene.materials
    np.testing.assert_allclose(loaded.base_color_texture.image[0, 0], 0.5029, atol=1e-4)
    np.testing.assert_allclose(loaded.emission_texture.image[1, 0], (0.0, 1.0, 0.0513), atol=1e-4)
    np.testing.assert_allclose(loaded.metallic_roughness_texture.image[1, 0], (0.0, 1.0, 64 / 255), rtol=1e-6)
    (mesh,) = scene.meshes
    order = np.lexsort(mesh.vertices.T)
    np.testing.assert_allclose(mesh.uvs[order, 0], TEXCOORDS[np.lexsort(CORNERS.T)], atol=1e-6)


def test_a_missing_image_is_an_error(tmp_path):
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    textures = {"textures": [{"source": 0}], "images": [{"uri": "gone.png"}]}
    with pytest.raises(BokehguideError, match=r"square\.gltf.*(gone\.png|baseColorTexture)"):
        load_scene(write_gltf(tmp_path / "square.gltf", material, **textures))


def test_nodes_place_turn_and_mirror(tmp_path):
    tilted = np.array([[0.6, 0.0, 0.8]] * 4)
    nodes = [
        {"mesh": 0, "translation": [5, 0, 0], "rotation": [0, 0.7071067811865476, 0, 0.7071067811865476]},
        {"mesh": 0, "translation": [0, 0, -9], "scale": [-2, 1, 1]},
    ]
    meshes = load_scene(write_gltf(tmp_path / "two.gltf", {}, nodes, tilted)).meshes
    mirrored, turned = sorted(meshes, key=lambda mesh: mesh.vertices[:, 2].max())
    np.testing.assert_allclose(turned.vertices[:, 0], 5.0, atol=1e-6)
    np.testing.assert_allclose(turned.normals, [[0.8, 0.0, -0.6]] * 4, atol=1e-6)
    # Normals go by the inverse transpose: (0.6 / -2, 0, 0.8), normalised.
    np.testing.assert_allclose(mirrored.normals, [[-0.3511, 0.0, 0.9363]] * 4, atol=1e-4)
    a, b, c = mirrored.vertices[mirrored.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0.0, "the mirrored front faces +z still"


def test_without_normals_a_surface_is_flat(tmp_path):
    (mesh,) = load_scene(write_gltf(tmp_path / "flat.gltf", {})).meshes
    assert mesh.normals is None


def test_indices_out_of_range(tmp_path):
    path = write_gltf(tmp_path / "broken.gltf", {}, indices=np.array([[0, 1, 7]], np.uint16))
    with pytest.raises(BokehguideError, match=r"broken\.gltf.*7"):
        load_scene(path)


def test_nan_vertices(tmp_path):
    corners = CORNERS.copy()
    corners[2, 1] = np.nan
    with pytest.raises(BokehguideError, match=r"broken\.gltf.*nan.*not finite"):
        load_scene(write_gltf(tmp_path / "broken.gltf", {}, corners=corners))


@pytest.mark.parametrize(
    ("material", "named"),
    [
        ({"name": "m", "pbrMetallicRoughness": {"roughnessFactor": 3}}, "roughnessFactor: 3"),
        ({"name": "m", "pbrMetallicRoughness": {"baseColorFactor": [2, 0, 0, 1]}}, "baseColorFactor"),
        ({"name": "m", "emissiveFactor": [-1, 0, 0]}, "emissiveFactor"),
        ({"name": "m", "extensions": {"KHR_materials_ior": {"ior": 0.5}}}, "ior: 0.5"),
    ],
)
def test_factors_out_of_range(tmp_path, material, named):
    with pytest.raises(BokehguideError, match=named) as caught:
        load_scene(write_gltf(tmp_path / "bad.gltf", material))
    assert "bad.gltf" in str(caught.value) and "(m)" in str(caught.value)


@pytest.mark.parametrize("extension", ["KHR_materials_volume_scatter", "X_none"])
def test_an_extension_that_is_required_and_not_supported(tmp_path, extension):
    path = write_gltf(tmp_path / "new.gltf", {}, extensionsRequired=[extension, "KHR_texture_transform"])
    with pytest.raises(BokehguideError, match=rf"new\.gltf: extensionsRequired: {extension}: not supported"):
        load_scene(path)


def test_unsupported_features_cause_one_warning_each(tmp_path):
    material = {
        "name": "leaf",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}},
        "extensions": {
            "KHR_materials_clearcoat": {"clearcoatFactor": 1.0},
            "KHR_materials_volume_scatter": {},
            "KHR_materials_ior": {"ior": 0},
        },
    }
    Image.new("RGB", (1, 1)).save(tmp_path / "image.png")
    path = write_gltf(
        tmp_path / "leaf.gltf",
        material,
        nodes=[{"camera": 0, "children": [1]}, {"mesh": 0}],
        scenes=[{"nodes": [0]}, {"name": "second"}],
        textures=[{"source": 0, "sampler": 0}, {"extensions": {"MSFT_texture_dds": {"source": 1}}}],
        samplers=[{"magFilter": 9728}],
        images=[{"uri": "image.png"}, {"uri": "image.dds", "mimeType": "image/vnd-ms.dds"}],
        cameras=[{"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0.1, "zfar": 1}}],
        extensionsUsed=["MSFT_texture_dds", "KHR_materials_clearcoat"],
        animations=[{"channels": [], "samplers": []}],
    )
    scene = load_scene(path)
    said = "\n".join(scene.warnings)
    for part in (
        *("KHR_materials_volume_scatter: has no effect", "nearest-texel filters"),
        *(
            "orthographic cameras",
            "ior 0: 1.5 is used (leaf)",
            "only scenes[0] of 2 is drawn",
            "animations: the model is drawn in its rest pose",
        ),
        *("textures in an unsupported format (MSFT_texture_dds): only the factors are used (textures[1])",),
    ):
        assert said.count(part) == 1, f"{part!r} in {said!r}"
    assert len(scene.meshes) == 1, "the mesh below the camera is there"
    assert scene.materials[0].metallic_roughness_texture is None and scene.materials[0].roughness == 1.0
    assert scene.materials[0].clearcoat == 1.0 and scene.materials[0].ior == 1.5
    assert all(warning.startswith("leaf.gltf: ") and warning in summarize(scene) for warning in scene.warnings)


def test_factors_whose_product_is_absurd(tmp_path):
    material = {
        "name": "m",
        "emissiveFactor": [1e10, 0, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 1e10}},
    }
    with pytest.raises(BokehguideError, match=r"bad\.gltf: .*emissiveStrength: 1.*out of range"):
        load_scene(write_gltf(tmp_path / "bad.gltf", material))


def test_a_node_that_throws_the_mesh_away(tmp_path):
    nodes = [{"mesh": 0, "scale": [1e18, 1, 1], "translation": [1e18, 0, 0]}]
    with pytest.raises(BokehguideError, match=r"far\.gltf: .*vertices\[1\].*beyond 1e\+18"):
        load_scene(write_gltf(tmp_path / "far.gltf", {}, nodes))
