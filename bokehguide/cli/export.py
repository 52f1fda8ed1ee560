"""`bokehguide export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.inputs import refuse_scene_files
from bokehguide.cli.render import overrides_from, print_warnings
from bokehguide.cli.terminal import say
from bokehguide.export import export_mitsuba
from bokehguide.scene import Scene, load_scene


def replaceable(scene: Scene, folder: Path) -> list[Path]:
    """Files of the scene that have names of exported meshes and textures."""
    places = [((folder / part).resolve(), suffix) for part, suffix in (("meshes", ".ply"), ("textures", ".exr"))]
    return [path for path in sorted(scene.files) if (path.parent, path.suffix) in places and path.stem.isdigit()]


def run(options: argparse.Namespace) -> int:
    """Write a scene for another renderer, and tell what that renderer does not have."""
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    print_warnings(scene)
    refuse_scene_files(scene, [("--out", path) for path in (options.out / "scene.xml", *replaceable(scene, options.out))])
    print_folders(make_folders([options.out]))
    for line in export_mitsuba(scene, options.out):
        say(f"warning: {line}")
    print(f"wrote {options.out / 'scene.xml'}")
    return 0
