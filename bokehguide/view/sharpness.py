"""Depth through the centre of the lens: for the focus of a click, and for the marker of the plane of focus."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np

from bokehguide.errors import BokehguideError
from bokehguide.scene import Scene
from bokehguide.scene.sight import Sight, coc_diameter, frame_grid, frame_rays
from bokehguide.scene.types import FilmSettings

MARKER_WIDTH = 480
"""Largest width of the marker in pixels."""
SHARP = 1.5
"""Diameter, in pixels of the picture, of the largest circle of confusion that the marker covers."""


class DepthFinder:
    """Finds depths of the first visible surfaces. Meshes and materials are those of the scene for ever.

    The structure over the triangles is built when it is first needed. Threads may call the methods concurrently.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._sight: Sight | None = None
        self._lock = threading.Lock()
        self._pose: object = None
        self._map = np.empty((0, 0))

    def at(self, scene: Scene, x: float, y: float) -> float:
        """Depth in metres along the optical axis at a point of the frame, in fractions.

        Raises BokehguideError where nothing but background is visible.
        """
        raster = np.array([[x * scene.film.width, y * scene.film.height]])
        depth = float(self._along(scene, frame_rays(scene.camera, scene.film, raster))[0])
        if not np.isfinite(depth):
            seen = "the ray through the middle of the lens meets nothing but background there"
            raise BokehguideError(f"focus: {seen}; click a surface, or set the distance")
        return depth

    def marker(self, scene: Scene) -> np.ndarray:
        """Opacity of the marker over the frame, uint8 `[H, W]`: surfaces that are sharp."""
        film = scene.film
        width = min(film.width, MARKER_WIDTH)
        small = replace(film, width=width, height=max(1, round(film.height * width / film.width)))
        depth = self._depths(scene, small)
        sharp = np.isfinite(depth) & (coc_diameter(scene.camera, film, depth) <= SHARP)
        return np.where(sharp, 255, 0).astype(np.uint8)

    def _depths(self, scene: Scene, film: FilmSettings) -> np.ndarray:
        """Depths `[H, W]` through the centre of the lens, kept while the camera stays."""
        camera = scene.camera
        pose = (camera.position, camera.target, camera.up, camera.fov, film.width, film.height)
        with self._lock:
            if self._pose == pose:
                return self._map
        rays = frame_rays(camera, film, frame_grid(film, film.width, film.height))
        depths = self._along(scene, rays).reshape(film.height, film.width)
        with self._lock:
            self._pose, self._map = pose, depths
        return depths

    def _along(self, scene: Scene, rays: np.ndarray) -> np.ndarray:
        with self._lock:
            if self._sight is None:
                self._sight = Sight(self._scene.meshes, self._scene.materials)
        return self._sight.along(np.array(scene.camera.position), rays).distance
