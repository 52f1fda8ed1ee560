"""Images of colours that the exporter takes for 8-bit sRGB, as sRGB."""

from __future__ import annotations

import bpy
import numpy as np

from .node_chains import DATA, images_of
from .png import png

SLOTS = {"Base Color": "baseColorTexture", "Emission Color": "emissiveTexture"}
"""glTF textures by the inputs of the Principled BSDF node whose images are converted."""


def converted_images(node: bpy.types.Node) -> dict[str, bpy.types.Image]:
    """The images of a Principled BSDF node that need a conversion, by glTF texture.

    Pixels of floats are linear Rec.709 from every colour space, and so are pixels of 8 bits in a linear space. Textures that also
    hold the alpha are left out.
    """
    found = {}
    for name, slot in SLOTS.items():
        images = images_of(node.inputs[name])
        with_alpha = slot == "baseColorTexture" and node.inputs["Alpha"].is_linked
        if len(images) == 1 and images[0] is not None and not with_alpha and _is_convertible(images[0]):
            found[slot] = images[0]
    return found


def _is_convertible(image: bpy.types.Image) -> bool:
    """Whether the exporter takes an image for sRGB, and its linear pixels are known."""
    return image.source in ("FILE", "GENERATED") and (image.is_float or image.colorspace_settings.name in DATA)


def srgb_png(image: bpy.types.Image) -> bytes:
    """A PNG file with the linear pixels of an image in sRGB of 8 bits; values above 1 become 1."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    colors = pixels.reshape(height, width, image.channels)[::-1, :, : 3 if image.channels > 2 else 1]
    linear = np.nan_to_num(np.clip(np.broadcast_to(colors, (height, width, 3)), 0.0, 1.0))
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return png((255.0 * encoded + 0.5).astype(np.uint8))
