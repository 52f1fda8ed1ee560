"""Small files that would take minutes or gigabytes: each loads within bounds, or is refused in a line."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from bokehguide import limits
from bokehguide.errors import BokehguideError
from bokehguide.scene import load_scene
from bokehguide.scene.gltf import accessors
from bokehguide.scene.shapes import instanced, joined, transform, transformed, unit_box, unit_sphere
from bokehguide.train import RenderLoop, RenderSettings, load_checkpoint
from bokehguide.train.checkpoint import fingerprint, require_kind
from tests.support import crafted
from tests.support.scene_text import CAMERA
from tests.support.scenes import emitters

SECONDS, MEGABYTES = 60.0, 2560.0
"""The bounds for a file under 1 MB."""
REFUSED = {
    "instances": "instances in all; give fewer",
    "meshes": "meshes in all; join them to",
    "suns": "has 12,000 suns; give at most 256",
    "dotted keys": "a key of more than 100 parts",
    "dotted table": "a key of more than 100 parts",
    "map 16384": "would unfold from",
}


def refused(path) -> str:
    with pytest.raises(BokehguideError) as caught:
        load_scene(str(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.slow
def test_files_under_a_megabyte_take_little(tmp_path):
    """With the preparation of a render; in processor seconds, as other tests may run."""
    paths = crafted.scenes(tmp_path)
    command = [sys.executable, "-m", "tests.support.measured", *map(str, paths.values())]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=600, env=os.environ)
    assert finished.returncode == 0, finished.stderr
    measured = dict(zip(paths, map(json.loads, finished.stdout.splitlines()), strict=True))
    for name, facts in measured.items():
        assert max(path.stat().st_size for path in (paths[name], *tmp_path.glob("*.exr"))) < 10**6
        assert facts["whole"] < SECONDS and facts["mb"] < MEGABYTES, (name, facts)
        assert facts["message"].startswith("BokehguideError") == (name in REFUSED), (name, facts)
        assert REFUSED.get(name, "") in facts["message"]


@pytest.mark.parametrize("name", ["instances", "suns", "meshes"])
def test_too_much_is_refused_before_it_is_made(name, tmp_path):
    path = tmp_path / "many.gltf"
    path.write_text(json.dumps(crafted.GLTF[name]()))
    start = time.process_time()
    assert REFUSED[name] in refused(path)
    assert time.process_time() - start < 5.0


@pytest.mark.parametrize("name", ["dotted keys", "dotted table"])
def test_deep_keys(name, tmp_path):
    (tmp_path / "deep.toml").write_text(crafted.TOML[name])
    assert REFUSED[name] in refused(tmp_path / "deep.toml")


@pytest.mark.parametrize("key", ["a" * 10**6, '"' + "a.b " * 10**5 + '" = 1', "# " + "see a.b.c.d, " * 1000, "a." * 98 + "a = 1"])
def test_the_search_for_deep_keys_is_quick_and_right(key, tmp_path):
    (tmp_path / "long.toml").write_text(CAMERA + key)
    start = time.process_time()
    assert "parts" not in refused(tmp_path / "long.toml")
    assert time.process_time() - start < 2.0


def test_primitives_that_share_an_accessor_read_it_once(tmp_path, monkeypatch):
    """Each takes its own few vertices of a million."""
    document = crafted.one_accessor()
    document["meshes"][0]["primitives"] = document["meshes"][0]["primitives"][:50]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    put, read = accessors._put_sparse, []
    monkeypatch.setattr(accessors, "_put_sparse", lambda *arguments: (read.append(1), put(*arguments)))
    scene = load_scene(str(tmp_path / "a.gltf"))
    assert len(scene.meshes) == 50 and len(read) == 1
    np.testing.assert_array_equal(scene.meshes[49].vertices, np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))


def test_accessors_that_no_buffer_stores_are_few(tmp_path):
    document = crafted.gltf()
    document["accessors"] = [document["accessors"][1]] * 12 + document["accessors"]
    document["meshes"] = [{"primitives": [{"attributes": {"POSITION": n}, "indices": 14} for n in range(12)]}]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    assert "accessors[8].count: 1048576 makes more than 8388608 elements that no buffer stores" in refused(tmp_path / "a.gltf")


def test_instances_together_are_the_instances_one_by_one():
    rng = np.random.default_rng(0)
    mesh = transformed(unit_sphere(1), np.eye(4))
    tangents = np.concatenate((mesh.normals[:, [1, 2, 0]], np.ones((len(mesh.vertices), 1), np.float32)), axis=1)
    colors = rng.random((len(mesh.vertices), 4), np.float32)
    mesh = type(mesh)(**(vars(mesh) | {"tangents": tangents, "colors": colors}))
    matrices = np.stack([transform(rng.normal(size=3), rng.uniform(0, 360, 3), rng.uniform(0.5, 2, 3)) for _ in range(100)])
    together, each = instanced(mesh, matrices), joined([transformed(mesh, matrix) for matrix in matrices])
    for name in ("vertices", "triangles", "normals", "tangents", "uvs", "colors"):
        np.testing.assert_array_equal(getattr(together, name), getattr(each, name), err_msg=name)
        assert getattr(together, name).dtype == getattr(each, name).dtype
    matrices[3, :3, 0] *= -1.0
    mirrored = instanced(unit_box(), matrices)
    np.testing.assert_array_equal(mirrored.triangles, joined([transformed(unit_box(), m) for m in matrices]).triangles)


@pytest.mark.slow
def test_many_spheres_have_fewer_triangles_each(tmp_path, monkeypatch):
    monkeypatch.setattr("bokehguide.scene.shapes.MOST_SPHERES", (2, 4))
    for count, triangles in ((2, 1280), (3, 320), (5, 80)):
        (tmp_path / "a.toml").write_text(crafted.scene(crafted.BALL * count))
        assert [len(mesh.triangles) for mesh in load_scene(str(tmp_path / "a.toml")).meshes] == [triangles] * count
        (tmp_path / "a.gltf").write_text(json.dumps(crafted.lights(count=count)))
        scene = load_scene(str(tmp_path / "a.gltf"))
        assert [len(mesh.triangles) for mesh in scene.meshes] == [1] + [triangles] * count


def test_small_files_make_fewer_triangles(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "FREE_TRIANGLES", 500)
    path = tmp_path / "a.toml"
    path.write_text(crafted.scene(crafted.BALL.replace("sphere", "box") * 200))
    assert 500 < 12 * 200 < 500 + path.stat().st_size
    load_scene(str(path))
    path.write_text(crafted.scene(crafted.BALL * 3))
    most = 500 + path.stat().st_size
    assert f"object[0]: makes 1,280 triangles in all; give a scene of at most {most:,} for files as small" in refused(path)


@pytest.mark.parametrize("kind", ["nested", "bytes"])
def test_crafted_checkpoints(kind, tmp_path):
    loop = RenderLoop(emitters(32, 20), RenderSettings("uniform", threads=1))
    inputs = fingerprint(loop.scene, loop.settings)
    (tmp_path / "a.ckpt").write_bytes(crafted.nested(inputs) if kind == "nested" else crafted.byte_array(10**9))
    start = time.process_time()
    problem = "another commit wrote it, or it is damaged" if kind == "nested" else "is damaged or no checkpoint of a render"
    with pytest.raises(BokehguideError, match=problem):
        load_checkpoint(tmp_path / "a.ckpt", loop)
    assert time.process_time() - start < 2.0


def test_a_part_that_a_checkpoint_names_often_is_checked_once():
    part: object = []
    for _ in range(100):
        part = [part, part]
    start = time.process_time()
    require_kind(part, None)
    assert time.process_time() - start < 1.0
