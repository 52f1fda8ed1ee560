"""Worker threads of a render loop. They do not change settings of the process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import ParamSpec, Self, TypeVar

import torch

from bokehguide.runtime.device import own_stream

P = ParamSpec("P")
Item = TypeVar("Item")
Result = TypeVar("Result")

_default_lock = threading.Lock()
"""Lock for the time in which PyTorch's default number of OpenMP threads is changed."""


class Workers:
    """A pool of threads with one OpenMP thread each.

    The constructor starts no thread: threads start with the first call of `map` or `submit`. They end with `close`, at the end of
    the context, or when the object is garbage-collected.

    threads: number of threads. device: of the tensors that `map` works on. closed: whether `close` was called.
    """

    def __init__(self, threads: int, device: torch.device):
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        self.threads, self.closed = threads, False
        self._device = device
        # The threads hold the initializer. It must not refer to this object, or the object would never be collected.
        self._pool = ThreadPoolExecutor(threads, "bokehguide", _begin_thread, (device,))

    def map(self, work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Results of `work` for each item, in the items' order. On CUDA, each thread uses its own stream.

        If `work` raises exceptions, the method waits for all running items, and raises the first exception in the items' order.
        """

        def run(item: Item) -> Result:
            with own_stream(self._device):
                return work(item)

        futures = [self.submit(run, item) for item in items]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()
            wait(futures)

    def submit(self, work: Callable[P, Result], *args: P.args, **kwargs: P.kwargs) -> Future[Result]:
        """Start `work` on one of the threads. Raises RuntimeError after `close`."""
        return self._pool.submit(work, *args, **kwargs)

    @contextmanager
    def serial(self) -> Iterator[None]:
        """A context in which the calling thread has one OpenMP thread."""
        before = _set_openmp_threads(1)
        try:
            yield
        finally:
            _set_openmp_threads(before)

    def close(self) -> None:
        """Wait for the threads' work and end them."""
        self.closed = True
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _begin_thread(device: torch.device) -> None:
    _set_openmp_threads(1)
    if device.type == "cuda":
        torch.cuda.set_device(device)  # each thread has its own current device


def _set_openmp_threads(count: int) -> int:
    """Set the number of OpenMP threads of the calling thread only; returns the previous number.

    `torch.set_num_threads` also sets the default of threads that have not used PyTorch yet. Another thread restores the default.
    """
    with _default_lock:
        before = torch.get_num_threads()
        if before == count:
            return before
        ready, changed = threading.Event(), threading.Event()

        def keep_default() -> None:
            default = torch.get_num_threads()
            ready.set()
            changed.wait()
            torch.set_num_threads(default)

        keeper = threading.Thread(target=keep_default)
        keeper.start()
        try:
            ready.wait()
            torch.set_num_threads(count)
        finally:
            changed.set()
            keeper.join()
        return before
