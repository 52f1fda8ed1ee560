"""`bokehguide scenes`."""

from __future__ import annotations

import argparse

from bokehguide.scene import BUILTIN


def run(options: argparse.Namespace) -> int:
    """Print each built-in scene with what it shows."""
    width = max(map(len, BUILTIN))
    for name, build in BUILTIN.items():
        print(f"{name:<{width}}  {build().description}")
    return 0
