"""Scene files that name another scene as their base."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bokehguide.errors import BokehguideError
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.toml.derived import derived_text
from tests.support.gltf_square import write_gltf
from tests.support.scene_text import BOX_AND_EMITTER


@pytest.fixture
def derive(tmp_path):
    """A function that writes a derived scene beside `box.toml` and loads it."""
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)

    def write(text: str, overrides: Overrides = Overrides(), **keywords):  # noqa: B008 - frozen
        (tmp_path / "derived.toml").write_text(text)
        return load_scene(str(tmp_path / "derived.toml"), overrides, **keywords)

    return write


def test_overrides_replace_values_of_the_base(derive):
    scene = derive(
        'base = "box.toml"\n[overrides]\nf_number = 0.2\nwidth = 16\nheight = 9\nexposure = 1.5\naperture_blades = 6\n'
    )
    assert (scene.name, scene.film.width, scene.film.height, scene.film.exposure) == ("derived", 16, 9, 1.5)
    assert scene.camera.f_number == pytest.approx(0.2) and scene.camera.aperture.blades == 6
    assert (scene.camera.focus_distance, len(scene.meshes), scene.film.max_depth) == (3.0, 2, 3)


LAMP = """
[[light]]
name = "key"
radius = 0.1
position = [0.0, 3.0, 0.0]
lumens = 800.0
group = "key"
"""
SUN = "[[sun]]\ndirection = [0.0, 1.0, 0.0]\nirradiance = [1.0, 2.0, 3.0]\n"


@pytest.mark.parametrize("key", ["camera", "film", "environment", "lights", "materials", "object"])
def test_tables_of_a_whole_scene_have_no_place_beside_a_base(derive, key):
    told = rf"derived.toml: {key}: has no place beside base; give \[overrides\], \[\[light\]\] and \[\[sun\]\] only, or a scene"
    with pytest.raises(BokehguideError, match=told):
        derive(f'base = "box.toml"\n[{key}]\nfov = 40.0\n')


def test_lights_beside_a_base_join_those_of_the_base(derive, tmp_path):
    before = derive('base = "box.toml"\n')
    scene = derive('base = "box.toml"\n' + LAMP + SUN)
    assert len(scene.meshes) == len(before.meshes) + 1 and scene.meshes[-1].name == "key"
    lamp = scene.materials[scene.meshes[-1].material]
    assert lamp.emits and lamp.light_group == "key" and scene.materials[: len(before.materials)] == before.materials
    assert len(scene.suns) == len(before.suns) + 1 and scene.suns[-1].irradiance == (1.0, 2.0, 3.0)
    (tmp_path / "lit.toml").write_text('base = "box.toml"\n' + LAMP)
    assert [mesh.name for mesh in derive('base = "lit.toml"\n' + LAMP.replace("key", "fill")).meshes[-2:]] == ["key", "fill"]
    assert len(derive('base = "daylight"\n' + LAMP).meshes) == len(load_scene("daylight").meshes) + 1


def test_a_light_of_the_file_replaces_the_sky_of_a_model(derive, tmp_path):
    """As a light within the model does; a base in between changes nothing."""
    trimesh.creation.box().export(tmp_path / "box.ply")
    assert derive('base = "box.ply"\n').environment is not None
    (tmp_path / "between.toml").write_text('base = "box.ply"\n')
    for base, light in (("box.ply", LAMP), ("box.ply", SUN), ("between.toml", LAMP)):
        scene = derive(f'base = "{base}"\n{light}')
        assert scene.environment is None and scene.film.exposure is None and scene.likely_mistakes == ()
    kept = derive(f'base = "box.ply"\n[overrides]\nenvironment = "1,1,1"\n{LAMP}')
    assert kept.environment.radiance.ravel().tolist() == [1.0, 1.0, 1.0]


def test_a_sun_beside_a_base_can_be_hidden(derive, tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    assert not derive(f'base = "box.ply"\n[overrides]\nhide_environment = true\n{SUN}').environment.visible
    assert not derive(f'base = "box.ply"\n{SUN}', Overrides(hide_environment=True)).environment.visible


def test_a_base_with_cameras_is_seen_by_its_own(derive, tmp_path):
    view = {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 1.5, "znear": 0.1}}
    nodes = [{"mesh": 0}, {"camera": 0, "name": "front", "translation": [0, 0, 4]}]
    nodes += [{"camera": 0, "name": "side", "translation": [1, 0, 6]}]
    write_gltf(tmp_path / "square.gltf", nodes=nodes, cameras=[view])
    assert derive('base = "square.gltf"\n' + LAMP).camera.position == (0.0, 0.0, 4.0)
    for overrides, position in (
        ('camera = "side"', (1.0, 0.0, 6.0)),
        ("camera = 1", (1.0, 0.0, 6.0)),
        ("camera_position = [0.0, 0.0, 3.0]", (0.0, 0.0, 3.0)),
        ("f_number = 2.0", (0.0, 0.0, 4.0)),
    ):
        assert derive(f'base = "square.gltf"\n[overrides]\n{overrides}\n').camera.position == position
    camera = derive('base = "square.gltf"\n[overrides]\ncamera = "side"\n', Overrides(camera="front")).camera
    assert camera.position == (0.0, 0.0, 4.0)


def test_a_byte_order_mark_changes_nothing(derive, tmp_path):
    scene = derive("\ufeff" + 'base = "box.toml"\n[overrides]\nwidth = 16\n')
    assert scene.film.width == 16


def test_an_override_may_meter_the_exposure(derive, tmp_path):
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER.replace("[film]", "[film]\nexposure = 2.0"))
    assert derive('base = "box.toml"\n').film.exposure == 2.0
    assert derive('base = "box.toml"\n[overrides]\nexposure = "auto"\n').film.exposure is None
    with pytest.raises(
        BokehguideError, match=r"derived.toml: overrides.exposure: 'bright' is not a number; give EV .* or \"auto\""
    ):
        derive('base = "box.toml"\n[overrides]\nexposure = "bright"\n')


def test_a_base_may_be_built_in_and_overrides_may_be_absent(derive):
    assert len(derive('base = "daylight"\n').meshes) == len(load_scene("daylight").meshes)


def test_the_command_line_has_the_last_word(derive):
    scene = derive('base = "box.toml"\n[overrides]\nf_number = 0.2\nfocus_distance = 2.0\n', Overrides(aperture_radius=0.1))
    assert (scene.camera.aperture_radius, scene.camera.focus_distance) == (0.1, 2.0)


def test_a_focus_on_a_point_is_found_in_the_derived_scene(derive):
    near = derive('base = "box.toml"\n[overrides]\nfocus_at = [0.25, 0.6]\n').camera.focus_distance
    assert near == pytest.approx(3.0, abs=0.2)
    far = derive('base = "box.toml"\n[overrides]\nfocus_at = [0.25, 0.6]\ncamera_position = [0.0, 0.0, 5.0]\n')
    assert far.camera.focus_distance == pytest.approx(near + 1.0, abs=0.2)


def test_a_base_may_have_a_base(derive, tmp_path):
    (tmp_path / "first.toml").write_text('base = "box.toml"\n[overrides]\nfov = 30.0\nfocus_distance = 2.5\n')
    camera = derive('base = "first.toml"\n[overrides]\nfov = 20.0\n').camera
    assert (camera.fov, camera.focus_distance) == (20.0, 2.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('base = "derived.toml"', "derived.toml: base: more than 8 files"),
        ('base = "gone.toml"', "derived.toml: base: .*gone.toml"),
        ('base = "fairy-light"', "derived.toml: base: 'fairy-light' is no built-in scene .*; did you mean 'fairy-lights'"),
        ('base = "/etc/hostname"', "outside the scene's folder"),
        ('base = ""', "derived.toml: base: .* is not a text"),
        ("base = 3", "derived.toml: base: 3 is not a text"),
        ('base = "box.toml"\n[overrides]\nf_numbr = 2.0', "overrides.f_numbr: unknown key; did you mean 'f_number'"),
        ('base = "box.toml"\n[overrides]\nf_number = -2.0', "derived.toml: overrides: f_number or --f-number: -2.0"),
        ('base = "box.toml"\n[overrides]\nf_number = 2.0\naperture_radius = 1.0', "both given"),
        ('base = "box.toml"\n[overrides]\nexposure = 1e9', "derived.toml: overrides.exposure"),
        ('base = "box.toml"\n[overrides]\naperture_image = "gone.png"', "overrides.aperture_image: .*gone.png"),
        ('base = "box.toml"\n[overrides]\nenvironment = "gone.hdr"', "overrides.environment: .*gone.hdr"),
        ('base = "box.toml"\n[overrides]\ncamera = "a"', "--camera: 'a': selects a camera of a model"),
        ('base = "daylight"\n[overrides]\ncamera = "a"', "--camera: 'a': selects a camera of a model"),
        ('base = "box.toml"\n[overrides]\ncamera_position = [1.0, 2.0]', "--camera-position"),
        ('base = "box.toml"\n[camera]\nfov = 3.0', "camera: has no place beside base"),
        ('base = "box.toml"\n[light]\nradius = 1.0', r"derived.toml: light: .* is not a list of tables; write \[\[light\]\]"),
        ('base = "box.toml"\n[[light]]\nposition = [0.0, 1.0, 0.0]\nradius = -1.0', r"derived.toml: light\[0\].radius: -1.0"),
        ('base = "box.toml"\n[[sun]]\nangle = 1.0', r"derived.toml: sun\[0\].irradiance: missing; give"),
        ('base = "box.toml"\noverrides = 3', "overrides: 3 is not a table"),
    ],
)
def test_mistakes_are_named(text, words, derive):
    with pytest.raises(BokehguideError, match=words) as caught:
        derive(text)
    assert len(str(caught.value).splitlines()) == 1


def test_the_text_of_a_derived_scene_is_read_back(derive, tmp_path):
    values = Overrides(
        width=7, height=5, environment="0.5,0.25,1.5", camera_position=(0.1, 0.2, 5.0), focus_distance=float("inf"), fov=1.0 / 3.0
    )
    (tmp_path / 'a "quoted" \\ name.toml').write_text(BOX_AND_EMITTER)
    scene = derive(derived_text('a "quoted" \\ name.toml', values, -0.3, "two\nlines"))
    assert scene.camera.position == (0.1, 0.2, 5.0) and scene.camera.fov == 1.0 / 3.0 and scene.film.exposure == -0.3
    assert scene.camera.focus_distance == float("inf") and scene.environment.radiance.ravel().tolist() == [0.5, 0.25, 1.5]


def test_the_rotation_of_an_environment_is_an_override():
    assert load_scene("daylight", Overrides(environment_rotation=30.0)).environment.rotation == 30.0
    both = load_scene("daylight", Overrides(environment="1,1,1", environment_rotation=-10.0)).environment
    assert both.rotation == -10.0 and both.radiance.ravel().tolist() == [1.0, 1.0, 1.0]


def test_no_environment_is_an_override(derive, tmp_path):
    """Of a built-in scene, of a scene file, and of a model, which gets no sky then."""
    assert load_scene("daylight").environment is not None
    assert load_scene("daylight", Overrides(environment="none")).environment is None
    assert derive('base = "box.toml"\n[overrides]\nenvironment = "none"\n').environment is None
    trimesh.creation.box().export(tmp_path / "box.ply")
    scene = load_scene(tmp_path / "box.ply", Overrides(environment="none"))
    assert scene.environment is None and scene.film.exposure is None
    assert any("nothing shines" in mistake for mistake in scene.likely_mistakes)
    with pytest.raises(BokehguideError, match=r"--environment-rotation: 10: there is no environment; leave it out$"):
        load_scene("daylight", Overrides(environment="none", environment_rotation=10.0))


def test_a_hidden_environment_is_an_override(derive, tmp_path):
    """The light stays. False is the same as no override."""
    trimesh.creation.box().export(tmp_path / "box.ply")
    shown, hidden = (load_scene(tmp_path / "box.ply", Overrides(hide_environment=hide)) for hide in (False, True))
    assert shown.environment.visible and not hidden.environment.visible
    np.testing.assert_array_equal(hidden.environment.radiance, shown.environment.radiance)
    assert hidden.film.exposure == shown.film.exposure
    text = derived_text("box.toml", Overrides(hide_environment=True), None, "")
    assert not derive(text).environment.visible and not derive(text, Overrides(environment="1,1,1")).environment.visible
    assert derive(BOX_AND_EMITTER.replace("[environment]\ncolor = [0.02, 0.03, 0.05]\n", ""), Overrides(hide_environment=True))
    with pytest.raises(BokehguideError, match="hide_environment or --hide-environment: 1 is neither true nor false"):
        Overrides(hide_environment=1)


def test_suns_without_an_environment_are_hidden(derive):
    sun = "[[sun]]\ndirection = [0.0, 1.0, 0.0]\nirradiance = [1.0, 1.0, 1.0]\n"
    text = BOX_AND_EMITTER.replace("[environment]\ncolor = [0.02, 0.03, 0.05]\n", sun)
    assert derive(text).environment is None
    scene = derive(text, Overrides(hide_environment=True))
    assert not scene.environment.visible and not scene.environment.radiance.any() and len(scene.suns) == 1


def test_the_length_of_paths_is_an_override(derive):
    assert load_scene("daylight", Overrides(max_depth=12)).film.max_depth == 12
    assert derive(derived_text("daylight", Overrides(max_depth=3, width=20), None, "")).film.max_depth == 3
    with pytest.raises(BokehguideError, match="--max-depth: 0"):
        Overrides(max_depth=0)


def test_a_rotation_needs_an_environment(derive):
    text = BOX_AND_EMITTER.replace("[environment]\ncolor = [0.02, 0.03, 0.05]\n", "")
    with pytest.raises(BokehguideError, match="--environment-rotation: 10: there is no environment; give environment or --env"):
        derive(text, Overrides(environment_rotation=10.0))
