"""Materials of `.mtl` files in the terms of `Material`."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import decode_texture, nearest_texels, texture_from_image
from bokehguide.scene.tables import FRACTION, IOR, NOT_NEGATIVE, Table
from bokehguide.scene.types import Material, Texture, as_vector

VECTORS, NUMBERS = ("kd", "ke", "ks"), ("ns", "ni", "d", "tr", "pr", "pm")
TERMS = {*VECTORS, *NUMBERS, "map_kd", "map_d"}
"""Supported statements."""
NEEDLESS = {"ka", "map_ka", "illum"}
"""Statements that describe light or a shading model: a path tracer needs none of them."""
GLOSSIEST = 1000.0
"""The exponent Ns of a roughness of 0, as Blender reads and writes it."""
USUAL_KS = (0.5, 0.5, 0.5)
"""The Ks that Blender writes for the reflectance of the refractive index 1.5."""


def ignored_terms(terms: Collection[str]) -> set[str]:
    """The statements `terms` of a material that have no effect and change the surface."""
    return {term for term in terms if not term.startswith("#")} - TERMS - NEEDLESS


def mtl_material(material: Any, name: str, place: str, files: SceneFiles, get: Callable[[str], bytes]) -> Material:
    """The `Material` of a material of trimesh; the default material for None.

    name: of its geometry. place: the model file, for messages. get: reads a file that the material names. Raises BokehguideError
    for numbers out of range and for unreadable textures.
    """
    terms = getattr(material, "kwargs", None) or {}
    label = printable(getattr(material, "name", None) or name)
    values = {key: _vector(terms[key]) for key in VECTORS if key in terms}
    values |= {key: _number(terms[key]) for key in NUMBERS if key in terms}
    table = Table(values, place, f"material {label}", values)
    color = _image(material, f"{place}: {label}", files)
    opacity = _opacity(table, terms, f"{place}: {label}", files, get)
    if isinstance(opacity, np.ndarray):
        color, opacity = _with_alpha(color, opacity), 1.0
    return Material(
        name=name,
        base_color=as_vector(min(channel, 1.0) for channel in table.vector("kd", Material.base_color, NOT_NEGATIVE)),
        emission=table.vector("ke", Material.emission, NOT_NEGATIVE),
        metallic=min(table.number("pm", 0.0, NOT_NEGATIVE), 1.0),
        roughness=_roughness(table),
        ior=_index(table),
        specular=min(sum(table.vector("ks", USUAL_KS, NOT_NEGATIVE)) / sum(USUAL_KS), 1.0),
        opacity=opacity,
        alpha_mode="opaque" if opacity == 1.0 and (color is None or color.shape[2] == 3) else "blend",
        base_color_texture=None if color is None else Texture(color),
    )


def _number(words: Any) -> Any:
    """The last word of a statement as a number, or unchanged if it is none. Options such as -halo stand before."""
    last: Any = words[-1] if isinstance(words, list) and words else words
    try:
        return float(last)
    except (TypeError, ValueError):
        return last


def _vector(words: Any) -> Any:
    """`words` as numbers, or unchanged if they are none."""
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError):
        return words


def _roughness(table: Table) -> float:
    """The roughness Pr, or that of the exponent Ns."""
    if "pr" in table:
        return min(table.number("pr", 1.0, NOT_NEGATIVE), 1.0)
    return 1.0 - math.sqrt(min(table.number("ns", 0.0, NOT_NEGATIVE) / GLOSSIEST, 1.0))


def _index(table: Table) -> float:
    """The refractive index Ni; many files give 1 for surfaces with reflections."""
    index = table.number("ni", Material.ior, NOT_NEGATIVE)
    return min(index, IOR.high) if index > 1.0 else Material.ior


def _image(material: Any, place: str, files: SceneFiles) -> np.ndarray | None:
    """The image map_Kd, linear `[H, W, 3]`."""
    image = getattr(material, "image", None)
    if image is None or image.format is None:  # a placeholder of trimesh for uvs without an image
        return None
    return texture_from_image(image, place, files)


def _opacity(
    table: Table, terms: Mapping[str, Any], place: str, files: SceneFiles, get: Callable[[str], bytes]
) -> float | np.ndarray:
    """The opacity d, or 1 - Tr, as a number; an image `[H, W]` of map_d. A Tr of 1 alone is opaque: some exporters write it."""
    opacity = table.number("d", 1.0, NOT_NEGATIVE) if "d" in table else 1.0 - table.number("tr", 0.0, FRACTION) % 1.0
    opacity = min(max(opacity, 0.0), 1.0)
    if "map_d" not in terms:
        return opacity
    try:
        data = get(" ".join(terms["map_d"]))
    except FileNotFoundError:
        return opacity
    image = decode_texture(data, place, files, srgb=False, alpha=True)
    return image[..., 3 if image.shape[2] == 4 else 0] * np.float32(opacity)


def _with_alpha(color: np.ndarray | None, alpha: np.ndarray) -> np.ndarray:
    """Colours `[H, W, 3]` with opacities `[h, w]`, `[H', W', 4]` in the larger size; white without colours."""
    color = np.ones((1, 1, 3), np.float32) if color is None else color
    height, width = (max(one, other) for one, other in zip(color.shape, alpha.shape))
    return np.concatenate([nearest_texels(color, height, width), nearest_texels(alpha, height, width)[..., None]], axis=2)
