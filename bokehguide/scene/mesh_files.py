"""Models in `.obj`, `.ply` and `.stl`, read with trimesh."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from bokehguide.color import srgb_to_linear
from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.losses import Losses
from bokehguide.scene.model import Model
from bokehguide.scene.mtl_materials import ignored_terms, mtl_material
from bokehguide.scene.shapes import transformed, unit_normals
from bokehguide.scene.types import Mesh
from bokehguide.stopping import default_signals

# Without a handler, Python prints the log of trimesh, which includes tracebacks, to the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

INDEXED = {
    b"v": ("vertex", "vertices"),
    b"vt": ("texture coordinate", "texture coordinates"),
    b"vn": ("normal", "normals"),
}
"""Statements of `.obj` files that faces have indices of, in the order of the indices, each with words for one and for many."""
OPTIONS = re.compile(
    r"^(?:-(?:(?:o|s|t)(?:\s+[-+.\deE]+(?=\s)){1,3}|mm\s+\S+\s+\S+|(?:blendu|blendv|bm|boost|cc|clamp|imfchan|texres|type)\s+\S+)\s+)+"
)
"""Options of an `.mtl` file before the name of a texture."""
COLORED = ("vertex", "face")
"""Kinds of visuals of trimesh with colours of vertices or faces."""
WHITE = (1.0, 1.0, 1.0)


class _Resolver(FilePathResolver):
    """Gives trimesh the files that a model names, if the scene may read them."""

    def __init__(self, model: Path, files: SceneFiles):
        super().__init__(str(model))
        self.model, self.files = model, files
        self.refusal: BokehguideError | None = None
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """The bytes of the file `name`, or of its last component in the model's folder.

        Names often refer to another disk. trimesh continues without a missing file, so that this
        method keeps the first refusal.
        """
        refusal = None
        plain = OPTIONS.sub("", name.strip(), count=1)
        for candidate in (plain, PureWindowsPath(plain).name):
            try:
                path = self.files.find(self.model.parent, candidate, str(self.model))
            except BokehguideError as error:
                refusal = refusal or error
                continue
            if path.is_file():
                data = path.read_bytes()
                self.files.reserve(0, len(data), str(self.model))
                return data
        self.refusal = self.refusal or refusal
        self.missing.append(name)
        raise FileNotFoundError(name)


def load_mesh_file(path: Path, files: SceneFiles) -> Model:
    """Read a model. Raises as `load_model` does."""
    scene, resolver = _parsed(path, files)
    materials, index, ignored, lost = [], {}, set[str](), Losses()
    for name, geometry in scene.geometry.items():
        index[name] = len(materials)
        source = getattr(geometry.visual, "material", None)
        material = mtl_material(source, printable(name), str(path), files, resolver.get, lost)
        materials.append(replace(material, base_color=WHITE) if geometry.visual.kind in COLORED else material)
        ignored |= ignored_terms(getattr(source, "kwargs", None) or ())
    if resolver.refusal is not None:
        raise resolver.refusal
    meshes = []
    for node in scene.graph.nodes_geometry:
        matrix, geometry_name = scene.graph[node]
        name = str(geometry_name)
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        with located(str(path) if name == path.name else f"{path}: {printable(name)}"):
            mesh = _mesh(geometry, index[name])
            if mesh.normals is not None:
                mesh = replace(mesh, normals=unit_normals(mesh.normals, mesh.vertices, mesh.triangles))
            meshes.append(replace(transformed(mesh, matrix), name=printable(name)))
    warnings = [f"{printable(name)}: no such file; left out" for name in dict.fromkeys(resolver.missing)]
    warnings += lost.lines(".mtl file")
    if ignored:
        warnings.append(f".mtl file: {printable(', '.join(sorted(ignored)), 200)}: have no effect")
    return Model(tuple(meshes), tuple(materials), warnings=tuple(warnings))


def _parsed(path: Path, files: SceneFiles) -> tuple[trimesh.Scene, _Resolver]:
    """The trimesh scene of the file, and the reader of the files that it names."""
    resolver = _Resolver(path, files)
    files.add_file(path)
    try:
        # Parts of trimesh hold the interpreter's lock, and numbers of damaged files overflow.
        with default_signals(), np.errstate(all="ignore"):
            source = _with_absolute_indices(path) if path.suffix.lower() == ".obj" else str(path)
            kind = path.suffix[1:].lower()
            scene = _with_strips(trimesh.load_scene(source, file_type=kind, resolver=resolver, process=False))
    except Exception as error:  # the parsers raise exceptions of any type for damaged files
        if path.suffix.lower() == ".obj" and not isinstance(error, OSError):
            _require_indices(path)
        problem = reason(error) if isinstance(error, OSError | ValueError) else "damaged"
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({problem}); export it or fetch it again") from None
    if path.suffix.lower() == ".obj" and _has_wrong_index(path.read_bytes()):
        _require_indices(path)
    return scene, resolver


def _with_strips(scene: trimesh.Scene) -> trimesh.Scene:
    """`scene`, or the mesh of a `.ply` file whose triangles are strips, of which trimesh makes a cloud of points."""
    for name, cloud in scene.geometry.items():
        raw = getattr(cloud, "metadata", {}).get("_ply_raw", {}) if isinstance(cloud, trimesh.PointCloud) else {}
        if raw.get("tristrips", {}).get("length"):
            rows = raw["tristrips"]["data"]
            column = rows["vertex_indices"]
            indices = column["f1"] if column.dtype.names else column
            faces = [_strip_triangles(np.asarray(row).reshape(-1).astype(np.int64)) for row in indices]
            return trimesh.Scene({name: trimesh.Trimesh(cloud.vertices, np.concatenate(faces), process=False)})
    return scene


def _strip_triangles(strip: np.ndarray) -> np.ndarray:
    """Triangles `[T, 3]` of strips of indices, which -1 separates. Every second triangle of a strip is turned."""
    starts = np.concatenate([[0], np.flatnonzero(strip < 0) + 1])
    triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    place = np.arange(len(triangles))
    turned = (place - starts[np.searchsorted(starts, place, side="right") - 1]) % 2 == 1
    triangles[turned] = triangles[turned][:, [1, 0, 2]]
    return triangles[(triangles >= 0).all(axis=1)]


def _with_absolute_indices(path: Path) -> str | BytesIO:
    """The `.obj` file, or its text without negative indices, which trimesh counts from the end of the file.

    A negative index counts back from the last statement above.
    """
    data = path.read_bytes()
    face = re.search(rb"^[ \t]*f[ \t][^#\n]*-\d", data, re.MULTILINE)
    if face is None or not re.compile(rb"^[ \t]*v", re.MULTILINE).search(data, face.end()):
        return str(path)
    lines, before = data.splitlines(), Counter[bytes]()
    for number, line in enumerate(lines):
        words = line.partition(b"#")[0].split()
        before.update(words[:1])
        if words[:1] == [b"f"] and b"-" in line:
            lines[number] = b" ".join([b"f", *(_absolute(corner, before) for corner in words[1:])])
    return BytesIO(b"\n".join(lines) + b"\n")


def _absolute(corner: bytes, before: Mapping[bytes, int]) -> bytes:
    """A corner of a face without negative indices. before: the number of each statement above the face."""
    return b"/".join(
        str(before[key] + 1 + int(index)).encode()
        if re.fullmatch(rb"-\d{1,18}", index) and before[key] + int(index) >= 0
        else index
        for index, key in zip(corner.split(b"/"), INDEXED)
    )


def _require_indices(path: Path) -> None:
    """Raise BokehguideError, naming the line, for a face of an `.obj` file with an index that the file lacks."""
    lines = [line.partition(b"#")[0].split() for line in path.read_bytes().splitlines()]
    counts, before = Counter(words[0] for words in lines if words), Counter[bytes]()
    for number, words in enumerate(lines, 1):
        before.update(words[:1])
        for corner in words[1:] if words[:1] == [b"f"] else ():
            for place, (index, (key, (one, many))) in enumerate(zip(corner.split(b"/"), INDEXED.items())):
                # A negative index counts back from the last statement above.
                known = re.fullmatch(rb"-?\d{1,18}", index) and -before[key] <= int(index) <= counts[key] and int(index) != 0
                if not known and (place == 0 or (index and counts[key] > 0)):
                    raise BokehguideError(
                        f"{path}:{number}: the face has the {one} {printable(index.decode(errors='replace'), 20)}, "
                        f"and the file has {counts[key]} {one if counts[key] == 1 else many}; repair the face"
                    )


def _has_wrong_index(data: bytes) -> bool:
    """Whether a face of an `.obj` file may have the index 0 or one beyond the file, which trimesh accepts.

    The search is fast: it looks at each corner once, and does not see statements after a blank.
    """
    counts = [sum(data.count(b"\n%s%s" % (key, blank)) for blank in (b" ", b"\t")) for key in INDEXED]
    corners = set(b" ".join(re.findall(rb"^[ \t]*f[ \t]([^\n#]*)", data, re.MULTILINE)).split())
    given = ((index.lstrip(b"-"), count) for corner in corners for index, count in zip(corner.split(b"/"), counts))
    return any(index.isdigit() and count > 0 and not 1 <= int(index) <= count for index, count in given)


def _mesh(geometry: trimesh.Trimesh, material: int) -> Mesh:
    """A geometry as a Mesh with the file's normals, and colours of its vertices or faces, which are sRGB."""
    mesh = Mesh.from_trimesh(geometry, material)
    # trimesh computes missing normals on demand. At this point its cache holds only the file's.
    if "vertex_normals" in geometry._cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float32)
        mesh = replace(mesh, normals=normals) if np.isfinite(normals).all() else mesh
    visual: Any = geometry.visual
    if visual.kind not in COLORED:
        return mesh
    if visual.kind == "vertex":
        return replace(mesh, colors=_linear(visual.vertex_colors))
    corners = mesh.triangles.reshape(-1)
    normals = None if mesh.normals is None else mesh.normals[corners]
    return Mesh(
        vertices=mesh.vertices[corners],
        triangles=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        material=material,
        normals=normals,
        colors=_linear(visual.face_colors).repeat(3, axis=0),
    )


def _linear(colors: np.ndarray) -> np.ndarray:
    """sRGB colours with opacities, uint8 `[N, 4]`, as linear float32."""
    encoded = np.asarray(colors, np.float32) / 255.0
    return np.concatenate([srgb_to_linear(encoded[:, :3]), encoded[:, 3:]], axis=1)
