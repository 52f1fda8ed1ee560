"""`bokehguide render --tev`: what a viewer gets by tev's protocol, and viewers that are absent, die or hang."""

from __future__ import annotations

import socket
import sys
import time

import numpy as np
import pytest

from bokehguide.cli import main, tev
from bokehguide.image import read_exr
from tests.support.same_bits import assert_same_layers
from tests.support.tev_server import TevServer

pytest.importorskip("tevclient")


def render(*options: object) -> int:
    return main(["render", "emitters.toml", "--threads", "1", *map(str, options)])


@pytest.mark.parametrize("options", [(), ("--crop", "3,2,9,7"), ("--size", "300x140")])
def test_the_viewer_ends_with_the_radiance_of_the_file(lamps_folder, options):
    with TevServer() as server:
        assert render("--mode", "uniform", "--spp", 3, *options, "--out", "a.exr", "--tev", server.address) == 0
        server.wait()
    found = read_exr("a.exr")
    assert server.created == 1 and list(server.images) == ["emitters uniform"]
    channels = server.images["emitters uniform"]
    assert list(channels) == ["R", "G", "B"]
    assert_same_layers(found, channels)
    assert channels["R"].max() > 0.01


def test_the_viewer_follows_the_render(lamps_folder, monkeypatch):
    """With no pause between pictures: the first step's radiance comes first, and the last step's last."""
    monkeypatch.setattr(tev, "INTERVAL", 0.0)
    monkeypatch.setattr(tev, "SHARE", 1e9)
    with TevServer() as server:
        assert render("--spp", 40, "--out", "a.exr", "--tev", server.address) == 0
        server.wait()
    assert server.updates["emitters guided", "R"] >= 4
    red = [pixels for channel, pixels in server.history if channel == "R"]
    assert len(red) == server.updates["emitters guided", "R"]
    distance = [float(np.abs(pixels - red[-1]).mean()) for pixels in red]
    assert distance[0] > 2.0 * distance[-2] > 0.0  # noise falls


def test_the_pictures_take_a_small_share_of_the_time(lamps_folder):
    with TevServer() as server:
        assert render("--mode", "uniform", "--spp", 60, "--out", "a.exr", "--tev", server.address) == 0
        server.wait()
    assert 1 <= server.updates["emitters uniform", "R"] <= 8  # at most one a second, and those of the files


def test_the_viewer_gets_the_denoised_picture(lamps_folder):
    pytest.importorskip("mitsuba_oidn")
    with TevServer() as server:
        assert render("--spp", 4, "--denoise", "--out", "a.exr", "--tev", server.address) == 0
        server.wait()
    found, channels = read_exr("a.exr"), server.images["emitters guided"]
    assert list(channels) == ["R", "G", "B", "denoised.R", "denoised.G", "denoised.B"]
    assert_same_layers(found, channels)


def test_the_picture_is_that_without_a_viewer(lamps_folder):
    assert render("--spp", 5, "--out", "plain.exr") == 0
    with TevServer() as server:
        assert render("--spp", 5, "--out", "a.exr", "--tev", server.address) == 0
    plain = read_exr("plain.exr")
    assert_same_layers(plain, read_exr("a.exr"))


def warnings_of(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if "tev" in line]


def test_an_absent_viewer_is_told_once(lamps_folder, capsys):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    assert render("--spp", 4, "--out", "a.exr", "--tev", f"127.0.0.1:{port}") == 0
    (line,) = warnings_of(capsys)
    assert f"warning: --tev: 127.0.0.1:{port} takes no pictures (Connection refused); the render goes on" in line
    assert read_exr("a.exr")["R"].max() > 0.1


@pytest.mark.parametrize("host", ["no-such-host.invalid", "a..b"])
def test_an_unknown_host_is_told_once(lamps_folder, host, capsys):
    assert render("--spp", 2, "--out", "a.exr", "--tev", host) == 0
    (line,) = warnings_of(capsys)
    assert f"{host}:14158 takes no pictures" in line


def test_a_viewer_that_dies_is_told_once(lamps_folder, monkeypatch, capsys):
    monkeypatch.setattr(tev, "INTERVAL", 0.0)
    monkeypatch.setattr(tev, "SHARE", 1e9)
    with TevServer(dies_after=2) as server:
        assert render("--spp", 30, "--size", "320x200", "--out", "a.exr", "--tev", server.address) == 0
    (line,) = warnings_of(capsys)
    assert "takes no pictures" in line and "the render goes on" in line
    assert read_exr("a.exr")["samples.Y"].min() == 30.0


def test_a_viewer_that_hangs_does_not_hold_the_render(lamps_folder, monkeypatch, capsys):
    monkeypatch.setattr(tev, "PATIENCE", 0.5)
    start = time.monotonic()
    with TevServer(reads=False) as server:
        options = ("--mode", "uniform", "--size", "1600x1000", "--spp", 2, "--out", "a.exr")  # more than buffers hold
        assert render(*options, "--tev", server.address) == 0
        assert time.monotonic() - start < 60.0
    (line,) = warnings_of(capsys)
    assert "no answer in time" in line


def test_a_missing_client_is_told_before_the_render(lamps_folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tevclient", None)
    assert render("--tev", "127.0.0.1") == 2
    assert "pip install 'bokehguide[tev]'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", ":14158", "host:", "host:0", "host:65536", "host:1:2"])
def test_a_wrong_address_is_an_error(lamps_folder, text, capsys):
    assert render(f"--tev={text}") == 2
    assert "argument --tev: " in capsys.readouterr().err
