"""Each test starts with an empty scene and the add-on. BOKEHGUIDE_PYTHON is an interpreter with bokehguide."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parent)]
bpy = pytest.importorskip("bpy", reason="the tests of the add-on need Blender as a Python module; run make test-blender")
STATUS = pytest.StashKey[int]()


@pytest.fixture
def scene():
    """An empty scene with the add-on and Cycles enabled."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="bokehguide_blender")
    python = os.environ.get("BOKEHGUIDE_PYTHON")
    if not python:
        pytest.skip("BOKEHGUIDE_PYTHON names no interpreter with bokehguide")
    bpy.context.preferences.addons["bokehguide_blender"].preferences.python = python
    yield bpy.context.scene
    # The exporter's log would write to the output that pytest captured for this test, which is closed in the next.
    logging.getLogger("glTFImporter").handlers.clear()
    bpy.ops.preferences.addon_disable(module="bokehguide_blender")


def pytest_sessionfinish(session, exitstatus):
    session.config.stash[STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """End the process at once, after the summary, where Blender's own end fails.

    Blender 4.5 as a module checks for leaks at exit, and can then print about "static variables in C++" without end.
    Blender 4.2 can crash there, so that the exit status is that of the crash. Blender 5.0 has neither fault.
    """
    if bpy.app.version < (5, 0, 0) and STATUS in config.stash:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(config.stash[STATUS])
