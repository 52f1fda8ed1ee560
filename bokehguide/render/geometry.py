"""The scene's triangles and materials as tensors, and the surfaces that rays find there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bokehguide.render import triangles
from bokehguide.render.kernels import kernel, record
from bokehguide.render.materials import CLEARCOAT_F0, Materials
from bokehguide.render.pixels import put, put_where, worthwhile
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.render.vector import cross, dot, fifth_power, length, normalize
from bokehguide.scene.types import Scene

MIN_ALPHA = 1e-3
"""Smallest GGX α of an opaque surface: smoother ones are as good as mirrors."""
SMOOTH_ALPHA = 4e-3
"""Below this α (roughness 0.063) a transmissive surface reflects and refracts as a delta."""
OFFSET = 1e-5
"""Ray origins leave the surface by this fraction of the distances involved."""
MIN_FACING = 1e-4
"""Least cosine between a shading normal and the direction to the viewer."""
TARGETS = {
    "base_color": (("base_color", slice(0, 3), False),),
    "metallic_roughness": (("alpha", 1, True), ("metallic", 2, False)),
    "specular": (("specular", 3, False),),
    "specular_color": (("specular_color", slice(0, 3), False),),
    "transmission": (("transmission", 0, False),),
    "clearcoat": (("clearcoat", 0, False),),
    "clearcoat_roughness": (("clearcoat_alpha", 1, True),),
}
"""What the texture in a slot multiplies: fields of `Surface`, by which channels, and whether by
their squares, as α = roughness² needs it."""


@record
@dataclass
class Surface:
    """What the paths of a batch hit, as component arrays; all vectors are in world space.

    geometric_normal and normal lie on the side of `outgoing`, the direction back along
    the ray. front: whether that is the triangle's front, float32 of 0 or 1.
    offset: distance by which new rays leave along ±geometric_normal. facing: float32, 0 where a
    shading normal faced away from `outgoing` and gave way, else 1. alpha and
    clearcoat_alpha are GGX's α. A field that may be None is so where no material of the
    scene has the term: specular colours other than white, a clear coat. clearcoat_normal
    is as normal, and None also where every coat's is that of what is beneath.
    """

    position: Tensor
    outgoing: Tensor
    geometric_normal: Tensor
    normal: Tensor
    front: Tensor
    offset: Tensor
    facing: Tensor
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
    clearcoat_normal: Tensor | None = None

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
        meshes = scene.meshes
        vertices, corners = triangles.joined(meshes)
        self.tracer = Tracer(vertices, corners)
        self._vertices, self._corners = self._rows(vertices), self._rows(corners)
        self.materials = Materials(scene.materials, meshes, self.device)
        counts = torch.tensor([len(mesh.triangles) for mesh in meshes])
        numbers = torch.tensor([mesh.material for mesh in meshes], dtype=torch.int32)
        self.material = torch.repeat_interleave(numbers, counts).to(self.device)
        """Material of each triangle, int32 `[T]`."""
        self._normals = self._rows(triangles.normal_rows(meshes))
        self._targets = [(slot, targets) for slot, targets in TARGETS.items() if slot in self.materials.slots]
        self._uvs = self._colors = None
        if self.materials.atlas.uv_sets:
            self._uvs = self._rows(triangles.uv_rows(meshes, self.materials.atlas.uv_sets)).flatten(1)
        if any(mesh.colors is not None for mesh in meshes):
            self._colors = self._rows(triangles.color_rows(meshes))
        self._tangents = {}
        for slot in self.materials.normal_scales:
            normal_maps = [getattr(material, f"{slot}_texture") for material in scene.materials]
            self._tangents[slot] = self._rows(triangles.tangent_rows(meshes, normal_maps))

    def _rows(self, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(rows).to(self.device)

    def corners(self, triangle: Tensor) -> Tensor:
        """Vertex positions `[corner, component, N]` of triangles `[N]`."""
        corners = self._corners.index_select(0, triangle)
        return self._vertices.index_select(0, corners.flatten()).view(-1, 3, 3).permute(1, 2, 0).contiguous()

    def corner_normals(self, triangle: Tensor) -> Tensor:
        """Shading normals `[corner, component, N]` at the corners of triangles `[N]`."""
        first, second, third = self._normals[3:12].index_select(1, triangle).view(3, 3, -1)
        return torch.stack((first, first + second, first + third))

    def areas(self, triangle: Tensor) -> Tensor:
        """Areas `[N]` of triangles `[N]`."""
        corners = self.corners(triangle)
        return 0.5 * length(cross(corners[1] - corners[0], corners[2] - corners[0]))

    def face_normals(self, triangle: Tensor) -> Tensor:
        """Unit geometric normals `[3, N]` on the front of triangles `[N]`."""
        return self._normals[0:3].index_select(1, triangle)

    def is_double_sided(self, triangle: Tensor) -> Tensor:
        """1 where triangles `[N]` emit from both faces, else 0; float32 `[N]`."""
        return self.materials.emission[3].index_select(0, self.material.index_select(0, triangle))

    def surface(self, origins: Tensor, directions: Tensor, hit: Hit) -> Surface:
        """The surfaces at valid hits of rays `[3, N]`."""
        rows = self._normals.index_select(1, hit.triangle)
        sides = _sides(rows, origins, directions, hit)
        material = self.material.index_select(0, hit.triangle)
        values = self.materials.parameters.index_select(1, material)
        surface = Surface(*sides, values[0:3], *values[3:])
        if self.materials.specular_color is not None:
            surface.specular_color = self.materials.specular_color.index_select(1, material)
        if self.materials.clearcoat is not None:
            surface.clearcoat, surface.clearcoat_alpha = self.materials.clearcoat.index_select(1, material)
        if self.materials.tilts_coats:
            surface.clearcoat_normal = surface.normal.clone()
        self._paint(surface, hit, material)
        surface.alpha.clamp_(min=MIN_ALPHA)
        if surface.clearcoat_alpha is not None:
            surface.clearcoat_alpha.clamp_(min=MIN_ALPHA)
        return surface

    def _paint(self, surface: Surface, hit: Hit, material: Tensor) -> None:
        """Multiply the factors by what vertex colours and textures say, and bend the normals, in place."""
        if self._colors is not None:
            surface.base_color *= self._color(hit)[0:3]
        for slot, targets in self._targets:
            index, texel, _ = self._texels(slot, hit, material)
            for field, channels, squared in targets if len(index) > 0 else ():
                factor = texel[channels].square() if squared else texel[channels]
                values = getattr(surface, field)
                put(values, index, values.index_select(-1, index) * factor)
        for slot, scales in self.materials.normal_scales.items():
            index, texel, mapped = self._texels(slot, hit, material)
            if len(index) > 0:
                texel[0:2] *= scales.index_select(1, material.index_select(0, index))
                self._bend_normals(slot, surface, hit, index, texel, mapped)

    def _bend_normals(
        self, slot: str, surface: Surface, hit: Hit, index: Tensor, tangent_space: Tensor, mapped: Tensor
    ) -> None:
        """Bend the shading normals of the hits at `index` that are `mapped`, bool `[K]`, to what the slot's maps give in tangent space
        `[.., K]`."""
        rows = self._tangents[slot].index_select(1, hit.triangle.index_select(0, index))
        normal = getattr(surface, slot).index_select(1, index)
        tangent = _interpolate(rows[0:9], hit.u.index_select(0, index), hit.v.index_select(0, index))
        tangent = normalize(tangent - normal * dot(normal, tangent))  # none stays 0 and leaves the normal as it is
        # On the back the whole vector turns round; `normal` has, and so has the bitangent with it.
        side = 2.0 * surface.front.index_select(0, index) - 1.0
        x, y, z = tangent_space[0] * side, tangent_space[1] * rows[9], tangent_space[2]
        bent = normalize(x * tangent + y * cross(normal, tangent) + z * normal)
        facing = (dot(bent, surface.outgoing.index_select(1, index)) > MIN_FACING).to(torch.float32)
        put_where(mapped, surface.facing, index, surface.facing.index_select(0, index) * facing)
        put_where(mapped, getattr(surface, slot), index, bent * facing + normal * (1.0 - facing))

    def own_normals(self, surface: Surface, hit: Hit) -> list[Tensor]:
        """All shading normals `[3, N]` of surfaces at hits that give way where they face away, as they are where none has."""
        normals = [surface.normal]
        if surface.clearcoat_normal is not None:
            normals.append(surface.clearcoat_normal)
        if self.materials.normal_scales:  # what is bent gives way to these, and these to the geometry
            rows = self._normals.index_select(1, hit.triangle)
            normals.append(_interpolated_normal(rows, hit, surface.geometric_normal))
        return normals

    def _color(self, hit: Hit) -> Tensor:
        """Vertex colours `[4, N]`."""
        return _interpolate(self._colors.index_select(1, hit.triangle), hit.u, hit.v)

    def _texels(self, slot: str, hit: Hit, material: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where hits on `material` `[N]` may have a texture in the slot (see `worthwhile`), int64 `[K]`; its RGBA there `[4, K]`, 1 where
        there is none; and whether there is one, bool `[K]`."""
        index, number = self.materials.textured(slot, material)
        mapped, number = number >= 0, number.clamp(min=0)
        if len(index) == 0:
            return index, torch.empty(4, 0, device=self.device), mapped
        triangle = hit.triangle.index_select(0, index)
        if len(self.materials.atlas.uv_sets) > 1:
            triangle = triangle + len(self.material) * self.materials.atlas.uv_set.index_select(0, number)
        uv = _interpolate(self._uvs.index_select(1, triangle), hit.u.index_select(0, index), hit.v.index_select(0, index))
        return index, torch.where(mapped, self.materials.atlas.lookup(number, uv), 1.0), mapped

    def emission(self, hit: Hit, front: Tensor, direction: Tensor | None) -> Tensor:
        """Radiance `[3, N]` that hits emit towards unit `direction` `[3, N]`, the viewer.

        It leaves the front, or both faces of a double-sided material, through the clear coat
        if there is one. direction None asks for what cones emit along their axes and what is
        beneath coats. Opacity is the caller's to apply.
        """
        radiance = emitted(self.emission_rows(hit.triangle), front)
        return radiance if self.materials.plain_emission else radiance * self.emission_share(hit, direction)

    def emission_rows(self, triangle: Tensor) -> Tensor:
        """Rows `[4, N]` of triangles `[N]` for `emitted`."""
        return self.materials.emission.index_select(1, self.material.index_select(0, triangle))

    def emission_share(self, hit: Hit, direction: Tensor | None) -> Tensor:
        """What cones, textures, vertex colours and clear coats leave of the emission of materials at hits, `[3, N]`;
        direction: as in `emission`."""
        material = self.material.index_select(0, hit.triangle)
        share = self.materials.cone(material, direction).expand(3, -1).clone()
        index, texel, _ = self._texels("emission", hit, material)
        if len(index) > 0:
            share[:, index] *= texel[0:3]
        if self._colors is not None:
            tinted = self.materials.tinted.index_select(0, material)
            index = worthwhile(tinted)
            if len(index) > 0:
                color = self._color(Hit(*(field.index_select(0, index) for field in hit)))[0:3]
                put_where(tinted.index_select(0, index), share, index, share.index_select(1, index) * color)
        if self.materials.clearcoat is not None and direction is not None:
            share *= self._through_clearcoat(hit, material, direction)
        return share

    def _through_clearcoat(self, hit: Hit, material: Tensor, direction: Tensor) -> Tensor:
        """Share `[N]` of the emission that passes the clear coat, 1 where there is none (KHR_materials_clearcoat)."""
        weight = self.materials.clearcoat[0].index_select(0, material)
        index, texel, _ = self._texels("clearcoat", hit, material)
        if len(index) > 0:
            weight[index] *= texel[0]
        normal = normalize(_interpolate(self._normals[3:12].index_select(1, hit.triangle), hit.u, hit.v))
        grazing = fifth_power(1.0 - dot(normal, direction).abs().clamp(max=1.0))
        return 1.0 - weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)

    def is_sheer(self, triangle: Tensor) -> Tensor:
        """Whether triangles `[N]` let light through somewhere, bool `[N]`."""
        return self.materials.sheer.index_select(0, self.material.index_select(0, triangle))

    def opacity(self, hit: Hit) -> Tensor:
        """Share of the light that surfaces stop at hits `[N]`, 1 on opaque materials."""
        material = self.material.index_select(0, hit.triangle)
        coverage = torch.ones_like(hit.u) if self._colors is None else self._color(hit)[3]
        index, texel, _ = self._texels("base_color", hit, material)
        if len(index) > 0:
            coverage[index] *= texel[3]
        return self.materials.opacity(material, coverage)

    def transmittance(self, hit: Hit, front: Tensor) -> Tensor | None:
        """What solids leave `[3, N]` of the light on the ways that end at hits; None where none absorbs."""
        if not self.materials.absorbs:
            return None
        return self.materials.transmittance(self.material.index_select(0, hit.triangle), front, hit.distance)


@kernel
def _sides(rows: Tensor, origins: Tensor, directions: Tensor, hit: Hit) -> tuple[Tensor, ...]:
    """The fields of `Surface` up to `facing`, from the triangles' normals `[12, N]`."""
    geometric, outgoing = rows[0:3], -directions
    side = dot(geometric, outgoing)
    front = (side > 0.0).to(torch.float32)
    geometric = geometric * torch.copysign(torch.ones_like(side), side)
    normal = _interpolated_normal(rows, hit, geometric)
    # A shading normal that faces away from the viewer gives way to the geometric one.
    facing = (dot(normal, outgoing) > MIN_FACING).to(torch.float32)
    normal = normal * facing + geometric * (1.0 - facing)
    position = origins + hit.distance * directions
    return position, outgoing, geometric, normal, front, leaving_distance(position, hit.distance), facing


def _interpolated_normal(rows: Tensor, hit: Hit, geometric: Tensor) -> Tensor:
    """Shading normals `[3, N]` from the triangles' normals `[12, N]`, on the side of the geometric ones."""
    normal = _interpolate(rows[3:12], hit.u, hit.v)
    side = dot(normal, geometric)
    return normalize(normal * torch.copysign(torch.ones_like(side), side))


def leaving_distance(position: Tensor, distance: Tensor) -> Tensor:
    """How far `[N]` from `position` `[3, N]`, found after `distance`, a new ray starts clear of the surface."""
    return OFFSET * (position.abs().amax(0) + distance)


def emitted(rows: Tensor, front: Tensor) -> Tensor:
    """Radiance `[3, N]` that materials emit: their emission and 1 where it leaves both faces, `[4, N]`; front: `[N]`, as in `Surface`."""
    return rows[0:3] * torch.maximum(front, rows[3])


def _interpolate(rows: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Values `[C, N]` from rows `[3 C, N]` of first corners and differences."""
    count = rows.shape[0] // 3
    return rows[0:count] + u * rows[count : 2 * count] + v * rows[2 * count :]
