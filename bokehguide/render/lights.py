"""Next-event estimation: choose a light, a point on it, and know the density."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.alias import AliasTable
from bokehguide.render.environment import EnvironmentLight
from bokehguide.render.geometry import Geometry, Surface
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.vector import dot, luminance
from bokehguide.scene.types import Scene

MIN_SHARE = 0.1
"""Neither kind of light gets fewer than this share of the light samples."""
POWER_GRID = 4
"""The power of a textured triangle is averaged over this many squared points."""


CANDIDATES = 4
"""Points on lamps that compete for each light sample."""
ROTATION = (1.0 / CANDIDATES, 0.5, 0.7548776662, 0.5698402910)
"""From one candidate to the next: even steps over the lamps, Roberts' R2 sequence over their area."""


class LightSample(NamedTuple):
    """One light sample for each shaded point.

    direction: unit, `[3, N]`; distance `[N]`; radiance: `[3, N]`, 0 for what does not
    count; weight: `[N]`, whose mean over draws makes radiance × weight an unbiased
    integral over solid angle (1/pdf for plain sampling); pdf: `[N]`, per solid angle,
    the density that MIS weighs the sample with.
    """

    direction: Tensor
    distance: Tensor
    radiance: Tensor
    weight: Tensor
    pdf: Tensor


class Lights:
    """Emissive triangles (alias table over power) and the environment map.

    Points on triangles are resampled: of CANDIDATES points drawn by power one is kept by
    the irradiance it would cause unshadowed (Talbot et al. 2005), so that near lamps are
    found among many. All densities are per unit solid angle at the shaded point and
    include the choice between the two kinds.
    """

    def __init__(self, scene: Scene, geometry: Geometry):
        self._geometry = geometry
        device = geometry.device
        self.environment = EnvironmentLight(scene.environment, device) if scene.environment else None
        steps = torch.arange(CANDIDATES, device=device)[:, None]
        self._rotations = torch.tensor(ROTATION, device=device)[:, None, None] * steps  # [4, CANDIDATES, 1]
        triangles = torch.nonzero(geometry.emissive[geometry.material])[:, 0]
        power = _triangle_powers(geometry, triangles)
        triangles, power = triangles[power > 0.0], power[power > 0.0]
        sky = self.environment.power if self.environment else 0.0
        self.environment_share = _environment_share(sky, float(power.sum()), geometry)
        self._area_pdf = torch.zeros(geometry.material.shape[0], device=device)
        self._triangles = triangles
        if len(triangles) > 0:
            self._table = AliasTable(power.cpu().numpy(), device)
            areas = geometry.areas.to(device)[triangles]
            self._area_pdf[triangles] = self._table.probability / areas
            corners = geometry.corners.to(device)[:, :, triangles]
            double_sided = geometry.is_double_sided(triangles)
            brightness = power / (areas * (1.0 + double_sided))
            rows = (corners[0], corners[1] - corners[0], corners[2] - corners[0], geometry.face_normals(triangles))
            self._lamps = torch.cat((*rows, brightness[None], double_sided[None]))  # [14, lamps]

    @property
    def empty(self) -> bool:
        """Whether there is nothing that `sample` could choose."""
        return self.environment_share == 0.0 and len(self._triangles) == 0

    def sample(self, surface: Surface, uniforms: Tensor) -> LightSample:
        """A light sample for each of N surfaces from uniform numbers `[6, N]`."""
        if self.environment_share == 0.0:
            return self._sample_triangles(surface, uniforms[1:])
        if self.environment_share == 1.0:
            return self._sample_environment(uniforms[1:])
        sky = uniforms[0] < self.environment_share
        index = torch.cat((sky.nonzero()[:, 0], (~sky).nonzero()[:, 0]))
        count = int(sky.sum())
        near = index[count:]
        far_samples = self._sample_environment(uniforms[1:5].index_select(1, index[:count]))
        near_samples = self._sample_triangles(surface.select(near), uniforms[1:].index_select(1, near))
        back = torch.empty_like(index)
        back[index] = torch.arange(len(index), device=index.device)
        return LightSample(*(torch.cat(pair, dim=-1).index_select(-1, back) for pair in zip(far_samples, near_samples)))

    def _sample_environment(self, uniforms: Tensor) -> LightSample:
        direction, pdf = self.environment.sample(uniforms[0:4])
        distance = torch.full_like(pdf, MISS_DISTANCE)
        pdf = pdf * self.environment_share
        return LightSample(direction, distance, self.environment.radiance(direction), 1.0 / pdf, pdf)

    def _sample_triangles(self, surface: Surface, uniforms: Tensor) -> LightSample:
        """Resampled importance sampling: candidates by power, one kept by unshadowed irradiance.

        The candidates are rotations of one point set; correlated candidates leave the
        mean unchanged, as long as each is distributed by power.
        """
        rotated = uniforms[0:4, None] + self._rotations
        rotated = (rotated - rotated.floor()).flatten(1)  # [4, candidates × N]
        lamp = self._table.sample(rotated[0:2])
        root = rotated[2].sqrt()
        u, v = root * (1.0 - rotated[3]), root * rotated[3]
        offset, normal, brightness, double_sided = self._on_lamps(lamp, u, v, surface.position)
        squared = dot(offset, offset).clamp(min=1e-30)
        distance = squared.sqrt()
        direction = offset / distance
        cosine = -dot(normal, direction)
        target = brightness * torch.maximum(cosine.sign(), double_sided).clamp(min=0.0) * _receives(surface, direction)
        pdf = self.triangle_pdf(self._triangles.index_select(0, lamp), distance, cosine)
        share = (target / pdf).reshape(CANDIDATES, -1).cumsum(0)
        chosen = (share <= uniforms[4] * share[-1]).sum(0).clamp(max=CANDIDATES - 1)
        kept = chosen * len(chosen) + torch.arange(len(chosen), device=chosen.device)
        direction, fields = direction.index_select(1, kept), torch.stack((distance, u, v, cosine, target, pdf))
        distance, u, v, cosine, target, pdf = fields.index_select(1, kept).unbind(0)
        hit = Hit(self._triangles.index_select(0, lamp.index_select(0, kept)), distance, u, v)
        radiance = self._geometry.emission(hit, (cosine > 0.0).to(torch.float32))
        # `pdf` is that of all candidates together, so the mean over them is in it already.
        return LightSample(direction, distance, radiance, share[-1] / target.clamp(min=1e-30), pdf)

    def _on_lamps(self, lamp: Tensor, u: Tensor, v: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Offsets `[3, K·N]` from points `[3, N]` to lamps, their normals, mean luminance and double-sidedness."""
        rows = self._lamps.index_select(1, lamp)
        target = rows[0:3] + u * rows[3:6] + v * rows[6:9]
        offset = target.reshape(3, CANDIDATES, -1) - points[:, None]
        return offset.flatten(1), rows[9:12], rows[12], rows[13]

    def triangle_pdf(self, triangle: Tensor, distance: Tensor, cosine: Tensor) -> Tensor:
        """Density `[N]` of points on `triangle` at `distance` under `cosine` for MIS.

        It is that of all candidates together; MIS may use any function of the point.
        """
        share = CANDIDATES * (1.0 - self.environment_share)
        return share * self._area_pdf.index_select(0, triangle) * distance * distance / cosine.abs().clamp(min=1e-12)

    def environment_pdf(self, directions: Tensor) -> Tensor:
        """Density `[N]` with which `sample` finds environment directions `[3, N]`."""
        return self.environment_share * self.environment.pdf(directions)


def _receives(surface: Surface, direction: Tensor) -> Tensor:
    """Cosine `[K·N]` at which N surfaces take in light from `direction` `[3, K·N]`; 0 from behind, unless they transmit."""
    cosine = (direction.reshape(3, CANDIDATES, -1) * surface.normal[:, None]).sum(0)
    transmits = (surface.transmission > 0.0).to(torch.float32)
    return torch.maximum(cosine, cosine.abs() * transmits).clamp(min=0.0).flatten()


def _triangle_powers(geometry: Geometry, triangles: Tensor) -> Tensor:
    """Area times mean emitted luminance of each triangle, both faces of a double-sided one."""
    if len(triangles) == 0:
        return torch.zeros(0)
    grid = (torch.arange(POWER_GRID, device=geometry.device) + 0.5) / POWER_GRID
    total = torch.zeros(len(triangles), device=geometry.device)
    ones = torch.ones_like(total)
    for a in grid.tolist():
        for b in grid.tolist():
            root = math.sqrt(a)
            hit = Hit(triangles, ones, ones * (root * (1.0 - b)), ones * (root * b))
            total += luminance(geometry.emission(hit, ones))
    faces = 1.0 + geometry.is_double_sided(triangles)
    return total / POWER_GRID**2 * geometry.areas.to(geometry.device)[triangles] * faces


def _environment_share(sky: float, lamps: float, geometry: Geometry) -> float:
    """Share of light samples for the environment, by the irradiance that each kind may cause.

    The environment gives about sky / 4, the lamps about 4 lamps / extent² half an extent away.
    """
    if sky == 0.0:
        return 0.0
    if lamps == 0.0:
        return 1.0
    box = geometry.corners.amax((0, 2)) - geometry.corners.amin((0, 2))
    irradiance = 4.0 * lamps / float(box.square().sum().clamp(min=1e-30))
    return float(np.clip(sky / 4.0 / (sky / 4.0 + irradiance), MIN_SHARE, 1.0 - MIN_SHARE))
