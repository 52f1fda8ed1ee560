"""Mistakes are readable reports, and a cancelled render ends its process."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import bpy
import pytest
import scenes


def fails(pattern):
    """A context in which a render fails with a message."""
    return pytest.raises(RuntimeError, match=pattern)


def rendered():
    bpy.context.scene.render.engine = "BOKEHGUIDE"
    bpy.ops.render.render()


def options():
    return bpy.context.preferences.addons["bokehguide_blender"].preferences


def test_no_environment(scene):
    scenes.camera()
    options().python = "/nowhere/python"
    with fails("/nowhere/python: no such Python interpreter; press Install in the add-on's preferences"):
        rendered()


def test_an_environment_without_bokehguide(scene):
    scenes.camera()
    options().python = sys.executable
    with fails("bokehguide cannot be imported .*; install it from the add-on's preferences"):
        rendered()


def test_a_file_that_is_no_interpreter(scene, tmp_path):
    scenes.camera()
    file = tmp_path / "python"
    file.write_text("no interpreter")
    options().python = str(file)
    with fails("cannot start"):
        rendered()


def test_orthographic_camera(scene):
    scenes.camera(type="ORTHO")
    with fails("perspective cameras only"):
        rendered()


def test_message_of_bokehguide(scene):
    scenes.camera()
    scene.bokehguide.max_bounces = 1000
    scenes.mesh("cube", location=(1e12, 0, 0))
    with fails("geometry.glb"):
        rendered()


def test_missing_world_map(scene):
    tree = scenes.world()
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    scenes.camera()
    with fails("has no image"):
        rendered()
    texture.image = bpy.data.images.new("map", 8, 4)
    texture.image.source, texture.image.filepath = "FILE", "//nowhere.hdr"
    with fails("world: the image map cannot be read; check its path"):
        rendered()


def test_cancel(scene, tmp_path, monkeypatch):
    """The test answers in Blender's place whether the user has pressed Escape."""
    from bokehguide_blender import engine, process

    started = []
    begin = process.Render.__init__

    def spy(self, *arguments):
        begin(self, *arguments)
        started.append(self)

    monkeypatch.setattr(process.Render, "__init__", spy)
    pressed = threading.Event()
    monkeypatch.setattr(engine.BokehguideEngine, "test_break", lambda _: pressed.is_set(), raising=False)
    scenes.mesh("cube")
    scenes.camera()
    scene.bokehguide.samples = 65536
    scene.render.resolution_x, scene.render.resolution_y = 640, 480
    threading.Timer(6.0, pressed.set).start()
    start = time.monotonic()
    rendered()
    assert 6.0 < time.monotonic() - start < 20.0
    assert not started[0].running
    assert not Path(started[0].folder).exists()
