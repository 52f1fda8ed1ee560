"""The checkpoint of `bokehguide render`: PATH.ckpt beside PATH.exr."""

from __future__ import annotations

import re
import time
from contextlib import suppress
from itertools import count
from pathlib import Path

from bokehguide.cli.terminal import say
from bokehguide.errors import BokehguideError
from bokehguide.image.files import written_file
from bokehguide.train import AdaptiveLoop, RenderLoop, load_checkpoint, save_checkpoint, saved_state
from bokehguide.train.checkpoint import ANOTHER, UNREADABLE

INTERVAL = 60.0
"""Seconds from one save to the next, by default."""


class Checkpoints:
    """The checkpoint file of one render.

    every: seconds from one save to the next, 0 for no file; None: INTERVAL, and the file is removed when the render ends by
    itself. silent: print no notes on stderr.
    """

    def __init__(self, path: Path, every: float | None, silent: bool):
        self.path, self._silent = path, silent
        self.every = INTERVAL if every is None else every
        self._kept = every is not None
        """Whether the file stays when the render ends by itself: the user has asked for it, now or when it was written."""
        self._resumes = False
        """Whether the user continues the render session by session: the file stays until the render is complete."""
        self._last = time.monotonic()
        self._saved_step = 0
        self._stranger = ""
        """What the file is, if it is not of this render: see `SavedState`."""
        self._changed = ""
        """The inputs in which the file's render differs: see `SavedState`."""

    def begin(self, loop: RenderLoop | AdaptiveLoop, resume: bool, restarted: bool = False) -> float:
        """Load the file into the loop if `resume` is set and the file exists; returns the seconds of earlier sessions.

        Without `resume`, a file of the same render stays until the loop has more SPP than the file. Any other file gets another
        name before the first save. restarted: whether a rank of this job has died; the loop then loads a file of the same render.
        Raises BokehguideError if `resume` finds another render, a damaged file, or more SPP than the settings ask for.
        """
        self._resumes = resume
        if resume and self.path.exists():
            return self._load(loop)
        if resume:
            advice = "a finished render keeps one with --checkpoint-every SECONDS"
            self._note(f"no {self.path} to resume; starting from the first step ({advice})")
        elif self.every > 0.0:
            saved = saved_state(self.path, loop)
            if restarted and 0 < saved.step <= loop.settings.spp:
                return self._load(loop)
            self._saved_step, self._kept = saved.step, self._kept or saved.kept
            self._stranger, self._changed = saved.stranger, saved.changed
            if saved.step > 0:
                self._note(f"{self.path} has {saved.step} SPP of this render and stays until this run has more; see --resume")
        return 0.0

    def _load(self, loop: RenderLoop | AdaptiveLoop) -> float:
        """Load the file into the loop; returns the seconds of earlier sessions. Raises BokehguideError as `begin` does."""
        seconds = load_checkpoint(self.path, loop)
        self._kept |= saved_state(self.path, loop).kept
        step = self._saved_step = loop.step_number
        if step > loop.settings.spp:
            raise BokehguideError(f"{self.path}: has {step} SPP already; give --spp {step} or more")
        self._note(f"resuming {self.path} at {step} SPP")
        return seconds

    def due(self) -> bool:
        return 0.0 < self.every <= time.monotonic() - self._last

    def save(self, loop: RenderLoop | AdaptiveLoop, seconds: float) -> None:
        """Write the state; collective. Warns if the file cannot be written, as the render can still succeed."""
        if self.every > 0.0 and loop.step_number > self._saved_step:
            self._set_aside(loop)
            try:
                save_checkpoint(self.path, loop, seconds, self._kept)
                self._saved_step = loop.step_number
            except BokehguideError as error:
                self._note(f"warning: {error}")
        self._last = time.monotonic()

    def end(self, loop: RenderLoop | AdaptiveLoop, seconds: float, interrupted: bool) -> None:
        """Save the last state if the render was interrupted or the file is to stay; collective."""
        if interrupted or self._stays(loop):
            self.save(loop, seconds)

    def remove(self, loop: RenderLoop | AdaptiveLoop) -> None:
        """Remove the file that is not to stay, once the picture is written. A file with more SPP stays."""
        if not self._stays(loop) and 0 < self._saved_step <= loop.step_number:
            with suppress(OSError):
                written_file(self.path).unlink()
            self._saved_step = 0

    def ahead(self, loop: RenderLoop | AdaptiveLoop) -> bool:
        """Whether the file has a later state of the same render than the loop; images of that state may exist."""
        return self._saved_step > loop.step_number

    def holds(self, loop: RenderLoop | AdaptiveLoop) -> bool:
        """Whether the file has the current state of the loop."""
        return 0 < self._saved_step == loop.step_number

    def _stays(self, loop: RenderLoop | AdaptiveLoop) -> bool:
        """Whether the file stays when the render ends by itself."""
        return self._kept or (self._resumes and not loop.complete)

    def _set_aside(self, loop: RenderLoop | AdaptiveLoop) -> None:
        """Rename a file that is not of this render to the first free name, and tell it."""
        if self._stranger and loop.ranks.first:
            new = _free_name(self.path)
            with suppress(OSError):  # the save fails too then, and warns
                self.path.rename(new)
                options = f"that render's options with --out {new.with_suffix('.exr')} --resume continue it"
                another = f"; {options}\nDifferences: {self._changed}"
                remedy = {ANOTHER: another, UNREADABLE: ""}.get(self._stranger, "; that version continues it")
                self._note(f"{self.path} {self._stranger} and is {new} now{remedy}")
                self._tell_others()
        self._stranger = ""

    def _tell_others(self) -> None:
        """Tell the number and the size of the files that have got another name, from the second on."""
        name = re.compile(rf"{re.escape(self.path.stem)}-\d+\.ckpt")
        others = [path for path in self.path.parent.iterdir() if name.fullmatch(path.name)]
        if len(others) > 1:
            size = sum(path.stat().st_size for path in others) / 2**20
            names = self.path.with_name(f"{self.path.stem}-NUMBER.ckpt")
            self._note(f"{len(others)} files {names} take {size:.1f} MB; remove the files that no render continues")

    def _note(self, text: str) -> None:
        if not self._silent:
            say(text)


def _free_name(path: Path) -> Path:
    """The first of PATH-2.ckpt, PATH-3.ckpt, … that neither a checkpoint nor a picture has."""
    names = (path.with_name(f"{path.stem}-{number}.ckpt") for number in count(2))
    return next(name for name in names if not any(name.with_suffix(kind).exists() for kind in (".ckpt", ".exr", ".png")))
