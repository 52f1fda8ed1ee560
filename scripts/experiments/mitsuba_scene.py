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
from bokehguide.limits import FARTHEST_FOCUS
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Camera, Environment, Material, Mesh, Scene, Texture

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
SMOOTH_GLASS = 0.063
FINE_MASK = 32
"""Texels of a cut-out's mask per texel of the texture, across and down."""
NEAR, FAR = 1e-4, 1e5
"""Clipping planes of Mitsuba's camera, metres."""
CHUNK_SAMPLES = 1 << 22
"""Largest number of samples of one render, which Mitsuba keeps in memory."""
APART = 1e-5
"""Distance of the back of a two-sided emitter behind its front, in scene sizes."""


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
        return Material(**terms, metallic=1.0, roughness=float(np.clip(material.roughness, *METAL_ROUGHNESS)))
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
    """A comparable scene in Mitsuba."""

    def __init__(self, scene: Scene):
        path = _path(scene)
        self._scene = mi.load_dict(_scene_dictionary(scene) | {"integrator": {"type": "moment", "path": path}})
        self._path = mi.load_dict(path)

    def look_at(self, column: int, row: int) -> None:
        """Restrict later renders to this pixel."""
        parameters = mi.traverse(self._scene)
        parameters["sensor.film.crop_offset"] = [column, row]
        parameters["sensor.film.crop_size"] = [1, 1]
        parameters.update()

    def picture(self, spp: int, seed: int) -> Tensor:
        """Radiance `[H, W, 3]` of an independent render, without the moments of `render`."""
        image = mi.render(self._scene, integrator=self._path, spp=spp, seed=seed)
        return torch.from_numpy(np.array(image, np.float64)[..., :3].copy())

    def render(self, spp: int, seed: int) -> MitsubaFilm:
        """An independent render of `spp` ≥ 2 samples per pixel."""
        # Channels: RGB of the mean, then X, Y, Z of the mean and of the squares.
        image = np.array(mi.render(self._scene, spp=spp, seed=seed), np.float64)
        if not np.isfinite(image).all():
            raise BokehguideError(f"Mitsuba: NaN or infinite pixels with seed {seed} at {spp} SPP")
        return MitsubaFilm(torch.from_numpy(image[..., :3].copy()), torch.from_numpy(image[..., 7].copy()), spp)


def _path(scene: Scene) -> dict[str, Any]:
    """The integrator, without Russian roulette: paths end at the last segment."""
    return {"type": "path", "max_depth": scene.film.max_depth, "rr_depth": 100}


def _scene_dictionary(scene: Scene) -> dict[str, Any]:
    parts: dict[str, Any] = {"type": "scene", "sensor": _sensor(scene)}
    materials = [mi.load_dict(_bsdf(material)) for material in scene.materials]
    size = max(float(np.ptp(mesh.vertices, axis=0).max()) for mesh in scene.meshes)
    for number, mesh in enumerate(scene.meshes):
        material = scene.materials[mesh.material]
        parts[f"mesh{number}"] = _shape(mesh, material, materials[mesh.material])
        if material.emits and material.double_sided:
            parts[f"mesh{number}back"] = _shape(_back(mesh, APART * size), material, materials[mesh.material])
    if scene.environment is not None:
        parts["environment"] = environment_emitter(scene.environment)
    return parts


def _sensor(scene: Scene) -> dict[str, Any]:
    camera: Camera = scene.camera
    lens = {"type": "perspective"}  # thinlens refuses a radius of 0
    if camera.aperture_radius > 0.0:
        lens = {
            "type": "thinlens",
            "aperture_radius": camera.aperture_radius,
            "focus_distance": min(camera.focus_distance, FARTHEST_FOCUS),
        }
    film = {"type": "hdrfilm", "width": scene.film.width, "height": scene.film.height, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at(list(camera.position), list(camera.target), list(camera.up))
    return lens | {
        "to_world": place,
        "fov": camera.fov,
        "fov_axis": "x",
        "near_clip": NEAR,
        "far_clip": FAR,
        "film": film | {"pixel_format": "rgb", "component_format": "float32"},
        "sampler": {"type": "independent"},
    }


def _bsdf(material: Material) -> dict[str, Any]:
    color = _color(material.base_color, material.base_color_texture)
    alpha = material.roughness**2
    if material.transmission > 0.0:
        index = {"int_ior": material.ior, "ext_ior": 1.0, "specular_transmittance": color}
        if material.thin:
            bsdf = {"type": "thindielectric"} | index
        elif alpha == 0.0:
            bsdf = {"type": "dielectric"} | index
        else:
            bsdf = {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha} | index
    elif material.metallic > 0.0:  # Schlick's Fresnel term, as in glTF
        metal = {"type": "principled", "base_color": color, "metallic": 1.0, "roughness": material.roughness}
        bsdf = {"type": "twosided", "bsdf": metal}
    else:
        bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
    return bsdf if material.alpha_mode == "opaque" else {"type": "mask", "bsdf": bsdf, "opacity": _opacity(material)}


def _color(factor: tuple[float, float, float], texture: Texture | None) -> dict[str, Any]:
    """A colour, or an image multiplied by it."""
    if texture is None:
        return {"type": "rgb", "value": list(factor)}
    return _bitmap(texture.image[..., :3] * np.asarray(factor, np.float32), texture)


def _opacity(material: Material) -> dict[str, Any] | float:
    """The opacity of a material that is not opaque. Mitsuba has no cut-outs, so a fine image replaces the threshold."""
    texture, cuts = material.base_color_texture, material.alpha_mode == "mask"
    if texture is None or texture.image.shape[2] < 4:
        return float(material.opacity >= material.alpha_cutoff) if cuts else material.opacity
    image = material.opacity * texture.image[..., 3]
    if not cuts:
        return _bitmap(image, texture)
    axes = ((np.arange(FINE_MASK * size) + 0.5) / FINE_MASK - 0.5 for size in image.shape)
    places = np.meshgrid(*axes, indexing="ij")
    beyond = {"repeat": "grid-wrap", "clamp": "nearest", "mirror": "reflect"}[texture.wrap[0]]
    cut = map_coordinates(image, places, order=1, mode=beyond) >= material.alpha_cutoff
    return _bitmap(cut, texture) | {"filter_type": "nearest"}


def _bitmap(image: np.ndarray, texture: Texture) -> dict[str, Any]:
    a, b, c, d, e, f = texture.transform
    if len(set(texture.wrap)) > 1:
        raise BokehguideError(f"texture: Mitsuba wraps u and v alike, not {' and '.join(texture.wrap)}")
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(image, np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": texture.wrap[0],
        "to_uv": mi.ScalarTransform4f([[a, b, 0.0, c], [d, e, 0.0, f], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]),
    }


def _shape(mesh: Mesh, material: Material, bsdf: mi.BSDF) -> mi.Mesh:
    parts = mi.Properties()
    parts["bsdf"] = bsdf
    if material.emits:
        radiance = _color(material.emission, material.emission_texture)
        parts["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    uv_set = next((t.uv_set for t in (material.base_color_texture, material.emission_texture) if t is not None), 0)
    arrays = {"vertex_positions": mesh.vertices, "faces": mesh.triangles.astype(np.uint32)}
    if mesh.normals is not None:
        arrays["vertex_normals"] = mesh.normals
    if mesh.uvs is not None:
        arrays["vertex_texcoords"] = mesh.uvs[:, uv_set]
    shape = mi.Mesh(
        material.name,
        *(len(mesh.vertices), len(mesh.triangles)),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uvs is not None,
        props=parts,
    )
    parameters = mi.traverse(shape)
    for name, array in arrays.items():
        parameters[name] = np.ascontiguousarray(array).ravel()
    parameters.update()
    return shape


def _back(mesh: Mesh, distance: float) -> Mesh:
    """The other face of every triangle of a flat mesh, `distance` behind it."""
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    vertices = (corners - distance * normals[:, None])[:, ::-1].reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    uvs = None if mesh.uvs is None else mesh.uvs[mesh.triangles][:, ::-1].reshape(len(vertices), -1, 2)
    return Mesh(vertices, triangles, mesh.material, uvs=uvs)


def environment_emitter(environment: Environment) -> dict[str, Any]:
    """The map with Mitsuba's rows, rotated: its centre lies at +z in Mitsuba and at -z in bokehguide.

    Mitsuba's first and last rows are the poles and its columns are texels; with twice as
    many rows plus one, both bilinear interpolants agree.
    """
    if not environment.visible:
        raise BokehguideError(
            "environment: Mitsuba has no environment that is invisible to the camera; set visible = true to compare"
        )
    radiance = np.asarray(environment.radiance, np.float32)
    if radiance.shape[:2] == (1, 1):
        return {"type": "constant", "radiance": {"type": "rgb", "value": radiance[0, 0].tolist()}}
    padded = np.pad(radiance, ((1, 1), (0, 0), (0, 0)), mode="edge")
    rows = np.empty((2 * len(radiance) + 1, *radiance.shape[1:]), np.float32)
    rows[1::2], rows[0::2] = radiance, 0.5 * (padded[1:] + padded[:-1])
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180.0 + environment.rotation)
    return {"type": "envmap", "bitmap": mi.Bitmap(rows), "to_world": turn}
