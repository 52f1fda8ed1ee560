"""Materials of `.mtl` files in the terms of `Material`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import decode_texture, nearest_texels, texture_from_image
from bokehguide.scene.losses import Losses
from bokehguide.scene.tables import FRACTION, IOR, NOT_NEGATIVE, Table
from bokehguide.scene.types import Material, Texture
from bokehguide.scene.vectors import fractions

VECTORS, NUMBERS = ("kd", "ke", "ks"), ("ns", "ni", "d", "tr", "pr", "pm")
NORMALS = ("norm", "map_bump", "bump")
"""Statements of a normal map. Exporters also write normal maps as the height maps of the last two."""
TERMS = {*VECTORS, *NUMBERS, *NORMALS, "map_kd", "map_ke", "map_d"}
"""Supported statements."""
NEEDLESS = {"ka", "map_ka", "illum"}
"""Statements that describe light or a shading model: a path tracer needs none of them."""
GLOSSIEST = 1000.0
"""The exponent Ns of a roughness of 0, as Blender reads and writes it."""
UPWARDS = 0.7
"""Least mean of z of a normal map; a height map and a normal map of object space have less."""
BUMP = re.compile(r"(?:^|\s)-bm\s+(\S+)")
USUAL_KS = (0.5, 0.5, 0.5)
"""The Ks that Blender writes for the reflectance of the refractive index 1.5."""


def ignored_terms(terms: Collection[str]) -> set[str]:
    """The statements `terms` of a material that have no effect and change the surface."""
    return {term for term in terms if not term.startswith("#")} - TERMS - NEEDLESS


def mtl_material(material: Any, name: str, place: str, files: SceneFiles, get: Callable[[str], bytes], lost: Losses) -> Material:
    """The `Material` of a material of trimesh; the default material for None.

    name: of its geometry. place: the model file, for messages. get: reads a file that the material names. lost: gets statements
    without effect. Raises BokehguideError for numbers out of range and for unreadable textures.
    """
    terms = getattr(material, "kwargs", None) or {}
    label = printable(getattr(material, "name", None) or name)
    values = {key: _vector(terms[key]) for key in VECTORS if key in terms}
    values |= {key: _number(terms[key]) for key in NUMBERS if key in terms}
    table = Table(values, place, f"material {label}", values)
    color = _image(material, f"{place}: {label}", files)
    maps = _Maps(terms, f"{place}: {label}", files, get)
    opacity = _opacity(table, maps)
    if isinstance(opacity, np.ndarray):
        color, opacity = _with_alpha(color, opacity), 1.0
    return Material(
        **_emission(table, maps),
        **_normals(maps, label, lost),
        name=name,
        base_color=fractions(table.vector("kd", Material.base_color, NOT_NEGATIVE)),
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


@dataclass(frozen=True)
class _Maps:
    """The images that the statements `terms` of a material name. place: of the material, for messages. get: reads a file."""

    terms: Mapping[str, Any]
    place: str
    files: SceneFiles
    get: Callable[[str], bytes]

    def read(self, key: str, srgb: bool = False, alpha: bool = False) -> np.ndarray | None:
        """The linear pixels of an image, None without the statement and without its file."""
        if key not in self.terms:
            return None
        try:
            data = self.get(" ".join(self.terms[key]))
        except FileNotFoundError:
            return None
        return decode_texture(data, self.place, self.files, srgb, alpha)


def _opacity(table: Table, maps: _Maps) -> float | np.ndarray:
    """The opacity d, or 1 - Tr, as a number; an image `[H, W]` of map_d. A Tr of 1 alone is opaque: some exporters write it."""
    opacity = table.number("d", 1.0, NOT_NEGATIVE) if "d" in table else 1.0 - table.number("tr", 0.0, FRACTION) % 1.0
    opacity = min(max(opacity, 0.0), 1.0)
    image = maps.read("map_d", alpha=True)
    return opacity if image is None else image[..., 3 if image.shape[2] == 4 else 0] * np.float32(opacity)


def _emission(table: Table, maps: _Maps) -> dict[str, Any]:
    """The fields of emission. A Ke of 0 beside a map_Ke is white: Blender writes and reads it so."""
    emission, image = table.vector("ke", Material.emission, NOT_NEGATIVE), maps.read("map_ke", srgb=True)
    if image is None:
        return {"emission": emission}
    return {"emission": emission if any(emission) else (1.0, 1.0, 1.0), "emission_texture": Texture(image)}


def _normals(maps: _Maps, label: str, lost: Losses) -> dict[str, Any]:
    """The fields of the normal map. The option -bm is its strength. A height map is lost."""
    for key in NORMALS:
        image = maps.read(key)
        if image is not None and float(image[..., 2].mean()) < 0.5 * (1.0 + UPWARDS):
            lost.add(f"{key} with a height map: left out; give a normal map", label)
        elif image is not None:
            strength = BUMP.search(" ".join(maps.terms[key]))
            try:
                scale = float(strength[1]) if strength else 1.0
            except ValueError:
                scale = 1.0
            return {"normal_texture": Texture(image), "normal_scale": scale}
    return {}


def _with_alpha(color: np.ndarray | None, alpha: np.ndarray) -> np.ndarray:
    """Colours `[H, W, 3]` with opacities `[h, w]`, `[H', W', 4]` in the larger size; white without colours."""
    color = np.ones((1, 1, 3), np.float32) if color is None else color
    height, width = (max(one, other) for one, other in zip(color.shape, alpha.shape))
    return np.concatenate([nearest_texels(color, height, width), nearest_texels(alpha, height, width)[..., None]], axis=2)
