"""Plain data of a scene in world space.

Lengths are in metres, angles in degrees, colours in linear Rec.709. Emission is radiance.
World space is right-handed with y up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

Vector = tuple[float, float, float]

SENSOR_WIDTH = 36.0
"""Millimetres; the default sensor for focal lengths and f-numbers."""

LABEL = "label"
"""Metadata of fields that name something and change no picture; digests omit them."""


def as_vector(values: Iterable[float]) -> Vector:
    """Three numbers of any kind as a tuple of floats."""
    x, y, z = map(float, values)
    return x, y, z


@dataclass(frozen=True)
class Aperture:
    """The shape of a lens opening, seen from behind the camera.

    The bokeh of anything beyond the focal plane has the same orientation. The lens radius r is the
    circumradius of a polygon, half the height of an opening with a ratio, or half the longer side of a mask.

    blades: number of iris blades, 0 for a disc. The middle of one polygon edge lies to the right.
    rotation: degrees, anticlockwise. curvature: of the polygon edges, 0 straight, 1 a circle.
    ratio: divides the width, as in Blender. image: a mask in place of the blades, its transmission
    as linear float32 `[H, W]`, top row first. cat_eye: offset of the second opening that vignettes
    the frame's corners, in r. edge: from -1 to 1; the transmission is 1 + edge (2t² - 1) at the
    relative distance t from the centre.
    """

    blades: int = 0
    rotation: float = 0.0
    curvature: float = 0.0
    ratio: float = 1.0
    image: np.ndarray | None = None
    cat_eye: float = 0.0
    edge: float = 0.0


@dataclass(frozen=True)
class Camera:
    """A thin-lens camera at `position` that looks at `target`.

    fov: horizontal field of view in degrees. aperture_radius: lens radius in metres, 0 for a pinhole.
    focus_distance: metres from the lens to the focal plane along the optical axis; FARTHEST_FOCUS
    or more is infinity. aperture: shape of the lens opening; None is a disc. sensor_width: of the
    f-number, millimetres.
    """

    position: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov: float = 40.0
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    aperture: Aperture | None = None
    sensor_width: float = SENSOR_WIDTH

    @property
    def f_number(self) -> float:
        """Focal length / lens diameter; inf for a pinhole."""
        if self.aperture_radius == 0.0:
            return math.inf
        return 1e-3 * 0.5 * self.sensor_width / math.tan(math.radians(self.fov) / 2.0) / (2.0 * self.aperture_radius)


@dataclass(frozen=True)
class FilmSettings:
    """Size in pixels, and the maximum path length in segments (1 is directly visible emission)."""

    width: int = 640
    height: int = 360
    max_depth: int = 6


@dataclass(frozen=True)
class Texture:
    """An image on a surface, sampled bilinearly.

    image: linear float32 `[H, W, C]`, top row first; the material selects the channels.
    uv_set: index among the mesh's uv sets. wrap: addressing outside [0, 1] along u and v, "repeat",
    "clamp" or "mirror". transform: the affine map (a, b, c, d, e, f) from the mesh's uv to the
    texture's, u' = a u + b v + c and v' = d u + e v + f.
    """

    image: np.ndarray
    uv_set: int = 0
    wrap: tuple[str, str] = ("repeat", "repeat")
    transform: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Cone:
    """Angular falloff of a spotlight: full radiance within `inner` degrees of `axis`, none beyond `outer`.

    The falloff in between follows KHR_lights_punctual. axis: unit, in world space.
    """

    axis: Vector
    inner: float
    outer: float


@dataclass(frozen=True)
class Material:
    """A surface in glTF's metallic-roughness model.

    Each texture multiplies its factors: base colour (RGB, and opacity by A if there are four
    channels), (unused, roughness, metallic) as in glTF, emission (RGB), specular (A), specular
    colour (RGB), transmission (R), clearcoat (R) and clearcoat roughness (G). Texels of a normal map
    are tangent-space normals mapped to [0, 1]; `normal_scale` multiplies x and y. The clearcoat has
    its own normal map; without one, its normal is the geometry's.

    alpha_mode: "opaque" ignores opacity; "mask" removes points with opacity below `alpha_cutoff`;
    "blend" transmits the fraction 1 - opacity without refraction. attenuation_color: transmittance of
    `attenuation_distance` metres inside (KHR_materials_volume). emission_cone: None emits in all
    directions. tint_emission: vertex colours multiply the emission, as for unlit materials. A
    clearcoat attenuates the emission beneath it.
    """

    name: str
    base_color: Vector = (0.8, 0.8, 0.8)
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = 1.0
    specular_color: Vector = (1.0, 1.0, 1.0)
    transmission: float = 0.0
    thin: bool = False
    ior: float = 1.5
    attenuation_color: Vector = (1.0, 1.0, 1.0)
    attenuation_distance: float = math.inf
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    emission: Vector = (0.0, 0.0, 0.0)
    emission_cone: Cone | None = None
    tint_emission: bool = False
    double_sided: bool = False
    opacity: float = 1.0
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5
    normal_scale: float = 1.0
    clearcoat_normal_scale: float = 1.0
    base_color_texture: Texture | None = None
    metallic_roughness_texture: Texture | None = None
    emission_texture: Texture | None = None
    normal_texture: Texture | None = None
    specular_texture: Texture | None = None
    specular_color_texture: Texture | None = None
    transmission_texture: Texture | None = None
    clearcoat_texture: Texture | None = None
    clearcoat_roughness_texture: Texture | None = None
    clearcoat_normal_texture: Texture | None = None

    @property
    def emits(self) -> bool:
        """True where any channel of the emission is positive."""
        return any(channel > 0.0 for channel in self.emission)


@dataclass(frozen=True)
class Mesh:
    """Triangles in world space with one material.

    vertices: float32 `[V, 3]`. triangles: int32 `[T, 3]`, anticlockwise seen from the front.
    material: index into `Scene.materials`. normals: unit float32 `[V, 3]`; None is flat shading.
    uvs: float32 `[V, S, 2]`, S sets with v downwards from the texture's top row (glTF), or None.
    tangents: float32 `[V, 4]` for normal maps, glTF's unit tangent and the sign of the bitangent;
    None derives them from the uvs. colors: linear float32 `[V, 4]` that multiply base colour and
    opacity, or None. name: of the object. groups: further names of the object, such as those of the
    glTF nodes above its own.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    material: int
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    tangents: np.ndarray | None = None
    colors: np.ndarray | None = None
    name: str = field(default="", metadata={LABEL: True})
    groups: tuple[str, ...] = field(default=(), metadata={LABEL: True})


@dataclass(frozen=True)
class Sun:
    """A disc of constant radiance at infinity.

    direction: unit, from the scene towards the sun. angle: diameter of the disc in degrees.
    irradiance: on a surface perpendicular to `direction`, linear Rec.709.
    """

    direction: Vector
    angle: float
    irradiance: Vector


@dataclass(frozen=True)
class Environment:
    """An environment map: equirectangular radiance, float32 `[H, W, 3]`, top row towards +y.

    The map's centre lies at -z and u grows towards +x. A constant colour is a 1 × 1 map.
    rotation: degrees about +y, anticlockwise seen from above. visible: if False, camera rays that
    escape see neither map nor suns and have alpha 0; the lighting stays.
    """

    radiance: np.ndarray
    rotation: float = 0.0
    visible: bool = True


@dataclass(frozen=True)
class Inset:
    """A crop box in fractions of the frame, measured from the top left corner."""

    x: float
    y: float
    width: float
    height: float

    def pixels(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns of this inset in an image of `height` rows and `width` columns."""
        top, left = round(self.y * height), round(self.x * width)
        bottom = max(top + 1, round((self.y + self.height) * height))
        right = max(left + 1, round((self.x + self.width) * width))
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class Scene:
    """Everything that a render needs.

    warnings: unsupported features of the input, one a line. supported: imported features of its
    models, one a line. likely_mistakes: values that the user may not have meant, one a line.
    """

    name: str
    camera: Camera
    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    film: FilmSettings = FilmSettings()
    environment: Environment | None = None
    suns: tuple[Sun, ...] = ()
    insets: tuple[Inset, ...] = ()
    description: str = ""
    warnings: tuple[str, ...] = field(default=())
    supported: tuple[str, ...] = ()
    likely_mistakes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LightSizes:
    """Sizes of a model's punctual lights, which have none of their own.

    radius: of the spheres for point and spot lights, in metres; None derives it from the model.
    sun_angle: diameter of a sun's disc in degrees; the default is the real sun's.
    """

    radius: float | None = None
    sun_angle: float = 0.53


@dataclass(frozen=True)
class ModelCamera:
    """A camera of a model file; `forward` and `up` are unit vectors, `vertical_fov` is in degrees."""

    name: str
    position: Vector
    forward: Vector
    up: Vector
    vertical_fov: float


@dataclass(frozen=True)
class Model:
    """Contents of a model file in the model's own space.

    emitters: spheres at the positions of its lights; framing ignores them. supported: imported
    features, one a line. warnings: ignored features, one a line.
    """

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    emitters: tuple[Mesh, ...] = ()
    suns: tuple[Sun, ...] = ()
    cameras: tuple[ModelCamera, ...] = ()
    supported: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
