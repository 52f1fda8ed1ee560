"""`bokehguide info`."""

from __future__ import annotations

import argparse

from bokehguide.scene import load_scene, summarize


def run(options: argparse.Namespace) -> int:
    """Print the contents of a scene, and the ignored parts of its files."""
    print(summarize(load_scene(options.scene, allow_outside=options.allow_outside)))
    return 0
