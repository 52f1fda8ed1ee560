"""Light from infinitely far away: an equirectangular radiance map, and suns."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.alias import AliasTable
from bokehguide.render.suns import SunDisc
from bokehguide.render.vector import polar_angle
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.types import Environment, Sun


class EnvironmentLight:
    """The map, the suns or both: their radiances add up, and `sample` chooses between them by power.

    visible: whether camera rays see it. power: luminance that `sample` accounts for,
    integrated over the sphere; where it is 0 there is nothing to sample.
    """

    def __init__(
        self, environment: Environment | None, suns: tuple[Sun, ...] = (), device: torch.device | str = "cpu"
    ):
        self.visible = environment is None or environment.visible
        self._map = EnvironmentMap(environment, device) if environment is not None else None
        self._suns = [disc for disc in (SunDisc(sun, device) for sun in suns) if disc.power > 0.0]
        powers = np.array([self._map.power if self._map else 0.0, *(disc.power for disc in self._suns)])
        self.power = float(powers.sum())
        self._share = powers / self.power if self.power > 0.0 else powers

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        color = torch.zeros_like(directions) if self._map is None else self._map.radiance(directions)
        for disc in self._suns:
            color = color + disc.color * disc.contains(directions)
        return color

    def alpha(self, directions: Tensor) -> Tensor:
        """What hides the background of camera rays `[3, N]`: all of a map, but of suns alone their discs; `[N]`."""
        if self._map is not None:
            return torch.ones_like(directions[0])
        return sum((disc.contains(directions) for disc in self._suns), torch.zeros_like(directions[0])).clamp(max=1.0)

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[5, N]`."""
        if not self._suns:
            return self._map.sample(uniforms[0:4])
        edges = np.cumsum(self._share).tolist()
        direction = self._suns[-1].sample(uniforms[0:2])
        for disc, edge in zip(self._suns[-2::-1], edges[-2:0:-1]):
            direction = torch.where(uniforms[4] < edge, disc.sample(uniforms[0:2]), direction)
        if self._share[0] > 0.0:
            direction = torch.where(uniforms[4] < edges[0], self._map.sample(uniforms[0:4])[0], direction)
        return direction, self.pdf(direction)

    def pdf(self, directions: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`."""
        density = torch.zeros_like(directions[0])
        if self._share[0] > 0.0:
            density = self._map.pdf(directions) * self._share[0]
        for disc, share in zip(self._suns, self._share[1:]):
            density = density + share * disc.density * disc.contains(directions)
        return density


class EnvironmentMap:
    """Bilinear radiance over directions, sampled by texel.

    The map's centre lies at -z and u grows towards +x. `sample` and `pdf` are densities
    per unit solid angle, constant within a texel and proportional to what the bilinear
    interpolant's mean there exceeds the map's mean by: what is even is left to BSDF
    sampling ("MIS compensation", Karlík et al. 2019). A map of one colour has nothing to
    sample: its power is 0.
    """

    def __init__(self, environment: Environment, device: torch.device | str = "cpu"):
        radiance = np.asarray(environment.radiance, np.float32)
        self.height, self.width = radiance.shape[:2]
        self.texels = torch.from_numpy(radiance.reshape(-1, 3)).T.contiguous().to(device)
        self._turn = math.radians(environment.rotation) / (2.0 * math.pi)
        rows = np.cos(np.pi * np.arange(self.height + 1) / self.height)
        self._solid_angle = torch.from_numpy((rows[:-1] - rows[1:]) * 2.0 * math.pi / self.width).float().to(device)
        excess = _excess(radiance @ LUMINANCE, self._solid_angle.cpu().numpy()[:, None])
        self.power = float(excess.sum())
        """Luminance above the map's mean, integrated over the sphere."""
        self._table = AliasTable(excess.reshape(-1), device) if self.power > 0.0 else None

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        u, v = self._uv(directions)
        x, y = u * self.width - 0.5, v * self.height - 0.5
        left, top = x.floor(), y.floor()
        fx, fy = x - left, y - top
        color = torch.zeros_like(directions)
        for dy, wy in ((0, 1.0 - fy), (1, fy)):
            row = (top.long() + dy).clamp(0, self.height - 1) * self.width
            for dx, wx in ((0, 1.0 - fx), (1, fx)):
                color += self.texels.index_select(1, row + (left.long() + dx) % self.width) * (wx * wy)
        return color

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[4, N]`."""
        texel = self._table.sample(uniforms[0:2])
        row, column = texel // self.width, texel % self.width
        phi = 2.0 * math.pi * ((column + uniforms[2]) / self.width - 0.5 - self._turn)
        top, bottom = torch.cos(math.pi * row / self.height), torch.cos(math.pi * (row + 1) / self.height)
        y = top + (bottom - top) * uniforms[3]
        sine = (1.0 - y * y).clamp(min=0.0).sqrt()
        return torch.stack((sine * phi.sin(), y, -sine * phi.cos())), self._density(texel, row)

    def pdf(self, directions: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`."""
        u, v = self._uv(directions)
        row = (v * self.height).long().clamp(0, self.height - 1)
        column = (u * self.width).long() % self.width
        return self._density(row * self.width + column, row)

    def _density(self, texel: Tensor, row: Tensor) -> Tensor:
        return self._table.pdf(texel) / self._solid_angle.index_select(0, row)

    def _uv(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = directions.unbind(0)
        u = 0.5 + polar_angle(x, -z) / (2.0 * math.pi) + self._turn
        return u - u.floor(), torch.acos(y.clamp(-1.0, 1.0)) / math.pi


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
