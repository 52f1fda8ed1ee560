"""All textures of a scene in one array, so that one gather serves every hit of a batch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.scene.types import Texture


class TextureAtlas:
    """Linear RGB textures, stored as half floats one after the other.

    `add` returns the texture's number (-1 for None); `build` fixes the atlas.
    """

    def __init__(self) -> None:
        self._images: list[np.ndarray] = []
        self._numbers: dict[int, int] = {}

    def add(self, texture: Texture | None) -> int:
        """The texture's number; the same image is stored once."""
        if texture is None:
            return -1
        image = texture.image
        if id(image) not in self._numbers:
            self._numbers[id(image)] = len(self._images)
            self._images.append(image)
        return self._numbers[id(image)]

    def build(self, device: torch.device | str) -> TextureAtlas:
        """Move the texels to `device`; no texture can be added afterwards."""
        sizes = torch.tensor([image.shape[:2] for image in self._images], dtype=torch.int64).reshape(-1, 2)
        counts = sizes.prod(dim=1)
        self.offsets = (counts.cumsum(0) - counts).to(device)
        self.heights, self.widths = sizes.to(device).unbind(1)
        texels = [torch.from_numpy(np.ascontiguousarray(image, np.float32)).reshape(-1, 3).half() for image in self._images]
        self.texels = torch.cat(texels or [torch.zeros(0, 3).half()]).T.contiguous().to(device)
        return self

    def lookup(self, number: Tensor, uv: Tensor) -> Tensor:
        """Bilinear colours `[3, N]` of textures `number` int64 `[N]` at `uv` `[2, N]`, repeated."""
        width, height = self.widths[number], self.heights[number]
        x = (uv[0] - uv[0].floor()) * width - 0.5
        y = (uv[1] - uv[1].floor()) * height - 0.5
        left, top = x.floor(), y.floor()
        fx, fy = x - left, y - top
        color = torch.zeros(3, x.shape[0], device=x.device)
        for dy, wy in ((0, 1.0 - fy), (1, fy)):
            row = (top.long() + dy) % height * width + self.offsets[number]
            for dx, wx in ((0, 1.0 - fx), (1, fx)):
                color += self.texels.index_select(1, row + (left.long() + dx) % width).float() * (wx * wy)
        return color
