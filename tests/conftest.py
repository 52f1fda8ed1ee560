"""Fixtures, and one OpenMP thread for the tests and the processes that they start."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Set before torch is imported: several processes with spinning OpenMP threads each slow a test from a second to a minute.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
# The commands that tests start are those of this checkout, installed or not.
os.environ["PYTHONPATH"] = str(Path(__file__).parent.parent)

from tests.support.scene_text import BOX_AND_EMITTER


@pytest.fixture
def lamps_file(tmp_path: Path) -> Path:
    """A scene file of a box in focus and an emitter behind it, 32 × 20 pixels."""
    path = tmp_path / "emitters.toml"
    path.write_text(BOX_AND_EMITTER)
    return path


@pytest.fixture
def lamps_folder(lamps_file: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with `lamps_file`."""
    monkeypatch.chdir(lamps_file.parent)
    return lamps_file.parent


@pytest.fixture
def bokehguide(tmp_path: Path):
    """Run the command in a folder of its own; gives the finished process with its texts."""

    def run(*arguments: object) -> subprocess.CompletedProcess:
        command = [sys.executable, "-m", "bokehguide", *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)

    return run


@pytest.fixture(autouse=True, scope="module")
def mitsuba_variant(request: pytest.FixtureRequest):
    """The variant of Mitsuba that a test module names in MITSUBA_VARIANT; the earlier variant returns after the module.

    A variant belongs to the process, and pytest imports all modules before the first test.
    """
    wanted = getattr(request.module, "MITSUBA_VARIANT", None)
    if wanted is None:
        yield
        return
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant(wanted)
    yield
    if before is not None:
        mi.set_variant(before)
