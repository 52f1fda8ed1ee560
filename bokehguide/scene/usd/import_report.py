"""The import report: what was read from a USD file, in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bokehguide.errors import printable
from bokehguide.scene.model import ModelState
from bokehguide.scene.usd.stage import Stage
from bokehguide.scene.usd.variants import variant_names


def supported(read: Any, opened: Stage, state: ModelState) -> Iterator[str]:
    """Lines on units, variants, time, textures, lights and cameras. read: the reader of the stage, with what it found."""
    yield f"USD stage: {opened.unit:g} m in a scene unit, {'z' if opened.world[1, 1] == 0.0 else 'y'} up"
    if variants := printable(", ".join(variant_names(opened.stage)), 600):
        yield f"variants: {variants}; drawn: {printable(state.variant or 'the selections of the file')}"
    if not opened.time.IsEarliestTime():
        yield f"time code: {opened.time.GetValue():g}"
    if read.looks.textures.count:
        yield f"textures: {read.looks.textures.count}"
    lights = {"area": len(read.emitters), "distant": len(read.suns), "dome": int(read.environment is not None)}
    if any(lights.values()):
        yield "lights: " + ", ".join(f"{kind} ({count})" for kind, count in lights.items() if count)
    if read.cameras:
        yield "cameras: " + ", ".join(f"{number} {camera.name}" for number, (_, camera) in enumerate(read.cameras))
