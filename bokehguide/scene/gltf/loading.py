"""glTF files as models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.gltf.animations import Pose, read_pose
from bokehguide.scene.gltf.cameras import read_cameras
from bokehguide.scene.gltf.document import Document, read_document
from bokehguide.scene.gltf.extensions import check_required, note_ignored, warnings
from bokehguide.scene.gltf.import_report import supported
from bokehguide.scene.gltf.lights import default_radius, read_lights
from bokehguide.scene.gltf.materials import DEFAULT, read_materials
from bokehguide.scene.gltf.morphs import morph_weights
from bokehguide.scene.gltf.nodes import INSTANCING, Placed, instance_matrices, place_nodes
from bokehguide.scene.gltf.primitives import Deformation, read_primitive
from bokehguide.scene.gltf.skins import Skins
from bokehguide.scene.gltf.textures import Textures
from bokehguide.scene.gltf.variants import material_of, select_variant
from bokehguide.scene.model import LightSizes, Model, ModelState
from bokehguide.scene.shapes import instanced
from bokehguide.scene.types import Material, Mesh
from bokehguide.scene.validation import check_meshes, check_triangles


def load_gltf(path: Path, files: SceneFiles, sizes: LightSizes, state: ModelState) -> Model:
    """The default scene of a glTF file. Instances become triangles.

    files: the files that the model may name. sizes: of the lights. state: the variant and the time. Raises BokehguideError
    naming file and object for damaged data, values out of range, unknown variants, required but unsupported extensions, and
    more than MAX_TRIANGLES triangles with all instances.
    """
    document = read_document(path, files)
    check_required(document)
    variant, pose = select_variant(document, state.variant), read_pose(document, state.time)
    placed = place_nodes(document, pose)
    textures = Textures(document)
    materials = read_materials(document, textures)
    meshes = _Meshes(document, materials, placed, variant, pose).place()
    if not meshes:
        return Model((), ())
    if any(mesh.material == len(materials) for mesh in meshes):
        materials.append(DEFAULT)
    radius = default_radius(meshes) if sizes.radius is None else sizes.radius
    emitters, emissive, suns = read_lights(document, placed, sizes, radius)
    cameras = read_cameras(document, placed)
    note_ignored(document, state.time is None)
    return Model(
        meshes=tuple(meshes),
        materials=(*materials, *emissive),
        emitters=tuple(replace(emitter, material=emitter.material + len(materials)) for emitter in emitters),
        suns=tuple(suns),
        cameras=tuple(cameras),
        supported=tuple(supported(document, meshes, materials, textures, emissive, suns, cameras, radius, state)),
        warnings=tuple(warnings(document)),
    )


class _Meshes:
    """The meshes of a document. variant: index of the material variant. pose: of nodes and morph targets.

    Primitives without a material have the material index `len(materials)`.
    """

    def __init__(
        self, document: Document, materials: Sequence[Material], placed: Sequence[Placed], variant: int | None, pose: Pose
    ):
        self._document, self._materials, self._placed, self._variant = document, materials, placed, variant
        self._pose, self._skins = pose, Skins(document, placed)
        self._read: dict[tuple[int, int | None, tuple[float, ...]], list[Mesh]] = {}

    def place(self) -> list[Mesh]:
        """All meshes in world space."""
        document, parts = self._document, []
        triangles, instances = 0, 0
        for node in self._placed:
            index = document.link(node.node, "mesh", "meshes")
            if index is None:
                continue
            skin = document.link(node.node, "skin", "skins")
            primitives, matrices = self._deformed(node, index, skin), np.eye(4)[None]
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
        return [mesh for part in parts for mesh in _instances(document, *part)]

    def _deformed(self, node: Placed, index: int, skin: int | None) -> list[Mesh]:
        """The primitives of mesh number `index` at a node, read once for each skin and each set of morph weights."""
        weights = morph_weights(node.node, self._document.items("meshes")[index], self._pose)
        if (index, skin, weights) not in self._read:
            joints = None if skin is None else self._skins.joint_matrices(skin)
            self._read[index, skin, weights] = self._primitives(index, Deformation(weights, joints))
        return self._read[index, skin, weights]

    def _primitives(self, index: int, deformation: Deformation) -> list[Mesh]:
        """The checked primitives of one mesh in its own space, or in world space with a skin."""
        document = self._document
        source, meshes, triangles = document.items("meshes")[index], [], 0
        for primitive in source.parts("primitives"):
            number = material_of(document, primitive, self._variant)
            material = DEFAULT if number is None else self._materials[number]
            number = len(self._materials) if number is None else number
            with located(f"{document.file}: {primitive.path}"):
                mesh = read_primitive(document, primitive, source.label, number, material, deformation)
            if mesh is not None:
                meshes.append(mesh)
                triangles += len(mesh.triangles)
                check_triangles(triangles, f"{document.file}: {primitive.path}", document.files.most_triangles)
        return meshes


def _instances(document: Document, mesh: Mesh, matrices: np.ndarray, place: str, names: dict[str, Any]) -> list[Mesh]:
    """The instances of a mesh under `matrices` `[N, 4, 4]` as one mesh, none if all have size 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        flat = np.linalg.det(matrices[:, :3, :3]) == 0.0
    if flat.any() and len(matrices) > 1:
        document.note(f"instances of size 0: {flat.sum()} left out")
        matrices = matrices[~flat]
    if not len(matrices):
        return []
    with located(place):
        return [replace(instanced(mesh, matrices), **names)]


def _names(document: Document, node: Placed, index: int) -> dict[str, Any]:
    """Name and groups of the meshes of a node: its own name, that of its mesh number `index`, and those above."""
    mesh = document.items("meshes")[index]
    own = [part.label for part in (node.node, mesh) if "name" in part]
    name, *others = own or [mesh.label]
    return {"name": name, "groups": (*others, *node.groups)}
