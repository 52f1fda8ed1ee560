"""How a sample of one pixel becomes a sample of another: the two shift mappings of Area ReSTIR.

A sample is a sub-pixel position u, a lens point and the random numbers of its path. Both
shifts keep the first and the last; they differ in the lens point, and the path is traced
anew from there:

- the lens copy keeps the lens point;
- the reconnection takes the lens point from which the new pixel sees the same first
  surface point or, where the ray left the scene, the same direction. It fails where that
  lens point is none of the aperture or something else is seen from it.

Measures are du × dA_lens × random numbers, so a shift's Jacobian is |∂l' / ∂l|. Forth and
back is where it was: a reconnection succeeds both ways or neither way, as both rays have
to meet the same point first, with the same random numbers to go through sheer surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.pixels import indices
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.render.vector import luminance
from bokehguide.restir.reservoirs import Reservoirs


def reconnect(lens_points: Tensor, focus_shift: Tensor, depth: Tensor, focus_distance: float) -> Tensor:
    """Lens points l' `[2, N]` from which rays through the new focus points meet what those from l `[2, N]` met.

    focus_shift: x_F' - x_F `[2, N]`; depth: of the first surface `[N]`, very large for a
    direction. It is l' = x₁ + (x_F' - x₁) z / (z - d_F), less the same formula for l. At
    z = d_F, where all rays of a focus point meet, there is none: 1e15.
    """
    return (lens_points + focus_shift * (depth / (depth - focus_distance))).nan_to_num(1e15, 1e15, -1e15)


def reconnection_jacobian(plane: Tensor, lens_points: Tensor, new_lens_points: Tensor) -> Tensor:
    """|∂l' / ∂l| `[N]` of `reconnect`: how far l' is from the plane of the first surface, over how far l is.

    |ω'·n₁| |ω·n₀| / (|ω'·n₀| |ω·n₁|) with n₀ the lens normal: both cones stand on the same
    piece of surface, and with x₁ - l = |x₁ - l| ω the depth z = |x₁ - l| ω·n₀ cancels.
    plane: as Reservoirs has it.
    """
    return _distance(plane, new_lens_points) / _distance(plane, lens_points).clamp(min=1e-20)


def _distance(plane: Tensor, lens_points: Tensor) -> Tensor:
    """Distance `[N]` of lens points `[2, N]` from planes `[3, N]`."""
    return (plane[2] - plane[0] * lens_points[0] - plane[1] * lens_points[1]).abs()


def same_point(triangle: Tensor, expected: Tensor) -> Tensor:
    """Whether rays towards points of `expected` triangles met them, given what they did meet, bool `[N]`; -1: nothing.

    A ray meets a triangle once, so no tolerance blurs who can come from where. By rounding a
    ray to an edge may meet the triangle next to it: far too seldom to be seen.
    """
    return triangle == expected


def copied_share(coc: Tensor, radius: float) -> Tensor:
    """γ, the share of neighbours whose lens points are copied, by the diameter of the circle of confusion `[N]`.

    coc: of what the centre's pinhole ray meets, and never of a sample's own hit: a choice
    that hangs on the sample would be no mapping. The fit of Area ReSTIR's authors has it in
    pixels where `radius`, that of the neighbourhood, is 50; a smaller picture with a smaller
    neighbourhood is divided in the same way.
    """
    coc = coc * (50.0 / radius)
    return torch.where(coc <= 2.0, 1.0, 17.939 / (coc + 21.383) + 0.1)


@dataclass
class Shifted:
    """Samples in their new pixels, black where the shift failed.

    radiance: times the aperture's W `[3, N]`; target: p̂ `[N]`; jacobian: of the shift `[N]`; rays: traced.
    """

    radiance: Tensor
    target: Tensor
    jacobian: Tensor
    rays: int = 0

    def split(self, count: int) -> tuple[Shifted, Shifted]:
        """The first `count` samples, with the rays of all, and the others."""
        values = (self.radiance, self.target, self.jacobian)
        first = Shifted(*(value[..., :count] for value in values), self.rays)
        return first, Shifted(*(value[..., count:] for value in values))


class Shift:
    """Shifts samples between the pixels of a camera. Threads may call it side by side."""

    def __init__(self, camera: ThinLensCamera, tracer: PathTracer):
        self._camera, self._tracer = camera, tracer

    def focus_points(self, pixels: Tensor, subpixel: Tensor) -> Tensor:
        """x_F `[3, N]` of positions `[2, N]` in pixels of flat indices `[N]`."""
        width = self._camera.width
        return self._camera.focus_points(torch.stack((pixels % width, pixels // width)) + subpixel)

    def __call__(
        self,
        samples: Reservoirs,
        random: PixelRandom,
        source: Tensor,
        target: Tensor,
        reconnects: Tensor,
        timer: PhaseTimer,
    ) -> Shifted:
        """Shift samples of the pixels `source`, whose paths took `random`, to the pixels `target`.

        source, target: flat indices `[N]`; reconnects: which shift each gets, bool `[N]`.
        What is black, or would have to pass outside the aperture, is not traced.
        """
        camera = self._camera
        focus = self.focus_points(target, samples.subpixel)
        focus_shift = (focus - self.focus_points(source, samples.subpixel))[:2]
        points = reconnect(samples.lens_points, focus_shift, samples.depth, camera.lens.focus_distance)
        points = torch.where(reconnects, points, samples.lens_points)
        passes = camera.lens.transmission(points) * camera.lens.unblocked(points, focus)
        index = indices((samples.target > 0.0) & (passes > 0.0))
        points, samples, passes = points.index_select(1, index), samples.select(index), passes.index_select(0, index)
        reconnects = reconnects.index_select(0, index)
        origins, directions = camera.rays(focus.index_select(1, index), points)
        with timer.measure("shading"):
            traced = self._tracer.trace(origins, directions, random.select(index), timer)
        passes = passes * (same_point(traced.triangle, samples.triangle) | ~reconnects)
        shifted = Shifted(torch.zeros_like(focus), torch.zeros_like(focus[0]), torch.ones_like(focus[0]), traced.rays)
        shifted.radiance[:, index] = traced.radiance * passes
        shifted.target[index] = luminance(traced.radiance) * passes
        jacobian = reconnection_jacobian(samples.plane, samples.lens_points, points)
        shifted.jacobian[index] = torch.where(reconnects, jacobian, 1.0)
        return shifted
