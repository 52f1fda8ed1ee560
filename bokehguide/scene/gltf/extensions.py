"""Supported glTF extensions, and warnings for unsupported features."""

from __future__ import annotations

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.gltf.animations import POINTER
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.draco import DRACO
from bokehguide.scene.gltf.lights import EXTENSION as LIGHTS
from bokehguide.scene.gltf.meshopt_views import EXTENSIONS as MESHOPT
from bokehguide.scene.gltf.nodes import INSTANCING
from bokehguide.scene.gltf.specular_glossiness import EXTENSION as GLOSSINESS
from bokehguide.scene.gltf.textures import FORMATS, TRANSFORM
from bokehguide.scene.gltf.variants import EXTENSION as VARIANTS

MATERIAL_EXTENSIONS = (
    *("KHR_materials_emissive_strength", "KHR_materials_transmission", "KHR_materials_ior"),
    *("KHR_materials_volume", "KHR_materials_clearcoat", "KHR_materials_specular", "KHR_materials_unlit", GLOSSINESS),
    *("KHR_materials_sheen", "KHR_materials_anisotropy", "KHR_materials_diffuse_transmission", "KHR_materials_iridescence"),
    "KHR_materials_dispersion",
)
SUPPORTED = {*MATERIAL_EXTENSIONS, *MESHOPT, *FORMATS, DRACO, LIGHTS, INSTANCING, TRANSFORM, VARIANTS, "KHR_mesh_quantization"}
HARMLESS = {POINTER}
"""Unsupported extensions without which a model at rest is complete, even if the file requires them."""


def check_required(document: Document) -> None:
    """Raise BokehguideError if the file requires unsupported extensions."""
    unknown = [name for name in document.names("extensionsRequired") if name not in SUPPORTED | HARMLESS]
    if unknown:
        raise BokehguideError(
            f"{document.file}: extensionsRequired: {printable(', '.join(unknown), 200)}: not supported; save the file without"
        )


def note_ignored(document: Document, at_rest: bool) -> None:
    """Note features of the file that no other part of the loader reads. at_rest: whether no animation is drawn."""
    used = {*document.names("extensionsUsed")}
    for material in document.items("materials"):
        used |= {*material.extensions}
    for name in sorted(used - SUPPORTED):
        document.note(f"{name}: has no effect")
    if at_rest and document.items("animations"):
        document.note("animations: the model is drawn in its rest pose; give a time to draw another")
    if not at_rest and not document.items("animations"):
        document.note("time: has no effect, as the model has no animations")


def warnings(document: Document) -> list[str]:
    """The notes of `document`, one a line, each with the first few names of its objects."""
    return document.notes.lines()
