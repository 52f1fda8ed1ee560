"""Materials of a glTF file, with their extensions."""

from __future__ import annotations

import math
from typing import Any

from bokehguide.scene.gltf.document import Document
from bokehguide.scene.gltf.parts import Part
from bokehguide.scene.gltf.specular_glossiness import EXTENSION as GLOSSINESS
from bokehguide.scene.gltf.specular_glossiness import specular_glossiness
from bokehguide.scene.gltf.textures import Textures
from bokehguide.scene.tables import ANY, FILM, FRACTION, IOR, NOT_NEGATIVE, POSITIVE
from bokehguide.scene.types import Material, Vector, as_vector

WHITE = (1.0, 1.0, 1.0)
DEFAULT = Material("default", base_color=WHITE, metallic=1.0)
"""glTF's material for primitives without one: every factor is 1."""
SINGLE_SCATTERING = "bokehguide_single_scattering"
"""Key of the extras of a material, for metals without multiple scattering: the add-on for Blender writes the key."""
ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}


def read_materials(document: Document, textures: Textures) -> list[Material]:
    """All materials in the file's order.

    Raises BokehguideError naming file, material and key for factors out of range.
    """
    return [_material(part, textures) for part in document.items("materials")]


def _material(part: Part, textures: Textures) -> Material:
    """One material of the file."""
    mode = part.text("alphaMode") or "OPAQUE"
    if mode not in ALPHA_MODES:
        part.fail("alphaMode", f"is none of {', '.join(ALPHA_MODES)}; repair the file")
    normal, model = part.part("normalTexture"), specular_glossiness if GLOSSINESS in part.extensions else _metallic_roughness
    material = Material(
        name=part.label,
        emission=_emission(part),
        double_sided=part.flag("doubleSided"),
        alpha_mode=ALPHA_MODES[mode],
        alpha_cutoff=part.number("alphaCutoff", Material.alpha_cutoff, NOT_NEGATIVE),
        normal_scale=normal.number("scale", 1.0, ANY),
        emission_texture=textures.read(part, "emissiveTexture", srgb=True),
        normal_texture=textures.read(part, "normalTexture"),
        **model(part, textures, alpha=mode != "OPAQUE"),
        **_clearcoat(part, textures),
        **_sheen(part, textures),
        **_anisotropy(part, textures),
        **_diffuse_transmission(part, textures),
        **_iridescence(part, textures),
        single_scattering=_single_scattering(part),
        dispersion=part.extension("KHR_materials_dispersion").number("dispersion", 0.0, NOT_NEGATIVE),
        **_transmission(part, textures),
    )
    if "KHR_materials_unlit" in part.extensions:
        return _unlit(material)
    _note_layers_of_glass(material, textures.document)
    return material


def _note_layers_of_glass(material: Material, document: Document) -> None:
    """Note the layers that the opaque part of a transmissive material has, and that its glass lacks."""
    if material.transmission == 0.0:
        return
    colored = material.specular_color != WHITE or material.specular_texture or material.specular_color_texture
    layers = {
        "specular": material.specular != 1.0 or colored,
        "clearcoat": material.clearcoat > 0.0,
        "sheen": any(material.sheen_color),
    }
    for name in (name for name, used in layers.items() if used):
        document.note(f"KHR_materials_{name}: has no effect on the transmissive part of a material", material.name)


def _metallic_roughness(part: Part, textures: Textures, alpha: bool) -> dict[str, Any]:
    """The fields of `Material` from the core's model, KHR_materials_ior and KHR_materials_specular.

    alpha: the opacity has an effect.
    """
    pbr = part.part("pbrMetallicRoughness")
    red, green, blue, opacity = pbr.numbers("baseColorFactor", 4, (*WHITE, 1.0), FRACTION)
    return {
        "base_color": (red, green, blue),
        "opacity": opacity,
        "base_color_texture": textures.read(pbr, "baseColorTexture", srgb=True, alpha=alpha),
        "metallic": pbr.number("metallicFactor", 1.0, FRACTION),
        "roughness": pbr.number("roughnessFactor", 1.0, FRACTION),
        "metallic_roughness_texture": textures.read(pbr, "metallicRoughnessTexture"),
        "ior": _ior(part, textures.document),
        **_specular(part, textures),
    }


def _ior(part: Part, document: Document) -> float:
    """The index of refraction. 0 means total reflection (KHR_materials_ior), which is not supported."""
    ior = part.extension("KHR_materials_ior")
    if ior.number("ior", 1.5) == 0.0:
        document.note("ior 0: 1.5 is used", part.label)
        return 1.5
    return ior.number("ior", 1.5, IOR)


def _emission(part: Part) -> Vector:
    """The emission factor times KHR_materials_emissive_strength."""
    factor = part.vector("emissiveFactor", (0.0, 0.0, 0.0), NOT_NEGATIVE)
    strong = part.extension("KHR_materials_emissive_strength")
    strength = strong.number("emissiveStrength", 1.0, NOT_NEGATIVE)
    emission = as_vector(strength * channel for channel in factor)
    if not all(map(NOT_NEGATIVE.contains, emission)):
        strong.fail("emissiveStrength", f"times emissiveFactor is out of range; give {NOT_NEGATIVE.remedy}")
    return emission


def _specular(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_specular."""
    specular = part.extension("KHR_materials_specular")
    return {
        "specular": specular.number("specularFactor", 1.0, FRACTION),
        "specular_color": specular.vector("specularColorFactor", WHITE, NOT_NEGATIVE),
        "specular_texture": textures.read(specular, "specularTexture", alpha=True),
        "specular_color_texture": textures.read(specular, "specularColorTexture", srgb=True),
    }


def _clearcoat(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_clearcoat."""
    coat = part.extension("KHR_materials_clearcoat")
    return {
        "clearcoat": coat.number("clearcoatFactor", 0.0, FRACTION),
        "clearcoat_roughness": coat.number("clearcoatRoughnessFactor", 0.0, FRACTION),
        "clearcoat_normal_scale": coat.part("clearcoatNormalTexture").number("scale", 1.0, ANY),
        "clearcoat_texture": textures.read(coat, "clearcoatTexture"),
        "clearcoat_roughness_texture": textures.read(coat, "clearcoatRoughnessTexture"),
        "clearcoat_normal_texture": textures.read(coat, "clearcoatNormalTexture"),
    }


def _single_scattering(part: Part) -> bool:
    """Whether the extras, any JSON value, have the key of the add-on."""
    extras = part.values.get("extras")
    return isinstance(extras, dict) and extras.get(SINGLE_SCATTERING) is True


def _sheen(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_sheen."""
    sheen = part.extension("KHR_materials_sheen")
    return {
        "sheen_color": sheen.vector("sheenColorFactor", (0.0, 0.0, 0.0), FRACTION),
        "sheen_roughness": sheen.number("sheenRoughnessFactor", 0.0, FRACTION),
        "sheen_color_texture": textures.read(sheen, "sheenColorTexture", srgb=True),
        "sheen_roughness_texture": textures.read(sheen, "sheenRoughnessTexture", alpha=True),
    }


def _anisotropy(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_anisotropy."""
    brushed = part.extension("KHR_materials_anisotropy")
    return {
        "anisotropy": brushed.number("anisotropyStrength", 0.0, FRACTION),
        "anisotropy_rotation": math.degrees(brushed.number("anisotropyRotation", 0.0, ANY)),
        "anisotropy_texture": textures.read(brushed, "anisotropyTexture"),
    }


def _diffuse_transmission(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_diffuse_transmission."""
    leaf = part.extension("KHR_materials_diffuse_transmission")
    return {
        "diffuse_transmission": leaf.number("diffuseTransmissionFactor", 0.0, FRACTION),
        "diffuse_transmission_color": leaf.vector("diffuseTransmissionColorFactor", WHITE, FRACTION),
        "diffuse_transmission_texture": textures.read(leaf, "diffuseTransmissionTexture", alpha=True),
        "diffuse_transmission_color_texture": textures.read(leaf, "diffuseTransmissionColorTexture", srgb=True),
    }


def _iridescence(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_iridescence."""
    film = part.extension("KHR_materials_iridescence")
    least, most = Material.iridescence_thickness
    least = film.number("iridescenceThicknessMinimum", least, FILM)
    return {
        "iridescence": film.number("iridescenceFactor", 0.0, FRACTION),
        "iridescence_ior": film.number("iridescenceIor", Material.iridescence_ior, IOR),
        "iridescence_thickness": (least, film.number("iridescenceThicknessMaximum", most, FILM)),
        "iridescence_texture": textures.read(film, "iridescenceTexture"),
        "iridescence_thickness_texture": textures.read(film, "iridescenceThicknessTexture"),
    }


def _transmission(part: Part, textures: Textures) -> dict[str, Any]:
    """The fields of `Material` from KHR_materials_transmission and KHR_materials_volume.

    A surface with thickness 0 is a thin sheet. Other thicknesses follow from the geometry.
    """
    transmission, volume = part.extension("KHR_materials_transmission"), part.extension("KHR_materials_volume")
    return {
        "transmission": transmission.number("transmissionFactor", 0.0, FRACTION),
        "transmission_texture": textures.read(transmission, "transmissionTexture"),
        "thin": volume.number("thicknessFactor", 0.0, NOT_NEGATIVE) == 0.0,
        "attenuation_color": volume.vector("attenuationColor", WHITE, FRACTION),
        "attenuation_distance": volume.number("attenuationDistance", math.inf, POSITIVE),
    }


def _unlit(material: Material) -> Material:
    """A black surface that emits the base colour of `material`.

    It keeps the base colour's texture if the alpha mode needs it.
    """
    return Material(
        name=material.name,
        base_color=(0.0, 0.0, 0.0),
        specular=0.0,
        emission=material.base_color,
        tint_emission=True,
        emission_texture=material.base_color_texture,
        double_sided=material.double_sided,
        opacity=material.opacity,
        alpha_mode=material.alpha_mode,
        alpha_cutoff=material.alpha_cutoff,
        base_color_texture=None if material.alpha_mode == "opaque" else material.base_color_texture,
    )
