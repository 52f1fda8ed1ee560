"""Small sound files in every format that bokehguide reads, to be damaged."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from fuzzing.gltf_samples import SQUARE, draco_glb, glb, glossy_gltf, gltf_parts, meshopt_glb
from fuzzing.ktx2_samples import ETC1S, UASTC
from fuzzing.materialx_samples import DOCUMENT
from fuzzing.materialx_samples import PART as INCLUDED
from fuzzing.materialx_samples import STAGE as DRESSED
from fuzzing.pbrt_samples import LENS, PART, PFM, REALISTIC, SCENE, octahedral_sky
from fuzzing.usd_samples import STAGE, usdc, usdz
from PIL import Image

from bokehguide.scene import load_scene
from bokehguide.train import RenderLoop, RenderSettings, save_checkpoint

LIT = """
[camera]
position = [0.0, 0.0, 4.0]
target = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
f_number = 2.0
focal_length = 50.0
focus_distance = 3.0
[camera.aperture]
blades = 6
rotation = 10.0
curvature = 0.2
cat_eye = 0.5
[film]
width = 16
height = 9
max_depth = 3
[environment]
map = "sky.NAME"
intensity = 0.5
rotation = 30.0
[[sun]]
direction = [0.3, 0.8, 0.5]
irradiance = [3.0, 2.9, 2.7]
angle = 0.53
[lights]
radius = 0.01
[materials.wall]
base_color = [0.5, 0.4, 0.3]
base_color_texture = "wood.png"
normal_texture = "wood.png"
normal_scale = 0.5
roughness = 0.3
clearcoat = 0.5
sheen_color = [0.5, 0.4, 0.3]
anisotropy = 0.5
diffuse_transmission = 0.25
alpha_mode = "blend"
opacity = 0.8
[materials.emitter]
base_color = [0.0, 0.0, 0.0]
emission = [40.0, 30.0, 20.0]
emission_cone = { axis = [0.0, 0.0, 1.0], inner = 20.0, outer = 30.0 }
[[object]]
shape = "box"
material = "wall"
rotate = [0.0, 45.0, 0.0]
translate = [-0.6, -0.3, 0.5]
[[object]]
shape = "rectangle"
material = "emitter"
translate = [0.5, 0.2, -3.0]
scale = 0.2
[[object]]
file = "square.stl"
"""
OBJ = """mtllib square.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0.5
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
usemtl wood
f 1/1/1 2/2/1 3/3/1
usemtl emitter
f 1/1/1 3/3/1 4/2/1
"""
MTL = "newmtl wood\nKd 0.5 0.5 0.5\nmap_Kd wood.png\nnewmtl emitter\nKd 0 0 0\nKe 5 4 3\n"
PLY = """ply
format ascii 1.0
comment TextureFile wood.png
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float s
property float t
element face 2
property list uchar int vertex_indices
end_header
-1 -1 0 0 0 1 0 0
1 -1 0 0 0 1 1 0
1 1 0 0 0 1 1 1
-1 1 0 0 0 1 0 1
3 0 1 2
3 0 2 3
"""


XML = """<scene version="3.0.0">
<default name="spp" value="4"/>
<integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="thinlens"><float name="fov" value="40"/><float name="aperture_radius" value="0.05"/>
<float name="focus_distance" value="3"/><string name="fov_axis" value="smaller"/>
<transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="9"/></film></sensor>
<bsdf type="twosided" id="wood"><bsdf type="roughplastic"><texture type="bitmap" name="diffuse_reflectance">
<string name="filename" value="wood.png"/></texture><float name="alpha" value="0.2"/></bsdf></bsdf>
<bsdf type="roughconductor" id="gold"><string name="material" value="Au"/></bsdf>
<bsdf type="dielectric" id="glass"><string name="int_ior" value="bk7"/></bsdf>
<shape type="ply"><string name="filename" value="square.ply"/><ref id="wood"/></shape>
<shape type="sphere"><point name="center" x="1" y="0" z="0"/><float name="radius" value="0.3"/><ref id="gold"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.2"/><translate x="-1"/></transform><ref id="glass"/></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.1"/><translate z="-2"/></transform>
<emitter type="area"><rgb name="radiance" value="9 8 7"/></emitter></shape>
<emitter type="envmap"><string name="filename" value="sky.hdr"/><float name="scale" value="0.5"/></emitter>
<emitter type="point"><point name="position" x="0" y="2" z="0"/><rgb name="intensity" value="3 3 3"/></emitter>
<emitter type="directional"><vector name="direction" x="0" y="-1" z="0.2"/></emitter>
</scene>
"""


@dataclass(frozen=True)
class Sample:
    """Files by name, those of them that are to be damaged, and the one that is loaded."""

    files: dict[str, bytes]
    damaged: tuple[str, ...]
    loaded: str


def image(kind: str, mode: str = "RGB", size: tuple[int, int] = (6, 4)) -> bytes:
    """A few pixels as PNG, JPEG or WebP."""
    texels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 4), np.uint8)
    stream = io.BytesIO()
    Image.fromarray(texels).convert(mode).save(stream, kind)
    return stream.getvalue()


def deep_png() -> bytes:
    """A PNG of 16 bits."""
    rows = b"".join(b"\0" + bytes(range(24)) for _ in range(3))
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    packed = (struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def hdr() -> bytes:
    """16 × 8, a gradient: every row in runs, as the format has them."""
    row = bytearray(b"\2\2\0\20")
    for level in (60, 90, 120, 129):
        row += bytes([128 + 12, level, 4, level + 1, level + 2, level + 3, level + 4])
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + bytes(row) * 8


def exr(folder: Path, compression=OpenEXR.ZIP_COMPRESSION, **header) -> bytes:
    pixels = np.random.default_rng(0).random((8, 16, 3), np.float32)
    OpenEXR.File({"compression": compression, **header}, {"RGB": pixels}).write(str(folder / "sky.exr"))
    return (folder / "sky.exr").read_bytes()


def binary_stl() -> bytes:
    corners = SQUARE[[0, 1, 2, 0, 2, 3]].reshape(2, 9)
    faces = (np.float32([0, 0, 1]).tobytes() + corner.tobytes() + b"\0\0" for corner in corners)
    return b"square".ljust(80) + struct.pack("<I", 2) + b"".join(faces)


def ascii_stl() -> bytes:
    facets = []
    for corners in SQUARE[[0, 1, 2, 0, 2, 3]].reshape(2, 3, 3):
        lines = "".join("vertex {} {} {}\n".format(*corner) for corner in corners)
        facets.append(f"facet normal 0 0 1\nouter loop\n{lines}endloop\nendfacet\n")
    return f"solid square\n{''.join(facets)}endsolid square\n".encode()


def binary_ply() -> bytes:
    header = PLY[: PLY.index("-1 -1 0 0")].replace("ascii", "binary_little_endian")
    vertices = np.concatenate([SQUARE, np.tile(np.float32([0, 0, 1]), (4, 1)), SQUARE[:, :2]], axis=1)
    faces = b"".join(b"\3" + np.int32(face).tobytes() for face in ([0, 1, 2], [0, 2, 3]))
    return header.encode() + vertices.tobytes() + faces


def gltf() -> Sample:
    document, data = gltf_parts()
    encoded = "data:image/png;base64," + base64.b64encode(image("PNG")).decode()
    document |= {"images": [{"uri": "wood.png"}, {"uri": encoded}], "buffers": [{"uri": "square.bin", "byteLength": len(data)}]}
    document["textures"].append({"source": 1})
    document["materials"][1]["emissiveTexture"] = {"index": 1}
    files = {"square.gltf": json.dumps(document).encode(), "square.bin": data, "wood.png": image("PNG", "RGBA")}
    return Sample(files, tuple(files), "square.gltf")


def glossy(ktx2: bytes) -> Sample:
    """A model with specular-glossiness, variants, and images in the formats of extensions; `ktx2` is one of them."""
    images = {"wood.png": image("PNG"), "wood.ktx2": ktx2, "wood.avif": image("AVIF", "RGBA")}
    files = {"square.gltf": json.dumps(glossy_gltf()).encode(), "square.bin": gltf_parts()[1], **images}
    night = MOVED.replace("glb", "gltf") + 'variant = "night"\n'
    return Sample(files | {"scene.toml": night.encode()}, ("square.gltf", "wood.ktx2", "wood.avif", "scene.toml"), "scene.toml")


def mitsuba_scene() -> Sample:
    """A Mitsuba scene with a kind of each thing that is read."""
    files = {"scene.xml": XML.encode(), "square.ply": binary_ply(), "wood.png": image("PNG"), "sky.hdr": hdr()}
    return Sample(files, ("scene.xml", "scene.xml", "square.ply"), "scene.xml")


def pbrt_scenes(folder: Path) -> list[Sample]:
    """A pbrt scene with a kind of each thing that is read, and the same scene with another camera."""
    parts = {"part.pbrt": PART.encode(), "square.ply": binary_ply(), "wood.png": image("PNG"), "sky.exr": octahedral_sky(folder)}
    damaged = ("scene.pbrt", "scene.pbrt", "scene.pbrt", "part.pbrt", "part.pbrt", "square.ply", "sky.exr")
    other = parts | {"scene.pbrt": REALISTIC.encode(), "lens.dat": LENS, "sky.pfm": PFM, "square.ply": PLY.encode()}
    realistic = Sample(other, ("scene.pbrt", "lens.dat", "sky.pfm", "square.ply"), "scene.pbrt")
    return [Sample(parts | {"scene.pbrt": SCENE.encode()}, damaged, "scene.pbrt"), realistic]


def usd_stage(folder: Path, name: str) -> Sample:
    """A USD stage with its images, as text, in binary form, or in one file."""
    images = {"wood.png": image("PNG", "RGBA"), "sky.hdr": hdr()}
    makers = {"a.usda": STAGE.encode, "a.usdc": lambda: usdc(folder), "a.usdz": lambda: usdz(folder, images)}
    return Sample(images | {name: makers[name]()}, (name,), name)


def materialx_stage() -> Sample:
    """A USD stage whose materials come from a MaterialX document, which includes another one."""
    documents = {"look.mtlx": DOCUMENT.encode(), "part.mtlx": INCLUDED.encode()}
    damaged = ("look.mtlx", "look.mtlx", "look.mtlx", "part.mtlx")
    return Sample(documents | {"a.usda": DRESSED.encode(), "wood.png": image("PNG", "RGBA")}, damaged, "a.usda")


def scene_with(sky: str, data: bytes) -> Sample:
    """A scene file whose sky is to be damaged."""
    files = {"scene.toml": LIT.replace("NAME", sky).encode(), "wood.png": image("PNG"), "square.stl": binary_stl()}
    return Sample(files | {f"sky.{sky}": data}, (f"sky.{sky}",), "scene.toml")


def checkpoint(folder: Path, mode: str) -> Sample:
    """A scene and the checkpoint of a render of it, MODE.ckpt."""
    files = scene_with("hdr", hdr()).files
    for name, data in files.items():
        (folder / name).write_bytes(data)
    loop = RenderLoop(load_scene(str(folder / "scene.toml")), RenderSettings(mode, threads=1))
    for _ in range(3):
        loop.step()
    name = f"{mode}.ckpt"
    save_checkpoint(folder / name, loop, 1.0)
    return Sample(files | {name: (folder / name).read_bytes()}, (name,), name)


def textures() -> Sample:
    """A scene that has an image in each format."""
    files = {"wood.png": image("PNG", "P"), "deep.png": deep_png(), "wood.jpg": image("JPEG"), "wood.webp": image("WEBP")}
    slots = {"specular_color": "deep.png", "transmission": "wood.jpg", "emission": "wood.webp"}
    more = "".join(f'{slot}_texture = "{name}"\n' for slot, name in slots.items()) + "emission = [1.0, 1.0, 1.0]\n"
    text = LIT.replace("NAME", "hdr").replace("[materials.emitter]", more + "[materials.emitter]")
    return Sample(files | {"scene.toml": text.encode(), "square.stl": ascii_stl(), "sky.hdr": hdr()}, tuple(files), "scene.toml")


SAMPLES: dict[str, Callable[[Path], list[Sample]]] = {
    "glb": lambda folder: [
        Sample({"square.glb": data}, ("square.glb",), "square.glb") for data in (glb(image("PNG", "RGBA")), draco_glb())
    ],
    "gltf": lambda folder: [gltf()],
    "meshopt": lambda folder: [Sample(MESHOPT_FILES, ("square.glb",), name) for name in ("square.glb", "scene.toml")],
    "glossy": lambda folder: [glossy(ETC1S), glossy(UASTC)],
    "xml": lambda folder: [mitsuba_scene()],
    "pbrt": lambda folder: pbrt_scenes(folder),
    "usda": lambda folder: [usd_stage(folder, "a.usda")],
    "usdc": lambda folder: [usd_stage(folder, "a.usdc")],
    "usdz": lambda folder: [usd_stage(folder, "a.usdz")],
    "mtlx": lambda folder: [materialx_stage()],
    "toml": lambda folder: [Sample(scene_with("hdr", hdr()).files, ("scene.toml",), "scene.toml")],
    "hdr": lambda folder: [scene_with("hdr", hdr())],
    "exr": lambda folder: [scene_with("exr", exr(folder, kind)) for kind in EXR_KINDS],
    "images": lambda folder: [textures()],
    "obj": lambda folder: [Sample(OBJ_FILES, ("square.obj", "square.mtl", "wood.png"), "square.obj")],
    "ply": lambda folder: [
        Sample({"a.ply": data, "wood.png": image("PNG")}, ("a.ply",), "a.ply") for data in (PLY.encode(), binary_ply())
    ],
    "stl": lambda folder: [Sample({"a.stl": data}, ("a.stl",), "a.stl") for data in (ascii_stl(), binary_stl())],
    "ckpt": lambda folder: [checkpoint(folder, mode) for mode in ("lis-o", "guided")],
}
"""Samples of each format, made in a folder of their own."""
EXR_KINDS = (OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION, OpenEXR.NO_COMPRESSION, OpenEXR.DWAA_COMPRESSION)
MOVED = '[camera]\nposition = [0, 0, 4]\ntarget = [0, 0, 0]\n[[object]]\nfile = "square.glb"\ntime = 0.5\n'
MESHOPT_FILES = {"square.glb": meshopt_glb(), "scene.toml": MOVED.encode()}
OBJ_FILES = {"square.obj": OBJ.encode(), "square.mtl": MTL.encode(), "wood.png": image("PNG")}
