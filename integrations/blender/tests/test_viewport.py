"""The viewport's pictures are those of a render from its view, and follow the changes of the scene.

Blender draws no window here, so the tests call what Blender calls, and read the pictures before they go to the GPU.
"""

from __future__ import annotations

import math
import sys
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scenes
from mathutils import Matrix, Vector
from test_camera import FRAMINGS

SAMPLES = 3


def request(matrix, view_matrix, size, perspective="CAMERA", distance=5.0):
    """The view of a region with these matrices."""
    from bokehguide_blender.viewport import view_request

    region = SimpleNamespace(window_matrix=matrix, view_matrix=view_matrix, view_perspective=perspective, view_distance=distance)
    space = SimpleNamespace(camera=bpy.context.scene.camera)
    return view_request(space, region, bpy.context.evaluated_depsgraph_get(), size)


def camera_view(size, zoom=1.0, offset=(0.0, 0.0)):
    """The view through the scene's camera. zoom and offset: of the frame in the region, as by the mouse."""
    camera = bpy.context.scene.camera
    matrix = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size[0], y=size[1])
    moved = Matrix.Translation((*offset, 0.0)) @ Matrix.Diagonal((zoom, zoom, 1.0, 1.0))
    return request(moved @ matrix, camera.matrix_world.inverted(), size)


def seen_at(view, point):
    """The pixel (column, row) of the picture at which a view shows a point of Blender."""
    table, (width, height), window = view["camera"], view["size"], view["window"]
    position, target, up = (np.array(table[name]) for name in ("position", "target", "up"))
    forward = target - position
    x, y, z = point
    offset = np.array((x, z, -y)) - position
    slopes = np.array((np.cross(forward, up) @ offset, -(up @ offset))) / (forward @ offset)
    pixels = slopes * 0.5 * width / math.tan(math.radians(table["fov"]) / 2.0)
    return pixels + np.array((width, height)) / 2.0 - window[:2]


def expected_at(matrix, size, point):
    """As `seen_at`, by a projection matrix."""
    x, y, _, w = matrix @ Vector((*point, 1.0))
    return np.array((0.5 + 0.5 * x / w, 0.5 - 0.5 * y / w)) * size


POINTS = ((0.3, 0.2, 0.1), (-0.6, 0.5, 0.4), (0.0, -1.0, 0.0))


@pytest.mark.parametrize("name", FRAMINGS)
def test_view_through_the_camera(scene, name):
    """The framing is that of a render with the size of the region."""
    from bokehguide_blender.camera import read_camera, read_framing

    size, options = FRAMINGS[name]
    camera = scenes.camera((0.5, -6, 1.5), **({"lens": 60.0} | options), use_dof=True, aperture_fstop=0.7, focus_distance=4.0)
    view = camera_view(size)
    framing = read_framing(camera.data, scene.render, size, [])
    assert (view["size"], view["window"]) == (framing.size, framing.window)
    table = read_camera(camera, framing, [])
    for key in ("position", "target", "up", "fov", "aperture_radius", "focus_distance"):
        assert view["camera"][key] == pytest.approx(table[key], abs=1e-5), key
    assert view["camera"]["aperture"] == table["aperture"]


@pytest.mark.parametrize("zoom, offset", [(0.4, (0.0, 0.0)), (1.7, (0.25, -0.5)), (1.0, (-1.5, 0.0))])
def test_zoom_and_offset_of_the_camera_view(scene, zoom, offset):
    camera, size = scenes.camera((0.5, -6, 1.5), lens=60.0), (96, 64)
    moved = Matrix.Translation((*offset, 0.0)) @ Matrix.Diagonal((zoom, zoom, 1.0, 1.0))
    projection = moved @ camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=96, y=64)
    view = camera_view(size, zoom, offset)
    for point in POINTS:
        np.testing.assert_allclose(
            seen_at(view, point), expected_at(projection @ camera.matrix_world.inverted(), size, point), atol=0.26
        )


def test_views_without_camera(scene):
    """A free view has no depth of field. A view without perspective is one from far away."""
    place = scenes.camera((2.0, -6, 3.5), use_dof=True, type="ORTHO", ortho_scale=3.0)
    matrix = place.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=96, y=64)
    look = place.matrix_world.inverted()
    view = request(matrix, look, (96, 64), "ORTHO", place.location.length)
    for point in POINTS:
        np.testing.assert_allclose(seen_at(view, point), expected_at(matrix @ look, (96, 64), point), atol=1.0)
    assert view["camera"]["aperture_radius"] == 0.0
    place.data.type = "PERSP"
    matrix = place.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=96, y=64)
    free, through = (request(matrix, look, (96, 64), kind)["camera"] for kind in ("PERSP", "CAMERA"))
    assert free["aperture_radius"] == 0.0 < through["aperture_radius"]
    assert free["position"] == through["position"]


class Running:
    """A viewport of an area in Rendered shading."""

    def __init__(self):
        from bokehguide_blender.viewport import Viewport

        window = bpy.context.window_manager.windows[0]
        self.area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
        self.area.spaces.active.shading.type = "RENDERED"
        bpy.context.scene.render.engine = "BOKEHGUIDE"
        bpy.context.scene.bokehguide.viewport_samples = SAMPLES
        self.viewport = Viewport(self.area.as_pointer())
        bpy.app.handlers.depsgraph_update_post.append(self._updated)

    def _updated(self, _scene, depsgraph):
        self.viewport.scene.note(depsgraph)

    def picture(self, size=scenes.SIZE):
        """The picture at rest of the scene and camera of now, `[H, W, 4]`, top row first."""
        viewport, end = self.viewport, time.monotonic() + 120.0
        bpy.context.view_layer.update()
        viewport.status = ""
        while viewport.status != f"Sample {SAMPLES}/{SAMPLES}":
            assert time.monotonic() < end, viewport.status
            assert viewport.tick() is not None, viewport.status
            if viewport.scene.path is not None and not viewport.scene.waiting:
                viewport.show(camera_view(size))
            time.sleep(0.02)
        return viewport.texture.pixels[::-1]

    def rest(self):
        """Wait until no change waits for its export."""
        bpy.context.view_layer.update()
        while self.viewport.scene.waiting:
            self.viewport.tick()
            time.sleep(0.02)

    def close(self):
        bpy.app.handlers.depsgraph_update_post.clear()
        self.viewport.close()


@pytest.fixture
def running(scene):
    scenes.world((0.5, 0.6, 0.7))
    scenes.mesh("cube")
    scenes.light("POINT", (2, -2, 3), energy=300.0, shadow_soft_size=0.3)
    scenes.camera((0.5, -6, 1.5), lens=60.0, shift_x=0.1, use_dof=True, aperture_fstop=0.2, focus_distance=6.0)
    started = Running()
    yield started
    started.close()


def test_picture(scene, running, tmp_path):
    """Sample for sample, the picture is that of F12."""
    picture = running.picture()
    rendered = scenes.colors(scenes.render("BOKEHGUIDE", tmp_path, samples=SAMPLES))
    np.testing.assert_allclose(picture, rendered, rtol=1e-4, atol=1e-5)


def test_changes(scene, running):
    """A change of a camera exports nothing, one of a lamp no meshes, and a selection gives no other file."""
    before, files = running.picture(), running.viewport.scene
    cube, lamp, first = scene.objects["Cube"], scene.objects["point"], files.path
    geometry = sorted(first.parent.glob("*.glb"))

    def changed(name):
        nonlocal before
        picture = running.picture()
        assert np.abs(picture - before).mean() > 0.01, name
        before = picture

    scene.camera.location.x += 1.0
    changed("camera")
    assert files.path == first
    lamp.data.energy = 3000.0
    changed("lamp")
    assert files.path != first and sorted(first.parent.glob("*.glb")) == geometry
    second = files.path
    cube.select_set(not cube.select_get())
    running.rest()
    assert files.path == second
    for name, change in {
        "moved": lambda: setattr(cube, "location", (1.0, 0.0, 0.0)),
        "material": lambda: color(cube.active_material, (1.0, 0.0, 0.0, 1.0)),
        "hidden": lambda: cube.hide_set(True),
        "shown": lambda: cube.hide_set(False),
        "world": lambda: scenes.world((4.0, 0.0, 0.0)),
    }.items():
        change()
        changed(name)


def color(material, value):
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = value


def test_viewport_visibility(scene, running):
    """Objects that only the render hides are shown."""
    running.picture()
    path = running.viewport.scene.path
    scene.objects["Cube"].hide_render = True
    running.rest()
    assert running.viewport.scene.path == path
    assert scene.objects["Cube"].hide_render


def test_edit_mode_stays(scene, running):
    running.picture()
    bpy.context.view_layer.objects.active = scene.objects["Cube"]
    bpy.ops.object.mode_set(mode="EDIT")
    running.viewport.scene.note(SimpleNamespace(updates=()))
    time.sleep(0.5)
    running.viewport.tick()
    assert "Object Mode" in running.viewport.status
    assert scene.objects["Cube"].mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")
    scene.objects["Cube"].location.x = 1.0
    assert running.picture().shape == (64, 96, 4)


def test_end(running):
    """A viewport that leaves Rendered shading ends its process and removes its files."""
    running.picture()
    folder, process = running.viewport.scene.path.parent, running.viewport.process
    assert process.running and folder.exists()
    running.area.spaces.active.shading.type = "SOLID"
    assert running.viewport.tick() is None
    assert not process.running and not folder.exists()


def test_end_of_blender(running):
    """The end of stdin, which the end of Blender causes, ends the process."""
    process = running.viewport.process
    process._process.stdin.close()
    end = time.monotonic() + 20.0
    while process.running and time.monotonic() < end:
        time.sleep(0.1)
    assert not process.running


def test_transparent_world(scene, running):
    assert running.picture()[..., 3].min() == 1.0
    scene.render.film_transparent = True
    alpha = running.picture()[..., 3]
    assert alpha.min() == 0.0 and alpha.max() == 1.0


@pytest.mark.parametrize("changed", [False, True])
def test_an_environment_without_bokehguide_is_told(scene, changed):
    scenes.camera()
    bpy.context.preferences.addons["bokehguide_blender"].preferences.python = sys.executable
    started = Running()
    if changed:  # while the process ends
        started.viewport.tick()
        started.viewport.process.failure()
        time.sleep(0.5)
        started.viewport.scene.waiting = True
    while started.viewport.tick() is not None:
        time.sleep(0.05)
    started.close()
    assert "bokehguide cannot be imported" in started.viewport.status


def test_a_view_that_cannot_be_rendered_is_told(running):
    running.picture()
    running.viewport.show({**camera_view(scenes.SIZE), "size": (10**6, 10**6)})
    end = time.monotonic() + 60.0
    while "Bokehguide: " not in running.viewport.status and time.monotonic() < end:
        running.viewport.tick()
        time.sleep(0.02)
    assert "pixels" in running.viewport.status or "65536" in running.viewport.status
    assert running.picture(size=(48, 32)).shape == (32, 48, 4)
