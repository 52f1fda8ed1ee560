"""Materials of a scene as tables by material number: parameters, textures, opacity, emission cones, absorption."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.textures import TextureAtlas
from bokehguide.render.vector import dot
from bokehguide.runtime.indexing import ActiveEntries
from bokehguide.scene.types import Cone, Material, Mesh, Texture

SLOTS = (
    "base_color",
    "metallic_roughness",
    "emission",
    "normal",
    "specular",
    "specular_color",
    "transmission",
    "clearcoat",
    "clearcoat_roughness",
    "clearcoat_normal",
    "sheen_color",
    "sheen_roughness",
    "anisotropy",
    "diffuse_transmission",
    "diffuse_transmission_color",
    "iridescence",
    "iridescence_thickness",
)
"""Parameters of a material that may have a texture."""
NORMAL_MAPS = ("normal", "clearcoat_normal")
"""Slots whose textures are normal maps; `Surface` has fields of the same names."""
SIGNED = (*NORMAL_MAPS, "anisotropy")
"""Slots whose textures hold vectors."""
WHITE = (1.0, 1.0, 1.0)
CLEARCOAT_F0 = 0.04
"""Reflectance at normal incidence of a clearcoat with the refractive index 1.5."""


class Materials:
    """Tables `[.., M]` of the parameters of M materials; None for parameters that no material uses.

    meshes: all meshes of the scene, because vertex colours may make a material translucent.
    """

    def __init__(self, materials: tuple[Material, ...], meshes: tuple[Mesh, ...], device: torch.device):
        self._device = device
        self._add_textures(materials)
        self.parameters = self._table(
            [(*m.base_color, m.metallic, m.roughness**2, m.specular, m.transmission, float(m.thin), m.ior) for m in materials]
        )
        """Base colour, metallic, α, specular, transmission, thin, ior."""
        self.has_transmission = any(m.transmission > 0.0 for m in materials)
        self._add_optional_terms(materials)
        self._add_emission(materials)
        self._add_coverage(materials, meshes)

    def _table(self, rows: list) -> Tensor:
        return torch.tensor(rows, dtype=torch.float32).T.contiguous().to(self._device)

    def _optional(self, rows: list, needed: bool) -> Tensor | None:
        return self._table(rows) if needed else None

    def _add_textures(self, materials: tuple[Material, ...]) -> None:
        atlas = TextureAtlas()
        numbers = {slot: [atlas.add(_texture(m, slot), signed=slot in SIGNED) for m in materials] for slot in SLOTS}
        self.tilts_coats = _tilts_coats(materials, numbers)
        """Whether some clearcoat has normals other than those of the layers beneath."""
        if not self.tilts_coats:
            del numbers["clearcoat_normal"]
        self.numbers = {slot: torch.tensor(row, device=self._device) for slot, row in numbers.items() if max(row) >= 0}
        self.slots = frozenset(self.numbers)
        """Slots in which some material has a texture."""
        self.atlas = atlas.build(self._device)
        bending = [slot for slot in NORMAL_MAPS if slot in self.numbers]
        self.normal_scales = {slot: self._table([(getattr(m, f"{slot}_scale"),) for m in materials]) for slot in bending}
        """Scales of x and y of the normal maps, by slot in use."""

    def _add_optional_terms(self, materials: tuple[Material, ...]) -> None:
        colored = "specular_color" in self.numbers or any(m.specular_color != WHITE for m in materials)
        self.specular_color = self._optional([m.specular_color for m in materials], colored)
        coats = [(m.clearcoat, m.clearcoat_roughness**2) for m in materials]
        self.clearcoat = self._optional(coats, any(m.clearcoat > 0.0 for m in materials))
        sheens = [(*m.sheen_color, m.sheen_roughness) for m in materials]
        self.sheen = self._optional(sheens, any(any(m.sheen_color) for m in materials))
        self.anisotropy = self._optional([_anisotropy(m) for m in materials], any(m.anisotropy > 0.0 for m in materials))
        """Strength, and cosine and sine of the rotation."""
        transmitted = [(m.diffuse_transmission, *m.diffuse_transmission_color) for m in materials]
        self.diffuse_transmission = self._optional(transmitted, any(m.diffuse_transmission > 0.0 for m in materials))
        """Factor and colour of the diffuse transmission."""
        films = [(m.iridescence, m.iridescence_ior, *m.iridescence_thickness) for m in materials]
        self.film = self._optional(films, any(m.iridescence > 0.0 for m in materials))
        """Iridescence, index of refraction, and least and largest thickness in nm, of thin films."""
        self.dispersion = self._optional([(m.dispersion,) for m in materials], any(m.dispersion > 0.0 for m in materials))
        single = [m.single_scattering and m.metallic > 0.0 and m.roughness > 0.0 for m in materials]
        self.single_scattering = self._optional([(float(each),) for each in single], any(single))

    def _add_emission(self, materials: tuple[Material, ...]) -> None:
        self.emissive = torch.tensor([m.emits for m in materials], device=self._device)
        self.emission = self._table([(*m.emission, float(m.double_sided)) for m in materials])
        self.tinted = torch.tensor([m.tint_emission for m in materials], device=self._device)
        """Whether vertex colours multiply the emission of a material, bool `[M]`."""
        cones = [m.emission_cone for m in materials]
        self.cones = self._optional(list(map(_cone_row, cones)), any(cones))
        changed = self.cones is not None or self.clearcoat is not None or "emission" in self.numbers
        self.plain_emission = not (changed or any(m.tint_emission for m in materials))
        """Whether the emission of all materials is constant over the surface and over directions."""

    def _add_coverage(self, materials: tuple[Material, ...], meshes: tuple[Mesh, ...]) -> None:
        translucent = list(map(_is_translucent, materials, _least_colors(materials, meshes)))
        self.has_translucent = any(translucent)
        self.translucent = torch.tensor(translucent, device=self._device)
        """Which materials are translucent somewhere, bool `[M]`."""
        self.opacities = self._table([(m.opacity, float(m.alpha_mode == "blend"), _cutoff(m)) for m in materials])
        absorption = [_absorption(material) for material in materials]
        self.absorbs = any(map(any, absorption))
        """Whether some solid absorbs light."""
        self.absorption = self._optional(absorption, self.absorbs)

    def textured(self, slot: str, material: Tensor) -> tuple[ActiveEntries, Tensor]:
        """Those K of `material` `[N]` with a texture in the slot, and the number of the texture, int64 `[K]`; 0 if inactive."""
        if slot not in self.numbers:
            return ActiveEntries(torch.zeros(0, dtype=torch.bool, device=material.device)), material[:0]
        number = self.numbers[slot].index_select(0, material)
        textured = ActiveEntries(number >= 0)
        return textured, textured.masked(textured.select(number), 0)

    def cone(self, material: Tensor, direction: Tensor | None) -> Tensor:
        """Factor `[N]` of emission cones in unit directions `[3, N]`; None: along their axes."""
        if self.cones is None or direction is None:
            return torch.ones(material.shape, device=material.device)
        rows = self.cones.index_select(1, material)
        t = (dot(rows[0:3], direction) * rows[3] + rows[4]).clamp(0.0, 1.0)
        return t.square() * (1.0 + rows[5] * (2.0 - 2.0 * t))

    def opacity(self, material: Tensor, coverage: Tensor) -> Tensor:
        """Opacity `[N]` of `material` `[N]`, from the product `coverage` `[N]` of texture and vertex alpha."""
        factor, blend, cutoff = self.opacities.index_select(1, material)
        coverage = factor * coverage
        return blend * coverage.clamp(0.0, 1.0) + (1.0 - blend) * (coverage >= cutoff)

    def transmittance(self, material: Tensor, front: Tensor, distance: Tensor) -> Tensor:
        """Transmittance `[3, N]` along rays of length `distance` `[N]` that end on the inner side of a solid.

        Call this method only if `absorbs` is true. Nested solids are not supported. If a ray meets the boundary of a solid from
        inside, the solid absorbs along the whole ray. A ray to another surface inside the solid has no absorption.
        """
        assert self.absorption is not None
        return (-self.absorption.index_select(1, material) * ((1.0 - front) * distance)).exp()


def _texture(material: Material, slot: str) -> Texture | None:
    """Texture of the material in the slot, None if the factor of the texture is 0."""
    unseen = {
        "emission": not material.emits,
        "transmission": material.transmission == 0.0,
        "clearcoat": material.clearcoat == 0.0,
        "clearcoat_roughness": material.clearcoat == 0.0,
        "clearcoat_normal": material.clearcoat == 0.0,
        "sheen_color": not any(material.sheen_color),
        "sheen_roughness": not any(material.sheen_color),
        "anisotropy": material.anisotropy == 0.0,
        "iridescence": material.iridescence == 0.0,
        "iridescence_thickness": material.iridescence == 0.0,
        "diffuse_transmission": material.diffuse_transmission == 0.0,
        "diffuse_transmission_color": material.diffuse_transmission == 0.0,
    }
    return None if unseen.get(slot, False) else getattr(material, f"{slot}_texture")


def _anisotropy(material: Material) -> tuple[float, float, float]:
    """Strength, and cosine and sine of the rotation."""
    angle = math.radians(material.anisotropy_rotation)
    return material.anisotropy, math.cos(angle), math.sin(angle)


def _tilts_coats(materials: tuple[Material, ...], numbers: dict[str, list[int]]) -> bool:
    """Whether base and clearcoat of a material have different normal maps, by number in the atlas, or different scales."""
    base = zip(numbers["normal"], [m.normal_scale for m in materials])
    coat = zip(numbers["clearcoat_normal"], [m.clearcoat_normal_scale for m in materials])
    return any(m.clearcoat > 0.0 and below != above for m, below, above in zip(materials, base, coat))


def _cone_row(cone: Cone | None) -> tuple[float, ...]:
    """Axis, scale and offset of t, and 1 for a smooth falloff (`Cone`)."""
    if cone is None:
        return 0.0, 0.0, 0.0, 0.0, 1.0, 0.0
    inner, outer = math.cos(math.radians(cone.inner)), math.cos(math.radians(cone.outer))
    scale = 1.0 / max(1e-3, inner - outer)
    return *cone.axis, scale, -outer * scale, float(cone.smooth)


def _cutoff(material: Material) -> float:
    return material.alpha_cutoff if material.alpha_mode == "mask" else -math.inf


def _least_colors(materials: tuple[Material, ...], meshes: tuple[Mesh, ...]) -> list[float]:
    """Smallest vertex alpha of the meshes of each material."""
    least = [1.0] * len(materials)
    for mesh in meshes:
        if mesh.colors is not None:
            least[mesh.material] = min(least[mesh.material], float(mesh.colors[:, 3].min()))
    return least


def _is_translucent(material: Material, least: float) -> bool:
    """Whether some point of the material may be translucent; least: smallest vertex alpha."""
    if material.alpha_mode == "opaque":
        return False
    least *= material.opacity
    texture = material.base_color_texture
    if texture is not None and texture.image.shape[2] == 4:
        least *= float(np.min(texture.image[..., 3]))
    return least < (material.alpha_cutoff if material.alpha_mode == "mask" else 1.0)


def _absorption(material: Material) -> tuple[float, float, float]:
    """Absorption coefficients, 1/m; 0 for materials that do not absorb."""
    opaque = material.transmission == 0.0 and material.diffuse_transmission == 0.0
    if opaque or material.thin or math.isinf(material.attenuation_distance):
        return 0.0, 0.0, 0.0
    red, green, blue = (-math.log(max(channel, 1e-30)) / material.attenuation_distance for channel in material.attenuation_color)
    return red, green, blue
