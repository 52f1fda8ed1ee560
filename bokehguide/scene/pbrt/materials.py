"""Materials of pbrt-v4 in the terms of `Material`, with the parts that materials of all versions share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.anisotropy import from_alphas
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.pbrt.contents import Contents, Shape
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.spectra import index, metal
from bokehguide.scene.pbrt.textures import Textures, Value, constant
from bokehguide.scene.pbrt.tokens import Place
from bokehguide.scene.tables import did_you_mean
from bokehguide.scene.types import Material, as_vector

GREY = (0.5, 0.5, 0.5)
MAX_NESTING = 16
"""Mixtures of materials that refer to each other; a cycle has more."""


@dataclass(frozen=True)
class Opacity:
    """The opacity of a shape. key: equal for equal opacities."""

    value: Value
    key: object


class Materials:
    """The materials of a scene, each converted once for each opacity."""

    def __init__(self, contents: Contents, textures: Textures, folder: Path, files: SceneFiles):
        self._contents, self._textures, self._folder, self._files = contents, textures, folder, files
        self._known: dict[object, int | None] = {}
        self.all: list[Material] = []

    def index(self, shape: Shape, opacity: Opacity | None, emission: dict[str, Any]) -> int | None:
        """The index of the material of a shape, None where the surface is invisible. emission: its fields of emission.

        Raises BokehguideError for an unknown kind or name of a material.
        """
        source = shape.material
        shared = "emission_texture" not in emission
        light = tuple(emission.items()) if shared else ()
        key = (source if isinstance(source, str) else id(source), None if opacity is None else opacity.key, light)
        if shared and key in self._known:
            return self._known[key]
        material = self._material(source, shape.parameters.place, 0)
        if material is not None and opacity is not None:
            material = self._translucent(material, opacity.value)
        if material is None and emission:
            material = Material("light", (0.0, 0.0, 0.0), specular=0.0)
        number = None if material is None else self.add(replace(material, **emission))
        if shared:
            self._known[key] = number
        return number

    def turned(self, shape: Shape) -> bool:
        """Whether the medium behind a shape is the thinner one, so that the material suits the other side of the surface."""
        source = self._contents.materials.get(shape.material) if isinstance(shape.material, str) else shape.material
        return source is not None and source.kind == "dielectric" and self._eta(source) < 1.0

    def add(self, material: Material) -> int:
        """The index of another material."""
        self.all.append(material)
        return len(self.all) - 1

    def _material(self, source: str | Parameters | None, place: Place, depth: int) -> Material | None:
        """The closest material, None for an interface between media. place: of its use."""
        if source is None:
            return Material("default", GREY, specular=0.0)
        if isinstance(source, str):
            found = self._contents.materials.get(source)
            if found is None:
                names = self._contents.materials
                place.fail(f"no material {printable(source)!r}; {did_you_mean(source, names) if names else 'define it'}")
            name, source = printable(source), found
        else:
            name = printable(source.kind)
        if source.kind in ("interface", "none", ""):
            return None
        if depth > MAX_NESTING:
            source.place.fail("mixtures of materials refer to each other; break the chain")
        material = self._converted(source, name, depth)
        return None if material is None else self._bumped(source, material)

    def _converted(self, source: Parameters, name: str, depth: int) -> Material | None:
        """A material before its normal map. Raises BokehguideError for an unknown kind."""
        if source.kind not in KINDS:
            known = "convert the file with pbrt --upgrade" if source.kind in OLDER_NAMES else did_you_mean(source.kind, KINDS)
            source.place.fail(f"material {printable(source.kind)!r}: unknown in pbrt-v4; {known}")
        return KINDS[source.kind](self, source, name, depth)

    def _bumped(self, source: Parameters, material: Material) -> Material:
        """`material` with the normal map; displacement is lost."""
        if "displacement" in source:
            self._contents.lose("displacement and bump maps: left out", material.name)
        name = source.text("normalmap")
        if not name:
            return material
        return replace(
            material, normal_texture=self._textures.on_surface(Value(self._textures.load(name, str(source.place), False)))
        )

    def _translucent(self, material: Material, opacity: Value) -> Material:
        """`material` with the opacity of a shape."""
        if opacity.constant:
            return replace(material, alpha_mode="blend", opacity=float(opacity.image.mean().clip(0.0, 1.0)))
        texture, alpha = (
            material.base_color_texture,
            opacity.map(lambda texels: texels.mean(axis=2, keepdims=True).clip(0.0, 1.0)),
        )
        color = (
            Value(np.ones((1, 1, 3))) if texture is None else Value(texture.image[..., :3], texture.wrap[0], texture.transform)
        )
        both = self._textures.combined(color, alpha, _with_alpha)
        return replace(material, alpha_mode="blend", base_color_texture=self._textures.on_surface(both))

    def _colored(self, value: Value, name: str, key: str = "base_color") -> dict[str, Any]:
        """The fields of a colour `key` of `Material`. name: of the material."""
        value = value.map(lambda texels: np.broadcast_to(texels, (*texels.shape[:2], 3)))
        if value.image.max(initial=0.0) > 1.0 + 1e-6:
            self._contents.lose("reflectances above 1: 1 in their place", name)
        value = value.map(lambda texels: texels.clip(0.0, 1.0))
        if value.constant:
            return {key: as_vector(value.image[0, 0])}
        return {key: (1.0, 1.0, 1.0), f"{key}_texture": self._textures.on_surface(value)}

    def _alphas(self, source: Parameters, prefix: str = "") -> tuple[Value, Value]:
        """α of pbrt along u and along v."""
        keys = [f"{prefix}{each}roughness" for each in ("u", "v")]
        keys = [key if key in source else f"{prefix}roughness" for key in keys]
        remap = source.flag("remaproughness", True)
        first, second = (
            self._textures.scalar(source, key, 0.0).map(
                lambda texels: np.sqrt(texels.clip(min=0.0)) if remap else texels.clip(min=0.0)
            )
            for key in keys
        )
        return first, second

    def _alpha(self, source: Parameters, prefix: str = "") -> Value:
        """The one α of a texture or of a coating."""
        first, second = self._alphas(source, prefix)
        if not np.array_equal(first.image, second.image):
            self._contents.lose("anisotropic roughness: that along u counts", printable(source.kind))
        return first

    def _rough(self, source: Parameters, prefix: str = "") -> dict[str, Any]:
        """The fields of a roughness, whose square is α, or of two."""
        alphas = self._alphas(source, prefix)
        if all(alpha.constant for alpha in alphas):
            return from_alphas(*(float(alpha.image.mean()) for alpha in alphas))
        value = self._alpha(source, prefix).map(lambda texels: np.sqrt(texels.clip(0.0, 1.0)))
        if value.constant:
            return {"roughness": float(value.image.mean())}
        channels = value.map(lambda texels: np.concatenate([np.ones_like(texels), texels, np.ones_like(texels)], axis=2))
        return {"roughness": 1.0, "metallic_roughness_texture": self._textures.on_surface(channels)}

    def _isotropic(self, source: Parameters, name: str) -> dict[str, Any]:
        """The fields of the roughness of a surface that transmits. name: of the material."""
        rough = self._rough(source)
        if rough.pop("anisotropy", 0.0) > 0.0:
            self._contents.lose("anisotropic roughness of dielectrics: the smaller α counts", name)
        return rough

    def _eta(self, source: Parameters) -> float:
        """The refractive index behind a surface, relative to that in front."""
        value = index(source, "eta", 1.5, self._folder, self._files)
        if not value > 0.0:
            source.fail("eta", "is no refractive index; give a number above 0")
        return value

    def _ior(self, source: Parameters) -> float:
        """The refractive index of the denser medium, relative to that of the thinner one."""
        eta = self._eta(source)
        return max(eta, 1.0 / eta)

    def _diffuse(self, source: Parameters, name: str, depth: int) -> Material:
        return Material(name, specular=0.0, **self._colored(self._textures.color(source, "reflectance", 0.5), name))

    def _coated_diffuse(self, source: Parameters, name: str, depth: int) -> Material:
        ior = self._ior(source)
        inside = internal_reflectance(ior)
        color = self._textures.color(source, "reflectance", 0.5)
        seen = color.map(lambda texels: (1.0 - inside) * texels / (1.0 - inside * texels.clip(0.0, 1.0)))
        return Material(name, ior=ior, **self._rough(source), **self._colored(seen, name))

    def _metal(self, source: Parameters, prefix: str) -> Value:
        """The reflectance of a conductor at normal incidence."""
        if "reflectance" in source:
            return self._textures.color(source, "reflectance", 0.5)
        return constant(*metal(source, prefix, self._folder, self._files))

    def _conductor(self, source: Parameters, name: str, depth: int) -> Material:
        rough, color = self._rough(source), self._colored(self._metal(source, ""), name)
        return Material(name, metallic=1.0, single_scattering=True, **rough, **color)

    def _coated_conductor(self, source: Parameters, name: str, depth: int) -> Material:
        coat = self._alpha(source, "interface.").image.mean()
        rough, color = self._rough(source, "conductor."), self._colored(self._metal(source, "conductor."), name)
        coated = {"clearcoat": 1.0, "clearcoat_roughness": float(np.sqrt(coat.clip(0.0, 1.0)))}
        return Material(name, metallic=1.0, single_scattering=True, **coated, **rough, **color)

    def _dielectric(self, source: Parameters, name: str, depth: int) -> Material:
        return Material(name, (1.0, 1.0, 1.0), transmission=1.0, ior=self._ior(source), **self._isotropic(source, name))

    def _thin_dielectric(self, source: Parameters, name: str, depth: int) -> Material:
        return Material(name, (1.0, 1.0, 1.0), transmission=1.0, roughness=0.0, thin=True, ior=self._ior(source))

    def _diffuse_transmission(self, source: Parameters, name: str, depth: int) -> Material:
        scale = min(max(source.number("scale", 1.0), 0.0), 1.0)
        back, through = (
            self._textures.color(source, key, 0.25).map(lambda texels: texels * scale) for key in ("reflectance", "transmittance")
        )
        return self._two_sided(name, back, through, specular=0.0)

    def _two_sided(self, name: str, back: Value, through: Value, **others: Any) -> Material:
        """A surface with the diffuse reflectance `back` and the diffuse transmittance `through`. others: further fields."""
        share = float(through.image.max() / max(back.image.max() + through.image.max(), 1e-6))
        base = self._colored(back.map(lambda texels: texels / max(1.0 - share, 1e-6)), name)
        color = self._colored(through.map(lambda texels: texels / max(share, 1e-6)), name, "diffuse_transmission_color")
        return Material(name, diffuse_transmission=share, **base, **color, **others)

    def _subsurface(self, source: Parameters, name: str, depth: int) -> Material:
        self._contents.lose("subsurface scattering: a coated diffuse surface in its place", name)
        color = self._textures.color(source, "reflectance", 0.8)
        ior = max(source.number("eta", 1.33), 1.0)
        return Material(name, ior=ior, **self._rough(source), **self._colored(color, name))

    def _grey(self, source: Parameters, name: str, depth: int) -> Material:
        self._contents.lose(f"material {source.kind}: a diffuse surface in its place", name)
        return Material(name, specular=0.0, **self._colored(self._textures.color(source, "reflectance", 0.5), name))

    def _mix(self, source: Parameters, name: str, depth: int) -> Material | None:
        names = source.texts("materials")
        if len(names) != 2:
            source.place.fail('mix: give two names as "string materials"')
        amount = float(self._textures.scalar(source, "amount", 0.5).image.mean())
        if 0.0 < amount < 1.0:
            self._contents.lose("mixtures of materials: the larger part counts", name)
        return self._material(names[1 if amount > 0.5 else 0], source.place, depth + 1)


def _with_alpha(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Colours `[H, W, 3]` and opacities `[H, W, 1]` side by side; either may be of one texel."""
    size = np.broadcast_shapes(color.shape[:2], alpha.shape[:2])
    return np.concatenate([np.broadcast_to(color, (*size, 3)), np.broadcast_to(alpha, (*size, 1))], axis=2)


def internal_reflectance(ior: float) -> float:
    """The reflectance of a smooth boundary to diffuse light from inside, by quadrature of Fresnel's equations."""
    cosine = (np.arange(512) + 0.5) / 512.0
    transmitted = 1.0 - (1.0 - cosine**2) * ior**2
    outside = np.sqrt(transmitted.clip(min=0.0))
    parallel = (cosine - ior * outside) / (cosine + ior * outside)
    perpendicular = (ior * cosine - outside) / (ior * cosine + outside)
    reflected = np.where(transmitted <= 0.0, 1.0, 0.5 * (parallel**2 + perpendicular**2))
    return float((2.0 * cosine * reflected).mean())


Convert = Callable[[Materials, Parameters, str, int], Material | None]
KINDS: dict[str, Convert] = {
    "diffuse": Materials._diffuse,
    "coateddiffuse": Materials._coated_diffuse,
    "conductor": Materials._conductor,
    "coatedconductor": Materials._coated_conductor,
    "dielectric": Materials._dielectric,
    "thindielectric": Materials._thin_dielectric,
    "diffusetransmission": Materials._diffuse_transmission,
    "subsurface": Materials._subsurface,
    "hair": Materials._grey,
    "measured": Materials._grey,
    "mix": Materials._mix,
}
"""Materials of pbrt-v4; `interface` is no surface."""
OLDER_NAMES = {
    *("disney", "fourier", "glass", "kdsubsurface", "matte", "metal"),
    *("mirror", "plastic", "substrate", "translucent", "uber"),
}
"""Materials of pbrt-v3 that pbrt-v4 lacks."""
