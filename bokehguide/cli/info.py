"""`bokehguide info`."""

from __future__ import annotations

import argparse

from bokehguide.scene import describe, load_scene


def run(options: argparse.Namespace) -> int:
    """Print what was loaded and what of it was ignored."""
    print(describe(load_scene(options.scene, allow_outside=options.allow_outside)))
    return 0
