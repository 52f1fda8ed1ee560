"""Distant lights: discs of constant radiance at infinity, one for each sun of a scene."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.color import LUMINANCE
from bokehguide.render.vector import dot
from bokehguide.scene.types import Sun


class DistantLight:
    """A distant light; `sample` draws directions uniformly over the solid angle of the disc.

    A surface that faces the disc receives the irradiance of the sun, which is radiance · π sin² of half the angle. density: of
    `sample`, per unit solid angle. radiance: `[3, 1]`. power: luminance integrated over the solid angle.
    """

    def __init__(self, sun: Sun, device: torch.device | str = "cpu"):
        half = math.radians(sun.angle) / 2.0
        self._height = 2.0 * math.sin(half / 2.0) ** 2  # 1 - cos half, which would lose the digits of a small disc
        self._squared_radius = 2.0 * self._height  # of the chord from the centre to the rim
        self.density = 1.0 / (2.0 * math.pi * self._height)
        self.radiance = torch.tensor(sun.irradiance, device=device)[:, None] / (math.pi * math.sin(half) ** 2)
        self.power = float(LUMINANCE @ sun.irradiance) / (math.pi * math.sin(half) ** 2 * self.density)
        self._frame = frame_about(sun.direction).to(device)

    def contains(self, directions: Tensor) -> Tensor:
        """Whether unit directions `[3, N]` lie within the disc, float32 `[N]` of 0 or 1."""
        offset = directions - self._frame[:, 2:]
        return (dot(offset, offset) <= self._squared_radius).to(torch.float32)

    def row(self, share: float) -> Tensor:
        """All of the light as float32 `[16]`, for the native core; share: of the samples of the environment."""
        numbers = torch.tensor([self._height, self._squared_radius, self.density, *self.radiance.flatten().tolist(), share])
        return torch.cat((self._frame.flatten(), numbers))

    def sample(self, uniforms: Tensor) -> Tensor:
        """Unit directions `[3, N]` from uniform numbers `[2, N]`."""
        return cap_directions(self._frame, self._height, uniforms)


def cap_directions(frame: Tensor, height: float, uniforms: Tensor) -> Tensor:
    """Unit directions `[3, N]`, uniform over the cap of the sphere about the third column of `frame`.

    height: 1 - cosine of half the angle of the cap. uniforms: `[2, N]`.
    """
    down = height * uniforms[0]
    sine = (down * (2.0 - down)).sqrt()
    phi = 2.0 * math.pi * uniforms[1]
    return frame @ torch.stack((sine * phi.cos(), sine * phi.sin(), 1.0 - down))


def frame_about(direction: tuple[float, float, float]) -> Tensor:
    """A right-handed orthonormal basis with `direction` as its third column, `[3, 3]`."""
    z = torch.tensor(direction, dtype=torch.float64)
    z = z / z.norm()
    across = torch.zeros(3, dtype=torch.float64)
    across[int(z.abs().argmin())] = 1.0
    x = torch.linalg.cross(across, z)
    x = x / x.norm()
    return torch.stack((x, torch.linalg.cross(z, x), z), dim=1).float()
