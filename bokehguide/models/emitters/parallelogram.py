"""Parallelograms, such as windows and soft boxes, as exact densities on the lens.

The line from a lens point through x_F meets a parallelogram's plane in one point. A density over the parallelogram therefore
gives a density over the lens plane, for any distance and tilt. The distribution excludes parts that the lens does not see.
docs/explanation/lens-densities.md derives the formulas.
"""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from bokehguide.models.projection import FAR_OUTSIDE, LENS_MARGIN, project_to_lens
from bokehguide.render.vector import cross, dot
from bokehguide.runtime.indexing import ActiveEntries

LENS_POINT_ERROR = 1e-6
"""Bound on the rounding error of a lens point over its distance from the lens centre: 16 units in the last place."""
GAUSS_NODES = (0.2113, 0.7887)
"""Nodes of Gauss' quadrature with two points on 0 … 1."""
TINY = 1e-30
"""Divisor in place of 0, for a ray or an x_F in the plane of the parallelogram."""


class ParallelogramEmitters:
    """P parallelograms in the camera frame.

    A point of the plane has coordinates (a, b), in units of the half edges from the centre: -1 … 1 on the parallelogram.

    centre, right, up: centres and half edges, `[3, P]`, metres.
    """

    def __init__(self, centre: Tensor, right: Tensor, up: Tensor):
        self._centre, self._right, self._up = centre, right, up
        normal = cross(right, up)
        self._area = 4.0 * dot(normal, normal).sqrt()
        self._normal = normal / (0.25 * self._area)
        # The dual basis: a = first · offset and b = second · offset for an offset from the centre in the plane.
        self._first = cross(up, self._normal) / dot(right, cross(up, self._normal))
        self._second = cross(right, self._normal) / dot(up, cross(right, self._normal))

    def __len__(self) -> int:
        return self._centre.shape[1]

    def in_core(self, extension: ModuleType, luminance: Tensor) -> object:
        """The parallelograms in the native core, by the names of `ParallelogramTable` in `native/tables.h`.

        luminance: of each parallelogram, `[P]`.
        """
        tables = {name[1:]: table.contiguous() for name, table in vars(self).items()}
        return extension.ParallelogramShapes(tables | {"luminance": luminance.contiguous()})

    def select(self, index: Tensor) -> ParallelogramEmitters:
        """The parallelograms at `index`, int64 `[M]`."""
        selected = object.__new__(ParallelogramEmitters)
        for name, value in vars(self).items():
            setattr(selected, name, value.index_select(-1, index))
        return selected

    def coordinates(self, points: Tensor, focus: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates `[2, P]` at which lines from lens points `[2, P]` through x_F `[3, P]` meet the planes; and the Jacobian
        `[P]`.

        The Jacobian is the fraction of the parallelogram's area per unit area of the lens plane. The code measures lengths from
        the projection of the centre, so that a distant x_F and a small parallelogram lose no digits.
        """
        offset = self._centre - focus
        ray = torch.cat((focus[:2] - points, focus[2:3]))
        cosine = dot(self._normal, ray)
        cosine = torch.where(cosine == 0.0, TINY, cosine)
        distance = dot(self._normal, offset) / cosine  # from x_F to the plane, in lengths of the ray
        from_centre = torch.cat((points - project_to_lens(self._centre, focus), torch.zeros_like(points[:1])))
        in_plane = dot(self._normal, from_centre) / cosine * offset - distance * from_centre
        jacobian = distance.square() * (focus[2] / cosine).abs() / self._area
        return torch.stack((dot(self._first, in_plane), dot(self._second, in_plane))), jacobian

    def _margin(self, focus: Tensor, radius: Tensor) -> Tensor:
        """Bound `[2, P]` on the rounding error of coordinates of sampled lens points, through x_F `[3, P]`.

        Windows are larger by this margin. Without the margin, rounding might move a sample out of the window, and its density
        would be far too small.
        """
        offset = self._centre - focus
        error = LENS_POINT_ERROR * (project_to_lens(self._centre, focus).square().sum(0).sqrt() + radius)
        height = dot(self._normal, offset)
        height = torch.where(height == 0.0, TINY, height)
        gradients = [dot(row, offset) / height * self._normal - row for row in (self._first, self._second)]
        length = torch.stack([gradient[:2].square().sum(0).sqrt() for gradient in gradients])
        return ((offset[2] / focus[2]).abs() * length * error).nan_to_num(1.0, 1.0).clamp(1e-5, 1.0)

    def window(self, focus: Tensor, radius: Tensor) -> Tensor:
        """Ranges of both coordinates that the lens sees through x_F `[3, P]`: low and high, `[2, 2, P]`; equal if nothing is
        visible.

        radius: of the lens, `[]`, metres.
        """
        limit = 1.0 + self._margin(focus, radius)
        ranges = [self._range_on_lens(row, focus, radius) for row in (self._first, self._second)]
        window = torch.maximum(torch.minimum(torch.stack(ranges, dim=1).nan_to_num(0.0), limit), -limit)
        # The lens may see an end of the first range only outside the second range. The nearest row then bounds the first range.
        ends = []
        for side, end in enumerate(window[:, 0]):
            low, high = self._interval(end, 0, window, focus, radius)
            ends.append(self._interval(0.5 * (low + high), 1, window, focus, radius)[side])
        return torch.stack((torch.stack(ends), window[:, 1]), dim=1)

    def _range_on_lens(self, row: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
        """Least and greatest value `[2, P]` of one coordinate over the lens circle; infinite if the plane cuts the lens.

        The coordinate at lens point l is N(l) / D(l), with N(l) = n₀ + g·l and D(l) = d₀ + s·l. A level line N = v D touches
        the circle of radius r where (n₀ - v d₀)² = r² |g - v s|². The two roots v are the ends.

        row: of the dual basis, `[3, P]`.
        """
        offset, centre = self._centre - focus, project_to_lens(self._centre, focus)
        height, squared = dot(self._normal, offset), (LENS_MARGIN * radius).square()
        d0, s = dot(self._normal, focus / focus[2]), -self._normal[:2] / focus[2]
        g = (dot(row, offset) * self._normal[:2] - row[:2] * height) / focus[2]
        n0 = -(g * centre).sum(0)
        quadratic = d0.square() - squared * s.square().sum(0)
        linear = n0 * d0 - squared * (g * s).sum(0)
        determinant = g[0] * s[1] - g[1] * s[0]
        discriminant = squared * ((n0 * s - d0 * g).square().sum(0) - squared * determinant.square())
        root = discriminant.clamp(min=0.0).sqrt()
        ends = torch.stack((linear - root, linear + root)) / quadratic
        unbounded = torch.stack((-torch.ones_like(root), torch.ones_like(root))) * torch.inf
        return torch.where(quadratic <= 0.0, unbounded, ends)

    def _on_lens(self, place: Tensor, focus: Tensor) -> Tensor:
        """Lens points `[2, P]` that see coordinates `[2, P]` through x_F `[3, P]`."""
        offset, in_plane = self._centre - focus, place[0] * self._right + place[1] * self._up
        shift = (offset[:2] * (in_plane[2] / offset[2]) - in_plane[:2]) * (focus[2] / (offset[2] + in_plane[2]))
        return project_to_lens(self._centre, focus) + shift

    def _interval(self, at: Tensor, axis: int, window: Tensor, focus: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """Interval of the other coordinate that the lens sees if coordinate `axis` is `at` `[P]`; equal ends if nothing is
        visible.

        A line on the parallelogram between the ends of the window corresponds to a line on the lens, and the lens circle clips
        this line to a chord. The fraction t of the line on the lens corresponds to the fraction t z₀ / (t z₀ + (1 - t) z₁) on the
        parallelogram. z₀ and z₁ are the depths of the line's ends beyond x_F.
        """
        low, high = window[:, 1 - axis]
        fixed, moving = (self._right, self._up) if axis == 0 else (self._up, self._right)
        first, last = (self._on_lens(torch.stack((at, other) if axis == 0 else (other, at)), focus) for other in (low, high))
        length = (last - first).square().sum(0).sqrt().clamp(min=TINY)
        direction = (last - first) / length
        middle = -(first * direction).sum(0)  # of the chord, from `first`
        reach = LENS_MARGIN * radius + LENS_POINT_ERROR * length
        half = (reach * reach - (first + middle * direction).square().sum(0)).clamp(min=0.0).sqrt()
        depth = self._centre[2] - focus[2] + at * fixed[2]
        ends = []
        for fraction, fallback in (((middle - half) / length, 0.0), ((middle + half) / length, 1.0)):
            fraction = fraction.nan_to_num(fallback, 1.0, 0.0).clamp(0.0, 1.0)
            near = fraction * (depth + low * moving[2])
            share = (near / (near + (1.0 - fraction) * (depth + high * moving[2]))).nan_to_num(fallback).clamp(0.0, 1.0)
            ends.append(low + share * (high - low))
        return ends[0], ends[1]

    def sample(self, window: Tensor, focus: Tensor, radius: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, P]` that see parallelograms through x_F `[3, P]`, from uniform numbers `[2, P]`.

        The first coordinate is uniform over the window. The second coordinate is uniform over the interval that the lens sees at
        the first coordinate. If the interval is empty, the point is FAR_OUTSIDE.
        """
        a = window[0, 0] + uniforms[0] * (window[1, 0] - window[0, 0])
        low, high = self._interval(a, 0, window, focus, radius)
        points = self._on_lens(torch.stack((a, low + uniforms[1] * (high - low))), focus)
        return torch.where(high > low, points, FAR_OUTSIDE)

    def pdf(self, points: Tensor, window: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
        """Density `[P]` of `sample` at lens points `[2, P]`, per unit area of the lens plane."""
        place, jacobian = self.coordinates(points, focus)
        low, high = self._interval(place[0], 0, window, focus, radius)
        inside = (place[0] >= window[0, 0]) & (place[0] <= window[1, 0]) & (place[1] >= low) & (place[1] <= high)
        share = 0.25 * (window[1, 0] - window[0, 0]) * (high - low)  # of the parallelogram
        return torch.where(inside & (share > 0.0), jacobian / share, 0.0)

    def area_on_lens(self, window: Tensor, focus: Tensor, radius: Tensor) -> Tensor:
        """Approximate area `[P]` of the lens that sees the windows, m²: quadrature of the inverse Jacobian over GAUSS_NODES."""
        width, offset, total = window[1, 0] - window[0, 0], self._centre - focus, 0.0
        for node in GAUSS_NODES:
            a = window[0, 0] + node * width
            low, high = self._interval(a, 0, window, focus, radius)
            # The inverse Jacobian from depths beyond x_F alone: it is 0 for x_F in the plane.
            depth = offset[2] + a * self._right[2] + 0.5 * (low + high) * self._up[2]
            ratio = depth / focus[2]
            total = total + (high - low) * (dot(self._normal, offset) / (ratio * ratio * ratio * focus[2])).abs()
        return 0.25 / len(GAUSS_NODES) * width * self._area * total


class ViewedParallelograms:
    """Those of M candidates that are parallelograms, each seen through the focus point of the pixel that owns the candidate.

    number: parallelogram of each candidate, -1 for none, int64 `[M]`. owner: pixel that owns each candidate, int64 `[M]`. focus:
    x_F, `[3, N]`. radius: of the lens, `[]`, metres.

    entries: the K candidates that are parallelograms. area: approximate area of the lens that sees each of them, `[K]`, m².
    """

    def __init__(self, parallelograms: ParallelogramEmitters, number: Tensor, owner: Tensor, focus: Tensor, radius: Tensor):
        self.entries = ActiveEntries(number >= 0)
        number, self._owner = self.entries.select(number), self.entries.select(owner)
        self._parallelograms, self._focus = parallelograms.select(number.clamp(min=0)), focus.index_select(1, self._owner)
        self._radius = radius
        self._window = self._parallelograms.window(self._focus, radius)
        self.area = self._parallelograms.area_on_lens(self._window, self._focus, radius)

    def sample(self, place: Tensor, uniforms: Tensor) -> Tensor:
        """Lens points `[2, J]` of the candidates at `place` among the K, from uniform numbers `[2, J]`."""
        window, focus = self._window.index_select(2, place), self._focus.index_select(1, place)
        return self._parallelograms.select(place).sample(window, focus, self._radius, uniforms)

    def pdf(self, points: Tensor) -> Tensor:
        """Densities `[K]` at the owners' lens points `[2, N]`, per unit area of the lens plane."""
        return self._parallelograms.pdf(points.index_select(1, self._owner), self._window, self._focus, self._radius)
