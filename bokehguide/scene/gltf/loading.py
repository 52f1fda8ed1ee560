"""glTF files as models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.cameras import read_cameras
from bokehguide.scene.gltf.document import Document, read_document
from bokehguide.scene.gltf.extensions import check_required, note_ignored, warnings
from bokehguide.scene.gltf.import_report import supported
from bokehguide.scene.gltf.lights import default_radius, read_lights
from bokehguide.scene.gltf.materials import DEFAULT, read_materials
from bokehguide.scene.gltf.nodes import INSTANCING, Placed, instance_matrices, place_nodes
from bokehguide.scene.gltf.primitives import read_primitive
from bokehguide.scene.gltf.skins import Skins
from bokehguide.scene.gltf.textures import Textures
from bokehguide.scene.shapes import instanced
from bokehguide.scene.types import LightSizes, Material, Mesh, Model
from bokehguide.scene.validation import check_meshes, check_triangles


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
    read: dict[tuple[int, int | None], list[Mesh]] = {}
    skins = Skins(document, placed)
    parts: list[tuple[Mesh, np.ndarray, str, dict[str, Any]]] = []
    triangles, instances = 0, 0
    for node in placed:
        index = document.link(node.node, "mesh", "meshes")
        if index is None:
            continue
        skin = document.link(node.node, "skin", "skins")
        joints = None if skin is None else skins.joint_matrices(skin)
        if (index, skin) not in read:
            read[index, skin] = _primitives(document, index, materials, joints)
        primitives, matrices = read[index, skin], np.eye(4)[None]
        if skin is None:
            matrices = instance_matrices(document, node, document.files.most_instances - instances)
            instances += len(matrices) if INSTANCING in node.node.extensions else 0
        elif INSTANCING in node.node.extensions:  # the joints replace the node's own matrix
            document.note(f"{INSTANCING} of skinned meshes: one instance is drawn", node.node.label)
        place, names = f"{document.file}: {node.node.path}", _names(document, node, index)
        check_meshes(len(parts) + len(primitives), place, document.files.most_meshes)
        parts += [(mesh, matrices, place, names) for mesh in primitives]
        triangles += sum(len(mesh.triangles) for mesh in primitives) * max(len(matrices), 1)
        check_triangles(triangles, place, document.files.most_triangles)
    meshes = []
    for mesh, matrices, place, names in parts:
        with np.errstate(over="ignore", invalid="ignore"):
            flat = np.linalg.det(matrices[:, :3, :3]) == 0.0
        if flat.any() and len(matrices) > 1:
            document.note(f"instances of size 0: {flat.sum()} left out")
            matrices = matrices[~flat]
        if len(matrices):
            with located(place):
                meshes.append(replace(instanced(mesh, matrices), **names))
    return meshes


def _names(document: Document, node: Placed, index: int) -> dict[str, Any]:
    """Name and groups of the meshes of a node: its own name, that of its mesh number `index`, and those above."""
    mesh = document.items("meshes")[index]
    own = [part.label for part in (node.node, mesh) if "name" in part]
    name, *others = own or [mesh.label]
    return {"name": name, "groups": (*others, *node.groups)}


def _primitives(document: Document, index: int, materials: Sequence[Material], joints: np.ndarray | None = None) -> list[Mesh]:
    """The checked primitives of one mesh in its own space, or in world space with the matrices of `joints`."""
    source, meshes, triangles = document.items("meshes")[index], [], 0
    for primitive in source.parts("primitives"):
        number = document.link(primitive, "material", "materials")
        material = DEFAULT if number is None else materials[number]
        number = len(materials) if number is None else number
        with located(f"{document.file}: {primitive.path}"):
            mesh = read_primitive(document, primitive, source.label, number, material, joints)
        if mesh is not None:
            meshes.append(mesh)
            triangles += len(mesh.triangles)
            check_triangles(triangles, f"{document.file}: {primitive.path}", document.files.most_triangles)
    return meshes
