"""`bokehguide view`: its mistakes in a line, and its end by a signal."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys

import pytest
from websockets.sync.client import connect

from bokehguide.cli import main
from tests.support.scene_text import BOX_AND_EMITTER


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)
    return tmp_path


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "one of the arguments SCENE --watch is required"),
        (["box.toml", "--watch", "a.exr"], "not allowed with"),
        (["--watch", "a.png"], "end it in .exr"),
        (["--watch", "a.exr", "--focus-distance", "3"], "--focus-distance: has no effect with --watch; leave it out"),
        (["--watch", "a.exr", "--noisy"], "--noisy: has no effect with --watch"),
        (["box.tom"], "no such scene"),
        (["my box.EXR"], "my box.EXR: is a picture, and no scene; bokehguide view --watch 'my box.EXR' shows a picture"),
        (["box.toml", "--port", "70000"], "from 0 to 65535"),
        (["box.toml", "--host", "not a host"], "cannot listen on not a host:8737"),
        (["box.toml", "--mode", "magic"], "argument --mode: invalid choice: 'magic'"),
        (["box.toml", "--f-number", "0"], "--f-number: 0.0"),
    ],
)
def test_a_mistake_is_told_in_a_line(options, words, folder, capsys):
    assert main(["view", *options, "--no-browser"]) == 2
    stderr = capsys.readouterr().err
    assert words in stderr and stderr.startswith("bokehguide: error: ") and "Traceback" not in stderr


def test_a_port_in_use_is_told_before_the_scene_is_loaded(folder, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", "none.toml", "--no-browser", f"--port={port}"]) == 2
    assert f"cannot listen on 127.0.0.1:{port}" in capsys.readouterr().err


def test_the_missing_extra_is_told_before_the_scene_is_loaded(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    assert main(["view", "no-such-scene"]) == 2
    assert "pip install 'bokehguide[view]'" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_ends_it_in_the_middle_of_its_work(number, folder):
    command = [sys.executable, "-m", "bokehguide", "view", "box.toml", "--port=0", "--no-browser", "--size=640x400"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert line.endswith("serves this machine alone; Ctrl-C ends\n")
            with connect(line.split()[0].replace("http:", "ws:") + "socket", max_size=None) as page:
                for _ in range(4):
                    page.recv(timeout=60)
                process.send_signal(number)
                _, stderr = process.communicate(timeout=60)
        finally:
            process.kill()  # the exit of `with` waits for its end
        assert process.returncode == 0
        assert "Traceback" not in stderr and stderr.endswith("bokehguide: ended\n"), stderr
