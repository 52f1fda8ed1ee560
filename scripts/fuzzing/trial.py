"""Requirements on a loader: it refuses a file in one or two lines, or makes a scene that can be traced."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene import Scene, load_scene, summarize
from bokehguide.scene.types import FilmSettings
from bokehguide.train import RenderLoop, RenderSettings, load_checkpoint

LONGEST = 1500
"""Largest number of characters of a message."""


class Fault(Exception):
    """A violated requirement."""


def trial(path: Path) -> bool:
    """Load a scene or a checkpoint, and trace; returns whether it was loaded. Raises Fault or any other exception."""
    try:
        if path.suffix == ".ckpt":
            loop = RenderLoop(sound_scene(path.with_name("scene.toml")), RenderSettings(path.stem, threads=1))
            load_checkpoint(path, loop)
        else:
            scene = load_scene(str(path))
    except BokehguideError as error:
        check_message(str(error), path)
        return False
    if path.suffix != ".ckpt":
        check_scene(scene)
        small = replace(scene, film=FilmSettings(16, 9, min(scene.film.max_depth, 4)))
        loop = RenderLoop(small, RenderSettings("uniform", threads=1))
    loop.step()
    loop.guide_images()
    if loop.film.bad_count or not loop.film.radiance().isfinite().all():
        raise Fault(f"{loop.film.bad_count} samples are not finite, or the picture is not")
    return True


@lru_cache(maxsize=1)
def sound_scene(path: Path) -> Scene:
    return load_scene(str(path))


def check_message(text: str, path: Path) -> None:
    """Raise Fault unless a message names a file of the scene, has at most two lines, and is printable."""
    lines = text.splitlines()
    if not lines or len(lines) > 2 or not all(line.isprintable() for line in lines) or len(text) > LONGEST:
        raise Fault(f"a message of {len(lines)} lines, {len(text)} characters: {text[:300]!r}")
    if str(path.parent) not in text:
        raise Fault(f"a message that names no file: {text!r}")
    if any(word in text for word in ("MemoryError", "allocate", "bad_alloc", "Cannot allocate")):
        raise Fault(f"memory ran out before the file was refused: {text!r}")


def check_scene(scene: Scene) -> None:
    """Raise Fault unless the arrays and texts of a scene are valid."""
    for mesh in scene.meshes:
        for name in ("vertices", "normals", "uvs", "tangents", "colors"):
            values = getattr(mesh, name)
            if values is not None and (
                values.dtype != np.float32 or len(values) != len(mesh.vertices) or not np.isfinite(values).all()
            ):
                raise Fault(f"{name} are {values.dtype} {values.shape}, or not finite")
        if mesh.triangles.dtype != np.int32 or mesh.triangles.min() < 0 or mesh.triangles.max() >= len(mesh.vertices):
            raise Fault("indices lead out of the vertices")
    texts = [*summarize(scene).splitlines(), *scene.warnings, *scene.supported]
    if not all(line.isprintable() for line in texts):
        raise Fault(f"a text is not printable: {next(line for line in texts if not line.isprintable())!r}")
