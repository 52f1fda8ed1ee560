"""Lamps of an environment map, seen through a focus point on the lens as bright as the map has them.

A point at infinity is seen through x_F from one lens point alone, so that a density over directions is one over the
lens plane. That of a lamp here is its luminance as the map interpolates it: a tent over each of its texels. Nothing is
left of a lamp's shape, or of what is uneven in it, to make noise. Of what lies beyond the lens little is drawn: rows of texels
that the lens sees nothing of are left out, and on each row what it does not see.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bokehguide.models.map_view import View, chord, heights, lens_view
from bokehguide.models.profiles import Profiles
from bokehguide.models.projection import FAR_OUTSIDE
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.equirectangular import Equirectangular
from bokehguide.render.kernels import kernel
from bokehguide.render.pixels import put, put_where, worthwhile
from bokehguide.render.vector import dot, normalize, to_world
from bokehguide.scene.lamps import LUMINANCE
from bokehguide.scene.types import Environment


class Line(NamedTuple):
    """What N views see of lamps along lines across the map, each between the middles of two rows of texels.

    spans: the lamps' parts in these rows; tents: what each row adds to the line; low, mass: of the rows' light, what lies
    before the view, and in it; `[2, N]` each. ends: of what the views show of the line, see `chord`.
    """

    spans: tuple[Tensor, Tensor]
    tents: Tensor
    low: Tensor
    mass: Tensor
    ends: tuple[Tensor, Tensor]


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
        lamp, (row, column) = texel_lamp.reshape(-1)[texel], np.divmod(texel, width)
        light = environment.radiance.reshape(-1, 3)[texel].astype(np.float64) @ LUMINANCE * np.sin(np.pi * (row + 0.5) / height)
        beyond = 0.125 * ((row == 0) + 1.0 * (row == height - 1))  # of these rows' tents, above the map's top and below its bottom
        light /= np.bincount(lamp, light * (1.0 - beyond))[lamp]
        spans, span = np.unique(lamp * height + row, return_inverse=True)
        self._spans = Profiles(len(spans) + 1, span, column, light, width, device)
        """Of each lamp's texels in each row, along it; and of nothing, the last."""
        lamps, rows = np.divmod(spans, height)
        of_rows = self._spans.total[:-1].cpu().numpy()
        self._rows = Profiles(int(lamp.max()) + 1, lamps, rows + 1, of_rows, height + 2, device)
        """Of each lamp's rows, down the map; one row more above and below it."""
        self._span = torch.full((len(self._rows.position) + 1,), len(spans), device=device)
        """Of each knot of `_rows`."""
        knots, _ = self._rows.find(*(torch.from_numpy(values).to(device) for values in (lamps, rows + 1.0)))
        self._span[knots] = torch.arange(len(spans), device=device)
        every = torch.arange(int(lamp.max()) + 1, device=device)
        self.whole = torch.stack([self._rows.below(every, torch.full_like(every, end + 0.5, dtype=torch.float64)) for end in (0, height)])
        """Shares of lamps above the map's top, and above its bottom, as `rows` has them of what is seen, `[2, S]`."""
        self._columns = torch.from_numpy(_columns(lamp, column, width)).to(device)
        slot = np.zeros(height * width, np.int32)
        slot[texel] = np.arange(1, len(texel) + 1)
        self._slot = torch.from_numpy(slot).to(device)
        """Place of each texel in what follows, 0 for those of no lamp."""
        self._light = torch.from_numpy(np.append(0.0, light).astype(np.float32)).to(device)
        self._lamp = torch.from_numpy(np.append(-1, lamp)).to(device)

    def view(self, focus: Tensor) -> View:
        """What the lens sees through x_F `[3, N]`."""
        return lens_view(self._map, self._camera, focus)

    def rows(self, lamp: Tensor, view: View) -> Tensor:
        """Shares of lamps `[N]` above what the views see of them, and above the end of that: float64 `[2, N]`."""
        middle, half = self._columns.index_select(1, lamp)
        top, bottom = heights(self._map, view, middle, half)
        return torch.stack((self._rows.below(lamp, top + 0.5), self._rows.below(lamp, bottom + 0.5)))

    def _line(self, lamp: Tensor, view: View, y: Tensor) -> Line:
        """What views see of lamps, `[N]` both, `y` `[N]` texels below the map's top."""
        knot, below = self._rows.find(lamp, y + 0.5)
        spans = self._span.index_select(0, knot), self._span.index_select(0, knot + 1)
        ends = chord(self._map, view, y)
        low, high = (torch.stack([self._spans.below(span, view.column + end - 0.5) for span in spans]) for end in ends)
        return Line(spans, torch.stack((1.0 - below, below)), low, high - low, ends)

    def sample(self, lamp: Tensor, view: View, rows: Tensor, uniforms: Tensor, focus: Tensor) -> Tensor:
        """Lens points `[2, N]` that see what views show of lamps `[N]` through x_F `[3, N]`, from uniform numbers `[2, N]`: down
        the map by the light of the lamps' rows, and across by what of it the view shows."""
        down, across = uniforms.double()
        y = self._rows.place(lamp, rows[0] + down * (rows[1] - rows[0])) - 0.5
        line = self._line(lamp, view, y)
        mass = line.tents * line.mass
        target = across * mass.sum(0)
        upper = target < mass[0]
        target = torch.where(upper, target / line.tents[0], (target - mass[0]) / line.tents[1]) + torch.where(upper, *line.low)
        x = self._spans.place(torch.where(upper, *line.spans), target) + 0.5
        local = self._camera.axes.T @ self._map.directions(x.float(), y.float())
        shown = (local[2] > 0.0) & (mass.sum(0) > 0.0) & (rows[1] > rows[0])
        return torch.where(shown, focus[:2] - local[:2] * (focus[2] / local[2]), FAR_OUTSIDE)

    def evaluate(self, points: Tensor, focus: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The lamp that lens points `[2, N]` see through x_F `[3, N]`, -1 for none, `[N]`; where on the map, in texels, float64
        `[2, N]`; and the density that all of the lamp has there, `[N]`."""
        row, column, tents, place, scale = _texels_around(self._map, self._camera.axes, points, focus)
        lamp, density = torch.full_like(scale, -1, dtype=torch.int64), torch.zeros_like(scale)
        for down in range(2):
            for across in range(2):
                slot = self._slot.index_select(0, row[down] + column[across]).long()
                density += tents[2 * down + across] * self._light.index_select(0, slot)
                lamp = torch.maximum(lamp, self._lamp.index_select(0, slot))
        return lamp, place.double(), density * scale

    def enlarged(self, lamp: Tensor, view: View, rows: Tensor, place: Tensor) -> Tensor:
        """How many times denser `sample` draws at places `[2, N]` of the map than all of the lamps would be, float64 `[N]`: 0 where
        views do not show them."""
        x, y = place
        line = self._line(lamp, view, y)
        aside = (x - view.column) / self._map.width
        aside = (aside - aside.round()) * self._map.width
        above = self._rows.below(lamp, y + 0.5)
        shown = (aside >= line.ends[0]) & (aside <= line.ends[1]) & (above >= rows[0]) & (above <= rows[1])
        part = (rows[1] - rows[0]) * (line.tents * line.mass).sum(0)
        whole = (line.tents * self._totals(line)).sum(0)
        return torch.where(shown & (part > 0.0), whole / part, 0.0)

    def _totals(self, line: Line) -> Tensor:
        return torch.stack([self._spans.total.index_select(0, span) for span in line.spans])


def _columns(lamp: np.ndarray, column: np.ndarray, width: int) -> np.ndarray:
    """Columns in whose middle lamps stand, and how far they light texels beside it, `[2, S]`, of the lamps that texels `[K]` belong to."""
    key = np.unique(lamp * width + column)
    lamp, column = np.divmod(key, width)
    first = np.searchsorted(lamp, np.arange(lamp[-1] + 2))
    before = np.append(0, column[:-1])
    before[first[:-1]] = column[first[1:] - 1] - width
    # Across the widest gap of its columns a lamp does not reach.
    order = np.lexsort((column - before, lamp))[first[1:] - 1]
    left, right = column[order], before[order] + width
    return np.stack((0.5 * (left + right + 1), np.minimum(0.5 * (right - left + 1) + 0.5, 0.5 * width)))


@kernel
def _texels_around(
    layout: Equirectangular, axes: Tensor, points: Tensor, focus: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor, Tensor, Tensor]:
    """The four texels about what lens points `[2, N]` see through x_F `[3, N]`.

    The first texel of their rows, and columns, int32 `[N]`; tents over the texels `[4, N]`; where that is on the map, in
    texels `[2, N]`; and the density of lens points where that of places on the map is 1, `[N]`.
    """
    ray = torch.cat((focus[:2] - points, focus[2:3]))
    distance = dot(ray, ray).sqrt()
    towards = normalize(to_world(ray, *(axis[:, None] for axis in axes.T)))
    left, top, fx, fy = layout.corner(towards)
    up, down = (1.0 - fy) * (top >= 0.0), fy * (top + 1.0 < layout.height)
    tents = torch.stack(((1.0 - fx) * up, fx * up, (1.0 - fx) * down, fx * down))
    rows, columns = layout.texels(left, top)
    sine = (towards[0] * towards[0] + towards[2] * towards[2]).sqrt()  # that of y has few digits near the poles
    solid_angle = 2.0 * math.pi**2 / (layout.height * layout.width) * sine
    place = torch.stack((left + fx, top + fy)) + 0.5
    return rows, columns, tents, place, focus[2] / (distance * distance * distance * solid_angle.clamp(min=1e-30))


class SeenSky:
    """Those of M candidates that are lamps of the map, seen through x_F `[3, N]` of the pixels that own them.

    number: which of `lamps` each candidate is, -1 for the others, int64 `[M]`; owner: int64 `[M]`; whole: of which nothing is cut
    off by the lens, bool `[M]`. index: of K candidates, of which those at `real` are lamps of the map (see `worthwhile`); share: of
    their light, what is in the rows that the lens sees anything of, at least what passes it, `[K]`.
    """

    def __init__(self, lamps: SkyLamps, number: Tensor, owner: Tensor, focus: Tensor, whole: Tensor):
        self.index = worthwhile(number >= 0)
        number, owner = (values.index_select(0, self.index) for values in (number, owner))
        self.real, self._lamps, self._number = number >= 0, lamps, number.clamp(min=0)
        looks = torch.zeros(focus.shape[1], dtype=torch.bool, device=focus.device)
        looks[owner] = True
        self._pixels = worthwhile(looks)
        """Those that own any."""
        place = torch.zeros(len(looks), dtype=torch.int64, device=focus.device)
        put(place, self._pixels, torch.arange(len(self._pixels), device=focus.device))
        self._owner = place.index_select(0, owner)
        """Of each of the K, among these."""
        self._focus = focus.index_select(1, self._pixels)
        self._view, self._cut = lamps.view(self._focus), ~whole.index_select(0, self.index)
        cut = worthwhile(self._cut)
        self._rows = lamps.whole.index_select(1, self._number)
        view = self._view.select(self._owner.index_select(0, cut))
        put_where(self._cut.index_select(0, cut), self._rows, cut, lamps.rows(self._number.index_select(0, cut), view))
        self.share = (self._rows[1] - self._rows[0]).float()

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of those at `place` among the K, from uniform numbers `[2, J]`."""
        owner, number = self._owner.index_select(0, place), self._number.index_select(0, place)
        view, rows = self._view.select(owner), self._rows.index_select(1, place)
        return self._lamps.sample(number, view, rows, uniforms, self._focus.index_select(1, owner))

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the lens points `[2, N]` of the pixels, per unit area of the lens plane."""
        lamp, place, density = self._lamps.evaluate(points.index_select(1, self._pixels), self._focus)
        seen = lamp.index_select(0, self._owner) == self._number
        result = density.index_select(0, self._owner) * seen
        cut = seen & self._cut
        index = worthwhile(cut)
        owner, number = self._owner.index_select(0, index), self._number.index_select(0, index)
        times = self._lamps.enlarged(number, self._view.select(owner), self._rows.index_select(1, index), place.index_select(1, owner))
        put_where(cut.index_select(0, index), result, index, result.index_select(0, index) * times.float())
        return result
