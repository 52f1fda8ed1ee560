"""Scenes in Mitsuba 3, reduced to terms that both renderers define alike.

`comparable` reduces a scene to terms with an exact counterpart, and `left_out` lists the removed terms: coats over a base,
specular lobes of dielectrics, normal maps, attenuation, cones of spotlights, vertex colours. Metals and rough glass are made
so smooth that Mitsuba's separable Smith term and the height-correlated term differ by less than 0.1 % up to 85° from the
normal.

Mitsuba counts cut-outs on a path as segments, and cut-outs block its light samples. Scenes with opacity need a `max_depth`
beyond which the radiance is negligible.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import drjit
import mitsuba as mi
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from bokehguide.errors import BokehguideError
from bokehguide.export.mitsuba_materials import SMOOTH_GLASS, Bitmap, bitmap, mitsuba_bsdf
from bokehguide.export.mitsuba_tree import environment_emitter, integrator, scene_tree
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Environment, Material, Scene, Texture

LEAST_LLVM = 17
"""First version of LLVM with x86 code for `fminimum`. Dr.Jit emits it; an older LLVM ends the process."""


def _choose_variant() -> None:
    """Set Mitsuba's LLVM variant, or the scalar variant where LLVM is missing or too old."""
    mi.set_variant("llvm_ad_rgb", "scalar_rgb")
    if mi.variant() != "scalar_rgb" and drjit.detail.llvm_version()[0] < LEAST_LLVM:
        mi.set_variant("scalar_rgb")


_choose_variant()

METAL_ROUGHNESS = (0.05, 0.2)
GLASS_ROUGHNESS = (0.1, 0.2)
"""Ranges to which roughness is clamped; glass below SMOOTH_GLASS is smooth."""
FINE_MASK = 32
"""Texels of a cut-out's mask per texel of the texture, across and down."""
LAYERS = "albedo:albedo,normal:sh_normal"
"""AOVs that a denoiser takes."""
CHUNK_SAMPLES = 1 << 22
"""Largest number of samples of one render, which Mitsuba keeps in memory."""


def comparable(scene: Scene) -> Scene:
    """`scene` with materials that Mitsuba has too; emitters have flat normals, as their radiance is constant over directions."""
    if scene.camera.aperture is not None:
        raise BokehguideError(f"{scene.name}: Mitsuba's aperture is round; remove [camera.aperture] to compare")
    if scene.suns:
        raise BokehguideError(f"{scene.name}: suns have no counterpart in Mitsuba; remove them to compare")
    materials = tuple(_comparable_material(material) for material in scene.materials)
    meshes = tuple(
        replace(mesh, normals=None if materials[mesh.material].emits else mesh.normals, tangents=None, colors=None)
        for mesh in scene.meshes
    )
    return replace(scene, meshes=meshes, materials=materials)


def left_out(scene: Scene, reduced: Scene) -> list[str]:
    """Terms of `scene` that `comparable` removed or changed: a line for each term, with its materials."""
    lost: dict[str, list[str]] = {}
    for number in sorted({mesh.material for mesh in scene.meshes}):
        before, after = scene.materials[number], reduced.materials[number]
        for term in (field.name for field in fields(Material)):
            one, other = getattr(before, term), getattr(after, term)
            matters = term != "roughness" or after.metallic > 0.0 or after.transmission > 0.0
            if matters and one is not other and (isinstance(one, Texture) or one != other):
                lost.setdefault(term.replace("_", " "), []).append(before.name)
    for mesh, kept in zip(scene.meshes, reduced.meshes):
        for term in ("normals", "colors"):
            if getattr(mesh, term) is not None and getattr(kept, term) is None:
                lost.setdefault(f"vertex {term}", []).append(scene.materials[mesh.material].name)
    return [f"{term} of {', '.join(dict.fromkeys(names))}" for term, names in lost.items()]


def _comparable_material(material: Material) -> Material:
    """The closest of a Lambertian surface, a metal and glass."""
    kept = ("name", "base_color", "ior", "thin", "emission", "double_sided", "opacity", "alpha_mode", "alpha_cutoff")
    terms = {name: getattr(material, name) for name in (*kept, "base_color_texture", "emission_texture")}
    if material.transmission >= 0.5:
        smooth = material.thin or material.roughness < SMOOTH_GLASS
        roughness = 0.0 if smooth else float(np.clip(material.roughness, *GLASS_ROUGHNESS))
        return Material(**terms, transmission=1.0, roughness=roughness)
    if material.metallic >= 0.5:
        roughness = float(np.clip(material.roughness, *METAL_ROUGHNESS))
        return Material(**terms, metallic=1.0, single_scattering=True, roughness=roughness)
    return Material(**terms, specular=0.0)


@dataclass(frozen=True)
class MitsubaFilm:
    """The result of one render of Mitsuba, with the methods of a `Film` that a comparison needs."""

    mean: Tensor
    second_moment: Tensor
    spp: int
    bad_count = 0
    bad_samples = ()

    def radiance(self) -> Tensor:
        """Mean radiance, float64 `[H, W, 3]`."""
        return self.mean

    def variance(self) -> Tensor:
        """Estimated variance of the mean luminance, float64 `[H, W]`."""
        mean = luminance(self.mean.movedim(-1, 0))
        return (self.second_moment - mean.square()).clamp(min=0.0) / (self.spp - 1)


class MitsubaRenderer:
    """A comparable scene in Mitsuba. layers: whether `picture` renders the auxiliary layers of a denoiser too."""

    def __init__(self, scene: Scene, layers: bool = False):
        if scene.environment is not None:
            load_environment(scene.environment)  # raises for one that is invisible
        path = integrator(scene)
        self._scene = load(scene_tree(scene, _bsdf) | {"integrator": {"type": "moment", "path": path}})
        self._picture = mi.load_dict({"type": "aov", "aovs": LAYERS, "path": path} if layers else path)

    def look_at(self, column: int, row: int) -> None:
        """Restrict later renders to this pixel."""
        parameters = mi.traverse(self._scene)
        parameters["sensor.film.crop_offset"] = [column, row]
        parameters["sensor.film.crop_size"] = [1, 1]
        parameters.update()

    def picture(self, spp: int, seed: int) -> Tensor:
        """Radiance `[H, W, 3]` of an independent render, without the moments of `render`; with layers `[H, W, 9]`."""
        return torch.from_numpy(np.array(mi.render(self._scene, integrator=self._picture, spp=spp, seed=seed), np.float64))

    def render(self, spp: int, seed: int) -> MitsubaFilm:
        """An independent render of `spp` ≥ 2 samples per pixel."""
        # Channels: RGB of the mean, then X, Y, Z of the mean and of the squares.
        image = np.array(mi.render(self._scene, spp=spp, seed=seed), np.float64)
        if not np.isfinite(image).all():
            raise BokehguideError(f"Mitsuba: NaN or infinite pixels with seed {seed} at {spp} SPP")
        return MitsubaFilm(torch.from_numpy(image[..., :3].copy()), torch.from_numpy(image[..., 7].copy()), spp)


def load(value: Any) -> Any:
    """The object of a dictionary of `bokehguide.export`, whose arrays become objects of Mitsuba."""
    materials = {name: mi.load_dict(_plain(part)) for name, part in value.items() if name.startswith("material")}
    parts = {name: part for name, part in value.items() if name not in materials}
    return mi.load_dict({name: _shape(part, materials) if _is_shape(part) else _plain(part) for name, part in parts.items()})


def _is_shape(value: Any) -> bool:
    return isinstance(value, dict) and "geometry" in value


def _plain(value: Any) -> Any:
    """A value of a dictionary in the types that `mi.load_dict` takes."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, Bitmap):
        return mi.Bitmap(value.pixels)
    return mi.ScalarTransform4f(value) if isinstance(value, np.ndarray) else value


def _bsdf(material: Material) -> dict[str, Any]:
    """The exported BSDF, with the opacity of `_opacity`."""
    for texture in (material.base_color_texture, material.emission_texture):
        if texture is not None and len(set(texture.wrap)) > 1:
            raise BokehguideError(f"texture: Mitsuba wraps u and v alike, not {' and '.join(texture.wrap)}")
    bsdf = mitsuba_bsdf(replace(material, alpha_mode="opaque"))
    return bsdf if material.alpha_mode == "opaque" else {"type": "mask", "bsdf": bsdf, "opacity": _opacity(material)}


def _opacity(material: Material) -> dict[str, Any] | float:
    """The opacity of a material that is not opaque. Mitsuba has no cut-outs, so a fine image replaces the threshold."""
    texture, cuts = material.base_color_texture, material.alpha_mode == "mask"
    if texture is None or texture.image.shape[2] < 4:
        return float(material.opacity >= material.alpha_cutoff) if cuts else material.opacity
    image = material.opacity * texture.image[..., 3]
    if not cuts:
        return bitmap(image, texture)
    axes = ((np.arange(FINE_MASK * size) + 0.5) / FINE_MASK - 0.5 for size in image.shape)
    places = np.meshgrid(*axes, indexing="ij")
    beyond = {"repeat": "grid-wrap", "clamp": "nearest", "mirror": "reflect"}[texture.wrap[0]]
    cut = map_coordinates(image, places, order=1, mode=beyond) >= material.alpha_cutoff
    return bitmap(cut, texture) | {"filter_type": "nearest"}


def _shape(shape: dict[str, Any], materials: dict[str, mi.BSDF]) -> mi.Mesh:
    """A mesh of Mitsuba with its BSDF and emitter."""
    geometry, parts = shape["geometry"], mi.Properties()
    parts["bsdf"] = materials[shape["bsdf"]["id"]]
    if "emitter" in shape:
        parts["emitter"] = mi.load_dict(_plain(shape["emitter"]))
    arrays = {"vertex_positions": geometry.vertices, "faces": geometry.triangles.astype(np.uint32)}
    if geometry.normals is not None:
        arrays["vertex_normals"] = geometry.normals
    if geometry.uvs is not None:
        arrays["vertex_texcoords"] = geometry.uvs
    mesh = mi.Mesh(
        "mesh",
        *(len(geometry.vertices), len(geometry.triangles)),
        has_vertex_normals=geometry.normals is not None,
        has_vertex_texcoords=geometry.uvs is not None,
        props=parts,
    )
    parameters = mi.traverse(mesh)
    for name, array in arrays.items():
        parameters[name] = np.ascontiguousarray(array).ravel()
    parameters.update()
    return mesh


def load_environment(environment: Environment) -> mi.Emitter:
    """The emitter of an environment. Raises BokehguideError for one that the camera does not see."""
    if not environment.visible:
        raise BokehguideError(
            "environment: Mitsuba has no environment that is invisible to the camera; set visible = true to compare"
        )
    return mi.load_dict(_plain(environment_emitter(environment)))
