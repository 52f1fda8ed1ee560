"""Cryptomatte layers of a render: mattes of objects and of materials through the lens."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.image import cryptomatte
from bokehguide.scene.names import material_names, object_names
from bokehguide.scene.types import Scene

if TYPE_CHECKING:
    from bokehguide.render.film import Film
    from bokehguide.render.halves_film import HalvesFilm


def triangle_objects(scene: Scene) -> dict[str, Tensor]:
    """For each kind of matte, the number of the name of each triangle, from 1, int32 `[T]`. A name has one number."""
    counts = torch.tensor([len(mesh.triangles) for mesh in scene.meshes])
    return {
        kind: torch.repeat_interleave(torch.tensor(_numbers(names), dtype=torch.int32), counts)
        for kind, names in _names_of_meshes(scene).items()
    }


def matte_layers(scene: Scene, picture: Film | HalvesFilm) -> dict[str, np.ndarray]:
    """Layers float32 `[H, W, 4]` by the keys of `bokehguide.image.cryptomatte.CHANNELS`.

    picture: of a loop whose settings have `cryptomatte`. Raises BokehguideError for another picture.
    """
    covered, layers = picture.covered(), {}
    if not covered:
        raise BokehguideError("cryptomatte: the film has no coverage; render with RenderSettings(cryptomatte=True)")
    for kind, names in _names_of_meshes(scene).items():
        ranked = covered[kind].ranked(cryptomatte.RANKS)
        known = np.concatenate(([np.float32(0.0)], cryptomatte.floats(list(dict.fromkeys(names)))))
        shape = (cryptomatte.RANKS, picture.height, picture.width)
        identifiers = known[ranked.numbers.cpu().numpy().reshape(shape)]
        layers |= cryptomatte.planes(kind, identifiers, ranked.share.float().cpu().numpy().reshape(shape))
    return layers


def matte_attributes(scene: Scene) -> dict[str, str]:
    """Header attributes of all layers, with the manifests."""
    found: dict[str, str] = {}
    for kind, names in _names_of_meshes(scene).items():
        found |= cryptomatte.attributes(kind, names)
    return found


def _names_of_meshes(scene: Scene) -> dict[str, list[str]]:
    """The names of each mesh by kind of matte."""
    materials = material_names(scene)
    return {"object": object_names(scene), "material": [materials[mesh.material] for mesh in scene.meshes]}


def _numbers(names: list[str]) -> list[int]:
    """The number of each name, from 1, in the order of first appearance."""
    known = {name: number for number, name in enumerate(dict.fromkeys(names), start=1)}
    return [known[name] for name in names]
