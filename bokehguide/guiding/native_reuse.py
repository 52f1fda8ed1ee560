"""Reuse of primary hits in the native core: the same estimator as `PixelPathReuse.reuse`, in a few calls for each batch.

`native/pixel_reuse.h` holds the formulas. PyTorch computes the transmission of an aperture that is not a disc. PyTorch also
computes the densities of a mixture that the core does not hold.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bokehguide.guiding.lens_queries import MixtureQuery
from bokehguide.guiding.pixel_groups import PixelGroups
from bokehguide.guiding.protocols import BatchSamples, LensQuery
from bokehguide.guiding.reuse_weights import Reused
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.light_groups import GroupRadiance
from bokehguide.render.native import NativeTracer
from bokehguide.render.primary_hits import CoreRecord
from bokehguide.runtime.indexing import Pixels, scatter
from bokehguide.runtime.timer import PhaseTimer

NOWHERE = 1e15
"""Coordinate of lens points for pixels without a view."""


class ViewPoints(NamedTuple):
    """J views in rows of viewers. Within a row, each pixel is the viewer of at most one view.

    viewer: pixel that sees the hit of another pixel, int64 `[J]`. points: lens points, `[2, J]`. ends: 0, and the end of each
    row.
    """

    viewer: Tensor
    points: Tensor
    ends: list[int]

    def densities(self, query: LensQuery, count: int) -> Tensor:
        """Densities q of the viewers at the lens points, `[J]`. count: number of pixels in the batch."""
        if not query.varies:
            return query.pdf(self.points)
        found = []
        for first, end in pairwise(self.ends):
            viewer = self.viewer[first:end]
            points = torch.full((2, count), NOWHERE, device=viewer.device)
            scatter(points, viewer, self.points[:, first:end])
            found.append(query.pdf(points).index_select(0, viewer))
        return torch.cat(found)


def native_reuse(
    native: NativeTracer,
    camera: ThinLensCamera,
    groups: PixelGroups,
    min_spread: float,
    samples: BatchSamples,
    own: dict[str, Tensor],
    timer: PhaseTimer,
) -> Reused | None:
    """The samples of a batch after reuse; None where the core did not record the primary hits. Adds to `paths.rays`.

    own: density at each pixel's own lens point, and the transmittance there if it is not 1, `[N]` each.
    """
    record = native.record(samples.paths.primary_hits)
    if record is None:
        return None
    offsets = torch.tensor(groups.offsets(), dtype=torch.int32)
    arrays = _arrays(camera, samples) | {"offsets": offsets, "right": torch.tensor(groups.right, dtype=torch.int32)}
    views = native.views(arrays, _numbers(camera, groups, min_spread), record, *_pixels(samples.batch.places))
    if not camera.lens.is_disc and len(views) > 0:
        points, viewer, _ = _points(views)
        views.set_passing(camera.lens.passing(points, samples.batch.focus.index_select(1, viewer)))
    rays, seconds = views.trace()
    samples.paths.rays += rays
    timer.add("tracing rays", seconds)
    count = samples.drawn.weight.shape[0]
    density = _densities(views, samples.query, len(offsets), count)
    by_group = _light_group_arrays(samples.paths.groups, record)
    if not camera.lens.is_disc:
        own = own | {"passing": camera.lens.passing(samples.drawn.points, samples.batch.focus)}
    reused = Reused(torch.empty(3, count), torch.empty(count), None if by_group is None else by_group["radiance"])
    views.reuse(density, {name: values.contiguous() for name, values in own.items()}, reused.radiance, reused.weight, by_group)
    return reused


def _arrays(camera: ThinLensCamera, samples: BatchSamples) -> dict[str, Tensor]:
    arrays = {
        "points": samples.drawn.points,
        "focus": samples.batch.focus,
        "depth": samples.film.depth,
        "weight": samples.drawn.weight,
        "radiance": samples.paths.radiance,
        "triangle": samples.paths.triangle,
        "axes": camera.axes,
        "position": camera.position,
    }
    return {name: values.contiguous() for name, values in arrays.items()}


def _light_group_arrays(groups: GroupRadiance | None, record: CoreRecord) -> dict[str, Tensor] | None:
    """The arrays of `ReusedGroups` in `native/tables.h`; `radiance` is the result."""
    if groups is None:
        return None
    arrays = {"own": groups.rays, "radiance": torch.empty_like(groups.rays), "materials": groups.groups.materials}
    if record.hits > 0:
        assert groups.reflected is not None
        arrays["reflected"] = groups.reflected
    return arrays


def _numbers(camera: ThinLensCamera, groups: PixelGroups, min_spread: float) -> dict[str, float]:
    lens = camera.lens
    # The circle that contains an aperture of another shape is widened against rounding; `Lens.passing` is exact.
    radius = lens.radius if lens.is_disc else lens.radius * (1.0 + 1e-6)
    numbers = {
        "radius": lens.radius,
        "squared_radius": radius**2,
        "passing": 1.0 / lens.area if lens.area > 0.0 else 0.0,
        "focus_distance": lens.focus_distance,
        "pixel_slope": camera.pixel_slope,
        "min_spread": min_spread,
        "width": groups.width,
        "below": groups.below,
    }
    return {name: float(value) for name, value in numbers.items()}


def _pixels(places: Pixels) -> tuple[int, Tensor | None]:
    """Number of the first pixel, and the numbers of all pixels, None if they are consecutive."""
    return (places.start, None) if isinstance(places, slice) else (int(places[0]), places.contiguous())


def _points(views: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Lens points `[2, J]`, viewers int64 `[J]`, and members of the groups that the viewers are, int32 `[J]`."""
    points, viewer, member = torch.empty(2, len(views)), *(torch.empty(len(views), dtype=torch.int32) for _ in range(2))
    views.copy(points, viewer, member)
    return points, viewer.long(), member


def _densities(views: Any, query: LensQuery, members: int, count: int) -> Tensor:
    """Densities of the viewers at the lens points, `[J]`. Views by the same member of groups have different viewers."""
    if isinstance(query, MixtureQuery) and query.mixture.core is not None:
        density, lens = torch.empty(len(views)), query.mixture.lens
        transmission = None if lens.is_disc else lens.transmission(_points(views)[0]).contiguous()
        views.densities(query.mixture.core, transmission, density)
        return density
    points, viewer, member = _points(views)
    order = member.argsort(stable=True)
    ends = torch.bincount(member, minlength=members).cumsum(0).tolist()
    by_member = ViewPoints(viewer.index_select(0, order), points.index_select(1, order), ends)
    return torch.empty(len(order)).index_copy_(0, order, by_member.densities(query, count))
