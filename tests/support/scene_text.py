"""Parts of scene files in TOML."""

from __future__ import annotations

from pathlib import Path

from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Scene

CAMERA = """
[camera]
position = [0.0, 1.0, 6.0]
target = [0.0, 1.0, 0.0]
"""
BALL = """
[materials.grey]
base_color = [0.5, 0.5, 0.5]
[[object]]
shape = "sphere"
material = "grey"
"""
BOX_AND_EMITTER = """
[camera]
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
fov = 40.0
aperture_radius = 0.5
focus_distance = 3.0
[film]
width = 32
height = 20
max_depth = 3
[environment]
color = [0.02, 0.03, 0.05]
[materials.wall]
base_color = [0.5, 0.4, 0.3]
[materials.emitter]
base_color = [0.0, 0.0, 0.0]
emission = [40.0, 30.0, 20.0]
[[object]]
shape = "box"
material = "wall"
translate = [-0.6, -0.3, 0.5]
[[object]]
shape = "sphere"
material = "emitter"
translate = [0.5, 0.2, -3.0]
scale = 0.2
"""
"""A box in focus and an emitter behind it, 32 × 20 pixels."""


def load(folder: Path, text: str, overrides: Overrides | None = None) -> Scene:
    """The scene of a file with this text, written to a folder."""
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(str(path), overrides or Overrides())
