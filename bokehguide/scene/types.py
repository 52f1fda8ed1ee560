"""What a scene is: plain data in world space, before any ray is traced.

Lengths are metres, angles degrees, colours linear Rec.709 (radiance where they
emit). World space is right-handed with y up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A thin-lens camera that looks from `position` to `target`.

    fov: horizontal field of view in degrees.
    aperture_radius: lens radius in metres, 0 for a pinhole.
    focus_distance: metres from the lens to the focal plane, along the optical axis.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    fov: float = 40.0
    aperture_radius: float = 0.0
    focus_distance: float = 1.0


@dataclass(frozen=True)
class Film:
    """Size in pixels and the longest path in segments (1 = emission seen directly)."""

    width: int = 640
    height: int = 360
    max_depth: int = 6


@dataclass(frozen=True)
class Material:
    """A surface in glTF's metallic-roughness terms.

    Textures are linear float32 `[H, W, 3]`, top row first, repeated outside [0, 1]²:
    base colour, (unused, roughness, metallic) as glTF packs them, and emission; each
    multiplies its factor.
    """

    name: str
    base_color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = 1.0
    transmission: float = 0.0
    thin: bool = False
    ior: float = 1.5
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    double_sided: bool = False
    base_color_texture: np.ndarray | None = None
    metallic_roughness_texture: np.ndarray | None = None
    emission_texture: np.ndarray | None = None

    @property
    def emits(self) -> bool:
        return any(channel > 0.0 for channel in self.emission)


@dataclass(frozen=True)
class Mesh:
    """Triangles in world space with one material.

    vertices: float32 `[V, 3]`; triangles: int32 `[T, 3]`, anticlockwise seen from the
    front; normals: unit float32 `[V, 3]` or None for flat shading; uvs: float32
    `[V, 2]` with v downwards from the texture's top row (glTF), or None.
    material: index into `Scene.materials`.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    material: int
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None


@dataclass(frozen=True)
class Environment:
    """Equirectangular radiance, float32 `[H, W, 3]`, top row towards +y.

    The map's centre lies at -z and u grows towards +x; `rotation` turns it about +y,
    anticlockwise seen from above. A constant colour is a 1 × 1 map.
    """

    radiance: np.ndarray
    rotation: float = 0.0


@dataclass(frozen=True)
class Inset:
    """A crop box as fractions of the frame, from its top left corner."""

    x: float
    y: float
    width: float
    height: float

    def pixels(self, width: int, height: int) -> tuple[slice, slice]:
        """Rows and columns of this inset in a `height × width` image."""
        top, left = round(self.y * height), round(self.x * width)
        bottom = max(top + 1, round((self.y + self.height) * height))
        right = max(left + 1, round((self.x + self.width) * width))
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class Scene:
    """Everything a render needs. `warnings` say what of the input was not honoured."""

    name: str
    camera: Camera
    meshes: tuple[Mesh, ...]
    materials: tuple[Material, ...]
    film: Film = Film()
    environment: Environment | None = None
    insets: tuple[Inset, ...] = ()
    description: str = ""
    warnings: tuple[str, ...] = field(default=())
