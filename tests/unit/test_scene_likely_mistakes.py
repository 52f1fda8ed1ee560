"""Warnings for likely mistakes."""

from __future__ import annotations

import json

import pytest
import trimesh

from bokehguide.cli import main
from bokehguide.scene import BUILTIN, Overrides, load_scene
from tests.support.gltf_square import write_gltf

BALL = """
[camera]
position = [0.0, 0.0, 5.0]
target = [0.0, 0.0, 0.0]
{lens}

[environment]
color = [1.0, 1.0, 1.0]

[materials.clay]

[[object]]
name = "ball"
shape = "sphere"
material = "clay"
scale = {scale}
"""

PLACED = """
[camera]
position = [0.0, 0.0, 5.0]
target = [0.0, 0.0, 0.0]
aperture_radius = 0.05

[environment]
color = [1.0, 1.0, 1.0]

[[object]]
file = "part.{suffix}"
{scale}
"""

CASES = {
    "a wide lens": ({"aperture_radius": 3.0, "focus_distance": 4.0}, "wider than its focus distance"),
    "an f-number": ({"f_number": 0.3}, "an f-number of 0.3 is below"),
    "a narrow view": ({"fov": 1.0}, "narrower than 2°"),
    "a wide view": ({"fov": 160.0}, "wider than 150°"),
    "darkness": ({"environment": "0,0,0"}, "nothing shines"),
    "inside": ({"camera_position": (0.0, 0.0, 0.2)}, "the camera is inside 'ball'"),
    "focus behind": ({"focus_distance": 40.0, "aperture_radius": 0.2}, "lies behind everything"),
}


def mistakes(tmp_path, lens="aperture_radius = 0.05", scale=1.0, **overrides):
    path = tmp_path / "ball.toml"
    path.write_text(BALL.format(lens=lens, scale=scale))
    return load_scene(str(path), Overrides(**overrides)).likely_mistakes


@pytest.mark.parametrize("case", CASES)
def test_a_likely_mistake_is_one_line(tmp_path, case):
    overrides, message = CASES[case]
    found = mistakes(tmp_path, **overrides)
    assert any(message in line for line in found) and not any("\n" in line for line in found)
    assert mistakes(tmp_path) == (), "the scene without the mistake"


def test_a_pinhole_that_nobody_asked_for(tmp_path):
    (line,) = mistakes(tmp_path, lens="")
    assert "the camera is a pinhole" in line
    assert mistakes(tmp_path, lens="aperture_radius = 0.0") == ()
    assert mistakes(tmp_path, lens="", aperture_radius=0.0) == ()


def test_the_shape_of_a_pinhole(tmp_path):
    (line,) = mistakes(tmp_path, aperture_radius=0.0, aperture_blades=5)
    assert "the shape of the aperture has no effect" in line
    assert mistakes(tmp_path, aperture_blades=5) == ()


@pytest.mark.parametrize("scale", [1e-5, 1e5])
def test_a_model_far_from_metres(tmp_path, scale):
    assert any(
        "lengths are in metres" in line for line in mistakes(tmp_path, scale=scale, camera_position=(0.0, 0.0, 5.0 * scale))
    )


def extents(path) -> list[str]:
    """The warnings about the extent of a scene."""
    return [line for line in load_scene(str(path)).likely_mistakes if "metres" in line or " m long" in line]


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize(
    ("extent", "told"), [(0.5, None), (99.0, None), (100.0, "100 m"), (250.0, "250 m"), (25000.0, "2.5e+04 m")]
)
def test_a_long_model_without_a_unit(tmp_path, suffix, extent, told):
    path = tmp_path / f"part.{suffix}"
    trimesh.creation.box((0.2 * extent, extent, 0.4 * extent)).export(path)
    line = f"part.{suffix}: the model is {told} long, as .{suffix} files have no unit; if its unit is the millimetre, give "
    expected = [line + "scale = 0.001 in an [[object]] of a scene file"] if told else []
    assert extents(path) == expected
    (tmp_path / "derived.toml").write_text(f'base = "part.{suffix}"\n')
    assert extents(tmp_path / "derived.toml") == expected
    (tmp_path / "twice.toml").write_text(PLACED.format(suffix=suffix, scale="") + f'[[object]]\nfile = "part.{suffix}"\n')
    for scale in (0.001, 1.0):
        (tmp_path / "scaled.toml").write_text(PLACED.format(suffix=suffix, scale=f"scale = {scale}"))
        assert not [line for line in extents(tmp_path / "scaled.toml") if "long" in line]
    assert extents(tmp_path / "twice.toml") == expected


def test_a_long_gltf_model_has_its_unit(tmp_path):
    trimesh.creation.box((250.0, 250.0, 250.0)).export(tmp_path / "part.glb")
    assert extents(tmp_path / "part.glb") == []


def test_the_unit_is_told_on_stderr(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box((250.0, 120.0, 80.0)).export("part.stl")
    assert main(["render", "part.stl", "--size", "16x9", "--spp", "1", "--mode", "uniform"]) == 0
    told = "bokehguide: warning: part.stl: the model is 250 m long, as .stl files have no unit; if its unit is"
    assert capsys.readouterr().err.count(told) == 1


def test_a_model_far_from_the_origin(tmp_path):
    for distance, far in ((100.0, False), (10_000.0, True)):
        write_gltf(tmp_path / "square.gltf", nodes=[{"children": [1], "translation": [0.0, -distance, 0.0]}, {"mesh": 0}])
        document = json.loads((tmp_path / "square.gltf").read_text())
        document["scenes"] = [{"nodes": [0]}]
        (tmp_path / "square.gltf").write_text(json.dumps(document))
        found = [line for line in load_scene(str(tmp_path / "square.gltf")).likely_mistakes if "from the origin" in line]
        assert len(found) == far and all("2.8 m in size and 1e+04 m from the origin, where" in line for line in found)


@pytest.mark.parametrize("name", BUILTIN)
def test_the_built_in_scenes_hold_none(name):
    assert load_scene(name).likely_mistakes == ()
