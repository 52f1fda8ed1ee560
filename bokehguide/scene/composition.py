"""The view of a model without a camera, as a photographer would choose it.

The front of a model faces +z. The camera stands about as high as the model, three quarters from the front, with bright emitters
behind the model and inside the frame. The choice is the best of a fixed list of views, so that the same files give the same view.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from bokehguide.scene.emitters import Emitters
from bokehguide.scene.sight import Sight, camera_axes, frame_grid, frame_rays
from bokehguide.scene.types import Camera, FilmSettings, as_vector

FOV = 40.0
AZIMUTHS = tuple(side * angle for angle in (35, 30, 40, 25, 45, 20, 50) for side in (1, -1))
"""Degrees from +z towards +x, the preferred ones first."""
PITCHES = (-26, -20, -15, -11, -8, -6, -4, -2, 0, 2, 4)
"""Elevations of the optical axis in degrees."""
FILLS = (0.84, 0.66)
"""Shares of the frame's width or height that the model takes."""
LOWERED = (0.0, 0.35, 0.7, 1.0)
"""Positions of the model between the middle of the frame, 0, and the lowest place, 1."""
COVERS = -0.25
"""Height that the model reaches at least, from the middle of the frame, relative to half of the frame's height."""
FLAT, TALL = 0.15, 0.8
"""Height relative to width of models that are seen from HIGH and from LOW degrees above their middle."""
HIGH, LOW = 18.0, 6.0
LOWEST = (8.0, -4.0)
"""Degrees from which a FLAT and a TALL model are seen at least: a board from its edge shows nothing."""
INSIDE = 0.86
"""Share of the frame, from its middle, in which an emitter counts as inside."""
LEAST_BLUR = 1.0 / 3.0
"""Smallest circle of confusion of an emitter that counts, relative to that at infinity; emitters on the model have less."""
OVERHEAD, FAINT = 25.0, 1e-3
"""Emitters at infinity above this elevation in degrees do not count, nor those below this share of the flux of all others."""
MOST_EMITTERS = 256
CELLS = 32
"""Cells along the longest side of the grid that thins out the model's points."""
HIGHLIGHT = 0.06
"""Diameter of the circle of confusion at infinity, relative to the width of the frame."""
GRID = (65, 37)
"""Rays over the frame, both numbers odd, that look for the surface in its middle."""
WEIGHT_HEIGHT, WEIGHT_AZIMUTH, WEIGHT_SIDE, WEIGHT_FILL, WEIGHT_LOWERED = 0.0016, 0.004, 0.5, 0.8, 0.08
"""Costs of a view, relative to the merit of 1 for the most emitters in the frame: per squared degree from the preferred
elevation, per degree from the preferred azimuth, of the side of -x (models that do not face +z often face +x), of a small model,
and of a model below the middle."""


@dataclass(frozen=True)
class Composition:
    """A view of a model. rotation: degrees by which the environment is to turn about +y, to bring emitters into the frame."""

    camera: Camera
    rotation: float = 0.0


def compose(
    points: np.ndarray, sight: Sight, emitters: Emitters, film: FilmSettings, fov: float, turnable: bool = True
) -> Composition:
    """The best view of a model with the vertices `points` `[N, 3]`.

    sight: of the model. emitters: of the model and its environment. fov: horizontal, degrees. turnable: whether the environment
    may turn; it turns only where the best view without a turn has no emitter in the frame.
    """
    points, bright = _thinned(points), _bright_emitters(emitters, float(np.ptp(points, axis=0).max()))
    views = [view for view in _views(points, film, fov) if view.elevation >= _by_shape(points, LOWEST)]
    costs = np.array([_cost(view, _by_shape(points, (HIGH, LOW))) for view in views])

    def best(bright: _BrightEmitters) -> tuple[_View, float]:
        shares = np.array([bright.share(view, sight, film) for view in views])
        chosen = int(np.argmax(shares / max(shares.max(), 1e-30) - costs))
        return views[chosen], float(shares[chosen])

    (view, share), rotation = best(bright), 0.0
    if turnable and share == 0.0 and (angle := bright.useful_rotation()) is not None:
        turned, share = best(bright.rotated(angle))
        view, rotation = (turned, angle) if share > 0.0 else (view, 0.0)
    return Composition(with_lens(view.camera, sight, film), rotation)


def with_lens(camera: Camera, sight: Sight, film: FilmSettings) -> Camera:
    """`camera` focused on the part of the model in the middle of the frame, with a lens that blurs infinity to HIGHLIGHT.

    The focus is on the surface nearest to the middle, or to the inner third of the surfaces' box where the middle lies outside.
    The target moves to the focal plane. Without a surface in the frame the focus is at the target.
    """
    axis = camera_axes(camera)[2]
    focus = float(np.linalg.norm(np.subtract(camera.target, camera.position)))
    raster = frame_grid(film, *GRID)
    depth = sight.along(np.array(camera.position), frame_rays(camera, film, raster)).distance
    met = np.isfinite(depth) & (depth > 0.0)
    if met.any():
        raster, depth = raster[met], depth[met]
        low, high = raster.min(axis=0), raster.max(axis=0)
        wanted = np.clip((0.5 * film.width, 0.5 * film.height), low + (high - low) / 3.0, high - (high - low) / 3.0)
        focus = float(depth[np.argmin(np.linalg.norm(raster - wanted, axis=1))])
    radius = HIGHLIGHT * focus * np.tan(np.radians(camera.fov) / 2.0)
    target = as_vector(np.array(camera.position) + focus * axis)
    return replace(camera, target=target, focus_distance=focus, aperture_radius=float(radius))


@dataclass(frozen=True)
class _View:
    """A candidate: its camera, whose target lies as deep as the model's middle, and the parameters of the choice.

    elevation: of the camera above the model's middle, degrees.
    """

    camera: Camera
    azimuth: float
    elevation: float
    fill: float
    lowered: float


def _views(points: np.ndarray, film: FilmSettings, fov: float) -> Iterator[_View]:
    """All candidates for a model with the vertices `points` `[N, 3]`."""
    aspect = film.height / film.width
    for azimuth, pitch in product(AZIMUTHS, PITCHES):
        turn, tilt = np.radians(azimuth), np.radians(pitch)
        forward = np.array([-np.sin(turn) * np.cos(tilt), np.sin(tilt), -np.cos(turn) * np.cos(tilt)])
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        axes = np.stack([right, np.cross(right, forward), forward])
        seen = axes @ points.T
        for fill, lowered in product(FILLS, LOWERED):
            position, depth = _fitted(seen, fov, aspect, fill, lowered)
            position = position @ axes
            x, y, z = position - (points.min(axis=0) + points.max(axis=0)) / 2.0
            camera = Camera(as_vector(position), as_vector(position + depth * forward), fov=fov)
            yield _View(camera, azimuth, float(np.degrees(np.arctan2(y, np.hypot(x, z)))), fill, lowered)


def _fitted(points: np.ndarray, fov: float, aspect: float, fill: float, lowered: float) -> tuple[np.ndarray, float]:
    """The position `[3]` from which `points` `[3, N]` fit the frame, and the depth of their middle, in axes of the camera.

    A point (x, y, z) lies within the slope k of the camera at (a, b, c) if |x - a| ≤ k (z - c). The largest x - k z and
    -x - k z of the points therefore give c, and a halfway between the two planes; likewise b.
    """
    x, y, z = points
    wide = fill * np.tan(np.radians(fov) / 2.0)
    high = wide * aspect
    right, left = (x - wide * z).max(), (-x - wide * z).max()
    top, bottom = (y - high * z).max(), (-y - high * z).max()
    c = -max((right + left) / (2.0 * wide), (top + bottom) / (2.0 * high))
    b = (top - bottom) / 2.0
    # The camera may rise until the model touches the lower edge, while its upper end stays near the middle of the frame.
    slack = min((-high * c - bottom) - b, max((y - COVERS * high * (z - c)).max() - b, 0.0))
    return np.array([(right - left) / 2.0, b + lowered * max(slack, 0.0), c]), float((z.min() + z.max()) / 2.0 - c)


def _by_shape(points: np.ndarray, ends: tuple[float, float]) -> float:
    """A value for the shape of the model, between the first of `ends` for a FLAT model and the second for a TALL one."""
    x, y, z = np.ptp(points, axis=0)
    return float(np.interp(y / max(np.hypot(x, z), 1e-30), (FLAT, TALL), ends))


def _cost(view: _View, elevation: float) -> float:
    """How far a view is from the preferred one, without regard to emitters. elevation: the preferred one, degrees."""
    cost = WEIGHT_HEIGHT * (view.elevation - elevation) ** 2 + WEIGHT_AZIMUTH * abs(abs(view.azimuth) - 35.0)
    cost += WEIGHT_SIDE * (view.azimuth < 0)
    return cost + WEIGHT_FILL * (FILLS[0] - view.fill) + WEIGHT_LOWERED * view.lowered


@dataclass(frozen=True)
class _BrightEmitters:
    """The emitters that count. centres: `[K, 3]`, unit directions where `infinite` `[K]`; flux: luminance × solid angle at
    infinity, luminance × area elsewhere, `[K]`."""

    centres: np.ndarray
    flux: np.ndarray
    infinite: np.ndarray

    def share(self, view: _View, sight: Sight, film: FilmSettings) -> float:
        """The sum of the square roots of the fluxes of the emitters that are visible behind the model.

        The root lets many emitters count for more than one bright emitter. A near emitter counts in proportion to its blur.
        """
        camera = view.camera
        position = np.array(camera.position)
        axes, middle = camera_axes(camera), float(np.linalg.norm(np.subtract(camera.target, position)))
        relative = self.centres - np.where(self.infinite[:, None], 0.0, position)
        x, y, depth = axes @ relative.T
        reach = INSIDE * np.tan(np.radians(camera.fov) / 2.0)
        inside = (depth > 0.0) & (np.abs(x) < reach * depth) & (np.abs(y) < reach * depth * film.height / film.width)
        blur = np.where(self.infinite, 1.0, 1.0 - middle / np.maximum(depth, 1e-30))
        inside &= blur > LEAST_BLUR
        if not inside.any():
            return 0.0
        chosen = np.flatnonzero(inside)
        seen = sight.along(position, relative[chosen])
        chosen = chosen[seen.distance > np.where(self.infinite[chosen], 1e30, 0.95)]
        squared = np.where(self.infinite, 1.0, (relative**2).sum(1))[chosen]
        return float((blur[chosen] * np.sqrt(self.flux[chosen] / squared)).sum())

    def rotated(self, angle: float) -> _BrightEmitters:
        """The emitters, those at infinity turned by `angle` degrees about +y, anticlockwise seen from above."""
        cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turned = self.centres @ np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        return replace(self, centres=np.where(self.infinite[:, None], turned, self.centres))

    def useful_rotation(self) -> float | None:
        """The rotation that brings the brightest low emitter of the map behind the model in the first view; None without one."""
        low = self.infinite & (np.abs(self.centres[:, 1]) < np.sin(np.radians(15.0)))
        if not low.any():
            return None
        x, _, z = self.centres[low][np.argmax(self.flux[low])]
        behind = np.degrees(np.arctan2(-z, x))
        wanted = np.degrees(np.arctan2(np.cos(np.radians(AZIMUTHS[0])), -np.sin(np.radians(AZIMUTHS[0]))))
        # Beside the middle of the frame, which the model covers.
        return float((wanted - 12.0 - behind + 180.0) % 360.0 - 180.0)


def _bright_emitters(emitters: Emitters, size: float) -> _BrightEmitters:
    """The emitters that are bright enough to count, among the ones that may be in a frame: no sun overhead.

    size: of the model. The irradiance at this distance compares near emitters with emitters at infinity.
    """
    high = emitters.infinite & (np.abs(emitters.centres[:, 1]) > np.sin(np.radians(OVERHEAD)))
    flux = np.where(high, 0.0, emitters.luminance * np.pi * emitters.radii**2)
    irradiance = np.where(emitters.infinite, flux, flux / size**2)
    bright = np.argsort(-irradiance, kind="stable")[:MOST_EMITTERS]
    bright = bright[irradiance[bright] > FAINT * irradiance.sum()]
    return _BrightEmitters(emitters.centres[bright], flux[bright], emitters.infinite[bright])


def _thinned(points: np.ndarray) -> np.ndarray:
    """One of the `points` `[N, 3]` in each cell of a grid, and the extreme points along the axes."""
    low = points.min(axis=0)
    cells = np.floor((points - low) * (CELLS / max(np.ptp(points, axis=0).max(), 1e-30))).astype(np.int64)
    _, first = np.unique(cells @ np.array([1, CELLS + 1, (CELLS + 1) ** 2]), return_index=True)
    return points[np.union1d(first, np.concatenate([points.argmin(axis=0), points.argmax(axis=0)]))]
