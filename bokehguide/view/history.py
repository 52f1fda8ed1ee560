"""The states before each change, for undo."""

from __future__ import annotations

import time
from dataclasses import replace

from bokehguide.errors import BokehguideError
from bokehguide.view.state import ViewState

LONGEST = 200
"""Number of changes that can be undone."""
TOGETHER = 1.0
"""Seconds between two changes of one kind, such as moves of a drag, that count as one change."""


class History:
    """Earlier states, the latest last. The layer that is shown is no part of them."""

    def __init__(self) -> None:
        self._states: list[ViewState] = []
        self._last: tuple[object, float] = (None, 0.0)

    def __len__(self) -> int:
        return len(self._states)

    def add(self, before: ViewState, after: ViewState, kind: object) -> None:
        """Keep the state before a change. Changes of an equal kind that follow at once belong to it."""
        if before == replace(after, layer=before.layer):
            return
        now, (last, at) = time.monotonic(), self._last
        self._last = kind, now
        if kind != last or now - at > TOGETHER or not self._states:
            self._states = [*self._states[1 - LONGEST :], before]

    def undone(self, state: ViewState) -> ViewState:
        """The state before the last change. Raises BokehguideError without one."""
        if not self._states:
            raise BokehguideError("undo: nothing has been changed")
        self._last = None, 0.0
        return replace(self._states.pop(), layer=state.layer)
