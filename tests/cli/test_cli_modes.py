"""Modes of installed packages, which the command line finds by their entry points."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.paths import REPOSITORY

MODULE = """
from bokehguide.guiding.builders import uniform

def own(context):
    return uniform(context)
"""
TRANSPOSED = """
import torch
from bokehguide.guiding.protocols import LensPoints, LensQuery, LensSampler, LightStrategy, Mode

class Transposed(LensQuery):
    def sample(self):
        return LensPoints(torch.zeros(576, 2), torch.ones(576))

class Lens(LensSampler):
    def query(self, batch):
        return Transposed()

def own(context):
    return Mode(Lens(context), LightStrategy(context))
"""
SMALL = ("--size", "32x18", "--spp")


@pytest.fixture
def command(tmp_path):
    """Run the command where a package with these entry points and this module `own_mode` is installed."""

    def run(points: str, module: str, *arguments: object) -> subprocess.CompletedProcess:
        folder = tmp_path / "installed"
        (folder / "own_mode-1.0.dist-info").mkdir(parents=True, exist_ok=True)
        (folder / "own_mode-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: own-mode\nVersion: 1.0\n")
        (folder / "own_mode-1.0.dist-info/entry_points.txt").write_text(f"[bokehguide.modes]\n{points}\n")
        (folder / "own_mode.py").write_text(module)
        path = os.pathsep.join((str(folder), str(REPOSITORY)))
        words = [sys.executable, "-m", "bokehguide", *map(str, arguments)]
        return subprocess.run(words, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)

    return run


def test_help_lists_an_installed_mode_and_does_not_import_it(command):
    finished = command("own = own_mode:own", "raise SystemExit('imported')", "render", "--help")
    assert finished.returncode == 0, finished.stderr
    assert "guided,area-restir,area-restir+lis,own}" in finished.stdout


def test_an_installed_mode_renders_and_resumes(command, tmp_path):
    render = ("own = own_mode:own", MODULE, "render", "cutout", "--mode", "own", "--checkpoint-every", 0.001, *SMALL)
    assert command(*render, 2).returncode == 0
    finished = command(*render, 3, "--resume")
    assert finished.returncode == 0, finished.stderr
    assert "2/3 [" in finished.stderr  # the bar begins at the samples of the checkpoint
    assert (tmp_path / "cutout-own.exr").exists()


@pytest.mark.slow
def test_compare_takes_an_installed_mode(command, tmp_path):
    compare = ("compare", "cutout", "--modes", "uniform,own", "--out", "out", "--reference-spp", 4, "--cache", "cache")
    finished = command("own = own_mode:own", MODULE, *compare, *SMALL, 2)
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / "out/own.exr").exists()


@pytest.mark.parametrize(
    ("points", "module", "mode", "told"),
    [
        ("own = own_mode:own", "1 / 0", "own", "mode: own_mode:own cannot be imported (ZeroDivisionError: division by zero)"),
        ("own = own_mode:own", "", "own", "mode: own_mode:own cannot be imported (AttributeError: "),
        (
            "lis = own_mode:own",
            MODULE,
            "lis",
            "mode: 'lis' of the package own-mode is the mode of bokehguide.guiding.builders:lis",
        ),
        ("a/b = own_mode:own", MODULE, "a/b", "mode: 'a/b' of the package own-mode is no name of at most 64 letters"),
        (
            "own = own_mode:own",
            "def own(): pass",
            "own",
            "mode: own: the builder own_mode:own() does not take one ModeContext; define it as own(context)",
        ),
        (
            "own = own_mode:own",
            TRANSPOSED,
            "own",
            "mode: own: Transposed.sample() returned points: float32 [576, 2]; return float32 [2, 576] for 576 pixels",
        ),
    ],
)
def test_a_package_that_fails_is_told_in_a_line(points, module, mode, told, command, tmp_path):
    finished = command(points, module, "render", "cutout", "--mode", mode, "--out", "a.exr", "--threads", 1, *SMALL, 2)
    assert finished.returncode == 2
    (line,) = [line for line in finished.stderr.splitlines() if "error" in line]
    assert line.startswith(f"bokehguide: error: {told}")
    assert "Traceback" not in finished.stderr
    assert not (tmp_path / "a.exr").exists()


def test_a_package_that_takes_a_name_leaves_other_modes_alone(command):
    finished = command("lis = own_mode:own", MODULE, "render", "cutout", "--mode", "uniform", *SMALL, 1)
    assert finished.returncode == 0, finished.stderr
