"""The scene's triangles and materials as tensors, and the surfaces that rays find there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bokehguide.render.textures import TextureAtlas
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.render.vector import dot, normalize
from bokehguide.scene.types import Material, Mesh, Scene

MIN_ALPHA = 1e-3
"""Smallest GGX α of an opaque surface: smoother ones are as good as mirrors."""
SMOOTH_ALPHA = 4e-3
"""Below this α (roughness 0.063) a transmissive surface reflects and refracts as a delta."""
OFFSET = 1e-5
"""Ray origins leave the surface by this fraction of the distances involved."""


@dataclass
class Surface:
    """What the paths of a batch hit, as component arrays; all vectors are in world space.

    geometric_normal and normal lie on the side of `outgoing`, the direction back along
    the ray. front: whether that is the triangle's front, float32 of 0 or 1.
    offset: distance by which new rays leave along ±geometric_normal. alpha and
    clearcoat_alpha are GGX's α. A field that may be None is so where no material of the
    scene has the term: specular colours other than white, a clear coat.
    """

    position: Tensor
    outgoing: Tensor
    geometric_normal: Tensor
    normal: Tensor
    front: Tensor
    offset: Tensor
    base_color: Tensor
    metallic: Tensor
    alpha: Tensor
    specular: Tensor
    transmission: Tensor
    thin: Tensor
    ior: Tensor
    specular_color: Tensor | None = None
    clearcoat: Tensor | None = None
    clearcoat_alpha: Tensor | None = None

    def select(self, index: Tensor) -> Surface:
        """The surfaces at `index`, int64 `[M]`."""
        values = (getattr(self, name) for name in self.__dataclass_fields__)
        return Surface(*(None if value is None else value.index_select(-1, index) for value in values))

    def leave(self, direction: Tensor) -> Tensor:
        """Origins `[3, N]` off the surface on the side towards `direction`."""
        side = torch.sign(dot(self.geometric_normal, direction))
        return self.position + self.geometric_normal * (side * self.offset)


class Geometry:
    """Triangles, materials and textures of a scene, with the Embree tracer over them."""

    def __init__(self, scene: Scene, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in scene.meshes])
        vertices = np.concatenate([mesh.vertices for mesh in scene.meshes]).astype(np.float32)
        triangles = np.concatenate([mesh.triangles + offset for mesh, offset in zip(scene.meshes, offsets)])
        self.tracer = Tracer(vertices, triangles.astype(np.int32))
        self.corners = torch.from_numpy(vertices[triangles].transpose(1, 2, 0).copy())
        """Vertex positions `[corner, component, T]`, on the host."""
        edges = self.corners[1:] - self.corners[:1]
        normal = torch.linalg.cross(edges[0], edges[1], dim=0)
        self.areas = 0.5 * normal.square().sum(0).sqrt()
        normal = normalize(normal)
        shading = np.concatenate([_corner_normals(mesh) for mesh in scene.meshes])
        self._normals = torch.cat((normal, _interpolation_rows(shading, normal))).to(self.device)
        self.material = torch.from_numpy(
            np.concatenate([np.full(len(mesh.triangles), mesh.material, np.int64) for mesh in scene.meshes])
        ).to(self.device)
        uvs = np.concatenate([_corner_uvs(mesh) for mesh in scene.meshes]).reshape(-1, 6).T
        self._uvs = torch.from_numpy(np.ascontiguousarray(uvs, np.float32)).to(self.device)
        self._build_materials(scene.materials)

    def _build_materials(self, materials: tuple[Material, ...]) -> None:
        atlas = TextureAtlas()
        self._textures = torch.tensor(
            [
                [atlas.add(m.base_color_texture), atlas.add(m.metallic_roughness_texture), atlas.add(m.emission_texture)]
                for m in materials
            ]
        ).T.contiguous().to(self.device)  # [3, M]
        self.atlas = atlas.build(self.device)
        rows = [
            (*m.base_color, m.metallic, m.roughness, m.specular, m.transmission, float(m.thin), m.ior) for m in materials
        ]
        self._parameters = torch.tensor(rows, dtype=torch.float32).T.contiguous().to(self.device)
        self._emission = torch.tensor([(*m.emission, float(m.double_sided)) for m in materials]).T.contiguous().to(self.device)
        self.emissive = torch.tensor([m.emits for m in materials], device=self.device)
        self.has_transmission = any(m.transmission > 0.0 for m in materials)
        self._specular_color = torch.tensor([m.specular_color for m in materials]).T.contiguous().to(self.device)
        self._has_specular_color = any(m.specular_color != (1.0, 1.0, 1.0) for m in materials)
        self._clearcoat = torch.tensor([(m.clearcoat, m.clearcoat_roughness) for m in materials]).T.contiguous().to(self.device)
        self._has_clearcoat = any(m.clearcoat > 0.0 for m in materials)
        self._has_textures = bool((self._textures[:2] >= 0).any())

    def face_normals(self, triangle: Tensor) -> Tensor:
        """Unit geometric normals `[3, N]` on the front of triangles `[N]`."""
        return self._normals[0:3].index_select(1, triangle)

    def is_double_sided(self, triangle: Tensor) -> Tensor:
        """1 where triangles `[N]` emit from both faces, else 0; float32 `[N]`."""
        return self._emission[3].index_select(0, self.material.index_select(0, triangle))

    def surface(self, origins: Tensor, directions: Tensor, hit: Hit) -> Surface:
        """The surfaces at valid hits of rays `[3, N]`."""
        rows = self._normals.index_select(1, hit.triangle)
        geometric = rows[0:3]
        outgoing = -directions
        side = dot(geometric, outgoing)
        front = (side > 0.0).to(torch.float32)
        geometric = geometric * torch.copysign(torch.ones_like(side), side)
        normal = rows[3:6] + hit.u * rows[6:9] + hit.v * rows[9:12]
        normal = normalize(normal * torch.copysign(torch.ones_like(side), dot(normal, geometric)))
        # A shading normal that faces away from the viewer gives way to the geometric one.
        facing = (dot(normal, outgoing) > 1e-4).to(torch.float32)
        normal = normal * facing + geometric * (1.0 - facing)
        position = origins + hit.distance * directions
        offset = OFFSET * (position.abs().amax(0) + hit.distance)
        material = self.material.index_select(0, hit.triangle)
        values = self._parameters.index_select(1, material)
        base_color, metallic, roughness = values[0:3], values[3], values[4]
        if self._has_textures:
            base_color, metallic, roughness = self._apply_textures(material, hit, base_color, metallic, roughness)
        alpha = (roughness * roughness).clamp(min=MIN_ALPHA)
        surface = Surface(position, outgoing, geometric, normal, front, offset, base_color, metallic, alpha, *values[5:])
        if self._has_specular_color:
            surface.specular_color = self._specular_color.index_select(1, material)
        if self._has_clearcoat:
            surface.clearcoat, roughness = self._clearcoat.index_select(1, material)
            surface.clearcoat_alpha = (roughness * roughness).clamp(min=MIN_ALPHA)
        return surface

    def _apply_textures(self, material: Tensor, hit: Hit, base_color: Tensor, metallic: Tensor, roughness: Tensor):
        numbers = self._textures[:2].index_select(1, material)
        base_color, metallic, roughness = base_color.clone(), metallic.clone(), roughness.clone()
        colored = (numbers[0] >= 0).nonzero()[:, 0]
        base_color[:, colored] *= self._lookup(numbers[0], hit, colored)
        packed = (numbers[1] >= 0).nonzero()[:, 0]
        texel = self._lookup(numbers[1], hit, packed)
        roughness[packed] *= texel[1]
        metallic[packed] *= texel[2]
        return base_color, metallic, roughness

    def _lookup(self, number: Tensor, hit: Hit, index: Tensor) -> Tensor:
        corners = self._uvs.index_select(1, hit.triangle[index])
        u, v = hit.u[index], hit.v[index]
        uv = corners[0:2] * (1.0 - u - v) + corners[2:4] * u + corners[4:6] * v
        return self.atlas.lookup(number[index], uv)

    def emission(self, hit: Hit, front: Tensor) -> Tensor:
        """Radiance `[3, N]` that hits emit towards the viewer: from the front, or both faces if double-sided."""
        material = self.material.index_select(0, hit.triangle)
        rows = self._emission.index_select(1, material)
        radiance = rows[0:3] * torch.maximum(front, rows[3])
        number = self._textures[2].index_select(0, material)
        textured = (number >= 0).nonzero()[:, 0]
        if len(textured):
            radiance[:, textured] *= self._lookup(number, hit, textured)
        return radiance


def _corner_normals(mesh: Mesh) -> np.ndarray:
    """Shading normals `[T, corner, component]`, NaN where the mesh is flat."""
    if mesh.normals is None:
        return np.full((len(mesh.triangles), 3, 3), np.nan, np.float32)
    return mesh.normals[mesh.triangles].astype(np.float32)


def _corner_uvs(mesh: Mesh) -> np.ndarray:
    if mesh.uvs is None:
        return np.zeros((len(mesh.triangles), 3, 2), np.float32)
    return mesh.uvs[mesh.triangles][:, :, 0].astype(np.float32)


def _interpolation_rows(corner_normals: np.ndarray, flat: Tensor) -> Tensor:
    """Rows `[9, T]`: the first corner's normal and its differences to the other two."""
    normals = torch.from_numpy(np.ascontiguousarray(corner_normals.transpose(1, 2, 0)))
    normals = torch.where(normals.isnan(), flat, normals)
    return torch.cat((normals[0], normals[1] - normals[0], normals[2] - normals[0]))
