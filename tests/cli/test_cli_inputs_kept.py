"""No command replaces a file that its scene was read from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.cli import main
from bokehguide.image import write_exr
from bokehguide.scene import Overrides, load_scene

SURROUNDINGS = '[environment]\nmap = "sky.exr"\n[materials.wall]\nbase_color_texture = "wall.png"\n'
COMMANDS = {
    "info room.toml --json room.toml": ("--json", "room.toml"),
    "info room.toml --picture wall.png": ("--picture", "wall.png"),
    "info derived.toml --json room.toml": ("--json", "room.toml"),
    "render room.toml --spp 1 --json room.toml": ("--json", "room.toml"),
    "render room.toml --spp 1 --out sky.exr": ("--out", "sky.exr"),
    "render room.toml --spp 1 --out wall.exr": ("--out", "wall.png"),
    "render room.toml --spp 1 --out folder/../linked.exr": ("--out", "linked.exr"),
    "render emitters.toml --environment sky.exr --spp 1 --out sky.exr": ("--out", "sky.exr"),
    "render emitters.toml --aperture-image wall.png --spp 1 --out wall.exr": ("--out", "wall.png"),
    "render derived.toml --spp 1 --out wall.exr": ("--out", "wall.png"),
    "compare reference.toml --modes uniform --spp 1 --reference-spp 2 --out .": ("--out", "reference.exr"),
    "export scene.xml --to mitsuba --out .": ("--out", "scene.xml"),
    "export copy.xml --to mitsuba --out .": ("--out", ".ply"),
}
"""Commands with the option and the file that their message names."""


@pytest.fixture
def room(lamps_folder: Path) -> Path:
    """The current folder, with scenes that have a map and a texture."""
    text = Path("emitters.toml").read_text()
    start, end = text.index("[environment]"), text.index("base_color = [0.5, 0.4, 0.3]")
    text = text[:start] + SURROUNDINGS + text[end:].replace("base_color = [0.5, 0.4, 0.3]\n", "", 1)
    Path("room.toml").write_text(text)
    Path("reference.toml").write_text(text.replace("sky.exr", "reference.exr"))
    Path("derived.toml").write_text('base = "room.toml"\n')
    for name in ("sky", "reference"):
        write_exr(f"{name}.exr", {"beauty": np.ones((8, 16, 3), np.float32)})
    Image.new("RGB", (4, 4), (200, 100, 50)).save("wall.png")
    Path("folder").mkdir()
    Path("linked.exr").symlink_to("sky.exr")
    assert main(["export", "room.toml", "--to", "mitsuba", "--out", "exported"]) == 0
    for name in ("scene", "copy"):
        Path(f"{name}.xml").write_bytes(Path("exported/scene.xml").read_bytes())
    for part in ("meshes", "textures"):
        Path("exported", part).rename(part)
    return lamps_folder


@pytest.mark.parametrize("command", COMMANDS)
def test_an_output_that_is_a_file_of_the_scene_is_an_error(command, room, capfd):
    before = {path: path.read_bytes() for path in room.rglob("*") if path.is_file()}
    capfd.readouterr()
    assert main(command.split()) == 2
    option, name = COMMANDS[command]
    error = [line for line in capfd.readouterr().err.splitlines() if "error: " in line]
    assert len(error) == 1
    assert error[0].startswith(f"bokehguide: error: {option}: ")
    assert name in error[0] and "is a file of the scene" in error[0]
    assert {path: path.read_bytes() for path in room.rglob("*") if path.is_file()} == before


def test_other_outputs_in_the_folder_of_the_scene_are_written(room):
    assert main(["render", "room.toml", "--mode", "uniform", "--spp", "1", "--out", "room.exr", "--json", "facts.json"]) == 0
    assert main(["info", "room.toml", "--json", "facts.json", "--picture", "plan.png"]) == 0
    assert main(["export", "room.toml", "--to", "mitsuba", "--out", "exported"]) == 0
    assert json.loads(Path("facts.json").read_text())["scene"] == "room"
    assert Path("room.exr").exists() and Path("room.png").exists() and Path("plan.png").exists()


def test_a_cycle_of_links_is_no_file_of_the_scene(room):
    """The picture takes the place of the link."""
    Path("cycle.exr").symlink_to("cycle.exr")
    assert main(["render", "room.toml", "--mode", "uniform", "--spp", "1", "--out", "cycle.exr"]) == 0
    assert Path("cycle.exr").is_file()


def test_a_scene_names_its_files(room):
    assert {path.name for path in load_scene("derived.toml").files} == {"derived.toml", "room.toml", "sky.exr", "wall.png"}
    assert load_scene("fairy-lights").files == frozenset()


def test_texts_too_long_for_a_path_are_no_files_of_a_scene(room):
    digits = "1." + 300 * "0"
    assert len(load_scene("room.toml", Overrides(environment=f"{digits},1,1")).files) == 3
    Path("a.mtl").write_text(f"newmtl red\nmap_Kd {300 * 'x'}.png\n")
    Path("a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl red\nf 1/1 2/1 3/1\n")
    assert {path.name for path in load_scene("a.obj").files} == {"a.obj", "a.mtl"}
