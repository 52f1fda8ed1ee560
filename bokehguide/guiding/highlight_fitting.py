"""Detection of highlights in a record of primary hits, and fits of Gaussians or ellipsoids (sections 4.2.2 to 4.2.4)."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig, GuidedConfig, HighlightConfig
from bokehguide.guiding.layered_record import VoxelRecord
from bokehguide.guiding.record_buffer import Raster, RecordBuffer
from bokehguide.models.ellipse_mixture import outline_areas
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.vector import length


def find_highlights(
    record: RecordBuffer | VoxelRecord, camera: ThinLensCamera, mean_luminance: float, config: HighlightConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Bright cells of the record that are out of focus: cells `[K]`, positions `[3, K]` and mean luminance `[K]`."""
    cells, points, light = record.bright(config.radiance_threshold * mean_luminance)
    defocused = camera.coc_diameter(points[2]) >= config.coc_threshold
    return cells[defocused], points[:, defocused], light[defocused]


def label_patches(record: Raster, cells: Tensor, depth: Tensor, width: Tensor, depth_gap: float) -> Tensor:
    """Patch number of each highlight cell, int64 `[K]` from 0 without gaps.

    Cells that touch on the raster form a patch. One emitter may lie behind another, so gaps between the sorted depths of its
    cells split the patch.

    depth, width: depth and width of each cell, metres, `[K]`. depth_gap: see `HighlightConfig`.
    """
    if len(cells) == 0:
        return torch.zeros_like(cells)
    from kornia.contrib import connected_components_union_find  # the import takes half a second

    row, column = _close_gaps(cells // record.width), _close_gaps(cells % record.width)
    mask = torch.zeros(int(row.max()) + 1, int(column.max()) + 1, dtype=torch.bool, device=cells.device)
    mask[row, column] = True
    label = connected_components_union_find(mask[None, None])[0, 0, row, column]
    order = depth.argsort()
    order = order[label[order].argsort(stable=True)]
    label, depth, width = label[order], depth[order], width[order]
    leap = (label[1:] != label[:-1]) | (depth[1:] - depth[:-1] > depth_gap * width[:-1])
    patch = torch.empty_like(order)
    patch[order] = torch.cat((torch.zeros_like(order[:1]), leap.long().cumsum(0)))
    return patch


def _close_gaps(places: Tensor) -> Tensor:
    """Places `[K]` from 0 in the same order, with gaps of at most one empty place, so that the same places touch."""
    present, index = places.unique(return_inverse=True)
    steps = present.diff(prepend=present[:1]).clamp(max=2)
    return steps.cumsum(0)[index]


def fit_ellipsoids(
    record: VoxelRecord, camera: ThinLensCamera, mean_luminance: float, config: GuidedConfig
) -> tuple[Tensor, ...]:
    """Fit one ellipsoid to each of G patches of highlight cells.

    Returns the cells `[K]`, means `[3, G]`, outlines `[6, G]` (see `EllipseMixture`), largest half axes seen from the lens `[G]`
    and energies `[G]`: mean luminance times the area of the outline over π.

    Mean and covariance are weighted by the light. An unweighted bounding box would be several times larger, because of a few dim
    cells at the edge. The Gaussian with this mean and covariance has the least KL divergence from the light.
    """
    if not config.find_highlights:
        none = torch.zeros(6, 0, device=record.sums.device)
        return record.voxels[:0, 0].long(), none[:3], none, none[0], none[0]
    cells, points, light = find_highlights(record, camera, mean_luminance, config.highlights)
    width = points[2] * camera.pixel_slope
    patch = label_patches(record, cells, points[2], width, config.highlights.depth_gap)
    count = int(patch.max()) + 1 if len(patch) else 0
    area = (width * width).double()
    none = torch.zeros(2, count, device=points.device, dtype=torch.float64)
    areas, flux = none.index_add_(1, patch, torch.stack((area, light * area)))
    share = (light * area / flux[patch]).float()
    empty = torch.zeros(6, count, device=points.device)
    mean = empty[:3].index_add(1, patch, share * points)
    x, y, z = points - mean[:, patch]
    within = width * width / 12.0  # variance of a uniform distribution over a cell
    moments = torch.stack((x * x + within, x * y, x * z, y * y + within, y * z, z * z))
    outline = config.highlight_axes * config.highlight_axes * empty.index_add(1, patch, share * moments)
    spread = 0.5 * (outline[0] + outline[3])
    radius = (spread + ((outline[0] - spread).square() + outline[1].square()).sqrt()).sqrt()
    energy = flux / areas * outline_areas(outline, mean)
    return cells, mean, outline, radius, energy.clamp(max=torch.finfo(torch.float32).max).float()


def fit_gaussians(
    field: GaussianField,
    record: RecordBuffer,
    camera: ThinLensCamera,
    mean_luminance: float,
    config: GaussianConfig,
) -> Tensor:
    """Replace the field by one Gaussian for each patch of highlight cells; returns the cells `[K]`.

    Each cell has the width of a pixel at the depth of the cell (Eq. 24). The mean is the centre of the patch's bounding box. R_b
    is the radius of the smallest sphere about the mean that contains a ball of this width at every cell. A sphere around the box
    would also contain the corners of the box, and σ would be too large: for a disc of radius R, the best σ is R / 1.78.
    """
    cells, points, light = find_highlights(record, camera, mean_luminance, config.highlights)
    width = points[2] * camera.pixel_slope
    patch = label_patches(record, cells, points[2], width, config.highlights.depth_gap)
    count = int(patch.max()) + 1 if len(patch) else 0
    index = patch.expand(3, -1)
    empty = torch.zeros(3, count, device=points.device)
    low = empty.scatter_reduce(1, index, points - 0.5 * width, "amin", include_self=False)
    high = empty.scatter_reduce(1, index, points + 0.5 * width, "amax", include_self=False)
    center = 0.5 * (low + high)
    reach = length(points - center[:, patch]) + 0.5 * width
    radius = torch.zeros(count, device=points.device).scatter_reduce(0, patch, reach, "amax")
    energy = torch.zeros(count, device=points.device).index_add_(0, patch, light * width * width)
    field.assign(center, radius, config.sigma_scale * radius, energy)
    return cells
