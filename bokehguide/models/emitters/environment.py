"""Emitters of an environment map as densities on the lens, proportional to the luminance of the map.

A point at infinity is visible through x_F from one lens point only, so that a density over directions gives a density over the
lens plane. The density of an emitter is proportional to the bilinearly interpolated luminance of the map, a sum of tent functions
over the texels of the emitter. The shape of the emitter and the variation of its luminance therefore cause no noise. The
distribution excludes rows and columns of texels that the lens does not see (`lens_cone.py`). docs/explanation/lens-densities.md
derives the formulas.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.models.emitters.lens_cone import LensCone, lens_cone, row_interval, row_range
from bokehguide.models.emitters.piecewise_linear import PiecewiseLinear
from bokehguide.models.projection import FAR_OUTSIDE
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lights.equirectangular import Equirectangular
from bokehguide.render.vector import dot, normalize, to_world
from bokehguide.runtime.indexing import ActiveEntries


class MapLine(NamedTuple):
    """Horizontal lines on the map, one for each of N pairs of emitter and cone. A line is between the centres of two texel rows.

    segments: segments of the emitter in both rows, int64 `[N]` each. tents: interpolation weights of both rows, `[2, N]`. low,
    mass: flux of each row before the cone and inside the cone, `[2, N]`. interval: first and last column (see `row_interval`),
    `[N]` each.
    """

    segments: tuple[Tensor, Tensor]
    tents: Tensor
    low: Tensor
    mass: Tensor
    interval: tuple[Tensor, Tensor]


class EnvironmentEmitters:
    """S emitters of a map and their densities per unit area of the lens plane.

    A segment is the set of texels of one emitter in one row. The flux of each emitter is normalised to 1.

    luminance: of the map, `[H, W]`; only texels of emitters are used. texel_emitter: emitter of each texel, -1 for none,
    `[H, W]`. Texels of different emitters must not touch, not even at corners. rotation: of the map about y, degrees.
    """

    def __init__(self, luminance: np.ndarray, texel_emitter: np.ndarray, rotation: float, camera: ThinLensCamera):
        self._camera, device = camera, camera.position.device
        height, width = texel_emitter.shape
        self._map = Equirectangular(height, width, rotation, device)
        texel = np.flatnonzero(texel_emitter >= 0)
        emitter, (row, column) = texel_emitter.reshape(-1)[texel], np.divmod(texel, width)
        flux = luminance.reshape(-1)[texel] * np.sin(np.pi * (row + 0.5) / height)
        outside = 0.125 * ((row == 0) + 1.0 * (row == height - 1))  # share of a tent beyond the map's top or bottom
        flux /= np.bincount(emitter, flux * (1.0 - outside))[emitter]
        self._make_densities(emitter, row, column, flux, device)
        self._columns = torch.from_numpy(_column_ranges(emitter, column, width)).to(device)
        """Middle column and half width of each emitter, texels, `[2, S]`."""
        slot = np.zeros(height * width, np.int32)
        slot[texel] = np.arange(1, len(texel) + 1)
        self._slot = torch.from_numpy(slot).to(device)
        """Index of each texel in `_flux` and `_emitter`; 0 for texels of no emitter."""
        self._flux = torch.from_numpy(np.append(0.0, flux).astype(np.float32)).to(device)
        self._emitter = torch.from_numpy(np.append(-1, emitter)).to(device)

    def in_core(self, extension: ModuleType) -> object:
        """The emitters in the native core, by the names of `EnvironmentTable` in `native/tables.h`."""
        arrays = {"axes": self._camera.axes, "whole": self.whole, "columns": self._columns, "segment": self._segment}
        arrays |= {"emitter": self._emitter, "slot": self._slot, "flux": self._flux}
        numbers = {"width": self._map.width, "height": self._map.height, "turn": float(self._map.turn)}
        for prefix, density in (("segments", self._segments), ("rows", self._rows)):
            arrays |= {f"{prefix}_{name}": table for name, table in density.tables().items()}
            numbers[f"{prefix}_period"] = density.period
        tables = {name: table.contiguous() for name, table in arrays.items()}
        return extension.EnvironmentShapes(tables, {name: float(value) for name, value in numbers.items()})

    def _make_densities(
        self, emitter: np.ndarray, row: np.ndarray, column: np.ndarray, flux: np.ndarray, device: torch.device
    ) -> None:
        """The piecewise linear densities along each segment and down each emitter, from texels `[K]`."""
        height, width = self._map.height, self._map.width
        keys, segment = np.unique(emitter * height + row, return_inverse=True)
        self._segments = PiecewiseLinear(len(keys) + 1, segment, column, flux, width, device)
        """Densities along each segment. The last density is empty."""
        emitters, rows = np.divmod(keys, height)
        segment_flux = self._segments.total[:-1].cpu().numpy()
        self._rows = PiecewiseLinear(int(emitter.max()) + 1, emitters, rows + 1, segment_flux, height + 2, device)
        """Densities over the rows of each emitter, with an empty row above the map and an empty row below the map."""
        knots, _ = self._rows.find(*(torch.from_numpy(values).to(device) for values in (emitters, rows + 1.0)))
        self._segment = torch.full((len(self._rows.position) + 1,), len(keys), device=device)
        """Segment of each knot of `_rows`."""
        self._segment[knots] = torch.arange(len(keys), device=device)
        every = torch.arange(int(emitter.max()) + 1, device=device)
        ends = (torch.full_like(every, end + 0.5, dtype=torch.float64) for end in (0, height))
        self.whole = torch.stack([self._rows.integral(every, end) for end in ends])
        """`visible_rows` of emitters that lie completely in the cone, `[2, S]`."""

    def cones(self, focus: Tensor) -> LensCone:
        """Cones of directions from the lens through x_F `[3, N]`."""
        return lens_cone(self._map, self._camera, focus)

    def visible_rows(self, emitter: Tensor, cone: LensCone) -> Tensor:
        """Flux of emitters `[N]` above the first and above the last row that the cones contain, float64 `[2, N]`."""
        middle, half = self._columns.index_select(1, emitter)
        top, bottom = row_range(self._map, cone, middle, half)
        return torch.stack((self._rows.integral(emitter, top + 0.5), self._rows.integral(emitter, bottom + 0.5)))

    def _line(self, emitter: Tensor, cone: LensCone, y: Tensor) -> MapLine:
        """The lines of emitters `[N]` at `y` `[N]`, in texels below the map's top."""
        knot, beyond = self._rows.find(emitter, y + 0.5)
        segments = self._segment.index_select(0, knot), self._segment.index_select(0, knot + 1)
        interval = row_interval(self._map, cone, y)
        low, high = (
            torch.stack([self._segments.integral(segment, cone.column + end - 0.5) for segment in segments]) for end in interval
        )
        return MapLine(segments, torch.stack((1.0 - beyond, beyond)), low, high - low, interval)

    def sample(self, emitter: Tensor, cone: LensCone, rows: Tensor, uniforms: Tensor, focus: Tensor) -> Tensor:
        """Lens points `[2, N]` that see emitters `[N]` through x_F `[3, N]`, from uniform numbers `[2, N]`.

        The first number chooses the row in proportion to the flux of the whole row. The second number chooses the column in
        proportion to the luminance inside the cone. If the cone contains nothing of the emitter, the point is FAR_OUTSIDE. rows:
        from `visible_rows`.
        """
        down, across = uniforms.double()
        y = self._rows.inverse(emitter, rows[0] + down * (rows[1] - rows[0])) - 0.5
        line = self._line(emitter, cone, y)
        mass = line.tents * line.mass
        target = across * mass.sum(0)
        upper = target < mass[0]
        target = torch.where(upper, target / line.tents[0], (target - mass[0]) / line.tents[1]) + torch.where(upper, *line.low)
        x = self._segments.inverse(torch.where(upper, *line.segments), target) + 0.5
        local = self._camera.axes.T @ self._map.directions(x.float(), y.float())
        visible = (local[2] > 0.0) & (mass.sum(0) > 0.0) & (rows[1] > rows[0])
        return torch.where(visible, focus[:2] - local[:2] * (focus[2] / local[2]), FAR_OUTSIDE)

    def evaluate(self, points: Tensor, focus: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Emitter, position on the map and density without clipping for lens points `[2, N]` that see the map through x_F
        `[3, N]`.

        The emitter is `[N]`, -1 for none. The position is in texels, float64 `[2, N]`. The density is per unit lens area, `[N]`.
        """
        row, column, tents, place, scale = _texels_around(self._map, self._camera.axes, points, focus)
        emitter, density = torch.full_like(scale, -1, dtype=torch.int64), torch.zeros_like(scale)
        for down in range(2):
            for across in range(2):
                slot = self._slot.index_select(0, row[down] + column[across]).long()
                density += tents[2 * down + across] * self._flux.index_select(0, slot)
                emitter = torch.maximum(emitter, self._emitter.index_select(0, slot))
        return emitter, place.double(), density * scale

    def clipping_factor(self, emitter: Tensor, cone: LensCone, rows: Tensor, place: Tensor) -> Tensor:
        """Density of `sample` over density of `evaluate` at positions `[2, N]` on the map, float64 `[N]`; 0 outside the cones.

        The factor is F / (f · R). F is the flux of the row, f is the flux of the row inside the cone, and R is the flux of all
        visible rows.
        """
        x, y = place
        line = self._line(emitter, cone, y)
        offset = (x - cone.column) / self._map.width
        offset = (offset - offset.round()) * self._map.width
        above = self._rows.integral(emitter, y + 0.5)
        inside = (offset >= line.interval[0]) & (offset <= line.interval[1]) & (above >= rows[0]) & (above <= rows[1])
        visible = (rows[1] - rows[0]) * (line.tents * line.mass).sum(0)
        totals = torch.stack([self._segments.total.index_select(0, segment) for segment in line.segments])
        return torch.where(inside & (visible > 0.0), (line.tents * totals).sum(0) / visible, 0.0)


def _column_ranges(emitter: np.ndarray, column: np.ndarray, width: int) -> np.ndarray:
    """Middle column and half width of each emitter, `[2, S]`. The width includes the tent functions of the texels.

    The columns of a map form a circle. The range is the complement of the widest gap between the emitter's columns.

    emitter, column: of the emitters' texels, `[K]`.
    """
    key = np.unique(emitter * width + column)
    emitter, column = np.divmod(key, width)
    first = np.searchsorted(emitter, np.arange(emitter[-1] + 2))
    before = np.append(0, column[:-1])
    before[first[:-1]] = column[first[1:] - 1] - width
    after_gap = np.lexsort((column - before, emitter))[first[1:] - 1]
    left, right = column[after_gap], before[after_gap] + width
    return np.stack((0.5 * (left + right + 1), np.minimum(0.5 * (right - left + 1) + 0.5, 0.5 * width)))


def _texels_around(
    layout: Equirectangular, axes: Tensor, points: Tensor, focus: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor, Tensor, Tensor]:
    """The four texels around the directions from lens points `[2, N]` through x_F `[3, N]`.

    Returns the offsets of both rows and of both columns, int32 `[N]` each; interpolation weights, `[4, N]`; the position on the
    map in texels, `[2, N]`; and the factor cos θ / (|x_F - l|² · solid angle of a texel), `[N]`. The factor converts a density
    over texels into a density over the lens.
    """
    ray = torch.cat((focus[:2] - points, focus[2:3]))
    distance = dot(ray, ray).sqrt()
    towards = normalize(to_world(ray, *(axis[:, None] for axis in axes.T)))
    left, top, fx, fy = layout.corner(towards)
    upper, lower = (1.0 - fy) * (top >= 0.0), fy * (top + 1.0 < layout.height)
    tents = torch.stack(((1.0 - fx) * upper, fx * upper, (1.0 - fx) * lower, fx * lower))
    rows, columns = layout.texels(left, top)
    sine = (towards[0] * towards[0] + towards[2] * towards[2]).sqrt()  # √(1 - y²) has few digits near the poles
    solid_angle = 2.0 * math.pi**2 / (layout.height * layout.width) * sine
    place = torch.stack((left + fx, top + fy)) + 0.5
    return rows, columns, tents, place, focus[2] / (distance * distance * distance * solid_angle.clamp(min=1e-30))


class ViewedEnvironment:
    """Those of M candidates that are emitters of the map, each seen through the focus point of the pixel that owns the candidate.

    emitters: all emitters of the map. number: emitter of each candidate, -1 for none, int64 `[M]`. owner: pixel that owns each
    candidate, int64 `[M]`. focus: x_F, `[3, N]`. whole: whether the lens sees the whole emitter, bool `[M]`.

    entries: the K candidates that are emitters of the map. share: flux in the rows that the lens sees, an upper bound of the flux
    through the lens, `[K]`.
    """

    def __init__(self, emitters: EnvironmentEmitters, number: Tensor, owner: Tensor, focus: Tensor, whole: Tensor):
        self.entries = ActiveEntries(number >= 0)
        number, owner = self.entries.select(number), self.entries.select(owner)
        self._emitters, self._number = emitters, number.clamp(min=0)
        owns_any = torch.zeros(focus.shape[1], dtype=torch.bool, device=focus.device)
        owns_any[owner] = True
        self._pixels = ActiveEntries(owns_any)
        """Pixels that own at least one of the candidates."""
        place = torch.zeros(len(owns_any), dtype=torch.int64, device=focus.device)
        self._pixels.scatter(place, torch.arange(len(self._pixels), device=focus.device))
        self._owner = place.index_select(0, owner)
        """Index of each candidate's owner in `_pixels`, `[K]`."""
        self._focus = self._pixels.select(focus)
        self._cones, self._clipped = emitters.cones(self._focus), ~self.entries.select(whole)
        self._rows = self._visible_rows()
        self.share = (self._rows[1] - self._rows[0]).float()

    def _visible_rows(self) -> Tensor:
        """`EnvironmentEmitters.visible_rows` of each candidate, float64 `[2, K]`."""
        rows = self._emitters.whole.index_select(1, self._number)
        clipped = ActiveEntries(self._clipped)
        cones, number = self._cones.select(clipped.select(self._owner)), clipped.select(self._number)
        clipped.scatter(rows, self._emitters.visible_rows(number, cones))
        return rows

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of the candidates at `place` among the K, from uniform numbers `[2, J]`."""
        owner, number = self._owner.index_select(0, place), self._number.index_select(0, place)
        cones, rows = self._cones.select(owner), self._rows.index_select(1, place)
        return self._emitters.sample(number, cones, rows, uniforms, self._focus.index_select(1, owner))

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the owners' lens points `[2, N]`, per unit area of the lens plane."""
        emitter, place, density = self._emitters.evaluate(self._pixels.select(points), self._focus)
        seen = emitter.index_select(0, self._owner) == self._number
        result = density.index_select(0, self._owner) * seen
        clipped = ActiveEntries(seen & self._clipped)
        owner, number = clipped.select(self._owner), clipped.select(self._number)
        cones, rows, place = self._cones.select(owner), clipped.select(self._rows), place.index_select(1, owner)
        factor = self._emitters.clipping_factor(number, cones, rows, place).float()
        clipped.scatter(result, clipped.select(result) * factor)
        return result
