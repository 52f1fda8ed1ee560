"""Inputs of a command, which its outputs must not replace."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.scene import Scene


def refuse_scene_files(scene: Scene, outputs: Iterable[tuple[str, Path | None]]) -> None:
    """Raise BokehguideError if an output, with the option that names it, is a file that the scene was read from."""
    for option, path in outputs:
        if path is not None and Path(os.path.realpath(path)) in scene.files:  # `resolve` raises for a cycle of links
            raise BokehguideError(f"{option}: {str(path)!r} is a file of the scene; give another path")
