"""Materials and their textures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from bokehguide.scene.checks import Fields, check_light_group
from bokehguide.scene.tables import ANY, FILM, FRACTION, IOR, NOT_NEGATIVE, POSITIVE, Limits
from bokehguide.scene.types.fields import INDEX, LABEL
from bokehguide.scene.types.lights import Cone
from bokehguide.scene.vectors import Vector

WRAPS = ("repeat", "clamp", "mirror")
ALPHA_MODES = ("opaque", "mask", "blend")


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
