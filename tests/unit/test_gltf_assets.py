"""Models made by others, compared with trimesh where that reads them right."""

import json
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from bokehguide.scene import load_scene
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.accessors import read_raw
from bokehguide.scene.gltf.document import read_document
from bokehguide.scene.model import ModelState
from bokehguide.scene.model_files import load_model
from tests.support.paths import ASSETS

MODELS = ASSETS / "models"
pytestmark = pytest.mark.skipif(not MODELS.is_dir(), reason="no shared assets here")

TRIANGLES = {
    "DepthOfFieldExample.glb": 10610,
    "FlightHelmet/FlightHelmet.gltf": 94722,
    "love.glb": 46552,
    "SunglassesKhronos.glb": 13396,
    "TransmissionRoughnessTest.glb": 77792,
    "ClearCoatTest.glb": 37116,
    "AlphaBlendModeTest.glb": 61,
    "CesiumMilkTruck.glb": 3624,
    "Duck.glb": 4212,
    "CornellBox.glb": 36,
    "conformance/02_shared_mesh/02_shared_mesh.gltf": 24,
    "conformance/04_lights/04_lights.gltf": 2,
    "conformance/15_transmission/15_transmission.gltf": 4800,
    "conformance/16_volume/16_volume.gltf": 296,
    "conformance/17_ior/17_ior.gltf": 60,
}


@pytest.mark.parametrize("name", TRIANGLES)
def test_triangles_and_where_they_are(name):
    """As many triangles as there should be, each where trimesh places one, and the other way round."""
    model = load_model(MODELS / name)
    assert sum(len(mesh.triangles) for mesh in model.meshes) == TRIANGLES[name]
    theirs = trimesh.load_scene(str(MODELS / name), process=False)
    middles = []
    for node in theirs.graph.nodes_geometry:
        matrix, geometry = theirs.graph[node]
        mesh = theirs.geometry[geometry]
        middles.append(trimesh.transform_points(mesh.vertices, matrix)[mesh.faces].mean(axis=1))
    ours = np.concatenate([mesh.vertices[mesh.triangles].mean(axis=1) for mesh in model.meshes])
    middles = np.concatenate(middles)
    close = 1e-5 * np.ptp(ours, axis=0).max()
    assert len(ours) == len(middles)
    assert KDTree(ours).query(middles)[0].max() < close and KDTree(middles).query(ours)[0].max() < close


def test_materials_that_trimesh_has_right():
    """The factors and the images of a helmet with all core textures."""
    model = load_model(MODELS / "FlightHelmet" / "FlightHelmet.gltf")
    theirs = trimesh.load_scene(str(MODELS / "FlightHelmet" / "FlightHelmet.gltf"), process=False)
    named = {g.visual.material.name: g.visual.material for g in theirs.geometry.values()}
    assert {material.name for material in model.materials} == set(named)
    for material in model.materials:
        other = named[material.name]
        packed = np.asarray(other.metallicRoughnessTexture.convert("RGB")) / 255
        np.testing.assert_allclose(material.metallic_roughness_texture.image, packed, atol=1e-6)
        assert material.base_color_texture.image.shape[:2] == other.baseColorTexture.size[::-1]
        assert material.normal_texture is not None and material.double_sided == bool(other.doubleSided)
    assert {m.alpha_mode for m in model.materials} == {"opaque", "blend"}


def test_import_report_of_the_sunglasses():
    model = load_model(MODELS / "SunglassesKhronos.glb")
    assert model.supported[0] == "SunglassesKhronos.glb: materials with transmission (3), volume (1), ior (1), iridescence (1)"
    assert model.warnings == () and max(material.iridescence for material in model.materials) > 0.0


def test_all_clearcoat_terms_are_supported():
    model = load_model(MODELS / "ClearCoatTest.glb")
    assert model.warnings == () and any("clearcoat normal (2)" in line for line in model.supported)


def test_transmission_and_volume_of_the_conformance_files():
    def by_name(name):
        return {m.name: m for m in load_model(MODELS / "conformance" / name / f"{name}.gltf").materials}

    (json_file,) = (MODELS / "conformance" / "16_volume").glob("*.gltf")
    sources = {m["name"]: m for m in json.loads(json_file.read_text())["materials"]}
    for name, material in by_name("16_volume").items():
        volume = sources[name].get("extensions", {}).get("KHR_materials_volume", {})
        assert material.thin == (volume.get("thicknessFactor", 0) == 0)
        assert material.attenuation_distance == volume.get("attenuationDistance", np.inf)
    assert len({m.ior for m in by_name("17_ior").values()}) > 2


def test_instances_as_blender_makes_them():
    model = load_model(MODELS / "conformance" / "24_gpu_instancing" / "24_gpu_instancing.gltf")
    assert sum(len(mesh.triangles) for mesh in model.meshes) == 2 + (958 + 941) * 4032 == 7_656_770
    assert any("EXT_mesh_gpu_instancing" in line for line in model.supported)


def test_specular_glossiness_of_the_conformance_file():
    model = load_model(MODELS / "conformance" / "14_emission_strength" / "14_emission_strength.gltf")
    assert model.warnings == () and any("pbrSpecularGlossiness (9)" in line for line in model.supported)
    assert sum(material.metallic == 0.0 and material.specular_color != (1.0, 1.0, 1.0) for material in model.materials) == 9


@pytest.mark.parametrize("name", ["Ingenuity.glb", "japanese-bridge-garden.glb"])
def test_meshopt(name):
    """As many triangles as the accessors say, within their bounds, and unit normals."""
    data = (MODELS / name).read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    assert document["extensionsRequired"][0] == "EXT_meshopt_compression"
    model = load_model(MODELS / name)
    accessors, meshes = document["accessors"], document["meshes"]
    drawn = [mesh for node in document["nodes"] if "mesh" in node for mesh in meshes[node["mesh"]]["primitives"]]
    assert sum(len(mesh.triangles) for mesh in model.meshes) == sum(accessors[p["indices"]]["count"] for p in drawn) // 3
    assert model.warnings == () and any("compressed by meshoptimizer" in line for line in model.supported)
    decoded = read_document(MODELS / name, SceneFiles(MODELS))
    bounded = [number for number, accessor in enumerate(accessors) if "max" in accessor]
    for number in bounded:
        values = read_raw(decoded, number, accessors[number]["type"])
        np.testing.assert_allclose(values.min(axis=0), accessors[number]["min"], rtol=1e-6)
        np.testing.assert_allclose(values.max(axis=0), accessors[number]["max"], rtol=1e-6)
    assert len(bounded) >= len(drawn)


def test_a_truck_that_drives():
    """The wheels turn by the animation; the body stays."""
    path = MODELS / "CesiumMilkTruck.glb"
    rest, moved = load_model(path), load_model(path, state=ModelState(time=0.3))
    changed = {a.name: not np.allclose(a.vertices, b.vertices, atol=1e-4) for a, b in zip(rest.meshes, moved.meshes)}
    assert any(changed.values()) and not all(changed.values()) and moved.warnings == ()


def test_draco():
    path = MODELS / "chess-board.glb"
    model = load_model(path)
    assert sum(len(mesh.triangles) for mesh in model.meshes) == 178_848
    data = path.read_bytes()
    source = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    largest = max(source["accessors"], key=lambda a: a["count"] if a["type"] == "VEC3" else 0)
    assert all(mesh.normals is not None and np.ptp(mesh.vertices, axis=0).max() > 0.0 for mesh in model.meshes)
    assert largest["count"] == max(len(mesh.vertices) for mesh in model.meshes)
    assert next(m for m in model.materials if m.name == "Black_Piece").clearcoat == 1.0


def test_cameras():
    assert load_scene(str(MODELS / "Duck.glb")).camera.position == pytest.approx((4.0011, 4.6326, -4.3108), rel=1e-4)
    (camera,) = load_model(MODELS / "AlphaBlendModeTest.glb").cameras
    assert (camera.name, camera.vertical_fov) == ("camera_4A295F", pytest.approx(45.0))
