"""The lamps that a scene holds, as the field of mode `guided` begins with them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bokehguide.models.disc_distribution import Shapes, balls, packed
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.panels import Panels
from bokehguide.models.sky_lamps import SkyLamps
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.lamps import Lamps, find_lamps
from bokehguide.scene.types import Scene

REACH = 1.005
"""Size of a lamp's outline by its own. What of the lamp lies outside is left to the uniform part, and dear: with 0.95 the error is 1.2
to 5 times as large; with 1.1, of whose draws a sixth misses round lamps, 1.02 to 1.26 times (docs/results.md)."""
INFINITY = 1e5
"""Lamps at infinity are taken to be so many focus distances away."""
EMPTIEST = 16.0
"""A piece whose outline has more than this many times the area that it shows is no lamp but a tangle, left to be found."""
WIDEST = 3.0
"""A lamp's disc of so many lens radii is no help: nine draws in ten would miss the lens."""


@dataclass
class KnownLamps:
    """Lamps that the lens can see out of focus, camera frame.

    field: their balls; outlines: `packed`, `[6, L]`; shapes: which of them are something else. triangles `[T]`,
    whole_sky: which of the scene's, and whether the sky, send no light but theirs straight into the lens.
    """

    field: GaussianField
    outlines: Tensor
    shapes: Shapes
    triangles: Tensor
    whole_sky: bool


def known_lamps(scene: Scene, camera: ThinLensCamera) -> KnownLamps:
    """Those of the scene."""
    lamps = find_lamps(scene)
    arrays = (lamps.centres.T, lamps.extents, lamps.radii, lamps.luminance, lamps.outlines)
    centre, reach, size, bright, outline = (torch.from_numpy(x).float() for x in arrays)
    infinite, axes = torch.from_numpy(lamps.infinite), camera.axes.cpu()
    scale = torch.where(infinite, INFINITY * camera.lens.focus_distance, 1.0)
    world = centre - torch.where(infinite, 0.0, camera.position.cpu())
    mean, radius = (axes.T @ world) * scale, REACH * reach * scale
    # Of a cone the extent is the tangent, and the ball in it has the sine.
    cones = balls(radius / (1.0 + reach.square()).sqrt())
    outline = torch.where(infinite, cones, packed(axes.T @ outline @ axes) * REACH**2)
    energy = bright * radius.square()
    # Rings and other tangles fill little of their outlines.
    area = torch.linalg.eigvalsh(torch.from_numpy(lamps.outlines))[:, 1:].prod(1).sqrt().float()
    compact = area <= EMPTIEST * size.square()
    visible = scene.environment is None or scene.environment.visible
    seen = (mean[2] > radius) & (~infinite | visible) & compact & (energy > 0.0) & energy.isfinite()
    # Near the focus, or through a tiny lens, a lamp's disc is far larger than the lens: there is nothing to guide.
    away, lens = (mean[2] - camera.lens.focus_distance).abs(), camera.lens
    seen &= (away > radius) & (WIDEST * away * lens.radius > radius * lens.focus_distance)
    field = GaussianField()
    field.assign(mean[:, seen], radius[seen], radius[seen], energy[seen])
    known = torch.from_numpy(np.append(seen.numpy(), True)[lamps.triangles])  # -1 is the last
    whole_sky = bool(infinite.any() and seen[infinite & _in_sight(mean, radius, camera)].all())
    shapes = _shapes(scene, lamps, seen, camera)
    device = camera.position.device
    return KnownLamps(field.to(device), outline[:, seen].to(device), shapes, known.to(device), whole_sky)


def _in_sight(mean: Tensor, radius: Tensor, camera: ThinLensCamera) -> Tensor:
    """Whether balls `[3, L]` and `[L]` at infinity may send light into the frame, bool `[L]`."""
    steepest = 0.5 * math.hypot(camera.width, camera.height) * camera.pixel_slope + camera.lens.radius / camera.lens.focus_distance
    return mean[:2].norm(dim=0) - radius < steepest * (mean[2] + radius)


def _shapes(scene: Scene, lamps: Lamps, seen: Tensor, camera: ThinLensCamera) -> Shapes:
    """Which of the lamps that are `seen`, bool `[lamps]`, are lamps of the map or panels."""
    device = camera.position.device
    of_map, panel = torch.zeros_like(seen), torch.from_numpy(lamps.panels.any(axis=(1, 2))) & seen
    if lamps.texels is not None:
        of_map[torch.from_numpy(lamps.texels[lamps.texels >= 0])] = True
        of_map &= seen
    sky_lamp, number = _numbered(of_map), _numbered(panel)
    sky = panels = None
    if bool(of_map.any()):
        texels = torch.cat((sky_lamp, torch.tensor([-1])))[torch.from_numpy(lamps.texels)]  # -1 is the last
        sky = SkyLamps(scene.environment, texels.numpy(), camera)
    if bool(panel.any()):
        to_camera = camera.axes.T
        edges = torch.from_numpy(lamps.panels).float()[panel].to(device)
        centre = torch.from_numpy(lamps.centres).float()[panel].to(device)
        panels = Panels(to_camera @ (centre.T - camera.position), to_camera @ edges[:, 0].T, to_camera @ edges[:, 1].T)
    light = torch.from_numpy(lamps.luminance).float()[panel].to(device)
    return Shapes(sky, sky_lamp[seen].to(device), panels, number[seen].to(device), light)


def _numbered(kind: Tensor) -> Tensor:
    """0, 1, … for those of a kind, bool `[L]`, -1 for the others."""
    return torch.where(kind, kind.cumsum(0) - 1, -1)
