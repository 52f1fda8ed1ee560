"""The realistic camera of pbrt as the thin lens that has its focal length and its entrance pupil."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bokehguide.scene.files import SceneFiles, require_file
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.types import FilmSettings

MAX_SURFACES = 1000
"""Surfaces of a lens."""


@dataclass(frozen=True)
class ThinLens:
    """A thin lens. fov: horizontal, degrees. radius: of the entrance pupil, metres. focus: metres from the lens."""

    fov: float
    radius: float
    focus: float


def thin_lens(camera: Parameters, film: FilmSettings, diagonal: float, folder: Path, files: SceneFiles) -> ThinLens:
    """The thin lens of a lens file in paraxial optics. diagonal: of the film, millimetres.

    Raises BokehguideError for a missing or damaged lens file, a lens that does not collect light, and a focus within 4 focal
    lengths of the film, which no thin lens has.
    """
    surfaces = _surfaces(camera, folder, files)
    stop = camera.number("aperturediameter", 1.0)
    whole, before = np.eye(2), np.eye(2)
    medium = 1.0
    with np.errstate(all="ignore"):  # the check below finds what is not finite
        for radius, thickness, eta, diameter in surfaces:
            behind = medium if radius == 0.0 else eta if eta > 0.0 else 1.0
            if radius == 0.0:
                before, stop = whole, min(stop, diameter)
            else:
                whole = np.array([(1.0, 0.0), ((medium - behind) / radius, 1.0)]) @ whole
            whole = np.array([(1.0, thickness / behind), (0.0, 1.0)]) @ whole
            medium = behind
        focal = float(-1.0 / whole[1, 0])
    if not (1e-3 <= focal <= 1e5) or not abs(before[0, 0]) > 1e-3 or not stop > 0.0:
        camera.fail("lensfile", "is no lens that collects light; give another lens")
    distance = camera.number("focusdistance", 10.0) * 1e3
    if distance < 4.0 * focal:
        camera.place.fail(f"the focus distance is below 4 focal lengths, {4e-3 * focal:.3g} m; give a larger one")
    front = 0.5 * (distance + math.sqrt(distance * distance - 4.0 * distance * focal))
    width = diagonal * film.width / math.hypot(film.width, film.height)
    fov = 2.0 * math.degrees(math.atan(0.5 * width / (distance - front)))
    return ThinLens(fov, 5e-4 * stop / abs(before[0, 0]), 1e-3 * front)


def _surfaces(camera: Parameters, folder: Path, files: SceneFiles) -> np.ndarray:
    """Radius of curvature, thickness, refractive index and diameter `[N, 4]` of each surface from the front, millimetres."""
    path = files.find(folder, camera.text("lensfile"), str(camera.place))
    require_file(path, "lens", str(camera.place))
    lines = path.read_text("utf-8", errors="replace").splitlines()
    try:
        numbers = np.array(" ".join(line.partition("#")[0] for line in lines).split(), np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) == 0 or len(numbers) % 4 or len(numbers) > 4 * MAX_SURFACES or not np.isfinite(numbers).all():
        camera.fail("lensfile", "does not hold four numbers for each surface; repair it")
    return numbers.reshape(-1, 4)
