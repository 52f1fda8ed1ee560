"""All textures of a scene in one array. A batch of hits then needs one gather for each of the four texels of a look-up."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bokehguide.scene.types import Texture

HALF_MAX = 65504.0
"""Largest half float; textures with larger values are stored divided by their maximum."""
_IDENTITY = Texture.transform


class TextureAtlas:
    """Linear RGBA textures in one array. An int64 holds the four half floats of a texel.

    `add` returns the number of a texture, -1 for None; `build` completes the atlas. Images of three channels get an alpha of 1.
    """

    def __init__(self) -> None:
        self._images: list[tuple[np.ndarray, bool]] = []
        self._places: dict[tuple[int, bool], int] = {}
        self._textures: list[tuple[Texture, int]] = []
        self._numbers: dict[tuple, int] = {}

    def add(self, texture: Texture | None, signed: bool = False) -> int:
        """Number of the texture. Equal images are stored once.

        signed: look-ups return 2 x - 1, as for normal maps. The atlas stores 2 x - 1, so that values near 0 keep their digits.
        """
        if texture is None:
            return -1
        place = self._places.setdefault((id(texture.image), signed), len(self._images))
        if place == len(self._images):
            self._images.append((texture.image, signed))
        key = (place, texture.uv_set, texture.wrap, texture.transform)
        number = self._numbers.setdefault(key, len(self._textures))
        if number == len(self._textures):
            self._textures.append((texture, place))
        return number

    def build(self, device: torch.device | str) -> TextureAtlas:
        """Move the texels to `device`. After this call, no texture can be added."""
        textures = [texture for texture, _ in self._textures]
        place = torch.tensor([place for _, place in self._textures], dtype=torch.int64)
        halves, scales = zip(*(_halves(*image) for image in self._images)) if self._images else ((), ())
        counts = torch.tensor([len(texels) for texels in halves], dtype=torch.int64)
        self.texels = torch.cat([texels.view(torch.int64)[:, 0] for texels in halves] or [counts]).to(device)
        self.start = (counts.cumsum(0) - counts)[place].to(device)
        sizes = torch.tensor([texture.image.shape[1::-1] for texture in textures], dtype=torch.int64).reshape(-1, 2)
        self.sizes = sizes.T.contiguous().to(device)  # [2, textures]: width, height
        self.bounds = None
        if any(texture.wrap != ("repeat", "repeat") for texture in textures):
            bounds = [[_bounds(size, wrap) for size, wrap in zip(t.image.shape[1::-1], t.wrap)] for t in textures]
            self.bounds = torch.tensor(bounds).permute(1, 2, 0).contiguous().to(device)  # [axis, 3, textures]
        self.transforms = None
        if any(texture.transform != _IDENTITY for texture in textures):
            self.transforms = torch.tensor([texture.transform for texture in textures]).T.contiguous().to(device)
        self.scales = torch.tensor(scales)[place].to(device) if any(scale != 1.0 for scale in scales) else None
        self.uv_sets = tuple(sorted({texture.uv_set for texture in textures}))
        """The uv sets that textures use; `uv_set` is each texture's place among them."""
        places = [self.uv_sets.index(texture.uv_set) for texture in textures]
        self.uv_set = torch.tensor(places, dtype=torch.int64, device=device)
        return self

    def lookup(self, number: Tensor, uv: Tensor) -> Tensor:
        """Bilinear RGBA `[4, N]` of textures `number` int64 `[N]` at the mesh's `uv` `[2, N]`."""
        if self.transforms is not None:
            rows = self.transforms.index_select(1, number)
            uv = rows[0::3] * uv[0] + rows[1::3] * uv[1] + rows[2::3]
        columns, right = self._neighbours(number, uv[0], 0)
        lines, below = self._neighbours(number, uv[1], 1)
        start, width = self.start.index_select(0, number), self.sizes[0].index_select(0, number)
        color = torch.zeros(len(number), 4, device=uv.device)
        for line, wy in zip(lines, (1.0 - below, below)):
            first = start + line * width
            for column, wx in zip(columns, (1.0 - right, right)):
                texel = self.texels.index_select(0, first + column).view(torch.float16).view(-1, 4)
                color.addcmul_(texel.float(), (wx * wy)[:, None])
        if self.scales is not None:
            color *= self.scales.index_select(0, number)[:, None]
        return color.T.contiguous()

    def _neighbours(self, number: Tensor, coordinate: Tensor, axis: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Texel indices on both sides of a coordinate `[N]`, and the weight of the second."""
        size = self.sizes[axis].index_select(0, number)
        x = coordinate * size - 0.5
        floor = x.floor()
        index = floor.long()
        if self.bounds is None:
            return (index % size, (index + 1) % size), x - floor
        low, high, period = self.bounds[axis].index_select(1, number)
        pair = (torch.minimum(torch.maximum(i, low), high) % period for i in (index, index + 1))
        # The second half of a mirrored period is reversed; other textures end before it.
        first, second = (torch.minimum(i, 2 * size - 1 - i) for i in pair)
        return (first, second), x - floor


def _halves(image: np.ndarray, signed: bool) -> tuple[Tensor, float]:
    """Texels `[H W, 4]` as half floats, and the factor by which they were divided."""
    texels = torch.ones(image.shape[0] * image.shape[1], 4, dtype=torch.float16)
    values = torch.from_numpy(np.ascontiguousarray(image, np.float32)).reshape(len(texels), -1)
    if signed:
        values = 2.0 * values - 1.0
    peak = max(abs(float(extreme)) for extreme in torch.aminmax(values))
    scale = peak / HALF_MAX if peak > HALF_MAX else 1.0
    texels[:] = 1.0 / scale
    texels[:, : values.shape[1]] = values if scale == 1.0 else values / scale
    return texels, scale


def _bounds(size: int, wrap: str) -> tuple[int, int, int]:
    """Lowest and highest texel index of an axis of `size` texels, and its period."""
    if wrap == "clamp":
        return 0, size - 1, size
    unbounded = torch.iinfo(torch.int64)
    return unbounded.min, unbounded.max, 2 * size if wrap == "mirror" else size
