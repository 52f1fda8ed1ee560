"""The two shift mappings of Area ReSTIR, from samples of one pixel to samples of another.

A sample consists of a sub-pixel position u, a lens point and the random numbers of the path. Both shifts keep u and the random
numbers, map the lens point and trace the path again:

- The lens copy keeps the lens point.
- The reconnection uses the lens point from which the new pixel sees the same primary hit. For a miss, the new pixel sees the same
  direction (`models/reconnection.py`). The shift fails if the lens point is outside the aperture or the ray meets another
  surface.

The measure is du × dA_lens × random numbers, so that the Jacobian of a shift is |∂l' / ∂l|. Both shifts are invertible. A
reconnection succeeds in both directions or in neither direction, because both rays must meet the same point. Both rays use the
same random numbers at translucent surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bokehguide.baselines.restir.reservoirs import Reservoirs
from bokehguide.models.reconnection import reconnect, reconnection_jacobian
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.runtime.indexing import indices
from bokehguide.runtime.timer import PhaseTimer

FITTED_RADIUS = 50.0
"""Radius of the neighbourhood, in pixels, for which `copied_share` was fitted."""


def same_point(triangle: Tensor, expected: Tensor) -> Tensor:
    """Whether rays met the `expected` triangles, bool `[N]`; -1 means a miss.

    A ray meets a triangle at most once, so that the test needs no tolerance. At an edge, rounding may move the hit to the
    adjacent triangle. This is too rare to matter.
    """
    return triangle == expected


def copied_share(coc: Tensor, radius: float) -> Tensor:
    """γ, the share of neighbours with a lens copy, `[N]`, by the fit of Area ReSTIR's authors.

    coc: diameter of the circle of confusion at the hit of the pixel's pinhole ray, pixels, `[N]`. The diameter must not depend on
    the sample, because the choice of the shift must be the same for all samples. radius: of the neighbourhood, pixels. The fit
    holds for FITTED_RADIUS. For another radius, the function scales the diameter by the ratio of the radii.
    """
    coc = coc * (FITTED_RADIUS / radius)
    return torch.where(coc <= 2.0, 1.0, 17.939 / (coc + 21.383) + 0.1)


@dataclass
class Shifted:
    """Samples after a shift, black if the shift failed.

    radiance: times the transmission W, `[3, N]`; target: p̂, `[N]`; jacobian: of the shift, `[N]`; rays: number of traced rays.
    """

    radiance: Tensor
    target: Tensor
    jacobian: Tensor
    rays: int = 0

    def split(self, count: int) -> tuple[Shifted, Shifted]:
        """The first `count` samples and the remaining samples. The first part has the number of rays of both parts."""
        first = Shifted(self.radiance[:, :count], self.target[:count], self.jacobian[:count], self.rays)
        return first, Shifted(self.radiance[:, count:], self.target[count:], self.jacobian[count:])


class Shift:
    """Shifts samples between the pixels of a camera. Calls are thread-safe."""

    def __init__(self, camera: ThinLensCamera, tracer: PathTracer):
        self._camera, self._tracer = camera, tracer

    def focus_points(self, pixels: Tensor, subpixel: Tensor) -> Tensor:
        """x_F `[3, N]` of sub-pixel positions `[2, N]` in pixels of flat indices `[N]`."""
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
        """Shift samples from the pixels `source` to the pixels `target`.

        The method traces no rays for black samples and for samples whose new lens point is outside the aperture.

        random: random numbers of the samples' paths. source, target: flat indices, int64 `[N]`; reconnects: reconnection
        instead of lens copy, bool `[N]`.
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
