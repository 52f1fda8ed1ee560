"""`bokehguide export`."""

from __future__ import annotations

import argparse

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.render import overrides_from, print_warnings
from bokehguide.cli.terminal import say
from bokehguide.export import export_mitsuba
from bokehguide.scene import load_scene


def run(options: argparse.Namespace) -> int:
    """Write a scene for another renderer, and tell what that renderer does not have."""
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    print_warnings(scene)
    print_folders(make_folders([options.out]))
    for line in export_mitsuba(scene, options.out):
        say(f"warning: {line}")
    print(f"wrote {options.out / 'scene.xml'}")
    return 0
