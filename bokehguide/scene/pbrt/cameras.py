"""The camera and the film of pbrt as tables of a scene file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.limits import FARTHEST_FOCUS, MAX_EXPOSURE, NEAREST_FOCUS
from bokehguide.scene.checks import located
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.pbrt.contents import Contents
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.realistic import ThinLens, thin_lens
from bokehguide.scene.pbrt.transforms import MIRROR, inverse
from bokehguide.scene.types import FilmSettings

DIRECT = ("whitted", "directlighting")
"""Integrators of pbrt-v3 and older without interreflection."""
MOST_BOUNCES = 1000
"""Bounces of a path."""


def world_matrix(contents: Contents) -> np.ndarray:
    """The matrix from pbrt's world to that of the scene.

    The camera space of pbrt is left-handed: x points to the right, y up and z forward. A camera transform without a reflection
    therefore makes the world left-handed, and the scene becomes its mirror image along x. A world with `Scale -1 1 1` before
    LookAt is right-handed, and keeps its coordinates.
    """
    return MIRROR if np.linalg.det(contents.camera_matrix[:3, :3]) > 0.0 else np.eye(4)


def read_film(contents: Contents) -> FilmSettings:
    """Size of the film, depth of the integrator, and the exposure of the sensor where the file gives one."""
    film, integrator = contents.film, contents.integrator
    width, height = (1280, 720) if film is None else (int(film.number(key, size)) for key, size in SIZES)
    if film is not None and ("cropwindow" in film or "pixelbounds" in film):
        contents.lose("crop windows: the whole frame is rendered", film.place.short)
    if film is not None and film.text("sensor", "cie1931") != "cie1931":
        contents.lose("sensors: that of the CIE 1931 observer in their place", printable(film.text("sensor")))
    bounces = 5 if integrator is None else int(min(max(integrator.number("maxdepth", 5), 0), MOST_BOUNCES))
    if integrator is not None and integrator.kind in DIRECT:
        contents.lose(
            f"integrator {integrator.kind}: interreflection is added; --max-depth 2 leaves direct light",
            integrator.place.short,
        )
    place = "film" if film is None else str(film.place)
    with located(place):
        return FilmSettings(width, height, bounces + 1, _exposure(contents))


SIZES = (("xresolution", 1280), ("yresolution", 720))
"""Parameters of the size of the film, with their defaults."""


def _exposure(contents: Contents) -> float | None:
    """The exposure in EV of a sensor with an imaging ratio other than 1, which is exposure time × ISO / 100; else None.

    Sensors exist since pbrt-v4.
    """
    film, camera = contents.film, contents.camera
    if contents.older:
        return None
    iso = 100.0 if film is None else film.number("iso", 100.0)
    time = 1.0 if camera is None else camera.number("shutterclose", 1.0) - camera.number("shutteropen", 0.0)
    ratio = max(iso, 0.0) * max(time, 0.0) / 100.0
    if ratio <= 0.0 or abs(ratio - 1.0) < 1e-6:
        return None
    return min(max(math.log2(ratio), -MAX_EXPOSURE), MAX_EXPOSURE)


def read_camera(contents: Contents, film: FilmSettings, folder: Path, files: SceneFiles) -> dict[str, Any]:
    """The camera as a table of a scene file. Raises BokehguideError for a camera of a kind that is no lens."""
    camera = contents.camera
    assert camera is not None
    if camera.kind not in ("perspective", "realistic"):
        camera.place.fail(f"a camera of the type {printable(camera.kind)!r} has no counterpart; give a perspective camera")
    matrix = world_matrix(contents) @ inverse(contents.camera_matrix, camera.place, "the camera")
    position, axes = matrix[:3, 3], matrix[:3, :3]
    sizes = np.linalg.norm(axes, axis=0)
    axes = axes / sizes
    _check_axes(contents, camera, axes, sizes)
    if camera.kind == "realistic":
        lens = _realistic(contents, camera, film, folder, files)
    else:
        fov = _horizontal_fov(contents, camera, film, sizes[2] / sizes[0])
        lens = ThinLens(fov, *_radius_and_focus(camera))
    return {
        "position": position.tolist(),
        "target": (position + axes[:, 2] * max(1.0, 1e-3 * float(np.abs(position).max()))).tolist(),
        "up": axes[:, 1].tolist(),
        "fov": lens.fov,
        "aperture_radius": lens.radius * float(sizes[0]),
        "focus_distance": min(max(lens.focus * float(sizes[2]), NEAREST_FOCUS), FARTHEST_FOCUS),
    }


def _radius_and_focus(camera: Parameters) -> tuple[float, float]:
    """The radius of the lens and the distance in focus of a perspective camera."""
    radius, focus = camera.number("lensradius", 0.0), camera.number("focaldistance", 1e6)
    if radius < 0.0:
        camera.fail("lensradius", "is out of range; give 0 or more")
    if focus < 0.0 or (focus == 0.0 and radius > 0.0):
        camera.fail("focaldistance", "is out of range; give a number above 0, as the focal plane is never behind the lens")
    return radius, focus


def _realistic(contents: Contents, camera: Parameters, film: FilmSettings, folder: Path, files: SceneFiles) -> ThinLens:
    """The thin lens of a realistic camera."""
    contents.lose("realistic cameras: a thin lens of the same focal length", printable(camera.text("lensfile")))
    if "aperture" in camera:
        contents.lose("shapes of apertures: round ones in their place", printable(camera.text("aperture")))
    diagonal = 35.0 if contents.film is None else contents.film.number("diagonal", 35.0)
    if not diagonal > 0.0:
        camera.place.fail('"float diagonal" of the film is out of range; give millimetres above 0')
    return thin_lens(camera, film, diagonal, folder, files)


def _check_axes(contents: Contents, camera: Parameters, axes: np.ndarray, sizes: np.ndarray) -> None:
    """Tell a sheared or unevenly scaled camera."""
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.ptp(sizes) > 1e-3 * sizes.max():
        contents.lose("sheared and unevenly scaled cameras: upright ones in their place", camera.place.short)


def _horizontal_fov(contents: Contents, camera: Parameters, film: FilmSettings, stretch: float) -> float:
    """The horizontal field of view in degrees. pbrt's `fov` is that of the shorter side, whose window is from -1 to 1."""
    fov = camera.number("fov", 90.0)
    if not 0.0 < fov < 180.0:
        camera.fail("fov", "is out of range; give degrees between 0 and 180")
    pixels = film.width / film.height
    aspect = camera.number("frameaspectratio", pixels)
    if not aspect > 0.0:
        camera.fail("frameaspectratio", "is out of range; give a number above 0")
    window = np.array([-aspect, aspect, -1.0, 1.0] if aspect > 1.0 else [-1.0, 1.0, -1.0 / aspect, 1.0 / aspect])
    given = camera.numbers("screenwindow")
    if given is not None:
        if len(given) != 4 or not (given[1] > given[0] and given[3] > given[2]).all():
            camera.fail("screenwindow", "is no window; give the left, right, lower and upper edge")
        window = given[:, 0]
    width, height = window[1] - window[0], window[3] - window[2]
    if abs(window[0] + window[1]) > 1e-3 * width or abs(window[2] + window[3]) > 1e-3 * height:
        contents.lose("screen windows off the axis: centred ones in their place", camera.place.short)
    if abs(width / height / pixels - 1.0) > 1e-2:
        contents.lose("pixels that are not square: the horizontal field of view counts", camera.place.short)
    return math.degrees(2.0 * math.atan(0.5 * float(width) * math.tan(math.radians(fov) / 2.0) / float(stretch)))
