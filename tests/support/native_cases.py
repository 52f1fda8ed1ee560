"""Scenes with every feature that the native core knows, rays through them, and stages of its traces."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from types import ModuleType
from typing import Any, TypeVar, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.render.native_hits import PLAIN_FIELDS
from bokehguide.render.native_tables import native_scene
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import Surface
from bokehguide.runtime import native
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Cone, Environment, Material, Mesh, Scene, Sun, Texture
from tests.support.tracing import DOWN, UP, emitter, rectangle, scene, sphere

T = TypeVar("T")
BUILT_IN = ("fairy-lights", "night-street", "chrome", "daylight", "cutout", "glitter", "occluded")
SUNS = (Sun((0.6, 0.8, 0.0), 3.0, (2.0, 1.5, 1.0)), Sun((0.0, 0.6, 0.8), 20.0, (0.3, 0.4, 0.5)))
MANY_SUNS = (1, 6, 14, 40, 300)
FEATURES = (
    "textures",
    "coats",
    "layers",
    "films",
    "glass",
    "sheets",
    "sky",
    "hidden sky",
    "suns",
    "lamps",
    "solids",
    "spot in the dark",
    "dark",
)


def core() -> ModuleType:
    """The native core; skips the test where it is not built."""
    found = native.core()
    if found is None:
        pytest.skip("the native core is not built")
    return found


def each_instruction_set(work: Callable[[], T]) -> list[T]:
    """Results of a function with each core that the processor can run; skips the test where there is one."""
    names = core().instruction_sets()
    if len(names) == 1:
        pytest.skip("the processor has one instruction set")
    results = []
    try:
        for name in names:
            core().use_instruction_set(name)
            results.append(work())
    finally:
        core().use_instruction_set(names[-1])
    return results


def texture(seed: int, channels: int = 4, low: float = 0.2, **others) -> Texture:
    values = np.random.default_rng(seed).uniform(low, 1.0, (7, 5, channels))
    return Texture(values.astype(np.float32), **others)


def bumps(seed: int) -> Texture:
    generator = np.random.default_rng(seed)
    return Texture(np.append(generator.uniform(0.2, 0.8, (6, 6, 2)), np.ones((6, 6, 1)), axis=2).astype(np.float32), uv_set=1)


def dressed(mesh: Mesh, alpha: float = 0.3) -> Mesh:
    """The mesh with two uv sets and vertex colours."""
    uvs = np.stack((3.0 * mesh.vertices[:, :2] + 0.3 * mesh.vertices[:, 2:], -1.7 * mesh.vertices[:, 1:]), axis=1)
    colors = np.random.default_rng(3).uniform(alpha, 1.0, (len(mesh.vertices), 4)).astype(np.float32)
    return replace(mesh, uvs=np.ascontiguousarray(uvs), colors=colors)


TEXTURED = Material(
    "all",
    (0.9, 0.8, 0.7),
    metallic=0.7,
    roughness=0.6,
    specular_color=(1.0, 0.6, 0.3),
    transmission=0.5,
    clearcoat=0.8,
    clearcoat_roughness=0.4,
    base_color_texture=texture(1, 3, transform=(1.0, 0.4, 0.1, -0.3, 2.0, 0.7)),
    metallic_roughness_texture=texture(2, 3, wrap=("mirror", "clamp")),
    specular_texture=texture(3, uv_set=1),
    specular_color_texture=texture(4, 3),
    transmission_texture=texture(5, 3),
    clearcoat_texture=texture(6, 3),
    clearcoat_roughness_texture=texture(7, 3),
    normal_texture=bumps(8),
    normal_scale=0.7,
)
COATS = Material(
    "coat", (0.3, 0.5, 0.8), roughness=0.5, clearcoat=0.9, clearcoat_roughness=0.2, clearcoat_normal_texture=bumps(9)
)
LAYERS = (
    Material(
        "cloth",
        (0.3, 0.2, 0.6),
        sheen_color=(0.9, 0.8, 1.0),
        sheen_roughness=0.8,
        sheen_color_texture=texture(14, 3),
        sheen_roughness_texture=texture(15),
        clearcoat=0.4,
        clearcoat_roughness=0.5,
        clearcoat_normal_texture=bumps(16),
    ),
    Material("brushed", (0.9, 0.7, 0.5), metallic=1.0, roughness=0.4, anisotropy=0.9, anisotropy_rotation=30.0),
    Material(
        "scratched", (0.6, 0.6, 0.6), roughness=0.3, anisotropy=1.0, anisotropy_texture=texture(17, 3), normal_texture=bumps(8)
    ),
    Material(
        "leaf",
        (0.2, 0.6, 0.1),
        roughness=0.4,
        sheen_color=(0.2, 0.2, 0.2),
        diffuse_transmission=0.8,
        diffuse_transmission_color=(0.7, 0.9, 0.3),
        diffuse_transmission_texture=texture(18),
        diffuse_transmission_color_texture=texture(19, 3),
        attenuation_color=(0.7, 0.8, 0.9),
        attenuation_distance=2.0,
    ),
)
FILMS = (
    Material(
        "oil",
        (0.1, 0.1, 0.1),
        roughness=0.4,
        iridescence=1.0,
        iridescence_ior=1.8,
        iridescence_thickness=(200.0, 900.0),
        iridescence_texture=texture(20, 3),
        iridescence_thickness_texture=texture(21, 3),
    ),
    Material("steel", (0.7, 0.6, 0.5), metallic=1.0, roughness=0.3, iridescence=0.7, iridescence_ior=2.0),
    Material("rough steel", (0.7, 0.6, 0.5), metallic=1.0, roughness=0.8, single_scattering=True),
    Material("bubble", roughness=0.4, transmission=1.0, thin=True, iridescence=1.0, iridescence_ior=1.4),
    Material(
        "gem", (0.9, 1.0, 0.9), roughness=0.4, transmission=1.0, ior=1.8, dispersion=2.0, iridescence=0.8, iridescence_ior=2.2
    ),
    Material("prism", roughness=0.0, transmission=1.0, ior=1.6, dispersion=3.0),
)
GLASS = (
    Material(
        "frosted", (0.9, 0.9, 0.8), roughness=0.5, transmission=1.0, attenuation_color=(0.4, 0.7, 0.9), attenuation_distance=0.5
    ),
    Material("clear", (0.9, 1.0, 0.9), roughness=0.0, transmission=0.9),
    Material("sheet", (0.9, 0.9, 0.8), roughness=0.4, transmission=0.8, thin=True, double_sided=True),
)
SHEETS = (
    Material("mask", (0.6, 0.5, 0.4), base_color_texture=texture(10), alpha_mode="mask", alpha_cutoff=0.4),
    Material("blend", (0.3, 0.8, 0.4), opacity=0.6, alpha_mode="blend"),
    Material("blended texture", (0.8, 0.8, 0.4), base_color_texture=texture(11, low=0.0), alpha_mode="blend"),
)
SOLIDS = (
    Material("partial prism", (0.4, 0.5, 0.6), roughness=0.0, transmission=0.6, ior=1.6, dispersion=3.0),
    Material("white glass", (1.0, 1.0, 1.0), roughness=0.0, transmission=1.0),
)
EXTREMES = (
    Material("glaze", (0.5, 0.6, 0.7), roughness=0.5, ior=3.0, specular_color=(6.0, 3.0, 1.0)),
    Material(
        "coated leaf",
        (0.2, 0.6, 0.1),
        roughness=0.6,
        diffuse_transmission=0.8,
        clearcoat=0.9,
        clearcoat_roughness=0.4,
        clearcoat_normal_texture=bumps(9),
        normal_texture=bumps(8),
    ),
    Material("trace of oil", (0.2, 0.2, 0.2), roughness=0.4, iridescence=1.0, iridescence_thickness=(0.0, 0.02)),
    Material("spread", (1.0, 1.0, 1.0), roughness=0.4, transmission=1.0, ior=1.3, dispersion=60.0),
)
MATTE = Material("matte", (0.6, 0.6, 0.6), roughness=0.8)
LAMPS = (
    emitter(4.0, emission_texture=texture(12, 3, 0.0), double_sided=True),
    emitter(9.0, emission_cone=Cone((0.0, -1.0, 0.0), 20.0, 50.0)),
    emitter(7.0, emission_cone=Cone((0.0, -1.0, 0.0), 10.0, 60.0, smooth=True)),
    emitter(3.0, clearcoat=1.0, clearcoat_texture=texture(13, 3)),
    emitter(5.0, tint_emission=True, alpha_mode="blend", opacity=0.7),
)


def sky(visible: bool = True) -> Environment:
    radiance = np.random.default_rng(4).uniform(0.1, 1.0, (9, 17, 3)).astype(np.float32)
    radiance[2:4, 3:5] = 30.0
    return Environment(radiance, 40.0, visible=visible)


def room(materials: tuple[Material, ...], lamps: tuple[Material, ...], environment: Environment | None = None, suns=()) -> Scene:
    """A floor, spheres and slanted plates of some materials, and one rectangle for each lamp."""
    every = [MATTE, *materials, *lamps]
    meshes = [rectangle(0, rotate=UP, scale=3.0)]
    for number in range(1, len(materials) + 1):
        meshes += [sphere(number, (1.1 * number - 2.0, 0.5, -0.4), 0.4), sphere(number, (1.1 * number - 2.1, 0.5, 0.9), 0.3)]
        meshes.append(rectangle(number, (1.1 * number - 2.0, 0.7, 0.3), (-60.0, 20.0, 0.0), 0.5))
    for number in range(len(lamps)):
        meshes.append(rectangle(1 + len(materials) + number, (1.2 * number - 1.5, 1.8, 0.2 * number), DOWN, 0.3))
    made = scene([dressed(mesh) for mesh in meshes], every, environment, max_depth=6)
    return replace(made, suns=suns)


def solids() -> Scene:
    """Glass that absorbs nothing or transmits a part, an absorbing emitter with its back to the room, and suns that overlap."""
    suns = (*SUNS, Sun((0.0, 0.7, 0.714142843), 30.0, (0.5, 0.3, 0.2)))
    glow = emitter(6.0, double_sided=True, transmission=0.5, attenuation_color=(0.2, 0.5, 0.8), attenuation_distance=0.5)
    made = room(SOLIDS, (glow,), None, suns)
    return replace(made, meshes=(*made.meshes, dressed(rectangle(3, (0.4, 1.9, 0.9), UP, 0.4))))


def under_suns(count: int) -> Scene:
    """A room with a lamp and some suns, each of which is a cluster of lights."""
    directions = np.random.default_rng(6).normal(size=(count, 3))
    directions[:, 1] = np.abs(directions[:, 1])
    suns = [Sun(tuple(each / np.linalg.norm(each)), 5.0, (1.0, 0.8, 0.6)) for each in directions]
    return room((MATTE,), (emitter(6.0),), None, tuple(suns))


def sheets_before_a_lamp(sheets: int, opacity: float, scale: float, **film: int) -> Scene:
    """Slanted sheets of twice the length `scale` between a floor and an emitter."""
    sheet = replace(MATTE, opacity=opacity, alpha_mode="blend")
    panes = [rectangle(1, (0.0, 1.5 + 0.004 * number, 0.0), (-60.0, 0.0, 0.0), scale) for number in range(sheets)]
    meshes = [rectangle(0, rotate=UP, scale=3.0), *panes, rectangle(2, (0.0, 4.5, 0.0), DOWN)]
    return scene(meshes, [MATTE, sheet, emitter(5.0)], **film)


def panes() -> Scene:
    """White panes, whose paths keep their throughput until Russian roulette ends them, before a bright sky."""
    pane = Material("pane", (1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, thin=True)
    return scene([rectangle(0, (0.0, 0.25 * number, 0.5), UP, 3.0) for number in range(8)], [pane], sky(), max_depth=10)


def mirror_ball() -> Scene:
    """An emitter in a hollow mirror, which has images of it before itself."""
    mirror = Material("mirror", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    return scene([sphere(0, (0.0, 0.9, 0.5), 2.0), sphere(1, (0.6, 0.4, 0.9), 0.3)], [mirror, emitter(6.0)], max_depth=4)


@cache
def feature_scene(name: str) -> Scene:
    lamp = (emitter(6.0),)
    scenes = {
        "textures": lambda: room((TEXTURED, COATS), lamp, sky()),
        "coats": lambda: room((COATS, replace(COATS, normal_texture=bumps(2))), lamp),
        "layers": lambda: room(LAYERS, lamp, sky()),
        "films": lambda: room(FILMS, lamp, sky()),
        "extremes": lambda: room(EXTREMES, lamp, sky()),
        "gems": lambda: room(FILMS[:2:-1], lamp, sky()),  # rays hit the first materials of a room most often
        "leaves": lambda: room(LAYERS[:1:-1], lamp, sky()),
        "glass": lambda: room(GLASS, lamp, sky()),
        "sheets": lambda: room(SHEETS, LAMPS),
        "sky": lambda: room((MATTE,), (), sky(), SUNS),
        "hidden sky": lambda: room((MATTE, *GLASS), lamp, sky(visible=False)),
        "suns": lambda: room((MATTE,), lamp, None, SUNS),
        "lamps": lambda: room((MATTE, COATS), LAMPS, sky(), SUNS),
        "solids": solids,
        "large sheet": lambda: sheets_before_a_lamp(1, 0.4, 1000.0),
        "many sheets": lambda: sheets_before_a_lamp(300, 0.001, 30.0, max_depth=2),
        "mirror ball": mirror_ball,
        "panes": panes,
        "spot in the dark": lambda: room((MATTE,), LAMPS[1:2]),
        "dark": lambda: room((MATTE,), ()),
    }
    scenes |= {f"suns: {count}": partial(under_suns, count) for count in MANY_SUNS}
    return scenes[name]() if name in scenes else load_scene(name, Overrides(width=64, height=36))


@cache
def both_tracers(name: str) -> tuple[PathTracer, PathTracer]:
    """The path tracer of a scene with the native core, and without it."""
    core()
    with pytest.MonkeyPatch.context() as patch:
        tracer = PathTracer(feature_scene(name))
        patch.setenv(native.SWITCH, "0")
        return tracer, PathTracer(feature_scene(name))


@cache
def tables(name: str) -> Any:
    """The scene in the native core."""
    tracer, _ = both_tracers(name)
    return native_scene(core(), tracer.geometry, tracer.lights, tracer.visibility)


def rays(name: str, count: int, seed: int = 0) -> tuple[Tensor, Tensor, PixelRandom]:
    """Rays `[3, count]` from near the camera of a built-in scene, or from the middle of a room, and random numbers."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(3, count))
    if name in BUILT_IN:
        camera = feature_scene(name).camera
        forward = np.array(camera.target) - camera.position
        directions = 0.25 * directions + (forward / np.linalg.norm(forward))[:, None]
        origins = np.array(camera.position)[:, None] + generator.normal(size=(3, count)) * camera.aperture_radius
    else:
        origins = np.array([0.0, 0.9, 0.5])[:, None] + generator.uniform(-0.5, 0.5, (3, count))
    directions /= np.linalg.norm(directions, axis=0)
    origin, direction = (torch.from_numpy(values).float() for values in (origins, directions))
    return origin, direction, PixelRandom(seed, 3, torch.arange(count))


def rows_of(surface: Surface) -> Tensor:
    """The surfaces as the native core has them, `[32, N]`, or `[49, N]` with a field that is rare."""
    count = surface.position.shape[1]
    defaults = {"specular_color": torch.ones(3, count), "clearcoat": torch.zeros(count), "clearcoat_alpha": torch.ones(count)}
    defaults["clearcoat_normal"] = surface.normal
    defaults |= {"sheen_color": torch.zeros(3, count), "sheen_roughness": torch.zeros(count), "tangent": torch.zeros(3, count)}
    defaults |= {"alpha_along": surface.alpha, "diffuse_transmission": torch.zeros(count)}
    defaults |= {name: torch.zeros(count) for name in ("iridescence", "film_thickness", "dispersion", "single_scattering")}
    defaults |= {"transmission_color": torch.ones(3, count), "film_ior": torch.ones(count)}
    rare = [getattr(surface, field.name) is not None for field in dataclasses.fields(Surface)[PLAIN_FIELDS:]]
    kept = list(vars(surface).items())[: None if any(rare) else PLAIN_FIELDS]
    fields = {name: defaults.get(name) if value is None else value for name, value in kept}
    return torch.cat([cast(Tensor, value).reshape(-1, count) for value in fields.values()]).contiguous()
