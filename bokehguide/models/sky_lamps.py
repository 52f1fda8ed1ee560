"""Lamps of an environment map, seen through a focus point on the lens as bright as the map has them.

A point at infinity is seen through x_F from one lens point alone, so that a density over directions is one over the
lens plane. That of a lamp here is its luminance as the map interpolates it: a tent over each of its texels. Nothing is
left of a lamp's shape, or of what is uneven in it, to make noise.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.models.projection import FAR_OUTSIDE
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.equirectangular import Equirectangular
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import indices
from bokehguide.render.vector import dot, normalize
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.types import Environment


class SkyLamps:
    """S lamps, and their densities per unit area of the lens plane.

    texel_lamp: `[H, W]`, which lamp each texel of the map belongs to, -1 for none. Texels of different lamps do not
    touch, not even at their corners.
    """

    def __init__(self, environment: Environment, texel_lamp: np.ndarray, camera: ThinLensCamera):
        self._camera, device = camera, camera.position.device
        height, width = texel_lamp.shape
        self._map = Equirectangular(height, width, environment.rotation, device)
        texel = np.flatnonzero(texel_lamp >= 0)
        lamp = texel_lamp.reshape(-1)[texel]
        order = np.lexsort((texel, lamp))
        texel, lamp = texel[order], lamp[order]
        row = texel // width
        light = environment.radiance.reshape(-1, 3)[texel].astype(np.float64) @ LUMINANCE * np.sin(np.pi * (row + 0.5) / height)
        light /= np.bincount(lamp, light)[lamp]
        # Rows of each lamp, by their light, and within them texels: two numbers choose one, and stay evenly spread.
        starts = np.flatnonzero(np.diff(lamp * height + row, prepend=-1))
        span = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(texel)))
        of_row = np.add.reduceat(light, starts)
        self._rows = _Choice(of_row, lamp[starts], device)
        self._texels = _Choice(light / of_row[span], span, device)
        self._texel = torch.from_numpy(texel).to(device)
        slot = np.zeros(height * width, np.int32)
        slot[texel] = np.arange(1, len(texel) + 1)
        self._slot = torch.from_numpy(slot).to(device)
        """Place of each texel in what follows, 0 for those of no lamp."""
        self._light = torch.from_numpy(np.append(0.0, light).astype(np.float32)).to(device)
        self._lamp = torch.from_numpy(np.append(-1, lamp)).to(device)

    def sample(self, lamp: Tensor, uniforms: Tensor, focus: Tensor) -> Tensor:
        """Lens points `[2, N]` that see lamps `[N]` through x_F `[3, N]`, from uniform numbers `[2, N]`."""
        row, down = self._rows.sample(lamp, uniforms[0])
        place, across = self._texels.sample(row, uniforms[1])
        texel = self._texel.index_select(0, place)
        x = texel % self._map.width + 0.5 + _tent(across)
        y = texel // self._map.width + 0.5 + _tent(down)
        local = self._camera.axes.T @ self._map.directions(x, y)
        ahead = (local[2] > 0.0) & (y > 0.0) & (y < self._map.height)
        return torch.where(ahead, focus[:2] - local[:2] * (focus[2] / local[2]), FAR_OUTSIDE)

    def evaluate(self, points: Tensor, focus: Tensor) -> tuple[Tensor, Tensor]:
        """The lamp that lens points `[2, N]` see through x_F `[3, N]`, -1 for none, and its density there, `[N]` both."""
        row, column, tents, scale = _texels_around(self._map, self._camera.axes, points, focus)
        lamp, density = torch.full_like(scale, -1, dtype=torch.int64), torch.zeros_like(scale)
        for down in range(2):
            for across in range(2):
                slot = self._slot.index_select(0, row[down] + column[across]).long()
                density += tents[2 * down + across] * self._light.index_select(0, slot)
                lamp = torch.maximum(lamp, self._lamp.index_select(0, slot))
        return lamp, density * scale


@kernel
def _texels_around(
    layout: Equirectangular, axes: Tensor, points: Tensor, focus: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor, Tensor]:
    """The four texels about what lens points `[2, N]` see through x_F `[3, N]`.

    The first texel of their rows, and columns, int32 `[N]`; tents over the texels `[4, N]`; and the density of lens points
    where that of places on the map is 1, `[N]`.
    """
    ray = torch.cat((focus[:2] - points, focus[2:3]))
    distance = dot(ray, ray).sqrt()
    right, up, forward = axes.T
    towards = normalize(right[:, None] * ray[0] + up[:, None] * ray[1] + forward[:, None] * ray[2])
    left, top, fx, fy = layout.corner(towards)
    up, down = (1.0 - fy) * (top >= 0.0), fy * (top + 1.0 < layout.height)
    tents = torch.stack(((1.0 - fx) * up, fx * up, (1.0 - fx) * down, fx * down))
    rows, columns = layout.texels(left, top)
    sine = (towards[0] * towards[0] + towards[2] * towards[2]).sqrt()  # that of y has few digits near the poles
    solid_angle = 2.0 * math.pi**2 / (layout.height * layout.width) * sine
    return rows, columns, tents, focus[2] / (distance * distance * distance * solid_angle.clamp(min=1e-30))


class SeenSky:
    """Those of M candidates that are lamps of the map, seen through x_F `[3, N]` of the pixels that own them.

    number: which of `lamps` each candidate is, -1 for the others, int64 `[M]`; owner: int64 `[M]`. index: of the K
    candidates that are lamps of the map.
    """

    def __init__(self, lamps: SkyLamps, number: Tensor, owner: Tensor, focus: Tensor):
        self.index = indices(number >= 0)
        self._lamps, self._focus = lamps, focus
        self._number, self._owner = number.index_select(0, self.index), owner.index_select(0, self.index)

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of those at `place` among the K, from uniform numbers `[2, J]`."""
        focus = self._focus.index_select(1, self._owner.index_select(0, place))
        return self._lamps.sample(self._number.index_select(0, place), uniforms, focus)

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the lens points `[2, N]` of the pixels, per unit area of the lens plane."""
        lamp, density = (values.index_select(0, self._owner) for values in self._lamps.evaluate(points, self._focus))
        return density * (lamp == self._number)


class _Choice:
    """One of several members of a group, by weight; what is left of the number that chose is uniform again.

    weight `[K]`, of sum 1 in each group; group: ascending, `[K]`.
    """

    def __init__(self, weight: np.ndarray, group: np.ndarray, device: torch.device):
        first = np.flatnonzero(np.diff(group, prepend=-1))
        whole = np.cumsum(weight)
        start = np.concatenate(([0.0], whole[:-1]))
        low = start - np.repeat(start[first], np.diff(first, append=len(group))) + group
        self._low, self._weight = (torch.from_numpy(values).to(device) for values in (low, weight))

    def sample(self, group: Tensor, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Members and what is left of uniform numbers, float32 `[N]`, for groups `[N]`."""
        target = group + uniforms.double()
        place = torch.searchsorted(self._low, target, right=True) - 1
        left = (target - self._low.index_select(0, place)) / self._weight.index_select(0, place)
        return place, left.float().clamp(0.0, 1.0)


def _tent(uniforms: Tensor) -> Tensor:
    """Numbers in -1 … 1 of density 1 - |x| from uniform ones."""
    centred = 2.0 * uniforms - 1.0
    return torch.copysign(1.0 - (1.0 - centred.abs()).clamp(min=0.0).sqrt(), centred)
