"""Ctrl-C and SIGTERM at any time: the exit codes 130 and 143, within a second, and nothing left behind."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from bokehguide import stopping
from bokehguide.cli import main
from bokehguide.runtime import interrupt as interrupts
from bokehguide.runtime.interrupt import Interrupt

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
LONGEST = 5.0
"""Seconds that a loaded machine may take; a second on an idle one."""


def stopped(command: list[str], folder, number: int, ready) -> tuple[int, float, str]:
    """Start a command, send a signal when `ready` says so; its code as a shell reports it, the seconds it took, and stderr."""
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        ready(process)
        process.send_signal(number)
        start = time.monotonic()
        stderr = process.communicate(timeout=60)[1]
        code = process.returncode if process.returncode >= 0 else 128 - process.returncode
        return code, time.monotonic() - start, stderr


def render(folder, *options: object) -> list[str]:
    return [sys.executable, "-m", "bokehguide", "render", "emitters.toml", "--out", "a.exr", *map(str, options)]


@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("delay", [0.0, 0.5])
def test_while_libraries_are_imported(number, delay, lamps_file, tmp_path):
    before = sorted(tmp_path.iterdir())

    def ready(process):
        assert process.stderr.readline() == "bokehguide: starting\n"
        time.sleep(delay)

    code, seconds, stderr = stopped(render(tmp_path), tmp_path, number, ready)
    assert (code, "Traceback" in stderr) == (CODES[number], False), stderr
    assert seconds < LONGEST
    assert "bokehguide: interrupted" in stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
@pytest.mark.parametrize("delay", np.linspace(0.0, 6.0, 24))
def test_at_any_time(delay, lamps_file, tmp_path):
    """Also in the steps, after which the picture is written."""
    command = render(tmp_path, "--spp", 1000000, "--logdir", "logs")

    def ready(process):
        process.stderr.readline()
        time.sleep(delay)

    code, seconds, stderr = stopped(command, tmp_path, signal.SIGINT, ready)
    assert code == 130 and seconds < LONGEST and "Traceback" not in stderr, stderr
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_while_the_tracing_structure_is_built(number, tmp_path):
    """Embree keeps the interpreter's lock for seconds."""
    program = """if True:
        import numpy as np, sys
        from bokehguide import stopping
        from bokehguide.render.tracer import Tracer
        stopping.stop_at_signals()
        corners = np.random.default_rng(0).random((3_000_000, 3), dtype=np.float32)
        print("ready", file=sys.stderr, flush=True)
        Tracer(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
        print("built", file=sys.stderr)
    """

    def ready(process):
        process.stderr.readline()
        time.sleep(0.2)

    code, seconds, stderr = stopped([sys.executable, "-c", program], tmp_path, number, ready)
    assert code == CODES[number] and seconds < 1.0 and "built" not in stderr


def test_an_interrupt_that_python_would_lose(tmp_path):
    """KeyboardInterrupt in a destructor is printed and ignored."""
    program = """if True:
        import sys, time
        from bokehguide import stopping
        stopping.stop_at_signals()
        class Slow:
            def __del__(self):
                print("ready", file=sys.stderr, flush=True)
                end = time.monotonic() + 5
                while time.monotonic() < end: pass
        Slow()
        print("went on", file=sys.stderr)
    """
    ready = lambda process: process.stderr.readline()  # noqa: E731
    code, _, stderr = stopped([sys.executable, "-c", program], tmp_path, signal.SIGINT, ready)
    assert code == 130 and "went on" not in stderr


@pytest.mark.slow
def test_temporary_files_go(tmp_path):
    program = f"""if True:
        import sys, time
        from bokehguide import stopping
        from bokehguide.image import replacing
        stopping.stop_at_signals()
        stopping.note_at_stop("all is kept")
        with replacing({str(tmp_path / "a.txt")!r}) as temporary:
            temporary.write_text("half")
            print("ready", file=sys.stderr, flush=True)
            time.sleep(60)
    """
    ready = lambda process: process.stderr.readline()  # noqa: E731
    code, _, stderr = stopped([sys.executable, "-c", program], tmp_path, signal.SIGTERM, ready)
    assert (code, stderr) == (143, "bokehguide: all is kept\nbokehguide: interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def usual_handler() -> Iterator[None]:
    """Python's handler of SIGINT, which processes in the background of a shell do not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_handler")
def test_signals_of_a_kind_within_a_second_are_one_request(monkeypatch):
    """`timeout` sends SIGTERM to its child and then to its process group."""
    monkeypatch.setattr(interrupts, "ONE_REQUEST", 60.0)
    with Interrupt() as interrupt:
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        assert interrupt.signal == signal.SIGINT
        monkeypatch.setattr(interrupts, "ONE_REQUEST", 0.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
def test_a_render_that_timeout_ends_saves_its_state(lamps_file, tmp_path):
    """The signals are those of `timeout`, after the first picture, which a loaded machine may take long to write."""
    command, deadline = render(tmp_path, "--spp", 1000000), time.monotonic() + 60.0
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        while not (tmp_path / "a.exr").exists():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGTERM)
        os.killpg(process.pid, signal.SIGTERM)
        stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 143 and "saved, --resume continues from a.ckpt" in stderr, stderr


@pytest.mark.usefixtures("usual_handler")
def test_a_second_signal_outside_of_saving_has_its_usual_effect(monkeypatch):
    told = []
    monkeypatch.setattr(interrupts, "ONE_REQUEST", 0.0)
    with Interrupt(lambda: told.append("told")) as interrupt:
        with interrupt.saving():
            for _ in range(3):
                signal.raise_signal(signal.SIGINT)
        assert interrupt.signal == signal.SIGINT and told == ["told"]
        signal.raise_signal(signal.SIGTERM)  # as torchrun sends it after a Ctrl-C
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert interrupt.signal == signal.SIGINT and told == ["told"]


def test_a_process_that_is_no_command_keeps_its_handlers():
    before = [signal.getsignal(number) for number in stopping.NUMBERS]
    with stopping.default_signals():
        assert [signal.getsignal(number) for number in stopping.NUMBERS] == before
    thread = threading.Thread(target=lambda: stopping.default_signals().__enter__())
    thread.start()
    thread.join()
    assert [signal.getsignal(number) for number in stopping.NUMBERS] == before


def test_a_command_forgets_the_note_of_an_earlier_command(lamps_file, monkeypatch, capsys):
    def interrupted(options):
        raise KeyboardInterrupt

    stopping.note_at_stop("samples are kept")
    monkeypatch.setattr("bokehguide.cli.info.run", interrupted)
    assert main(["info", "emitters.toml"]) == 130
    assert capsys.readouterr().err == "bokehguide: interrupted\n"
