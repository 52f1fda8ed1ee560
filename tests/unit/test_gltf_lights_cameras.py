"""glTF's punctual lights as spheres and suns, and its cameras as ours."""

import math

import numpy as np
import pygltflib
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene, summarize
from tests.support.gltf_builder import Builder, simple

DOWN = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Turns -z to -y."""


def lit(*lights: dict, **node) -> Builder:
    builder = simple()
    builder.lights(*lights)
    for index in range(len(lights)):
        builder.node(extensions={"KHR_lights_punctual": {"light": index}}, **node)
    return builder


def intensity(scene, mesh) -> np.ndarray:
    """The radiant power of an emitter divided by 4π: its area times its radiance over 4."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return np.array(scene.materials[mesh.material].emission) * np.pi * area / (4 * np.pi)


def middle(mesh) -> np.ndarray:
    return (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2


def test_a_point_light_becomes_a_sphere_of_its_intensity(tmp_path):
    light = {"type": "point", "color": [1, 0.5, 0], "intensity": 683.0, "name": "bulb", "range": 5}
    scene = load_scene(lit(light, translation=[0, 3, 0], scale=[7, 7, 7]).save(tmp_path / "bulb.glb"))
    _, bulb = scene.meshes
    np.testing.assert_allclose(intensity(scene, bulb), [1.0, 0.5, 0.0], rtol=1e-4)
    np.testing.assert_allclose(middle(bulb), [0, 3, 0], atol=1e-4)
    assert np.ptp(bulb.vertices, axis=0) == pytest.approx([0.02] * 3, rel=0.01), "1 cm, whatever the node's scale"
    assert scene.materials[bulb.material].emission_cone is None and scene.materials[bulb.material].name == "bulb"
    assert scene.environment is None, "a model with a light brings its own light"
    assert scene.warnings == ("bulb.glb: the range of lights: has no effect (bulb)",)
    assert "lights: point (1); point and spot lights as spheres of radius 0.01 m" in summarize(scene)


def test_lights_of_a_small_model_are_smaller(tmp_path):
    builder = Builder()
    builder.lights({"type": "point", "intensity": 1})
    builder.node(mesh=builder.mesh(), scale=[0.05, 0.05, 0.05])
    builder.node(translation=[0, 1, 0], extensions={"KHR_lights_punctual": {"light": 0}})
    scene = load_scene(builder.save(tmp_path / "toy.glb"))
    assert np.ptp(scene.meshes[1].vertices[:, 0]) == pytest.approx(0.002, rel=0.01), "a hundredth of 0.1 m, both ways"
    assert np.abs(scene.camera.target[1]) < 0.01, "the camera frames the model and not its light"


def test_a_spotlight_has_a_cone(tmp_path):
    spot = {"type": "spot", "intensity": 683, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5}}
    scene = load_scene(lit(spot, {"type": "spot"}, rotation=DOWN).save(tmp_path / "spot.glb"))
    first, second = (scene.materials[mesh.material].emission_cone for mesh in scene.meshes[1:])
    np.testing.assert_allclose(first.axis, [0, -1, 0], atol=1e-7)
    assert (first.inner, first.outer) == pytest.approx((math.degrees(0.1), math.degrees(0.5)))
    assert (second.inner, second.outer) == pytest.approx((0.0, 45.0)), "the format's defaults"


def test_a_directional_light_becomes_a_sun(tmp_path):
    light = {"type": "directional", "intensity": 6830, "color": [1, 1, 0.5]}
    scene = load_scene(lit(light, rotation=DOWN).save(tmp_path / "sun.glb"))
    (sun,) = scene.suns
    np.testing.assert_allclose(sun.direction, [0, 1, 0], atol=1e-7)
    assert sun.irradiance == pytest.approx((10.0, 10.0, 5.0)) and sun.angle == 0.53
    assert len(scene.meshes) == 1 and scene.environment is None


@pytest.mark.parametrize(
    ("light", "named"),
    [
        ({"type": "point", "intensity": -1}, "intensity: -1 is out of range"),
        ({"type": "point", "intensity": 1e18}, r"intensity: 1e\+18 makes a radiance"),
        ({"type": "spot", "spot": {"innerConeAngle": 0.6, "outerConeAngle": 0.5}}, r"outerConeAngle: 0\.5 is not above"),
        ({"type": "spot", "spot": {"outerConeAngle": 2}}, "outerConeAngle: 2 is out of range"),
        ({"type": "directional", "color": [1, 1]}, r"color: \[1, 1\]"),
    ],
)
def test_a_wrong_light(tmp_path, light, named):
    with pytest.raises(BokehguideError, match=rf"bad\.glb: KHR_lights_punctual\.lights\[0\].*{named}"):
        load_scene(lit(light).save(tmp_path / "bad.glb"))


SCENE = """
camera = { position = [0, 0, 9], target = [0, 0, 0] }
[lights]
radius = 0.25
sun_angle = 3.0
[[object]]
file = "lit.glb"
material = "red"
rotate = [0, 0, 90]
translate = [0, 1, 0]
scale = 2
[materials.red]
base_color = [1, 0, 0]
"""


def test_a_scene_file_sets_their_size_and_turns_them(tmp_path):
    spot = {"type": "spot", "intensity": 683}
    lit(spot, {"type": "directional", "intensity": 683}, rotation=DOWN).save(tmp_path / "lit.glb")
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = load_scene(str(tmp_path / "scene.toml"))
    square, emitter = scene.meshes
    assert scene.materials[square.material].name == "red"
    assert np.ptp(emitter.vertices[:, 0]) == pytest.approx(1.0, rel=0.01), "radius 0.25, twice as large"
    np.testing.assert_allclose(middle(emitter), [0, 1, 0], atol=1e-3)
    material = scene.materials[emitter.material]
    np.testing.assert_allclose(material.emission_cone.axis, [1, 0, 0], atol=1e-6, err_msg="from -y to +x")
    assert material.emission == pytest.approx([1 / (math.pi * 0.25**2)] * 3)
    (sun,) = scene.suns
    np.testing.assert_allclose(sun.direction, [-1, 0, 0], atol=1e-6)
    assert sun.angle == 3.0
    assert "spheres of radius 0.25 m" in summarize(load_scene(str(tmp_path / "scene.toml")))
    lit(spot).save(tmp_path / "lit.glb")
    unused = "lights.sun_angle: has no effect, as no model has directional lights"
    assert load_scene(str(tmp_path / "scene.toml")).warnings == (unused,)
    (tmp_path / "scene.toml").write_text(SCENE.replace("radius = 0.25", "radius = 0"))
    with pytest.raises(BokehguideError, match=r"lights\.radius: 0 is out of range"):
        load_scene(str(tmp_path / "scene.toml"))


def photographed() -> Builder:
    """A square before two cameras, the second tilted, and one that is not of perspective."""
    builder = simple()
    perspective = pygltflib.Perspective(yfov=math.radians(30), aspectRatio=1.0, znear=0.1)
    builder.gltf.cameras = [
        pygltflib.Camera(type="perspective", perspective=perspective, name="wide"),
        pygltflib.Camera(type="orthographic", orthographic=pygltflib.Orthographic(xmag=1, ymag=1, zfar=9, znear=1)),
    ]
    builder.node(name="front", camera=0, translation=[0, 0, 5], scale=[3, 3, 3])
    roll = [0, 0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    builder.node(camera=0, translation=[0, 0, 8], rotation=roll)
    builder.node(name="flat", camera=1)
    return builder


def test_the_files_first_camera_is_the_default(tmp_path):
    path = photographed().save(tmp_path / "set.glb")
    scene = load_scene(path, Overrides(width=300, height=100))
    camera = scene.camera
    assert camera.position == (0.0, 0.0, 5.0) and camera.up == pytest.approx((0, 1, 0))
    assert camera.target == pytest.approx((0, 0, 0), abs=1e-6) and camera.focus_distance == pytest.approx(5.0)
    vertical = 2 * math.atan(math.tan(math.radians(camera.fov / 2)) / 3)
    assert math.degrees(vertical) == pytest.approx(30.0), "the vertical field of view holds"
    across = 2.0 * math.tan(math.radians(camera.fov / 2)) * camera.focus_distance
    assert 2.0 * camera.aperture_radius == pytest.approx(0.06 * across), "a disc at infinity has 6 % of the frame's width"
    assert scene.warnings == ("set.glb: orthographic cameras: left out (flat)",)
    assert "cameras: 0 front, 1 wide" in summarize(scene)


@pytest.mark.parametrize("name", ["wide", "1"])
def test_a_camera_by_name_or_number(tmp_path, name):
    path = photographed().save(tmp_path / "set.glb")
    camera = load_scene(path, Overrides(camera=name, f_number=2.0, focus_distance=7.0, fov=40.0)).camera
    assert camera.position == (0.0, 0.0, 8.0) and camera.up == pytest.approx((-1, 0, 0), abs=1e-6)
    assert (camera.fov, camera.focus_distance) == (pytest.approx(40.0), 7.0)
    assert camera.aperture_radius == pytest.approx(0.018 / math.tan(math.radians(20)) / 4)


@pytest.mark.parametrize("overrides", [{"camera": "frame"}, {"camera_position": (3.0, 3.0, 3.0)}])
def test_the_framing_camera_is_still_there(tmp_path, overrides):
    path = photographed().save(tmp_path / "set.glb")
    camera = load_scene(path, Overrides(**overrides)).camera
    assert camera.position not in ((0.0, 0.0, 5.0), (0.0, 0.0, 8.0))
    forward = np.subtract(camera.target, camera.position)
    towards = np.negative(camera.position)  # the model surrounds the origin
    cosine = forward @ towards / np.linalg.norm(forward) / np.linalg.norm(towards)
    assert cosine > math.cos(math.radians(camera.fov / 2)), "the model is in the frame"


@pytest.mark.slow
def test_a_camera_that_is_not_there(tmp_path, bokehguide):
    path = photographed().save(tmp_path / "set.glb")
    finished = bokehguide("render", path, "--camera", "back")
    assert finished.returncode == 2
    assert finished.stderr.endswith(
        f"bokehguide: error: --camera: 'back' is no camera of {path}; it has 0 (front), 1 (wide); 'frame' frames the model\n"
    )
    with pytest.raises(BokehguideError, match="--camera: 'front': selects a camera of a model"):
        load_scene("daylight", Overrides(camera="front"))
    with pytest.raises(BokehguideError, match="--camera: 'front' and camera_position"):
        Overrides(camera="front", camera_position=(0.0, 0.0, 0.0))


def test_a_camera_looking_straight_down(tmp_path):
    builder = photographed()
    builder.gltf.nodes[1].rotation, builder.gltf.nodes[1].translation = DOWN, [0, 4, 0]
    camera = load_scene(builder.save(tmp_path / "down.glb")).camera
    assert camera.up == pytest.approx((0, 0, -1), abs=1e-6)
    assert np.subtract(camera.target, camera.position)[1] < 0.0
