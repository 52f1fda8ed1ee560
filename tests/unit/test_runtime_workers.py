"""Worker threads leave the process around them unchanged, and end."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import torch

from bokehguide.runtime.workers import Workers
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes

CPU = torch.device("cpu")
OUTSIDE = 5
"""OpenMP threads of the process around the workers."""


@pytest.fixture(autouse=True)
def outside() -> Iterator[None]:
    """A process with several OpenMP threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(OUTSIDE)
    yield
    torch.set_num_threads(before)


def in_new_thread(function: Callable):
    results = []
    thread = threading.Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join()
    return results[0]


def assert_unchanged() -> None:
    assert torch.get_num_threads() == in_new_thread(torch.get_num_threads) == OUTSIDE


def started_since(earlier: set[threading.Thread]) -> set[threading.Thread]:
    return set(threading.enumerate()) - earlier


def test_the_process_is_the_same_before_during_and_after():
    earlier = set(threading.enumerate())  # threads of an earlier test may still be ending
    workers = Workers(3, CPU)
    assert not started_since(earlier), "construction starts nothing"
    barrier = threading.Barrier(4, timeout=30.0)

    def work(_: int) -> int:
        barrier.wait()  # three threads are at work
        barrier.wait()  # the process around them has been looked at
        return torch.get_num_threads()

    futures = [workers.submit(work, number) for number in range(3)]
    barrier.wait()
    assert len(started_since(earlier)) == 3
    assert_unchanged()
    barrier.wait()
    assert [future.result() for future in futures] == [1] * 3
    assert_unchanged()
    workers.close()
    assert not started_since(earlier)
    assert_unchanged()


def test_the_serial_part_has_the_settings_of_the_threads():
    workers = Workers(2, CPU)
    with workers.serial():
        assert torch.get_num_threads() == 1
        assert in_new_thread(torch.get_num_threads) == OUTSIDE, "other threads are unchanged"
        with workers.serial():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
    assert_unchanged()
    with pytest.raises(ZeroDivisionError), workers.serial():
        raise ZeroDivisionError
    assert_unchanged()


def test_the_serial_part_keeps_the_number_of_the_calling_thread():
    """Which may differ from the default of new threads."""

    def other_thread() -> list[int]:
        torch.get_num_threads()  # the first call in a thread sets its number to the default
        torch.set_num_threads(3)
        in_new_thread(lambda: torch.set_num_threads(7))  # the default from now on
        with Workers(1, CPU).serial():
            inside = torch.get_num_threads(), in_new_thread(torch.get_num_threads)
        return [*inside, torch.get_num_threads(), in_new_thread(torch.get_num_threads)]

    assert in_new_thread(other_thread) == [1, 7, 3, 7]
    assert torch.get_num_threads() == OUTSIDE


def test_two_work_in_turns():
    with Workers(1, CPU) as one, Workers(3, CPU) as other:
        for _ in range(3):
            for workers in (one, other):
                assert workers.map(lambda _: torch.get_num_threads(), range(7)) == [1] * 7
        with one.serial():
            assert other.map(lambda _: torch.get_num_threads(), range(2)) == [1] * 2
            with other.serial():
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1
        assert_unchanged()


def test_results_are_in_order():
    with Workers(3, CPU) as workers:
        assert workers.map(lambda number: time.sleep(0.01 / (number + 1)) or number, range(20)) == list(range(20))
        assert workers.submit(divmod, 7, 3).result() == (2, 1)


def test_the_first_exception_is_raised_when_nothing_runs():
    running = set()

    def work(number: int) -> None:
        running.add(number)
        time.sleep(0.02)
        running.remove(number)
        if number in (1, 2):
            raise ValueError(f"number {number}")

    with Workers(3, CPU) as workers:
        with pytest.raises(ValueError, match="number 1"):
            workers.map(work, range(50))
        assert not running
        assert workers.map(abs, [-1, 2]) == [1, 2], "the threads go on"


def test_close_can_be_called_twice_and_ends_the_use():
    workers = Workers(1, CPU)
    workers.map(abs, [1])
    workers.close()
    workers.close()
    with pytest.raises(RuntimeError):
        workers.submit(abs, 1)


def test_close_waits_for_submitted_work():
    workers, done = Workers(1, CPU), []
    future = workers.submit(lambda: time.sleep(0.05) or done.append(1))
    workers.close()
    assert done == [1] and future.done()


def test_forgotten_threads_end():
    threads = threading.enumerate()
    forgotten = Workers(2, CPU)
    forgotten.map(abs, range(4))
    started = [thread for thread in threading.enumerate() if thread not in threads]
    assert started
    del forgotten
    gc.collect()
    for thread in started:
        thread.join(10.0)
    assert threading.enumerate() == threads


def test_cuda_threads_use_the_current_device(monkeypatch):
    """CUDA's current device belongs to a thread, and a new thread starts with the first device."""
    chosen = []
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: chosen.append((device, threading.current_thread().name)))
    with Workers(1, torch.device("cuda")) as workers:
        workers.submit(abs, 1).result()
    assert chosen == [(torch.device("cuda:1"), "bokehguide_0")]


def test_loops_with_different_settings_in_one_process():
    scene, threads = scenes.emitters(32, 18), threading.enumerate()

    def loop_of(count: int) -> RenderLoop:
        return RenderLoop(scene, RenderSettings("guided", threads=count))

    with loop_of(1) as one, loop_of(3) as other:
        assert threading.enumerate() == threads
        for loop in [one, other] * 3:
            loop.step()
            assert_unchanged()
        assert torch.equal(one.film.radiance(), other.film.radiance())
    assert threading.enumerate() == threads
