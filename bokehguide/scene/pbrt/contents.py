"""What a pbrt file describes, before its conversion, and the graphics state while it is read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bokehguide.scene.losses import UNKNOWN_NAMES, Losses, unknown_name
from bokehguide.scene.pbrt.parameters import Parameter, Parameters
from bokehguide.scene.pbrt.tokens import Place


@dataclass(frozen=True)
class State:
    """The graphics state. matrix: world from object. moving: whether transforms of this moment count, as those at the start of
    the exposure do. attributes: default parameters by target."""

    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    reverse: bool = False
    material: str | Parameters | None = None
    light: Parameters | None = None
    space: str = "srgb"
    active: bool = True
    attributes: dict[str, dict[str, Parameter]] = field(default_factory=dict)


@dataclass(frozen=True)
class Shape:
    """A shape. matrix: world from object. material: a name, or the parameters of an unnamed one. light: of its emission."""

    parameters: Parameters
    matrix: np.ndarray
    reverse: bool
    material: str | Parameters | None
    light: Parameters | None


@dataclass(frozen=True)
class Light:
    """A light source. matrix: world from light."""

    parameters: Parameters
    matrix: np.ndarray


@dataclass(frozen=True)
class Texture:
    """A texture. value: "float" or "spectrum"."""

    value: str
    parameters: Parameters


@dataclass(frozen=True)
class Instance:
    """A use of an object. matrix: world from object."""

    name: str
    matrix: np.ndarray
    place: Place


@dataclass
class Contents:
    """The entries of a scene. camera_matrix: camera from world. lost: with a few names or places.

    older: whether the file is of pbrt-v3 or older.
    """

    camera: Parameters | None = None
    camera_matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    film: Parameters | None = None
    integrator: Parameters | None = None
    shapes: list[Shape] = field(default_factory=list)
    objects: dict[str, list[Shape]] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    materials: dict[str, Parameters] = field(default_factory=dict)
    textures: dict[tuple[str, str], Texture] = field(default_factory=dict)
    lost: Losses = field(default_factory=Losses)
    older: bool = False

    def note_misspelt(self) -> None:
        """Note parameters that nothing has read, and whose names resemble those of parameters that were missing."""
        shapes = [shape for each in (self.shapes, *self.objects.values()) for shape in each]
        read = [self.camera, self.film, self.integrator, *self.materials.values()]
        read += [part for shape in shapes for part in (shape.parameters, shape.material, shape.light)]
        read += [light.parameters for light in self.lights] + [texture.parameters for texture in self.textures.values()]
        for parameters in {id(each): each for each in read if isinstance(each, Parameters)}.values():
            for key, near in parameters.misspelt():
                self.lose(UNKNOWN_NAMES, unknown_name(str(parameters.values[key].place), key, near))

    def lose(self, what: str, name: str) -> None:
        """Note a loss of an object."""
        self.lost.add(what, name)
