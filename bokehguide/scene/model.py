"""Plain data of a model file, before a scene places the model. Units are those of `types`."""

from __future__ import annotations

from dataclasses import dataclass

from bokehguide.scene.types import Environment, FilmSettings, Material, Mesh, Sun, Vector


@dataclass(frozen=True)
class LightSizes:
    """Sizes of a model's punctual lights, which have none of their own.

    radius: of the spheres for point and spot lights, in metres; None derives it from the model.
    sun_angle: diameter of a sun's disc in degrees; the default is the real sun's.
    """

    radius: float | None = None
    sun_angle: float = 0.53


@dataclass(frozen=True)
class ModelState:
    """The state in which a model is drawn.

    variant: name of one of its material variants, or SET=NAME for each variant set of a stage, with commas in between; None draws
    the file's own choice. time: of its animations, in seconds; None draws the pose at rest.
    """

    variant: str | None = None
    time: float | None = None


AT_REST = ModelState()
"""The state of a model without a variant and a time."""


@dataclass(frozen=True)
class ModelLens:
    """The lens of a camera of a model file.

    aperture_radius: metres, 0 for a pinhole. focus_distance: metres; None focuses on the middle of the frame. sensor_width:
    millimetres.
    """

    aperture_radius: float
    focus_distance: float | None
    sensor_width: float


@dataclass(frozen=True)
class ModelCamera:
    """A camera of a model file; `forward` and `up` are unit vectors.

    vertical_fov, horizontal_fov: degrees. The frame shows at least both; None leaves the horizontal one to the film. lens: None
    derives one from the view.
    """

    name: str
    position: Vector
    forward: Vector
    up: Vector
    vertical_fov: float
    horizontal_fov: float | None = None
    lens: ModelLens | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """Contents of a model file in the model's own space.

    emitters: spheres at the positions of its lights, and other surfaces of lights; framing ignores them. environment, film: None
    without. supported: imported features, one a line. warnings: ignored features, one a line.
    """

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    emitters: tuple[Mesh, ...] = ()
    suns: tuple[Sun, ...] = ()
    cameras: tuple[ModelCamera, ...] = ()
    environment: Environment | None = None
    film: FilmSettings | None = None
    supported: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
