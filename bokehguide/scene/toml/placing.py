"""Transforms of a model's lights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bokehguide.scene.model import Model
from bokehguide.scene.shapes import transformed
from bokehguide.scene.types import Material, Mesh, Sun, Vector, as_vector


def in_light_group(model: Model, group: str) -> Model:
    """`model` with all its lights and emissive materials in a light group; `model` itself for an empty name."""
    if not group:
        return model
    materials = (replace(material, light_group=group) if material.emits else material for material in model.materials)
    return replace(model, materials=tuple(materials), suns=tuple(replace(sun, light_group=group) for sun in model.suns))


def place_emitters(model: Model, first: int, matrix: np.ndarray, materials: list[Material]) -> list[Mesh]:
    """The emitters of `model` under `matrix` `[4, 4]`.

    materials: the scene's; the model's start at `first`. A rotated spotlight needs a cone in world
    space, so that its own copy of the material is appended to `materials`.
    """
    emitters = []
    for emitter in model.emitters:
        index = first + emitter.material
        cone = materials[index].emission_cone
        if cone is not None and (axis := _turned(cone.axis, matrix)) != cone.axis:
            materials.append(replace(materials[index], emission_cone=replace(cone, axis=axis)))
            index = len(materials) - 1
        emitters.append(replace(transformed(emitter, matrix), material=index))
    return emitters


def place_suns(model: Model, matrix: np.ndarray) -> list[Sun]:
    """The suns of `model` under the linear part of `matrix` `[4, 4]`."""
    return [replace(sun, direction=_turned(sun.direction, matrix)) for sun in model.suns]


def _turned(direction: Vector, matrix: np.ndarray) -> Vector:
    """`direction` under the linear part of `matrix` `[4, 4]`, at unit length."""
    vector = matrix[:3, :3] @ np.asarray(direction)
    return as_vector(vector / np.linalg.norm(vector))
