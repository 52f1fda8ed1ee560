"""The checkpoint of `bokehguide render`: PATH.ckpt beside PATH.exr."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from bokehguide.errors import BokehguideError
from bokehguide.train import RenderLoop, load_checkpoint, save_checkpoint


class Checkpoints:
    """Keeps the state of one render in a file.

    every: seconds from one save to the next, 0 for no file at all.
    """

    def __init__(self, path: Path, every: float):
        self.path, self.every = path, every
        self._last = time.monotonic()
        self._saved_step = 0

    def resume(self, loop: RenderLoop) -> float:
        """Go on from the file, or start anew where there is none, and say which; returns the seconds so far.

        Raises BokehguideError where it is of another render, damaged, or holds more samples than are asked for.
        """
        if not self.path.exists():
            print(f"bokehguide: there is no {self.path} to resume; starting anew", file=sys.stderr)
            return 0.0
        seconds = load_checkpoint(self.path, loop)
        step = self._saved_step = loop.step_number
        if step > loop.settings.spp:
            raise BokehguideError(f"{self.path}: holds {step} SPP already; give --spp {step} or more")
        print(f"bokehguide: resuming {self.path} at {step} SPP", file=sys.stderr)
        return seconds

    def due(self) -> bool:
        return 0.0 < self.every <= time.monotonic() - self._last

    def save(self, loop: RenderLoop, seconds: float) -> None:
        """Write the state. Where it cannot be written, warn: the render can still end well."""
        if self.every > 0.0 and loop.step_number > self._saved_step:
            try:
                save_checkpoint(self.path, loop, seconds)
                self._saved_step = loop.step_number
            except BokehguideError as error:
                print(f"bokehguide: warning: {error}", file=sys.stderr)
        self._last = time.monotonic()

    def holds(self, loop: RenderLoop) -> bool:
        """Whether the file has the state that the loop is in."""
        return 0 < self._saved_step == loop.step_number
