"""What of a glTF file does not reach the picture, one line each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pygltflib import GLTF2

HONOURED = {
    *("KHR_materials_emissive_strength", "KHR_materials_transmission", "KHR_materials_ior"),
    *("KHR_materials_specular", "KHR_draco_mesh_compression", "KHR_mesh_quantization"),
    "EXT_texture_webp",
}

EXPLAINED = {
    "KHR_lights_punctual": "its sun, point and spot lights give no light",
    "EXT_mesh_gpu_instancing": "of its instances only one is drawn",
    "KHR_materials_volume": "transmission is not attenuated",
    "KHR_materials_unlit": "its materials are lit like others",
    "KHR_texture_transform": "textures keep their place, scale and turn",
    "KHR_materials_pbrSpecularGlossiness": "the metallic-roughness values are used",
    "KHR_materials_variants": "the default variant is drawn",
}

REPEAT = 10497
TRIANGLES, TRIANGLE_STRIP = 4, 5


def ignored_features(document: GLTF2) -> list[str]:
    """Warnings, each once, in the order of the file's sections."""
    extensions = sorted({*(document.extensionsUsed or []), *(document.extensionsRequired or [])})
    warnings = [
        f"{name}: {EXPLAINED.get(name, 'has no effect')}"
        for name in extensions
        if name not in HONOURED
    ]
    warnings += [*_of_materials(document), *_of_meshes(document)]
    if any(sampler.wrapS not in (None, REPEAT) or sampler.wrapT not in (None, REPEAT)
           for sampler in document.samplers):
        warnings.append("texture wrapping: all textures repeat")
    if document.cameras:
        warnings.append(f"cameras: the file's own ({len(document.cameras)}) are not used")
    if document.animations or document.skins:
        warnings.append("animations and skins: the model is drawn at rest")
    if len(document.scenes) > 1:
        warnings.append(f"scenes: only the default one of {len(document.scenes)} is drawn")
    return warnings


def _of_materials(document: GLTF2) -> Iterator[str]:
    for what, applies in (
        ("normal maps: surfaces keep their own normals", lambda m: m.normalTexture is not None),
        ("alpha mode MASK: drawn opaque", lambda m: m.alphaMode == "MASK"),
        ("alpha mode BLEND: drawn opaque", lambda m: m.alphaMode == "BLEND"),
        ("second texture coordinates: the first are used", lambda m: _uses_second_uvs(m)),
        ("textures in material extensions: only the factors are used", lambda m: _extension_textures(m)),
    ):
        names = [m.name or str(i) for i, m in enumerate(document.materials) if applies(m)]
        if names:
            yield f"{what} ({', '.join(names[:4])}{', …' if len(names) > 4 else ''})"


def _uses_second_uvs(material: Any) -> bool:
    pbr = material.pbrMetallicRoughness
    textures = (material.emissiveTexture, getattr(pbr, "baseColorTexture", None),
                getattr(pbr, "metallicRoughnessTexture", None))
    return any(texture is not None and texture.texCoord for texture in textures)


def _extension_textures(material: Any) -> bool:
    return any(
        name in HONOURED and any(key.endswith("Texture") for key in values)
        for name, values in (material.extensions or {}).items()
    )


def _of_meshes(document: GLTF2) -> Iterator[str]:
    primitives = [primitive for mesh in document.meshes for primitive in mesh.primitives]
    if any(primitive.attributes.COLOR_0 is not None for primitive in primitives):
        yield "vertex colours: have no effect"
    if any(primitive.targets for primitive in primitives):
        yield "morph targets: the model is drawn at rest"
    if any(p.mode not in (None, TRIANGLES, TRIANGLE_STRIP) for p in primitives):
        yield "points, lines and triangle fans: left out"
