"""The `[materials.NAME]` tables of a scene file."""

from __future__ import annotations

from bokehguide.errors import BokehguideError
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.images import load_texture
from bokehguide.scene.tables import ANY, CONE_ANGLE, IOR, NOT_NEGATIVE, POSITIVE, SHARE, Table, did_you_mean
from bokehguide.scene.types import Cone, Material, Texture

ENCODED = {
    "base_color_texture": True,
    "metallic_roughness_texture": False,
    "emission_texture": True,
    "normal_texture": False,
    "specular_texture": False,
    "specular_color_texture": True,
    "transmission_texture": False,
    "clearcoat_texture": False,
    "clearcoat_roughness_texture": False,
    "clearcoat_normal_texture": False,
}
"""The textures, and whether their colours are sRGB."""
KEYS = (
    *("base_color", "metallic", "roughness", "specular", "specular_color", "transmission", "thin", "ior"),
    *("attenuation_color", "attenuation_distance", "clearcoat", "clearcoat_roughness", "emission"),
    *("emission_cone", "double_sided", "opacity", "alpha_mode", "alpha_cutoff", "normal_scale"),
    *("clearcoat_normal_scale", *ENCODED),
)
NEEDS = {
    "emission_texture": ("emission",),
    "emission_cone": ("emission",),
    "normal_scale": ("normal_texture",),
    "clearcoat_normal_scale": ("clearcoat_normal_texture",),
    "attenuation_color": ("attenuation_distance",),
    "attenuation_distance": ("attenuation_color",),
    "clearcoat_roughness": ("clearcoat", "clearcoat_texture"),
    "clearcoat_roughness_texture": ("clearcoat", "clearcoat_texture"),
    "clearcoat_normal_texture": ("clearcoat", "clearcoat_texture"),
    "opacity": ("alpha_mode",),
    "alpha_cutoff": ("alpha_mode",),
}
"""Keys that do nothing without one of others."""
ALPHA_MODES = ("opaque", "mask", "blend")


def read_materials(root: Table, files: SceneFiles) -> list[Material]:
    """The materials in the file's order; `files` are those that textures may be.

    Raises BokehguideError naming file, field, value and remedy for anything wrong.
    """
    values = root.values.get("materials", {})
    if not isinstance(values, dict):
        root.fail("materials", "is not a table; write [materials.NAME]")
    return [_material(Table(values[name], root.file, f"materials.{name}", KEYS), files) for name in values]


def _material(table: Table, files: SceneFiles) -> Material:
    """A texture multiplies its factors, which are 1 where they are left out."""
    for key, others in NEEDS.items():
        if key in table and not any(other in table for other in others):
            table.fail(key, f"does nothing without {others[0]}; give that too")
    textures = _textures(table, files)

    def factor(key: str, default: float, texture: str) -> float:
        return table.number(key, 1.0 if textures[texture] else default, SHARE)

    base_color = (1.0, 1.0, 1.0) if textures["base_color_texture"] else Material.base_color
    return Material(
        name=table.path.removeprefix("materials."),
        base_color=table.vector("base_color", base_color, SHARE),
        metallic=factor("metallic", Material.metallic, "metallic_roughness_texture"),
        roughness=factor("roughness", Material.roughness, "metallic_roughness_texture"),
        specular=factor("specular", Material.specular, "specular_texture"),
        specular_color=table.vector("specular_color", Material.specular_color, NOT_NEGATIVE),
        transmission=factor("transmission", Material.transmission, "transmission_texture"),
        thin=table.flag("thin"),
        ior=table.number("ior", Material.ior, IOR),
        attenuation_color=table.vector("attenuation_color", Material.attenuation_color, SHARE),
        attenuation_distance=table.number("attenuation_distance", Material.attenuation_distance, POSITIVE),
        clearcoat=factor("clearcoat", Material.clearcoat, "clearcoat_texture"),
        clearcoat_roughness=factor("clearcoat_roughness", Material.clearcoat_roughness, "clearcoat_roughness_texture"),
        emission=table.vector("emission", Material.emission, NOT_NEGATIVE),
        emission_cone=_cone(table),
        double_sided=table.flag("double_sided"),
        opacity=table.number("opacity", Material.opacity, SHARE),
        alpha_mode=_alpha_mode(table),
        alpha_cutoff=table.number("alpha_cutoff", Material.alpha_cutoff, SHARE),
        normal_scale=table.number("normal_scale", Material.normal_scale, ANY),
        clearcoat_normal_scale=table.number("clearcoat_normal_scale", Material.clearcoat_normal_scale, ANY),
        **textures,
    )


def _textures(table: Table, files: SceneFiles) -> dict[str, Texture | None]:
    textures = dict.fromkeys(ENCODED)
    for key, encoded in ENCODED.items():
        if key in table:
            alpha = key == "specular_texture" or (key == "base_color_texture" and _alpha_mode(table) != "opaque")
            textures[key] = Texture(load_texture(files.named(table, key), files, encoded, alpha))
    specular = textures["specular_texture"]
    if specular is not None and specular.image.shape[2] < 4:
        table.fail("specular_texture", "has no alpha, which is what it is read from; give an image with alpha")
    return textures


def _alpha_mode(table: Table) -> str:
    mode = table.text("alpha_mode") or Material.alpha_mode
    if mode not in ALPHA_MODES:
        table.fail("alpha_mode", f"is not a mode; {did_you_mean(mode, ALPHA_MODES)}")
    return mode


def _cone(table: Table) -> Cone | None:
    if "emission_cone" not in table:
        return None
    cone = Table(table.values["emission_cone"], table.file, f"{table.path}.emission_cone", ("axis", "inner", "outer"))
    axis = cone.direction("axis")
    outer = cone.number("outer", 45.0, CONE_ANGLE)
    inner = cone.number("inner", 0.0, CONE_ANGLE)
    if inner >= outer:
        raise BokehguideError(f"{cone.place('outer')}: {outer:g} is not above inner, {inner:g}; give a larger angle")
    return Cone(axis, inner, outer)
