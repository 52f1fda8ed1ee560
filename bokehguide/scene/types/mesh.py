"""Meshes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from bokehguide.limits import MAX_EXTENT
from bokehguide.scene.checks import FieldError, Fields
from bokehguide.scene.types.fields import INDEX, LABEL
from bokehguide.scene.uvs import turned_uvs


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space with one material.

    vertices: float32 `[V, 3]`. triangles: int32 `[T, 3]`, anticlockwise seen from the front.
    material: index into `Scene.materials`. normals: unit float32 `[V, 3]`; None is flat shading.
    uvs: float32 `[V, S, 2]`, S sets with v downwards from the texture's top row (glTF), or None.
    tangents: float32 `[V, 4]` for normal maps, glTF's unit tangent and the sign of the bitangent;
    None derives them from the uvs. colors: linear float32 `[V, 4]` that multiply base colour and
    opacity, or None. name: of the object, empty without one. groups: further names of the object, such as those of the
    glTF nodes above its own.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    material: int
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    tangents: np.ndarray | None = None
    colors: np.ndarray | None = None
    name: str = field(default="", metadata={LABEL: True})
    groups: tuple[str, ...] = field(default=(), metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        vertices = fields.check_array("vertices", ("N", 3))
        triangles = fields.check_array("triangles", ("N", 3), whole=True)
        count = len(vertices)
        for name, shape in {"normals": (3,), "uvs": ("sets", 2), "tangents": (4,), "colors": (4,)}.items():
            if getattr(self, name) is not None:
                fields.check_array(name, (count, *shape))
        fields.check_wholes(material=INDEX)
        fields.check_texts("name")
        # The range of all coordinates is much faster than that of each axis, and never smaller.
        if count and float(vertices.max()) - float(vertices.min()) > MAX_EXTENT:
            extent = np.ptp(vertices, axis=0).max()
            if extent > MAX_EXTENT:
                raise FieldError(f"Mesh.vertices: reach {extent:.3g} m from end to end; scale them to {MAX_EXTENT:g} m or less")
        if triangles.size and not (triangles.min() >= 0 and triangles.max() < count):
            out = np.flatnonzero(((triangles < 0) | (triangles >= count)).any(axis=1))
            raise FieldError(
                f"Mesh.triangles[{out[0]}] has the indices {triangles[out[0]].tolist()}, but there are {count} vertices; "
                f"repair them ({len(out)} such)"
            )

    @classmethod
    def from_trimesh(cls, mesh: Any, material: int = 0, smooth: bool = False) -> Self:
        """A `trimesh.Trimesh` with its texture coordinates.

        smooth: take the vertex normals of trimesh; else the shading is flat. Raises BokehguideError for anything else than a
        Trimesh, and as the constructor.
        """
        vertices, faces = getattr(mesh, "vertices", None), getattr(mesh, "faces", None)
        if vertices is None or faces is None:
            raise FieldError(
                f"Mesh.from_trimesh: {type(mesh).__name__} is no Trimesh; give one, or the result of Scene.to_mesh() of trimesh"
            )
        uvs = getattr(getattr(mesh, "visual", None), "uv", None)
        if uvs is not None:  # v points upwards in trimesh
            uvs = turned_uvs(np.asarray(uvs, dtype=np.float32)[:, None, :2])
        normals = np.asarray(mesh.vertex_normals) if smooth else None
        return cls(np.asarray(vertices), np.asarray(faces), material, normals, uvs)
