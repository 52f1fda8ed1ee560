"""Bad input: one clear line that names the file, the field, the value and the remedy."""

import numpy as np
import OpenEXR
import pytest

from bokehguide.errors import BokehguideError
from bokehguide.scene import Camera, Material, Mesh, Overrides, Scene, load_scene
from bokehguide.scene.shapes import unit_rectangle

BIG = "9" * 400
GOOD = """
[camera]
position = [0.0, 1.0, 6.0]
target = [0.0, 1.0, 0.0]
fov = 40.0
aperture_radius = 0.1
focus_distance = 5.0
[film]
width = 64
[environment]
color = [0.1, 0.1, 0.1]
[materials.gold]
roughness = 0.2
[[object]]
shape = "sphere"
material = "gold"
scale = 1.0
"""


def message(spec, overrides: Overrides | None = None) -> str:
    with pytest.raises(BokehguideError) as caught:
        load_scene(str(spec), overrides or Overrides())
    text = str(caught.value)
    assert len(text.splitlines()) <= 2, text
    return text


def test_the_scene_that_is_broken_below_is_good(tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD)
    assert len(load_scene(str(tmp_path / "scene.toml")).meshes) == 1


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("fov = 40.0", "fov = 190", ["camera.fov", "190", "between 0 and 180"]),
        ("fov = 40.0", "fov = 0.0", ["camera.fov", "0.0"]),
        ("fov = 40.0", "fov = nan", ["camera.fov", "nan"]),
        ("fov = 40.0", "fov = true", ["camera.fov", "True", "not a number"]),
        ("fov = 40.0", 'fov = "wide"', ["camera.fov", "'wide'", "not a number"]),
        ("fov = 40.0", "fov = 40.0\nfocal_length = 50.0", ["camera.fov", "focal_length", "keep one"]),
        ("fov = 40.0", "sensor_width = 0.0", ["camera.sensor_width", "0.0", "above 0"]),
        ("fov = 40.0", "focal_length = -50", ["camera.focal_length", "-50", "above 0"]),
        ("fov = 40.0", "fow = 40.0", ["camera.fow", "unknown key", "did you mean 'fov'?"]),
        ("aperture_radius = 0.1", "aperture_radius = -0.1", ["camera.aperture_radius", "-0.1"]),
        ("aperture_radius = 0.1", "f_number = 0.0", ["camera.f_number", "0.0", "above 0"]),
        (
            "aperture_radius = 0.1",
            "aperture_radius = 0.1\nf_number = 2.0",
            ["camera.aperture_radius", "f_number", "keep one"],
        ),
        ("focus_distance = 5.0", "focus_distance = -5.0", ["camera.focus_distance", "-5.0", "behind"]),
        ("focus_distance = 5.0", "focus_distance = nan", ["camera.focus_distance", "nan", "or inf"]),
        ("focus_distance = 5.0", "focus_point = [0, 1, 9]", ["camera.focus_point", "behind the lens"]),
        (
            "focus_distance = 5.0",
            "focus_distance = 5.0\nfocus_point = [0, 1, 0]",
            ["camera.focus_distance", "focus_point", "keep one"],
        ),
        ("target = [0.0, 1.0, 0.0]", "target = [0.0, 1.0, 6.0]", ["camera.target", "equals position"]),
        ("target = [0.0, 1.0, 0.0]", "target = [0.0, 9.0, 6.0]", ["camera.target", "along up"]),
        ("target = [0.0, 1.0, 0.0]", "up = [0.0, 1.0, 0.0]", ["camera.target", "missing"]),
        ("fov = 40.0", "up = [0, 0, 0]", ["camera.up", "no direction"]),
        ("fov = 40.0", "up = [0, 0, 2]", ["camera.up", "[0, 0, 2]", "another up"]),
        ("position = [0.0, 1.0, 6.0]", "position = [0.0, 1.0]", ["camera.position", "[0.0, 1.0]", "three"]),
        ("position = [0.0, 1.0, 6.0]", "position = [0, nan, 6]", ["camera.position", "nan"]),
        ("[camera]", "[kamera]", ["kamera", "unknown key", "camera"]),
        ("width = 64", "width = 0", ["film.width", "0", "1 or more"]),
        ("width = 64", "width = 64.5", ["film.width", "64.5", "whole number"]),
        ("width = 64", "max_depth = -1", ["film.max_depth", "-1"]),
        ("width = 64", "widht = 64", ["film.widht", "did you mean 'width'?"]),
        ("color = [0.1, 0.1, 0.1]", "color = [0.1, -0.1, 0.1]", ["environment.color", "-0.1"]),
        ("color = [0.1, 0.1, 0.1]", "", ["environment", "give color or map"]),
        ("color = [0.1, 0.1, 0.1]", 'map = "sky.hdr"', ["sky.hdr", "no such file"]),
        ("color = [0.1, 0.1, 0.1]", 'map = "."', ["not an environment map", ".hdr or .exr"]),
        ("color = [0.1, 0.1, 0.1]", 'map = "sky.png"', ["sky.png", ".hdr or .exr"]),
        (
            "color = [0.1, 0.1, 0.1]",
            'color = [1, 1, 1]\nmap = "sky.hdr"',
            ["environment.color", "map", "keep one"],
        ),
        ("color = [0.1, 0.1, 0.1]", "color = [1, 1, 1]\nintensity = -1", ["environment.intensity", "-1"]),
        ("roughness = 0.2", "roughness = 1.2", ["materials.gold.roughness", "1.2", "between 0 and 1"]),
        ("roughness = 0.2", "metallic = -1", ["materials.gold.metallic", "-1"]),
        ("roughness = 0.2", "transmission = 2", ["materials.gold.transmission", "2"]),
        ("roughness = 0.2", "specular = 2", ["materials.gold.specular", "2"]),
        ("roughness = 0.2", "ior = 0.9", ["materials.gold.ior", "0.9", "1 or more"]),
        ("roughness = 0.2", "base_color = [2, 0, 0]", ["materials.gold.base_color", "[2, 0, 0]"]),
        ("roughness = 0.2", "emission = [-1, 0, 0]", ["materials.gold.emission", "[-1, 0, 0]"]),
        ("roughness = 0.2", "emission = [inf, 0, 0]", ["materials.gold.emission", "inf"]),
        ("roughness = 0.2", "thin = 1", ["materials.gold.thin", "1", "true nor false"]),
        ("roughness = 0.2", "rougness = 0.2", ["materials.gold.rougness", "did you mean 'roughness'?"]),
        ("roughness = 0.2", 'base_color_texture = "no.png"', ["no.png", "no such file"]),
        (
            "roughness = 0.2",
            'base_color_texture = "scene.toml"',
            ["gold.base_color_texture: ", "unreadable texture"],
        ),
        (
            "roughness = 0.2",
            'emission_texture = "no.png"\nemission = [1, 1, 1]',
            ["no.png", "no such file"],
        ),
        ("roughness = 0.2", 'alpha_mode = "blond"', ["materials.gold.alpha_mode", "'blond'", "did you mean 'blend'?"]),
        ("roughness = 0.2", "alpha_cutoff = 0.5", ["materials.gold.alpha_cutoff", "without alpha_mode"]),
        ("roughness = 0.2", "opacity = 0.5", ["materials.gold.opacity", "without alpha_mode"]),
        ("roughness = 0.2", "specular_color = [1, -1, 1]", ["materials.gold.specular_color", "-1"]),
        ("roughness = 0.2", "normal_scale = 0.5", ["materials.gold.normal_scale", "without normal_texture"]),
        ("roughness = 0.2", 'emission_texture = "a.png"', ["gold.emission_texture", "without emission"]),
        ("roughness = 0.2", "clearcoat = 1.5", ["materials.gold.clearcoat", "1.5", "between 0 and 1"]),
        ("roughness = 0.2", "clearcoat_roughness = 0.5", ["gold.clearcoat_roughness", "without clearcoat"]),
        ("roughness = 0.2", 'clearcoat_normal_texture = "a.png"', ["gold.clearcoat_normal_texture", "without clearcoat"]),
        ("roughness = 0.2", "clearcoat_normal_scale = 2", ["clearcoat_normal_scale", "without clearcoat_normal_texture"]),
        ("roughness = 0.2", "attenuation_color = [1, 1, 1]", ["gold.attenuation_color", "without attenuation_distance"]),
        (
            "roughness = 0.2",
            "attenuation_color = [1, 1, 1]\nattenuation_distance = 0",
            ["gold.attenuation_distance", "0", "above 0"],
        ),
        (
            "roughness = 0.2",
            "emission = [1, 1, 1]\nemission_cone = { axis = [0, 0, 0] }",
            ["gold.emission_cone.axis", "[0, 0, 0]", "no direction"],
        ),
        (
            "roughness = 0.2",
            "emission = [1, 1, 1]\nemission_cone = { axis = [0, 1, 0], inner = 50 }",
            ["gold.emission_cone.outer", "45", "not above inner, 50"],
        ),
        (
            "roughness = 0.2",
            "emission = [1, 1, 1]\nemission_cone = { inner = 50 }",
            ["gold.emission_cone.axis", "missing", "[x, y, z]"],
        ),
        ("roughness = 0.2", "emission_cone = { axis = [0, 1, 0] }", ["gold.emission_cone", "without emission"]),
        ("[camera]", "[[sun]]\nirradiance = [1, 1, 1]\n[camera]", ["sun[0].direction", "missing"]),
        ("[camera]", "[[sun]]\ndirection = [0, 1, 0]\n[camera]", ["sun[0].irradiance", "missing", "[r, g, b]"]),
        ("[camera]", "[sun]\ndirection = [0, 1, 0]\n[camera]", ["sun", "[[sun]]"]),
        (
            "[camera]",
            "[[sun]]\ndirection = [0, 1, 0]\nirradiance = [1, 1, 1]\nangle = 0\n[camera]",
            ["sun[0].angle", "0", "0.01"],
        ),
        ("color = [0.1, 0.1, 0.1]", "color = [1, 1, 1]\nvisible = 0", ["environment.visible", "0", "true nor false"]),
        ('material = "gold"', 'material = "gild"', ["object[0].material", "'gild'", "did you mean 'gold'?"]),
        ('material = "gold"', "", ["object[0].material", "missing"]),
        ('shape = "sphere"', 'shape = "cone"', ["object[0].shape", "'cone'", "sphere"]),
        ('shape = "sphere"', "", ["object[0].shape", "missing", "file"]),
        ('shape = "sphere"', 'shape = "box"\nfile = "a.obj"', ["object[0].shape", "file", "keep one"]),
        ('shape = "sphere"', 'file = "a.obj"', ["a.obj", "no such file"]),
        ("scale = 1.0", "scale = 0", ["object[0].scale", "0", "flattens"]),
        ("scale = 1.0", "scale = [1, 0, 1]", ["object[0].scale", "[1, 0, 1]", "flattens"]),
        ("scale = 1.0", 'scale = "big"', ["object[0].scale", "'big'"]),
        ("scale = 1.0", "rotate = 90", ["object[0].rotate", "90", "three"]),
        ("scale = 1.0", "sclae = 1.0", ["object[0].sclae", "did you mean 'scale'?"]),
        ("[[object]]", "[object]", ["object", "[[object]]"]),
        ("[materials.gold]", "[material.gold]", ["material", "unknown key", "did you mean 'materials'?"]),
        ("fov = 40.0", "fov = ", ["not valid TOML", "line 5"]),
        ("focus_distance = 5.0", "focus_distance = 1e39", ["camera.focus_distance", "out of range", "1e+18"]),
        ("focus_distance = 5.0", "focus_distance = 1e-320", ["camera.focus_distance", "out of range", "above 0"]),
        ("focus_distance = 5.0", f"focus_distance = {BIG}", ["camera.focus_distance", "1329 bits", "out of range"]),
        ("focus_distance = 5.0", f"focus_distance = {BIG * 20}", ["not valid TOML", "digits"]),
        ("position = [0.0, 1.0, 6.0]", "position = [1e39, 1, 6]", ["camera.position", "1e+39", "out of range"]),
        ("position = [0.0, 1.0, 6.0]", f"position = [{BIG}, 1, 6]", ["camera.position", "1329 bits", "out of range"]),
        ("fov = 40.0", "fov = 1e-30", ["camera.fov", "1e-30", "0.001"]),
        ("fov = 40.0", "focal_length = 1e12", ["camera.focal_length", "degrees", "0.001"]),
        ("aperture_radius = 0.1", "aperture_radius = 1e30", ["camera.aperture_radius", "1e+30", "out of range"]),
        ("color = [0.1, 0.1, 0.1]", "color = [1e39, 1, 1]", ["environment.color", "1e+39", "out of range"]),
        (
            "color = [0.1, 0.1, 0.1]",
            "color = [1e10, 1, 1]\nintensity = 1e10",
            ["environment.intensity", "1e+20", "give less"],
        ),
        ("roughness = 0.2", "emission = [1e39, 1, 1]", ["materials.gold.emission", "1e+39", "out of range"]),
        ("scale = 1.0", "scale = 1e39", ["object[0].scale", "1e+39", "out of range"]),
        ("scale = 1.0", "scale = 9e17\ntranslate = [9e17, 0, 0]", ["object[0]", "vertices[", "beyond 1e+18"]),
        ("scale = 1.0", "scale = 1e17", ["object[0]", "2e+17 m", "1e+09 m or less"]),
        ("width = 64", "width = 1000000000", ["film.width", "1000000000", "up to 65536"]),
        ("width = 64", "width = 65536\nheight = 65536", ["FilmSettings: 65536x65536", "at most 268435456"]),
        ("width = 64", f"max_depth = {BIG}", ["film.max_depth", "1329 bits"]),
        ("fov = 40.0", "fov = 40.0\nfov = 41.0", ["not valid TOML", "line 6"]),
        ("[[object]]", "[[lights]]\nradius = 0.1\n[[object]]", ["lights", "write [lights]", "or [[light]]"]),
        ('shape = "sphere"', r'file = "models\table.obj"', ["object[0].file", "control characters", "write / between folders"]),
        ('shape = "sphere"', r'file = "C:\models\a.obj"', ["not valid TOML", "line 15", "write / between the folders of a path"]),
        ('shape = "sphere"', r'file = "models\use.obj"', ["not valid TOML", "line 15", "write / between the folders of a path"]),
    ],
)
def test_a_wrong_value_in_a_scene_file(tmp_path, old, new, named):
    assert old in GOOD
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace(old, new, 1))
    text = message(path)
    assert str(tmp_path) in text, "the message names the file"
    for part in named:
        assert part in text, f"{part!r} is not in {text!r}"


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("missing.toml", None, ["no such file"]),
        ("latin.toml", b"name = '\xe9'", ["UTF-8"]),
        ("empty.toml", b"", ["camera", "missing"]),
        ("missing.glb", None, ["no such file"]),
        ("junk.glb", b"junk", ["not a readable .glb model (neither a GLB nor JSON); export it or fetch it again"]),
        ("void.glb", b"", ["not a readable .glb model (empty); export it or fetch it again"]),
        ("junk.gltf", b"{", ["not a readable .gltf model (damaged JSON: Expecting", "); export it or fetch it again"]),
        ("empty.gltf", b"{}", ["no triangles"]),
        ("list.gltf", b"[]", ["list.gltf: [] is not a JSON object"]),
        ("junk.ply", b"junk", ["not a readable .ply model (Not a ply file!); export it or fetch it again"]),
        ("cut.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n", ["model (damaged); export it or fetch it"]),
        ("junk.stl", b"junk", ["no triangles"]),
        ("empty.obj", b"", ["no triangles"]),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ["vertices[0]", "nan", "not finite"]),
        ("huge.obj", b"v 0 0 1e300\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ["vertices[0]", "1e+300"]),
        ("out.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", ["out.obj:4: the face has the vertex 9"]),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", ["no triangle with an area"]),
        ("far.obj", b"v 0 0 1e19\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ["vertices[0]", "beyond 1e+18"]),
        ("point.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", ["one point"]),
    ],
)
def test_a_file_that_is_no_scene(tmp_path, name, content, named):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    text = message(path)
    assert text.startswith(str(path))
    assert f"{name}: {name}" not in text, "the file is named once"
    for part in named:
        assert part in text, f"{part!r} is not in {text!r}"


@pytest.mark.parametrize("suffix", ["toml", "glb", "obj"])
def test_a_folder_is_no_scene(tmp_path, suffix):
    (tmp_path / f"folder.{suffix}").mkdir()
    assert "is a folder" in message(tmp_path / f"folder.{suffix}")


def test_an_unknown_name_lists_the_built_in_scenes():
    text = message("fairylights")
    assert "did you mean 'fairy-lights'?" in text and "daylight" in text and ".glb" in text


def test_an_empty_scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(GOOD[: GOOD.index("[[object]]")])
    assert message(path).startswith(f"{path}: holds no triangle")


@pytest.mark.parametrize("name", ["sky.hdr", "sky.exr"])
@pytest.mark.parametrize("content", [b"", b"junk", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n12"])
def test_an_unreadable_environment_map(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert f"{name}: is " in message("daylight", Overrides(environment=str(tmp_path / name)))


def test_the_error_of_a_truncated_environment_map_takes_one_line(tmp_path, capfd):
    OpenEXR.File({}, {"RGB": np.random.default_rng(1).random((64, 128, 3), np.float32)}).write(str(tmp_path / "sky.exr"))
    whole = (tmp_path / "sky.exr").read_bytes()
    for share in (0.002, 0.01, 0.5, 0.99):
        (tmp_path / "sky.exr").write_bytes(whole[: int(share * len(whole))])
        text = message("daylight", Overrides(environment=str(tmp_path / "sky.exr")))
        assert "sky.exr: is damaged" in text and "\n" not in text
    assert capfd.readouterr() == ("", "")


def test_names_in_an_environment_map_that_are_no_text(tmp_path):
    """The messages of OpenImageIO contain control characters as well."""
    OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(tmp_path / "sky.exr"))
    whole = (tmp_path / "sky.exr").read_bytes()
    for old, new in ((b"\0B\0", b"\0\xb6\0"), (b"chlist", b"chl\xb6st"), (b"chlist", b"chl\x1bst"), (b"B\0", b"\x1b\0")):
        assert old in whole
        (tmp_path / "sky.exr").write_bytes(whole.replace(old, new))
        text = message("daylight", Overrides(environment=str(tmp_path / "sky.exr")))
        assert "sky.exr: " in text and text.isprintable()


@pytest.mark.parametrize("name", ['"a\\nb\\u001b[2J"', "9" * 5000])
@pytest.mark.parametrize(
    "line", ["[camera]\n{} = 1", "[{}]\n[camera]", "[materials.{}]\nb = 1\n[camera]", "[camera.{}]\n[camera]"]
)
def test_names_in_a_scene_file_do_nothing_to_the_terminal(tmp_path, name, line):
    (tmp_path / "scene.toml").write_text(GOOD.replace("[camera]", line.format(name), 1))
    text = message(tmp_path / "scene.toml")
    assert text.isprintable() and len(text) < 1000, text


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_environment_map_that_is_not_finite(tmp_path, bad):
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[2, 3, 1] = radiance[3, 0, 0] = radiance[3, 0, 2] = bad
    OpenEXR.File({}, {"RGB": radiance}).write(str(tmp_path / "sky.exr"))
    text = message("daylight", Overrides(environment=str(tmp_path / "sky.exr")))
    assert "sky.exr: texels that are NaN, infinite or beyond 1e+18: 2, the first in column 3 and row 2, counted from 0; " in text


def test_an_exr_without_colours(tmp_path):
    OpenEXR.File({}, {"depth.Z": np.ones((4, 8), np.float32)}).write(str(tmp_path / "sky.exr"))
    text = message("daylight", Overrides(environment=str(tmp_path / "sky.exr")))
    assert "depth.Z" in text and "R, G, B" in text


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"width": 0}, ["--size (width)", "0"]),
        ({"height": -3}, ["--size (height)", "-3"]),
        ({"f_number": 0.0}, ["--f-number", "0.0", "above 0"]),
        ({"f_number": 2.0, "aperture_radius": 0.1}, ["--f-number", "aperture", "keep one"]),
        ({"aperture_radius": -1.0}, ["--aperture-radius", "-1.0"]),
        ({"focus_distance": -2.0}, ["--focus-distance", "-2.0", "behind the lens"]),
        ({"fov": 180.0}, ["--fov", "180.0", "between 0 and 180"]),
        ({"fov": 1e-30}, ["--fov", "1e-30", "out of range"]),
        ({"f_number": 1e-320}, ["--f-number", "1e-320", "out of range"]),
        ({"aperture_radius": 1e30}, ["--aperture-radius", "1e+30", "out of range"]),
        ({"focus_distance": 1e39}, ["--focus-distance", "1e+39", "out of range"]),
        ({"camera_target": (1e39, 0.0, 0.0)}, ["--camera-target", "1e+39", "out of range"]),
        ({"width": 65537}, ["--size (width)", "65537", "65536"]),
        ({"camera_position": (0.0, float("nan"), 0.0)}, ["--camera-position", "nan"]),
        ({"camera_target": (0.0, 1.0)}, ["--camera-target", "three"]),
        ({"camera_target": np.zeros((3, 1))}, ["--camera-target: array([[0.], [0.], [0.]]) is not three numbers; give"]),
        ({"width": np.zeros((300, 3))}, ["--size (width)", "..."]),
    ],
)
def test_an_override_out_of_range(values, named):
    with pytest.raises(BokehguideError) as caught:
        Overrides(**values)
    for part in named:
        assert part in str(caught.value), str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("environment", "part"),
    [
        ("1,2", "R,G,B"),
        ("1,-2,3", "'1,-2,3'"),
        ("1e39,1,1", "up to 1e+18"),
        ("a,b,c", "three numbers"),
        ("no.hdr", "no such file"),
    ],
)
def test_an_environment_override_that_is_neither_map_nor_colour(environment, part):
    assert part in message("daylight", Overrides(environment=environment))


def test_overrides_that_leave_no_direction_to_look():
    overrides = Overrides(camera_position=(1.0, 2.0, 3.0), camera_target=(1.0, 2.0, 3.0))
    assert "camera.target" in message("daylight", overrides)
    overrides = Overrides(camera_position=(0.0, 5.0, 0.0), camera_target=(0.0, 0.0, 0.0))
    assert "along up" in message("daylight", overrides)


def scene_of(**changes) -> Scene:
    square = unit_rectangle()
    arrays = {"vertices": square.vertices.copy(), "triangles": square.triangles.copy(), "material": 0}
    camera = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0))
    return Scene("test", camera, (Mesh(**(arrays | changes)),), (Material("grey"),))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"triangles": np.array([[0, 1, 4]], np.int32)}, ["Mesh.triangles[0]", "[0, 1, 4]", "4 vertices"]),
        ({"triangles": np.array([[0, 1, -1]], np.int32)}, ["Mesh.triangles[0]", "[0, 1, -1]"]),
        ({"vertices": np.full((4, 3), np.nan, np.float32)}, ["Mesh.vertices[0]", "not finite", "4 such"]),
        ({"normals": np.ones((3, 3), np.float32)}, ["Mesh.normals", "(3, 3)", "(4, 3)"]),
        ({"uvs": np.full((4, 1, 2), np.inf, np.float32)}, ["Mesh.uvs[0]", "not finite"]),
        ({"material": 1}, ["Scene.meshes[0].material", "1 is out of range", "there is one material"]),
    ],
)
def test_invalid_meshes_are_rejected(changes, named):
    scene_of()
    with pytest.raises(BokehguideError) as caught:
        scene_of(**changes)
    for part in named:
        assert part in str(caught.value), str(caught.value)
