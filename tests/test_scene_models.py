"""Models: geometry, materials and extensions of real files, and what is said to be ignored."""

import base64
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, describe, load_scene

ASSETS = Path(__file__).resolve().parents[2] / "shared" / "assets"
needs_assets = pytest.mark.skipif(not ASSETS.is_dir(), reason="no shared assets here")

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
TEXCOORDS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]], np.uint16)


def write_gltf(path, material=None, nodes=None, normals=None, indices=TRIANGLES, corners=CORNERS, **extra):
    """A square of 2 × 2 that faces +z as a glTF with embedded buffers."""
    arrays = {"POSITION": corners, "TEXCOORD_0": TEXCOORDS}
    if normals is not None:
        arrays["NORMAL"] = np.asarray(normals, np.float32)
    blobs = [array.tobytes() for array in arrays.values()] + [indices.tobytes()]
    views, accessors, offset = [], [], 0
    for blob, array in zip(blobs, [*arrays.values(), indices]):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob)})
        kind = {2: "VEC2", 3: "VEC3"}[array.shape[1]] if array is not indices else "SCALAR"
        accessors.append({
            "bufferView": len(accessors),
            "componentType": 5123 if array is indices else 5126,
            "count": indices.size if array is indices else len(array),
            "type": kind,
            "min": array.min(axis=0).tolist() if array is not indices else [int(array.min())],
            "max": array.max(axis=0).tolist() if array is not indices else [int(array.max())],
        })
        offset += len(blob)
    primitive = {
        "attributes": {name: number for number, name in enumerate(arrays)},
        "indices": len(arrays),
        **({} if material is None else {"material": 0}),
    }
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes or [0])))}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [] if material is None else [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{
            "byteLength": offset,
            "uri": "data:application/octet-stream;base64," + base64.b64encode(b"".join(blobs)).decode(),
        }],
    } | extra
    path.write_text(json.dumps(document))
    return str(path)


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


def test_thickness_makes_a_solid(tmp_path):
    material = {"extensions": {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_volume": {"thicknessFactor": 0.5, "attenuationColor": [1, 0, 0]},
    }}
    scene = load_scene(
        write_gltf(tmp_path / "glass.gltf", material, extensionsUsed=["KHR_materials_volume"])
    )
    assert not scene.materials[0].thin
    assert scene.warnings == ("glass.gltf: KHR_materials_volume: transmission is not attenuated",)


def test_gltf_defaults(tmp_path):
    """Without a material, and with an empty one, every factor is 1."""
    for material in (None, {}):
        (loaded,) = load_scene(write_gltf(tmp_path / "plain.gltf", material)).materials
        assert loaded.base_color == (1.0, 1.0, 1.0)
        assert (loaded.metallic, loaded.roughness, loaded.ior) == (1.0, 1.0, 1.5)
        assert not loaded.emits and not loaded.double_sided


def test_materials_of_one_name_are_told_apart(tmp_path):
    path = write_gltf(tmp_path / "twins.gltf", {"name": "same"})
    document = json.loads(Path(path).read_text())
    document["materials"] = [
        {"name": "same", "pbrMetallicRoughness": {"roughnessFactor": roughness}} for roughness in (0.1, 0.9)
    ]
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
            "baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0},
        },
        "emissiveTexture": {"index": 0},
        "emissiveFactor": [1, 1, 1],
    }
    textures = {"textures": [{"source": 0}], "images": [{"uri": "image.png"}]}
    scene = load_scene(write_gltf(tmp_path / "square.gltf", material, **textures))
    (loaded,) = scene.materials
    np.testing.assert_allclose(loaded.base_color_texture[0, 0], 0.5029, atol=1e-4)
    np.testing.assert_allclose(loaded.emission_texture[1, 0], (0.0, 1.0, 0.0513), atol=1e-4)
    np.testing.assert_allclose(loaded.metallic_roughness_texture[1, 0], (0.0, 1.0, 64 / 255), rtol=1e-6)
    (mesh,) = scene.meshes
    order = np.lexsort(mesh.vertices.T)
    np.testing.assert_allclose(mesh.uvs[order], TEXCOORDS[np.lexsort(CORNERS.T)], atol=1e-6)


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


@pytest.mark.parametrize("extension", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_a_compression_without_a_decoder(tmp_path, extension):
    if extension == "KHR_draco_mesh_compression" and importlib.util.find_spec("DracoPy"):
        pytest.skip("there is a decoder here")
    path = write_gltf(tmp_path / "small.gltf", {}, extensionsUsed=[extension])
    with pytest.raises(BokehguideError, match=f"small.gltf.*{extension}"):
        load_scene(path)


def test_what_is_not_honoured_is_said_once(tmp_path):
    material = {
        "name": "leaf",
        "alphaMode": "MASK",
        "normalTexture": {"index": 0},
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}},
        "extensions": {
            "KHR_materials_clearcoat": {"clearcoatFactor": 1.0},
            "KHR_materials_transmission": {"transmissionFactor": 1, "transmissionTexture": {"index": 0}},
        },
    }
    Image.new("RGB", (1, 1)).save(tmp_path / "image.png")
    path = write_gltf(
        tmp_path / "leaf.gltf",
        material,
        nodes=[{"camera": 0, "children": [1]}, {"mesh": 0}],
        scenes=[{"nodes": [0]}],
        textures=[{"source": 0, "sampler": 0}],
        samplers=[{"wrapS": 33071}],
        images=[{"uri": "image.png"}],
        cameras=[{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}],
        extensionsUsed=["KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_texture_transform"],
        extensions={"KHR_lights_punctual": {"lights": [{"type": "directional"}]}},
    )
    scene = load_scene(path)
    said = "\n".join(scene.warnings)
    for part in (
        *("KHR_lights_punctual", "KHR_materials_clearcoat", "KHR_texture_transform", "normal maps"),
        *("alpha mode MASK", "second texture coordinates", "textures in material extensions"),
        *("wrapping", "cameras"),
    ):
        assert said.count(part) == 1, f"{part!r} in {said!r}"
    assert len(scene.meshes) == 1, "the mesh below the camera is there"
    assert all(warning in describe(scene) for warning in scene.warnings)


def test_obj_materials(tmp_path):
    Image.new("RGB", (1, 1), (188, 188, 188)).save(tmp_path / "wood.png")
    (tmp_path / "m.mtl").write_text(
        "newmtl lamp\nKd 0.001 0 0\nKe 5 4 3\nnewmtl wood\nKd 0.5 0.5 0.5\nmap_Kd wood.png\n"
    )
    (tmp_path / "m.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
        "usemtl lamp\nf 1 3 4\nusemtl wood\nf 1/1 2/2 3/3\n"
    )
    scene = load_scene(str(tmp_path / "m.obj"))
    materials = {material.name: material for material in scene.materials}
    assert materials["lamp"].emission == (5.0, 4.0, 3.0)
    assert materials["lamp"].base_color == (0.001, 0.0, 0.0)
    np.testing.assert_allclose(materials["wood"].base_color_texture, 0.5029, atol=1e-4)
    assert scene.environment is None
    assert scene.warnings == ("m.obj: of its .mtl file only Kd, map_Kd and Ke are honoured",)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "glb"])
def test_a_model_is_framed_and_lit(tmp_path, suffix):
    box = trimesh.creation.box((3.0, 1.0, 2.0))
    box.apply_translation((10.0, 20.0, 30.0))
    path = tmp_path / f"box.{suffix}"
    box.export(path)
    scene = load_scene(str(path))
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == 12
    camera = scene.camera
    assert camera.fov == 40.0 and camera.target == pytest.approx((10.0, 20.0, 30.0))
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    relative = box.vertices - camera.position
    depth = relative @ forward
    across = np.abs(relative @ right / depth) / np.tan(np.radians(20.0))
    upwards = np.abs(relative @ np.cross(right, forward) / depth) / np.tan(np.radians(20.0)) * 640 / 360
    assert 0.7 < max(across.max(), upwards.max()) < 1.0, "it fills the frame and stays inside"
    assert camera.focus_distance == pytest.approx(depth.min(), rel=1e-4)
    assert camera.aperture_radius == pytest.approx(0.02 * camera.focus_distance)
    sky = scene.environment.radiance
    assert sky.shape == (32, 64, 3) and (np.diff(sky[:, 0, 1]) <= 0.0).all() and sky.min() > 0.0


def test_overrides_of_a_models_camera(tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(radius=1.0).export(path)
    overrides = Overrides(
        camera_position=(0.0, 0.0, 5.0), camera_target=(0.0, 0.0, 0.0), f_number=2.0, environment="0,0,1"
    )
    scene = load_scene(str(path), overrides)
    assert scene.camera.focus_distance == pytest.approx(4.0), "focused on the nearest part"
    assert scene.camera.aperture_radius == pytest.approx(0.018 / np.tan(np.radians(20.0)) / 4.0)
    np.testing.assert_array_equal(scene.environment.radiance, [[[0.0, 0.0, 1.0]]])
    far = load_scene(str(path), Overrides(fov=10.0)).camera
    assert np.linalg.norm(far.position) > 2.0 * np.linalg.norm(load_scene(str(path)).camera.position)


def test_a_model_in_a_scene_file_keeps_its_materials(tmp_path):
    write_gltf(tmp_path / "square.gltf", {"name": "own", "pbrMetallicRoughness": {"roughnessFactor": 0.3}})
    (tmp_path / "scene.toml").write_text("""
        camera = { position = [0, 0, 5], target = [0, 0, 0] }
        [materials.red]
        base_color = [1, 0, 0]
        [[object]]
        file = "square.gltf"
        [[object]]
        file = "square.gltf"
        material = "red"
        translate = [0, 0, -1]
    """)
    scene = load_scene(str(tmp_path / "scene.toml"))
    assert [scene.materials[mesh.material].name for mesh in scene.meshes] == ["own", "red"]
    assert [material.name for material in scene.materials] == ["red", "own"], "loaded once"
    assert scene.meshes[1].vertices[0, 2] == -1.0


@needs_assets
def test_depth_of_field_example():
    """Emissive strength, which trimesh loses, and the sun, which is not honoured."""
    scene = load_scene(
        str(ASSETS / "models" / "DepthOfFieldExample.glb"),
        Overrides(environment=str(ASSETS / "hdr" / "st_peters_square_night_1k.hdr")),
    )
    materials = {material.name: material for material in scene.materials}
    assert materials["Lava"].emission == (20.0, 20.0, 20.0)
    assert materials["Lava"].emission_texture is not None
    assert materials["CircuitBoard"].metallic == pytest.approx(0.8912387)
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == 10610
    assert all(mesh.normals is not None for mesh in scene.meshes)
    assert scene.environment.radiance.shape == (512, 1024, 3)
    assert scene.environment.radiance.max() == 10752.0
    assert any("KHR_lights_punctual" in warning for warning in scene.warnings)
    assert "4 lamps; environment map of 1024 × 512" in describe(scene)


@needs_assets
def test_draco_is_an_error_that_names_the_extension():
    if importlib.util.find_spec("DracoPy"):
        pytest.skip("there is a decoder here")
    with pytest.raises(BokehguideError, match="chess-board.glb: uses KHR_draco_mesh_compression"):
        load_scene(str(ASSETS / "models" / "chess-board.glb"))


@needs_assets
@pytest.mark.parametrize(
    ("name", "triangles", "meshes"),
    [
        ("FlightHelmet/FlightHelmet.gltf", 94722, 6),
        ("CesiumMilkTruck.glb", 3624, 5),
        ("Duck.glb", 4212, 1),
        ("conformance/02_shared_mesh/02_shared_mesh.gltf", 24, 2),
        ("TransmissionRoughnessTest.glb", 77792, 9),
    ],
)
def test_real_models(name, triangles, meshes):
    scene = load_scene(str(ASSETS / "models" / name))
    assert sum(len(mesh.triangles) for mesh in scene.meshes) == triangles
    assert len(scene.meshes) == meshes
    assert scene.environment is not None
