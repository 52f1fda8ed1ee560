"""`bokehguide scenes`."""

from __future__ import annotations

import argparse

from bokehguide.scene import DESCRIPTIONS


def run(options: argparse.Namespace) -> int:
    """Print each built-in scene with its description."""
    width = max(map(len, DESCRIPTIONS))
    for name, description in DESCRIPTIONS.items():
        print(f"{name:<{width}}  {description}")
    return 0
