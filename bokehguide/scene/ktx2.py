"""KTX 2 textures with ETC1S or UASTC, as KHR_texture_basisu permits them, transcoded by Basis Universal."""

from __future__ import annotations

import struct

import numpy as np

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
HEADER = struct.Struct("<12s9I4I2Q")
"""Identifier, nine properties of the texture, and the places of the other parts."""
LEVEL = struct.Struct("<3Q")
"""Offset, stored bytes and decompressed bytes of a level."""
BLOCK, BLOCK_BYTES = 4, 16
"""Texels along a side of a block of UASTC, and its bytes."""
MAX_LEVELS = 32


def is_ktx2(data: bytes) -> bool:
    """True if `data` begin as a KTX 2 file."""
    return data[: len(IDENTIFIER)] == IDENTIFIER


class Ktx2:
    """A KTX 2 file with one image. width, height: of its largest level, in texels.

    Raises ValueError for damaged data, for cube maps, arrays and volumes, and for other contents than ETC1S and UASTC.
    """

    def __init__(self, data: bytes):
        import opengl_basisu

        self.width, self.height = _check_header(data)
        self._texture = opengl_basisu.open(data)
        if (self._texture.width, self._texture.height) != (self.width, self.height):
            raise ValueError("the size in the header is wrong")

    def pixels(self, alpha: bool) -> np.ndarray:
        """The largest level, uint8 `[H, W, 4]`, or `[H, W, 3]` if it has no alpha or `alpha` is false."""
        texels = self._texture.transcode("rgba8").data
        return np.asarray(texels) if alpha and self._texture.has_alpha else np.ascontiguousarray(texels[..., :3])


def _check_header(data: bytes) -> tuple[int, int]:
    """Width and height. Raises ValueError for sizes to which the decoder must not inflate a level."""
    if len(data) < HEADER.size:
        raise ValueError("cut short")
    _, pixel_format, _, width, height, depth, layers, faces, levels, _, *_ = HEADER.unpack_from(data)
    if pixel_format != 0:
        raise ValueError(f"pixels of VkFormat {pixel_format}; encode the texture as ETC1S or UASTC")
    if width == 0 or height == 0 or depth > 1 or layers > 1 or faces != 1:
        raise ValueError("no single two-dimensional image")
    if levels > MAX_LEVELS or HEADER.size + LEVEL.size * levels > len(data):
        raise ValueError("cut short")
    largest = BLOCK_BYTES * -(-width // BLOCK) * -(-height // BLOCK)
    for number in range(max(levels, 1)):
        _, _, inflated = LEVEL.unpack_from(data, HEADER.size + LEVEL.size * number)
        if inflated > largest:
            raise ValueError("a level is larger than the image")
    return width, height
