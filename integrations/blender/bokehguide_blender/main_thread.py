"""Calls in Blender's main thread, in which operators may run."""

from __future__ import annotations

import threading
from collections.abc import Callable

import bpy

from .messages import Cancelled

INTERVAL = 0.1
"""Seconds between two checks for a cancellation."""


def in_main_thread(function: Callable[[], None], cancelled: Callable[[], bool]) -> None:
    """Call `function` in the main thread and wait for its end. Raises what `function` raises, and Cancelled.

    A render from the interface runs in a thread of its own while the main thread handles events. A render by a script or without
    an interface runs in the main thread.
    """
    if threading.current_thread() is threading.main_thread():
        function()
        return
    call = _Call(function)
    bpy.app.timers.register(call.run, first_interval=0.0)
    while not call.done.wait(INTERVAL):
        if cancelled():
            call.revoked = True
            raise Cancelled
    if call.error is not None:
        raise call.error


class _Call:
    """One call. revoked: the call is no longer wanted."""

    def __init__(self, function: Callable[[], None]):
        self.done, self.revoked = threading.Event(), False
        self.error: Exception | None = None
        self._function = function

    def run(self) -> None:
        """Called by a timer in the main thread; returns None, so that the timer ends."""
        try:
            if not self.revoked:
                self._function()
        except Exception as error:
            self.error = error
        finally:
            self.done.set()
