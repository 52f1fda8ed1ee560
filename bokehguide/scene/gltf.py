"""glTF: geometry by way of trimesh, materials from the file's own JSON.

trimesh quantises baseColorFactor to 8 bits, drops every material extension and joins
geometry to materials by name. So it gets a copy of the file whose materials are named
by their number, and the materials are read here.
"""

from __future__ import annotations

import copy
import importlib.util
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh
from pygltflib import GLTF2
from pygltflib import Material as GltfMaterial

from bokehguide.errors import BokehguideError
from bokehguide.scene.images import texture_from_image
from bokehguide.scene.tables import IOR, NOT_NEGATIVE, SHARE, Table
from bokehguide.scene.types import Material, Texture

DRACO = "KHR_draco_mesh_compression"
UNREADABLE = ("EXT_meshopt_compression", "KHR_meshopt_compression")


def read_gltf(path: Path) -> tuple[GLTF2, trimesh.Scene]:
    """The JSON of `path` and trimesh's scene, whose materials are named by their number.

    Raises BokehguideError where a compression cannot be undone: trimesh would load
    such a mesh as zeros.
    """
    document = GLTF2().load(str(path))
    if document is None:
        raise ValueError("no glTF in it")
    for extension in set(document.extensionsUsed or []) & {DRACO, *UNREADABLE}:
        if extension != DRACO:
            raise BokehguideError(f"{path}: uses {extension}, which cannot be read; save it without")
        if importlib.util.find_spec("DracoPy") is None:
            raise BokehguideError(
                f"{path}: uses {DRACO} and there is no decoder; "
                "install one (pip install DracoPy) or save the file without compression"
            )
    return document, _through_trimesh(document, path)


def _through_trimesh(document: GLTF2, path: Path) -> trimesh.Scene:
    bare = copy.deepcopy(document)
    for index, material in enumerate(bare.materials):
        material.name, material.emissiveFactor = str(index), None
    # A mesh below a camera's node would lose its path to the world.
    bare.cameras = []
    for node in bare.nodes:
        node.camera = None
    binary = path.suffix.lower() == ".glb"
    data = b"".join(bare.save_to_bytes()) if binary else bare.to_json().encode()
    return trimesh.load_scene(
        BytesIO(data),
        file_type="glb" if binary else "gltf",
        resolver=trimesh.resolvers.FilePathResolver(str(path)),
        process=False,
    )


def gltf_materials(document: GLTF2, scene: trimesh.Scene, file: str) -> list[Material]:
    """The materials of `document` in its order; their images come from trimesh's `scene`.

    Raises BokehguideError for factors out of range and images that were not found.
    """
    loaded = {
        geometry.visual.material.name: geometry.visual.material
        for geometry in scene.geometry.values()
        if getattr(geometry.visual, "material", None) is not None
    }
    return [
        _material(material, loaded.get(str(index)), f"material {index}", file)
        for index, material in enumerate(document.materials)
    ]


def _material(source: GltfMaterial, loaded: Any, place: str, file: str) -> Material:
    """One material; `loaded` is trimesh's, None where no geometry uses it."""
    pbr = source.pbrMetallicRoughness
    extensions = source.extensions or {}
    values = _given(pbr, "metallicFactor", "roughnessFactor")
    if pbr is not None and pbr.baseColorFactor is not None:
        values["baseColorFactor"] = pbr.baseColorFactor[:3]
    if source.emissiveFactor is not None:
        values["emissiveFactor"] = source.emissiveFactor
    for extension, key in (
        ("KHR_materials_emissive_strength", "emissiveStrength"),
        ("KHR_materials_transmission", "transmissionFactor"),
        ("KHR_materials_ior", "ior"),
        ("KHR_materials_specular", "specularFactor"),
    ):
        if key in extensions.get(extension, {}):
            values[key] = extensions[extension][key]
    table = Table(values, file, f"{place} ({source.name})" if source.name else place, values)
    # An ior of 0 is the extension's way to say: reflect everything. There is no such solid.
    ior = 1.5 if values.get("ior") == 0 else table.number("ior", 1.5, IOR)
    strength = table.number("emissiveStrength", 1.0, NOT_NEGATIVE)
    emission = table.vector("emissiveFactor", (0.0, 0.0, 0.0), NOT_NEGATIVE)
    emission = tuple(strength * channel for channel in emission)
    if not all(map(NOT_NEGATIVE.hold, emission)):
        table.fail("emissiveStrength", f"times emissiveFactor is out of range; give {NOT_NEGATIVE.remedy}")
    thickness = extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0.0)
    return Material(
        name=source.name or place,
        base_color=table.vector("baseColorFactor", (1.0, 1.0, 1.0), SHARE),
        metallic=table.number("metallicFactor", 1.0, SHARE),
        roughness=table.number("roughnessFactor", 1.0, SHARE),
        specular=table.number("specularFactor", 1.0, SHARE),
        transmission=table.number("transmissionFactor", 0.0, SHARE),
        thin=thickness == 0.0,
        ior=ior,
        emission=emission,
        double_sided=bool(source.doubleSided),
        base_color_texture=_texture(pbr, "baseColorTexture", loaded, table, srgb=True),
        metallic_roughness_texture=_texture(
            pbr, "metallicRoughnessTexture", loaded, table, srgb=False
        ),
        emission_texture=_texture(source, "emissiveTexture", loaded, table, srgb=True),
    )


def _given(source: Any, *keys: str) -> dict[str, Any]:
    """Those attributes of `source` that the file gives."""
    pairs = {key: getattr(source, key, None) for key in keys}
    return {key: value for key, value in pairs.items() if value is not None}


def _texture(source: Any, key: str, loaded: Any, table: Table, srgb: bool) -> Texture | None:
    reference = getattr(source, key, None)
    if reference is None or loaded is None:
        return None
    image = getattr(loaded, key)
    if image is None:
        raise BokehguideError(
            f"{table.place(key)}: texture {reference.index} cannot be read; "
            "put the image beside the model, as PNG, JPEG or WebP"
        )
    return Texture(texture_from_image(image, srgb))
