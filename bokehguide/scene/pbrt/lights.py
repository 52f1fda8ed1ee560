"""Light sources of pbrt: suns, an environment map, and small spheres for points and spots."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.color import LUMINANCE
from bokehguide.errors import printable
from bokehguide.limits import LARGEST
from bokehguide.scene.environments import load_environment_map
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.model import LightSizes
from bokehguide.scene.pbrt.contents import Contents, Light
from bokehguide.scene.pbrt.materials import Materials
from bokehguide.scene.pbrt.octahedral import equirectangular, turned, upper_illuminance
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.spectra import emission
from bokehguide.scene.pbrt.textures import Textures, Value
from bokehguide.scene.pbrt.transforms import inverse, linear
from bokehguide.scene.shapes import sphere_subdivisions, spheres
from bokehguide.scene.types import Cone, Environment, Material, Mesh, Sun, as_vector

POINTS = ("point", "spot", "goniometric", "projection")
"""Light sources at a point."""
QUARTIC = 0.6
"""Width in the cosine of the falloff t² that has the flux of t⁴, which is that of spots before pbrt-v4, per width of t⁴."""


class Lights:
    """The light sources of a scene, converted. world: the matrix from pbrt's world to that of the scene.

    radius: of the spheres for point and spot lights, metres. meshes, suns, environment: the results.
    """

    def __init__(self, contents: Contents, materials: Materials, textures: Textures, world: np.ndarray, radius: float):
        self._contents, self._materials, self._textures = contents, materials, textures
        self._world, self._radius = world, radius
        self._subdivisions = sphere_subdivisions(len(contents.lights))
        self.meshes: list[Mesh] = []
        self.suns: list[Sun] = []
        self._maps: list[np.ndarray] = []

    def read(self, folder: Path, files: SceneFiles) -> None:
        """Convert all light sources. Raises BokehguideError for values out of range and for missing files."""
        for light in self._contents.lights:
            parameters, matrix = light.parameters, self._world @ light.matrix
            if parameters.kind == "infinite":
                self._maps.append(self._infinite(parameters, matrix, folder, files))
            elif parameters.kind == "distant":
                self._distant(parameters, matrix, folder, files)
            elif parameters.kind in POINTS:
                self._point(light, matrix, folder, files)
            else:
                self._contents.lose(f"light sources of the type {printable(parameters.kind)}: left out", parameters.place.short)

    @property
    def environment(self) -> Environment | None:
        """The sum of the infinite lights."""
        if not self._maps:
            return None
        size = max(len(each) for each in self._maps)
        total = np.zeros((size, 2 * size if size > 1 else 1, 3))
        for each in self._maps:
            rows, columns = (np.arange(total.shape[axis]) * each.shape[axis] // total.shape[axis] for axis in (0, 1))
            total = total + each[rows[:, None], columns]
        return Environment(total.astype(np.float32))

    def _distant(self, parameters: Parameters, matrix: np.ndarray, folder: Path, files: SceneFiles) -> None:
        start = np.array(parameters.vector("from", (0.0, 0.0, 0.0)))
        end = np.array(parameters.vector("to", (0.0, 0.0, 1.0)))
        direction = linear(matrix, start - end)
        if not np.linalg.norm(direction) > 0.0:
            parameters.place.fail('distant: "from" equals "to", so there is no direction; move one of them')
        color = emission(parameters, "L", folder, files) * _scale(parameters, self._contents, "illuminance", 1.0)
        if color.any():
            self.suns.append(Sun(as_vector(direction), LightSizes.sun_angle, as_vector(color)))
            self._contents.lose(f"distant lights: discs of {LightSizes.sun_angle}°", parameters.place.short)

    def _point(self, light: Light, matrix: np.ndarray, folder: Path, files: SceneFiles) -> None:
        """A light at a point as a small sphere of the same intensity, within a cone for a spot and a projection."""
        parameters = light.parameters
        start = np.array(parameters.vector("from", (0.0, 0.0, 0.0)))
        cone, solid, image = None, 4.0 * math.pi, np.ones(3)
        if parameters.kind == "spot":
            cone, solid = self._spot(parameters, matrix, start)
        elif parameters.kind == "projection":
            cone, solid, image = self._projection(parameters, matrix)
        elif parameters.kind == "goniometric":
            image = self._goniometric(parameters)
        unit = max(solid * float(image @ LUMINANCE), 1e-12)
        intensity = emission(parameters, "I", folder, files) * _scale(parameters, self._contents, "power", unit) * image
        what = "spheres" if cone is None else "spheres with a cone"
        self._contents.lose(f"{parameters.kind} lights: {what} of radius {self._radius:.3g} m", parameters.place.short)
        if not intensity.any():
            return
        radiance = as_vector(np.minimum(intensity / (math.pi * self._radius**2), LARGEST))
        material = Material(f"{parameters.kind} light", (0.0, 0.0, 0.0), specular=0.0, emission=radiance, emission_cone=cone)
        position = self._beside_camera(matrix @ (*start, 1.0), parameters)
        sphere = spheres(position[None, :3], self._radius, self._materials.add(material), self._subdivisions)
        self.meshes.append(replace(sphere, name=material.name))

    def _beside_camera(self, position: np.ndarray, parameters: Parameters) -> np.ndarray:
        """The position `[4]` of a sphere, or one behind the camera for a sphere that would enclose the camera."""
        matrix = self._world @ inverse(self._contents.camera_matrix, parameters.place, "the camera")
        if np.linalg.norm(position - matrix[:, 3]) > 2.0 * self._radius:
            return position
        self._contents.lose("lights at the camera: behind the camera", parameters.place.short)
        return matrix[:, 3] - 2.0 * self._radius * matrix[:, 2] / np.linalg.norm(matrix[:, 2])

    def _spot(self, parameters: Parameters, matrix: np.ndarray, start: np.ndarray) -> tuple[Cone, float]:
        """The cone of a spotlight, and the integral of pbrt-v4's falloff over directions.

        The falloff of pbrt-v4 is a smoothstep in the cosine. Before pbrt-v4 it is t⁴; a narrower t² is within 0.041 of t⁴.
        """
        axis = linear(matrix, np.array(parameters.vector("to", (0.0, 0.0, 1.0))) - start)
        if not np.linalg.norm(axis) > 0.0:
            parameters.place.fail('spot: "from" equals "to", so there is no direction; move one of them')
        outer, delta = parameters.number("coneangle", 30.0), parameters.number("conedeltaangle", 5.0)
        low, high = math.cos(math.radians(outer)), math.cos(math.radians(outer - delta))
        solid = max(2.0 * math.pi * ((1.0 - high) + 0.5 * (high - low)), 1e-6)
        inner, outer = abs(outer - delta), min(max(outer, 0.1), 90.0)
        older = self._contents.older
        if older and inner < outer:
            outer = math.degrees(math.acos(high - QUARTIC * (high - math.cos(math.radians(outer)))))
        return Cone(as_vector(axis), min(inner, outer - 0.05), outer, smooth=not older), solid

    def _goniometric(self, parameters: Parameters) -> np.ndarray:
        """The mean `[3]` over all directions of the image of a goniometric light."""
        image = self._light_image(parameters, "images of goniometric lights: their mean")
        if not self._contents.older:  # grey maps of equal area
            return np.full(3, (image @ LUMINANCE).mean())
        weights = np.sin(math.pi * (np.arange(len(image)) + 0.5) / len(image))
        return (image.mean(axis=1) * weights[:, None]).sum(axis=0) / weights.sum()

    def _projection(self, parameters: Parameters, matrix: np.ndarray) -> tuple[Cone, float, np.ndarray]:
        """The cone around the axis of a projection with the solid angle of its window, this angle, and the mean colour in it."""
        image = self._light_image(parameters, "images of projection lights: a round spot of their mean colour")
        height, width = image.shape[:2]
        fov = parameters.number("fov", 45.0 if self._contents.older else 90.0)
        if not 0.0 < fov < 180.0:
            parameters.fail("fov", "is out of range; give degrees between 0 and 180")
        sides = math.tan(math.radians(fov) / 2.0) * np.array([max(width, height) / each for each in (height, width)])
        x, y = (side * ((2.0 * np.arange(count) + 1.0) / count - 1.0) for side, count in zip(sides, (width, height)))
        weights = (1.0 + x**2 + y[:, None] ** 2) ** -1.5
        mean = (image * weights[..., None]).sum(axis=(0, 1)) / weights.sum()
        solid = 4.0 * math.asin(float(sides.prod() / np.sqrt(1.0 + sides**2).prod()))
        outer = max(math.degrees(math.acos(1.0 - solid / (2.0 * math.pi))), 0.1)
        axis = linear(matrix, np.array((0.0, 0.0, 1.0)))
        return Cone(as_vector(axis), outer - 0.05, outer), solid, mean

    def _light_image(self, parameters: Parameters, loss: str) -> np.ndarray:
        """The image of a light at a point, linear `[H, W, 3]`; one white texel without one.

        Before pbrt-v4, files hold linear light.
        """
        name = parameters.text("filename")
        if not name:
            return np.ones((1, 1, 3))
        self._contents.lose(loss, printable(name))
        return self._textures.load(name, str(parameters.place), not self._contents.older).clip(min=0.0).astype(np.float64)

    def _infinite(self, parameters: Parameters, matrix: np.ndarray, folder: Path, files: SceneFiles) -> np.ndarray:
        """The radiance `[H, W, 3]` of an infinite light in the scene's directions."""
        if "portal" in parameters:
            self._contents.lose("portals of infinite lights: light comes from all directions", parameters.place.short)
        name = parameters.text("filename")
        if not name:
            color = emission(parameters, "L", folder, files) * _scale(parameters, self._contents, "illuminance", math.pi)
            return color.reshape(1, 1, 3)
        image = self._map(name, parameters, folder, files)
        turn = inverse(matrix, parameters.place, "the infinite light")[:3, :3]
        if self._contents.older:
            return turned(image * emission(parameters, "L", folder, files), turn)
        if len(image) != image.shape[1]:
            parameters.fail("filename", "is no square; pbrt-v4 needs an octahedral map, as imgtool makeequiarea makes it")
        wanted = parameters.number("illuminance", -1.0)
        found = upper_illuminance(image, LUMINANCE) if wanted > 0.0 else 0.0
        scale = _given_scale(parameters, self._contents) * (wanted / found if found > 0.0 else 1.0)
        return equirectangular(image, turn) * np.float32(scale)

    def _map(self, name: str, parameters: Parameters, folder: Path, files: SceneFiles) -> np.ndarray:
        """The image of an infinite light, linear `[H, W, 3]`."""
        if name.lower().endswith((".exr", ".hdr")):
            path = files.find(folder, name, str(parameters.place))
            return load_environment_map(path)[0].astype(np.float64)
        return self._textures.load(name, str(parameters.place), not self._contents.older).clip(min=0.0)


def _scale(parameters: Parameters, contents: Contents, key: str, unit: float) -> float:
    """The factor of a light's colour. The parameter `key`, if above 0, gives its total, of which colour 1 has `unit`."""
    total = parameters.number(key, -1.0)
    return _given_scale(parameters, contents) * (total / unit if total > 0.0 else 1.0)


def _given_scale(parameters: Parameters, contents: Contents) -> float:
    """The parameter `scale` of a light; 0 for a negative one."""
    scale = parameters.number("scale", 1.0)
    if scale < 0.0:
        contents.lose("negative scales of lights: 0 in their place", f"{printable(parameters.kind)}, {parameters.place.short}")
    return max(scale, 0.0)


def area_emission(
    parameters: Parameters, area: float, contents: Contents, textures: Textures, folder: Path, files: SceneFiles
) -> dict[str, Any]:
    """The fields of `Material` of an area light. area: of the shape, m²."""
    both = parameters.flag("twosided")
    name = parameters.text("filename")
    image = textures.load(name, str(parameters.place), True) if name else None
    unit = (2.0 if both else 1.0) * area * math.pi * (1.0 if image is None else max(float((image @ LUMINANCE).mean()), 1e-12))
    color = emission(parameters, "L", folder, files) if image is None else np.ones(3)
    color = color * _scale(parameters, contents, "power", unit)
    fields: dict[str, Any] = {"emission": as_vector(np.minimum(color, LARGEST)), "double_sided": both}
    return fields if image is None else fields | {"emission_texture": textures.on_surface(Value(image))}
