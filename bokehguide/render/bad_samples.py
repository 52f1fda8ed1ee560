"""Bad samples: NaN or infinite samples, which a film omits and reports."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.runtime.indexing import Pixels, indices_of_each

KEPT_BAD_SAMPLES = 100
"""Largest number of bad samples that a film reports individually."""


class BadSample(NamedTuple):
    """A NaN or infinite sample: pixel of the frame, step and seed."""

    x: int
    y: int
    step: int
    seed: int


class BadSamples:
    """The bad samples of a film. Threads may call `suspect` concurrently.

    width, height: of the film, pixels. seed: for the reports. corner: as in `Film`.
    """

    def __init__(self, width: int, height: int, seed: int, corner: tuple[int, int]):
        self._width, self._height, self._seed, self._corner = width, height, seed, corner
        self._count = 0
        self._samples: list[BadSample] = []
        self._suspects: list[tuple[Pixels, Tensor, int]] = []
        """Batches that may contain bad samples: pixels, whether samples are finite, bool `[N]`, and the step."""
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        self.find()
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)
        self._lock = threading.Lock()

    def state_dict(self) -> dict[str, object]:
        """The number of bad samples, and the first of them as tuples."""
        return {"bad_count": self.count, "bad_samples": [tuple(bad) for bad in self.samples]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self._count, self._suspects = state["bad_count"], []
        self._samples = [BadSample(*bad) for bad in state["bad_samples"]]

    def suspect(self, pixels: Pixels, good: Tensor, step: int) -> None:
        """Keep a batch that may contain bad samples; good: whether a sample is finite, bool `[N]`."""
        self._suspects.append((pixels, good, step))

    def find(self) -> None:
        """Count the bad samples of all batches. From a GPU, the results of all batches are read at once."""
        with self._lock:
            suspects, self._suspects = self._suspects, []
            for (pixels, good, step), places in zip(suspects, indices_of_each([~good for _, good, _ in suspects])):
                if len(places) > 0:
                    self._report(torch.arange(self._width * self._height, device=good.device)[pixels][places], step)

    def _report(self, pixels: Tensor, step: int) -> None:
        left, top = self._corner
        found = [BadSample(left + p % self._width, top + p // self._width, step, self._seed) for p in pixels.tolist()]
        self._count += len(found)
        self._samples = earliest(self._samples + found)

    @property
    def count(self) -> int:
        """Number of bad samples."""
        self.find()
        return self._count

    @property
    def samples(self) -> list[BadSample]:
        """First bad samples, in the order of steps and pixels."""
        self.find()
        return list(self._samples)


def earliest(samples: list[BadSample]) -> list[BadSample]:
    """First KEPT_BAD_SAMPLES samples in the order of steps and pixels."""
    return sorted(samples, key=lambda bad: (bad.step, bad.y, bad.x))[:KEPT_BAD_SAMPLES]
