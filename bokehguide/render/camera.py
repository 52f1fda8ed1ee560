"""The thin-lens camera: raster positions, focus points, rays.

The camera frame has its origin at the lens centre, x right, y up and z along the optical axis into the scene. It is left-handed;
the world is right-handed. Raster positions are in pixels from the top left corner of the film.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render import dimensions
from bokehguide.render.film import NO_DEPTH
from bokehguide.render.lens import make_lens
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import normalize
from bokehguide.runtime import native
from bokehguide.runtime.indexing import Pixels, core_pixels, pixel_numbers
from bokehguide.scene import types


class FilmPositions(NamedTuple):
    """One position in each of N pixels. raster: positions in the frame, pixels, `[2, N]`. subpixel: positions within the pixel,
    0 to 1, `[2, N]`. focus: focus points x_F, camera frame, metres, `[3, N]`."""

    raster: Tensor
    subpixel: Tensor
    focus: Tensor


class ThinLensCamera:
    """Maps raster positions and lens points to world rays, and points of the camera frame to raster positions."""

    def __init__(self, camera: types.Camera, width: int, height: int, device: torch.device | str = "cpu"):
        self.width, self.height = width, height
        position = torch.tensor(camera.position, dtype=torch.float64)
        forward = normalize((torch.tensor(camera.target, dtype=torch.float64) - position)[:, None])[:, 0]
        right = normalize(torch.linalg.cross(forward, torch.tensor(camera.up, dtype=torch.float64))[:, None])[:, 0]
        up = torch.linalg.cross(right, forward)
        self.position = position.float().to(device)[:, None]
        self.axes = torch.stack((right, up, forward), dim=1).float().to(device)  # camera to world, [3, 3]
        self.pixel_slope = 2.0 * math.tan(math.radians(camera.fov) / 2.0) / width
        """Width of a pixel at unit distance: s / d_s of Eq. 24."""
        self.lens = make_lens(camera, 0.5 * math.hypot(width, height) * self.pixel_slope, device)

    def slopes(self, raster: Tensor) -> Tensor:
        """Pinhole slopes (x/z, y/z) `[2, N]` of raster positions `[2, N]`."""
        return torch.stack(
            ((raster[0] - 0.5 * self.width) * self.pixel_slope, (0.5 * self.height - raster[1]) * self.pixel_slope)
        )

    def raster(self, points: Tensor) -> Tensor:
        """Pinhole projection of camera-frame points `[3, N]` to raster positions `[2, N]`."""
        scale = 1.0 / (points[2] * self.pixel_slope)
        return torch.stack((0.5 * self.width + points[0] * scale, 0.5 * self.height - points[1] * scale))

    def focus_points(self, raster: Tensor) -> Tensor:
        """Focus points x_F, camera frame, `[3, N]`: all camera rays of a raster position meet at its point on the focal plane.

        raster: raster positions, `[2, N]`.
        """
        x, y = self.slopes(raster).unbind(0)
        distance = self.lens.focus_distance
        return torch.stack((x * distance, y * distance, torch.full_like(x, distance)))

    def film_positions(self, pixels: Pixels, random: PixelRandom) -> FilmPositions:
        """A random position in each of N pixels of the frame."""
        keys, core = random.pixel_keys, native.core_on(random.pixel_keys.device)
        if core is not None:
            first, numbers = core_pixels(pixels)
            size, lengths = (self.width, self.height), (self.pixel_slope, self.lens.focus_distance)
            rows = torch.empty(7, len(keys))
            core.film_positions(size, lengths, random.core_keys(core), dimensions.FILM, first, numbers, keys, rows)
            return FilmPositions(*rows.split((2, 2, 3)))
        numbers = pixel_numbers(pixels, keys.device)
        row = numbers // self.width
        corner = torch.stack((numbers - row * self.width, row))
        raster = corner + random.stratified(dimensions.FILM, 2)
        return FilmPositions(raster, raster - corner, self.focus_points(raster))

    def rays(self, focus: Tensor, lens_points: Tensor) -> tuple[Tensor, Tensor]:
        """World origins and unit directions `[3, N]` of rays from lens points `[2, N]` through focus points `[3, N]`."""
        core = native.core_on(focus.device)
        if core is not None:
            rows = torch.empty(6, focus.shape[1])
            core.camera_rays(self.axes.contiguous(), self.position, focus.contiguous(), lens_points.contiguous(), rows)
            return rows[0:3], rows[3:6]
        origin = torch.cat((lens_points, torch.zeros_like(lens_points[:1])))
        direction = normalize(focus - origin)
        return self.axes @ origin + self.position, self.axes @ direction

    def depth(self, distance: Tensor, directions: Tensor) -> Tensor:
        """Depth along the axis, metres, of hits at `distance` `[N]` in world `directions` `[3, N]`; NO_DEPTH for misses."""
        core = native.core_on(distance.device)
        if core is not None:
            depths, axes = torch.empty(len(distance)), self.axes.contiguous()
            core.camera_depths(axes, distance.contiguous(), directions.contiguous(), MISS_DISTANCE, NO_DEPTH, depths)
            return depths
        return torch.where(distance < MISS_DISTANCE, distance * (self.axes[:, 2] @ directions), NO_DEPTH)

    def coc_diameter(self, depth: Tensor) -> Tensor:
        """Diameter in pixels of the circle of confusion at `depth`, both `[N]` (metres along the axis), Eq. 23.

        The denominator of Eq. 23 belongs to another geometry. Here, the disc of a point on the sensor has the diameter
        2 r |Z - d_F| / Z · d_s / d_F.
        """
        lens = self.lens
        return 2.0 * lens.radius * (depth - lens.focus_distance).abs() / (depth * lens.focus_distance * self.pixel_slope)
