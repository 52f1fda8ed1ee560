"""Cameras of a stage in world space."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bokehguide.scene.model import ModelCamera, ModelLens
from bokehguide.scene.tables import ANGLE_OF_VIEW
from bokehguide.scene.types import as_vector
from bokehguide.scene.usd.libraries import UsdGeom
from bokehguide.scene.usd.prims import Placed
from bokehguide.scene.usd.stage import Stage

TENTH = 0.1
"""Scene units of a focal length or an aperture of 1."""
LONG = 1.0
"""Metres; a longer focal length is more likely a mistake of the unit."""


def read_camera(opened: Stage, placed: Placed) -> ModelCamera | None:
    """A perspective camera; None, with a note, for another one and for values without a meaning."""
    prim, name = placed.prim, placed.name
    camera = UsdGeom.Camera(prim)
    if camera.GetProjectionAttr().Get(opened.time) != UsdGeom.Tokens.perspective:
        opened.lose("orthographic cameras: left out", name)
        return None
    axes = placed.matrices[0][:3, :3]
    lengths = np.linalg.norm(axes, axis=0)
    focal, across, down = (_number(opened, prim, key) for key in ("focalLength", "horizontalAperture", "verticalAperture"))
    for key, value in (("focalLength", focal), ("horizontalAperture", across), ("verticalAperture", down)):
        if value < 0.0:
            opened.fail(prim, f"{key}: {value:g} is out of range; give a number above 0")
    if not (np.isfinite(placed.matrices[0]).all() and (lengths > 0.0).all() and min(focal, across, down) > 0.0):
        opened.lose("cameras with a scale, a focal length or an aperture of 0: left out", name)
        return None
    if np.linalg.det(axes / lengths) < 0.0:
        opened.lose("mirrored cameras: the picture is not mirrored", name)
    if any(_number(opened, prim, key) for key in ("horizontalApertureOffset", "verticalApertureOffset")):
        opened.lose("offsets of the aperture of cameras: left out", name)
    return ModelCamera(
        name=name,
        position=as_vector(placed.matrices[0][:3, 3]),
        forward=as_vector(-axes[:, 2] / lengths[2]),
        up=as_vector(axes[:, 1] / lengths[1]),
        vertical_fov=_angle(down, focal),
        horizontal_fov=_angle(across, focal),
        lens=_lens(opened, camera, focal, across, name),
    )


def _lens(opened: Stage, camera: Any, focal: float, across: float, name: str) -> ModelLens | None:
    """The lens of a camera, whose lengths do not scale with its transform; None if the camera has no f-stop."""
    attribute = camera.GetFStopAttr()
    if not attribute.HasAuthoredValue():
        return None
    stop, focus = _number(opened, camera.GetPrim(), "fStop"), _number(opened, camera.GetPrim(), "focusDistance") * opened.unit
    if stop < 0.0:
        opened.lose("f-stops below 0: a pinhole in their place; give fStop above 0, or --f-number", name)
    length = TENTH * opened.unit * focal
    if length > LONG:
        opened.lose(f"focal lengths above {LONG:g} m: check metersPerUnit, or give --f-number", name)
    return ModelLens(
        aperture_radius=length / (2.0 * stop) if stop > 0.0 else 0.0,
        focus_distance=focus if focus > 0.0 else None,
        sensor_width=1e3 * TENTH * opened.unit * across,
    )


def _angle(aperture: float, focal: float) -> float:
    """A field of view in degrees."""
    return min(max(math.degrees(2.0 * math.atan(aperture / (2.0 * focal))), ANGLE_OF_VIEW.low), ANGLE_OF_VIEW.high)


def _number(opened: Stage, prim: Any, name: str) -> float:
    """A number of a camera, 0 if it is not finite."""
    value = float(prim.GetAttribute(name).Get(opened.time) or 0.0)
    return value if math.isfinite(value) else 0.0
