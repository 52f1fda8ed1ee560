"""Supported glTF extensions, and warnings for unsupported features."""

from __future__ import annotations

from itertools import islice

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.draco import DRACO
from bokehguide.scene.gltf.lights import EXTENSION as LIGHTS
from bokehguide.scene.gltf.nodes import INSTANCING
from bokehguide.scene.gltf.textures import TRANSFORM, WEBP

MATERIAL_EXTENSIONS = (
    *("KHR_materials_emissive_strength", "KHR_materials_transmission", "KHR_materials_ior"),
    *("KHR_materials_volume", "KHR_materials_clearcoat", "KHR_materials_specular", "KHR_materials_unlit"),
)
SUPPORTED = {*MATERIAL_EXTENSIONS, DRACO, LIGHTS, INSTANCING, TRANSFORM, WEBP, "KHR_mesh_quantization"}

EXPLAINED = {
    "KHR_materials_pbrSpecularGlossiness": "the metallic-roughness values are used",
    "KHR_materials_variants": "the default variant is drawn",
    "KHR_texture_basisu": "the fallback image is used, if there is one",
}


def check_required(document: Document) -> None:
    """Raise BokehguideError if the file requires unsupported extensions."""
    unknown = [name for name in document.names("extensionsRequired") if name not in SUPPORTED]
    if unknown:
        raise BokehguideError(
            f"{document.file}: extensionsRequired: {printable(', '.join(unknown), 200)}: not supported; save the file without"
        )


def note_ignored(document: Document) -> None:
    """Note features of the file that no other part of the loader reads."""
    used = {*document.names("extensionsUsed")}
    for material in document.items("materials"):
        used |= {*material.extensions}
    for name in sorted(used - SUPPORTED):
        document.note(f"{name}: {EXPLAINED.get(name, 'has no effect')}")
    if document.items("animations"):
        document.note("animations: the model is drawn in its rest pose")


def warnings(document: Document) -> list[str]:
    """The notes of `document`, one a line, each with the first few names of its objects."""
    return [
        printable(f"{what} ({', '.join(islice(names, 4))}{', …' if len(names) > 4 else ''})" if names else what, 400)
        for what, names in document.notes.items()
    ]
