"""Models in `.obj`, `.ply` and `.stl`, read with trimesh."""

from __future__ import annotations

import logging
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import texture_from_image
from bokehguide.scene.shapes import transformed, unit_normals
from bokehguide.scene.tables import NOT_NEGATIVE, Table
from bokehguide.scene.types import Material, Mesh, Model, Texture, as_vector
from bokehguide.stopping import default_signals

# Without a handler, Python prints the log of trimesh, which includes tracebacks, to the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

INDEXED = {
    b"v": ("vertex", "vertices"),
    b"vt": ("texture coordinate", "texture coordinates"),
    b"vn": ("normal", "normals"),
}
"""Statements of `.obj` files that faces have indices of, in the order of the indices, each with words for one and for many."""
MTL_TERMS = {"kd", "ke", "map_kd"}
"""Supported statements of `.mtl` files."""


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
        for candidate in (name.strip(), PureWindowsPath(name.strip()).name):
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
    scene, warnings = _parsed(path, files)
    materials, index, ignored = [], {}, set[str]()
    for name, geometry in scene.geometry.items():
        index[name] = len(materials)
        materials.append(_material(geometry, printable(name), path, files))
        if geometry.visual.kind in ("vertex", "face"):
            warnings.append("vertex and face colours: have no effect")
        ignored |= {*(getattr(getattr(geometry.visual, "material", None), "kwargs", None) or ())} - MTL_TERMS
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
    if ignored:
        terms = printable(", ".join(sorted(map(str, ignored))), 200)
        warnings.append(f".mtl file: {terms}: have no effect, only Kd, map_Kd and Ke do")
    return Model(tuple(meshes), tuple(materials), warnings=tuple(warnings))


def _parsed(path: Path, files: SceneFiles) -> tuple[trimesh.Scene, list[str]]:
    """The trimesh scene of the file, and a warning for each missing file that it names."""
    resolver = _Resolver(path, files)
    files.add_file(path)
    try:
        # Parts of trimesh hold the interpreter's lock, and numbers of damaged files overflow.
        with default_signals(), np.errstate(all="ignore"):
            scene = trimesh.load_scene(str(path), resolver=resolver, process=False)
    except Exception as error:  # the parsers raise exceptions of any type for damaged files
        if path.suffix.lower() == ".obj" and not isinstance(error, OSError):
            _require_indices(path)
        raise BokehguideError(f"{path}: not a readable {path.suffix} model ({reason(error)})") from None
    if resolver.refusal is not None:
        raise resolver.refusal
    if path.suffix.lower() == ".obj" and _has_wrong_index(path.read_bytes()):
        _require_indices(path)
    return scene, [f"{printable(name)}: no such file; left out" for name in resolver.missing]


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


def _material(geometry: Any, name: str, path: Path, files: SceneFiles) -> Material:
    """The material of an `.obj` geometry, or the default material for `.ply` and `.stl`."""
    material = getattr(geometry.visual, "material", None)
    terms = getattr(material, "kwargs", None) or {}
    image = getattr(material, "image", None)
    if image is not None and image.format is None:  # a placeholder of trimesh for uvs without an image
        image = None
    label = printable(getattr(material, "name", None) or name)
    values = {key: _numbers(terms[key]) for key in ("kd", "ke") if key in terms}
    table = Table(values, str(path), f"material {label}", values)
    return Material(
        name=name,
        base_color=as_vector(min(channel, 1.0) for channel in table.vector("kd", Material.base_color, NOT_NEGATIVE)),
        emission=table.vector("ke", Material.emission, NOT_NEGATIVE),
        base_color_texture=None if image is None else Texture(texture_from_image(image, f"{path}: {label}", files)),
    )


def _numbers(words: Any) -> Any:
    """`words` as numbers, or unchanged if they are none."""
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError):
        return words


def _mesh(geometry: trimesh.Trimesh, material: int) -> Mesh:
    """A geometry as a Mesh with the file's normals."""
    mesh = Mesh.from_trimesh(geometry, material)
    # trimesh computes missing normals on demand. At this point its cache holds only the file's.
    if "vertex_normals" in geometry._cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float32)
        return replace(mesh, normals=normals) if np.isfinite(normals).all() else mesh
    return mesh
