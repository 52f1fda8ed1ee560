"""Light from infinity: an equirectangular map of radiance, and distant lights."""

from __future__ import annotations

import logging
import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.color import LUMINANCE
from bokehguide.render.lights.alias_table import AliasTable
from bokehguide.render.lights.distant import DistantLight
from bokehguide.render.lights.equirectangular import Equirectangular
from bokehguide.runtime.device import to_device
from bokehguide.scene.types import Environment, Sun

log = logging.getLogger(__name__)


class EnvironmentLight:
    """A map, distant lights, or both. The radiances are added, and `sample` chooses the map or a distant light by power.

    map: None without a map. distant: distant lights with positive power. numbers: of their suns. visible: whether
    camera rays see the environment. power: luminance integrated over the sphere, of the part that `sample` covers; 0 if there is
    nothing to sample.

    An element of the environment is a texel of the map, or -1, -2, … for the distant lights.
    """

    def __init__(self, environment: Environment | None, suns: tuple[Sun, ...] = (), device: torch.device | str = "cpu"):
        self.visible = environment is None or environment.visible
        self.map = EnvironmentMap(environment, device) if environment is not None else None
        lights = [DistantLight(sun, device) for sun in suns]
        self.numbers = [number for number, light in enumerate(lights) if light.power > 0.0]
        self.distant = [lights[number] for number in self.numbers]
        powers = np.array([self.map.power if self.map else 0.0, *(light.power for light in self.distant)])
        self.power = float(powers.sum())
        self.share = powers / self.power if self.power > 0.0 else powers
        self.sampled_map = self.map if powers[0] > 0.0 else None

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        color = torch.zeros_like(directions) if self.map is None else self.map.radiance(directions)
        for light in self.distant:
            color = color + light.radiance * light.contains(directions)
        return color

    def alpha(self, directions: Tensor) -> Tensor:
        """Alpha `[N]` of camera rays in unit directions `[3, N]`: 1 with a map, else 1 in the discs of distant lights."""
        if self.map is not None:
            return torch.ones_like(directions[0])
        return sum((light.contains(directions) for light in self.distant), torch.zeros_like(directions[0])).clamp(max=1.0)

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[5, N]`."""
        element = self.sample_element(uniforms[[0, 1, 4]])
        direction = self.directions(element, uniforms[2:4])
        return direction, self.pdf(direction, self.texels(direction, element))

    def sample_element(self, uniforms: Tensor) -> Tensor:
        """Elements `[N]`, drawn in proportion to their power from uniform numbers `[3, N]`."""
        texel = None if self.sampled_map is None else self.sampled_map.sample_element(uniforms[0:2])
        if texel is not None and not self.distant:
            return texel
        edges = to_device(np.cumsum(self.share[:-1]), uniforms.device, torch.float32)
        number = (uniforms[2] >= edges[:, None]).sum(0, dtype=torch.int32)
        return -number if texel is None else torch.where(number > 0, -number, texel)

    def directions(self, element: Tensor, uniforms: Tensor) -> Tensor:
        """Unit directions `[3, N]` within elements `[N]`, from uniform numbers `[2, N]`."""
        direction = torch.zeros(3, len(element), device=element.device)
        if self.sampled_map is not None:
            direction = self.sampled_map.directions(element.clamp(min=0), uniforms)
        for number, light in enumerate(self.distant, start=1):
            direction = torch.where(element == -number, light.sample(uniforms), direction)
        return direction

    def texels(self, directions: Tensor, element: Tensor | None = None) -> Tensor:
        """Texels of the map `[N]` that unit directions `[3, N]` lie in, all 0 where no map is sampled.

        element: elements from which the directions were drawn, None for other directions. With `element`, rounding moves no
        direction to another texel.
        """
        if self.sampled_map is None:
            return torch.zeros(directions.shape[1], dtype=torch.int32, device=directions.device)
        if element is None:
            return self.sampled_map.texel_at(directions)
        return torch.where(element < 0, self.sampled_map.texel_at(directions), element) if self.distant else element

    def pdf(self, directions: Tensor, texel: Tensor | None = None) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`; their texels may be given."""
        density = torch.zeros_like(directions[0])
        if self.sampled_map is not None:
            texel = self.sampled_map.texel_at(directions) if texel is None else texel
            density = self.sampled_map.density(texel) * self.share[0]
        for light, share in zip(self.distant, self.share[1:]):
            density = density + share * light.density * light.contains(directions)
        return density


class EnvironmentMap:
    """Bilinear radiance over directions, sampled by texel.

    Densities are per unit solid angle and constant within a texel. The density of a texel is proportional to the excess of its
    mean luminance over the mean luminance of the map. BSDF sampling covers the rest (MIS compensation, Karlík et al. 2019). A map
    of one colour has the power 0.
    """

    def __init__(self, environment: Environment, device: torch.device | str = "cpu"):
        radiance = np.asarray(environment.radiance, np.float32)
        self.height, self.width = radiance.shape[:2]
        log.info("preparing the environment map of %d x %d texels", self.width, self.height)
        self.texels = torch.zeros(radiance.size // 3, 4, device=device)
        """Radiance and solid-angle density of `sample`, `[texels, 4]`. The density is 0 where nothing is to be sampled."""
        self.texels[:, :3] = torch.from_numpy(radiance.reshape(-1, 3))
        self.layout = Equirectangular(self.height, self.width, environment.rotation, device)
        rows = np.cos(np.pi * np.arange(self.height + 1) / self.height)
        self._solid_angle = torch.from_numpy((rows[:-1] - rows[1:]) * 2.0 * math.pi / self.width).float().to(device)
        excess = _excess(radiance @ LUMINANCE, self._solid_angle.cpu().numpy()[:, None])
        self.power = float(excess.sum())
        """Luminance above the map's mean, integrated over the sphere."""
        self.table = AliasTable(excess.reshape(-1), device) if self.power > 0.0 else None
        if self.table is not None:
            self.texels[:, 3] = self.probability * self.uniform_density()

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance `[3, N]` from unit directions `[3, N]`."""
        left, top, across, down = self.layout.corner(directions)
        rows, columns = self.layout.texels(left, top)
        one, two, three, four = (self.texels.index_select(0, row + column).T for row in rows for column in columns)
        upper, lower = (1.0 - across) * one + across * two, (1.0 - across) * three + across * four
        return ((1.0 - down) * upper + down * lower)[:3]

    def sample(self, uniforms: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions `[3, N]` and their solid-angle densities `[N]` from uniform numbers `[4, N]`."""
        texel = self.sample_element(uniforms[0:2])
        return self.directions(texel, uniforms[2:4]), self.density(texel)

    def pdf(self, directions: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` at unit directions `[3, N]`."""
        return self.density(self.texel_at(directions))

    def sample_element(self, uniforms: Tensor) -> Tensor:
        """Texels `[N]`, drawn in proportion to their power from uniform numbers `[2, N]`."""
        assert self.table is not None
        return self.table.sample(uniforms)

    def directions(self, texel: Tensor, uniforms: Tensor) -> Tensor:
        """Unit directions `[3, N]`, uniform over texels `[N]`, from uniform numbers `[2, N]`."""
        row, column = texel // self.width, texel % self.width
        top, bottom = torch.cos(math.pi / self.height * row), torch.cos(math.pi / self.height * (row + 1))
        return self.layout.around(column + uniforms[0], top + (bottom - top) * uniforms[1])

    def texel_at(self, directions: Tensor) -> Tensor:
        """Texels `[N]` that unit directions `[3, N]` lie in."""
        column, row = self.layout.place(directions)  # rounding may give the map's width or height
        return row.int().clamp(0, self.height - 1) * self.width + column.int().clamp(0, self.width - 1)

    def density(self, texel: Tensor) -> Tensor:
        """Solid-angle density `[N]` of `sample` in texels `[N]`."""
        return self.texels[:, 3].index_select(0, texel)

    @property
    def probability(self) -> Tensor:
        """Probability of drawing each texel, `[H * W]`."""
        assert self.table is not None
        return self.table.probability

    def uniform_density(self) -> Tensor:
        """Solid-angle density of uniform directions over each texel, `[H * W]`."""
        return (1.0 / self._solid_angle).repeat_interleave(self.width)

    def shares(self) -> np.ndarray:
        """Probability of each texel, float32 `[H, W]`; all 0 if there is nothing to sample."""
        if self.table is None:
            return np.zeros((self.height, self.width), np.float32)
        return self.table.probability.cpu().numpy().reshape(self.height, self.width)


def _excess(luminance: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """Excess of each texel `[H, W]` over the mean luminance, times the solid angle, never negative."""
    smooth = _footprint_mean(luminance)
    mean = (smooth * solid_angle).sum() / (4.0 * np.pi)
    excess = smooth - mean
    # On a map of one colour, rounding may leave a small excess.
    return np.where(excess > 1e-5 * mean, excess, 0.0) * solid_angle


def _footprint_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the bilinear interpolant over each texel, of texel values `[H, W]`."""
    across = 0.75 * values + 0.125 * (np.roll(values, 1, axis=1) + np.roll(values, -1, axis=1))
    padded = np.pad(across, ((1, 1), (0, 0)), mode="edge")
    return 0.75 * across + 0.125 * (padded[:-2] + padded[2:])
