"""The state of the page of `bokehguide view`: the command and the scene file of a state make the scene of the page."""

from __future__ import annotations

import math
import os
import random
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bokehguide.cli.arguments import parse
from bokehguide.cli.render import overrides_from
from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, Scene, load_scene
from bokehguide.scene.digest import digest
from bokehguide.scene.sight import to_raster
from bokehguide.view.motion import move
from bokehguide.view.state import CHANGES, Source, ViewState, changed, command_line, moved, scene_file, values_of
from tests.support.gltf_square import write_gltf
from tests.support.scene_text import BOX_AND_EMITTER

FILE = BOX_AND_EMITTER.replace("fov = 40.0\naperture_radius = 0.5", "focal_length = 37.3\nf_number = 0.07").replace(
    "focus_distance = 3.0", 'focus_on = "wall"'
)
"""A scene file whose lens and focus depend on other values of its camera."""

STAGE_CAMERA = """
def Camera "{name}" {{
    float focalLength = 0.5
    float horizontalAperture = {width}
    float verticalAperture = 0.15291
    float fStop = 2.8
    float focusDistance = 3
    double3 xformOp:translate = (0, 0, 4)
    double3 xformOp:rotateXYZ = {turn}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
}}
"""
STAGE = "\n".join(
    (
        '#usda 1.0\n(\nmetersPerUnit = 1\nupAxis = "Y"\n)\ndef Sphere "ball" {\ndouble radius = 0.5\n}',
        STAGE_CAMERA.format(name="upright", width=0.20955, turn="(0, 0, 0)"),
        STAGE_CAMERA.format(name="tilted", width=0.5, turn="(-5, 3, 12)"),
    )
)
"""A stage of a 50 mm lens on a sensor 20.955 mm wide, and of another lens on a sensor 50 mm wide."""


def source_of(spec: str, *options: str) -> Source:
    given = parse(["render", spec, *options])
    return Source(load_scene(spec, overrides_from(given)), overrides_from(given), spec)


def state_of(source: Source) -> ViewState:
    return ViewState(source.overrides, exposure=source.scene.film.exposure)


def same(one: Scene, other: Scene, sensor: bool = True) -> None:
    """Assert that two scenes have the same camera, film, environment and geometry. sensor: whether its width counts."""
    for name in ("position", "target", "up", "fov", "aperture_radius", "focus_distance", *(["sensor_width"] if sensor else [])):
        assert getattr(one.camera, name) == getattr(other.camera, name), name
    assert digest(one.camera.aperture) == digest(other.camera.aperture)
    assert (one.film.width, one.film.height, one.film.max_depth) == (other.film.width, other.film.height, other.film.max_depth)
    assert digest(one.environment) == digest(other.environment) and digest(one.meshes) == digest(other.meshes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Iterator[Path]:
    """The present folder of these tests, with the files of the sources."""
    path = tmp_path_factory.mktemp("view")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(path)
        yield path


@pytest.fixture(scope="module")
def sources(folder) -> dict[str, Source]:
    """Sources of all kinds."""
    (folder / "box.toml").write_text(FILE)
    write_gltf(folder / "square.gltf")
    tilted = {"camera": 0, "translation": [0.5, 1.0, 4.0], "rotation": [-0.1, 0.02, 0.03, 0.994]}
    lens = [{"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}]
    write_gltf(folder / "photo.gltf", nodes=[{"mesh": 0}, tilted], cameras=lens)
    lens = [{"type": "perspective", "perspective": {"aspectRatio": 16 / 9, "yfov": 0.4, "znear": 0.1, "zfar": 100.0}}]
    camera = {"name": "Camera", "camera": 0, "translation": [0.5, 0.6, 4.0], "rotation": [-0.05, 0.0, 0.0, 0.99875]}
    write_gltf(folder / "blender.gltf", nodes=[{"name": "Plane", "mesh": 0}, camera], cameras=lens)
    return {
        "builtin": source_of("fairy-lights", "--size", "32x18"),
        "file": source_of("box.toml"),
        "model": source_of("square.gltf", "--size", "32x18"),
        "camera": source_of("photo.gltf", "--size", "32x18", "--camera", "0"),
        "blender": source_of("blender.gltf", "--size", "32x18"),
        "hidden": source_of("square.gltf", "--size", "32x18", "--hide-environment"),
        "options": source_of("box.toml", "--f-number", "0.1", "--camera-target", "0.1,0,0"),
    }


EDITS = {
    "untouched": [],
    "f-number": [("f_number", 1.7)],
    "pinhole": [("f_number", None)],
    "focus": [("focus_distance", 2.345)],
    "infinity": [("focus_distance", None)],
    "field of view": [("fov", 33.3)],
    "focal length": [("focal_length", 61.7), ("f_number", 2.2)],
    "shape": [("blades", 7), ("rotation", 12.5), ("curvature", 0.3), ("ratio", 1.4), ("cat_eye", 0.5), ("edge", -0.2)],
    "round again": [("blades", 7), ("rotation", 12.5), ("blades", 0)],
    "light": [("environment_rotation", 77.0), ("mode", "uniform"), ("exposure", 1.5), ("view", "aces"), ("spp", 3)],
    "moved lens": [("f_number", 1.4), ("move", ("orbit", 0.1, 0.05)), ("focal_length", 61.7), ("move", ("dolly", 0.0, -0.1))],
    "moved": [("move", ("orbit", 0.1, 0.05)), ("move", ("dolly", 0.0, -0.1)), ("f_number", 1.1), ("move", ("pan", 0.05, 0.0))],
}


def edited(source: Source, name: str) -> ViewState:
    """The state after the edits of this name."""
    state = state_of(source)
    for key, value in EDITS[name]:
        state = with_edit(state, source, key, value)
    return state


def with_edit(state: ViewState, source: Source, key: str, value: Any) -> ViewState:
    """The state after one edit."""
    if key == "move":
        return moved(state, source, *move(source.scene_of(state.overrides).camera, *value))
    return changed(state, source, key, value)


@pytest.mark.parametrize("name", EDITS)
@pytest.mark.parametrize("kind", ["builtin", "file", "model", "camera", "blender", "hidden", "options"])
def test_the_command_and_the_scene_file_make_the_scene_of_the_page(kind, name, sources, folder):
    check_page(sources[kind], name, folder)


@pytest.mark.parametrize("name", ["untouched", "f-number", "pinhole", "field of view", "focal length", "moved lens", "moved"])
@pytest.mark.parametrize("options", [(), ("--fov", "60"), ("--f-number", "2"), ("--camera", "frame"), ("--camera", "tilted")])
def test_the_lens_of_a_stage_is_that_of_the_page(options, name, folder):
    pytest.importorskip("pxr")
    (folder / "stage.usda").write_text(STAGE)
    check_page(source_of("stage.usda", "--size", "32x18", *options), name, folder, sensor="tilted" not in options)


OVERRIDES = ("", "f_number = 2.0", "fov = 60.0", "camera_position = [0.4, 0.5, 3.0]", "aperture_blades = 6", 'camera = "tilted"')
"""Overrides of scene files whose base is a model with the camera `tilted`."""


def random_edits(rng: random.Random) -> list[tuple[str, object]]:
    """Some edits of the camera, the lens and the environment."""
    kinds = ("f_number", "focus_distance", "fov", "focal_length", "environment_rotation", "blades", "move", "move")
    limits = {"f_number": (0.5, 8.0), "focus_distance": (1.0, 6.0), "fov": (20.0, 70.0), "focal_length": (20.0, 90.0)}
    edits: list[tuple[str, object]] = []
    for kind in rng.choices(kinds, k=rng.randint(1, 5)):
        if kind == "move":
            name = rng.choice(("orbit", "look", "pan", "dolly", "walk", "rise"))
            edits.append((kind, (name, rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1))))
        elif kind == "blades":
            edits.append((kind, rng.choice((5, 7))))
        else:
            pinhole = kind == "f_number" and rng.random() < 0.2
            edits.append((kind, None if pinhole else rng.uniform(*limits.get(kind, (0.0, 360.0)))))
    return edits


@pytest.mark.parametrize("first", range(0, 20, 5))
@pytest.mark.parametrize("model", ["rolled.usda", "tilted.gltf", "plain.gltf"])
def test_random_edits_of_a_scene_file_with_a_model_as_base(model, first, folder):
    if model == "rolled.usda":
        pytest.importorskip("pxr")
        (folder / model).write_text(STAGE.replace("(0, 0, 0)", "(3, 2, 10)"))
    elif model == "tilted.gltf":
        camera = {"name": "tilted", "camera": 0, "translation": [0.5, 1.0, 4.0], "rotation": [-0.1, 0.02, 0.03, 0.994]}
        lens = [{"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}]
        write_gltf(folder / model, nodes=[{"mesh": 0}, camera], cameras=lens)
    else:
        write_gltf(folder / model)
    known = OVERRIDES[:-1] if model == "plain.gltf" else OVERRIDES
    for seed in range(first, first + 5):
        rng = random.Random(seed)
        (folder / "derived.toml").write_text(f'base = "{model}"\n[overrides]\n{rng.choice(known)}\n')
        source = source_of("derived.toml", "--size", "32x18", *rng.choice([(), (), ("--f-number", "1.5"), ("--fov", "50")]))
        state = state_of(source)
        for key, value in random_edits(rng):
            try:
                state = with_edit(state, source, key, value)
            except BokehguideError:  # a pinhole has no blades
                continue
        options = parse(shlex.split(command_line(state, source))[1:])
        same(load_scene(options.scene, overrides_from(options)), source.scene_of(state.overrides), model != "rolled.usda")


@pytest.mark.parametrize("name", ["untouched", "f-number", "focal length", "moved lens", "moved"])
def test_the_camera_that_a_scene_file_selects(name, folder):
    pytest.importorskip("pxr")
    (folder / "stage.usda").write_text(STAGE)
    (folder / "derived.toml").write_text('base = "stage.usda"\n[overrides]\ncamera = "tilted"\n')
    check_page(source_of("derived.toml", "--size", "32x18"), name, folder, sensor=False)


def check_page(source: Source, name: str, folder: Path, sensor: bool = True) -> None:
    """Assert that the command and the scene file after edits make the scene of the page. sensor: whether they keep its width."""
    state = edited(source, name)
    scene = source.scene_of(state.overrides)
    words = shlex.split(command_line(state, source))
    options = parse(words[1:])
    same(load_scene(options.scene, overrides_from(options)), scene, sensor)
    assert (options.mode, options.spp, options.view) == (state.mode, state.spp, state.view)
    path = folder / "saved.toml"
    path.write_text(scene_file(state, source, folder, path.name))
    saved = load_scene(str(path))
    same(saved, scene, sensor)
    assert saved.film.exposure == state.exposure
    assert path.read_text().startswith(f"# bokehguide render saved.toml --mode={state.mode} --spp={state.spp}")


@pytest.mark.parametrize("exposure", [None, 1.5])
def test_the_exposure_of_the_page_replaces_that_of_the_scene(exposure, sources, folder):
    scene = sources["file"].scene
    exposed = replace(sources["file"], scene=replace(scene, film=replace(scene.film, exposure=-2.0)))
    (folder / "saved.toml").write_text(scene_file(ViewState(Overrides(), exposure=exposure), exposed, folder, "saved.toml"))
    (folder / "box.toml").write_text(FILE.replace("[film]", "[film]\nexposure = -2.0"))
    assert load_scene("box.toml").film.exposure == -2.0 and load_scene("saved.toml").film.exposure == exposure
    (folder / "box.toml").write_text(FILE)


@pytest.mark.parametrize("number", [1.1, 2.8, 201.4])
def test_a_typed_f_number_stays_as_it_was_typed(number, sources, folder):
    source = sources["file"]
    state = changed(changed(state_of(source), source, "f_number", number), source, "fov", 39.6)
    assert f"f_number = {number}\n" in scene_file(state, source, folder, "saved.toml")


def test_edits_change_the_scene(sources):
    """Otherwise the comparisons above would prove nothing."""
    for source in sources.values():
        cameras = {name: source.scene_of(edited(source, name).overrides) for name in EDITS}
        first = cameras.pop("untouched")
        for name, scene in cameras.items():
            if name != "round again":
                differs = scene.camera != first.camera or digest(scene.environment) != digest(first.environment)
                assert differs, name


def test_another_field_of_view_keeps_the_f_number_and_the_focus(sources):
    source = sources["file"]
    before = values_of(state_of(source), source)
    after = values_of(edited(source, "field of view"), source)
    assert after["f_number"] == pytest.approx(before["f_number"], rel=1e-12)
    assert (after["focus_distance"], after["fov"]) == (before["focus_distance"], 33.3)
    assert after["focal_length"] == pytest.approx(18.0 / math.tan(math.radians(33.3) / 2.0))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("f_number", -1.0, "f-number"),
        ("f_number", "2", "no number"),
        ("focus_distance", 0.0, "focus-distance"),
        ("fov", 200.0, "fov"),
        ("focal_length", 0.0, "focal length: 0 is out of range; give millimetres from 0.000157 to 2.06e"),
        ("focal_length", 1e9, "focal length: .* is out of range; give millimetres from"),
        ("blades", 2, "blades"),
        ("blades", 2.5, "blades"),
        ("ratio", 100.0, "ratio"),
        ("exposure", 1e9, "exposure"),
        ("spp", 0, "SPP"),
        ("spp", True, "SPP"),
        ("mode", "magic", "mode"),
        ("layer", "smell", "layer"),
        ("denoise", "yes", "denoise"),
        ("f_nunber", 2.0, "did you mean 'f_number'"),
        ("environment_rotation", math.nan, "no number"),
    ],
)
def test_a_wrong_value_is_an_error_that_names_it(name, value, words, sources):
    source = sources["builtin"]
    with pytest.raises(BokehguideError, match=words):
        changed(state_of(source), source, name, value)


def test_a_scene_of_python_has_no_file(sources, tmp_path):
    source = Source(sources["builtin"].scene)
    with pytest.raises(BokehguideError, match="a scene of Python"):
        scene_file(state_of(source), source, tmp_path, "a.toml")


def test_paths_of_a_saved_scene_are_relative_to_it(sources, tmp_path):
    text = scene_file(state_of(sources["file"]), sources["file"], tmp_path, "a.toml")
    assert f'base = "{os.path.relpath("box.toml", tmp_path)}"' in text and "--allow-outside" in text.splitlines()[0]
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(BokehguideError, match="outside the scene's folder"):
        load_scene(str(tmp_path / "a.toml"))
    same(load_scene(str(tmp_path / "a.toml"), allow_outside=True), sources["file"].scene)


@pytest.mark.parametrize("kind", ["orbit", "look", "pan", "dolly", "walk", "rise"])
def test_movements_add_no_roll_and_change_as_asked(kind, sources):
    camera = sources["builtin"].scene.camera
    position, target = (np.array(each) for each in move(camera, kind, 0.1, 0.07))
    before = np.subtract(camera.target, camera.position)
    distance, after = np.linalg.norm(before), target - position
    moved_eye, moved_target = not np.allclose(position, camera.position), not np.allclose(target, camera.target)
    assert (moved_eye, moved_target) == {"orbit": (True, False), "look": (False, True), "dolly": (True, False)}.get(
        kind, (True, True)
    )
    if kind != "dolly":
        assert np.linalg.norm(after) == pytest.approx(distance)
    if kind in ("pan", "walk", "rise"):
        np.testing.assert_allclose(after, before, atol=1e-9)
    if kind == "dolly":
        assert np.linalg.norm(after) == pytest.approx(distance * 4.0**0.07)


def test_the_scene_follows_the_pointer(sources):
    """A point at the target moves with a drag to the right and down, for a pan and for a look."""
    scene = sources["builtin"].scene
    for kind in ("pan", "look"):
        position, target = move(scene.camera, kind, 0.02, 0.01)
        camera = replace(scene.camera, position=position, target=target)
        (raster,), _ = to_raster(camera, scene.film, np.array([scene.camera.target]))
        expected = np.array([0.5 * scene.film.width, 0.5 * scene.film.height]) + np.array([0.02, 0.01]) * scene.film.width
        np.testing.assert_allclose(raster, expected, atol=0.02 * scene.film.width * 0.15)


def test_an_orbit_stops_before_the_zenith(sources):
    camera = sources["builtin"].scene.camera
    position, target = move(camera, "orbit", 0.0, 100.0)
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    assert -0.9999 < forward[1] < -0.99


def test_all_changes_are_values_of_the_page(sources):
    source = sources["builtin"]
    assert set(CHANGES) <= set(values_of(state_of(source), source))


def test_overrides_give_way_to_later_ones():
    later, earlier = Overrides(f_number=2.0, focus_distance=1.0), Overrides(aperture_radius=0.1, focus_on="x", fov=30.0)
    assert later.over(earlier) == Overrides(f_number=2.0, focus_distance=1.0, fov=30.0)
    assert Overrides(camera_target=(0.0, 0.0, 1.0)).over(Overrides(camera="a")) == Overrides(camera_target=(0.0, 0.0, 1.0))
