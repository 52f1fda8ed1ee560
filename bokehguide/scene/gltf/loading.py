"""glTF files as models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.cameras import read_cameras
from bokehguide.scene.gltf.document import Document, read_document
from bokehguide.scene.gltf.extensions import check_required, note_ignored, warnings
from bokehguide.scene.gltf.import_report import supported
from bokehguide.scene.gltf.lights import default_radius, read_lights
from bokehguide.scene.gltf.materials import DEFAULT, read_materials
from bokehguide.scene.gltf.nodes import INSTANCING, Placed, instance_matrices, place_nodes
from bokehguide.scene.gltf.primitives import read_primitive
from bokehguide.scene.gltf.skins import joint_matrices
from bokehguide.scene.gltf.textures import Textures
from bokehguide.scene.shapes import joined, transformed
from bokehguide.scene.types import LightSizes, Material, Mesh, Model
from bokehguide.scene.validation import check_mesh, check_triangles


def load_gltf(path: Path, files: SceneFiles, sizes: LightSizes) -> Model:
    """The default scene of a glTF file. Instances become triangles.

    files: the files that the model may name. sizes: of the lights. Raises BokehguideError naming
    file and object for damaged data, values out of range, required but unsupported extensions, and
    more than MAX_TRIANGLES triangles with all instances.
    """
    document = read_document(path, files)
    check_required(document)
    placed = place_nodes(document)
    textures = Textures(document)
    materials = read_materials(document, textures)
    meshes = _place(document, materials, placed)
    if not meshes:
        return Model((), ())
    if any(mesh.material == len(materials) for mesh in meshes):
        materials.append(DEFAULT)
    radius = default_radius(meshes) if sizes.radius is None else sizes.radius
    emitters, emissive, suns = read_lights(document, placed, sizes, radius)
    cameras = read_cameras(document, placed)
    note_ignored(document)
    return Model(
        meshes=tuple(meshes),
        materials=(*materials, *emissive),
        emitters=tuple(replace(emitter, material=emitter.material + len(materials)) for emitter in emitters),
        suns=tuple(suns),
        cameras=tuple(cameras),
        supported=tuple(supported(document, meshes, materials, textures, emissive, suns, cameras, radius)),
        warnings=tuple(warnings(document)),
    )


def _place(document: Document, materials: Sequence[Material], placed: Sequence[Placed]) -> list[Mesh]:
    """Meshes in world space. Primitives without a material have the material index `len(materials)`."""
    read: dict[int, list[Mesh]] = {}
    parts: list[tuple[Mesh, np.ndarray, Placed]] = []
    triangles = 0
    for node in placed:
        index = document.link(node.node, "mesh", "meshes")
        if index is None:
            continue
        joints = joint_matrices(document, node.node, placed)
        if joints is not None:  # the joints replace the node's own matrix
            primitives, matrices = _primitives(document, index, materials, joints), np.eye(4)[None]
            if INSTANCING in node.node.extensions:
                document.note(f"{INSTANCING} of skinned meshes: one instance is drawn", node.node.label)
        else:
            if index not in read:
                read[index] = _primitives(document, index, materials)
            primitives, matrices = read[index], instance_matrices(document, node)
        parts += [(replace(mesh, **_names(document, node, index)), matrices, node) for mesh in primitives]
        triangles += sum(len(mesh.triangles) for mesh in primitives) * max(len(matrices), 1)
        check_triangles(triangles, f"{document.file}: {node.node.path}")
    meshes = []
    for mesh, matrices, node in parts:
        with np.errstate(over="ignore", invalid="ignore"):
            flat = np.linalg.det(matrices[:, :3, :3]) == 0.0
        if flat.any() and len(matrices) > 1:
            document.note(f"instances of size 0: {flat.sum()} left out")
            matrices = matrices[~flat]
        if len(matrices):
            instances = joined([transformed(mesh, matrix) for matrix in matrices])
            check_mesh(instances, f"{document.file}: {node.node.path}", len(materials) + 1)
            meshes.append(instances)
    return meshes


def _names(document: Document, node: Placed, index: int) -> dict[str, Any]:
    """Name and groups of the meshes of a node: its own name, that of its mesh number `index`, and those above."""
    mesh = document.items("meshes")[index]
    own = [part.label for part in (node.node, mesh) if "name" in part]
    name, *others = own or [mesh.label]
    return {"name": name, "groups": (*others, *node.groups)}


def _primitives(document: Document, index: int, materials: Sequence[Material], joints: np.ndarray | None = None) -> list[Mesh]:
    """The checked primitives of one mesh in its own space, or in world space with the matrices of `joints`."""
    source, meshes = document.items("meshes")[index], []
    for primitive in source.parts("primitives"):
        number = document.link(primitive, "material", "materials")
        material = DEFAULT if number is None else materials[number]
        number = len(materials) if number is None else number
        mesh = read_primitive(document, primitive, source.label, number, material, joints)
        if mesh is not None:
            check_mesh(mesh, f"{document.file}: {primitive.path}", len(materials) + 1)
            meshes.append(mesh)
            check_triangles(sum(len(mesh.triangles) for mesh in meshes), f"{document.file}: {primitive.path}")
    return meshes
