"""Materials of pbrt-v3 and older in the terms of `Material`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.anisotropy import from_alphas
from bokehguide.scene.disney_sheen import from_disney
from bokehguide.scene.pbrt.materials import Materials
from bokehguide.scene.pbrt.parameters import Parameters
from bokehguide.scene.pbrt.textures import Value
from bokehguide.scene.types import Material

F0 = 0.04
"""Reflectance at normal incidence of the refractive index 1.5, by which the specular colour is divided."""
ROUGHNESS = {"metal": 0.01, "glass": 0.0, "kdsubsurface": 0.0, "subsurface": 0.0}
"""Roughness of a material without one, 0.1 for the others."""
REMAP = (1.62142, 0.819955, 0.1734, 0.0171201, 0.000640711)
"""Coefficients of α as a polynomial of the logarithm of the roughness, in pbrt-v3's `RoughnessToAlpha`."""


class OlderMaterials(Materials):
    """The materials of an older scene. An unknown kind is a matte surface, as in pbrt-v3."""

    def _converted(self, source: Parameters, name: str, depth: int) -> Material | None:
        if source.kind not in OLDER_KINDS:
            self._contents.lose(
                f"materials of the unknown type {printable(source.kind)}: matte in their place", source.place.short
            )
        return OLDER_KINDS.get(source.kind, OlderMaterials._matte)(self, source, name, depth)

    def _bumped(self, source: Parameters, material: Material) -> Material:
        if "bumpmap" in source:
            self._contents.lose("displacement and bump maps: left out", material.name)
        return material

    def _alphas(self, source: Parameters, prefix: str = "") -> tuple[Value, Value]:
        """α along u and along v. A roughness of 0 is smooth."""
        default, remap = ROUGHNESS.get(source.kind, 0.1), source.flag("remaproughness", True)
        keys = [each if each in source else "roughness" for each in ("uroughness", "vroughness")]
        first, second = (self._textures.scalar(source, key, default).map(_alpha if remap else _clipped) for key in keys)
        return first, second

    def _eta(self, source: Parameters) -> float:
        return super()._eta(source) if "eta" in source or "index" not in source else max(source.number("index", 1.5), 1e-3)

    def _base(self, source: Parameters, name: str, default: float) -> dict[str, Any]:
        """The fields of the diffuse colour Kd."""
        return self._colored(self._textures.color(source, "Kd", default), name)

    def _matte(self, source: Parameters, name: str, depth: int) -> Material:
        if self._textures.scalar(source, "sigma", 0.0).image.max() > 0.0:
            self._contents.lose("sigma of matte: Lambertian surfaces in their place", name)
        return Material(name, specular=0.0, **self._base(source, name, 0.5))

    def _plastic(self, source: Parameters, name: str, depth: int) -> Material:
        gloss = self._colored(self._textures.color(source, "Ks", 0.25), name, "specular_color")
        return Material(name, **self._rough(source), **gloss, **self._base(source, name, 0.25))

    def _substrate(self, source: Parameters, name: str, depth: int) -> Material:
        """Ks is the reflectance at normal incidence."""
        gloss = self._colored(self._textures.color(source, "Ks", 0.5), name, "specular_color")
        gloss["specular_color"] = tuple(channel / F0 for channel in gloss["specular_color"])
        return Material(name, ior=1.5, **self._rough(source), **gloss, **self._base(source, name, 0.5))

    def _mirror(self, source: Parameters, name: str, depth: int) -> Material:
        color = self._colored(self._textures.color(source, "Kr", 0.9), name)
        return Material(name, metallic=1.0, roughness=0.0, single_scattering=True, **color)

    def _shiny_metal(self, source: Parameters, name: str, depth: int) -> Material:
        color = self._colored(self._textures.color(source, "Ks", 1.0), name)
        return Material(name, metallic=1.0, single_scattering=True, **self._rough(source), **color)

    def _glass(self, source: Parameters, name: str, depth: int) -> Material:
        gloss = self._colored(self._textures.color(source, "Kr", 1.0), name, "specular_color")
        through = self._colored(self._textures.color(source, "Kt", 1.0), name)
        return Material(name, transmission=1.0, ior=self._ior(source), **self._isotropic(source, name), **gloss, **through)

    def _uber(self, source: Parameters, name: str, depth: int) -> Material:
        """Diffuse, glossy, mirror and refracting parts. The larger of the parts Ks and Kr is the specular one."""
        values = {key: self._textures.color(source, key, default) for key, default in UBER.items()}
        means = {key: float(value.image.mean()) for key, value in values.items()}
        diffuse, share = values["Kd"], 0.0
        if means["Kt"] > 0.0:
            diffuse, share = self._textures.combined(diffuse, values["Kt"], np.add), means["Kt"] / (means["Kd"] + means["Kt"])
        mirror = means["Kr"] > means["Ks"]
        if min(means["Kr"], means["Ks"]) > 0.0:
            self._contents.lose("Ks and Kr of uber: the larger one counts", name)
        gloss = self._colored(values["Kr" if mirror else "Ks"], name, "specular_color")
        rough = {"roughness": 0.0} if mirror else self._isotropic(source, name) if share > 0.0 else self._rough(source)
        base = self._colored(diffuse, name)
        material = Material(name, ior=self._ior(source), transmission=share, **rough, **gloss, **base)
        opacity = self._textures.color(source, "opacity", 1.0).map(lambda texels: texels.mean(axis=2, keepdims=True))
        return material if opacity.constant and opacity.image.min() >= 1.0 else self._translucent(material, opacity)

    def _translucent_sheet(self, source: Parameters, name: str, depth: int) -> Material:
        diffuse = self._textures.color(source, "Kd", 0.25)
        back, through = (
            self._textures.combined(diffuse, self._textures.color(source, key, 0.5), np.multiply)
            for key in ("reflect", "transmit")
        )
        gloss = self._colored(self._textures.color(source, "Ks", 0.25), name, "specular_color")
        return self._two_sided(name, back, through, **self._rough(source), **gloss)

    def _kd_subsurface(self, source: Parameters, name: str, depth: int) -> Material:
        self._contents.lose("subsurface scattering: a coated diffuse surface in its place", name)
        return Material(name, ior=max(source.number("eta", 1.33), 1.0), **self._rough(source), **self._base(source, name, 0.5))

    def _diffuse_in_place(self, source: Parameters, name: str, depth: int) -> Material:
        self._contents.lose(f"material {source.kind}: a diffuse surface in its place", name)
        return Material(name, specular=0.0, **self._colored(self._textures.color(source, "color", 0.5), name))

    def _disney(self, source: Parameters, name: str, depth: int) -> Material:
        def number(key: str, default: float = 0.0) -> float:
            return min(max(float(self._textures.scalar(source, key, default).image.mean()), 0.0), 1.0)

        color, metallic = self._colored(self._textures.color(source, "color", 0.5), name), number("metallic")
        aspect, alpha = math.sqrt(1.0 - 0.9 * number("anisotropic")), number("roughness", 0.5) ** 2
        coat = math.sqrt(0.1 + (0.001 - 0.1) * number("clearcoatgloss", 1.0))
        return Material(
            name,
            metallic=metallic,
            single_scattering=metallic > 0.0,
            ior=self._ior(source),
            transmission=number("spectrans"),
            thin=source.flag("thin"),
            clearcoat=0.25 * number("clearcoat"),
            clearcoat_roughness=coat,
            **from_disney(number("sheen"), number("sheentint", 0.5), color["base_color"], metallic),
            **from_alphas(alpha / aspect, alpha * aspect),
            **color,
        )

    def _blend(self, source: Parameters, name: str, depth: int) -> Material | None:
        """The larger part of a mixture; `amount` is the share of the first material."""
        names = [source.text(key) for key in ("namedmaterial1", "namedmaterial2")]
        amount = float(self._textures.color(source, "amount", 0.5).image.mean())
        if 0.0 < amount < 1.0:
            self._contents.lose("mixtures of materials: the larger part counts", name)
        return self._material(names[0 if amount >= 0.5 else 1], source.place, depth + 1)


UBER = {"Kd": 0.25, "Ks": 0.25, "Kr": 0.0, "Kt": 0.0}
"""Colours of the parts of uber by default."""


def _alpha(roughness: np.ndarray) -> np.ndarray:
    """pbrt-v3's α of a roughness."""
    logarithm = np.log(roughness.clip(min=1e-3))
    return np.where(roughness > 0.0, np.polynomial.polynomial.polyval(logarithm, REMAP), 0.0)


def _clipped(roughness: np.ndarray) -> np.ndarray:
    """α where the file gives it."""
    return roughness.clip(min=0.0)


Convert = Callable[[OlderMaterials, Parameters, str, int], Material | None]
OLDER_KINDS: dict[str, Convert] = {
    "matte": OlderMaterials._matte,
    "plastic": OlderMaterials._plastic,
    "substrate": OlderMaterials._substrate,
    "metal": OlderMaterials._conductor,
    "shinymetal": OlderMaterials._shiny_metal,
    "mirror": OlderMaterials._mirror,
    "glass": OlderMaterials._glass,
    "uber": OlderMaterials._uber,
    "translucent": OlderMaterials._translucent_sheet,
    "kdsubsurface": OlderMaterials._kd_subsurface,
    "subsurface": OlderMaterials._subsurface,
    "disney": OlderMaterials._disney,
    "mix": OlderMaterials._blend,
    "fourier": OlderMaterials._diffuse_in_place,
    "hair": OlderMaterials._diffuse_in_place,
    "measured": OlderMaterials._diffuse_in_place,
}
"""Materials of pbrt-v3 and older."""
