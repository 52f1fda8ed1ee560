"""Settings and objects that a render leaves out are told by name."""

from __future__ import annotations

import bpy
import pytest
import scenes


@pytest.fixture
def warnings(scene, capfd):
    """Renders a cube under a world, and returns what Blender reports."""

    def render():
        scenes.world((0.5, 0.5, 0.5))
        scenes.mesh("cube")
        scenes.camera()
        scene.render.engine, scene.bokehguide.samples = "BOKEHGUIDE", 1
        scene.render.resolution_x = scene.render.resolution_y = 8
        capfd.readouterr()
        bpy.ops.render.render()
        return "".join(capfd.readouterr())

    return render


def test_settings(scene, warnings):
    scene.render.use_motion_blur = scene.render.use_multiview = True
    layer = bpy.context.view_layer
    layer.material_override = scenes.material()
    layer.use_pass_mist = layer.use_pass_cryptomatte_asset = True
    said = warnings()
    assert "motion blur is ignored" in said
    assert "stereoscopy is ignored" in said
    assert "the material override of the view layer is ignored" in said
    assert "passes that bokehguide lacks: Cryptomatte Asset, Mist" in said


def test_objects(scene, warnings):
    scenes.mesh("cube").name = "hidden"
    bpy.data.objects["hidden"].visible_camera = False
    scenes.mesh("cube").name = "hole"
    bpy.data.objects["hole"].is_holdout = True
    scene.collection.objects.link(bpy.data.objects.new("smoke", bpy.data.volumes.new("smoke")))
    said = warnings()
    assert "the ray visibility of objects is ignored: hidden" in said
    assert "holdouts and shadow catchers become ordinary objects: hole" in said
    assert "hair, points, grease pencil and volumes are left out: smoke" in said


def test_an_ordinary_scene(scene, warnings):
    bpy.context.view_layer.use_pass_z = bpy.context.view_layer.use_pass_normal = True
    scenes.light("SUN", energy=1.0)
    assert "Warning" not in warnings()
