"""Mistakes are readable reports, and a cancelled render ends its process."""

from __future__ import annotations

import sys
import threading
import time

import bpy
import pytest
import scenes


@pytest.fixture
def message(capfd):
    """Renders, and returns what Blender reports."""

    def render():
        capfd.readouterr()
        bpy.context.scene.render.engine = "BOKEHGUIDE"
        try:
            bpy.ops.render.render()
        except RuntimeError as error:  # from Blender 5.0 on
            return str(error)
        return "".join(capfd.readouterr())

    return render


def options():
    return bpy.context.preferences.addons["bokehguide_blender"].preferences


def test_no_environment(scene, message):
    scenes.camera()
    options().python = "/nowhere/python"
    assert "/nowhere/python: no such Python interpreter; press Install in the add-on's preferences" in message()


def test_an_environment_without_bokehguide(scene, message):
    scenes.camera()
    options().python = sys.executable
    said = message()
    assert "bokehguide cannot be imported" in said
    assert "install it from the add-on's preferences" in said
    assert "Traceback" not in said


def test_a_file_that_is_no_interpreter(scene, tmp_path, message):
    scenes.camera()
    file = tmp_path / "python"
    file.write_text("no interpreter")
    options().python = str(file)
    assert "cannot start" in message()


def test_orthographic_camera(scene, message):
    scenes.camera(type="ORTHO")
    assert "perspective cameras only" in message()


def world_texture():
    """The Environment Texture of a new world."""
    tree = scenes.world()
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    return texture


def test_message_of_bokehguide(scene, message, tmp_path):
    scenes.camera()
    (tmp_path / "broken.hdr").write_text("no map")
    image = world_texture().image = bpy.data.images.new("map", 8, 4)
    image.source, image.filepath = "FILE", str(tmp_path / "broken.hdr")
    said = message()
    assert "Bokehguide: " in said
    assert "broken.hdr" in said
    assert "Traceback" not in said


def test_missing_world_map(scene, message):
    texture = world_texture()
    scenes.camera()
    assert "has no image" in message()
    texture.image = bpy.data.images.new("map", 8, 4)
    texture.image.source, texture.image.filepath = "FILE", "//nowhere.hdr"
    assert "world: the image map cannot be read; check its path" in message()


def test_failure_of_the_exporter(scene, message, monkeypatch):
    writer = pytest.importorskip("io_scene_gltf2.io.exp.export", reason="Blender 4.2 has another module")

    def fail(*_, **__):
        raise OSError("No space left on device")

    scenes.camera()
    monkeypatch.setattr(writer, "save_gltf", fail)
    said = message()
    assert "Bokehguide: the glTF exporter failed: OSError: No space left on device; export" in said


def test_cancel(scene, message, monkeypatch):
    """The test answers in Blender's place whether the user has pressed Escape."""
    from bokehguide_blender import engine, process

    started = []
    begin = process.Render.__init__

    def spy(self, *arguments):
        begin(self, *arguments)
        started.append(self)

    monkeypatch.setattr(process.Render, "__init__", spy)
    pressed = threading.Event()
    monkeypatch.setattr(engine, "is_cancelled", lambda _: pressed.is_set())
    scenes.mesh("cube")
    scenes.camera()
    scene.bokehguide.samples = 65536
    scene.render.resolution_x, scene.render.resolution_y = 640, 480
    threading.Timer(6.0, pressed.set).start()
    start = time.monotonic()
    assert "Error" not in message()
    assert 6.0 < time.monotonic() - start < 20.0
    assert not started[0].running
