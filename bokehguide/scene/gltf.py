"""What trimesh loses of a glTF file: read from the file's JSON.

trimesh quantises baseColorFactor to 8 bits, drops every material extension, and joins
geometry to materials by name only. So the materials are read here, and trimesh gets a
copy of the file whose materials are named by their number.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh
from pygltflib import GLTF2

from bokehguide.errors import BokehguideError
from bokehguide.scene.images import texture_from_image
from bokehguide.scene.tables import IOR, NOT_NEGATIVE, SHARE, Limits
from bokehguide.scene.types import Material

EMISSIVE_STRENGTH = "KHR_materials_emissive_strength"
TRANSMISSION = "KHR_materials_transmission"
INDEX_OF_REFRACTION = "KHR_materials_ior"
SPECULAR = "KHR_materials_specular"
DRACO = "KHR_draco_mesh_compression"

HONOURED = {EMISSIVE_STRENGTH, TRANSMISSION, INDEX_OF_REFRACTION, SPECULAR, DRACO}
"""Extensions whose meaning reaches the picture; EXT_texture_webp through Pillow too."""

UNREADABLE = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""Extensions without which there is no geometry."""


@dataclass
class GltfFile:
    """The JSON of a file, and the scene that trimesh makes of it."""

    path: Path
    document: GLTF2

    def geometry(self) -> trimesh.Scene:
        """trimesh's scene; each geometry's material is named by its number in the JSON."""
        for index, material in enumerate(self.document.materials):
            material.name = str(index)
        # A mesh below a camera or a light makes trimesh lose its path to the world.
        for node in self.document.nodes:
            node.camera = None
        self.document.cameras = []
        binary = self.path.suffix.lower() == ".glb"
        data = b"".join(self.document.save_to_bytes()) if binary else self.document.to_json().encode()
        resolver = trimesh.resolvers.FilePathResolver(str(self.path))
        kind = "glb" if binary else "gltf"
        return trimesh.load_scene(BytesIO(data), file_type=kind, resolver=resolver, process=False)
