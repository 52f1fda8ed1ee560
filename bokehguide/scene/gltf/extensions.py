"""Which extensions are honoured, and what else of a file does not reach the picture."""

from __future__ import annotations

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
HONOURED = {*MATERIAL_EXTENSIONS, DRACO, LIGHTS, INSTANCING, TRANSFORM, WEBP, "KHR_mesh_quantization"}

EXPLAINED = {
    "KHR_materials_pbrSpecularGlossiness": "the metallic-roughness values are used",
    "KHR_materials_variants": "the default variant is drawn",
    "KHR_texture_basisu": "textures are taken in their other form, where there is one",
}


def check_required(document: Document) -> None:
    """Raise BokehguideError, naming it, for an extension that is required and not honoured."""
    unknown = [name for name in document.names("extensionsRequired") if name not in HONOURED]
    if unknown:
        raise BokehguideError(
            f"{document.file}: extensionsRequired: {printable(', '.join(unknown), 200)}: not supported; save the file without"
        )


def note_ignored(document: Document) -> None:
    """Note what the file has and no part of the loader asks for."""
    used = {*document.names("extensionsUsed")}
    for material in document.items("materials"):
        used |= {*material.extensions}
    for name in sorted(used - HONOURED):
        document.note(f"{name}: {EXPLAINED.get(name, 'has no effect')}")
    if document.items("animations"):
        document.note("animations: the model is drawn at rest")


def warnings(document: Document) -> list[str]:
    """What was noted, a line each, with the first few of the names it concerns."""
    return [
        printable(f"{what} ({', '.join(names[:4])}{', …' if len(names) > 4 else ''})" if names else what, 400)
        for what, names in document.notes.items()
    ]
