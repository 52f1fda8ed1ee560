"""Small scenes, each of one kind of material or light, that Mitsuba can render too.

Their emitters are large enough for few samples, and small enough for bokeh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bokehguide.scene.shapes import spheres, transform, transformed, unit_box, unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Inset, Material, Mesh, Scene, Texture

CAMERA = Camera((0.0, 0.7, 3.0), (0.0, 0.4, 0.0), fov=40.0, aperture_radius=0.08, focus_distance=3.0)
INSETS = (Inset(0.05, 0.05, 0.4, 0.4), Inset(0.3, 0.45, 0.4, 0.45))
WHITE = Material("white", (0.7, 0.7, 0.7), specular=0.0)


def diffuse() -> Scene:
    """Diffuse bodies on a chequered ground."""
    red = Material("red", (0.7, 0.2, 0.1), specular=0.0)
    return _stage("diffuse", [(_ball(-0.45), red), (_box(0.5), WHITE)])


def metal() -> Scene:
    """A golden and a silver ball, and a metal plate that leans behind them."""
    gold = Material("gold", (1.0, 0.77, 0.34), metallic=1.0, roughness=0.2)
    silver = Material("silver", (0.9, 0.9, 0.92), metallic=1.0, roughness=0.05)
    plate = _placed(unit_rectangle(), (0.0, 0.5, -1.0), (-10.0, 15.0, 0.0), (1.0, 0.5, 1.0))
    return _stage("metal", [(_ball(-0.45), gold), (_ball(0.45), silver), (plate, gold)])


def smooth_glass() -> Scene:
    """A tinted ball, a box and a thin pane of clear glass."""
    tinted = Material("tinted", (0.7, 0.9, 0.8), transmission=1.0, roughness=0.0)
    clear = Material("clear", (1.0, 1.0, 1.0), transmission=1.0, roughness=0.0, ior=1.33)
    pane = Material("pane", (0.9, 0.8, 0.7), transmission=1.0, roughness=0.0, thin=True)
    sheet = _placed(unit_rectangle(), (0.0, 0.5, -0.6), (0.0, 25.0, 0.0), (0.5, 0.5, 1.0))
    return _stage("smooth-glass", [(_ball(-0.45), tinted), (_box(0.5), clear), (sheet, pane)], max_depth=10)


def rough_glass() -> Scene:
    """A ball and a box of frosted glass."""
    frosted = Material("frosted", (0.9, 0.9, 1.0), transmission=1.0, roughness=0.2)
    return _stage("rough-glass", [(_ball(-0.45), frosted), (_box(0.5), frosted)], max_depth=10)


def textured_emitter() -> Scene:
    """Emitters with textures: one large, two small out of focus, and one that emits from both faces."""
    picture = Texture(_picture(6, 8), wrap=("clamp", "clamp"))
    screen = Material("screen", (0.0, 0.0, 0.0), specular=0.0, emission=(3.0, 3.0, 3.0), emission_texture=picture)
    board = replace(screen, name="board", emission=(2.0, 1.0, 3.0), double_sided=True)
    sign = replace(screen, name="sign", emission=(40.0, 25.0, 15.0))
    above = _placed(unit_rectangle(), (0.7, 2.2, 0.5), (60.0, -15.0, 0.0), (1.0, 0.7, 1.0))
    near = _placed(unit_rectangle(), (-0.5, 0.3, 0.0), (0.0, 60.0, 5.0), (0.3, 0.25, 1.0))
    signs = [_placed(unit_rectangle(), (x, 1.15, -2.5), (0.0, -20.0, 0.0), (0.06, 0.04, 1.0)) for x in (-0.6, 0.5)]
    bodies = [(above, screen), (near, board), (_ball(0.45), WHITE), *((mesh, sign) for mesh in signs)]
    return _stage("textured-emitter", bodies, emitters=False)


def environment_emitters() -> Scene:
    """Emitters at infinity, in a rotated environment map."""
    sky = np.random.default_rng(4).uniform(0.1, 0.3, (32, 64, 3)).astype(np.float32)
    radiance = sky.repeat(4, axis=0).repeat(4, axis=1)
    emitters = ((61, 144, (24, 10, 3)), (59, 153, (6, 20, 9)), (60, 163, (8, 8, 24)), (22, 40, (99, 99, 99)))
    # Three in view, and one behind the camera that lights the bodies.
    for row, column, color in emitters:
        radiance[row : row + 2, column : column + 2] = color
    scene = _stage("environment-emitters", [(_ball(-0.45), WHITE), (_box(0.5), WHITE)], emitters=False)
    return replace(scene, environment=Environment(radiance, rotation=37.0))


def alpha_mask() -> Scene:
    """Two leaves before a ball: one cut out, one half transparent."""
    image = np.concatenate((_picture(8, 8), _holes(8)[..., None]), axis=2)
    leaf = Material("leaf", (0.8, 0.8, 0.8), specular=0.0, base_color_texture=Texture(image), alpha_mode="mask")
    veil = replace(leaf, name="veil", alpha_mode="blend", opacity=0.8)
    left = _placed(unit_rectangle(), (-0.4, 0.5, 0.5), (0.0, 20.0, 0.0), (0.35, 0.35, 1.0))
    right = _placed(unit_rectangle(), (0.4, 0.5, -0.8), (0.0, -30.0, 10.0), (0.5, 0.4, 1.0))
    return _stage("alpha-mask", [(left, leaf), (right, veil), (_ball(0.1), WHITE)], max_depth=16)


MATERIAL_SCENES: dict[str, Callable[[], Scene]] = {
    "diffuse": diffuse,
    "metal": metal,
    "smooth-glass": smooth_glass,
    "rough-glass": rough_glass,
    "textured-emitter": textured_emitter,
    "environment-emitters": environment_emitters,
    "alpha-mask": alpha_mask,
}


def _stage(name: str, bodies: list[tuple[Mesh, Material]], max_depth: int = 6, emitters: bool = True) -> Scene:
    """Bodies on a ground with a tiled texture, under a sky; optionally a ceiling emitter and three small ones."""
    tiles = Texture(_picture(8, 8), transform=(4.0, 0.0, 0.3, 0.0, 4.0, 0.1))
    ground = Material("ground", (0.8, 0.8, 0.8), specular=0.0, base_color_texture=tiles)
    parts = [(_placed(unit_rectangle(), (0.0, 0.0, -1.0), (-90.0, 0.0, 0.0), 4.0), ground), *bodies]
    if emitters:
        ceiling = Material("ceiling", (0.0, 0.0, 0.0), specular=0.0, emission=(4.0, 3.8, 3.5))
        bulb = Material("bulb", (0.0, 0.0, 0.0), specular=0.0, emission=(12.0, 8.0, 4.0))
        centres = np.array([[-1.0, 1.1, -2.5], [0.1, 1.3, -3.5], [0.9, 0.9, -2.0]])
        parts += [(_placed(unit_rectangle(), (1.0, 2.5, 0.5), (90.0, 0.0, 0.0), 0.8), ceiling)]
        parts += [(spheres(centres, 0.04, 0), bulb)]
    meshes = tuple(replace(mesh, material=number) for number, (mesh, _) in enumerate(parts))
    sky = np.linspace((0.5, 0.6, 0.9), (0.1, 0.1, 0.1), 8, dtype=np.float32)[:, None].repeat(8, axis=1)
    return Scene(
        name=name,
        camera=CAMERA,
        meshes=meshes,
        materials=tuple(material for _, material in parts),
        film=FilmSettings(96, 54, max_depth),
        environment=Environment(np.ascontiguousarray(sky)),
        insets=INSETS,
    )


def _placed(mesh: Mesh, translate: tuple, rotate: tuple = (0.0, 0.0, 0.0), scale: float | tuple = 1.0) -> Mesh:
    return transformed(mesh, transform(translate, rotate, scale))


def _ball(x: float) -> Mesh:
    return _placed(unit_sphere(), (x, 0.36, 0.0), scale=0.35)


def _box(x: float) -> Mesh:
    return _placed(unit_box(), (x, 0.31, 0.0), (0.0, 30.0, 0.0), 0.6)


def _picture(height: int, width: int) -> np.ndarray:
    """Random colours without rotational or mirror symmetry, float32 `[height, width, 3]`."""
    picture = np.random.default_rng(1).uniform(0.1, 1.0, (height, width, 3))
    picture[: height // 2, : width // 2] *= 0.3
    return picture.astype(np.float16).astype(np.float32)


def _holes(size: int) -> np.ndarray:
    """Opacities, about a third of them 0, float32 `[size, size]`."""
    rng = np.random.default_rng(2)
    return np.where(rng.random((size, size)) < 0.35, 0.0, 1.0).astype(np.float32)
