"""Spotlight discovery and the fit of 3D Gaussians to it (sections 4.2.2 to 4.2.4)."""

from __future__ import annotations

import torch
from torch import Tensor

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.vector import length
from bokehguide.train.record_buffer import Raster, RecordBuffer
from bokehguide.train.voxel_record import VoxelRecord

RADIANCE_THRESHOLD = 8.0
"""A spot's cell is at least this many times as bright as the frame's mean (4.2.2: "high radiance", no figure)."""
COC_THRESHOLD = 4.0
"""A spot's circle of confusion measures at least this many pixels across (4.2.2: "manually set")."""
ALPHA = 0.5
"""σ = α R_b (section 4.2.4)."""
AXES = 2.4
"""Half axes of an ellipsoid by its light's standard deviations: those of an even disc, 2, and some more for a blurred edge."""
DEPTH_GAP = 8.0
"""Connected cells belong to two spots where their depths, sorted, leap by so many cell widths."""


def find_spotlights(
    record: RecordBuffer | VoxelRecord, camera: ThinLensCamera, mean_luminance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells `[K]` of the record that are bright and out of focus, their positions `[3, K]` and mean luminance `[K]`."""
    cells, points, light = record.bright(RADIANCE_THRESHOLD * mean_luminance)
    defocused = camera.coc_diameter(points[2]) >= COC_THRESHOLD
    return cells[defocused], points[:, defocused], light[defocused]


def label_patches(record: Raster, cells: Tensor, depth: Tensor, width: Tensor) -> Tensor:
    """Patch number of each spotlight cell, int64 `[K]` from 0 without gaps.

    Cells that touch on the raster form a patch, which is split where the sorted depths of
    its cells leap: two lamps may stand behind one another. depth, width: of each cell `[K]`.
    """
    from kornia.contrib import connected_components_union_find  # half a second that uniform renders do without

    mask = torch.zeros(record.height * record.width, dtype=torch.bool, device=cells.device)
    mask[cells] = True
    labels = connected_components_union_find(mask.reshape(1, 1, record.height, record.width))
    label = labels.reshape(-1)[cells]
    order = depth.argsort()
    order = order[label[order].argsort(stable=True)]
    label, depth, width = label[order], depth[order], width[order]
    leap = (label[1:] != label[:-1]) | (depth[1:] - depth[:-1] > DEPTH_GAP * width[:-1])
    patch = torch.empty_like(order)
    patch[order] = torch.cat((torch.zeros_like(order[:1]), leap.long().cumsum(0)))
    return patch


def fit_ellipsoids(record: VoxelRecord, camera: ThinLensCamera, mean_luminance: float) -> tuple[Tensor, ...]:
    """One ellipsoid for each patch of spotlight cells: the cells `[K]`; means `[3, G]`, outlines `[6, G]` (see
    `DiscLensDistribution`), largest half axes as the lens sees them and energies `[G]`.

    Mean and covariance are those of the light, not of the patch: a few cells at the edge, which a highlight seldom
    reaches, would make the box around them several times as large. Of all Gaussians theirs has the least KL divergence from the
    light: what gradients would seek step by step is known at once.
    """
    cells, points, light = find_spotlights(record, camera, mean_luminance)
    width = points[2] * camera.pixel_slope
    patch = label_patches(record, cells, points[2], width)
    count = int(patch.max()) + 1 if len(patch) else 0
    light = light.double() * width * width
    energy = torch.zeros(count, device=points.device, dtype=torch.float64).index_add_(0, patch, light)
    share = (light / energy[patch]).float()
    empty = torch.zeros(6, count, device=points.device)
    mean = empty[:3].index_add(1, patch, share * points)
    x, y, z = points - mean[:, patch]
    within = width * width / 12.0  # of a cell, lit evenly
    moments = torch.stack((x * x + within, x * y, x * z, y * y + within, y * z, z * z))
    outline = AXES * AXES * empty.index_add(1, patch, share * moments)
    spread = 0.5 * (outline[0] + outline[3])
    radius = (spread + ((outline[0] - spread).square() + outline[1].square()).sqrt()).sqrt()
    return cells, mean, outline, radius, energy.clamp(max=torch.finfo(torch.float32).max).float()


def fit_gaussians(field: GaussianField, record: RecordBuffer, camera: ThinLensCamera, mean_luminance: float) -> Tensor:
    """Replace the field by one Gaussian for each patch of spotlights; returns the spotlight cells `[K]`.

    Each cell is as wide as a pixel at its depth (Eq. 24). The mean is the centre of the
    patch's bounding box; R_b is the radius of the sphere about it that holds a ball of that
    width in every cell. (The sphere about the box itself reaches to its corners, and σ
    would come out as large as the lamp, when R / 1.78 is best for a disc of radius R.)
    """
    cells, points, light = find_spotlights(record, camera, mean_luminance)
    width = points[2] * camera.pixel_slope
    patch = label_patches(record, cells, points[2], width)
    count = int(patch.max()) + 1 if len(patch) else 0
    index = patch.expand(3, -1)
    empty = torch.zeros(3, count, device=points.device)
    low = empty.scatter_reduce(1, index, points - 0.5 * width, "amin", include_self=False)
    high = empty.scatter_reduce(1, index, points + 0.5 * width, "amax", include_self=False)
    center = 0.5 * (low + high)
    reach = length(points - center[:, patch]) + 0.5 * width
    radius = torch.zeros(count, device=points.device).scatter_reduce(0, patch, reach, "amax")
    energy = torch.zeros(count, device=points.device).index_add_(0, patch, light * width * width)
    field.assign(center, radius, ALPHA * radius, energy)
    return cells
