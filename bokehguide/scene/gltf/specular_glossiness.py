"""KHR_materials_pbrSpecularGlossiness in the terms of `Material`.

The extension gives the diffuse albedo, the reflectance f0 at normal incidence and the glossiness. An equal surface of `Material`
is not metallic, has the diffuse albedo as its base colour, the roughness 1 - glossiness, and a specular colour that scales the
reflectance of the refractive index 1.5, which is 0.04, to f0.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.gltf.textures import Textures
from bokehguide.scene.tables import FRACTION
from bokehguide.scene.types import Texture, as_vector

EXTENSION = "KHR_materials_pbrSpecularGlossiness"
WHITE = (1.0, 1.0, 1.0)
F0 = 0.04
"""Reflectance at normal incidence for the refractive index 1.5, by which the specular colour is divided."""


def specular_glossiness(part: Part, textures: Textures, alpha: bool) -> dict[str, Any]:
    """The fields of `Material` from the extension of a material. alpha: the opacity has an effect.

    Raises BokehguideError naming file, material and key for factors out of range.
    """
    gloss = part.extension(EXTENSION)
    red, green, blue, opacity = gloss.numbers("diffuseFactor", 4, (*WHITE, 1.0), FRACTION)
    glossiness = gloss.number("glossinessFactor", 1.0, FRACTION)
    image = textures.read(gloss, "specularGlossinessTexture", srgb=True, alpha=True)
    return {
        "base_color": (red, green, blue),
        "opacity": opacity,
        "base_color_texture": textures.read(gloss, "diffuseTexture", srgb=True, alpha=alpha),
        "metallic": 0.0,
        "roughness": 1.0 - glossiness if image is None else 1.0,
        "metallic_roughness_texture": None if image is None else _roughness(image, glossiness),
        "ior": 1.5,
        "specular_color": as_vector(f0 / F0 for f0 in gloss.vector("specularFactor", WHITE, FRACTION)),
        "specular_color_texture": None if image is None else replace(image, image=image.image[..., :3]),
    }


def _roughness(texture: Texture, glossiness: float) -> Texture:
    """The roughness 1 - glossiness of a specular-glossiness texture, in the channel of a metallic-roughness texture."""
    pixels = texture.image
    stored = pixels[..., 3] if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], np.float32)
    rough = np.zeros((*stored.shape, 3), np.float32)
    rough[..., 1] = 1.0 - np.float32(glossiness) * stored
    return replace(texture, image=rough)
