"""pbrt-v4 files as scenes: tokens, transforms, the camera, shapes and lights against closed forms."""

import gzip
import math

import numpy as np
import pytest

from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.pbrt.transforms import look_at, rotation
from tests.support.pbrt_text import HEAD, SQUARE, message, read

LOOKS = {
    "identity": ("", np.eye(4)),
    "look": ("LookAt 1 2 -3  0.5 0.25 4  0.1 1 0.2\n", None),
    "mirrored": ("Scale -1 1 1\nLookAt 1 2 -3  0.5 0.25 4  0.1 1 0.2\n", np.diag((-1.0, 1.0, 1.0, 1.0))),
    "turned": ("Rotate 30 0 1 0 Translate 0.5 0 2\nConcatTransform [-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1]\n", None),
    "large": ("Scale 2 2 2\nTranslate 0 0 1\n", None),
}


def camera_from_world(kind: str) -> np.ndarray:
    """The matrices of LOOKS, by the definitions of pbrt's directives."""
    eye, target, up = np.array((1.0, 2.0, -3.0)), np.array((0.5, 0.25, 4.0)), np.array((0.1, 1.0, 0.2))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(up, forward) / np.linalg.norm(np.cross(up, forward))
    world = np.eye(4)
    world[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    look = np.linalg.inv(world)
    cosine, sine = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    turn, move = np.eye(4), np.eye(4)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = cosine, sine, -sine, cosine
    move[:3, 3] = 0.5, 0.0, 2.0
    near = np.eye(4)
    near[2, 3] = 1.0
    mirror = np.diag((-1.0, 1.0, 1.0, 1.0))
    return {
        "identity": np.eye(4),
        "look": look,
        "mirrored": mirror @ look,
        "turned": turn @ move @ mirror,
        "large": np.diag((2.0, 2.0, 2.0, 1.0)) @ near,
    }[kind]


@pytest.mark.parametrize("kind", LOOKS)
@pytest.mark.parametrize("size", [(32, 16), (16, 32)])
def test_points_are_where_pbrt_draws_them(tmp_path, kind, size):
    """The projection of pbrt: x to the right and y up in camera space, `fov` along the shorter side."""
    width, height = size
    head = LOOKS[kind][0] + (
        f'Camera "perspective" "float fov" 50\nFilm "rgb" "integer xresolution" {width} "integer yresolution" {height}\n'
        "WorldBegin\n"
    )
    scene = read(tmp_path, SQUARE, head)
    matrix = camera_from_world(kind)
    corners = np.array([(-1, -1, 4, 1), (1, -1, 4, 1), (1, 1, 4, 1), (-1, 1, 4, 1)]) @ matrix.T
    half = math.tan(math.radians(25.0))
    scale = 0.5 * min(width, height) / half
    wanted = np.stack([width / 2 + corners[:, 0] / corners[:, 2] * scale, height / 2 - corners[:, 1] / corners[:, 2] * scale])
    camera = ThinLensCamera(scene.camera, width, height)
    import torch

    world = torch.from_numpy(scene.meshes[0].vertices.T.copy())
    found = camera.raster(camera.axes.T @ (world - camera.position)).numpy()
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-3)


def test_lens_film_and_integrator(tmp_path):
    head = (
        'Scale 0.5 0.5 0.5\nCamera "perspective" "float lensradius" 0.1 "float focaldistance" [3] "float fov" 40\n'
        'Film "rgb" "integer xresolution" [40] "integer yresolution" [30] "float iso" 200 "string filename" "a.exr"\n'
        'Integrator "path" "integer maxdepth" 7\nSampler "halton" PixelFilter "box" "float xradius" 1 Option "seed" 3\n'
        "WorldBegin\n"
    )
    scene = read(tmp_path, SQUARE, head)
    assert (scene.camera.aperture_radius, scene.camera.focus_distance) == pytest.approx((0.2, 6.0))
    assert scene.camera.fov == pytest.approx(2.0 * math.degrees(math.atan(math.tan(math.radians(20.0)) * 40 / 30)))
    assert (scene.film.width, scene.film.height, scene.film.max_depth, scene.film.exposure) == (40, 30, 8, 1.0)
    window = head.replace('"float fov"', '"float screenwindow" [-0.5 0.5 -0.375 0.375] "float fov"')
    narrow = read(tmp_path, SQUARE, window)
    assert narrow.camera.fov == pytest.approx(2.0 * math.degrees(math.atan(0.5 * math.tan(math.radians(20.0)))))
    assert read(tmp_path, SQUARE).film.exposure is None and read(tmp_path, SQUARE).film.max_depth == 6


@pytest.mark.parametrize("kind", ["whitted", "directlighting"])
def test_integrators_without_interreflection_are_told(tmp_path, kind):
    head = f'Camera "perspective"\nFilm "image"\nIntegrator "{kind}"\nWorldBegin\n'
    told = f"scene.pbrt: integrator {kind}: interreflection is added; --max-depth 2 leaves direct light (scene.pbrt:3)"
    assert told in read(tmp_path, SQUARE, head).warnings


def test_realistic_cameras_become_thin_lenses(tmp_path):
    """A biconvex lens of index 1.5 and radii of 50 mm has f = 50 mm (lensmaker's equation); then a telephoto pair."""
    head = (
        'Camera "realistic" "string lensfile" "lens.dat" "float aperturediameter" 20 "float focusdistance" 5\n'
        'Film "rgb" "integer xresolution" 30 "integer yresolution" 20 "float diagonal" 43.2666\nWorldBegin\n'
    )
    (tmp_path / "lens.dat").write_text("# radius thickness eta diameter\n50 0.001 1.5 30\n-50 0.001 1 30\n0 50 0 30\n")
    scene = read(tmp_path, SQUARE, head)
    front = (5.0 + math.sqrt(25.0 - 20.0 * 0.05)) / 2.0
    assert 1.0 / front + 1.0 / (5.0 - front) == pytest.approx(20.0)
    assert scene.camera.focus_distance == pytest.approx(front, rel=1e-4)
    assert scene.camera.aperture_radius == pytest.approx(0.01, rel=1e-3)
    assert scene.camera.fov == pytest.approx(2.0 * math.degrees(math.atan(0.018 / (5.0 - front))), rel=1e-4)
    assert scene.warnings == ("scene.pbrt: realistic cameras: a thin lens of the same focal length (lens.dat)",)
    # A lens of 100 mm and 50 mm behind it the stop, where the cone of light has half of its width, and a lens of -100 mm.
    (tmp_path / "lens.dat").write_text("100 0 1.5 60\n-100 50 1 60\n0 0 0 60\n-100 0 1.5 60\n100 90 1 60\n")
    pair = read(tmp_path, SQUARE, head.replace('distance" 5', 'distance" 5000')).camera
    assert pair.aperture_radius == pytest.approx(0.02, rel=1e-3)
    assert pair.fov == pytest.approx(2.0 * math.degrees(math.atan(18.0 / 200.0)), rel=1e-3)  # 1/100 - 1/100 + 50/100² = 1/200
    (tmp_path / "lens.dat").write_text("50 1 1.5")
    assert "four numbers" in message(tmp_path, SQUARE, head)


def test_tokens_and_parameters(tmp_path):
    body = (
        '# a comment with "quotes" [and brackets]\n'
        'AttributeBegin # another\nMaterial "diffuse" "rgb reflectance"[0.1 .2 3e-1]# no blank before\n'
        'Shape "trianglemesh""integer indices"[0 1 2]"point3 P" [\n-1 -1 4 # left\n 1 -1 4 1 1 4]AttributeEnd\n'
        'Attribute "shape" "float radius" 0.5\nShape "sphere"\nShape "sphere" "float radius" [2]\n'
        'TransformBegin Translate 1 2 3 CoordinateSystem "here" TransformEnd\n'
        'AttributeBegin CoordSysTransform "here" Shape "disk" AttributeEnd\n'
    )
    scene = read(tmp_path, body)
    assert scene.materials[scene.meshes[0].material].base_color == pytest.approx((0.1, 0.2, 0.3))
    assert len(scene.meshes[0].triangles) == 1
    radii = [np.linalg.norm(mesh.vertices, axis=1).mean() for mesh in scene.meshes[1:3]]
    assert radii == pytest.approx([0.5, 2.0], rel=3e-3)
    np.testing.assert_allclose(scene.meshes[3].vertices.mean(axis=0) * (-1, 1, 1), (1, 2, 3), atol=0.05)


def test_long_lists_of_numbers(tmp_path):
    """Lists above and below the length from which they are read at once."""
    points = np.random.default_rng(3).random((300, 3)).round(6)
    text = "\n".join(" ".join(f"{value:g}" for value in row) for row in points)
    shape = 'Shape "trianglemesh" "point3 P" [{}] "integer indices" [' + " ".join(map(str, range(300))) + "]"
    mesh = read(tmp_path, shape.format(text), "Scale -1 1 1\n" + HEAD).meshes[0]
    np.testing.assert_array_equal(mesh.vertices, points.astype(np.float32))
    for wrong, problem in (("x", "'x'"), ("nan", "not finite"), ("1e30", "beyond"), ("1e400", "not finite")):
        assert problem in message(tmp_path, shape.format(f"{text} 1 2 {wrong}"))


def test_includes_and_compressed_files(tmp_path):
    (tmp_path / "part.pbrt").write_text("Translate 0 0 2\n" + SQUARE)
    (tmp_path / "packed.pbrt.gz").write_bytes(gzip.compress(b'AttributeBegin Include "part.pbrt" AttributeEnd\n'))
    scene = read(tmp_path, 'Import "part.pbrt"\nInclude "packed.pbrt.gz"\n' + SQUARE, name="scene.pbrt.gz")
    assert [float(mesh.vertices[0, 2]) for mesh in scene.meshes] == [6.0, 6.0, 4.0]
    assert scene.name == "scene"


def test_transforms_are_those_of_pbrt(tmp_path):
    generator = np.random.default_rng(0)
    axis = generator.normal(size=3)
    turn = rotation(70.0, *axis)[:3, :3]
    np.testing.assert_allclose(turn @ axis, axis)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.trace(turn) == pytest.approx(1.0 + 2.0 * math.cos(math.radians(70.0)))
    np.testing.assert_allclose(rotation(90.0, 0.0, 0.0, 2.0)[:3, :3] @ (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), atol=1e-12)
    matrix = look_at([1.0, 2.0, -3.0, 0.5, 0.25, 4.0, 0.1, 1.0, 0.2], None)  # type: ignore[arg-type]
    np.testing.assert_allclose(matrix, camera_from_world("look"), atol=1e-12)
    body = "Translate 1 0 0 Scale 2 2 2 Rotate 90 0 0 1\n"
    moved = read(tmp_path, body + 'Shape "trianglemesh" "point3 P" [1 0 0 0 1 0 0 0 1]\n', "Scale -1 1 1\n" + HEAD).meshes[0]
    np.testing.assert_allclose(moved.vertices, [(1, 2, 0), (-1, 0, 0), (1, 0, 2)], atol=1e-6)
    columns = "Transform [0 1 0 0 -1 0 0 0 0 0 1 0 5 6 7 1] ConcatTransform [1 0 0 0 0 1 0 0 0 0 1 0 1 0 0 1]\n"
    moved = read(tmp_path, columns + 'Shape "trianglemesh" "point3 P" [1 0 0 0 1 0 0 0 1]\n', "Scale -1 1 1\n" + HEAD).meshes[0]
    np.testing.assert_allclose(moved.vertices, [(5, 8, 7), (4, 7, 7), (5, 7, 8)], atol=1e-6)


ERRORS = [
    ('Shape "sphere', ["scene.pbrt:4", "closing quote"]),
    ("\n\nShap\n", ["scene.pbrt:6", "'Shap'", "did you mean 'Shape'?"]),
    ("WorldEnds", ["'WorldEnds'", "did you mean 'WorldEnd'?"]),
    ("Translate 1 2", ["scene.pbrt", "the file ends", "Translate"]),
    ("Translate 1 2 x", ["scene.pbrt:4", "'x'", "Translate"]),
    ("Translate 1 2 1e30", ["1e30", "out of range"]),
    ("Translate nan 0 0", ["nan", "out of range"]),
    ('Shape "sphere" "float radius" "wide"', ["scene.pbrt:4", "radius", "another type"]),
    ('Shape "sphere" "float radius" [1 2]', ["radius", "1.0 2.0", "one number"]),
    ('Shape "sphere" "float radius" -1', ["radius", "-1.0", "above 0"]),
    ('Shape "sphere" "flot radius" 1', ["'flot'", "float"]),
    ('Shape "sphere" "radius" 1', ["'radius'", "a type and a name"]),
    ('Shape "sphere" "float radius" [1', ["the file ends", "]"]),
    ('Shape "trianglemesh" "point3 P" [0 0 0 1 0 0 0 1 0] "integer indices" [0 1 3]', ["beyond its 3 vertices"]),
    ('Shape "trianglemesh" "point3 P" [0 0 0 1]', ["P", "multiple of 3"]),
    ('Shape "trianglemesh" "integer indices" [0 1 2]', ["trianglemesh", "point3 P"]),
    ('Shape "plymesh" "string filename" "../x.ply"', ["../x.ply", "outside", "--allow-outside"]),
    ('Shape "plymesh" "string filename" "x.ply"', ["x.ply", "no such file"]),
    ('Include "/etc/passwd"', ["scene.pbrt:4", "outside"]),
    ('ObjectInstance "x"', ["'x'", "no such object"]),
    ('ObjectBegin "x"', ["scene.pbrt:4", "without ObjectEnd"]),
    ("AttributeEnd", ["without its AttributeBegin"]),
    ('ObjectBegin "x" ObjectInstance "x" ObjectEnd', ["within an object"]),
    ('MakeNamedMaterial "x"', ["'x'", "without a type"]),
    ('NamedMaterial "x" Shape "sphere"', ["'x'"]),
    ('Material "matte" Shape "sphere"', ["'matte'", "unknown in pbrt-v4"]),
    ('Material "diffuse" "texture reflectance" "x" Shape "sphere"', ["no spectrum texture 'x'"]),
    (
        'Texture "x" "float" "scale" "texture tex" "x" Material "conductor" "texture roughness" "x" Shape "sphere"',
        ["refers to itself"],
    ),
    ("LookAt 0 0 0 0 1 0 0 1 0", ["scene.pbrt:4", "LookAt", "up"]),
    ('Shape "loopsubdiv" "integer levels" 30 "point3 P" [0 0 0 1 0 0 0 1 0] "integer indices" [0 1 2]', ["levels", "0 to 8"]),
    ("", ["holds no shapes"]),
    ('Shape "heightfield"', ["holds no shapes", "shapes of the type heightfield: left out (scene.pbrt:4)"]),
]


@pytest.mark.parametrize(("body", "named"), ERRORS)
def test_errors_name_file_line_and_remedy(tmp_path, body, named):
    text = message(tmp_path, body)
    assert all(word in text for word in named), text


def test_cycles_and_floods_of_includes_are_refused(tmp_path):
    """A file that includes itself, and 15 files of which each but the last includes the next one twice."""
    (tmp_path / "self.pbrt").write_text('Include "self.pbrt"\n')
    assert "self.pbrt:1: files include each other more than 16 deep; break the cycle" in message(tmp_path, 'Include "self.pbrt"')
    for number in range(15):
        (tmp_path / f"{number}.pbrt").write_text(f'Include "{number + 1}.pbrt"\n' * 2 if number < 14 else "# the end\n")
    assert "the scene includes more than 10,000 files" in message(tmp_path, 'Include "0.pbrt"')


def test_cameras_without_a_counterpart(tmp_path):
    assert "orthographic" in message(tmp_path, SQUARE, HEAD.replace("perspective", "orthographic"))
    assert "has no camera" in message(tmp_path, SQUARE, HEAD[HEAD.index("Film") :])
    assert "fov" in message(tmp_path, SQUARE, HEAD.replace('fov" 90', 'fov" 190'))
    assert "singular" in message(tmp_path, SQUARE, "Scale 0 1 1\n" + HEAD)


@pytest.mark.parametrize(
    ("lens", "named"),
    [
        ('"float lensradius" 0.1 "float focaldistance" -4', "focaldistance: -4.0 is out of range; give a number above 0"),
        ('"float lensradius" 0.1 "float focaldistance" 0', "focaldistance: 0.0 is out of range"),
        ('"float focaldistance" -4', "focaldistance: -4.0 is out of range"),
        ('"float lensradius" -0.1 "float focaldistance" 4', "lensradius: -0.1 is out of range; give 0 or more"),
    ],
)
def test_lenses_out_of_range_are_refused(tmp_path, lens, named):
    text = message(tmp_path, SQUARE, f'Camera "perspective"\n{lens}\nWorldBegin\n')
    assert f"scene.pbrt:2: {named}" in text and "\n" not in text


def test_the_command_line_renders_a_scene(tmp_path, capsys):
    read(tmp_path, 'AreaLightSource "diffuse" "rgb L" [1 2 3]\nReverseOrientation\n' + SQUARE)
    arguments = ["render", str(tmp_path / "scene.pbrt"), "--spp", "2", "--out", str(tmp_path / "a.exr"), "--mode", "uniform"]
    assert main(arguments) == 0
    assert (tmp_path / "a.png").exists()
    capsys.readouterr()
    with pytest.raises(BokehguideError, match="camera of a model"):
        load_scene(str(tmp_path / "scene.pbrt"), Overrides(camera="0"))


def test_parameters_of_an_unknown_name_are_told(tmp_path):
    """A name that resembles that of a missing parameter; parameters without a counterpart here are left alone."""
    shape = 'Material "diffuse" "rgb refelctance" [0.5 0.5 0.5]\nShape "sphere" "float radios" 2 "string splitmethod" "equal"\n'
    (line,) = [line for line in read(tmp_path, shape).warnings if "unknown name" in line]
    assert "refelctance; did you mean reflectance?" in line and "radios; did you mean radius?" in line and "split" not in line
    known = 'Material "diffuse" "rgb reflectance" [0.5 0.5 0.5]\nShape "sphere" "float radius" 2\n'
    assert not any("unknown name" in line for line in read(tmp_path, known).warnings)


OLDER = 'Camera "perspective" "float fov" 90\nFilm "image" "integer xresolution" 32 "integer yresolution" 16\nWorldBegin\n'
"""The head of a file of pbrt-v3."""


def test_the_command_line_renders_a_scene_of_pbrt_v3(tmp_path, capsys):
    lit = 'AttributeBegin\nAreaLightSource "area" "color L" [1 2 3]\nReverseOrientation\n' + SQUARE + "AttributeEnd\nWorldEnd\n"
    (tmp_path / "scene.pbrt").write_text('SurfaceIntegrator "path" "integer maxdepth" 7\n' + OLDER + lit)
    arguments = ["render", str(tmp_path / "scene.pbrt"), "--spp", "1", "--out", str(tmp_path / "a.exr"), "--mode", "uniform"]
    assert main(arguments) == 0
    assert "warning" not in capsys.readouterr().err
    scene = load_scene(str(tmp_path / "scene.pbrt"))
    assert scene.film.max_depth == 8 and scene.materials[0].emission == (1.0, 2.0, 3.0)


def test_a_shutter_is_no_exposure_before_pbrt_v4(tmp_path):
    camera = 'Camera "perspective" "float shutteropen" 0 "float shutterclose" 0.25\n'
    assert read(tmp_path, SQUARE, camera + "WorldBegin\n").film.exposure == -2.0
    assert read(tmp_path, SQUARE + "WorldEnd\n", camera + "WorldBegin\n").film.exposure is None


def test_blocks_overlap_before_pbrt_v4(tmp_path):
    """An end restores the state of the last begin, whatever its kind."""
    body = 'AttributeBegin\nTranslate 0 0 1\nObjectBegin "a"\n' + SQUARE + "AttributeEnd\nObjectEnd\nTranslate 0 0 5\n"
    scene = read(tmp_path, body + 'ObjectInstance "a"\nWorldEnd\n', OLDER)
    np.testing.assert_allclose(scene.meshes[0].vertices[:, 2], 10.0)
    assert "AttributeEnd without its AttributeBegin" in message(tmp_path, body)


def test_the_end_of_a_transform_keeps_the_material_before_pbrt_v4(tmp_path):
    body = 'TransformBegin\nTranslate 0 0 1\nMaterial "matte" "rgb Kd" [1 0 0]\nTransformEnd\n' + SQUARE
    scene = read(tmp_path, body, OLDER)
    assert scene.materials[scene.meshes[0].material].base_color == (1.0, 0.0, 0.0)
    np.testing.assert_allclose(scene.meshes[0].vertices[:, 2], 4.0)


def test_a_second_object_of_a_name_replaces_the_first_before_pbrt_v4(tmp_path):
    twice = "".join(f'ObjectBegin "a"\nTranslate 0 0 {far}\n{SQUARE}ObjectEnd\nObjectInstance "a"\n' for far in (1, 2))
    assert [mesh.vertices[0, 2] for mesh in read(tmp_path, twice, OLDER).meshes] == [5.0, 6.0]
    assert "an object of this name exists" in message(tmp_path, twice)


def test_an_unknown_named_material_is_told_before_pbrt_v4(tmp_path):
    body = 'Material "matte" "rgb Kd" [1 0 0]\nNamedMaterial "lost"\n' + SQUARE
    scene = read(tmp_path, body, OLDER)
    assert scene.materials[scene.meshes[0].material].base_color == (1.0, 0.0, 0.0)
    assert scene.warnings == (
        "scene.pbrt: unknown names of materials: the material before stays, as in pbrt-v3 (lost, scene.pbrt:5)",
    )


def test_the_first_scene_of_a_file_counts_before_pbrt_v4(tmp_path):
    scene = read(tmp_path, SQUARE + "WorldEnd\n" + OLDER + 'Shape "sphere"\nWorldEnd\n', OLDER)
    assert len(scene.meshes) == 1 and scene.film.width == 32
    assert scene.warnings == ("scene.pbrt: scenes after the first WorldEnd: left out (scene.pbrt:5)",)


def test_distances_without_an_end(tmp_path):
    camera = 'Camera "perspective" "float lensradius" 0.1 "float focaldistance" [1e30] "float yon" inf\nWorldBegin\n'
    assert read(tmp_path, SQUARE, camera).camera.focus_distance == FARTHEST_FOCUS
    assert "not finite" in message(tmp_path, SQUARE, camera.replace("1e30", "nan"))
