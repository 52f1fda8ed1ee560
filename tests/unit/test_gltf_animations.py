"""Animations and morph targets: the pose of a glTF model at a time."""

import json
from pathlib import Path

import numpy as np
import pygltflib
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.model import ModelState
from bokehguide.scene.model_files import load_model
from tests.support.gltf_builder import SQUARE, Builder
from tests.support.gltf_skin import skinned

DELTA = np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 4]], np.float32)


def animated(path: str, keys: list, times=(1.0, 3.0), mode: str | None = None, normalized=False, builder=None) -> Builder:
    """A square whose node has one animated property, with `keys` at `times`."""
    builder = builder or Builder()
    if not builder.gltf.nodes:
        builder.node(mesh=builder.mesh())
    times = builder.accessor(np.array(times, np.float32), max=[float(max(times))], min=[float(min(times))])
    values = np.asarray(keys) if normalized else np.asarray(keys, np.float32)
    sampler = pygltflib.AnimationSampler(input=times, output=builder.accessor(values, normalized), interpolation=mode)
    target = pygltflib.AnimationChannelTarget(node=0, path=path)
    channel = pygltflib.AnimationChannel(sampler=0, target=target)
    builder.gltf.animations.append(pygltflib.Animation(channels=[channel], samplers=[sampler]))
    return builder


def saved(builder: Builder, folder: Path) -> Path:
    return Path(builder.save(folder / "m.glb"))


def posed(builder: Builder, folder: Path, time: float | None) -> np.ndarray:
    """The vertices at a time."""
    return load_model(saved(builder, folder), state=ModelState(time=time)).meshes[0].vertices


@pytest.mark.parametrize(
    ("mode", "time", "x"),
    [
        (None, 0.0, 2.0),
        (None, 1.0, 2.0),
        (None, 1.5, 3.0),
        (None, 3.0, 6.0),
        (None, 9.0, 6.0),
        ("STEP", 2.9, 2.0),
        ("STEP", 3.0, 6.0),
    ],
)
def test_translations(tmp_path, mode, time, x):
    builder = animated("translation", [[2, 0, 0], [6, 0, 0]], mode=mode)
    np.testing.assert_allclose(posed(builder, tmp_path, time), SQUARE + [x, 0, 0], atol=1e-5)
    np.testing.assert_allclose(posed(builder, tmp_path, None), SQUARE, atol=1e-6)


def test_a_cubic_spline(tmp_path):
    """At a quarter of the step, by hand: Hermite's four polynomials with the tangents times the step."""
    keys = [[9, 9, 9], [1, 0, 0], [0, 2, 0], [0, 4, 0], [5, 0, 0], [9, 9, 9]]
    t, step = 0.25, 2.0
    at = (2 * t**3 - 3 * t**2 + 1) * np.array([1, 0, 0]) + step * (t**3 - 2 * t**2 + t) * np.array([0, 2, 0])
    at = at + (3 * t**2 - 2 * t**3) * np.array([5, 0, 0]) + step * (t**3 - t**2) * np.array([0, 4, 0])
    builder = animated("translation", keys, mode="CUBICSPLINE")
    np.testing.assert_allclose(posed(builder, tmp_path, 1.5), SQUARE + at, atol=1e-5)
    np.testing.assert_allclose(posed(builder, tmp_path, 4.0), SQUARE + [5, 0, 0], atol=1e-5)


def test_rotations_take_the_shorter_arc_at_even_speed(tmp_path):
    half = np.array([0.0, np.sin(0.5), 0.0, np.cos(0.5)])  # one radian about +y
    builder = animated("rotation", [[0, 0, 0, 1], -half])
    turned = np.stack([SQUARE[:, 0] * np.cos(0.25), SQUARE[:, 1], -SQUARE[:, 0] * np.sin(0.25)], axis=1)
    np.testing.assert_allclose(posed(builder, tmp_path, 1.5), turned, atol=1e-6)


def test_normalised_integers(tmp_path):
    builder = animated("rotation", np.array([[0, 0, 0, 127], [0, 127, 0, 0]], np.int8), normalized=True)
    np.testing.assert_allclose(posed(builder, tmp_path, 3.0), SQUARE * [-1, 1, -1], atol=1e-5)


def test_scale_and_other_keys_of_the_node_stay(tmp_path):
    builder = animated("scale", [[1, 1, 1], [3, 1, 1]])
    builder.gltf.nodes[0].translation = [0, 5, 0]
    np.testing.assert_allclose(posed(builder, tmp_path, 2.0), SQUARE * [2, 1, 1] + [0, 5, 0], atol=1e-5)


def test_joints_of_a_skin(tmp_path):
    """The skin's second joint rises; the vertices on the right follow."""
    builder = skinned()
    builder = animated("translation", [[0, 0, 0], [0, 4, 0]], builder=builder)
    builder.gltf.animations[0].channels[0].target.node = 1  # the inner joint
    moved = SQUARE + np.array([[0, 0, 0], [0, 2, 0], [0, 2, 0], [0, 0, 0]])
    np.testing.assert_allclose(posed(builder, tmp_path, 2.0), moved, atol=1e-5)


def morphed(weights: list | None = None, **targets: np.ndarray) -> Builder:
    """A square with two morph targets: positions, then the given attributes."""
    builder = Builder()
    number = builder.mesh(NORMAL=np.array([[0, 0, 1]] * 4, np.float32), COLOR_0=np.full((4, 3), 0.25, np.float32))
    mesh = builder.gltf.meshes[number]
    second = {name: builder.accessor(array) for name, array in targets.items()}
    first = {"POSITION": builder.accessor(DELTA)}
    mesh.primitives[0].targets = [first, second or first]
    mesh.weights = weights
    builder.node(mesh=number)
    return builder


def test_weights_of_the_mesh_and_of_the_node(tmp_path):
    np.testing.assert_allclose(posed(morphed(), tmp_path, None), SQUARE, atol=1e-6)
    np.testing.assert_allclose(posed(morphed([0.5, 0]), tmp_path, None), SQUARE + 0.5 * DELTA, atol=1e-6)
    builder = morphed([0.5, 0])
    builder.node(mesh=0)
    path = tmp_path / "two.gltf"
    document = json.loads(Path(builder.save(path)).read_text())
    document["nodes"][1]["weights"] = [0.25, 0.5]
    path.write_text(json.dumps(document))
    first, second = load_model(path).meshes
    np.testing.assert_allclose(first.vertices, SQUARE + 0.5 * DELTA, atol=1e-6)
    np.testing.assert_allclose(second.vertices, SQUARE + 0.75 * DELTA, atol=1e-6)


def test_normals_and_colours_of_targets(tmp_path):
    turned = np.array([[1, 0, 0]] * 4, np.float32)
    builder = morphed([0, 1.0], NORMAL=turned, COLOR_0=np.full((4, 3), 0.5, np.float32))
    model = load_model(saved(builder, tmp_path))
    np.testing.assert_allclose(model.meshes[0].normals, [[0.5**0.5, 0, 0.5**0.5]] * 4, atol=1e-6)
    np.testing.assert_allclose(model.meshes[0].colors, [[0.75, 0.75, 0.75, 1]] * 4, atol=1e-6)
    assert "m.glb: meshes with morph targets: 1" in model.supported and model.warnings == ()


def test_animated_weights(tmp_path):
    builder = animated("weights", [0, 0, 1, 0.5], builder=morphed([9, 9]))
    np.testing.assert_allclose(posed(builder, tmp_path, 2.0), SQUARE + 0.75 * DELTA, atol=1e-5)


def test_targets_of_a_few_vertices_of_a_large_buffer(tmp_path):
    """Vertices that no triangle uses are left out of the differences too."""
    builder = Builder()
    many = np.concatenate([np.zeros((40, 3), np.float32), SQUARE])
    deltas = np.concatenate([np.ones((40, 3), np.float32), DELTA])
    number = builder.mesh(POSITION=many, indices=np.array([40, 41, 42, 40, 42, 43], np.uint16))
    builder.gltf.meshes[number].primitives[0].targets = [{"POSITION": builder.accessor(deltas)}]
    builder.gltf.meshes[number].weights = [1.0]
    builder.node(mesh=number)
    np.testing.assert_allclose(posed(builder, tmp_path, None), SQUARE + DELTA, atol=1e-6)


def test_the_first_animation_of_a_node_counts(tmp_path):
    builder = animated("translation", [[2, 0, 0], [2, 0, 0]])
    builder = animated("translation", [[7, 0, 0], [7, 0, 0]], builder=builder)
    builder = animated("scale", [[1, 2, 1], [1, 2, 1]], builder=builder)
    model = load_model(saved(builder, tmp_path), state=ModelState(time=0.0))
    np.testing.assert_allclose(model.meshes[0].vertices, SQUARE * [1, 2, 1] + [2, 0, 0], atol=1e-6)
    assert model.warnings == ("m.glb: further animations of the same nodes: left out (animations[1])",)


def test_pointers_are_told_as_ignored(tmp_path):
    builder = animated("translation", [[2, 0, 0], [2, 0, 0]])
    path = builder.save(tmp_path / "m.gltf")
    document = json.loads((tmp_path / "m.gltf").read_text())
    extension = {"KHR_animation_pointer": {"pointer": "/materials/0/emissiveFactor"}}
    document["animations"][0]["channels"].append({"sampler": 0, "target": {"path": "pointer", "extensions": extension}})
    document |= {"extensionsUsed": ["KHR_animation_pointer"], "extensionsRequired": ["KHR_animation_pointer"]}
    (tmp_path / "m.gltf").write_text(json.dumps(document))
    scene = load_scene(path, Overrides(time=1.0))
    assert scene.warnings == (
        "m.gltf: animations of KHR_animation_pointer: left out (animations[0])",
        "m.gltf: KHR_animation_pointer: has no effect",
    )
    np.testing.assert_allclose(scene.meshes[0].vertices, SQUARE + [2, 0, 0], atol=1e-6)


def test_a_time_without_animations_is_told(tmp_path):
    builder = animated("translation", [[2, 0, 0], [2, 0, 0]])
    builder.gltf.animations = []
    scene = load_scene(builder.save(tmp_path / "m.glb"), Overrides(time=1.0))
    assert scene.warnings == ("m.glb: time: has no effect, as the model has no animations",)


def test_the_report_names_the_animations(tmp_path):
    builder = animated("translation", [[2, 0, 0], [2, 0, 0]], times=(0.0, 2.5))
    builder.gltf.animations[0].name = "Walk"
    scene = load_scene(builder.save(tmp_path / "m.glb"))
    assert scene.supported == ("m.glb: animations: Walk (to 2.5 s); drawn: none",)
    assert scene.warnings == ("m.glb: animations: the model is drawn in its rest pose; give a time to draw another",)
    scene = load_scene(str(tmp_path / "m.glb"), Overrides(time=0.5))
    assert scene.supported == ("m.glb: animations: Walk (to 2.5 s); drawn: 0.5 s",) and scene.warnings == ()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"keys": [[1, 2, 3]]}, r"samplers\[0\]\.output: \d has 1 values for 2 keys"),
        ({"mode": "CUBICSPLINE"}, "output: .* has 2 values for 2 keys"),
        ({"mode": "EASE"}, "interpolation: 'EASE' is none of LINEAR, STEP, CUBICSPLINE"),
        ({"keys": [[np.nan, 0, 0], [0, 0, 0]]}, "output: .* is no translation at 1.5 s"),
        ({"path": "rotation", "keys": [[0, 0, 0, 0], [0, 0, 0, 0]]}, "output: .* is no rotation at 1.5 s"),
        ({"path": "rotation"}, "type: 'VEC3' is not VEC4"),
        ({"times": ()}, "has 2 values for 0 keys"),
    ],
)
def test_damaged_animations(tmp_path, changes, named):
    values = {"path": "translation", "keys": [[0, 0, 0], [1, 1, 1]]} | changes
    if values.get("times") == ():
        values["times"] = (1.0, 3.0)
        builder = animated(**values)
        builder.gltf.accessors[builder.gltf.animations[0].samplers[0].input].count = 0
    else:
        builder = animated(**values)
    with pytest.raises(BokehguideError, match=rf"m\.glb: .*{named}"):
        posed(builder, tmp_path, 1.5)


def test_a_channel_without_its_sampler(tmp_path):
    builder = animated("translation", [[0, 0, 0], [1, 1, 1]])
    builder.gltf.animations[0].channels[0].sampler = 4
    with pytest.raises(BokehguideError, match=r"channels\[0\]\.sampler: 4 is no index into the 1 samplers"):
        posed(builder, tmp_path, 1.5)


def test_too_few_differences(tmp_path):
    builder = morphed([1.0, 0.0])
    builder.gltf.accessors[builder.gltf.meshes[0].primitives[0].targets[0]["POSITION"]].count = 3
    with pytest.raises(BokehguideError, match=r"targets: 3 differences in accessors\[\d\] for 4 vertices"):
        posed(builder, tmp_path, None)


def test_more_weights_than_targets(tmp_path):
    model = load_model(saved(morphed([1.0, 0.0, 0.5]), tmp_path))
    assert model.warnings == ("m.glb: morph targets: 3 weights for 2 targets (meshes[0])",)
    np.testing.assert_allclose(model.meshes[0].vertices, SQUARE + DELTA, atol=1e-6)


def test_a_time_for_a_file_that_cannot_move(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(BokehguideError, match=r"a\.obj: has neither variants nor animations"):
        load_scene(str(tmp_path / "a.obj"), Overrides(time=1.0))
    with pytest.raises(BokehguideError, match=r"--time: 1\.0: selects a time of a model, but daylight is none"):
        load_scene("daylight", Overrides(time=1.0))
