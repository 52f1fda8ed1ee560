"""Plain data of a scene in world space.

Lengths are in metres, angles in degrees, colours in linear Rec.709. Emission is radiance.
World space is right-handed with y up.

Each class checks its fields when an instance is built, and raises BokehguideError with the class, the field, the value and the
remedy. Lists and arrays of other types are converted.

Scenes, models, meshes, textures and environments are equal only to themselves: their arrays can be large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from bokehguide.limits import MAX_EXTENT, MAX_PIXELS
from bokehguide.scene.checks import FieldError, Fields, check_light_group, iris_blades, viewing_direction
from bokehguide.scene.tables import (
    ANGLE_OF_VIEW,
    ANY,
    CAT_EYE,
    CONE_ANGLE,
    COUNT,
    EXPOSURE,
    FILM,
    FRACTION,
    IN_FRONT,
    IOR,
    NOT_NEGATIVE,
    POSITIVE,
    RATIO,
    SIGNED_FRACTION,
    SUN_ANGLE,
    Limits,
)
from bokehguide.scene.uvs import turned_uvs
from bokehguide.scene.vectors import Vector as Vector
from bokehguide.scene.vectors import as_vector as as_vector

SENSOR_WIDTH = 36.0
"""Millimetres; the default sensor for focal lengths and f-numbers."""

LABEL = "label"
"""Metadata of fields that name something and change no picture; digests omit them."""

WRAPS = ("repeat", "clamp", "mirror")
INDEX = Limits("an index, a whole number of 0 or more", low=0)
ALPHA_MODES = ("opaque", "mask", "blend")


@dataclass(frozen=True, eq=False)
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

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.keep("blades", iris_blades(fields))
        fields.check_numbers(rotation=ANY, curvature=FRACTION, ratio=RATIO, cat_eye=CAT_EYE, edge=SIGNED_FRACTION)
        if self.image is not None and not fields.check_array("image", ("H", "W"), low=0.0).any():
            fields.fail("image", "is black all over and lets no light through; give an image with brighter pixels")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Aperture) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    @property
    def _values(self) -> tuple[object, ...]:
        """The fields, with an image as its shape and its bytes, which are hashable."""
        image = None if self.image is None else (self.image.shape, self.image.tobytes())
        return self.blades, self.rotation, self.curvature, self.ratio, image, self.cat_eye, self.edge


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

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_vectors(position=ANY, target=ANY, up=ANY)
        fields.check_numbers(fov=ANGLE_OF_VIEW, aperture_radius=NOT_NEGATIVE, focus_distance=IN_FRONT, sensor_width=POSITIVE)
        fields.check_instances(Aperture, "aperture")
        viewing_direction(fields, self.position, self.target, self.up)


@dataclass(frozen=True)
class FilmSettings:
    """Size in pixels, and the maximum path length in segments (1 is directly visible emission).

    exposure: of display images, EV; None: metered.
    """

    width: int = 640
    height: int = 360
    max_depth: int = 6
    exposure: float | None = None

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_wholes(width=COUNT, height=COUNT, max_depth=COUNT)
        if self.exposure is not None:
            fields.check_numbers(exposure=EXPOSURE)
        if self.width * self.height > MAX_PIXELS:
            raise FieldError(f"FilmSettings: {self.width}x{self.height} pixels are too many; give at most {MAX_PIXELS}")


@dataclass(frozen=True, eq=False)
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

    def __post_init__(self) -> None:
        fields = Fields(self)
        if fields.check_array("image", ("H", "W", "C")).shape[2] > 4:
            fields.fail("image", "has more than four channels; give an image with 1 to 4")
        fields.check_wholes(uv_set=INDEX)
        if not (isinstance(self.wrap, (tuple, list)) and len(self.wrap) == 2 and all(mode in WRAPS for mode in self.wrap)):
            fields.fail("wrap", f"is out of range; give two of {', '.join(WRAPS)}")
        fields.keep("wrap", tuple(self.wrap))
        fields.check_tuple("transform", 6)


@dataclass(frozen=True)
class Cone:
    """Angular falloff of a spotlight: full radiance within `inner` degrees of `axis`, none beyond `outer`.

    With t from 0 at `outer` to 1 at `inner`, linear in the cosine, the falloff in between is t² as in KHR_lights_punctual, or
    3t² - 2t³ for `smooth` cones, as in Blender. axis: unit, in world space.
    """

    axis: Vector
    inner: float
    outer: float
    smooth: bool = False

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_direction("axis")
        fields.check_numbers(inner=CONE_ANGLE, outer=CONE_ANGLE)
        fields.check_flags("smooth")
        if self.inner >= self.outer:
            fields.fail("outer", f"is not above inner, {self.inner:g}; give a larger angle")


@dataclass(frozen=True)
class Material:
    """A surface in glTF's metallic-roughness model.

    Each texture multiplies its factors: base colour (RGB, and opacity by A if there are four
    channels), (unused, roughness, metallic) as in glTF, emission (RGB), specular (A), specular
    colour (RGB), transmission (R), clearcoat (R), clearcoat roughness (G), sheen colour (RGB), sheen
    roughness (A), diffuse transmission (A) and its colour (RGB). Texels of a normal map
    are tangent-space normals mapped to [0, 1]; `normal_scale` multiplies x and y. The clearcoat has
    its own normal map; without one, its normal is the geometry's.

    anisotropy: strength by which the roughness α grows to 1 along the tangent, turned by `anisotropy_rotation` degrees
    anticlockwise; its texture holds a direction (RG, mapped to [0, 1]) and a strength (B), as in KHR_materials_anisotropy.
    diffuse_transmission: share of the diffuse light that leaves on the other side. iridescence: share of a thin film of the
    index `iridescence_ior`. Its thickness in nm is the second number of `iridescence_thickness`; a texture (G) mixes the first
    and the second. dispersion: 20 divided by the Abbe number of a transmissive solid.
    single_scattering: metals lack the light that microfacets scatter more than once.

    alpha_mode: "opaque" ignores opacity; "mask" removes points with opacity below `alpha_cutoff`;
    "blend" transmits the fraction 1 - opacity without refraction. attenuation_color: transmittance of
    `attenuation_distance` metres inside (KHR_materials_volume). emission_cone: None emits in all
    directions. tint_emission: vertex colours multiply the emission, as for unlit materials. A
    clearcoat attenuates the emission beneath it. light_group: name of the light group of the emission, empty for none.
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
    sheen_color: Vector = (0.0, 0.0, 0.0)
    sheen_roughness: float = 0.0
    anisotropy: float = 0.0
    anisotropy_rotation: float = 0.0
    diffuse_transmission: float = 0.0
    diffuse_transmission_color: Vector = (1.0, 1.0, 1.0)
    iridescence: float = 0.0
    iridescence_ior: float = 1.3
    iridescence_thickness: tuple[float, float] = (100.0, 400.0)
    dispersion: float = 0.0
    single_scattering: bool = False
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
    sheen_color_texture: Texture | None = None
    sheen_roughness_texture: Texture | None = None
    anisotropy_texture: Texture | None = None
    diffuse_transmission_texture: Texture | None = None
    diffuse_transmission_color_texture: Texture | None = None
    iridescence_texture: Texture | None = None
    iridescence_thickness_texture: Texture | None = None
    light_group: str = field(default="", metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_texts("name")
        check_light_group(fields)
        fields.check_numbers(**MATERIAL_NUMBERS)
        fields.check_vectors(**MATERIAL_COLORS)
        fields.check_tuple("iridescence_thickness", 2, FILM)
        fields.check_flags("thin", "single_scattering", "tint_emission", "double_sided")
        fields.check_choice("alpha_mode", ALPHA_MODES)
        fields.check_instances(Cone, "emission_cone")
        fields.check_instances(Texture, *(key for key in fields.values if key.endswith("_texture")))

    @property
    def emits(self) -> bool:
        """True where any channel of the emission is positive."""
        return any(channel > 0.0 for channel in self.emission)


MATERIAL_NUMBERS: dict[str, Limits] = {
    "metallic": FRACTION,
    "roughness": FRACTION,
    "specular": FRACTION,
    "transmission": FRACTION,
    "ior": IOR,
    "attenuation_distance": replace(POSITIVE, infinity=True),
    "clearcoat": FRACTION,
    "clearcoat_roughness": FRACTION,
    "sheen_roughness": FRACTION,
    "anisotropy": FRACTION,
    "anisotropy_rotation": ANY,
    "diffuse_transmission": FRACTION,
    "iridescence": FRACTION,
    "iridescence_ior": IOR,
    "dispersion": NOT_NEGATIVE,
    "opacity": FRACTION,
    "alpha_cutoff": NOT_NEGATIVE,
    "normal_scale": ANY,
    "clearcoat_normal_scale": ANY,
}
"""Limits of the numbers of a `Material`."""
MATERIAL_COLORS: dict[str, Limits] = {
    "base_color": FRACTION,
    "specular_color": NOT_NEGATIVE,
    "attenuation_color": FRACTION,
    "sheen_color": FRACTION,
    "diffuse_transmission_color": FRACTION,
    "emission": NOT_NEGATIVE,
}
"""Limits of the colours of a `Material`, channel by channel."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world space with one material.

    vertices: float32 `[V, 3]`. triangles: int32 `[T, 3]`, anticlockwise seen from the front.
    material: index into `Scene.materials`. normals: unit float32 `[V, 3]`; None is flat shading.
    uvs: float32 `[V, S, 2]`, S sets with v downwards from the texture's top row (glTF), or None.
    tangents: float32 `[V, 4]` for normal maps, glTF's unit tangent and the sign of the bitangent;
    None derives them from the uvs. colors: linear float32 `[V, 4]` that multiply base colour and
    opacity, or None. name: of the object, empty without one. groups: further names of the object, such as those of the
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

    def __post_init__(self) -> None:
        fields = Fields(self)
        vertices = fields.check_array("vertices", ("N", 3))
        triangles = fields.check_array("triangles", ("N", 3), whole=True)
        count = len(vertices)
        for name, shape in {"normals": (3,), "uvs": ("sets", 2), "tangents": (4,), "colors": (4,)}.items():
            if getattr(self, name) is not None:
                fields.check_array(name, (count, *shape))
        fields.check_wholes(material=INDEX)
        fields.check_texts("name")
        # The range of all coordinates is much faster than that of each axis, and never smaller.
        if count and float(vertices.max()) - float(vertices.min()) > MAX_EXTENT:
            extent = np.ptp(vertices, axis=0).max()
            if extent > MAX_EXTENT:
                raise FieldError(f"Mesh.vertices: reach {extent:.3g} m from end to end; scale them to {MAX_EXTENT:g} m or less")
        if triangles.size and not (triangles.min() >= 0 and triangles.max() < count):
            out = np.flatnonzero(((triangles < 0) | (triangles >= count)).any(axis=1))
            raise FieldError(
                f"Mesh.triangles[{out[0]}] has the indices {triangles[out[0]].tolist()}, but there are {count} vertices; "
                f"repair them ({len(out)} such)"
            )

    @classmethod
    def from_trimesh(cls, mesh: Any, material: int = 0, smooth: bool = False) -> Self:
        """A `trimesh.Trimesh` with its texture coordinates.

        smooth: take the vertex normals of trimesh; else the shading is flat. Raises BokehguideError for anything else than a
        Trimesh, and as the constructor.
        """
        vertices, faces = getattr(mesh, "vertices", None), getattr(mesh, "faces", None)
        if vertices is None or faces is None:
            raise FieldError(
                f"Mesh.from_trimesh: {type(mesh).__name__} is no Trimesh; give one, or the result of Scene.to_mesh() of trimesh"
            )
        uvs = getattr(getattr(mesh, "visual", None), "uv", None)
        if uvs is not None:  # v points upwards in trimesh
            uvs = turned_uvs(np.asarray(uvs, dtype=np.float32)[:, None, :2])
        normals = np.asarray(mesh.vertex_normals) if smooth else None
        return cls(np.asarray(vertices), np.asarray(faces), material, normals, uvs)


@dataclass(frozen=True)
class Sun:
    """A disc of constant radiance at infinity.

    direction: unit, from the scene towards the sun. angle: diameter of the disc in degrees.
    irradiance: on a surface perpendicular to `direction`, linear Rec.709. light_group: as that of a `Material`.
    """

    direction: Vector
    angle: float
    irradiance: Vector
    light_group: str = field(default="", metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        check_light_group(fields)
        fields.check_direction("direction")
        fields.check_numbers(angle=SUN_ANGLE)
        fields.check_vectors(irradiance=NOT_NEGATIVE)


@dataclass(frozen=True, eq=False)
class Environment:
    """An environment map: equirectangular radiance, float32 `[H, W, 3]`, top row towards +y.

    The map's centre lies at -z and u grows towards +x. A constant colour is a 1 × 1 map, or three numbers.
    rotation: degrees about +y, anticlockwise seen from above. visible: if False, camera rays that
    escape see neither map nor suns and have alpha 0; the lighting stays. light_group: as that of a `Material`.
    """

    radiance: np.ndarray
    rotation: float = 0.0
    visible: bool = True
    light_group: str = field(default="", metadata={LABEL: True})

    def __post_init__(self) -> None:
        fields = Fields(self)
        check_light_group(fields)
        if np.shape(fields.values["radiance"]) == (3,):
            fields.values["radiance"] = np.asarray(fields.values["radiance"])[None, None]
        fields.check_array("radiance", ("H", "W", 3), low=0.0)
        fields.check_numbers(rotation=ANY)
        fields.check_flags("visible")


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


@dataclass(frozen=True, eq=False)
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

    def __post_init__(self) -> None:
        fields = Fields(self)
        fields.check_texts("name", "description")
        fields.check_instances(Camera, "camera", optional=False)
        fields.check_instances(FilmSettings, "film", optional=False)
        fields.check_instances(Environment, "environment")
        for key, kind in {"meshes": Mesh, "materials": Material, "suns": Sun, "insets": Inset}.items():
            fields.check_sequence(key, kind)
        count = len(self.materials)
        for number, mesh in enumerate(self.meshes):
            if mesh.material >= count:
                known = f"there are {count} materials" if count != 1 else "there is one material"
                raise FieldError(f"Scene.meshes[{number}].material: {mesh.material} is out of range; {known}")
