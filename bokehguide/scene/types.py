"""What a scene is: plain data in world space, before any ray is traced.

Lengths are metres, angles degrees, colours linear Rec.709 (radiance where they
emit). World space is right-handed with y up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Aperture:
    """What the opening of a lens looks like from behind the camera, and in the bokeh of what is behind the focal plane.

    Its size is the lens radius r: that of the circle that its corners lie on, of half its
    height, or of half a mask's longer side.

    blades: of its iris, 0 for a round one; the middle of an edge lies to the right. curvature: of
    their edges, 0 straight, 1 round. image: a mask in place of blades, its transmission as linear
    float32 `[H, W]`, top row first. edge: how much brighter the rim is than the centre, -1 … 1.
    rotation: degrees, anticlockwise. ratio: then the width is divided by it, as Blender has it.
    cat_eye: how far, in r, a second opening lies beside the first for the frame's corners.
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
    """A thin-lens camera that looks from `position` to `target`.

    fov: horizontal field of view in degrees.
    aperture_radius: lens radius in metres, 0 for a pinhole.
    focus_distance: metres from the lens to the focal plane, along the optical axis; math.inf
    is FARTHEST_FOCUS, and so is all beyond it.
    aperture: its shape; None is round.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fov: float = 40.0
    aperture_radius: float = 0.0
    focus_distance: float = 1.0
    aperture: Aperture | None = None


@dataclass(frozen=True)
class Film:
    """Size in pixels and the longest path in segments (1 = emission seen directly)."""

    width: int = 640
    height: int = 360
    max_depth: int = 6


@dataclass(frozen=True)
class Texture:
    """An image on a surface, sampled bilinearly.

    image: linear float32 `[H, W, C]`, top row first; which channels count is the
    material's matter. uv_set: which of the mesh's uv sets; wrap: what lies outside
    [0, 1] along u and v, "repeat", "clamp" or "mirror". transform: rows of the affine
    map (a, b, c, d, e, f), u' = a u + b v + c and v' = d u + e v + f, applied first.
    """

    image: np.ndarray
    uv_set: int = 0
    wrap: tuple[str, str] = ("repeat", "repeat")
    transform: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Cone:
    """Where a spotlight's radiance goes: all within `inner` degrees of `axis`, none beyond `outer`.

    Between them it falls as KHR_lights_punctual has it. axis: unit, in world space.
    """

    axis: tuple[float, float, float]
    inner: float
    outer: float


@dataclass(frozen=True)
class Material:
    """A surface in glTF's metallic-roughness terms.

    Each texture multiplies its factors: base colour (RGB, and opacity by A where it has
    four channels), (unused, roughness, metallic) as glTF packs them, emission (RGB),
    specular (A), specular colour (RGB), transmission (R), clearcoat (R) and
    clearcoat roughness (G). A normal map's texels are tangent-space normals scaled to
    0 … 1; `normal_scale` multiplies their x and y. A clear coat has a normal map and a
    scale of its own: without them it is as smooth as the geometry, whatever lies beneath.

    alpha_mode: "opaque" ignores opacity; "mask" leaves out what is below `alpha_cutoff`;
    "blend" lets the share 1 - opacity of the light through, unbent.
    attenuation_color is what is left of white light after `attenuation_distance` metres
    inside (KHR_materials_volume). emission_cone: None emits to all sides. A clear coat dims
    the emission beneath it; tint_emission: the mesh's colours multiply it, as unlit materials want.
    """

    name: str
    base_color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = 1.0
    specular_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    transmission: float = 0.0
    thin: bool = False
    ior: float = 1.5
    attenuation_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    attenuation_distance: float = math.inf
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
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
        return any(channel > 0.0 for channel in self.emission)


@dataclass(frozen=True)
class Mesh:
    """Triangles in world space with one material.

    vertices: float32 `[V, 3]`; triangles: int32 `[T, 3]`, anticlockwise seen from the
    front; normals: unit float32 `[V, 3]` or None for flat shading; uvs: float32
    `[V, S, 2]`, S sets with v downwards from the texture's top row (glTF), or None.
    tangents: float32 `[V, 4]` for normal maps, glTF's unit tangent and the bitangent's
    sign, or None: then they follow from the uvs. colors: linear float32 `[V, 4]` that
    multiply base colour and opacity, or None. material: index into `Scene.materials`.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    material: int
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    tangents: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True)
class Sun:
    """A disc of constant radiance at infinity.

    direction: unit, from the scene towards the sun; angle: its diameter in degrees;
    irradiance: on a surface that faces it, linear Rec.709.
    """

    direction: tuple[float, float, float]
    angle: float
    irradiance: tuple[float, float, float]


@dataclass(frozen=True)
class Environment:
    """Equirectangular radiance, float32 `[H, W, 3]`, top row towards +y.

    The map's centre lies at -z and u grows towards +x; `rotation` turns it about +y,
    anticlockwise seen from above. A constant colour is a 1 × 1 map. visible: whether
    camera rays see it (suns included); where not, it lights the scene and alpha is 0.
    """

    radiance: np.ndarray
    rotation: float = 0.0
    visible: bool = True


@dataclass(frozen=True)
class Inset:
    """A crop box as fractions of the frame, from its top left corner."""

    x: float
    y: float
    width: float
    height: float

    def pixels(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns of this inset in a `height × width` image."""
        top, left = round(self.y * height), round(self.x * width)
        bottom = max(top + 1, round((self.y + self.height) * height))
        right = max(left + 1, round((self.x + self.width) * width))
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class Scene:
    """Everything a render needs.

    `warnings` say what of the input was not honoured, and `honoured` what of its models was.
    """

    name: str
    camera: Camera
    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    film: Film = Film()
    environment: Environment | None = None
    suns: tuple[Sun, ...] = ()
    insets: tuple[Inset, ...] = ()
    description: str = ""
    warnings: tuple[str, ...] = field(default=())
    honoured: tuple[str, ...] = ()


@dataclass(frozen=True)
class LightSizes:
    """How large the lights of a model become that have no size of their own.

    radius: metres, of the spheres for point and spot lights; None suits the model.
    sun_angle: diameter of a sun's disc in degrees, by default that of the real one.
    """

    radius: float | None = None
    sun_angle: float = 0.53


@dataclass(frozen=True)
class ModelCamera:
    """A camera that a model brings; forward and up are unit, vertical_fov is in degrees."""

    name: str
    position: tuple[float, float, float]
    forward: tuple[float, float, float]
    up: tuple[float, float, float]
    vertical_fov: float


@dataclass(frozen=True)
class Model:
    """What a model's file holds, in the model's own space.

    lamps: spheres in the place of its lights, which are no part of what is framed.
    honoured, warnings: what of the file is in the picture and what is not, a line each.
    """

    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    lamps: tuple[Mesh, ...] = ()
    suns: tuple[Sun, ...] = ()
    cameras: tuple[ModelCamera, ...] = ()
    honoured: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
