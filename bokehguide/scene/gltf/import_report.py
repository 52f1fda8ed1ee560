"""The import report: supported features of a glTF file in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from bokehguide.scene.gltf.animations import duration
from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.extensions import MATERIAL_EXTENSIONS
from bokehguide.scene.gltf.meshopt_views import compression
from bokehguide.scene.gltf.nodes import INSTANCING
from bokehguide.scene.gltf.textures import Textures, textures_of
from bokehguide.scene.gltf.variants import variant_names
from bokehguide.scene.model import ModelCamera, ModelState
from bokehguide.scene.types import Material, Mesh, Sun


def supported(
    document: Document,
    meshes: Sequence[Mesh],
    materials: Sequence[Material],
    textures: Textures,
    emitters: Sequence[Material],
    suns: Sequence[Sun],
    cameras: Sequence[ModelCamera],
    radius: float,
    state: ModelState,
) -> Iterator[str]:
    """Lines on compression, materials and variants, textures, vertex colours, instances, poses, lights and cameras."""
    yield from _surfaces(document, meshes, materials, textures, state)
    if any(INSTANCING in node.extensions for node in document.items("nodes")):
        yield f"instances of {INSTANCING}, as separate triangles"
    yield from _poses(document, state)
    spots = sum(emitter.emission_cone is not None for emitter in emitters)
    lights = {"point": len(emitters) - spots, "spot": spots, "sun": len(suns)}
    if emitters or suns:
        size = f"; point and spot lights as spheres of radius {radius:.3g} m" if emitters else ""
        yield f"lights: {_counted({kind: count for kind, count in lights.items() if count})}{size}"
    if cameras:
        yield "cameras: " + ", ".join(f"{number} {camera.name}" for number, camera in enumerate(cameras))


def _surfaces(
    document: Document, meshes: Sequence[Mesh], materials: Sequence[Material], textures: Textures, state: ModelState
) -> Iterator[str]:
    """Lines on compression, materials and variants, textures and vertex colours."""
    packed = sum(compression(view) is not None for view in document.items("bufferViews"))
    if packed:
        yield f"buffer views compressed by meshoptimizer: {packed}"
    extensions = Counter(
        name.removeprefix("KHR_materials_")
        for material in document.items("materials")
        for name in material.extensions
        if name in MATERIAL_EXTENSIONS
    )
    if extensions:
        yield f"materials with {_counted(extensions)}"
    variants = variant_names(document)
    if variants:
        yield f"variants: {', '.join(variants)}; drawn: {state.variant or 'the materials without a variant'}"
    modes = Counter(material.alpha_mode for material in materials if material.alpha_mode != "opaque")
    if modes:
        yield f"alpha modes: {_counted(modes)}"
    kinds = Counter(name.removesuffix("_texture").replace("_", " ") for m in materials for name in textures_of(m))
    if kinds:
        yield f"textures from {len(textures.images)} images: {_counted(kinds)}"
    colored = sum(mesh.colors is not None for mesh in meshes)
    if colored:
        yield f"vertex colours: {colored} of {len(meshes)} meshes"


def _poses(document: Document, state: ModelState) -> Iterator[str]:
    """Lines on skins, morph targets and animations."""
    skins = sum("skin" in node for node in document.items("nodes"))
    if skins:
        yield f"skins: {skins}, {'at rest' if state.time is None else f'at {state.time:g} s'}"
    morphed = sum(any("targets" in each for each in mesh.parts("primitives")) for mesh in document.items("meshes"))
    if morphed:
        yield f"meshes with morph targets: {morphed}"
    animations = [f"{each.label}{_until(duration(document, each))}" for each in document.items("animations")]
    if animations:
        yield f"animations: {', '.join(animations)}; drawn: {'none' if state.time is None else f'{state.time:g} s'}"


def _until(seconds: float | None) -> str:
    """The end of an animation in parentheses."""
    return "" if seconds is None else f" (to {seconds:.3g} s)"


def _counted(counts: dict[str, int]) -> str:
    """Names with their counts in parentheses."""
    return ", ".join(f"{name} ({count})" for name, count in counts.items())
