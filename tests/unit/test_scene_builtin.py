"""The built-in scenes: their lens coverage, their insets, and the text of `info`."""

import numpy as np
import pytest

from bokehguide.scene import (
    BUILTIN,
    DESCRIPTIONS,
    Camera,
    Environment,
    FilmSettings,
    Inset,
    Material,
    Overrides,
    Scene,
    lens_coverage,
    load_scene,
    summarize,
)
from bokehguide.scene.builtin.parts import emitter_radius, gear, lathe, ring, rod
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box, unit_rectangle

EMITTER_SCENES = ("fairy-lights", "occluded", "chrome", "night-street", "glitter", "cutout")
NAMES = (*EMITTER_SCENES, "daylight")


def test_the_names_and_their_order():
    assert tuple(BUILTIN) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_built_in_scene_is_complete(name):
    scene = load_scene(name)
    assert scene.name == name and scene.warnings == ()
    assert scene.description == DESCRIPTIONS[name] and "\n" not in scene.description
    assert (scene.film.width, scene.film.height, scene.film.max_depth) == (640, 360, 6)
    assert 2 <= len(scene.insets) <= 3
    for inset in scene.insets:
        assert 0.0 <= inset.x < inset.x + inset.width <= 1.0
        assert 0.0 <= inset.y < inset.y + inset.height <= 1.0
    assert sum(len(mesh.triangles) for mesh in scene.meshes) < 400_000
    assert scene.camera.aperture_radius > 0.0


@pytest.mark.parametrize("name", NAMES)
def test_a_built_in_scene_is_always_the_same(name):
    first, second = BUILTIN[name](), BUILTIN[name]()
    for one, other in zip(first.meshes, second.meshes, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.triangles, other.triangles)
    assert first.materials == second.materials
    if first.environment is not None:
        np.testing.assert_array_equal(first.environment.radiance, second.environment.radiance)


@pytest.mark.parametrize("name", EMITTER_SCENES)
def test_an_emitter_covers_between_a_fifth_and_one_per_cent_of_the_lens(name):
    assert 0.002 <= lens_coverage(load_scene(name)) <= 0.01


@pytest.mark.parametrize("name", EMITTER_SCENES)
def test_every_inset_lies_over_bokeh(name):
    """The circles of confusion of three emitters have their middle in it; in chrome, of highlights."""
    scene = load_scene(name)
    camera, emitters = scene.camera, find_emitters(scene)
    forward = np.subtract(camera.target, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    towards = emitters.centres - np.where(emitters.infinite[:, None], 0.0, camera.position)
    towards = towards[towards @ forward > 0.0]
    reach = np.tan(np.radians(camera.fov / 2.0))
    x = 0.5 + 0.5 * (towards @ right) / (towards @ forward) / reach
    up = (towards @ np.cross(right, forward)) / (towards @ forward)
    y = 0.5 - 0.5 * up / reach * scene.film.width / scene.film.height
    for inset in scene.insets:
        inside = (inset.x < x) & (x < inset.x + inset.width)
        inside &= (inset.y < y) & (y < inset.y + inset.height)
        assert inside.sum() >= 3 or (name == "chrome" and inset is scene.insets[0]), inset


def test_daylight_has_no_spot():
    scene = load_scene("daylight")
    assert lens_coverage(scene) is None
    assert not any(material.emits for material in scene.materials)
    sky = scene.environment.radiance
    assert sky.max() < 2.0 * sky[sky.shape[0] // 4].mean()


def test_cutout_has_no_background():
    assert load_scene("cutout").environment is None


def test_the_other_emitter_scenes_have_one():
    assert all(load_scene(name).environment is not None for name in NAMES if name != "cutout")


def scene_with(meshes, environment=None, **camera) -> Scene:
    lens = {"aperture_radius": 0.1, "focus_distance": 2.0, "fov": 60.0} | camera
    return Scene(
        name="test",
        camera=Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), **lens),
        meshes=tuple(meshes),
        materials=(Material("emitter", emission=(5.0, 5.0, 5.0)), Material("grey")),
        environment=environment,
    )


def test_coverage_of_a_sphere_is_the_projected_disc():
    """R = 0.02 at Z = 6 through the focus at 2: (0.02 · 2 / 4 / 0.1)² = 1 %."""
    emitters = spheres([[0.0, 0.0, -6.0], [0.5, 0.2, -6.0], [-1.0, 0.0, -6.0]], 0.02, 0)
    assert lens_coverage(scene_with([emitters])) == pytest.approx(0.01, rel=2e-3)


def test_coverage_of_a_flat_emitter_by_its_area():
    """A square of 0.04 × 0.04 as the disc of its area, (0.04² / π)(2 / 4 / 0.1)²."""
    square = transformed(unit_rectangle(), transform((0.0, 0.0, -6.0), scale=0.02))
    assert lens_coverage(scene_with([square])) == pytest.approx(0.0016 / np.pi * 25.0, rel=1e-5)


def test_a_box_is_one_emitter_and_its_far_neighbour_another():
    box = transformed(unit_box(), transform((0.0, 0.0, -6.0), scale=0.02))
    other = transformed(unit_box(), transform((0.5, 0.0, -6.0), scale=0.02))
    emitters = find_emitters(scene_with([joined([box, other])]))
    assert len(emitters.radii) == 2
    # Cauchy: a closed convex surface of area 6 a² shows 6 a² / 4 on average.
    np.testing.assert_allclose(emitters.radii, np.sqrt(1.5 * 0.02**2 / np.pi), rtol=1e-5)
    np.testing.assert_allclose(sorted(emitters.centres[:, 0]), (0.0, 0.5), atol=1e-6)


def half_axes(outline: np.ndarray) -> np.ndarray:
    return np.sqrt(np.linalg.eigvalsh(outline))


def test_ellipsoids_have_the_proportions_of_emitters_and_contain_them():
    """A sphere's ellipsoid is the sphere. A rectangle's half axes are its half sides times √2, and 0. At infinity all are 0."""
    ball = spheres([[0.3, 0.0, -6.0]], 0.05, 0)
    parallelogram = transformed(unit_rectangle(), transform((1.0, 0.0, -6.0), (20.0, 70.0, -10.0), (0.5, 0.02, 1.0)))
    emitters = find_emitters(scene_with([ball, parallelogram], peak_map(slice(127, 129), slice(255, 257))))
    np.testing.assert_allclose(half_axes(emitters.ellipsoids[0]), 0.05, rtol=0.02)
    sides = np.linalg.norm(np.diff(parallelogram.vertices[parallelogram.triangles[0]], axis=0), axis=1)
    np.testing.assert_allclose(half_axes(emitters.ellipsoids[1])[1:], np.sort(sides) / np.sqrt(2.0), rtol=1e-3)
    assert half_axes(emitters.ellipsoids[1])[0] < 3e-3 * sides.max()
    assert not emitters.ellipsoids[2].any()
    for number, mesh in enumerate((ball, parallelogram)):
        offset = mesh.vertices - emitters.centres[number]
        inside = np.einsum("vi,ij,vj->v", offset, np.linalg.inv(emitters.ellipsoids[number]), offset)
        assert inside.max() == pytest.approx(1.0, rel=1e-3)


def test_bounding_radii_and_luminance_of_emitters():
    box = transformed(unit_box(), transform((0.0, 0.0, -6.0), scale=0.02))
    emitters = find_emitters(scene_with([box], peak_map(slice(127, 129), slice(255, 257))))
    assert emitters.bounding_radii[0] == pytest.approx(0.01 * np.sqrt(3.0), rel=1e-5)
    # To the middles of 2 × 2 texels of π / 256 each, and from there to the corner of what the bilinear interpolation lights.
    assert emitters.bounding_radii[1] == pytest.approx(np.pi / 256 * (np.sqrt(0.5) + np.sqrt(2.0)), rel=0.01)
    assert emitters.luminance[0] == pytest.approx(np.dot((0.2126, 0.7152, 0.0722), scene_with([box]).materials[0].emission))
    assert emitters.luminance[1] == pytest.approx(500.0, rel=1e-5)


def test_emitters_outside_the_frame_do_not_count():
    behind = spheres([[0.0, 0.0, 6.0]], 0.02, 0)
    beside = spheres([[9.0, 0.0, -6.0]], 0.02, 0)
    unlit = spheres([[0.0, 0.0, -6.0]], 0.02, 1)
    assert lens_coverage(scene_with([behind, beside, unlit])) is None
    assert lens_coverage(scene_with([spheres([[0.0, 0.0, -6.0]], 0.02, 0)], aperture_radius=0.0)) is None


def peak_map(rows, columns, rotation=0.0):
    radiance = np.full((256, 512, 3), 0.01, np.float32)
    radiance[rows, columns] = 500.0
    return Environment(radiance, rotation)


def test_coverage_of_a_spot_of_the_environment():
    """Four texels on the horizon subtend 4 (π / 256)² sr; the disc of that, times d / r."""
    environment = peak_map(slice(127, 129), slice(255, 257))
    share = lens_coverage(scene_with([spheres([[0, 0, 5.0]], 0.02, 1)], environment))
    assert share == pytest.approx(4.0 * (np.pi / 256) ** 2 / np.pi * (2.0 / 0.1) ** 2, rel=1e-3)


@pytest.mark.parametrize(
    ("column", "rotation", "direction"),
    [
        (256, 0.0, (0.0, 0.0, -1.0)),
        (384, 0.0, (1.0, 0.0, 0.0)),
        (128, 0.0, (-1.0, 0.0, 0.0)),
        (256, 90.0, (-1.0, 0.0, 0.0)),
        (0, 0.0, (0.0, 0.0, 1.0)),
    ],
)
def test_where_the_spots_of_an_environment_lie(column, rotation, direction):
    """The map's centre at -z, u towards +x, anticlockwise from above; its edges meet."""
    columns = [(column - 1) % 512, column % 512]
    emitters = find_emitters(scene_with([], peak_map(slice(127, 129), columns, rotation)))
    np.testing.assert_allclose(emitters.centres, [direction], atol=1e-6)
    assert emitters.infinite.all()


def test_a_smooth_sky_has_no_spots():
    sky = load_scene("daylight").environment
    assert lens_coverage(scene_with([], sky)) is None


@pytest.mark.slow
def test_info_says_what_was_loaded():
    scene = load_scene("fairy-lights", Overrides(width=320, height=180))
    text = summarize(scene)
    triangles = sum(len(mesh.triangles) for mesh in scene.meshes)
    emitters = len(find_emitters(scene).radii)
    for part in (
        f"fairy-lights: {scene.description}",
        f"{triangles:,}",
        f"in {emitters} emitters",
        "environment map of 64 × 32",
        "40° across",
        "radius 0.04 m, focused at 0.95 m (f/0.62 on a sensor 36 mm wide)",
        "320 × 180 pixels",
        "0.02, 0.05, 0.26, 0.4",
        f"{100 * lens_coverage(scene):.3g} % of the lens",
    ):
        assert part in text, f"{part!r} is not in\n{text}"
    assert "pinhole" in summarize(load_scene("daylight", Overrides(aperture_radius=0.0)))
    assert "colour (1, 2, 3)" in summarize(load_scene("daylight", Overrides(environment="1,2,3")))
    assert "no environment" in summarize(load_scene("cutout"))


@pytest.mark.parametrize(
    ("body", "volume"),
    [
        (lathe([(0.0, 0.0), (1.0, 0.0), (1.0, 2.0), (0.0, 2.0)], 256), 2.0 * np.pi),
        (rod((1.0, 0.0, 0.0), (1.0, 3.0, 0.0), 0.5, 256), 0.75 * np.pi),
        (ring(1.0, 0.1, 256), 2.0 * np.pi**2 * 0.01),
    ],
)
def test_turned_bodies_are_closed_and_face_outwards(body, volume):
    a, b, c = np.moveaxis(body.vertices[body.triangles].astype(np.float64), 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 == pytest.approx(volume, rel=0.02)
    flat = np.cross(b - a, c - a)
    assert (np.einsum("ij,ikj->ik", flat, body.normals[body.triangles]) > 0.0).all()


def test_a_wheel_has_its_teeth_outside_and_faces_outwards():
    wheel = gear(1.0, 20, 0.2)
    assert np.linalg.norm(wheel.vertices[:, :2], axis=1).max() == pytest.approx(1.0)
    a, b, c = np.moveaxis(wheel.vertices[wheel.triangles].astype(np.float64), 1, 0)
    # Rim: between the mean of the toothed outline and the bore, plus spokes and hub.
    assert 0.1 < np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 < 0.6
    front = np.linalg.norm((a + b + c)[:, :2] / 3, axis=1) > 0.8
    front &= (a + b + c)[:, 2] / 3 > 0.0999
    assert front.any() and (np.cross(b - a, c - a)[front, 2] > 0.0).all()


def test_emitter_radius_inverts_the_coverage():
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=0.1, focus_distance=2.0)
    centres = np.array([[0.0, 0.0, -6.0], [0.1, 0.0, -0.5]])
    for centre, radius in zip(centres, emitter_radius(camera, centres, 0.004)):
        share = lens_coverage(scene_with([spheres([centre], radius, 0)]))
        assert share == pytest.approx(0.004, rel=2e-3)


def test_inset_pixels():
    rows, columns = Inset(0.25, 0.5, 0.5, 0.25).pixels(FilmSettings.width, FilmSettings.height)
    assert (rows, columns) == (slice(180, 270), slice(160, 480))
