"""Facts about a scene as its camera sees it, for `bokehguide info`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bokehguide.scene.emitters import Emitters
from bokehguide.scene.names import object_names
from bokehguide.scene.sight import Sight, coc_diameter, frame_grid, frame_rays, to_raster
from bokehguide.scene.types import Camera, FilmSettings, Scene, Vector, as_vector

GRID = (192, 108)
"""Rays over the frame that look for the nearest and the farthest surface."""
SHOWN_EMITTERS = 5


@dataclass(frozen=True)
class Surface:
    """A visible surface: metres along the optical axis, and the name of its object."""

    depth: float
    object: str


@dataclass(frozen=True)
class VisibleEmitter:
    """An emitter in the frame. pixel: of its centre; depth: metres, inf for a peak of a map or a sun; luminance: of its
    radiance; coc: diameter of its circle of confusion in pixels."""

    pixel: tuple[float, float]
    depth: float
    luminance: float
    coc: float


@dataclass(frozen=True)
class SceneObject:
    """Meshes of one name: their materials, number of triangles, and the corners of their bounding box in metres."""

    name: str
    materials: tuple[str, ...]
    triangles: int
    low: Vector
    high: Vector


@dataclass(frozen=True)
class Inspection:
    """nearest, farthest: visible surfaces, None without any. background: whether parts of the frame show none. coc_infinity:
    diameter of the circle of confusion at infinity, pixels. emitters: the brightest in the frame, by their flux."""

    nearest: Surface | None
    farthest: Surface | None
    background: bool
    coc_infinity: float
    emitters: tuple[VisibleEmitter, ...]
    objects: tuple[SceneObject, ...]


def inspect(scene: Scene, emitters: Emitters) -> Inspection:
    """The facts about `scene`, as seen through a pinhole in the middle of the lens. emitters: of `scene`."""
    camera, sight = scene.camera, Sight(scene.meshes, scene.materials)
    seen = sight.along(np.array(camera.position), frame_rays(camera, scene.film, frame_grid(scene.film, *GRID)))
    met = np.isfinite(seen.distance)
    nearest, farthest = None, None
    if met.any():
        depth, mesh = seen.distance[met], seen.mesh[met]
        nearest, farthest = (Surface(float(depth[i]), scene.meshes[mesh[i]].name) for i in (depth.argmin(), depth.argmax()))
    infinity = float(coc_diameter(camera, scene.film, math.inf))
    visible = _visible_emitters(scene, emitters, sight)
    return Inspection(nearest, farthest, not bool(met.all()), infinity, visible, objects(scene))


def objects(scene: Scene) -> tuple[SceneObject, ...]:
    """The objects by name, in the order of the scene."""
    named: dict[str, list[int]] = {}
    for number, name in enumerate(object_names(scene)):
        named.setdefault(name, []).append(number)
    found = []
    for name, numbers in named.items():
        meshes = [scene.meshes[number] for number in numbers]
        low = np.min([mesh.vertices[mesh.triangles].min(axis=(0, 1)) for mesh in meshes], axis=0)
        high = np.max([mesh.vertices[mesh.triangles].max(axis=(0, 1)) for mesh in meshes], axis=0)
        materials = tuple(dict.fromkeys(scene.materials[mesh.material].name for mesh in meshes))
        triangles = sum(len(mesh.triangles) for mesh in meshes)
        found.append(SceneObject(name, materials, triangles, as_vector(low), as_vector(high)))
    return tuple(found)


def _visible_emitters(scene: Scene, emitters: Emitters, sight: Sight) -> tuple[VisibleEmitter, ...]:
    """The emitters of the largest flux whose centres are in the frame and not hidden."""
    camera, film, position = scene.camera, scene.film, np.array(scene.camera.position)
    relative = emitters.centres - np.where(emitters.infinite[:, None], 0.0, position)
    raster, depth = to_raster(camera, film, relative + position)
    inside = (depth > 0.0) & (raster >= 0.0).all(axis=1) & (raster <= (film.width, film.height)).all(axis=1)
    if scene.environment is not None and not scene.environment.visible:
        inside &= ~emitters.infinite
    chosen = np.flatnonzero(inside)
    # A near emitter hides its own centre, so that its bounding sphere counts as reached.
    reach = 1.0 - emitters.bounding_radii[chosen] / np.maximum(np.linalg.norm(relative[chosen], axis=1), 1e-30)
    needed = np.where(emitters.infinite[chosen], 1e30, reach - 1e-4)
    chosen = chosen[sight.along(position, relative[chosen]).distance >= needed]
    distance = np.where(emitters.infinite, 1.0, np.linalg.norm(relative, axis=1))[chosen]
    flux = emitters.luminance[chosen] * (emitters.radii[chosen] / distance) ** 2
    chosen = chosen[np.argsort(-flux, kind="stable")[:SHOWN_EMITTERS]]
    depth = np.where(emitters.infinite, np.inf, depth)
    return tuple(
        VisibleEmitter(
            (float(raster[i, 0]), float(raster[i, 1])),
            float(depth[i]),
            float(emitters.luminance[i]),
            float(coc_diameter(camera, film, depth[i])),
        )
        for i in chosen
    )


def as_json(scene: Scene, facts: Inspection) -> dict[str, Any]:
    """The facts as plain data for JSON; null stands for infinity and for an absent surface."""
    return {
        "scene": scene.name,
        "description": scene.description,
        "camera": _camera(scene.camera),
        "film": _film(scene.film),
        "in_view": {"nearest": _surface(facts.nearest), "farthest": _surface(facts.farthest), "background": facts.background},
        "coc_at_infinity": facts.coc_infinity,
        "emitters": [vars(emitter) | {"depth": _finite(emitter.depth)} for emitter in facts.emitters],
        "objects": [vars(entry) for entry in facts.objects],
        "supported": list(scene.supported),
        "ignored": list(scene.warnings),
        "warnings": list(scene.likely_mistakes),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    shape = None if camera.aperture is None else {key: value for key, value in vars(camera.aperture).items() if key != "image"}
    numbers = {key: _finite(getattr(camera, key)) for key in ("aperture_radius", "f_number", "sensor_width", "focus_distance")}
    places = {key: getattr(camera, key) for key in ("position", "target", "up", "fov")}
    return places | numbers | {"aperture": shape}


def _film(film: FilmSettings) -> dict[str, int]:
    return {"width": film.width, "height": film.height, "max_depth": film.max_depth}


def _surface(surface: Surface | None) -> dict[str, Any] | None:
    return None if surface is None else vars(surface)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
