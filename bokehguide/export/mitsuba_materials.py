"""Materials in the terms of Mitsuba 3, as the nested dictionaries that `mi.load_dict` reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.anisotropy import to_alphas
from bokehguide.scene.disney_sheen import to_disney
from bokehguide.scene.types import Material, Texture, Vector

SMOOTH_METAL = 0.3
"""Roughness up to which multiple scattering makes a metal brighter by a hundredth at most."""
SMOOTH_GLASS = 0.063
"""Roughness below which glass is smooth."""


@dataclass(frozen=True)
class Bitmap:
    """An image of a dictionary, linear float32 `[H, W]` or `[H, W, 3]`; a writer replaces it by a file."""

    pixels: np.ndarray


def mitsuba_bsdf(material: Material) -> dict[str, Any]:
    """The BSDF that is closest to a material: `dielectric` and its relatives, `diffuse`, or `principled`."""
    return with_opacity(material, _glass(material) if material.transmission >= 0.5 else _opaque(material))


def _glass(material: Material) -> dict[str, Any]:
    """Glass whose surface is tinted; absorption is left out."""
    index = {"int_ior": material.ior, "ext_ior": 1.0}
    index |= {"specular_transmittance": color(material.base_color, material.base_color_texture)}
    if material.thin:
        return {"type": "thindielectric"} | index
    if material.roughness < SMOOTH_GLASS:
        return {"type": "dielectric"} | index
    return {"type": "roughdielectric", "distribution": "ggx", "alpha": material.roughness**2} | index


def _opaque(material: Material) -> dict[str, Any]:
    """A Lambertian surface, or Disney's principled BSDF with the refractive index of the reflectance at normal incidence."""
    base, packed = color(material.base_color, material.base_color_texture), material.metallic_roughness_texture
    sheen = to_disney(material)
    if _is_matte(material) and material.metallic == 0.0 and material.clearcoat == 0.0 and sheen is None:
        bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": base}
    else:
        specular = 0.0 if _is_matte(material) else material.specular
        root = min(math.sqrt(specular) * (material.ior - 1.0) / (material.ior + 1.0), 0.999)
        bsdf = {
            "type": "principled",
            "base_color": base,
            "metallic": _channel(material.metallic, packed, 2),
            "roughness": _channel(material.roughness, packed, 1),
            "eta": (1.0 + root) / (1.0 - root),
        }
        if _exports_anisotropy(material):
            most, least = to_alphas(material.roughness, material.anisotropy)
            bsdf |= {"roughness": (most * least) ** 0.25, "anisotropic": (1.0 - least / most) / 0.9}
        if sheen is not None:
            bsdf |= dict(zip(("sheen", "sheen_tint"), sheen))
        if material.clearcoat > 0.0:
            bsdf |= {"clearcoat": material.clearcoat, "clearcoat_gloss": 1.0 - material.clearcoat_roughness}
    if material.normal_texture is not None:
        bsdf = {"type": "normalmap", "normalmap": bitmap(_normals(material), material.normal_texture), "bsdf": bsdf}
    return {"type": "twosided", "bsdf": bsdf}


def _is_matte(material: Material) -> bool:
    """Whether a dielectric has no coat."""
    return material.specular == 0.0 or (not any(material.specular_color) and material.specular_color_texture is None)


def _exports_anisotropy(material: Material) -> bool:
    """Whether Disney's principled BSDF, whose α along u is at most ten times the α along v, has the anisotropy of a material."""
    most, least = to_alphas(material.roughness, material.anisotropy)
    textured = material.anisotropy_texture is not None or material.metallic_roughness_texture is not None
    return material.anisotropy > 0.0 and material.anisotropy_rotation % 180.0 == 0.0 and not textured and least >= 0.1 * most


def with_opacity(material: Material, bsdf: dict[str, Any]) -> dict[str, Any]:
    """`bsdf` behind the opacity of a material."""
    if material.alpha_mode == "opaque":
        return bsdf
    texture = material.base_color_texture
    opacity: Any = material.opacity
    if texture is not None and texture.image.shape[2] == 4:
        image = material.opacity * texture.image[..., 3]
        cut = material.alpha_mode == "mask"
        opacity = bitmap((image >= material.alpha_cutoff).astype(np.float32) if cut else image, texture)
    elif material.alpha_mode == "mask":
        opacity = float(material.opacity >= material.alpha_cutoff)
    return {"type": "mask", "bsdf": bsdf, "opacity": opacity}


def color(factor: Vector, texture: Texture | None) -> dict[str, Any]:
    """A colour, or an image multiplied by it."""
    if texture is None:
        return {"type": "rgb", "value": list(factor)}
    return bitmap(texture.image[..., :3] * np.asarray(factor, np.float32), texture)


def _channel(factor: float, texture: Texture | None, channel: int) -> Any:
    """A number, or one channel of an image multiplied by it."""
    return factor if texture is None else bitmap(factor * texture.image[..., channel], texture)


def _normals(material: Material) -> np.ndarray:
    """The texels of a normal map with the scale of the material, y upwards as in glTF."""
    assert material.normal_texture is not None
    normals = 2.0 * material.normal_texture.image[..., :3] - 1.0
    normals[..., :2] *= material.normal_scale
    return 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=2, keepdims=True).clip(1e-9)


def bitmap(image: np.ndarray, texture: Texture) -> dict[str, Any]:
    """An image with the addressing and the transform of a texture."""
    a, b, c, d, e, f = texture.transform
    return {
        "type": "bitmap",
        "bitmap": Bitmap(np.ascontiguousarray(image, np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": texture.wrap[0],
        "to_uv": np.array([[a, b, 0.0, c], [d, e, 0.0, f], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]),
    }


def lost_terms(material: Material) -> Sequence[str]:
    """Terms of a material that `mitsuba_bsdf` leaves out or changes, in words."""
    glass, textures = material.transmission >= 0.5, (material.base_color_texture, material.metallic_roughness_texture)
    tests = {
        "partial transmission": 0.0 < material.transmission < 1.0 or material.transmission_texture is not None,
        "absorption": glass and np.isfinite(material.attenuation_distance),
        "roughness texture": glass and material.metallic_roughness_texture is not None,
        "normal texture": glass and material.normal_texture is not None,
        "specular colour": not _is_matte(material)
        and (material.specular_color != (1.0, 1.0, 1.0) or material.specular_color_texture is not None),
        "specular texture": material.specular_texture is not None,
        "clear coat textures": material.clearcoat > 0.0
        and any((material.clearcoat_texture, material.clearcoat_roughness_texture, material.clearcoat_normal_texture)),
        "sheen": any(material.sheen_color) and (glass or to_disney(material) is None),
        "anisotropy": material.anisotropy > 0.0 and (glass or not _exports_anisotropy(material)),
        "multiple scattering of rough metals": material.metallic > 0.0
        and material.roughness > SMOOTH_METAL
        and not material.single_scattering,
        "diffuse transmission": material.diffuse_transmission > 0.0,
        "iridescence": material.iridescence > 0.0,
        "dispersion": material.dispersion > 0.0,
        "emission cone": material.emission_cone is not None,
        "wrap modes that differ along u and v": any(t is not None and len(set(t.wrap)) > 1 for t in textures),
    }
    return [term for term, lost in tests.items() if lost]
