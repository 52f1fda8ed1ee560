"""A model's lights where an object of a scene file puts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.scene.shapes import transformed
from bokehguide.scene.types import Material, Mesh, Model, Sun


def place_lamps(model: Model, first: int, matrix: np.ndarray, materials: list[Material]) -> list[Mesh]:
    """The lamps of `model` under `matrix` `[4, 4]`, scaled as all of it is.

    materials: the scene's, the model's from `first` on. A spotlight that is turned gets
    a material of its own at their end, as its cone lies in world space.
    """
    lamps = []
    for lamp in model.lamps:
        index = first + lamp.material
        cone = materials[index].emission_cone
        if cone is not None and (axis := turned(cone.axis, matrix)) != cone.axis:
            materials.append(replace(materials[index], emission_cone=replace(cone, axis=axis)))
            index = len(materials) - 1
        lamps.append(replace(transformed(lamp, matrix), material=index))
    return lamps


def place_suns(model: Model, matrix: np.ndarray) -> list[Sun]:
    """The suns of `model` under `matrix` `[4, 4]`, of which only the turn matters."""
    return [replace(sun, direction=turned(sun.direction, matrix)) for sun in model.suns]


def turned(direction: tuple[float, float, float], matrix: np.ndarray) -> tuple[float, float, float]:
    """The unit vector along `direction` under `matrix`."""
    vector = matrix[:3, :3] @ np.asarray(direction)
    return tuple(map(float, vector / np.linalg.norm(vector)))
