"""Limits of untrusted scenes: files in their own folder, and the total size of images."""

import io
import json
import os
import struct
import zlib

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_VALUES
from bokehguide.scene import load_scene, validation
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from tests.support.gltf_builder import UVS, simple
from tests.support.scene_text import BOX_AND_EMITTER

TEXTURE = ("base_color = [0.5, 0.4, 0.3]", 'base_color_texture = "{}"')
MODEL = ('shape = "box"', 'file = "{}"')
MAP = ("color = [0.02, 0.03, 0.05]", 'map = "{}"')
MASK = ("[film]", '[camera.aperture]\nimage = "{}"\n[film]')


@pytest.fixture
def folder(tmp_path):
    """A scene's folder with the kinds of files that a scene names. A sibling folder holds the same files."""
    for part in ("outside", "scene", "scene/parts"):
        (tmp_path / part).mkdir()
        Image.new("RGB", (2, 2), (188, 188, 188)).save(tmp_path / part / "wood.png")
        OpenEXR.File({}, {"RGB": np.ones((2, 4, 3), np.float32)}).write(str(tmp_path / part / "sky.exr"))
        simple().save(tmp_path / part / "square.glb")
    return tmp_path / "scene"


def scene_file(folder, change: tuple[str, str], name: str):
    path = folder / "scene.toml"
    path.write_text(BOX_AND_EMITTER.replace(change[0], change[1].format(name), 1))
    return path


def refused(path, named: str) -> None:
    with pytest.raises(BokehguideError) as refusal:
        load_scene(str(path))
    text = str(refusal.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    assert f"{named} lies outside the scene's folder; copy it there, or give --allow-outside" in text


@pytest.mark.parametrize("kind", ["texture", "map", "ply", "glb"])
def test_files_beyond_the_free_memory_are_refused_before_they_take_it(folder, monkeypatch, kind):
    """A free memory of 100 MB stands for the machine's."""
    size = 2**26
    if kind == "texture":  # from a file of 16 kB
        path, change, size = folder / "large.png", TEXTURE, 6 * 4 * 4096 * 4096
        Image.new("L", (4096, 4096)).save(path)
    elif kind == "map":
        path, change, size = folder / "large.exr", MAP, 4 * 3 * 4096 * 4096
        OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION}, {"RGB": np.ones((4096, 4096, 3), np.float16)}).write(str(path))
    else:
        path, change = folder / f"large.{kind}", MODEL
        with path.open("wb") as file:
            file.truncate(size)
        size *= 2
    scene = scene_file(folder, change, path.name)
    monkeypatch.setattr("bokehguide.memory.free_memory", lambda: 10**8)
    monkeypatch.setattr("bokehguide.scene.images._texels", lambda *_: pytest.fail("was decoded"))
    what = "image" if kind in ("texture", "map") else "file"
    told = rf"takes about {size / 1e9:.1f} GB of memory, and 0\.1 GB are free; give a smaller {what}$"
    with pytest.raises(BokehguideError, match=told) as refusal:
        load_scene(str(scene))
    assert "\n" not in str(refusal.value) and str(refusal.value).startswith(str(folder))


@pytest.mark.parametrize(("change", "file"), [(TEXTURE, "wood.png"), (MASK, "wood.png"), (MAP, "sky.exr"), (MODEL, "square.glb")])
def test_paths_of_a_scene_file_stay_in_its_folder(folder, change, file):
    (folder / "link").symlink_to(folder.parent / "outside")
    (folder / f"linked-{file}").symlink_to(folder.parent / "outside" / file)
    inside = (file, f"parts/{file}", f"parts/../{file}", str(folder / file))
    for name in inside:
        load_scene(str(scene_file(folder, change, name)))
    for name in (f"../outside/{file}", str(folder.parent / "outside" / file), f"link/{file}", f"linked-{file}"):
        path = scene_file(folder, change, name)
        refused(path, repr(name))
        load_scene(str(path), allow_outside=True)
    refused(scene_file(folder, change, f"../nothing-{file}"), repr(f"../nothing-{file}"))


@pytest.mark.parametrize(
    "uri",
    [
        "../outside/square.bin",
        "%2e%2e/outside/square.bin",
        "..%2Foutside%2Fsquare.bin",
        "{outside}/square.bin",
        "link/square.bin",
    ],
)
def test_uris_of_a_gltf_file_stay_in_its_folder(folder, uri):
    (folder / "link").symlink_to(folder.parent / "outside")
    uri = uri.format(outside=folder.parent / "outside")
    path = gltf(folder, uri, folder.parent / "outside")
    with pytest.raises(BokehguideError, match=r"buffers\[0\].uri: .* lies outside the scene's folder; copy it there"):
        load_scene(str(path))
    load_scene(str(path), allow_outside=True)


@pytest.mark.parametrize("uri", ["file:///etc/hostname", "http://localhost/a.bin", "gone.bin"])
def test_other_schemes_are_file_names(folder, uri):
    with pytest.raises(BokehguideError, match=r"buffers\[0\].uri: .* is no file beside the model"):
        load_scene(str(gltf(folder, uri, folder)), allow_outside=True)


def gltf(folder, uri, place):
    """A square as .gltf in `folder`, its .bin in `place` under the name square.bin, and said to be at `uri`."""
    builder = simple()
    (place / "square.bin").write_bytes(builder.data)
    builder.save(folder / "square.gltf")
    document = json.loads((folder / "square.gltf").read_text())
    document["buffers"][0]["uri"] = uri
    (folder / "square.gltf").write_text(json.dumps(document))
    return folder / "square.gltf"


def test_a_models_own_files_may_be_anywhere_in_the_scenes_folder(folder):
    """The folder is the scene's, not the model's; alone, the model has but its own."""
    model = gltf(folder / "parts", "../square.bin", folder)
    load_scene(str(scene_file(folder, MODEL, "parts/square.gltf")))
    with pytest.raises(BokehguideError, match="lies outside"):
        load_scene(str(model))


def test_images_of_a_gltf_file_stay_in_its_folder(folder):
    builder = simple(TEXCOORD_0=UVS, material=0)
    builder.material({"baseColorTexture": {"index": builder.texture(b"")}})
    builder.save(folder / "a.gltf")
    document = json.loads((folder / "a.gltf").read_text())
    for uri, found in (("wood.png", True), ("../outside/wood.png", False)):
        document["images"] = [{"uri": uri}]
        (folder / "a.gltf").write_text(json.dumps(document))
        if found:
            load_scene(str(folder / "a.gltf"))
        else:
            with pytest.raises(BokehguideError, match=r"images\[0\].uri: '../outside/wood.png' lies outside"):
                load_scene(str(folder / "a.gltf"))


OBJ = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl wood\nf 1/1 2/2 3/3\n"


def obj(folder, library: str, image: str):
    (folder / "m.obj").write_text(OBJ.format(library))
    for place in (folder, folder.parent / "outside"):
        (place / "m.mtl").write_text(f"newmtl wood\nKd 1 1 1\nmap_Kd {image}\n")
    return folder / "m.obj"


@pytest.mark.slow
def test_an_objs_materials_and_images_stay_in_its_folder(folder):
    for name in ("{}", "./{}", "/home/someone/{}", "..\\else\\{}"):  # of another disk: looked for beside the model
        scene = load_scene(str(obj(folder, name.format("m.mtl"), name.format("wood.png"))))
        assert scene.materials[0].base_color_texture is not None, name
    (folder.parent / "outside/other.png").write_bytes((folder / "wood.png").read_bytes())
    (folder.parent / "outside/other.mtl").write_text("newmtl wood\nKd 1 0 0\n")
    for library, image, named in (("../outside/other.mtl", "", "other.mtl"), ("m.mtl", "../outside/other.png", "other.png")):
        path = obj(folder, library, image)
        refused(path, f"'../outside/{named}'")
        load_scene(str(path), allow_outside=True)


@pytest.mark.slow
def test_a_ply_without_its_image(folder, bokehguide):
    """trimesh would log a traceback, and make an image of its own."""
    header = "ply\nformat ascii 1.0\ncomment TextureFile gone.png\nelement vertex 3\n"
    properties = "".join(f"property float {name}\n" for name in "xyzst")
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n3 0 1 2\n"
    (folder / "a.ply").write_text(header + properties + faces)
    finished = bokehguide("info", folder / "a.ply")
    assert finished.returncode == 0 and finished.stderr == ""
    assert "a.ply: gone.png: no such file; left out" in finished.stdout
    assert load_scene(str(folder / "a.ply")).materials[0].base_color_texture is None


def test_missing_files_of_an_obj_cause_warnings(folder):
    scene = load_scene(str(obj(folder, "m.mtl", "gone.png")))
    assert "m.obj: gone.png: no such file; left out" in scene.warnings


@pytest.mark.parametrize("name", ["x" * 5000, "a\\u0000b", "loop/a"])
def test_a_name_that_is_no_path(folder, name):
    (folder / "loop").symlink_to(folder / "loop")
    for change in (TEXTURE, MODEL, MAP, MASK):
        with pytest.raises(BokehguideError) as refusal:
            load_scene(str(scene_file(folder, change, f"{name}.exr" if change is MAP else name)))
        assert str(refusal.value).isprintable() and len(str(refusal.value)) < 500


@pytest.mark.parametrize(("change", "file"), [(TEXTURE, "pipe.png"), (MAP, "pipe.hdr"), (MODEL, "pipe.glb"), (MODEL, "pipe.obj")])
def test_a_pipe_keeps_nobody_waiting(folder, change, file):
    os.mkfifo(folder / file)
    with pytest.raises(BokehguideError, match=r"pipe\.\w+: is no regular file"):
        load_scene(str(scene_file(folder, change, file)))


SMALL = ("--spp", 1, "--size", "8x5", "--out", "a.exr")
COMMANDS = [("info",), ("render", *SMALL), ("compare", *SMALL, "--modes", "uniform", "--reference-spp", 2)]


@pytest.mark.slow
@pytest.mark.parametrize("arguments", COMMANDS)
def test_the_command_lines_way_to_allow_it(folder, bokehguide, arguments):
    command, *options = arguments
    path = scene_file(folder, TEXTURE, "../outside/wood.png")
    finished = bokehguide(command, path, *options)
    assert finished.returncode == 2 and "lies outside the scene's folder" in finished.stderr
    finished = bokehguide(command, path, *options, "--allow-outside")
    assert finished.returncode == 0, finished.stderr


def bomb(side: int, depth: int = 8) -> bytes:
    """A valid black PNG of side × side grey pixels. It takes a thousandth of its decoded size."""
    packer = zlib.compressobj(9)
    row = bytes(1 + (side * depth + 7) // 8)
    data = b"".join([packer.compress(row) for _ in range(side)] + [packer.flush()])
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", side, side, depth, 0, 0, 0, 0)), (b"IDAT", data), (b"IEND", b""))
    packed = (struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize("depth", [1, 8, 16])
def test_a_small_file_with_a_huge_image_is_rejected(tmp_path, depth):
    (tmp_path / "bomb.png").write_bytes(bomb(9000, depth))
    assert (tmp_path / "bomb.png").stat().st_size < 1_000_000
    with pytest.raises(
        BokehguideError, match=r"bomb\.png: the scene's images would decode from [\d,]+ bytes to 324,000,000 values"
    ):
        load_texture(tmp_path / "bomb.png", SceneFiles(tmp_path), srgb=True)


def test_many_images_that_are_huge_together_are_rejected(tmp_path):
    files, count = SceneFiles(tmp_path), 0
    with pytest.raises(BokehguideError, match="would decode"):
        while count < 200:
            (tmp_path / "a.png").write_bytes(bomb(1024, 1) + str(count).encode())
            load_texture(tmp_path / "a.png", files, srgb=True)
            count += 1
    assert 1024 * 1024 * 4 * count <= MAX_VALUES < 1024 * 1024 * 4 * (count + 2)


def test_an_image_that_many_textures_name_is_decoded_once(tmp_path):
    (tmp_path / "a.png").write_bytes(bomb(1024, 1))
    (tmp_path / "b.png").write_bytes(bomb(1024, 1))
    files = SceneFiles(tmp_path)
    first = load_texture(tmp_path / "a.png", files, srgb=True)
    for _ in range(200):
        assert load_texture(tmp_path / "b.png", files, srgb=True) is first
    assert load_texture(tmp_path / "a.png", files, srgb=False) is not first


@pytest.mark.parametrize("order", ["<u2", ">u2"])
def test_grey_tiffs_of_16_bits_are_scaled(tmp_path, order):
    greys = np.array([[0, 16384], [32768, 65535]], order)
    Image.fromarray(greys).save(tmp_path / "grey.tiff")
    image = load_texture(tmp_path / "grey.tiff", SceneFiles(tmp_path), srgb=False, alpha=True)
    np.testing.assert_allclose(image, np.repeat(greys[..., None] / 65535, 3, axis=2), rtol=1e-5)


@pytest.mark.parametrize("change", [TEXTURE, MASK])
@pytest.mark.parametrize(("kind", "channels"), [("float", 1), ("float", 3), ("int", 1)])
def test_tiffs_of_other_numbers_are_refused_in_a_line(folder, change, kind, channels):
    out = oiio.ImageOutput.create("bad.tif")
    assert out.open(str(folder / "bad.tif"), oiio.ImageSpec(2, 2, channels, kind))
    assert out.write_image(np.ones((2, 2, channels), np.float32))
    out.close()
    with pytest.raises(BokehguideError, match=r"bad\.tif: .*texture.*; give a PNG.* TIFF of 8 or 16 bits") as caught:
        load_scene(str(scene_file(folder, change, "bad.tif")))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("compression", ["none", "zip"])
def test_tiffs_of_12_bits_are_refused_in_a_line(folder, compression, channels):
    """Pillow would read greys without their scale, at a sixteenth of their brightness."""
    spec = oiio.ImageSpec(4, 2, channels, "uint16")
    spec.attribute("oiio:BitsPerSample", 12)
    spec.attribute("compression", compression)
    out = oiio.ImageOutput.create("bad.tif")
    assert out.open(str(folder / "bad.tif"), spec) and out.write_image(np.ones((2, 4, channels), np.float32))
    out.close()
    with pytest.raises(BokehguideError, match=r"bad\.tif: .*texture.*; give a PNG.* TIFF of 8 or 16 bits") as caught:
        load_scene(str(scene_file(folder, TEXTURE, "bad.tif")))
    assert "\n" not in str(caught.value)


def test_a_photograph_may_be_as_large_as_its_file(tmp_path):
    """The budget grows with the size of the file."""
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (256, 256, 3), np.uint8)).save(tmp_path / "noise.png")
    files = SceneFiles(tmp_path)
    files.reserve(MAX_VALUES, 0, "all that is free")
    load_texture(tmp_path / "noise.png", files, srgb=True)


def test_an_environment_map_that_is_too_large(tmp_path):
    OpenEXR.File({}, {"RGB": np.zeros((5, 8, 3), np.float32)}).write(str(tmp_path / "sky.exr"))
    whole = (tmp_path / "sky.exr").read_bytes()
    assert whole.count(struct.pack("<4i", 0, 0, 7, 4)) == 2
    large = whole.replace(struct.pack("<4i", 0, 0, 7, 4), struct.pack("<4i", 0, 0, 15999, 15999))
    (tmp_path / "sky.exr").write_bytes(large + bytes(2**20))  # OpenImageIO sees through bolder lies itself
    with pytest.raises(BokehguideError, match=r"sky\.exr: would unfold from [\d,]+ bytes to 768,000,000 values"):
        load_scene(str(scene_file(tmp_path, MAP, "sky.exr")))


def test_pillows_other_formats_are_not_tried(tmp_path):
    """EPS, for one, would start another program."""
    for name in ("a.eps", "a.gif"):
        Image.new("RGB", (2, 2)).save(tmp_path / name)
        with pytest.raises(BokehguideError, match="unreadable texture; give a PNG"):
            load_texture(tmp_path / name, SceneFiles(tmp_path), srgb=True)
    stream = io.BytesIO()
    Image.new("RGB", (2, 2)).save(stream, "EPS")
    (tmp_path / "wood.png").write_bytes(stream.getvalue())
    (tmp_path / "outside").mkdir()
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/wood.png").write_bytes(stream.getvalue())
    with pytest.raises(BokehguideError, match=r"m\.obj: wood: a texture in the format EPS"):
        load_scene(str(obj(tmp_path / "scene", "m.mtl", "wood.png")))


def test_a_model_in_many_places_is_counted_as_it_is_placed(folder, monkeypatch):
    path = folder / "scene.toml"
    path.write_text(BOX_AND_EMITTER + '[[object]]\nfile = "square.glb"\n' * 40)
    monkeypatch.setattr(validation, "MAX_TRIANGLES", 12 + 1280 + 20)
    with pytest.raises(BokehguideError, match=r"scene\.toml: object\[12\]: makes 1,314 triangles in all; .* at most 1,312"):
        load_scene(str(path))


def test_a_damaged_png_of_16_bits_prints_nothing(tmp_path, capfd):
    whole = bomb(64, 16)
    for data in (whole[:45] + b"\x55" + whole[46:], whole[:-20]):
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(BokehguideError, match=r"a\.png: unreadable texture"):
            load_texture(tmp_path / "a.png", SceneFiles(tmp_path), srgb=True)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("change", "key", "kind"),
    [
        (TEXTURE, "materials.wall.base_color_texture", "texture"),
        (MASK, "camera.aperture.image", "image"),
        (MAP, "environment.map", "environment map"),
        (MODEL, "object[0].file", "model"),
    ],
)
def test_what_is_no_file_is_named_with_the_scene_and_the_key(folder, change, key, kind):
    """A pipe is not opened: its reader could wait for ever."""
    suffix = ".exr" if change is MAP else ".glb"
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"folder{suffix}").mkdir()
    for name, problem in (
        ("pipe", "is no regular file; give one"),
        ("folder", "is a folder; give a file"),
        ("none", "no such file"),
    ):
        path = scene_file(folder, change, name + suffix)
        with pytest.raises(BokehguideError) as refusal:
            load_scene(str(path))
        assert str(refusal.value).startswith(f"{path}: {key}: {folder / (name + suffix)}: {problem} ({kind})")


@pytest.mark.parametrize("section", ["buffers", "images"])
def test_pipes_in_a_model_are_not_opened(folder, section):
    os.mkfifo(folder / "pipe")
    simple(TEXCOORD_0=UVS).save(folder / "m.gltf")
    document = json.loads((folder / "m.gltf").read_text())
    texture = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    document |= {"images": [{"uri": "wood.png"}], "textures": [{"source": 0}], "materials": [texture]}
    document[section][0]["uri"] = "pipe"
    (folder / "m.gltf").write_text(json.dumps(document))
    with pytest.raises(BokehguideError, match=rf"m\.gltf: {section}\[0\]\.uri: 'pipe' is no file beside the model"):
        load_scene(str(folder / "m.gltf"))


def test_pipes_beside_a_mesh_are_left_out(folder):
    os.mkfifo(folder / "pipe.mtl")
    (folder / "m.obj").write_text("mtllib pipe.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert any("pipe.mtl: no such file; left out" in warning for warning in load_scene(str(folder / "m.obj")).warnings)


@pytest.mark.parametrize(("name", "kind"), [("a.obj", "model"), ("a.toml", "scene"), ("a.glb", "model"), ("a.pbrt", "pbrt file")])
def test_a_pointer_of_git_lfs_is_told(tmp_path, name, kind):
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:20357221\nsize 4284156\n")
    with pytest.raises(
        BokehguideError, match=rf"/{name}: is a pointer of Git LFS, not the file itself \({kind}\); run git lfs pull$"
    ):
        load_scene(str(tmp_path / name))
