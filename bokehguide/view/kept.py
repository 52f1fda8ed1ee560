"""Learned state that stays when the camera or the lens of the page changes."""

from __future__ import annotations

from bokehguide.guiding.inheritance import Learned
from bokehguide.render import PathTracer
from bokehguide.train import RenderLoop


class Kept:
    """What the latest picture at full size has learned. Only one thread may call `learned`, which also runs the loop's steps."""

    def __init__(self) -> None:
        self._loop: RenderLoop | None = None
        self._learned: Learned | None = None
        self._of: tuple[str, PathTracer] | None = None
        """Mode and tracer of `_learned`."""

    def take(self, loop: RenderLoop) -> None:
        """Learn from a loop that takes no further step, when `learned` is called."""
        self._loop = loop

    def learned(self, mode: str, tracer: PathTracer) -> Learned | None:
        """What a picture of this mode with the lights of this tracer may begin with."""
        loop, self._loop = self._loop, None
        found = None if loop is None else loop.learned()
        if loop is not None and found is not None:
            self._learned, self._of = found, (loop.settings.mode, loop.tracer)
        return self._learned if self._of == (mode, tracer) else None
