"""The view of a model without a camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from bokehguide.image import write_exr
from bokehguide.scene import Overrides, load_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A statue, and a dark map with one lamp low in the direction -z, as the front of a model faces +z."""
    folder = tmp_path_factory.mktemp("framing")
    body = trimesh.creation.cylinder(0.4, 1.6, sections=48)
    body.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, (1, 0, 0)))
    head = trimesh.creation.icosphere(3, 0.5)
    head.apply_translation((0.0, 1.2, 0.0))
    trimesh.util.concatenate([body, head]).export(folder / "statue.ply")
    radiance = np.full((64, 128, 3), 0.02, np.float32)
    radiance[28:30, 60:63] = 4000.0  # the middle of a map lies at -z
    write_exr(folder / "lamp.exr", {"beauty": radiance})
    return folder


def frame_of(camera, points):
    """Positions of points `[N, 3]` in the frame, from -1 to 1 across the width, and their depths."""
    forward = np.subtract(camera.target, camera.position) / np.linalg.norm(np.subtract(camera.target, camera.position))
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    relative = np.asarray(points) - camera.position
    depth = relative @ forward
    reach = np.tan(np.radians(camera.fov / 2.0)) * depth
    return relative @ right / reach, relative @ np.cross(right, forward) / reach, depth


def test_the_model_is_in_the_frame_and_in_focus(folder):
    scene = load_scene(str(folder / "statue.ply"))
    points = np.concatenate([mesh.vertices for mesh in scene.meshes])
    x, y, depth = frame_of(scene.camera, points)
    assert np.abs(x).max() < 1.0 and np.abs(y).max() < scene.film.height / scene.film.width
    assert max(np.abs(x).max(), np.abs(y).max() * scene.film.width / scene.film.height) > 0.6, "it is not small"
    assert depth.min() - 0.01 < scene.camera.focus_distance < np.median(depth), "focused on the near surface in the middle"
    azimuth = math.degrees(math.atan2(scene.camera.position[0], scene.camera.position[2]))
    assert 15.0 < abs(azimuth) < 55.0, "three quarters from the front"
    heights = points[:, 1]
    assert heights.min() - 0.5 < scene.camera.position[1] < heights.max() + 1.0, "about the model's own height"


def test_highlights_at_infinity_have_six_percent_of_the_width(folder):
    camera = load_scene(str(folder / "statue.ply")).camera
    frame = 2.0 * math.tan(math.radians(camera.fov / 2.0)) * camera.focus_distance
    assert 2.0 * camera.aperture_radius / frame == pytest.approx(0.06, rel=1e-6)


def test_the_lamp_of_the_map_is_in_the_frame(folder):
    scene = load_scene(str(folder / "statue.ply"), Overrides(environment=str(folder / "lamp.exr")))
    height, width = scene.environment.radiance.shape[:2]
    row, column = np.unravel_index(scene.environment.radiance.sum(-1).argmax(), (height, width))
    polar, around = math.pi * (row + 0.5) / height, 2.0 * math.pi * ((column + 0.5) / width - 0.5)
    around -= math.radians(scene.environment.rotation)
    towards = np.array([math.sin(polar) * math.sin(around), math.cos(polar), -math.sin(polar) * math.cos(around)])
    x, y, depth = frame_of(scene.camera, [scene.camera.position + 1e6 * towards])
    assert depth[0] > 0.0 and abs(x[0]) < 1.0 and abs(y[0]) < scene.film.height / scene.film.width


@pytest.mark.slow
def test_the_same_files_give_the_same_view(folder):
    overrides = Overrides(environment=str(folder / "lamp.exr"))
    first, second = (load_scene(str(folder / "statue.ply"), overrides).camera for _ in range(2))
    assert first == second


def test_an_emitter_without_area_does_not_count(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl lamp\nKd 0 0 0\nKe 5 5 5\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 3 0 0\nv 4 0 0\nv 5 0 0\n"
    (tmp_path / "m.obj").write_text(f"mtllib m.mtl\n{corners}usemtl lamp\nf 1 2 3\nf 4 5 6\n")
    assert np.isfinite(load_scene(str(tmp_path / "m.obj")).camera.position).all()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_view_does_not_depend_on_the_unit_of_a_model_that_shines(folder, scale):
    """The emitters of the model and of the map keep their proportion: a big model hides no emitter of the map."""
    cameras = []
    for unit in (1.0, scale):
        statue = trimesh.load(folder / "statue.ply")
        panel = np.array([(-0.1, 0.2, 0.6), (0.1, 0.2, 0.6), (0.1, 0.4, 0.6), (-0.1, 0.4, 0.6)]) * unit
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in (*(statue.vertices * unit), *panel)]
        lines += ["usemtl grey", *("f {} {} {}".format(*(face + 1)) for face in statue.faces)]
        first = len(statue.vertices) + 1
        lines += ["usemtl lit", f"f {first} {first + 1} {first + 2}", f"f {first} {first + 2} {first + 3}"]
        (folder / "lit.mtl").write_text("newmtl grey\nKd 0.5 0.5 0.5\nnewmtl lit\nKd 0 0 0\nKe 5 5 5\n")
        (folder / "lit.obj").write_text("\n".join(["mtllib lit.mtl", *lines]) + "\n")
        scene = load_scene(str(folder / "lit.obj"), Overrides(environment=str(folder / "lamp.exr")))
        cameras.append((np.array(scene.camera.position) / unit, scene.environment.rotation))
    np.testing.assert_allclose(cameras[1][0], cameras[0][0], rtol=1e-3)
    assert cameras[1][1] == cameras[0][1]
