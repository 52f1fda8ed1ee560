"""The latest picture of a viewport on the GPU. Importing needs no GPU."""

from __future__ import annotations

import numpy as np

BRIGHTEST = 65504.0
"""Largest number in half precision."""


class ViewportTexture:
    """Draws a picture over a region.

    pixels: linear premultiplied RGBA, float32 `[H, W, 4]`, bottom row first; None after the texture has them.
    """

    def __init__(self) -> None:
        self.pixels: np.ndarray | None = None
        self._texture = None

    def draw(self, width: int, height: int) -> None:
        """Stretch the latest picture over `width` × `height` pixels of the region that is drawn now."""
        import gpu
        from gpu_extras.presets import draw_texture_2d

        if self.pixels is not None:
            rows, columns, _ = self.pixels.shape
            values = np.minimum(self.pixels, BRIGHTEST, dtype=np.float32).ravel()
            buffer = gpu.types.Buffer("FLOAT", values.size, values)
            self._texture = gpu.types.GPUTexture((columns, rows), format="RGBA16F", data=buffer)
            self.pixels = None
        if self._texture is not None:
            gpu.state.blend_set("ALPHA_PREMULT")
            draw_texture_2d(self._texture, (0, 0), width, height)
            gpu.state.blend_set("NONE")
