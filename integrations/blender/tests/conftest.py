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
