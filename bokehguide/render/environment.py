"""Light from infinitely far away: an equirectangular radiance map, and suns."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.alias import AliasTable
from bokehguide.render.equirectangular import Equirectangular
from bokehguide.render.kernels import kernel
from bokehguide.render.suns import SunDisc
from bokehguide.render.transfers import sent
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.types import Environment, Sun


class EnvironmentLight:
    """The map, the suns or both: their radiances add up, and `sample` chooses between them by power.

    visible: whether camera rays see it. power: luminance that `sample` accounts for,
    integrated over the sphere; where it is 0 there is nothing to sample. map, suns: those that are there.
    """

    def __init__(
        self, environment: Environment | None, suns: tuple[Sun, ...] = (), device: torch.device | str = "cpu"
    ):
        self.visible = environment is None or environment.visible
        self.map = EnvironmentMap(environment, device) if environment is not None else None
        self.suns = [disc for disc in (SunDisc(sun, device) for sun in suns) if disc.power > 0.0]
        powers = np.array([self.map.power if self.map else 0.0, *(disc.power for disc in self.suns)])
        self.power = float(powers.sum())
        self._share = powers / self.power if self.power > 0.0 else powers

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        color = torch.zeros_like(directions) if self.map is None else self.map.radiance(directions)
        for disc in self.suns:
            color = color + disc.color * disc.contains(directions)
        return color

    def alpha(self, directions: Tensor) -> Tensor:
        """What hides the background of camera rays `[3, N]`: all of a map, but of suns alone their discs; `[N]`."""
        if self.map is not None:
            return torch.ones_like(directions[0])
        return sum((disc.contains(directions) for disc in self.suns), torch.zeros_like(directions[0])).clamp(max=1.0)

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[5, N]`."""
        element = self.pick(uniforms[[0, 1, 4]])
        direction = self.directions(element, uniforms[2:4])
        return direction, self.pdf(direction, self.texels(direction, element))

    def pick(self, uniforms: Tensor) -> Tensor:
        """What to sample, by power, from uniform numbers `[3, N]`: texels of the map, or -1, -2, … for the suns."""
        texel = self.map.pick(uniforms[0:2]) if self._share[0] > 0.0 else None
        if not self.suns:
            return texel
        edges = sent(np.cumsum(self._share[:-1]), uniforms.device, torch.float32)
        sun = (uniforms[2] >= edges[:, None]).sum(0, dtype=torch.int32)
        return -sun if texel is None else torch.where(sun > 0, -sun, texel)

    def directions(self, element: Tensor, uniforms: Tensor) -> Tensor:
        """Unit directions `[3, N]` within elements `[N]` as `pick` has them, from uniform numbers `[2, N]`."""
        direction = torch.zeros(3, len(element), device=element.device)
        if self._share[0] > 0.0:
            direction = self.map.directions(element.clamp(min=0), uniforms)
        for number, disc in enumerate(self.suns, start=1):
            direction = torch.where(element == -number, disc.sample(uniforms), direction)
        return direction

    def texels(self, directions: Tensor, element: Tensor | None = None) -> Tensor:
        """Texels of the map `[N]` that unit directions `[3, N]` lie in: those they were drawn in, where they were.

        All 0 where no map is sampled.
        """
        if self._share[0] == 0.0:
            return torch.zeros(directions.shape[1], dtype=torch.int32, device=directions.device)
        if element is None:
            return self.map.texel_at(directions)
        return torch.where(element < 0, self.map.texel_at(directions), element) if self.suns else element

    def pdf(self, directions: Tensor, texel: Tensor | None = None) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`; their texels may be given."""
        density = torch.zeros_like(directions[0])
        if self._share[0] > 0.0:
            density = self.map.density(self.map.texel_at(directions) if texel is None else texel) * self._share[0]
        for disc, share in zip(self.suns, self._share[1:]):
            density = density + share * disc.density * disc.contains(directions)
        return density


class EnvironmentMap:
    """Bilinear radiance over directions, sampled by texel.

    `sample` and `pdf` are densities per unit solid angle, constant within a texel and proportional to what the bilinear
    interpolant's mean there exceeds the map's mean by: what is even is left to BSDF
    sampling ("MIS compensation", Karlík et al. 2019). A map of one colour has nothing to
    sample: its power is 0.
    """

    def __init__(self, environment: Environment, device: torch.device | str = "cpu"):
        radiance = np.asarray(environment.radiance, np.float32)
        self.height, self.width = radiance.shape[:2]
        self.texels = torch.from_numpy(radiance.reshape(-1, 3)).T.contiguous().to(device)
        self._layout = Equirectangular(self.height, self.width, environment.rotation, device)
        rows = np.cos(np.pi * np.arange(self.height + 1) / self.height)
        self._solid_angle = torch.from_numpy((rows[:-1] - rows[1:]) * 2.0 * math.pi / self.width).float().to(device)
        excess = _excess(radiance @ LUMINANCE, self._solid_angle.cpu().numpy()[:, None])
        self.power = float(excess.sum())
        """Luminance above the map's mean, integrated over the sphere."""
        self._table = AliasTable(excess.reshape(-1), device) if self.power > 0.0 else None
        if self.power > 0.0:
            self._density = self._table.probability * self.evenness()

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        texels, across, down = _texels_about(self._layout, directions)
        return _blended(*(self.texels.index_select(1, texel) for texel in texels), across, down)

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[4, N]`."""
        texel = self.pick(uniforms[0:2])
        return self.directions(texel, uniforms[2:4]), self.density(texel)

    def pdf(self, directions: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`."""
        return self.density(self.texel_at(directions))

    def pick(self, uniforms: Tensor) -> Tensor:
        """Texels `[N]`, by power, from uniform numbers `[2, N]`."""
        return self._table.sample(uniforms)

    def directions(self, texel: Tensor, uniforms: Tensor) -> Tensor:
        """Unit directions `[3, N]`, even over texels `[N]`, from uniform numbers `[2, N]`."""
        return _within(self._layout, texel, uniforms)

    def texel_at(self, directions: Tensor) -> Tensor:
        """Texels `[N]` that unit directions `[3, N]` lie in."""
        return _texel_at(self._layout, directions)

    def density(self, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` in texels `[N]`."""
        return self._density.index_select(0, texel)

    def evenness(self) -> Tensor:
        """Solid-angle density within each texel, of directions that are even over it, `[H * W]`."""
        return (1.0 / self._solid_angle).repeat_interleave(self.width)

    def shares(self) -> np.ndarray:
        """Probability of each texel, float32 `[H, W]`; 0 where there is nothing to sample."""
        if self._table is None:
            return np.zeros((self.height, self.width), np.float32)
        return self._table.probability.cpu().numpy().reshape(self.height, self.width)


@kernel
def _texel_at(layout: Equirectangular, directions: Tensor) -> Tensor:
    """Texels `[N]` that unit directions `[3, N]` lie in."""
    column, row = layout.place(directions)  # which may round to the map's width and height
    return row.int().clamp(0, layout.height - 1) * layout.width + column.int().clamp(0, layout.width - 1)


@kernel
def _within(layout: Equirectangular, texel: Tensor, uniforms: Tensor) -> Tensor:
    """Unit directions `[3, N]`, even over texels `[N]`, from uniform numbers `[2, N]`."""
    row, column = texel // layout.width, texel % layout.width
    top, bottom = torch.cos(math.pi / layout.height * row), torch.cos(math.pi / layout.height * (row + 1))
    return layout.around(column + uniforms[0], top + (bottom - top) * uniforms[1])


@kernel
def _texels_about(layout: Equirectangular, directions: Tensor) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """The four texels about unit directions `[3, N]`, row by row, int32 `[N]`, and how far the directions are across and down."""
    left, top, across, down = layout.corner(directions)
    rows, columns = layout.texels(left, top)
    return tuple(row + column for row in rows for column in columns), across, down


@kernel
def _blended(one: Tensor, two: Tensor, three: Tensor, four: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Bilinear: what lies so far between four values `[3, N]`."""
    top, bottom = (1.0 - across) * one + across * two, (1.0 - across) * three + across * four
    return (1.0 - down) * top + down * bottom


def _excess(luminance: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """What each texel `[H, W]` sends beyond its share of the mean luminance, never negative."""
    smooth = _footprint_mean(luminance)
    mean = (smooth * solid_angle).sum() / (4.0 * np.pi)
    excess = smooth - mean
    return np.where(excess > 1e-5 * mean, excess, 0.0) * solid_angle


def _footprint_mean(values: np.ndarray) -> np.ndarray:
    """Means over each texel of the bilinear interpolant of `[H, W]` texel values."""
    across = 0.75 * values + 0.125 * (np.roll(values, 1, axis=1) + np.roll(values, -1, axis=1))
    padded = np.pad(across, ((1, 1), (0, 0)), mode="edge")
    return 0.75 * across + 0.125 * (padded[:-2] + padded[2:])
