"""KHR_materials_variants: the materials of the primitives by the name of a variant."""

from __future__ import annotations

from bokehguide.errors import BokehguideError, printable
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part

EXTENSION = "KHR_materials_variants"


def variant_names(document: Document) -> list[str]:
    """The names of the file's variants, in order."""
    variants = document.root.extension(EXTENSION).parts("variants")
    return [variant.text("name") or str(number) for number, variant in enumerate(variants)]


def select_variant(document: Document, name: str | None) -> int | None:
    """The index of the variant `name`; None for the materials that need no variant.

    Raises BokehguideError for a name that no variant has.
    """
    if name is None:
        return None
    names = variant_names(document)
    if name not in names:
        known = printable(", ".join(names), 600) or "none"
        raise BokehguideError(f"{document.file}: {printable(name)!r} is no variant of this model; it has {known}")
    return names.index(name)


def material_of(document: Document, primitive: Part, variant: int | None) -> int | None:
    """The index of the material of `primitive` in the variant, None for glTF's default material.

    A primitive without a mapping for the variant keeps its own material.
    """
    if variant is not None and EXTENSION in primitive.extensions:
        for mapping in primitive.extension(EXTENSION).parts("mappings"):
            variants = mapping.values.get("variants", [])
            if not isinstance(variants, list):
                mapping.fail("variants", "is not a list of indices; repair the file")
            if variant in variants:
                return document.required(mapping, "material", "materials")
    return document.link(primitive, "material", "materials")
