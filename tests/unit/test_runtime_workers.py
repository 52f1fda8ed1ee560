"""Worker threads leave the process around them unchanged, and end."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import torch

from bokehguide.runtime.compile import kernels
from bokehguide.runtime.workers import Workers
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes

CPU = torch.device("cpu")
OUTSIDE = 5
"""OpenMP threads of the process around the workers."""


@kernels.kernel
def doubled(values: torch.Tensor) -> torch.Tensor:
    return 2.0 * values


@pytest.fixture(autouse=True)
def compilations(monkeypatch) -> Iterator[list[kernels._Setting]]:
    """The settings by which kernels were compiled. Stand-ins run the functions; that of `doubled` changes the sign."""
    made = []

    def pretended_variant(function, arguments, tensors, key, setting):
        made.append(setting)
        if function.__name__ == "doubled":
            return lambda tensors: -function(*tensors)
        return lambda tensors: function(*kernels._rebuilt(arguments, iter(tensors)))

    monkeypatch.setattr(kernels, "_variant", pretended_variant)
    # Stand-ins must not serve other tests of this process.
    every = [value for value in gc.get_objects() if type(value) is kernels._Kernel]
    kept = [value._variants for value in every]
    for value in every:
        value._variants = {}
    yield made
    for value, variants in zip(every, kept):
        value._variants = variants


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


def state() -> tuple[object, ...]:
    """What a thread sees of the process: OpenMP threads, and whether kernels are compiled."""
    return torch.get_num_threads(), float(doubled(torch.ones(3))[0])


def assert_unchanged() -> None:
    assert state() == in_new_thread(state) == (OUTSIDE, 2.0)


def test_the_process_is_the_same_before_during_and_after():
    threads = threading.enumerate()
    workers = Workers(3, CPU, compiled=True)
    assert threading.enumerate() == threads, "construction starts nothing"
    barrier = threading.Barrier(4, timeout=30.0)

    def work(_: int) -> tuple[object, ...]:
        barrier.wait()  # three threads are at work
        barrier.wait()  # the process around them has been looked at
        return state()

    futures = [workers.submit(work, number) for number in range(3)]
    barrier.wait()
    assert len(threading.enumerate()) == len(threads) + 3
    assert_unchanged()
    barrier.wait()
    assert [future.result() for future in futures] == [(1, -2.0)] * 3
    assert_unchanged()
    workers.close()
    assert threading.enumerate() == threads
    assert_unchanged()


def test_the_serial_part_has_the_settings_of_the_threads():
    workers = Workers(2, CPU, compiled=True)
    with workers.serial():
        assert state() == (1, -2.0)
        assert in_new_thread(state) == (OUTSIDE, 2.0), "other threads are unchanged"
        with workers.serial():
            assert state() == (1, -2.0)
        assert state() == (1, -2.0)
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
        with Workers(1, CPU, compiled=False).serial():
            inside = torch.get_num_threads(), in_new_thread(torch.get_num_threads)
        return [*inside, torch.get_num_threads(), in_new_thread(torch.get_num_threads)]

    assert in_new_thread(other_thread) == [1, 7, 3, 7]
    assert torch.get_num_threads() == OUTSIDE


def test_two_work_in_turns(compilations):
    with Workers(1, CPU, compiled=False) as one, Workers(3, CPU, compiled=True) as other:
        for _ in range(3):
            for workers, sign in ((one, 1.0), (other, -1.0)):
                assert workers.map(lambda _: state(), range(7)) == [(1, sign * 2.0)] * 7
        with one.serial():
            assert other.map(lambda _: state(), range(2)) == [(1, -2.0)] * 2
            with other.serial():
                assert state() == (1, -2.0)
            assert state() == (1, 2.0)
        assert_unchanged()
    assert [setting.threads for setting in compilations] == [3], "one compiled, once"


def test_each_thread_count_has_kernels_of_its_own(compilations):
    """A loop with three threads does not wait for the single instance of a loop with one."""
    for threads in (1, 3, 1):
        with Workers(threads, CPU, compiled=True) as workers:
            workers.map(lambda _: state(), range(5))
    assert [setting.threads for setting in compilations] == [1, 3]


def test_results_are_in_order():
    with Workers(3, CPU, compiled=False) as workers:
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

    with Workers(3, CPU, compiled=False) as workers:
        with pytest.raises(ValueError, match="number 1"):
            workers.map(work, range(50))
        assert not running
        assert workers.map(abs, [-1, 2]) == [1, 2], "the threads go on"


def test_close_can_be_called_twice_and_ends_the_use():
    workers = Workers(1, CPU, compiled=False)
    workers.map(abs, [1])
    workers.close()
    workers.close()
    with pytest.raises(RuntimeError):
        workers.submit(abs, 1)


def test_close_waits_for_submitted_work():
    workers, done = Workers(1, CPU, compiled=False), []
    future = workers.submit(lambda: time.sleep(0.05) or done.append(1))
    workers.close()
    assert done == [1] and future.done()


def test_forgotten_threads_end():
    threads = threading.enumerate()
    forgotten = Workers(2, CPU, compiled=False)
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
    with Workers(1, torch.device("cuda"), compiled=False) as workers:
        workers.submit(abs, 1).result()
    assert chosen == [(torch.device("cuda:1"), "bokehguide_0")]


def test_loops_with_different_settings_in_one_process(compilations):
    scene, threads = scenes.emitters(32, 18), threading.enumerate()

    def loop_of(count: int, compiled: bool = False) -> RenderLoop:
        return RenderLoop(scene, RenderSettings("guided", threads=count, compile=compiled))

    with loop_of(1) as one, loop_of(3) as other, loop_of(2, compiled=True) as compiled:
        assert threading.enumerate() == threads
        loops = [one, other, compiled]
        for loop in loops * 3:
            loop.step()
            assert_unchanged()
        assert all(torch.equal(loop.film.radiance(), one.film.radiance()) for loop in loops)
    assert threading.enumerate() == threads
    assert len(compilations) > 10 and {setting.threads for setting in compilations} == {2}
