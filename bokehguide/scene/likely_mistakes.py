"""Warnings for values that the user may not have meant: one line each, before a render."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator

import numpy as np

from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.scene.sight import camera_axes, coc_diameter
from bokehguide.scene.types import Mesh, Scene

LEAST_F_NUMBER = 0.5
"""No lens in air has a smaller f-number."""
LEAST_FOV, GREATEST_FOV = 2.0, 150.0
"""Degrees."""
SMALLEST_MODEL, LARGEST_MODEL = 1e-3, 1e3
"""Metres; models beyond were probably made in another unit."""
FARTHEST = 300.0
"""Distance of the scene from the origin, relative to its size, up to which single precision shows no faults. New rays start at
1e-5 of the distance from surfaces, and this offset reaches 0.3 % of the size here."""
BLURRED = 2.0
"""Diameter in pixels of the smallest circle of confusion that counts as out of focus."""
INSIDE = 0.75
"""Winding number of a closed surface around a point inside is 1; this allows for holes."""


def likely_mistakes(scene: Scene, written: Collection[str]) -> tuple[str, ...]:
    """Warnings about `scene`, one a line.

    written: keys of `[camera]` that the user wrote, in a scene file or on the command line. Without `aperture_radius` among
    them, a pinhole counts as a mistake; an f-number counts only if it is among them. The `likely_mistakes` that `scene` has
    already are about units, and replace the warning about its size.
    """
    checks = (_wide_lens(scene), _f_number(scene, written), _field_of_view(scene), _darkness(scene), _pinhole(scene, written))
    return tuple(line for lines in (*checks, _inside(scene), _size_and_place(scene), _focus(scene)) for line in lines)


def _wide_lens(scene: Scene) -> Iterator[str]:
    camera = scene.camera
    if 2.0 * camera.aperture_radius > camera.focus_distance:
        yield (
            f"the lens is {2.0 * camera.aperture_radius:.3g} m wide, wider than its focus distance of "
            f"{camera.focus_distance:.3g} m; give a larger f_number or a smaller aperture_radius"
        )


def _f_number(scene: Scene, written: Collection[str]) -> Iterator[str]:
    # The radius alone does not tell the f-number: the sensor of a scene is known only where an f-number is given.
    camera = scene.camera
    if "f_number" in written and camera.f_number < LEAST_F_NUMBER:
        yield f"an f-number of {camera.f_number:.3g} is below the limit of lenses in air, {LEAST_F_NUMBER:g}; give a larger one"


def _field_of_view(scene: Scene) -> Iterator[str]:
    fov = scene.camera.fov
    if fov < LEAST_FOV:
        yield f"a field of view of {fov:.3g}° is narrower than {LEAST_FOV:g}°; fov is in degrees, focal_length in millimetres"
    if fov > GREATEST_FOV:
        yield f"a field of view of {fov:.3g}° is wider than {GREATEST_FOV:g}°; fov is in degrees, focal_length in millimetres"


def _darkness(scene: Scene) -> Iterator[str]:
    shines = scene.suns or any(scene.materials[mesh.material].emits for mesh in scene.meshes)
    if not shines and (scene.environment is None or not scene.environment.radiance.any()):
        yield "nothing shines, so that the picture is black; add an environment, a sun or a material with emission"


def _pinhole(scene: Scene, written: Collection[str]) -> Iterator[str]:
    if scene.camera.aperture_radius == 0.0 and "aperture_radius" not in written:
        yield (
            "the camera is a pinhole, so that all is sharp; give f_number (option --f-number), or aperture_radius = 0 "
            "(option --aperture-radius 0) to keep the pinhole"
        )
    elif scene.camera.aperture_radius == 0.0 and scene.camera.aperture is not None:
        yield "the camera is a pinhole, on which the shape of the aperture has no effect; give f_number, or leave the shape out"


def _inside(scene: Scene) -> Iterator[str]:
    objects = defaultdict(list)
    for number, mesh in enumerate(scene.meshes):
        objects[mesh.name or f"mesh {number}"].append(mesh)
    position = np.asarray(scene.camera.position)
    for name, meshes in objects.items():
        if _winding_number(meshes, position) > INSIDE:
            yield f"the camera is inside {name!r}; move camera.position out of it"


def _winding_number(meshes: list[Mesh], point: np.ndarray) -> float:
    """How often `meshes` enclose a point: 1 inside a closed surface whose front is outside, -1 in a room, 0 outside.

    The sum of the signed solid angles of the triangles (van Oosterom and Strackee 1983), divided by 4π.
    """
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    if (point < low).any() or (point > high).any():
        return 0.0
    total = 0.0
    for mesh in meshes:
        a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles] - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("ti,ti->t", a, np.cross(b, c))
        dots = [np.einsum("ti,ti->t", *pair) for pair in ((a, b), (b, c), (c, a))]
        total += np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb).sum()
    return total / (2.0 * np.pi)


def _size_and_place(scene: Scene) -> Iterator[str]:
    dark = [mesh.vertices for mesh in scene.meshes if not scene.materials[mesh.material].emits]
    points = np.concatenate(dark or [mesh.vertices for mesh in scene.meshes]).astype(np.float64)
    # Twice the median distance ignores the few corners of a large ground.
    middle = np.median(points, axis=0)
    size = 2.0 * float(np.median(np.linalg.norm(points - middle, axis=1)))
    if not SMALLEST_MODEL <= size <= LARGEST_MODEL and not scene.likely_mistakes:
        yield f"the scene is about {size:.2g} m in size, while lengths are in metres; scale the model if it has another unit"
    distance = float(np.abs(middle).max())
    if distance > FARTHEST * size:
        yield (
            f"the scene is about {size:.2g} m in size and {distance:.2g} m from the origin, where single precision causes dark "
            "bands near contacts; move the model and the camera to the origin"
        )


def _focus(scene: Scene) -> Iterator[str]:
    camera, forward = scene.camera, camera_axes(scene.camera)[2]
    depths = [((mesh.vertices - np.asarray(camera.position, np.float32)) @ forward).max() for mesh in scene.meshes]
    farthest = float(max(depths))
    infinite = camera.focus_distance >= FARTHEST_FOCUS  # the stars, or the environment, are meant
    if 0.0 < farthest < camera.focus_distance and not infinite and coc_diameter(camera, scene.film, farthest) > BLURRED:
        yield (
            f"the focus distance of {camera.focus_distance:.3g} m lies behind everything; the farthest surface is at "
            f"{farthest:.3g} m; give a smaller focus_distance"
        )
