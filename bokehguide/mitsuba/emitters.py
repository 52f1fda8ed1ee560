"""What a Mitsuba scene emits, as a `Scene` for the proposals of the lens guide.

The scene has the visible emitters alone: area emitters, and the environment as a map. Coordinates are those of the sensor: the
origin is the centre of the lens, x points to the left of the picture, y up and z forward. Emission is its mean luminance over
the shape, as a grey radiance. The proposals need no more, since they are the densities of lens points, and densities do not
bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from bokehguide.mitsuba.frame import matrix
from bokehguide.mitsuba.variants import is_scalar
from bokehguide.scene.shapes import transformed, unit_disc, unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Mesh, Scene

SHAPES = {"Rectangle": unit_rectangle, "Disk": unit_disc, "Sphere": unit_sphere}
"""Shapes of Mitsuba without triangles, as unit shapes that their `to_world` places."""
SAMPLES = 256
"""Points of a shape whose emission is averaged."""
WAVELENGTHS = (450.0, 530.0, 580.0, 620.0)
"""Nanometres at which spectral variants evaluate emission."""
MAP_ROWS = 256
"""Rows of the map that stands for the environment."""
NOWHERE = np.array([[0.0, 0.0, -1.0], [1e-6, 0.0, -1.0], [0.0, 1e-6, -1.0]], np.float32)
"""A triangle behind the lens: a `Scene` has at least one."""


@dataclass(frozen=True)
class EmitterScene:
    """The emitters of a Mitsuba scene. first_triangles: by the index of the shape among `mi.Scene.shapes()`, int64 `[shapes]`,
    its first triangle in `scene`, -1 for shapes that do not emit. per_triangle: whether the primitives of a shape are triangles
    of `scene`, bool `[shapes]`."""

    scene: Scene
    first_triangles: np.ndarray
    per_triangle: np.ndarray


def read_emitters(scene: Any, camera: Camera, width: int, height: int, to_sensor: np.ndarray) -> EmitterScene:
    """The emitters of an `mi.Scene`. camera: in the coordinates of the sensor. to_sensor: world to these, `[4, 4]`."""
    shapes = scene.shapes()
    first, per_triangle = np.full(len(shapes), -1, np.int64), np.zeros(len(shapes), bool)
    meshes, materials, count = [Mesh(NOWHERE, np.array([[0, 1, 2]], np.int32), 0)], [Material("black", (0.0, 0.0, 0.0))], 1
    for number, shape in enumerate(shapes):
        mesh = _mesh(shape) if shape.is_emitter() else None
        bright = 0.0 if mesh is None else _mean_luminance(shape)
        if mesh is None or bright <= 0.0:
            continue
        placed = transformed(Mesh(mesh.vertices, mesh.triangles, len(materials)), to_sensor)
        materials.append(Material(f"shape {number}", (0.0, 0.0, 0.0), emission=(bright, bright, bright)))
        meshes.append(placed)
        first[number], per_triangle[number] = count, shape.is_mesh()
        count += len(placed.triangles)
    return EmitterScene(
        Scene("mitsuba", camera, tuple(meshes), tuple(materials), FilmSettings(width, height), _environment(scene, to_sensor)),
        first,
        per_triangle,
    )


def _mesh(shape: Any) -> Mesh | None:
    """The triangles of a shape in world space, None for shapes of other kinds."""
    if shape.is_mesh():
        vertices = np.array(shape.vertex_positions_buffer(), np.float32).reshape(-1, 3)
        return Mesh(vertices, np.array(shape.faces_buffer(), np.int64).astype(np.int32).reshape(-1, 3), 0)
    unit = SHAPES.get(shape.class_name())
    if unit is None:
        return None
    return transformed(unit(), matrix(mi.traverse(shape)["to_world"]))


def luminance(value: Any, wavelengths: Any) -> Any:
    """The luminance of a spectrum in any variant of Mitsuba."""
    if mi.is_polarized:
        value = mi.unpolarized_spectrum(value)
    if mi.is_spectral:
        return mi.luminance(value, wavelengths)
    return value[0] if mi.is_monochromatic else mi.luminance(value)


def _mean_luminance(shape: Any) -> float:
    """The mean luminance that the emitter of a shape sends along the normals."""
    points = np.random.default_rng(0).random((2, SAMPLES)).astype(np.float32)
    wavelengths: Any = mi.Spectrum(*WAVELENGTHS) if mi.is_spectral else mi.Color0f()

    def emitted(point: Any) -> Any:
        at = mi.SurfaceInteraction3f(shape.sample_position(0.0, mi.Point2f(*point)), wavelengths)
        at.wi = mi.Vector3f(0.0, 0.0, 1.0)
        return luminance(shape.emitter().eval(at), wavelengths)

    return float(np.mean([emitted(point) for point in points.T.tolist()] if is_scalar() else np.array(emitted(points))))


def _environment(scene: Any, to_sensor: np.ndarray) -> Environment | None:
    """The environment emitter as a map of luminance around the sensor, None without one."""
    emitter = scene.environment()
    if emitter is None:
        return None
    rows, columns = MAP_ROWS, 2 * MAP_ROWS
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows, (np.arange(columns) + 0.5) * 2 * np.pi / columns, indexing="ij"
    )
    # The centre of a map of bokehguide lies at -z, and u grows towards +x.
    local = np.stack((-np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi))).reshape(3, -1)
    world = np.linalg.inv(to_sensor[:3, :3]) @ local
    world /= np.linalg.norm(world, axis=0)
    values = _evaluate_environment(emitter, -world.astype(np.float32)).reshape(rows, columns)
    return Environment(np.repeat(np.nan_to_num(values, posinf=0.0).clip(0.0)[..., None], 3, axis=2).astype(np.float32))


def _evaluate_environment(emitter: Any, directions: np.ndarray) -> np.ndarray:
    """Luminance `[N]` of an environment emitter for directions of propagation `[3, N]`."""
    at: Any = mi.SurfaceInteraction3f()
    if mi.is_spectral:
        at.wavelengths = mi.Spectrum(*WAVELENGTHS)

    def emitted(direction: Any) -> Any:
        at.wi = mi.Vector3f(*direction)
        return luminance(emitter.eval(at), at.wavelengths)

    if is_scalar():
        return np.array([emitted(direction) for direction in directions.T.tolist()])
    return np.broadcast_to(np.array(emitted(directions)), directions.shape[1:])
