"""Questions about the present job, which the thread of the renderer answers between two steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from bokehguide.errors import BokehguideError
from bokehguide.view.job import Job

Answer = TypeVar("Answer")


class Questions:
    """Functions of a job that wait for their turn: of any job, or of an exact one. Any thread may call `ask`."""

    def __init__(self) -> None:
        self.of_any: deque[tuple[Callable[[Job], Any], Future[Any]]] = deque()
        self.of_exact: deque[tuple[Callable[[Job], Any], Future[Any]]] = deque()

    def ask(self, question: Callable[[Job], Answer], exact: bool) -> Future[Answer]:
        """The later answer of a question. exact: whether it needs an exact job."""
        future: Future[Answer] = Future()
        (self.of_exact if exact else self.of_any).append((question, future))
        return future

    def answer(self, job: Job | None) -> None:
        """Answer all questions that the job can answer. Without a job, questions of any job are cancelled."""
        if job is not None and job.exact:
            self.of_any.extend(self.of_exact)
            self.of_exact.clear()
        while self.of_any:
            question, future = self.of_any.popleft()
            if job is None:
                future.cancel()
            elif future.set_running_or_notify_cancel():
                try:
                    future.set_result(question(job))
                except Exception as error:  # for the one who asked
                    future.set_exception(error)

    def refuse(self) -> None:
        """End the questions of an exact job: another picture takes its place."""
        while self.of_exact:
            error = BokehguideError("the picture changed before its samples were exact; save it again")
            self.of_exact.popleft()[1].set_exception(error)
