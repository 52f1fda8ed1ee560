"""Scenes as XML files for Mitsuba 3, with their meshes and images in a folder. Mitsuba itself is not needed."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from bokehguide.export.mitsuba_materials import Bitmap, lost_terms
from bokehguide.export.mitsuba_tree import Geometry, scene_tree
from bokehguide.image import make_folder
from bokehguide.image.files import replacing, unwritable
from bokehguide.scene.types import Scene

VERSION = "3.0.0"
TAGS = {
    "sensor": ("thinlens", "perspective"),
    "film": ("hdrfilm",),
    "rfilter": ("box",),
    "sampler": ("independent",),
    "integrator": ("path",),
    "bsdf": (
        *("diffuse", "principled", "dielectric", "roughdielectric", "thindielectric"),
        *("twosided", "mask", "normalmap"),
    ),
    "texture": ("bitmap",),
    "shape": ("ply",),
    "emitter": ("area", "envmap", "constant", "directional"),
}
TAG_OF = {plugin: tag for tag, plugins in TAGS.items() for plugin in plugins}
"""The XML tag of each plugin that the exporter uses."""

KINDS = {bool: "boolean", int: "integer", float: "float", str: "string"}
"""The XML tag of each type of value."""


def export_mitsuba(scene: Scene, folder: Path) -> list[str]:
    """Write `scene.xml`, `meshes/` and `textures/` into a folder, which may exist.

    Returns what Mitsuba does not have, one a line. Raises BokehguideError if the files cannot be written.
    """
    for part in (folder, folder / "meshes", folder / "textures"):
        make_folder(part)
    writer = _Writer(folder)
    root = ET.Element("scene", version=VERSION)
    for name, value in scene_tree(scene).items():
        if name != "type":
            writer.add(root, name, value, named=True)
    ET.indent(root)
    with replacing(folder / "scene.xml") as temporary:
        temporary.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
    return _losses(scene)


def _losses(scene: Scene) -> list[str]:
    """What the exported scene leaves out, one a line."""
    lost: dict[str, list[str]] = {}
    for number in sorted({mesh.material for mesh in scene.meshes}):
        for term in lost_terms(scene.materials[number]):
            lost.setdefault(term, []).append(scene.materials[number].name)
    colored = [scene.materials[mesh.material].name for mesh in scene.meshes if mesh.colors is not None]
    if colored:
        lost["vertex colours"] = colored
    lines = [f"{term}: left out ({', '.join(dict.fromkeys(names))})" for term, names in lost.items()]
    if scene.camera.aperture is not None:
        lines.append("shape of the aperture: Mitsuba's lens is round")
    if scene.suns:
        lines.append("discs of suns: Mitsuba has lights without a size in their place")
    if scene.environment is not None and not scene.environment.visible:
        lines.append("invisible environment: Mitsuba's camera sees it")
    return lines


class _Writer:
    """Writes the values of a dictionary as XML, and its arrays as files of a folder."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._files: dict[int, tuple[str, Any]] = {}
        """Names of written arrays by identity, with the arrays, which must not be collected meanwhile."""

    def add(self, parent: ET.Element, name: str, value: Any, named: bool = False) -> None:
        """Append the element of one property. named: whether others may refer to it by its name."""
        if isinstance(value, dict):
            self._add_object(parent, name, value, named)
        elif isinstance(value, Geometry):
            ET.SubElement(parent, "string", name="filename", value=self._file(value, "meshes", "ply", _write_ply))
        elif isinstance(value, Bitmap):
            ET.SubElement(parent, "string", name="filename", value=self._file(value, "textures", "exr", _write_exr))
        elif isinstance(value, np.ndarray):
            transform = ET.SubElement(parent, "transform", name=name)
            ET.SubElement(transform, "matrix", value=_numbers(value.ravel()))
        elif isinstance(value, list):
            ET.SubElement(parent, "vector", name=name, value=_numbers(value))
        else:
            text = str(value).lower() if isinstance(value, bool) else str(value)
            ET.SubElement(parent, KINDS[type(value)], name=name, value=text)

    def _add_object(self, parent: ET.Element, name: str, value: dict[str, Any], named: bool) -> None:
        """A colour, a reference, or a plugin with its properties."""
        if value["type"] == "rgb":
            ET.SubElement(parent, "rgb", name=name, value=_numbers(value["value"]))
        elif value["type"] == "ref":
            ET.SubElement(parent, "ref", name=name, id=value["id"])
        else:
            place = {"id": name} if named else {"name": name}
            element = ET.SubElement(parent, TAG_OF[value["type"]], {"type": value["type"], **place})
            for key, inner in value.items():
                if key != "type":
                    self.add(element, key, inner)

    def _file(self, value: Any, folder: str, suffix: str, write: Any) -> str:
        """The path of an array's file relative to the XML; equal objects share one."""
        if id(value) not in self._files:
            number = sum(name.startswith(folder) for name, _ in self._files.values())
            path = f"{folder}/{number:03d}.{suffix}"
            self._files[id(value)] = path, value
            with replacing(self._folder / path) as temporary:
                write(temporary, value)
        return self._files[id(value)][0]


def _numbers(values: Any) -> str:
    """Numbers with all digits of double precision."""
    return " ".join(repr(float(value)) for value in values)


def _write_ply(path: Path, geometry: Geometry) -> None:
    """A binary PLY file with normals and texture coordinates where there are some."""
    columns: list[tuple[Sequence[str], np.ndarray | None]] = [
        (("x", "y", "z"), geometry.vertices),
        (("nx", "ny", "nz"), geometry.normals),
        (("u", "v"), geometry.uvs),
    ]
    given = [(names, values) for names, values in columns if values is not None]
    properties = "".join(f"property float {name}\n" for names, _ in given for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(geometry.vertices)}\n{properties}"
    header += f"element face {len(geometry.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    vertices = np.concatenate([np.asarray(values, "<f4") for _, values in given], axis=1)
    faces = np.empty(len(geometry.triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, geometry.triangles
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def _write_exr(path: Path, image: Bitmap) -> None:
    """An EXR file of one channel Y or of R, G and B."""
    planes = [image.pixels] if image.pixels.ndim == 2 else [image.pixels[..., channel] for channel in range(3)]
    channels = {name: np.ascontiguousarray(plane) for name, plane in zip("RGB" if len(planes) == 3 else "Y", planes)}
    try:
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    except RuntimeError as error:
        raise unwritable(path, error) from error
