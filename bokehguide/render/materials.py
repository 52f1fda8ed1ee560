"""A scene's materials as tables by material number: parameters, textures, opacity, cones, volumes."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.pixels import worthwhile
from bokehguide.render.textures import TextureAtlas
from bokehguide.render.vector import dot
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
)
"""What a material may have a texture of."""
NORMAL_MAPS = ("normal", "clearcoat_normal")
"""Those of SLOTS whose textures are normal maps; `Surface` has fields of the same names."""
WHITE = (1.0, 1.0, 1.0)
CLEARCOAT_F0 = 0.04
"""Reflectance of a clearcoat head-on: an index of 1.5."""


class Materials:
    """Tables `[.., M]` of M materials. What no material has is None, so that it costs nothing.

    meshes: whose vertex colours may make a material less than opaque.
    """

    def __init__(self, materials: tuple[Material, ...], meshes: tuple[Mesh, ...], device: torch.device):
        def table(rows: list) -> Tensor:
            return torch.tensor(rows, dtype=torch.float32).T.contiguous().to(device)

        def optional(rows: list, needed: bool) -> Tensor | None:
            return table(rows) if needed else None

        atlas = TextureAtlas()
        numbers = {slot: [atlas.add(_texture(m, slot), signed=slot in NORMAL_MAPS) for m in materials] for slot in SLOTS}
        self.tilts_coats = _tilts_coats(materials, numbers)
        """Whether some clear coat's normals are not those of what is beneath."""
        if not self.tilts_coats:
            del numbers["clearcoat_normal"]
        self._numbers = {slot: torch.tensor(row, device=device) for slot, row in numbers.items() if max(row) >= 0}
        self.slots = frozenset(self._numbers)
        """Those of SLOTS in which some material has a texture."""
        self.atlas = atlas.build(device)
        self.parameters = table(
            [(*m.base_color, m.metallic, m.roughness**2, m.specular, m.transmission, float(m.thin), m.ior) for m in materials]
        )
        """base colour, metallic, α, specular, transmission, thin, ior."""
        colored = "specular_color" in self._numbers or any(m.specular_color != WHITE for m in materials)
        self.specular_color = optional([m.specular_color for m in materials], colored)
        coated = any(m.clearcoat > 0.0 for m in materials)
        self.clearcoat = optional([(m.clearcoat, m.clearcoat_roughness**2) for m in materials], coated)
        bending = [slot for slot in NORMAL_MAPS if slot in self._numbers]
        self.normal_scales = {slot: table([(getattr(m, f"{slot}_scale"),) for m in materials]) for slot in bending}
        """Of the x and y of those normal maps that there are."""
        self.has_transmission = any(m.transmission > 0.0 for m in materials)
        self.emissive = torch.tensor([m.emits for m in materials], device=device)
        self.emission = table([(*m.emission, float(m.double_sided)) for m in materials])
        self.tinted = torch.tensor([m.tint_emission for m in materials], device=device)
        """Whose emission vertex colours multiply, bool `[M]`."""
        self._cones = optional([_cone_row(m.emission_cone) for m in materials], any(m.emission_cone for m in materials))
        changed = self._cones is not None or coated or "emission" in self._numbers or any(m.tint_emission for m in materials)
        self.plain_emission = not changed
        """Whether all lamps are as bright wherever, and from wherever, one looks at them."""
        sheer = list(map(_is_sheer, materials, _least_colors(materials, meshes)))
        self.has_sheer = any(sheer)
        self.sheer = torch.tensor(sheer, device=device)
        """Which materials let light through somewhere, bool `[M]`."""
        self._opacity = table([(m.opacity, float(m.alpha_mode == "blend"), _cutoff(m)) for m in materials])
        absorption = [_absorption(material) for material in materials]
        self.absorbs = any(map(any, absorption))
        """Whether some solid absorbs light."""
        self._absorption = optional(absorption, self.absorbs)

    def textured(self, slot: str, material: Tensor) -> tuple[Tensor, Tensor]:
        """Where `material` `[N]` may have a texture in the slot (see `worthwhile`), and which, -1 for none: int64 `[K]` both."""
        if slot not in self._numbers:
            return material[:0], material[:0]
        number = self._numbers[slot].index_select(0, material)
        index = worthwhile(number >= 0)
        return index, number.index_select(0, index)

    def cone(self, material: Tensor, direction: Tensor | None) -> Tensor:
        """Share `[N]` of the emission that goes to `direction` `[3, N]`; None: along the cones' axes."""
        if self._cones is None or direction is None:
            return torch.ones(material.shape, device=material.device)
        rows = self._cones.index_select(1, material)
        return (dot(rows[0:3], direction) * rows[3] + rows[4]).clamp(0.0, 1.0).square()

    def opacity(self, material: Tensor, coverage: Tensor) -> Tensor:
        """Share of the light that `material` `[N]` stops where textures and vertices give `coverage` `[N]`."""
        factor, blend, cutoff = self._opacity.index_select(1, material)
        coverage = factor * coverage
        return blend * coverage.clamp(0.0, 1.0) + (1.0 - blend) * (coverage >= cutoff)

    def transmittance(self, material: Tensor, front: Tensor, distance: Tensor) -> Tensor:
        """What is left `[3, N]` of light after `distance` `[N]` that ended on a solid's inner side.

        Only where some solid absorbs. Solids are not nested: the one whose boundary is met
        from inside is taken to fill the whole way, and on the way to anything else inside
        it nothing is lost.
        """
        return (-self._absorption.index_select(1, material) * ((1.0 - front) * distance)).exp()


def _texture(material: Material, slot: str) -> Texture | None:
    """The material's texture in the slot, where its factor leaves anything of it to see."""
    unseen = {
        "emission": not material.emits,
        "transmission": material.transmission == 0.0,
        "clearcoat": material.clearcoat == 0.0,
        "clearcoat_roughness": material.clearcoat == 0.0,
        "clearcoat_normal": material.clearcoat == 0.0,
    }
    return None if unseen.get(slot, False) else getattr(material, f"{slot}_texture")


def _tilts_coats(materials: tuple[Material, ...], numbers: dict[str, list[int]]) -> bool:
    """Whether a clear-coated material's two normal maps, by the atlas's numbers, or their scales differ."""
    base = zip(numbers["normal"], [m.normal_scale for m in materials])
    coat = zip(numbers["clearcoat_normal"], [m.clearcoat_normal_scale for m in materials])
    return any(m.clearcoat > 0.0 and below != above for m, below, above in zip(materials, base, coat))


def _cone_row(cone: Cone | None) -> tuple[float, ...]:
    """Axis, scale and offset of KHR_lights_punctual's angular falloff."""
    if cone is None:
        return 0.0, 0.0, 0.0, 0.0, 1.0
    inner, outer = math.cos(math.radians(cone.inner)), math.cos(math.radians(cone.outer))
    scale = 1.0 / max(1e-3, inner - outer)
    return *cone.axis, scale, -outer * scale


def _cutoff(material: Material) -> float:
    return material.alpha_cutoff if material.alpha_mode == "mask" else -math.inf


def _least_colors(materials: tuple[Material, ...], meshes: tuple[Mesh, ...]) -> list[float]:
    """The lowest opacity among the vertex colours of each material's meshes."""
    least = [1.0] * len(materials)
    for mesh in meshes:
        if mesh.colors is not None:
            least[mesh.material] = min(least[mesh.material], float(mesh.colors[:, 3].min()))
    return least


def _is_sheer(material: Material, least: float) -> bool:
    """Whether some point of the material may be less than opaque, where the vertices' opacity is at least `least`."""
    if material.alpha_mode == "opaque":
        return False
    least *= material.opacity
    texture = material.base_color_texture
    if texture is not None and texture.image.shape[2] == 4:
        least *= float(np.min(texture.image[..., 3]))
    return least < (material.alpha_cutoff if material.alpha_mode == "mask" else 1.0)


def _absorption(material: Material) -> tuple[float, float, float]:
    """Share of the light lost per metre inside, as e to the minus this."""
    if material.transmission == 0.0 or material.thin or math.isinf(material.attenuation_distance):
        return 0.0, 0.0, 0.0
    return tuple(-math.log(max(channel, 1e-30)) / material.attenuation_distance for channel in material.attenuation_color)
