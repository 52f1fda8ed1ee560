"""Mitsuba XML files as scenes: what the exporter writes comes back, and shapes and fields of view are Mitsuba's."""

import zlib
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

mi = pytest.importorskip("mitsuba")

from bokehguide.cli import main
from bokehguide.errors import BokehguideError
from bokehguide.export import export_mitsuba
from bokehguide.image import write_exr
from bokehguide.render.bsdf.microfacets import ggx_density
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.environment import EnvironmentLight
from bokehguide.render.textures import TextureAtlas
from bokehguide.render.tracer import Tracer
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.anisotropy import to_alphas
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.mitsuba_xml.properties import PROPERTIES, unknown_properties
from bokehguide.scene.mitsuba_xml.tree import read_tree
from bokehguide.scene.shapes import spheres, transform, transformed, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Scene, Texture
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import estimates

MITSUBA_VARIANT = "scalar_rgb"
SENSOR = (
    '<sensor type="thinlens"><float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>'
    '<float name="fov" value="40"/><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>'
    '<film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="18"/></film></sensor>'
)

BALL = '<shape type="sphere"><bsdf type="{}"><string name="{}" value="{}"/></bsdf></shape>'


def written(folder, body: str, sensor: str = SENSOR):
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{sensor}{body}</scene>')
    return path


def read(folder, body: str, sensor: str = SENSOR) -> Scene:
    return load_scene(str(written(folder, body, sensor)))


def test_exported_scenes_come_back(tmp_path):
    image = np.random.default_rng(0).random((4, 6, 3), np.float32)
    texture = Texture(image, wrap=("mirror", "mirror"), transform=(2.0, 0.0, 0.5, 0.0, 1.0, 0.0))
    materials = (
        Material("matte", (1.0, 1.0, 1.0), specular=0.0, base_color_texture=texture),
        Material("gold", (1.0, 0.8, 0.3), metallic=1.0, roughness=0.3),
        Material("glass", (0.9, 1.0, 0.9), transmission=1.0, roughness=0.0, ior=1.4),
        Material("lamp", (0.0, 0.0, 0.0), specular=0.0, emission=(3.0, 2.0, 1.0)),
    )
    meshes = tuple(spheres(np.array([[number, 0.0, 0.0]]), np.array([0.4]), number, 1) for number in range(4))
    meshes = (transformed(unit_sphere(1), transform(scale=0.4)), *meshes[1:])
    radiance = np.random.default_rng(1).random((4, 8, 3)).astype(np.float32)
    camera = Camera((1.0, 2.0, 5.0), (1.5, 0.0, 0.0), fov=35.0, aperture_radius=0.05, focus_distance=4.0)
    scene = Scene("there", camera, meshes, materials, FilmSettings(32, 18, 5), Environment(radiance, 30.0))
    assert export_mitsuba(scene, tmp_path) == []
    back = load_scene(str(tmp_path / "scene.xml"))
    assert back.camera.position == pytest.approx(camera.position) and back.camera.fov == pytest.approx(35.0)
    assert (back.camera.aperture_radius, back.camera.focus_distance) == pytest.approx((0.05, 4.0))
    direction, wanted = (np.subtract(each.target, each.position) for each in (back.camera, camera))
    np.testing.assert_allclose(direction / np.linalg.norm(direction), wanted / np.linalg.norm(wanted), atol=1e-6)
    assert (back.film.width, back.film.height, back.film.max_depth) == (32, 18, 5)
    for mesh, ours in zip(back.meshes, meshes):
        np.testing.assert_allclose(mesh.vertices, ours.vertices, atol=1e-6)
        np.testing.assert_array_equal(mesh.triangles, ours.triangles)
        found, material = back.materials[mesh.material], materials[ours.material]
        assert found.base_color == pytest.approx(material.base_color)
        terms = ("metallic", "roughness", "transmission", "ior", "emission")
        assert all(getattr(found, term) == pytest.approx(getattr(material, term), abs=1e-3) for term in terms)
    np.testing.assert_allclose(back.meshes[0].uvs, meshes[0].uvs, atol=1e-6)
    again = back.materials[back.meshes[0].material].base_color_texture
    np.testing.assert_allclose(again.image, texture.image, atol=1e-6)
    assert (again.wrap, again.transform) == (texture.wrap, texture.transform)
    assert back.environment.rotation % 360.0 == pytest.approx(30.0)
    np.testing.assert_allclose(back.environment.radiance[1::2], radiance, atol=1e-6)
    assert back.warnings == ()


def test_exported_flat_meshes_stay_flat(tmp_path):
    """Mitsuba averages the normals at shared vertices of a file without normals, unless the shape says otherwise."""
    ball = unit_sphere(1)
    flat = replace(ball, normals=None, material=0)
    camera = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), aperture_radius=0.05, focus_distance=4.0)
    scene = Scene("ball", camera, (flat, transformed(ball, transform((4.0, 0.0, 0.0)))), (Material("m"),), FilmSettings(32, 18))
    export_mitsuba(scene, tmp_path)
    there = mi.load_file(str(tmp_path / "scene.xml"))
    for x, least in ((0.0, 0.9999), (4.0, 0.9)):
        hits = [there.ray_intersect(mi.Ray3f((x + 0.07 * n, 0.31, 5.0), (0.0, 0.0, -1.0))) for n in range(8)]
        cosines = [float(mi.ScalarVector3f(hit.n) @ mi.ScalarVector3f(hit.sh_frame.n)) for hit in hits]
        assert all(hit.is_valid() for hit in hits) and least < min(cosines)
        assert (min(cosines) > 0.9999) == (x == 0.0), "the other ball is smooth"
    back = load_scene(str(tmp_path / "scene.xml"))
    assert back.meshes[0].normals is None and back.meshes[1].normals is not None


@pytest.mark.parametrize("kind", ["sphere", "rectangle", "disk", "cube", "cylinder"])
def test_shapes_are_mitsubas(tmp_path, kind):
    """Bounds and area, under a transform."""
    steps = '<scale x="2" y="1" z="0.5"/><rotate y="1" angle="30"/><translate x="1" y="2" z="-3"/>'
    move = f'<transform name="to_world">{steps}</transform>'
    if kind == "sphere":
        move = '<point name="center" x="1" y="2" z="-3"/><float name="radius" value="0.7"/>'
    if kind == "cylinder":
        ends = '<point name="p0" x="1" y="2" z="-3"/><point name="p1" x="2" y="-1" z="0.5"/>'
        move = f'{ends}<float name="radius" value="0.7"/><transform name="to_world"><rotate y="1" angle="30"/></transform>'
    (mesh,) = read(tmp_path, f'<shape type="{kind}">{move}</shape>').meshes
    shape = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0]
    corners = mesh.vertices[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(shape.surface_area(), rel=3e-3)
    close = 0.01 * np.ptp(mesh.vertices)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), np.array(shape.bbox().min), atol=close)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), np.array(shape.bbox().max), atol=close)


CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
"""Of a square, anticlockwise."""


def write_square(path, normals: bool, reverse: bool) -> None:
    """A square as `.obj` or `.ply`. normals: whether the file has those along z. reverse: whether the triangles face -z."""
    faces = [(3, 2, 0), (2, 1, 0)] if reverse else [(0, 1, 2), (0, 2, 3)]
    if path.suffix == ".obj":
        corners = "".join(f"v {x} {y} 0\n" for x, y in CORNERS) + ("vn 0 0 1\n" if normals else "")
        join = "{}//1" if normals else "{}"
        path.write_text(corners + "".join(f"f {' '.join(join.format(each + 1) for each in face)}\n" for face in faces))
        return
    names = ("x", "y", "z", "nx", "ny", "nz") if normals else ("x", "y", "z")
    head = "".join(f"property float {name}\n" for name in names)
    head = f"ply\nformat ascii 1.0\nelement vertex 4\n{head}element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    corners = "".join(f"{x} {y} 0{' 0 0 1' * normals}\n" for x, y in CORNERS)
    path.write_text(head + corners + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces))


@pytest.mark.parametrize("kind", ["sphere", "rectangle", "disk", "cube", "obj", "ply", "serialized"])
def test_the_side_of_emission_is_mitsubas(tmp_path, kind):
    """Also of mirrored shapes, with and without normals in their files, and of normals against the order of vertices."""
    files = [""]
    if kind in ("obj", "ply"):
        for normals, reverse in ((False, False), (True, False), (True, True)):
            write_square(tmp_path / f"s{normals}{reverse}.{kind}", normals, reverse)
        files = [f'<string name="filename" value="{path.name}"/>' for path in sorted(tmp_path.glob(f"*.{kind}"))]
    if kind == "serialized":
        files = [f'<string name="filename" value="{write_serialized(tmp_path / "s.serialized").name}"/>']
    flags = ["", *(f'<boolean name="{key}" value="true"/>' for key in ("flip_normals", "face_normals"))]
    moves = ("", '<scale x="-1"/>', '<scale z="-1"/>', '<rotate x="1" angle="20"/>')
    light = '<emitter type="area"><rgb name="radiance" value="1 1 1"/></emitter>'
    for file, flag, move in product(files, flags, moves):
        if "face" in flag and kind in ("sphere", "disk"):
            continue
        shape = f'<shape type="{kind}">{file}{flag}<transform name="to_world">{move}</transform>{light}</shape>'
        scene = read(tmp_path, shape)
        there = mi.load_file(str(tmp_path / "scene.xml"))
        for side in (1.0, -1.0):
            hit = there.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.13, 4.0 * side), mi.Vector3f(0.0, 0.0, -side)))
            theirs = float(np.ravel(np.array(hit.emitter(there).eval(hit)))[0])
            ours = estimates(scene, (0.1, 0.13, 4.0 * side), (0.0, 0.0, -side), 1)[0, 0]
            assert ours == pytest.approx(theirs, abs=1e-4), (shape, side)


@pytest.mark.parametrize("flag", ["", '<boolean name="flip_normals" value="true"/>'])
@pytest.mark.parametrize("move", ["", '<scale x="-1"/>', '<rotate z="1" angle="25"/>'])
def test_the_side_of_emission_of_cylinders_is_mitsubas(tmp_path, flag, move):
    light = '<emitter type="area"><rgb name="radiance" value="1 1 1"/></emitter>'
    scene = read(tmp_path, f'<shape type="cylinder">{flag}<transform name="to_world">{move}</transform>{light}</shape>')
    there = mi.load_file(str(tmp_path / "scene.xml"))
    for start, direction in (((4.0, 0.1, 0.3), (-1.0, 0.0, 0.0)), ((0.2, 0.1, 0.3), (-1.0, 0.0, 0.0))):
        hit = there.ray_intersect(mi.Ray3f(mi.Point3f(*start), mi.Vector3f(*direction)))
        theirs = float(np.ravel(np.array(hit.emitter(there).eval(hit)))[0])
        assert estimates(scene, start, direction, 1)[0, 0] == pytest.approx(theirs, abs=1e-4)


def write_serialized(path):
    """A square in Mitsuba's own format, without normals."""
    vertices = np.array([(x, y, 0.0) for x, y in CORNERS], "<f4").tobytes()
    body = np.uint32(0x1000).tobytes() + b"square\0" + np.array([4, 2], "<u8").tobytes() + vertices
    body += np.array([0, 1, 2, 0, 2, 3], "<u4").tobytes()
    path.write_bytes(np.array([0x041C, 4], "<u2").tobytes() + zlib.compress(body) + np.array([0], "<u8").tobytes() + b"\1\0\0\0")
    return path


@pytest.mark.parametrize("mirror", ["", '<transform name="to_world"><scale y="-2"/></transform>'])
def test_models_without_normals_are_smooth_as_in_mitsuba(tmp_path, mirror):
    """The normals at the vertices are means of those around, weighted by angle."""
    ball = trimesh.creation.icosphere(1)
    ball.vertices *= (1.0, 0.5, 1.5)
    (tmp_path / "ball.obj").write_text(trimesh.exchange.obj.export_obj(ball, include_normals=False))
    scene = read(tmp_path, f'<shape type="obj"><string name="filename" value="ball.obj"/>{mirror}</shape>')
    there = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0]
    points, normals = (
        np.array(buffer(), np.float32).reshape(-1, 3) for buffer in (there.vertex_positions_buffer, there.vertex_normals_buffer)
    )
    mesh = scene.meshes[0]
    nearest = np.linalg.norm(mesh.vertices[:, None] - points, axis=2).argmin(axis=1)
    np.testing.assert_allclose(mesh.normals, normals[nearest], atol=2e-3)


@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger", "diagonal"])
def test_fields_of_view_are_mitsubas(tmp_path, axis):
    sensor = SENSOR.replace("<film", f'<string name="fov_axis" value="{axis}"/><film')
    scene = read(tmp_path, '<shape type="sphere"/>', sensor)
    theirs = mi.traverse(mi.load_file(str(tmp_path / "scene.xml")).sensors()[0])["x_fov"]
    assert scene.camera.fov == pytest.approx(float(np.ravel(np.array(theirs))[0]), rel=1e-4)


def test_materials(tmp_path):
    body = (
        '<bsdf type="twosided" id="gold"><bsdf type="roughconductor"><string name="material" value="Au"/>'
        '<float name="alpha" value="0.09"/></bsdf></bsdf>'
        '<bsdf type="roughplastic" id="red"><rgb name="diffuse_reflectance" value="0.5 0 0"/>'
        '<float name="alpha" value="0.25"/></bsdf>'
        '<bsdf type="dielectric" id="water"><string name="int_ior" value="water"/></bsdf>'
        '<bsdf type="principled" id="car"><rgb name="base_color" value="0 0 0.5"/><float name="clearcoat" value="0.7"/>'
        '<float name="clearcoat_gloss" value="0.9"/><float name="spec_tint" value="1"/></bsdf>'
        '<bsdf type="mask" id="veil"><float name="opacity" value="0.25"/><bsdf type="diffuse"/></bsdf>'
        '<bsdf type="hair" id="wig"/>'
    )
    names = ("gold", "red", "water", "car", "veil", "wig")
    shapes = "".join(f'<shape type="sphere" id="s{name}"><ref id="{name}"/></shape>' for name in names)
    scene = read(tmp_path, body + shapes)
    found = dict(zip(names, (scene.materials[mesh.material] for mesh in scene.meshes)))
    assert found["gold"].metallic == 1.0 and found["gold"].roughness == pytest.approx(0.3)
    assert found["gold"].single_scattering and not found["car"].single_scattering
    red, green, blue = found["gold"].base_color
    assert red > 0.9 and 0.6 < green < 0.85 and 0.2 < blue < 0.5
    assert found["red"].base_color == (0.5, 0.0, 0.0) and found["red"].roughness == pytest.approx(0.5)
    assert found["water"].transmission == 1.0 and found["water"].ior == pytest.approx(1.333, rel=1e-3)
    assert found["car"].clearcoat == pytest.approx(0.7) and found["car"].clearcoat_roughness == pytest.approx(0.1)
    assert (found["veil"].alpha_mode, found["veil"].opacity) == ("blend", 0.25)
    assert scene.warnings[0] == "scene.xml: spec_tint of principled BSDFs: left out (car)"
    assert scene.warnings[1] == "scene.xml: BSDF hair: grey in its place (wig)"


def sole(folder, bsdf: str) -> tuple[Material, tuple[str, ...]]:
    """The material of a sphere with a BSDF, and the warnings."""
    scene = read(folder, f'<shape type="sphere">{bsdf}</shape>')
    return scene.materials[scene.meshes[0].material], scene.warnings


def test_reflectances_of_principled_are_mitsubas(tmp_path):
    """The reflectance at normal incidence by `eta` and by `specular`, relative to that of glass of the index 1.5."""
    up = mi.Vector3f(0.0, 0.0, 1.0)

    def peak(**values) -> float:
        at = mi.SurfaceInteraction3f()
        at.wi = up
        black = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
        bsdf = mi.load_dict({"type": "principled", "base_color": black, "roughness": 0.3, **values})
        return np.ravel(np.array(bsdf.eval(mi.BSDFContext(), at, up)))[0]

    for key, value in (("eta", 2.0), ("eta", 1.2), ("eta", 0.8), ("specular", 1.0), ("specular", 0.25), ("specular", 0.0)):
        given = f'<bsdf type="principled"><float name="{key}" value="{value}"/><float name="spec_trans" value="{{}}"/></bsdf>'
        found, warnings = sole(tmp_path, given.format(0.0))
        expected = 0.04 * peak(**{key: value}) / peak(eta=1.5)
        assert found.specular * ((found.ior - 1.0) / (found.ior + 1.0)) ** 2 == pytest.approx(expected, rel=1e-3, abs=1e-9)
        assert warnings == ()
        if key == "eta":
            assert sole(tmp_path, given.format(1.0))[0].ior == pytest.approx(max(value, 1.0 / value))
    with pytest.raises(BokehguideError, match=r"principled \d+\.eta: big is not a number in range"):
        sole(tmp_path, '<bsdf type="principled"><string name="eta" value="big"/></bsdf>')


@pytest.mark.parametrize(("ior", "specular"), [(1.5, 1.0), (1.33, 1.0), (1.7, 1.0), (2.0, 1.0), (2.4, 1.0), (1.5, 0.4)])
def test_refractive_indices_come_back(tmp_path, ior, specular):
    """Mitsuba has one number for both, the reflectance at normal incidence."""
    camera, ball = Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0)), spheres(np.zeros((1, 3)), np.ones(1), 0, 1)
    material = Material("m", roughness=0.3, ior=ior, specular=specular)
    assert export_mitsuba(Scene("one", camera, (ball,), (material,), FilmSettings(8, 8)), tmp_path) == []
    found = load_scene(str(tmp_path / "scene.xml")).materials[0]
    ratios = [each.specular * ((each.ior - 1.0) / (each.ior + 1.0)) ** 2 for each in (found, material)]
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-5)
    assert specular < 1.0 or (found.ior, found.specular) == (pytest.approx(ior), 1.0)


DENSE = '<float name="int_ior" value="1.0"/><float name="ext_ior" value="1.5"/>'
SHINY = '<rgb name="base_color" value="1 1 1"/><float name="roughness" value="0.2"/><float name="spec_trans" value="1"/>'
GLASSES = {
    "glass": '<bsdf type="dielectric"/>',
    "bubble": f'<bsdf type="dielectric">{DENSE}</bsdf>',
    "mask": f'<bsdf type="mask"><float name="opacity" value="0.9"/><bsdf type="dielectric">{DENSE}</bsdf></bsdf>',
    "rough": f'<bsdf type="roughdielectric"><string name="distribution" value="ggx"/>{DENSE}</bsdf>',
    "principled": f'<bsdf type="principled">{SHINY}<float name="eta" value="1.8"/></bsdf>',
    "dense": f'<bsdf type="principled">{SHINY}<float name="eta" value="0.8"/></bsdf>',
}


@pytest.mark.parametrize("mirror", ["", '<scale x="-1"/>'])
@pytest.mark.parametrize("kind", GLASSES)
def test_glass_refracts_as_in_mitsuba(tmp_path, kind, mirror):
    """The radiance along a ray through a ball in front of a lamp, on either side of whose surface the glass may be."""
    place = '<transform name="to_world"><translate x="-1.2" z="-3"/></transform>'
    lamp = f'<shape type="rectangle">{place}<emitter type="area"><rgb name="radiance" value="3 3 3"/></emitter></shape>'
    shape = f'<shape type="sphere"><transform name="to_world">{mirror}</transform>{GLASSES[kind]}</shape>'
    sky = '<emitter type="constant"><rgb name="radiance" value="0.5 0.5 0.5"/></emitter>'
    scene = read(tmp_path, shape + lamp + sky + '<integrator type="path"><integer name="max_depth" value="12"/></integrator>')
    there, sampler = mi.load_file(str(tmp_path / "scene.xml")), mi.load_dict({"type": "independent"})
    sampler.seed(0)
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0.45, 0.1, 4.0), mi.Vector3f(0.0, 0.0, -1.0)))
    theirs = np.array([there.integrator().sample(there, sampler, ray)[0][0] for _ in range(2000)], np.float64)
    ours = estimates(scene, (0.45, 0.1, 4.0), (0.0, 0.0, -1.0), 20_000)[0]
    error = np.hypot(*(each.std() / np.sqrt(each.size) for each in (ours, theirs)))
    assert z_test(np.array([ours.mean() - theirs.mean()]), np.array([error + 2e-3])) > SIGNIFICANCE, (ours.mean(), theirs.mean())


BLEND = '<bsdf type="blendbsdf" id="mix">{}{}{}</bsdf>'
RED, BLUE = (f'<bsdf type="diffuse"><rgb name="reflectance" value="{c}"/></bsdf>' for c in ("0.8,0,0", "0,0,0.4"))
METAL = '<bsdf type="roughconductor"><string name="material" value="Au"/></bsdf>'


def test_blended_bsdfs_of_one_kind_have_the_mean_colour(tmp_path):
    """Mitsuba's albedo of the mixture; its default weight is 0.5."""
    for given, weight in (('<float name="weight" value="0.25"/>', 0.25), ("", 0.5)):
        text = BLEND.format(given, RED, BLUE)
        scene = load_scene(written(tmp_path, f'<shape type="sphere">{text}</shape><emitter type="constant"/>'))
        plain = {"type": "blendbsdf", "weight": weight}
        plain |= {
            name: {"type": "diffuse", "reflectance": {"type": "rgb", "value": c}}
            for name, c in (("a", [0.8, 0, 0]), ("b", [0, 0, 0.4]))
        }
        at = mi.SurfaceInteraction3f()
        at.wi = mi.Vector3f(0.0, 0.0, 1.0)
        mi.set_variant(MITSUBA_VARIANT)
        wanted = np.ravel(np.array(mi.load_dict(plain).eval_diffuse_reflectance(at)))
        np.testing.assert_allclose(scene.materials[0].base_color, wanted, atol=1e-6)
        assert scene.materials[0].name == "mix" and scene.warnings == ()


@pytest.mark.parametrize(("weight", "metallic"), [("0.7", 1.0), ("0.3", 0.0), ("1", 1.0), ("image", 1.0)])
def test_the_larger_part_of_other_blended_bsdfs_counts(tmp_path, weight, metallic):
    Image.new("L", (2, 2), 200).save(tmp_path / "weight.png")
    file = '<string name="filename" value="weight.png"/><boolean name="raw" value="true"/>'
    image = f'<texture type="bitmap" name="weight">{file}</texture>'
    given = image if weight == "image" else f'<float name="weight" value="{weight}"/>'
    body = f'<shape type="sphere">{BLEND.format(given, RED, METAL)}</shape><emitter type="constant"/>'
    scene = load_scene(written(tmp_path, body))
    assert scene.materials[0].metallic == metallic
    told = "scene.xml: mixtures of BSDFs: the larger part counts (mix)"
    assert scene.warnings == (() if weight == "1" else (told,))


def test_losses_of_reflectances_and_of_indices(tmp_path):
    grey = '<rgb name="specular_reflectance" value="0.5 0.25 0"/>'
    found, warnings = sole(tmp_path, f'<bsdf type="plastic">{grey}</bsdf>')
    assert (found.specular, found.specular_color) == (0.5, (1.0, 0.5, 0.0)) and warnings == ()
    assert sole(tmp_path, f'<bsdf type="plastic">{grey.replace("0.5 0.25 0", "0 0 0")}</bsdf>')[0].specular == 0.0
    checks = '<texture type="checkerboard" name="specular_reflectance"/>'
    for bsdf, told in (
        (f'<bsdf type="dielectric" id="b">{grey}</bsdf>', "specular_reflectance of dielectrics: 1.0 in its place (b)"),
        (
            f'<bsdf type="plastic" id="b">{checks}</bsdf>',
            "specular_reflectance of the type checkerboard: 1.0 in its place (b)",
        ),
        (f'<bsdf type="conductor" id="b">{checks}</bsdf>', "specular_reflectance of the type checkerboard: left out (b)"),
        (f'<bsdf type="thindielectric" id="b">{DENSE}</bsdf>', "thindielectric with int_ior below ext_ior: both exchanged (b)"),
    ):
        found, warnings = sole(tmp_path, bsdf)
        assert warnings == (f"scene.xml: {told}",)
    assert found.ior == pytest.approx(1.5)
    light = '<emitter type="area"><float name="radiance" value="2"/></emitter>'
    scene = read(tmp_path, f'<shape type="sphere" id="s">{GLASSES["bubble"]}{light}</shape>')
    assert scene.warnings == ("scene.xml: glass in a denser medium that emits: the glass is the denser one (s)",)
    assert estimates(scene, (0.1, 0.2, 4.0), (0.0, 0.0, -1.0), 1)[0, 0] >= 2.0


def test_losses_of_the_sensor(tmp_path):
    crop = '<integer name="crop_width" value="16"/><integer name="crop_offset_x" value="4"/></film>'
    sensor = SENSOR.replace("thinlens", "perspective").replace('<float name="aperture_radius" value="0.1"/>', "")
    offset = '<float name="principal_point_offset_y" value="0.2"/><film'
    ball = '<shape type="sphere"/>'
    assert read(tmp_path, ball, sensor.replace("</film>", crop).replace("<film", offset)).warnings == (
        "scene.xml: crops of the film: the whole film in their place (hdrfilm)",
        "scene.xml: principal points outside the middle: the middle in their place (perspective)",
    )
    whole = '<integer name="crop_width" value="32"/><integer name="crop_height" value="18"/></film>'
    assert read(tmp_path, ball, sensor.replace("</film>", whole)).warnings == ()


SPECTRA = [
    '<spectrum name="{}" type="d65"><float name="scale" value="3"/></spectrum>',
    '<spectrum name="{}" type="d65"><rgb name="color" value="1 2 3"/><float name="scale" value="2"/></spectrum>',
    '<spectrum name="{}" type="uniform"><float name="value" value="0.7"/></spectrum>',
    '<spectrum name="{}" value="400:1, 500:5, 600:8, 700:10"/>',
    '<spectrum name="{}" value="3"/>',
    '<float name="{}" value="2"/>',
]


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_spectra_of_light_are_mitsubas(tmp_path, spectrum):
    ball = '<shape type="sphere">{}</shape>'
    emitters = (
        f'<emitter type="area">{spectrum.format("radiance")}</emitter>',
        f'<emitter type="constant">{spectrum.format("radiance")}</emitter>',
        f'<emitter type="point" id="bulb">{spectrum.format("intensity")}</emitter>',
    )
    scene = read(tmp_path, ball.format(emitters[0]) + "".join(emitters[1:]))
    expected = np.ravel(np.array(mi.load_file(str(tmp_path / "scene.xml")).environment().eval(mi.SurfaceInteraction3f())))
    bulb = np.array(scene.materials[scene.meshes[1].material].emission) * np.pi * 0.01**2
    for found in (scene.materials[scene.meshes[0].material].emission, scene.environment.radiance[0, 0], bulb):
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert scene.warnings == ("scene.xml: point lights: spheres of radius 0.01 m (bulb)",)


def test_lights_without_a_colour_in_rgb_are_told(tmp_path):
    glow = '<spectrum name="radiance" type="blackbody"><float name="temperature" value="3000"/></spectrum>'
    scene = read(tmp_path, f'<shape type="sphere"/><emitter type="constant" id="sky">{glow}</emitter>')
    assert scene.environment.radiance.ravel().tolist() == [1.0, 1.0, 1.0]
    assert scene.warnings == ("scene.xml: radiance of the type blackbody: 1.0 in its place (sky)",)


def test_spectra_of_surfaces_are_mitsubas(tmp_path):
    found, warnings = sole(tmp_path, '<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1, 700:0.9"/></bsdf>')
    bsdf, at = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf(), mi.SurfaceInteraction3f()
    at.wi = mi.Vector3f(0.0, 0.0, 1.0)
    np.testing.assert_allclose(found.base_color, np.ravel(np.array(bsdf.eval_diffuse_reflectance(at))), rtol=1e-5)
    indices = '<spectrum name="eta" value="400:1.4, 700:0.2"/><spectrum name="k" value="400:1.5, 700:4.2"/>'
    found, others = sole(tmp_path, f'<bsdf type="conductor">{indices}</bsdf>')
    metal = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    _, weight = metal.sample(mi.BSDFContext(), at, 0.5, mi.Point2f(0.5, 0.5))
    np.testing.assert_allclose(found.base_color, np.ravel(np.array(weight)), rtol=1e-5)
    assert warnings == others == ()


def test_opacity_textures_are_mitsubas(tmp_path):
    """The alpha of the base colour is the transmission of Mitsuba's mask at the centres of texels, of images of two sizes."""
    random = np.random.default_rng(5)
    Image.fromarray(random.integers(0, 256, (4, 6, 3), np.uint8)).save(tmp_path / "leaf.png")
    Image.fromarray(random.integers(0, 256, (2, 3, 3), np.uint8)).save(tmp_path / "small.png")

    def leaf(opacity, reflectance, extra=""):
        image = '<texture type="bitmap" name="{}"><string name="filename" value="{}"/>{}</texture>'
        color = '<rgb name="reflectance" value="0.2 0.5 0.1"/>'
        inner = color if reflectance is None else image.format("reflectance", reflectance, "")
        mask = f'<bsdf type="mask" id="leaf">{image.format("opacity", opacity, extra)}<bsdf type="diffuse">{inner}</bsdf></bsdf>'
        scene = read(tmp_path, f'<shape type="rectangle">{mask}</shape>')
        return scene.materials[scene.meshes[0].material], scene.warnings

    material, warnings = leaf("leaf.png", "small.png")
    assert material.alpha_mode == "blend" and not warnings
    bsdf = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    at = mi.SurfaceInteraction3f()
    at.wi = mi.Vector3f(0.0, 0.0, 1.0)
    image = material.base_color_texture.image
    for row, column in np.ndindex(4, 6):
        at.uv = mi.Point2f((column + 0.5) / 6, (row + 0.5) / 4)  # bitmaps of Mitsuba begin at the top
        through = np.ravel(np.array(bsdf.eval_null_transmission(at)))[0]
        assert image[row, column, 3] == pytest.approx(1.0 - through, abs=2e-3)
    small = load_texture(tmp_path / "small.png", SceneFiles(tmp_path), srgb=True)
    np.testing.assert_array_equal(image[..., :3], small.repeat(2, axis=0).repeat(2, axis=1))
    plain, _ = leaf("leaf.png", None)
    assert plain.base_color == pytest.approx((0.2, 0.5, 0.1)) and (plain.base_color_texture.image[..., :3] == 1.0).all()
    _, (told,) = leaf("leaf.png", "small.png", '<string name="wrap_mode" value="clamp"/>')
    assert told.endswith("opacity textures with other coordinates than the colour: those of the colour count (leaf)")


def test_emitters(tmp_path):
    body = (
        '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="3 2 1"/></emitter></shape>'
        '<emitter type="point" id="bulb"><point name="position" x="1" y="2" z="3"/>'
        '<rgb name="intensity" value="5 5 5"/></emitter>'
        '<emitter type="directional" id="sun"><vector name="direction" x="0" y="-2" z="0"/>'
        '<rgb name="irradiance" value="4 4 4"/></emitter>'
        '<emitter type="constant"><rgb name="radiance" value="0.5 0.5 0.5"/></emitter><emitter type="projector" id="stage"/>'
    )
    scene = read(tmp_path, body)
    lamp = scene.materials[scene.meshes[0].material]
    assert lamp.emission == (3.0, 2.0, 1.0) and lamp.base_color == (0.0, 0.0, 0.0)
    bsdf = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    assert not np.array(bsdf.eval_diffuse_reflectance(mi.SurfaceInteraction3f())).any()
    bulb = scene.materials[scene.meshes[1].material]
    assert bulb.emission[0] * np.pi * 0.01**2 == pytest.approx(5.0)
    np.testing.assert_allclose(scene.meshes[1].vertices.mean(axis=0), (1, 2, 3), atol=2e-3)
    assert scene.suns[0].direction == pytest.approx((0.0, 1.0, 0.0)) and scene.suns[0].irradiance == (4.0, 4.0, 4.0)
    assert scene.environment.radiance.ravel().tolist() == [0.5, 0.5, 0.5]
    assert [line.removeprefix("scene.xml: ") for line in scene.warnings] == [
        "point lights: spheres of radius 0.01 m (bulb)",
        "directional lights: discs of 0.53° (sun)",
        "emitters of the type projector: left out (stage)",
    ]


def test_old_files_and_overrides(tmp_path):
    """Versions before 2.0 have other names; the command line's camera counts."""
    sensor = SENSOR.replace("aperture_radius", "apertureRadius").replace("focus_distance", "focusDistance")
    sensor = sensor.replace("to_world", "toWorld")
    path = written(tmp_path, '<shape type="sphere"/>', sensor)
    path.write_text(path.read_text().replace("3.0.0", "0.6.0"))
    scene = load_scene(str(path), Overrides(focus_distance=2.5, width=8, height=8))
    assert (scene.camera.aperture_radius, scene.camera.focus_distance, scene.film.width) == (0.1, 2.5, 8)


def test_the_variant_of_the_process_stays(tmp_path):
    read(tmp_path, '<shape type="sphere"/>')
    assert mi.variant() == "scalar_rgb"


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ("<shape", "not a readable Mitsuba scene"),
        ("<shape/>", "not a readable Mitsuba scene"),
        ("", "holds no shapes that can be drawn"),
        ('<shape type="obj"><string name="filename" value="none.obj"/></shape>', r"filename: .*none\.obj: no such file"),
        ('<shape type="ply"><string name="filename" value="../a.ply"/></shape>', r"filename: '\.\./a\.ply' lies outside"),
        ('<shape type="sphere"><float name="radius" value="1e30"/></shape>', "radius: 1e.30 is not a number in range"),
        ('<shape type="sphere"><point name="center" value="1e999, 2, 0"/></shape>', r"center: \(inf, 2\.0, .* not three numbers"),
        (BALL.format("dielectric", "int_ior", "tar"), "int_ior: tar is no medium"),
        (BALL.format("conductor", "material", "Xx"), "material: Xx is no conductor"),
        ('<include filename="../outside.xml"/><shape type="sphere"/>', "<include>: .* lies outside the scene's folder"),
        ('<path value="/tmp"/><shape type="sphere"/>', "<path>: '/tmp' lies outside the scene's folder"),
    ],
)
def test_mistakes(tmp_path, body, named):
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "outside.xml").write_text('<scene version="3.0.0"></scene>')
    with pytest.raises(BokehguideError, match=named) as caught:
        read(folder, body)
    assert "scene.xml" in str(caught.value) and "\n" not in str(caught.value)


def test_a_scene_without_a_sensor(tmp_path):
    with pytest.raises(BokehguideError, match="has no sensor of the type thinlens or perspective"):
        read(tmp_path, '<shape type="sphere"/>', "")


def test_textures_stay_in_the_folder_and_are_srgb(tmp_path):
    Image.new("RGB", (2, 2), (188, 188, 188)).save(tmp_path / "grey.png")
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="grey.png"/></texture>'
    scene = read(tmp_path, f'<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>')
    np.testing.assert_allclose(scene.materials[0].base_color_texture.image, 0.5029, atol=1e-3)
    with pytest.raises(BokehguideError, match="lies outside the scene's folder"):
        read(tmp_path, f'<shape type="sphere"><bsdf type="diffuse">{texture.replace("grey", "../grey")}</bsdf></shape>')


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ('<shape type="sphere"><emitter type="area"><rgb name="radiance" value="-200,120,50"/></emitter></shape>', "radiance"),
        ('<shape type="sphere"/><emitter type="point"><rgb name="intensity" value="-200,120,50"/></emitter>', "intensity"),
        (
            '<shape type="sphere"/><emitter type="directional"><rgb name="irradiance" value="-200,120,50"/></emitter>',
            "irradiance",
        ),
        ('<shape type="sphere"/><emitter type="constant"><rgb name="radiance" value="-200,120,50"/></emitter>', "radiance"),
    ],
)
def test_negative_light_is_refused(tmp_path, body, named):
    with pytest.raises(
        BokehguideError, match=rf"scene\.xml: \w+ \d+\.{named}: \(-200\.0, 120\.0, 50\.0\) has a negative channel"
    ):
        read(tmp_path, body)


def test_a_negative_scale_of_a_map_is_refused(tmp_path):
    write_exr(tmp_path / "sky.exr", {"beauty": np.ones((2, 4, 3), np.float32)})
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="{}"/></emitter>'
    assert read(tmp_path, '<shape type="sphere"/>' + sky.format("0.5")).environment.radiance.max() == 0.5
    with pytest.raises(BokehguideError, match=r"scene\.xml: envmap \d+\.scale: -0\.5 is negative; give a number of 0 or more"):
        read(tmp_path, '<shape type="sphere"/>' + sky.format("-0.5"))


def test_a_checkerboard_is_mitsubas(tmp_path):
    colors = '<rgb name="color0" value="0.9 0.1 0"/><rgb name="color1" value="0 0.2 0.7"/>'
    place = '<transform name="to_uv"><scale x="5" y="3"/><translate x="0.3" y="0.1"/></transform>'
    texture = f'<texture type="checkerboard" name="reflectance">{colors}{place}</texture>'
    scene = read(tmp_path, f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>')
    assert scene.warnings == ()
    found = scene.materials[scene.meshes[0].material].base_color_texture
    atlas = TextureAtlas()
    number = atlas.add(found)
    uv = np.random.default_rng(0).random((200, 2), np.float32)
    ours = atlas.build("cpu").lookup(torch.full((len(uv),), number), torch.from_numpy(uv.T.copy()))[:3].numpy().T
    bsdf = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    theirs = np.empty_like(ours)
    for row, point in zip(theirs, uv):
        at = mi.SurfaceInteraction3f()
        at.uv, at.wi = mi.Point2f(point), mi.Vector3f(0.0, 0.0, 1.0)
        row[:] = np.array(bsdf.eval_diffuse_reflectance(at)).ravel()
    same = np.abs(ours - theirs).max(axis=1) < 1e-3
    assert same.mean() > 0.94 and len(np.unique(theirs, axis=0)) == 2, "a check ends within one texel"
    light = texture.replace("reflectance", "radiance")
    scene = read(tmp_path, f'<shape type="rectangle"><emitter type="area">{light}</emitter></shape>')
    assert scene.materials[scene.meshes[0].material].emission_texture is not None and scene.warnings == ()


def test_a_checkerboard_of_textures_is_grey_in_their_place(tmp_path):
    inner = '<texture type="bitmap" name="color0"><string name="filename" value="a.png"/></texture>'
    texture = f'<texture type="checkerboard" name="reflectance" id="c">{inner}</texture>'
    found, warnings = sole(tmp_path, f'<bsdf type="diffuse">{texture}</bsdf>')
    assert warnings == ("scene.xml: textures in a checkerboard: grey in their place (c)",)
    np.testing.assert_allclose(np.unique(found.base_color_texture.image), (0.2, 0.5), rtol=1e-6)


def test_shapes_without_a_name_have_that_of_their_file_or_type(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "ball.obj")
    file = '<shape type="obj"><string name="filename" value="ball.obj"/></shape>'
    named = '<shape type="sphere" id="moon"/>'
    scene = read(tmp_path, f'{file}<shape type="sphere"/>{named}<shape type="sphere"/>{file}')
    assert [mesh.name for mesh in scene.meshes] == ["ball", "sphere", "moon", "sphere 2", "ball 2"]
    assert [mesh.groups for mesh in scene.meshes] == [("ball",), ("sphere",), ("sphere",), ("sphere",), ("ball",)]


@pytest.mark.parametrize("name", ["no.png", "no.exr"])
def test_a_missing_texture_is_named_with_its_scene(tmp_path, name):
    texture = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
    with pytest.raises(BokehguideError, match=rf"scene\.xml: bitmap \d+\.filename: .*{name}: no such file \(texture\)"):
        read(tmp_path, f'<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>')


def test_properties_of_an_unknown_name_are_told(tmp_path):
    texture = '<texture type="checkerboard" name="reflectanc"/>'
    body = (
        '<shape type="sphere" id="ball"><float name="radus" value="1"/><float name="halo" value="1"/>'
        f'<bsdf type="diffuse">{texture}</bsdf></shape>'
        '<shape type="cube"><bsdf type="roughconductor"><float name="alfa" value="0.2"/></bsdf></shape>'
    )
    sensor = SENSOR.replace('name="fov"', 'name="fovv"').replace('name="width"', 'name="widht"')
    lines = [line for line in read(tmp_path, body, sensor).warnings if "unknown name" in line]
    (line,) = lines
    assert line.startswith("scene.xml: parameters of an unknown name: ignored (")
    found = {
        (plugin.type, key, near)
        for plugin, key, near in unknown_properties(read_tree(tmp_path / "scene.xml", SceneFiles(tmp_path)))
    }
    assert found == {
        *(("thinlens", "fovv", "fov"), ("hdrfilm", "widht", "width"), ("sphere", "radus", "radius"), ("sphere", "halo", "")),
        *(("diffuse", "reflectanc", "reflectance"), ("roughconductor", "alfa", "alpha")),
    }


def test_nested_plugins_may_have_any_name(tmp_path):
    """Names of nested plugins count where they are textures of a BSDF alone."""
    Image.new("RGB", (2, 2), (128, 128, 255)).save(tmp_path / "n.png")
    texture = '<texture type="bitmap" name="ripples"><string name="filename" value="n.png"/></texture>'
    inner = f'<bsdf name="coat" type="bumpmap"><bsdf name="base" type="diffuse"/>{texture}</bsdf>'
    other = '<bsdf type="hair" id="h"><float name="x" value="1"/></bsdf>'
    scene = read(tmp_path, f'<shape type="sphere">{inner}<emitter name="glow" type="area"/></shape>{other}')
    assert not any("unknown name" in line for line in scene.warnings)


REQUIRED = {
    "thinlens": {"aperture_radius": 0.1, "fov": 40.0},
    "perspective": {"fov": 40.0},
    **{kind: {"inner": {"type": "diffuse"}} for kind in ("twosided", "mask")},
}


UNCHECKED = {"obj", "ply", "serialized", "bitmap", "envmap", "normalmap", "bumpmap", "roughdiffuse"}
"""Plugins that need files or textures, and one that Mitsuba 3.9 does not have."""
OURS = {("sphere", "face_normals"), ("disk", "face_normals")}
"""Properties that Mitsuba reads of other shapes only, and bokehguide of all."""


@pytest.mark.parametrize("kind", sorted(PROPERTIES.keys() - UNCHECKED))
def test_properties_are_mitsubas(kind):
    """Mitsuba refuses properties that a plugin does not ask for."""
    for key in (key for key in PROPERTIES[kind] if (kind, key) not in OURS):
        given = {key: 0.5} | REQUIRED.get(kind, {})
        try:
            mi.load_dict({"type": kind} | given)
        except RuntimeError as error:
            assert "unreferenced" not in str(error), (kind, key)


def test_the_command(tmp_path, capsys):
    path = written(tmp_path, '<shape type="sphere"/><emitter type="constant"/>')
    out = tmp_path / "a.exr"
    assert main(["render", str(path), "--spp", "1", "--threads", "1", "--mode", "uniform", "--out", str(out)]) == 0
    assert out.exists() and replace(load_scene(str(path)), warnings=()).film.width == 32


def test_anisotropic_materials_come_back(tmp_path):
    materials = (
        Material("brushed", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.5, anisotropy=0.7),
        Material("extreme", metallic=1.0, roughness=0.1, anisotropy=1.0),
    )
    meshes = tuple(spheres(np.array([[number, 0.0, 0.0]]), np.array([0.4]), number, 1) for number in range(2))
    scene = Scene("brushed", Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0)), meshes, materials, FilmSettings(8, 8))
    assert any("anisotropy" in line and "extreme" in line and "brushed" not in line for line in export_mitsuba(scene, tmp_path))
    back = load_scene(str(tmp_path / "scene.xml"))
    found = back.materials[back.meshes[0].material]
    assert (found.roughness, found.anisotropy) == pytest.approx((0.5, 0.7), abs=1e-4)


@pytest.mark.parametrize("u, v", [(0.5, 0.2), (0.1, 0.6)])
def test_microfacets_are_mitsubas(tmp_path, u, v):
    """D and G₁ of anisotropic GGX, at the α along u and v of a rough conductor."""
    alphas = f'<float name="alpha_u" value="{u}"/><float name="alpha_v" value="{v}"/>'
    scene = read(tmp_path, f'<shape type="sphere"><bsdf type="roughconductor">{alphas}</bsdf></shape>')
    metal = scene.materials[scene.meshes[0].material]
    most, least = to_alphas(metal.roughness, metal.anisotropy)
    assert (most, least) == pytest.approx((max(u, v), min(u, v))) and metal.anisotropy_rotation == (0.0 if u > v else 90.0)
    half = np.random.default_rng(0).normal(size=(3, 200)) + [[0.0], [0.0], [1.5]]
    half = torch.from_numpy(half[:, half[2] > 0.1] / np.linalg.norm(half[:, half[2] > 0.1], axis=0)).float()
    along, across = torch.full_like(half[0], most), torch.full_like(half[0], least)
    theirs = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, most, least, False)
    vectors = [mi.Vector3f(*map(float, column)) for column in half.T]
    density = [np.array(theirs.eval(vector)).item() for vector in vectors]
    np.testing.assert_allclose(ggx_density(half, across, along).numpy(), density, rtol=1e-3)
    masking = [np.array(theirs.smith_g1(vector, mi.Vector3f(0.0, 0.0, 1.0))).item() for vector in vectors]
    root = ((along * half[0]).square() + (across * half[1]).square() + half[2].square()).sqrt()
    np.testing.assert_allclose((2.0 * half[2] / (half[2] + root)).numpy(), masking, rtol=1e-3)


@pytest.mark.parametrize("kind", ["sphere", "rectangle", "disk", "cube", "cylinder"])
def test_texture_coordinates_are_mitsubas(tmp_path, kind):
    scene = read(tmp_path, f'<shape type="{kind}"/>')
    mesh, generator = scene.meshes[0], np.random.default_rng(0)
    chosen = mesh.triangles[generator.integers(len(mesh.triangles), size=60)]
    weights = generator.dirichlet((1.0, 1.0, 1.0), 60)
    corners = mesh.vertices[chosen]
    points, uvs = np.einsum("nc,ncx->nx", weights, corners), np.einsum("nc,ncx->nx", weights, mesh.uvs[chosen, 0])
    outside = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outside /= np.linalg.norm(outside, axis=1, keepdims=True)
    theirs = mi.load_dict({"type": "scene", "shape": {"type": kind}})
    for point, normal, uv in zip(points, outside, uvs):
        start = [float(value) for value in point + 0.5 * normal]
        found = theirs.ray_intersect(mi.Ray3f(mi.Point3f(*start), mi.Vector3f(*map(float, -normal))))
        difference = np.abs(np.array(found.uv).ravel() - uv)
        if kind == "sphere" and np.hypot(*point[:2]) < 0.2:
            continue  # u of flat triangles runs straight past the pole
        assert (np.minimum(difference, np.abs(1.0 - difference)) < 0.02).all(), (point, uv, found.uv)


TURNS = {
    "upright": '<rotate y="1" angle="70"/>',
    "z up": '<rotate y="1" angle="70"/><rotate x="1" angle="90"/>',
    "upside down": '<rotate x="1" angle="180"/><rotate y="1" angle="20"/>',
    "askew": '<rotate z="1" angle="25"/><rotate y="1" angle="130"/><rotate x="1" angle="-40"/>',
    "mirrored": '<scale x="-1"/><rotate y="1" angle="70"/>',
    "mirrored, z up": '<scale z="-1"/><rotate y="1" angle="-15"/><rotate x="1" angle="90"/>',
}


@pytest.mark.parametrize("turn", TURNS)
def test_maps_and_their_worlds_are_mitsubas(tmp_path, turn):
    """Light in the directions from the camera, whose place in the world is that of Mitsuba's. The map is smooth, as texels are
    half a texel apart in the two programs."""
    v, u = np.meshgrid(np.linspace(0.0, np.pi, 65), np.linspace(0.0, 2.0 * np.pi, 128, endpoint=False), indexing="ij")
    image = np.stack((2.0 + np.cos(v), 2.0 + np.sin(v) * np.sin(u), 2.0 + np.sin(v) * np.cos(u)), axis=2).astype(np.float32)
    write_exr(tmp_path / "map.exr", {"beauty": image})
    body = (
        '<emitter type="envmap"><string name="filename" value="map.exr"/>'
        f'<transform name="to_world">{TURNS[turn]}</transform></emitter>'
        '<emitter type="directional"><vector name="direction" x="1" y="2" z="3"/></emitter><shape type="rectangle">'
        '<transform name="to_world"><translate x="1" y="2" z="3"/></transform></shape>'
    )
    scene = read(tmp_path, body)
    emitters = mi.load_file(str(tmp_path / "scene.xml")).emitters()
    emitter = next(each for each in emitters if each.is_environment())
    matrix = np.array(mi.load_file(str(tmp_path / "scene.xml")).sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    ours = ThinLensCamera(scene.camera, scene.film.width, scene.film.height).axes.double().numpy()
    theirs = matrix[:3, :3] * (-1.0, 1.0, 1.0)  # Mitsuba's x points to the left
    world = ours @ theirs.T
    at, environment = mi.SurfaceInteraction3f(), EnvironmentLight(scene.environment)
    for direction in np.random.default_rng(4).normal(size=(40, 3)):
        direction /= np.linalg.norm(direction)
        at.wi = mi.Vector3f(*-direction)
        wanted = np.ravel(np.array(emitter.eval(at)))
        found = environment.radiance(torch.tensor((world @ direction)[:, None], dtype=torch.float32)).ravel().numpy()
        np.testing.assert_allclose(found, wanted, atol=0.04)
    np.testing.assert_allclose(scene.meshes[0].vertices.mean(axis=0), world @ (1, 2, 3), atol=1e-5)
    np.testing.assert_allclose(scene.suns[0].direction, -(world @ (1, 2, 3)) / np.sqrt(14.0), atol=1e-6)
    said = ["scene.xml: world: turned so that the environment map stands upright"]
    assert list(scene.supported) == ([] if turn in ("upright", "mirrored") else said)
    assert scene.warnings == ("scene.xml: directional lights: discs of 0.53° (directional)",)


def test_instances_of_groups_are_mitsubas(tmp_path):
    """Nearest hits of parallel rays, and the sides of the surfaces there."""
    body = (
        '<shape type="shapegroup" id="both"><shape type="sphere"><float name="radius" value="0.5"/></shape>'
        '<shape type="rectangle"><bsdf type="diffuse"><rgb name="reflectance" value="0.1 0.2 0.3"/></bsdf>'
        '<transform name="to_world"><translate x="2"/></transform></shape></shape>'
        '<shape type="instance"><ref id="both"/></shape>'
        '<shape type="instance"><ref id="both"/>'
        '<transform name="to_world"><scale x="-1" y="2"/><translate z="3"/></transform></shape>'
    )
    scene = read(tmp_path, body)
    assert scene.warnings == () and [mesh.name for mesh in scene.meshes] == ["sphere", "rectangle"]
    rectangle = scene.meshes[1]
    assert scene.materials[rectangle.material].base_color == pytest.approx((0.1, 0.2, 0.3))
    theirs = mi.load_file(str(tmp_path / "scene.xml"))
    rays = np.random.default_rng(5).uniform((-3.0, -2.0, -8.0), (3.0, 2.0, -6.0), (400, 3))
    tracer = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.triangles) for mesh in scene.meshes])
    ours = Tracer(tracer.vertices.astype(np.float32), tracer.faces.astype(np.int32))
    found = ours.intersect(torch.tensor(rays.T, dtype=torch.float32), torch.tensor([[0.0], [0.0], [1.0]]).expand(3, 400))
    depths, sides = [], []
    for origin in rays:
        hit = theirs.ray_intersect(mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(0.0, 0.0, 1.0)))
        depths.append(float(hit.t))
        sides.append(float(hit.n.z))
    hits, seen = np.isfinite(depths), found.triangle.numpy() >= 0
    assert hits.sum() > 100 and (hits == seen).mean() > 0.98
    both = hits & seen
    np.testing.assert_allclose(found.distance.numpy()[both], np.array(depths)[both], atol=0.05)
    normals = tracer.face_normals[found.triangle.numpy()[both], 2]
    assert (np.sign(normals) == np.sign(np.array(sides)[both])).mean() > 0.99


def test_folders_of_path_tags_come_first(tmp_path):
    """Of two files of one name, Mitsuba takes that of the last `<path>`."""
    for number, folder in enumerate((".", "first", "last"), 1):
        (tmp_path / folder).mkdir(exist_ok=True)
        trimesh.creation.box((number, number, number)).export(tmp_path / folder / "box.ply")
    trimesh.creation.box((7, 7, 7)).export(tmp_path / "first" / "other.ply")
    names = ("box.ply", "other.ply")
    body = '<path value="first"/><path value="last"/>' + "".join(
        f'<shape type="ply"><string name="filename" value="{name}"/></shape>' for name in names
    )
    path = written(tmp_path, body)
    sizes = [float(np.ptp(mesh.vertices, axis=0).max()) for mesh in load_scene(str(path)).meshes]
    theirs = [float(shape.bbox().extents().x) for shape in mi.load_file(str(path)).shapes()]
    assert sizes == pytest.approx([3.0, 7.0]) and sorted(theirs) == pytest.approx(sizes)


def test_folders_of_path_tags_lie_within_the_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    path = written(tmp_path / "inner", '<path value=".."/><shape type="sphere"/>')
    with pytest.raises(
        BokehguideError, match=r"<path>: '..' lies outside the scene's folder; copy it there, or give --allow-outside$"
    ):
        load_scene(str(path))


def test_an_undefined_parameter_has_a_remedy(tmp_path):
    path = written(tmp_path, '<shape type="sphere"><float name="radius" value="$size"/></shape>')
    with pytest.raises(BokehguideError, match=r'\$size\); add <default name="size" value="…"/> at the beginning of <scene>$'):
        load_scene(str(path))


@pytest.mark.parametrize("angles", ["", '<float name="cutoff_angle" value="60"/><float name="beam_width" value="20"/>'])
def test_spotlights_are_mitsubas(tmp_path, angles):
    """The same intensity on the axis, none beyond the cutoff, and the same flux: the falloffs between differ in form."""
    place = '<transform name="to_world"><lookat origin="1,2,3" target="4,1,5" up="0,1,0"/></transform>'
    body = f'<emitter type="spot">{place}{angles}<rgb name="intensity" value="5 4 3"/></emitter><shape type="rectangle"/>'
    scene = read(tmp_path, body)
    material, cone = scene.materials[-1], scene.materials[-1].emission_cone
    np.testing.assert_allclose(np.multiply(material.emission, np.pi * 0.01**2), (5.0, 4.0, 3.0), rtol=1e-5)
    np.testing.assert_allclose(scene.meshes[-1].vertices.mean(axis=0), (1, 2, 3), atol=2e-3)
    (light,) = mi.load_file(str(tmp_path / "scene.xml")).emitters()
    angle = np.radians(np.linspace(0.05, 89.95, 900))
    side = np.cross(cone.axis, (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    at, theirs = mi.SurfaceInteraction3f(), []
    for each in angle:
        at.p = mi.Point3f(*(np.array((1.0, 2.0, 3.0)) + np.cos(each) * np.array(cone.axis) + np.sin(each) * side))
        theirs.append(float(light.sample_direction(at, mi.Point2f(0.5, 0.5))[1][0]) / 5.0)
    low, high = np.cos(np.radians((cone.outer, cone.inner)))
    share = ((np.cos(angle) - low) / (high - low)).clip(0.0, 1.0)
    ours, theirs = share**2, np.array(theirs)
    assert not cone.smooth and cone.outer == (60.0 if angles else 20.0) and not theirs[angle > np.radians(cone.outer)].any()
    assert np.abs(ours - theirs).max() < 0.25  # the largest t - t²
    assert (ours * np.sin(angle)).sum() == pytest.approx((theirs * np.sin(angle)).sum(), rel=2e-3)


NINE = '<integrator type="path"><integer name="max_depth" value="9"/></integrator>'


@pytest.mark.parametrize(
    ("integrators", "depth"),
    [
        ("", 64),
        ('<integrator type="path"/>', 64),
        ('<integrator type="path"><integer name="max_depth" value="3"/></integrator>', 3),
        ('<integrator type="direct"/>', 2),
        (f'<integrator type="aov"><string name="aovs" value="d:depth"/>{NINE}</integrator>', 9),
    ],
)
def test_depths_of_integrators(tmp_path, integrators, depth):
    assert read(tmp_path, integrators + '<shape type="sphere"/>').film.max_depth == depth


def test_an_area_emitter_that_shapes_refer_to_is_no_loss(tmp_path):
    lamp = '<emitter type="area" id="lamp"><rgb name="radiance" value="3 2 1"/></emitter>'
    scene = read(tmp_path, lamp + '<shape type="rectangle"><ref id="lamp"/></shape>')
    assert scene.warnings == () and scene.materials[scene.meshes[0].material].emission == (3.0, 2.0, 1.0)


def test_media_are_told_and_their_boundaries_invisible(tmp_path):
    medium = '<medium type="homogeneous" name="interior"/>'
    body = (
        f'<shape type="sphere" id="fog"><bsdf type="null"/>{medium}</shape>'
        f'<shape type="sphere" id="bead"><bsdf type="dielectric"/>{medium}</shape>'
    )
    scene = read(tmp_path, body)
    assert [mesh.name for mesh in scene.meshes] == ["bead"] and scene.warnings == ("scene.xml: media: left out (fog, bead)",)


@pytest.mark.parametrize(("kind", "tolerance"), [("plastic", 2e-3), ("roughplastic", 0.05)])
def test_nonlinear_plastics_are_mitsubas(tmp_path, kind, tolerance):
    """Base colours over those of linear plastics are as the diffuse terms of Mitsuba, also of textures.

    The reflectance on the inside is that of a smooth surface, also of a rough one.
    """
    colors = ("0.9 0.4 0.1", "1 1 1")
    Image.fromarray(np.array([[[255, 188, 99]]], np.uint8)).save(tmp_path / "t.png")
    given = [f'<rgb name="diffuse_reflectance" value="{color}"/>' for color in colors]
    given.append('<texture name="diffuse_reflectance" type="bitmap"><string name="filename" value="t.png"/></texture>')
    at, away = mi.SurfaceInteraction3f(), mi.Vector3f(0.3, 0.1, 0.9)
    at.wi, at.uv = mi.Vector3f(-0.5, 0.2, 0.7), mi.Point2f(0.5, 0.5)
    for color in given:
        found, theirs = [], []
        for flag in ("", '<boolean name="nonlinear" value="true"/>'):
            scene = read(tmp_path, f'<shape type="sphere"><bsdf type="{kind}">{color}{flag}</bsdf></shape>')
            material = scene.materials[scene.meshes[0].material]
            texture = material.base_color_texture
            found.append(np.multiply(material.base_color, 1.0 if texture is None else texture.image[0, 0, :3]))
            bsdf = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
            diffuse = mi.BSDFContext()
            diffuse.type_mask = int(mi.BSDFFlags.DiffuseReflection)
            theirs.append(np.ravel(np.array(bsdf.eval(diffuse, at, away), np.float64)))
        np.testing.assert_allclose(found[1] / found[0], theirs[1] / theirs[0], rtol=tolerance)


def test_textures_of_roughness_and_metallic(tmp_path):
    """Luminances of images, packed as in glTF; the smaller image is repeated."""
    Image.fromarray(np.array([[0, 51], [102, 255]], np.uint8)).save(tmp_path / "rough.png")
    Image.fromarray(np.array([[[255, 0, 0]]], np.uint8)).save(tmp_path / "metal.png")
    file = '<string name="filename" value="{}.png"/><boolean name="raw" value="true"/>'
    bitmap = f'<texture type="bitmap" name="{{}}">{file}</texture>'
    names = ("roughness", "rough"), ("alpha", "rough"), ("metallic", "metal")
    rough, alpha, metal = (bitmap.format(*each) for each in names)
    values = np.array([[0.0, 0.2], [0.4, 1.0]])
    for kind, given, green, blue in (
        ("principled", rough + metal, values, 0.2126),
        ("principled", rough, values, 1.0),
        ("principled", metal, 1.0, 0.2126),
        ("roughconductor", alpha, np.sqrt(values), 1.0),
        ("roughplastic", alpha, np.sqrt(values), 1.0),
        ("roughdielectric", alpha, np.sqrt(values), 1.0),
    ):
        material, warnings = sole(tmp_path, f'<bsdf type="{kind}">{given}</bsdf>')
        image = material.metallic_roughness_texture.image
        np.testing.assert_allclose(image[..., 1], np.broadcast_to(green, image.shape[:2]), atol=1e-4)
        np.testing.assert_allclose(image[..., 2], np.broadcast_to(blue, image.shape[:2]), atol=1e-4)
        assert warnings == () and material.roughness == (1.0 if given != metal else 0.5)
        assert material.metallic == (1.0 if kind == "roughconductor" or metal in given else 0.0)
