"""The checkpoint of `bokehguide render`: PATH.ckpt beside PATH.exr."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.train import AdaptiveLoop, RenderLoop, load_checkpoint, save_checkpoint, saved_steps


class Checkpoints:
    """The checkpoint file of one render.

    every: seconds from one save to the next, 0 for no file; silent: print no notes on stderr.
    """

    def __init__(self, path: Path, every: float, silent: bool = False):
        self.path, self.every, self._silent = path, every, silent
        self._last = time.monotonic()
        self._saved_step = 0

    def begin(self, loop: RenderLoop | AdaptiveLoop, resume: bool) -> float:
        """Load the file into the loop if `resume` is set and the file exists; returns the seconds of earlier sessions.

        Without `resume`, a file of the same render stays until the loop has more SPP than the file.
        Raises BokehguideError if `resume` finds another render, a damaged file, or more SPP than the settings ask for.
        """
        if resume and self.path.exists():
            seconds = load_checkpoint(self.path, loop)
            step = self._saved_step = loop.step_number
            if step > loop.settings.spp:
                raise BokehguideError(f"{self.path}: has {step} SPP already; give --spp {step} or more")
            self._note(f"resuming {self.path} at {step} SPP")
            return seconds
        if resume:
            self._note(f"no {self.path} to resume; starting from the first step")
        elif self.every > 0.0:
            step = self._saved_step = saved_steps(self.path, loop)
            if step > 0:
                self._note(f"{self.path} has {step} SPP of this render and stays until this run has more; see --resume")
        return 0.0

    def due(self) -> bool:
        return 0.0 < self.every <= time.monotonic() - self._last

    def save(self, loop: RenderLoop | AdaptiveLoop, seconds: float) -> None:
        """Write the state; collective. Warns if the file cannot be written, as the render can still succeed."""
        if self.every > 0.0 and loop.step_number > self._saved_step:
            try:
                save_checkpoint(self.path, loop, seconds)
                self._saved_step = loop.step_number
            except BokehguideError as error:
                self._note(f"warning: {error}")
        self._last = time.monotonic()

    def ahead(self, loop: RenderLoop | AdaptiveLoop) -> bool:
        """Whether the file has a later state of the same render than the loop; images of that state may exist."""
        return self._saved_step > loop.step_number

    def holds(self, loop: RenderLoop | AdaptiveLoop) -> bool:
        """Whether the file has the current state of the loop."""
        return 0 < self._saved_step == loop.step_number

    def _note(self, text: str) -> None:
        if not self._silent:
            print(f"bokehguide: {text}", file=sys.stderr)
