"""The parts of the add-on for Blender that need no Blender. `make test-blender` runs the others."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import math
import runpy
import struct
import sys
import tomllib
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import bokehguide
from bokehguide.memory import free_memory
from bokehguide.scene.environments import load_environment_map
from tests.support.gltf_square import write_gltf
from tests.support.paths import REPOSITORY
from tests.support.scene_text import BOX_AND_EMITTER

FOLDER = REPOSITORY / "integrations" / "blender"
IDENTITY = np.eye(4).tolist()


@pytest.fixture
def addon(monkeypatch):
    """Imports a module of the add-on; the package itself would import bpy."""
    package = types.ModuleType("bokehguide_blender")
    package.__path__ = [str(FOLDER / "bokehguide_blender")]
    monkeypatch.setitem(sys.modules, "bokehguide_blender", package)
    yield lambda name: importlib.import_module(f"bokehguide_blender.{name}")
    for name in [name for name in sys.modules if name.startswith("bokehguide_blender.")]:
        del sys.modules[name]


def test_fields_of_view(addon):
    frame = addon("framing").frame
    horizontal = 2.0 * math.degrees(math.atan(18.0 / 50.0))
    assert frame(50.0, (36.0, 24.0), "AUTO", (96, 64)).fov == pytest.approx(horizontal)
    assert frame(50.0, (36.0, 24.0), "HORIZONTAL", (60, 100)).fov == pytest.approx(horizontal)
    # The sensor's width fits the longer side, the height of a portrait.
    assert frame(50.0, (36.0, 24.0), "AUTO", (60, 100)).fov == pytest.approx(2.0 * math.degrees(math.atan(18.0 / 50.0 * 0.6)))
    vertical = 2.0 * math.degrees(math.atan(12.0 / 50.0 * 1.5))
    assert frame(50.0, (36.0, 24.0), "VERTICAL", (96, 64)).fov == pytest.approx(vertical)
    assert not frame(50.0, (36.0, 24.0), "AUTO", (96, 64)).cropped


def test_shift_and_border(addon):
    framing = addon("framing").frame(50.0, (36.0, 24.0), "AUTO", (100, 60), (0.2, -0.1), (0.1, 0.5, 0.25, 1.0))
    assert framing.size == (140, 80)
    # The window begins 40 pixels to the right and 20 pixels below the frame's corner, and the border inside of the window.
    assert framing.window == (40 + 10, 20 + 0, 40, 45)
    assert math.tan(math.radians(framing.fov / 2.0)) == pytest.approx(18.0 / 50.0 * 1.4)
    assert framing.cropped


def test_a_projection_has_the_frame_of_its_camera(addon):
    """The matrix of a lens with a shift, as OpenGL defines it."""
    framing = addon("framing")
    slopes, shifts = (18.0 / 50.0, 18.0 / 50.0 * 0.6), (0.4, 2.0 * -0.1 / 0.6)
    matrix = [[1 / slopes[0], 0, shifts[0], 0], [0, 1 / slopes[1], shifts[1], 0], [0, 0, -1, -0.2], [0, 0, -1, 0]]
    found, back = framing.projected(matrix, (100, 60), 5.0)
    assert found == framing.frame(50.0, (36.0, 24.0), "AUTO", (100, 60), (0.2, -0.1))
    assert back == 0.0


def test_a_projection_without_perspective_is_seen_from_far_away(addon):
    matrix = [[1 / 2.0, 0, 0, 0.1], [0, 1 / 1.2, 0, 0], [0, 0, -0.02, -1], [0, 0, 0, 1]]
    found, back = addon("framing").projected(matrix, (100, 60), 5.0)
    # The plane 5 m from the viewport's camera keeps its half width of 2 m; the axis meets it 0.1 half widths to the right.
    distance = 5.0 + back
    assert distance == pytest.approx(200.0)
    per_pixel = 2.0 * distance * math.tan(math.radians(found.fov) / 2.0) / found.size[0]
    assert per_pixel == pytest.approx(4.0 / 100.0)
    assert found.window == (0, 0, 100, 60) and found.size == (110, 60)


@pytest.fixture
def preview(addon, tmp_path):
    """A running `preview_driver.py`, and a scene file."""
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER)
    with addon("process").Preview(sys.executable, tmp_path) as running:
        yield running


def view_of_box(tmp_path, **values):
    camera = {"position": [0.0, 0.0, 4.0], "target": [0.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0], "fov": 40.0, "aperture_radius": 0.1}
    view = {"scene": str(tmp_path / "box.toml"), "camera": camera, "size": [60, 40], "window": [10, 0, 50, 40]}
    return view | {"spp": 2, "seed": 3, "denoise": False, "transparent": False} | values


def until(running, key, **values):
    """The next message with a key and values."""
    while (message := running.message(60.0)) is not None:
        if key in message and values.items() <= message.items():
            return message
    pytest.fail(f"the process has ended: {running.failure()}")


def test_pictures_of_a_viewport(preview, tmp_path):
    view = view_of_box(tmp_path)
    preview.show(view)
    path = Path(until(preview, "picture", step=2)["picture"])
    scene = bokehguide.load_scene(view["scene"])
    camera = dataclasses.replace(scene.camera, aperture_radius=0.1, focus_distance=4.0)
    scene = dataclasses.replace(scene, camera=camera)
    expected = bokehguide.render(scene, spp=2, seed=3, size=(60, 40), crop=(10, 0, 50, 40), quiet=True)
    pixels = np.load(path)
    np.testing.assert_array_equal(pixels[::-1, :, :3], expected.beauty)
    assert pixels[..., 3].min() == 1.0
    preview.show(view_of_box(tmp_path, seed=4))
    until(preview, "picture", step=2)
    assert not path.exists()  # nobody has read the picture
    assert len(list(tmp_path.glob("*.npy"))) == 1


def test_a_viewport_tells_mistakes_and_goes_on(preview, tmp_path):
    preview.show(view_of_box(tmp_path, scene=str(tmp_path / "missing.toml")))
    assert "missing.toml" in until(preview, "failure")["failure"]
    view = view_of_box(tmp_path)
    preview.show(view | {"camera": view["camera"] | {"fov": 500.0}})
    assert "fov" in until(preview, "failure")["failure"]
    preview.show(view)
    until(preview, "picture", step=2)


def test_the_end_of_stdin_ends_a_viewport(preview, tmp_path):
    preview.show(view_of_box(tmp_path, spp=100_000))
    until(preview, "picture")
    preview._process.stdin.close()
    while preview.message(20.0):
        pass
    assert preview.failure() is None


def test_aperture_radius(addon):
    assert addon("framing").aperture_radius(50.0, 2.0) == pytest.approx(0.0125)


def lit_scene(addon, tmp_path, **tables):
    """A scene of a file that holds tables of lights."""
    camera = {"position": (0.0, 0.0, 5.0), "target": (0.0, 0.0, 0.0)}
    path = tmp_path / "scene.toml"
    path.write_text(addon("toml_text").dumps({"camera": camera, **tables}), encoding="utf-8")
    return bokehguide.load_scene(path)


def test_radiance_of_lights(addon, tmp_path):
    tables, color = addon("light_tables"), (1.0, 0.5, 0.2)
    stretched = np.diag([2.0, 1.0, 1.0, 1.0]).tolist()
    lights = [
        tables.point('a "point"\n', IDENTITY, color, 100.0, 0.3),
        tables.spot("spot", IDENTITY, color, 100.0, 0.3, math.radians(60.0), 0.5, True),
        tables.area("area", stretched, color, 100.0, "SQUARE", (0.5, 9.0), True),
        tables.area("ellipse", IDENTITY, color, 100.0, "ELLIPSE", (0.5, 0.4), True),
        tables.area("disk not normalised", stretched, color, 100.0, "DISK", (0.5, 9.0), False),
        tables.point("point not normalised", IDENTITY, color, 100.0, 0.3, False),
    ]
    materials = lit_scene(addon, tmp_path, light=lights).materials
    sphere = 100.0 / (4.0 * math.pi**2 * 0.3**2)
    areas = [0.5, 0.25 * math.pi * 0.2]
    flat = [100.0 / (math.pi * area) for area in areas]
    for material, radiance in zip(materials, (sphere, sphere, *flat, 100.0 / math.pi, 100.0 / math.pi)):
        np.testing.assert_allclose(material.emission, np.array(color) * radiance, rtol=0.01)
    cone = materials[1].emission_cone
    assert (cone.axis, cone.smooth) == ((0.0, -1.0, 0.0), True)
    assert math.cos(math.radians(cone.inner)) == pytest.approx(0.5 * (1.0 + math.cos(math.radians(30.0))))


def test_a_hard_spot_and_a_light_without_size_are_valid(addon, tmp_path):
    tables = addon("light_tables")
    spot = tables.spot("spot", IDENTITY, (1.0, 1.0, 1.0), 5.0, 0.0, math.pi, 0.0, True)
    scene = lit_scene(addon, tmp_path, light=[spot])
    assert scene.materials[0].emission_cone.outer == pytest.approx(90.0)


def test_sun(addon, tmp_path):
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # Blender's -z axis, along which a sun shines, becomes -Y
    tables = addon("light_tables")
    bulb, sun = tables.point("bulb", IDENTITY, (1.0, 1.0, 1.0), 1.0, 0.1), tables.sun(matrix.tolist(), (1.0, 0.5, 0.0), 3.0, 0.0)
    sun = lit_scene(addon, tmp_path, light=[bulb], sun=[sun]).suns[0]
    np.testing.assert_allclose(sun.direction, (0.0, 0.0, -1.0), atol=1e-12)
    assert (sun.irradiance, sun.angle) == ((3.0, 1.5, 0.0), 0.01)


def test_text_of_a_scene_file(addon):
    tables = {"a": {"text": 'é\\ "\n\x7f', "flag": True, "number": 1e-7, "inner": {"list": [1, 2.5]}}, "b": [{"x": 1}, {"x": 2}]}
    assert tomllib.loads(addon("toml_text").dumps(tables)) == tables
    with pytest.raises(TypeError):
        addon("toml_text").dumps({"a": {"x": None}})


def test_map(addon, tmp_path):
    colors = np.random.default_rng(1).lognormal(0.0, 3.0, (8, 16, 3)).astype(np.float32)
    colors[0, 0] = 0.0
    addon("radiance_hdr").write_hdr(tmp_path / "map.hdr", colors)
    read, warnings = load_environment_map(tmp_path / "map.hdr")
    assert not warnings
    assert (np.abs(np.asarray(read) - colors) <= 0.004 * colors.max(axis=2, keepdims=True)).all()


def test_transmission_is_solid(addon, tmp_path):
    transmission = {"KHR_materials_transmission": {"transmissionFactor": 1.0}}
    write_gltf(tmp_path / "glass.gltf", {"extensions": transmission}, extensionsUsed=list(transmission))
    text = (tmp_path / "glass.gltf").read_bytes()
    text += b" " * (-len(text) % 4)
    path = tmp_path / "glass.glb"
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    assert bokehguide.load_scene(path).materials[0].thin
    assert addon("glb").complete_glb(path, {}, {})
    assert not bokehguide.load_scene(path).materials[0].thin
    before = path.read_bytes()
    assert addon("glb").complete_glb(path, {}, {})
    assert path.read_bytes() == before


def test_planes(addon):
    normal = np.zeros((2, 1, 3), np.float32)
    normal[0, 0] = (1.0, 2.0, 3.0)  # the top row, y up
    zero = np.zeros((2, 1), np.float32)
    layers = {"beauty": np.stack([zero + 0.25] * 3, -1), "alpha": zero + 0.5, "depth": zero, "normal": normal, "albedo": normal}
    planes = addon("passes").planes_of(layers)
    np.testing.assert_array_equal(planes["Normal"], [0.0, 0.0, 0.0, 1.0, -3.0, 2.0])
    np.testing.assert_array_equal(planes["Combined"], [0.25, 0.25, 0.25, 0.5] * 2)
    assert addon("passes").planes_of(layers | {"denoised": normal})["Combined"][4] == 1.0
    assert addon("passes").planes_of(layers, opaque=True)["Combined"][3] == 1.0


def test_passes_of_mattes_and_light_groups(addon):
    plane = np.arange(8, dtype=np.float32).reshape(2, 1, 4)
    zero = np.zeros((2, 1, 3), np.float32)
    layers = {"beauty": zero, "alpha": zero[..., 0], "depth": zero[..., 0], "normal": zero, "albedo": zero}
    layers |= {"CryptoObject00": plane, "group_0": zero + 0.5, "ungrouped": zero}
    planes = addon("passes").planes_of(layers, light_groups=addon("light_groups").LightGroups(["key light"]).passes)
    np.testing.assert_array_equal(planes["CryptoObject00"], [4.0, 5.0, 6.0, 7.0, 0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(planes["Combined_key light"], [0.5] * 6)
    assert set(planes) == {"Combined", "Depth", "Normal", "Albedo", "CryptoObject00", "Combined_key light"}


def test_materials_are_replaced_by_name(addon, tmp_path):
    glb, path = addon("glb"), tmp_path / "geometry.glb"
    document = {"meshes": [{}], "materials": [{"name": "clay", "doubleSided": True}, {"name": "other"}, {"name": "glass"}]}
    glb.write_glb(path, document, b"rest")
    glass = {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1.0}}}
    assert glb.complete_glb(path, {"clay": {"alphaMode": "MASK"}, "glass": glass}, {})
    found, rest = glb.read_glb(path)
    assert rest == b"rest"
    assert found["materials"][0] == {"name": "clay", "doubleSided": True, "alphaMode": "MASK"}
    assert found["materials"][1] == {"name": "other"}
    assert found["materials"][2]["extensions"]["KHR_materials_volume"] == {"thicknessFactor": 1.0}
    assert found["extensionsUsed"] == ["KHR_materials_transmission", "KHR_materials_volume"]


def test_png(addon):
    colors = np.random.default_rng(2).integers(0, 256, (5, 7, 3), np.uint8)
    with Image.open(io.BytesIO(addon("png").png(colors))) as image:
        np.testing.assert_array_equal(np.asarray(image), colors)


def test_textures_are_replaced(addon):
    glb = addon("glb")
    document = {
        "materials": [{"name": "a", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}, {"name": "b"}],
        "textures": [{"source": 0, "sampler": 3}],
        "images": [{"bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 4}],
        "buffers": [{"byteLength": 4}],
    }
    rest = glb.CHUNK.pack(4, b"BIN\0") + b"mesh"
    files = {"a": {"baseColorTexture": b"12345"}, "b": {"emissiveTexture": b"6"}}
    replaced, changed = glb.replace_textures(document, rest, files)
    assert changed
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 1, "texCoord": 1}
    assert document["textures"][1] == {"source": 1, "sampler": 3}
    view = document["bufferViews"][document["images"][1]["bufferView"]]
    start = glb.CHUNK.size + view["byteOffset"]
    assert replaced[start : start + view["byteLength"]] == b"12345"
    assert document["buffers"][0]["byteLength"] == len(replaced) - glb.CHUNK.size == 12
    assert glb.replace_textures(document, rest, {}) == (rest, False)


def test_split_of_light_groups(addon, tmp_path):
    """Emissive nodes of a group stand in a file of their own, all others stay."""
    glb, path = addon("glb"), tmp_path / "geometry.glb"
    document = {
        "materials": [{"emissiveFactor": [1.0, 0.0, 0.0]}, {}],
        "meshes": [{"primitives": [{"material": 0}]}, {"primitives": [{"material": 1}]}],
        "nodes": [{"name": "sign", "mesh": 0, "children": [1]}, {"name": "wall", "mesh": 1}, {"name": "lamp", "mesh": 0}],
    }
    glb.write_glb(path, document, b"rest")
    files = glb.split_glb(path, {"sign": "group_0", "wall": "group_0"})
    assert set(files) == {"", "group_0"}
    contents = {group: glb.read_glb(file) for group, file in files.items()}
    assert all(rest == b"rest" for _, rest in contents.values())
    kept = {group: [node["name"] for node in found["nodes"] if "mesh" in node] for group, (found, _) in contents.items()}
    assert kept == {"": ["wall", "lamp"], "group_0": ["sign"]}
    assert contents["group_0"][0]["nodes"][0]["children"] == [1]
    glb.write_glb(path, document, b"")
    assert glb.split_glb(path, {"wall": "group_0"}) == {"": path}


@pytest.fixture
def quick(addon, tmp_path):
    """The process module, and a job with some samples of a small scene."""
    light = addon("light_tables").point("bulb", IDENTITY, (1.0, 1.0, 1.0), 100.0, 0.3)
    lit_scene(addon, tmp_path, light=[light], film={"width": 24, "height": 16})
    return addon("process"), lambda **options: (
        sys.executable,
        tmp_path / "scene.toml",
        tmp_path,
        "Layer",
        {"spp": 3, "seed": 1} | options,
    )


def messages(render):
    """All messages of a render."""
    return list(iter(lambda: render.message(60.0), None))


def test_driver(quick, tmp_path):
    process, job = quick
    with process.Render(*job()) as render:
        told = messages(render)
        assert render.failure() is None
    assert not any("error" in message for message in told), told
    pictures = [message["picture"] for message in told if "picture" in message]
    expected = bokehguide.render(tmp_path / "scene.toml", spp=3, seed=1, quiet=True)
    with np.load(pictures[-1]) as layers:
        np.testing.assert_array_equal(layers["beauty"], expected.beauty)
        np.testing.assert_array_equal(layers["depth"], expected.depth)
    assert any("step" in message and message["of"] == 3 for message in told)


def test_mattes_of_the_driver(quick, tmp_path):
    """The metadata name the layers as Cycles does, under the hash of these names."""
    hashes = pytest.importorskip("mmh3")
    process, job = quick
    with process.Render(*job(cryptomatte=True)) as render:
        told = messages(render)
    metadata = next(message["metadata"] for message in told if "metadata" in message)
    for kind in ("Object", "Material"):
        key = f"cryptomatte/{hashes.hash(f'Layer.Crypto{kind}'.encode(), 0, signed=False):08x}"[:-1]
        assert metadata[f"{key}/name"] == f"Layer.Crypto{kind}"
        assert metadata[f"{key}/hash"] == "MurmurHash3_32"
        assert "bulb" in json.loads(metadata[f"{key}/manifest"])
    with np.load([message["picture"] for message in told if "picture" in message][-1]) as layers:
        assert {"CryptoObject00", "CryptoObject02", "CryptoMaterial00"} <= set(layers)


def test_errors_of_the_driver(quick, tmp_path):
    process, job = quick
    (tmp_path / "scene.toml").write_text("[camera]\nposition = 1\n", encoding="utf-8")
    with process.Render(*job()) as render:
        told = messages(render)
    assert next(message["error"] for message in told if "error" in message).startswith("camera.target: missing")


def test_too_large_pictures_of_the_driver(quick, tmp_path):
    """A picture that bokehguide refuses, and one that the memory does not hold."""
    process, job = quick
    path = tmp_path / "scene.toml"
    text = path.read_text(encoding="utf-8")
    assert "width = 24\nheight = 16\n" in text
    for side, reason in ((65536, "are too many"), (16384, "lower the resolution")):
        if side == 16384 and (free_memory() or math.inf) > 60e9:
            continue
        path.write_text(text.replace("width = 24\nheight = 16", f"width = {side}\nheight = {side}"), encoding="utf-8")
        with process.Render(*job()) as render:
            told = messages(render)
        assert reason in next(message["error"] for message in told if "error" in message)


def test_end_of_a_running_render(quick):
    process, job = quick
    with process.Render(*job(spp=65536)) as render:
        while "step" not in (render.message(60.0) or {}):
            pass
        assert render.running
    assert not render.running


@pytest.mark.parametrize("python, message", [("", "press Install"), ("/nowhere/python", "no such Python interpreter")])
def test_missing_interpreter(quick, python, message):
    process, job = quick
    with pytest.raises(process.ProcessError, match=message):
        process.Render(python, *job()[1:])


def test_failed_installation(addon, tmp_path):
    installer, process = addon("installer"), addon("process")
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho no space left\nexit 1\n")
    fake.chmod(0o755)
    lines: list[str] = []
    with pytest.raises(process.ProcessError, match="installation failed: no space left"):
        installer.install(str(fake), tmp_path / "environment", "somewhere", lines.append)
    assert lines == ["no space left"]
    with pytest.raises(process.ProcessError, match="name the folder of its repository"):
        installer.chosen_source("")


def test_extension(tmp_path):
    path = runpy.run_path(str(FOLDER / "build.py"))["main"](tmp_path)
    with zipfile.ZipFile(path) as archive:
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert manifest["version"] == bokehguide.__version__
        assert {"__init__.py", "engine.py", "driver.py", "LICENSE"} <= set(archive.namelist())
        (tmp_path / "source.zip").write_bytes(archive.read("bokehguide-source.zip"))
    with zipfile.ZipFile(tmp_path / "source.zip") as sources:
        packed = {name.split("/", 1)[1] for name in sources.namelist()}
    modules = {str(file.relative_to(REPOSITORY)) for file in Path(bokehguide.__file__).parent.rglob("*.py")}
    assert modules | {"pyproject.toml", "native/CMakeLists.txt", "native/core.cpp", "bokehguide/view/page/app.js"} <= packed
