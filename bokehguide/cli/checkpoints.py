"""The checkpoint of `bokehguide render`: PATH.ckpt beside PATH.exr."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.train import RenderLoop, load_checkpoint, save_checkpoint, saved_steps


class Checkpoints:
    """Keeps the state of one render in a file.

    every: seconds from one save to the next, 0 for no file at all; speaks: whether notes go to stderr.
    """

    def __init__(self, path: Path, every: float, speaks: bool = True):
        self.path, self.every, self._speaks = path, every, speaks
        self._last = time.monotonic()
        self._saved_step = 0

    def begin(self, loop: RenderLoop, resume: bool) -> float:
        """Go on from the file, or start anew, and say so; returns the seconds that the render has taken so far.

        A file of the same render stays until there are more samples than it holds.
        Raises BokehguideError where `resume` finds another render, a damaged file or more samples than are asked for.
        """
        if resume and self.path.exists():
            seconds = load_checkpoint(self.path, loop)
            step = self._saved_step = loop.step_number
            if step > loop.settings.spp:
                raise BokehguideError(f"{self.path}: holds {step} SPP already; give --spp {step} or more")
            self._note(f"resuming {self.path} at {step} SPP")
            return seconds
        if resume:
            self._note(f"there is no {self.path} to resume; starting anew")
        elif self.every > 0.0:
            step = self._saved_step = saved_steps(self.path, loop)
            if step > 0:
                self._note(f"{self.path} holds {step} SPP of this render, and stays until there are more; see --resume")
        return 0.0

    def due(self) -> bool:
        return 0.0 < self.every <= time.monotonic() - self._last

    def save(self, loop: RenderLoop, seconds: float) -> None:
        """Write the state; collective. Where it cannot be written, warn: the render can still end well."""
        if self.every > 0.0 and loop.step_number > self._saved_step:
            try:
                save_checkpoint(self.path, loop, seconds)
                self._saved_step = loop.step_number
            except BokehguideError as error:
                self._note(f"warning: {error}")
        self._last = time.monotonic()

    def ahead(self, loop: RenderLoop) -> bool:
        """Whether the file has a later state of the same render than the loop is in, and pictures of it may be beside it."""
        return self._saved_step > loop.step_number

    def holds(self, loop: RenderLoop) -> bool:
        """Whether the file has the state that the loop is in."""
        return 0 < self._saved_step == loop.step_number

    def _note(self, text: str) -> None:
        if self._speaks:
            print(f"bokehguide: {text}", file=sys.stderr)
