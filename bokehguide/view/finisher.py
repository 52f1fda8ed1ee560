"""The thread that makes the exact picture of a job that rests."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from bokehguide.errors import BokehguideError
from bokehguide.runtime.process import return_freed_memory
from bokehguide.view.job import Job
from bokehguide.view.pictures import Shown, exact
from bokehguide.view.state import ViewState

log = logging.getLogger(__name__)

REST = 0.3
"""Seconds that a picture rests before the exact one is made, so that a drag does not wait for it."""


class Finisher:
    """Makes exact pictures, which take seconds: the denoiser of `bokehguide render`, and the views without a table.

    publish: receives the job, its state and revision, and the picture. It must compare them with what is wanted by then.
    """

    def __init__(self, publish: Callable[[Job, ViewState, int, Shown], None]):
        self._publish = publish
        self._pool = ThreadPoolExecutor(1, "finisher")
        self._stopped = threading.Event()

    def start(self, job: Job, state: ViewState, revision: int) -> None:
        """Make the picture of a job that takes no further step until `stop`."""
        self.stop()
        self._stopped = stopped = threading.Event()
        self._pool.submit(self._finish, job, state, revision, stopped)

    def stop(self) -> None:
        """Make no picture that has not been begun."""
        self._stopped.set()

    def close(self) -> None:
        """End the thread."""
        self.stop()
        self._pool.shutdown()

    def _finish(self, job: Job, state: ViewState, revision: int, stopped: threading.Event) -> None:
        if stopped.wait(REST):
            return_freed_memory()  # earlier pictures had other sizes
            return
        try:
            shown = exact(job.loop, state)
        except BokehguideError as error:
            log.warning("%s", error)
            return
        if not stopped.is_set():
            self._publish(job, state, revision, shown)
            return_freed_memory()
