"""Triangles and materials of a scene as tensors, and the surfaces at hits of rays."""

from __future__ import annotations

import logging

import numpy as np
import torch
from torch import Tensor

from bokehguide.render import triangles
from bokehguide.render.materials import CLEARCOAT_F0, Materials
from bokehguide.render.surface import MIN_ALPHA, Surface
from bokehguide.render.tracer import Hit, Tracer
from bokehguide.render.vector import cross, divisor, dot, fifth_power, length, normalize
from bokehguide.runtime.indexing import ActiveEntries
from bokehguide.scene.types import Material, Scene, Texture

log = logging.getLogger(__name__)

OFFSET = 1e-5
"""Offset of ray origins from the surface, relative to the distances involved."""
MIN_FACING = 1e-4
"""Smallest cosine between a shading normal and the direction to the viewer."""
TARGETS = {
    "base_color": (("base_color", slice(0, 3), False),),
    "metallic_roughness": (("alpha", 1, True), ("metallic", 2, False)),
    "specular": (("specular", 3, False),),
    "specular_color": (("specular_color", slice(0, 3), False),),
    "transmission": (("transmission", 0, False),),
    "clearcoat": (("clearcoat", 0, False),),
    "clearcoat_roughness": (("clearcoat_alpha", 1, True),),
    "sheen_color": (("sheen_color", slice(0, 3), False),),
    "sheen_roughness": (("sheen_roughness", 3, False),),
    "iridescence": (("iridescence", 0, False),),
    "diffuse_transmission": (("diffuse_transmission", 3, False),),
    "diffuse_transmission_color": (("transmission_color", slice(0, 3), False),),
}
"""For each texture slot: the fields of `Surface` that the texture multiplies, the channels of the texture, and whether the
channels are squared, because α = roughness²."""


class Geometry:
    """Triangles, materials and textures of a scene, and the Embree tracer over them.

    threads: see `Tracer`.
    """

    def __init__(self, scene: Scene, device: torch.device | str = "cpu", threads: int = 1):
        self.device = torch.device(device)
        meshes = scene.meshes
        count = sum(len(mesh.triangles) for mesh in meshes)
        log.info("preparing %s triangles and %s materials", f"{count:,}", f"{len(scene.materials):,}")
        vertices, corners = triangles.joined(meshes)
        self.tracer = Tracer(vertices, corners, threads)
        self.vertices, self.vertex_numbers = self._rows(vertices), self._rows(corners)
        self.materials = Materials(scene.materials, meshes, self.device)
        counts = torch.tensor([len(mesh.triangles) for mesh in meshes])
        numbers = torch.tensor([mesh.material for mesh in meshes], dtype=torch.int32)
        self.material = torch.repeat_interleave(numbers, counts).to(self.device)
        """Material of each triangle, int32 `[T]`."""
        self.normals = self._rows(triangles.normal_rows(meshes))
        self._targets = [(slot, targets) for slot, targets in TARGETS.items() if slot in self.materials.slots]
        self.uvs: Tensor | None = None
        self.colors: Tensor | None = None
        if self.materials.atlas.uv_sets:
            self.uvs = self._rows(triangles.uv_rows(meshes, self.materials.atlas.uv_sets)).flatten(1)
        if any(mesh.colors is not None for mesh in meshes):
            self.colors = self._rows(triangles.color_rows(meshes))
        self.tangents = {}
        for slot in self.materials.normal_scales:
            normal_maps = [getattr(material, f"{slot}_texture") for material in scene.materials]
            self.tangents[slot] = self._rows(triangles.tangent_rows(meshes, normal_maps))
        if self.materials.anisotropy is not None:
            self.tangents["anisotropy"] = self._rows(
                triangles.tangent_rows(meshes, list(map(_brushed, scene.materials)), smooth=True)
            )

    def _rows(self, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(rows).to(self.device)

    def corners(self, triangle: Tensor) -> Tensor:
        """Vertex positions `[corner, component, N]` of triangles `[N]`."""
        corners = self.vertex_numbers.index_select(0, triangle)
        return self.vertices.index_select(0, corners.flatten()).view(-1, 3, 3).permute(1, 2, 0).contiguous()

    def corner_normals(self, triangle: Tensor) -> Tensor:
        """Shading normals `[corner, component, N]` at the corners of triangles `[N]`."""
        first, second, third = self.normals[3:12].index_select(1, triangle).view(3, 3, -1)
        return torch.stack((first, first + second, first + third))

    def areas(self, triangle: Tensor) -> Tensor:
        """Areas `[N]` of triangles `[N]`."""
        corners = self.corners(triangle)
        return 0.5 * length(cross(corners[1] - corners[0], corners[2] - corners[0]))

    def face_normals(self, triangle: Tensor) -> Tensor:
        """Unit geometric normals `[3, N]` on the front of triangles `[N]`."""
        return self.normals[0:3].index_select(1, triangle)

    def is_double_sided(self, triangle: Tensor) -> Tensor:
        """1 where triangles `[N]` emit from both faces, else 0; float32 `[N]`."""
        return self.materials.emission[3].index_select(0, self.material.index_select(0, triangle))

    def surface(self, origins: Tensor, directions: Tensor, hit: Hit) -> Surface:
        """Surfaces at the hits of rays `[3, N]`; every ray must have a hit."""
        rows = self.normals.index_select(1, hit.triangle)
        sides = _sides(rows, origins, directions, hit)
        material = self.material.index_select(0, hit.triangle)
        values = self.materials.parameters.index_select(1, material)
        fields = [*sides, values[0:3], *values[3:]]
        surface = Surface(*fields)
        if self.materials.specular_color is not None:
            surface.specular_color = self.materials.specular_color.index_select(1, material)
        if self.materials.clearcoat is not None:
            surface.clearcoat, surface.clearcoat_alpha = self.materials.clearcoat.index_select(1, material)
        if self.materials.tilts_coats:
            surface.clearcoat_normal = surface.normal.clone()
        if self.materials.sheen is not None:
            rows = self.materials.sheen.index_select(1, material)
            surface.sheen_color, surface.sheen_roughness = rows[0:3], rows[3]
        if self.materials.diffuse_transmission is not None:
            rows = self.materials.diffuse_transmission.index_select(1, material)
            surface.diffuse_transmission, surface.transmission_color = rows[0], rows[1:4]
        if self.materials.film is not None:
            rows = self.materials.film.index_select(1, material)
            surface.iridescence, surface.film_ior, surface.film_thickness = rows[0], rows[1], rows[3]
        if self.materials.dispersion is not None:
            surface.dispersion = self.materials.dispersion[0].index_select(0, material)
        if self.materials.single_scattering is not None:
            surface.single_scattering = self.materials.single_scattering[0].index_select(0, material)
        self._apply_textures(surface, hit, material)
        if self.materials.has_transmission:
            _separate_glass(surface)
        surface.alpha.clamp_(min=MIN_ALPHA)
        if surface.clearcoat_alpha is not None:
            surface.clearcoat_alpha.clamp_(min=MIN_ALPHA)
        if self.materials.anisotropy is not None:
            self._apply_anisotropy(surface, hit, material)
        return surface

    def _apply_textures(self, surface: Surface, hit: Hit, material: Tensor) -> None:
        """Multiply parameters by vertex colours and textures, and apply normal maps, in place."""
        if self.colors is not None:
            surface.base_color *= self._color(hit)[0:3]
        for slot, targets in self._targets:
            textured, texel = self._texels(slot, hit, material)
            for field, channels, squared in targets if len(textured) > 0 else ():
                factor = texel[channels].square() if squared else texel[channels]
                values = getattr(surface, field)
                textured.scatter(values, textured.select(values) * factor)
        if surface.film_thickness is not None and self.materials.film is not None:
            textured, texel = self._texels("iridescence_thickness", hit, material)
            if len(textured) > 0:
                least, most = self.materials.film[2:4].index_select(1, textured.select(material))
                textured.scatter(surface.film_thickness, least + (most - least) * texel[1])
        for slot, scales in self.materials.normal_scales.items():
            mapped, texel = self._texels(slot, hit, material)
            if len(mapped) > 0:
                texel[0:2] *= scales.index_select(1, mapped.select(material))
                self._apply_normal_map(slot, surface, hit, mapped, texel)

    def _apply_normal_map(self, slot: str, surface: Surface, hit: Hit, mapped: ActiveEntries, tangent_space: Tensor) -> None:
        """Replace the shading normals of the `mapped` hits by those of the slot's maps, in tangent space `[.., K]`."""
        rows = self.tangents[slot].index_select(1, mapped.select(hit.triangle))
        normal = mapped.select(getattr(surface, slot))
        tangent = _interpolate(rows[0:9], mapped.select(hit.u), mapped.select(hit.v))
        tangent = normalize(tangent - normal * dot(normal, tangent))  # a missing tangent stays 0 and leaves the normal unchanged
        # On the back of a triangle, all three axes are reversed. `normal` and the bitangent are already reversed.
        side = 2.0 * mapped.select(surface.front) - 1.0
        x, y, z = tangent_space[0] * side, tangent_space[1] * rows[9], tangent_space[2]
        bent = normalize(x * tangent + y * cross(normal, tangent) + z * normal)
        facing = (dot(bent, mapped.select(surface.outgoing)) > MIN_FACING).to(torch.float32)
        mapped.scatter(surface.facing, mapped.select(surface.facing) * facing)
        mapped.scatter(getattr(surface, slot), bent * facing + normal * (1.0 - facing))

    def _apply_anisotropy(self, surface: Surface, hit: Hit, material: Tensor) -> None:
        """Set the direction of the larger roughness, and this roughness (KHR_materials_anisotropy)."""
        assert self.materials.anisotropy is not None
        strength, cosine, sine = self.materials.anisotropy.index_select(1, material)
        x, y = torch.ones_like(hit.u), torch.zeros_like(hit.u)
        textured, texel = self._texels("anisotropy", hit, material)
        if len(textured) > 0:
            size = (texel[0].square() + texel[1].square()).clamp(min=1e-12).rsqrt()
            textured.scatter(x, texel[0] * size)
            textured.scatter(y, texel[1] * size)
            textured.scatter(strength, textured.select(strength) * (0.5 * texel[2] + 0.5))
        x, y = x * cosine - y * sine, x * sine + y * cosine
        rows = self.tangents["anisotropy"].index_select(1, hit.triangle)
        normal = surface.normal
        tangent = _interpolate(rows[0:9], hit.u, hit.v)
        tangent = normalize(tangent - normal * dot(normal, tangent))
        side = 2.0 * surface.front - 1.0  # on the back, the normal is reversed, and with it the bitangent
        surface.tangent = x * side * tangent + y * rows[9] * cross(normal, tangent)
        surface.alpha_along = surface.alpha + (1.0 - surface.alpha) * strength.square()

    def own_normals(self, surface: Surface, hit: Hit) -> list[Tensor]:
        """All shading normals `[3, N]` at hits that face the viewer, and that another view may have to replace."""
        normals = [surface.normal]
        if surface.clearcoat_normal is not None:
            normals.append(surface.clearcoat_normal)
        if self.materials.normal_scales:  # they replace mapped normals, and geometric normals replace them
            rows = self.normals.index_select(1, hit.triangle)
            normals.append(_interpolated_normal(rows, hit, surface.geometric_normal))
        return normals

    def _color(self, hit: Hit) -> Tensor:
        """Vertex colours `[4, N]`."""
        assert self.colors is not None
        return _interpolate(self.colors.index_select(1, hit.triangle), hit.u, hit.v)

    def _texels(self, slot: str, hit: Hit, material: Tensor) -> tuple[ActiveEntries, Tensor]:
        """The K hits on `material` `[N]` with a texture in the slot, and the texture's RGBA `[4, K]`, 1 at inactive hits."""
        textured, number = self.materials.textured(slot, material)
        if len(textured) == 0:
            return textured, torch.empty(4, 0, device=self.device)
        assert self.uvs is not None
        triangle = textured.select(hit.triangle)
        if len(self.materials.atlas.uv_sets) > 1:
            triangle = triangle + len(self.material) * self.materials.atlas.uv_set.index_select(0, number)
        uv = _interpolate(self.uvs.index_select(1, triangle), textured.select(hit.u), textured.select(hit.v))
        return textured, textured.masked(self.materials.atlas.lookup(number, uv), 1.0)

    def emission(self, hit: Hit, front: Tensor, direction: Tensor | None) -> Tensor:
        """Radiance `[3, N]` that hits emit in unit directions `[3, N]`, unshadowed.

        Light leaves the front of a triangle, or both faces of a double-sided material. A clearcoat dims the light. direction
        None: radiance along the axes of emission cones, without the effect of clearcoats.
        """
        radiance = emitted(self.emission_rows(hit.triangle), front)
        return radiance if self.materials.plain_emission else radiance * self.emission_share(hit, direction)

    def emission_rows(self, triangle: Tensor) -> Tensor:
        """Rows `[4, N]` of triangles `[N]` for `emitted`."""
        return self.materials.emission.index_select(1, self.material.index_select(0, triangle))

    def emission_share(self, hit: Hit, direction: Tensor | None) -> Tensor:
        """Factor `[3, N]` by which cones, textures, vertex colours and clearcoats change the emission of materials at hits.

        direction: as in `emission`.
        """
        material = self.material.index_select(0, hit.triangle)
        share = self.materials.cone(material, direction).expand(3, -1).clone()
        textured, texel = self._texels("emission", hit, material)
        if len(textured) > 0:
            share[:, textured.index] *= texel[0:3]
        if self.colors is not None:
            tinted = ActiveEntries(self.materials.tinted.index_select(0, material))
            if len(tinted) > 0:
                tinted.scatter(share, tinted.select(share) * self._color(Hit(*map(tinted.select, hit)))[0:3])
        if self.materials.clearcoat is not None and direction is not None:
            share *= self._through_clearcoat(hit, material, direction)
        return share

    def _through_clearcoat(self, hit: Hit, material: Tensor, direction: Tensor) -> Tensor:
        """Transmittance `[N]` of the clearcoat for emission, 1 without one (KHR_materials_clearcoat)."""
        assert self.materials.clearcoat is not None
        weight = self.materials.clearcoat[0].index_select(0, material)
        textured, texel = self._texels("clearcoat", hit, material)
        if len(textured) > 0:
            weight[textured.index] *= texel[0]
        normal = normalize(_interpolate(self.normals[3:12].index_select(1, hit.triangle), hit.u, hit.v))
        grazing = fifth_power(1.0 - dot(normal, direction).abs().clamp(max=1.0))
        return 1.0 - weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)

    def is_translucent(self, triangle: Tensor) -> Tensor:
        """Whether triangles `[N]` have translucent materials, bool `[N]`."""
        return self.materials.translucent.index_select(0, self.material.index_select(0, triangle))

    def opacity(self, hit: Hit) -> Tensor:
        """Opacity `[N]` at hits, 1 on opaque materials."""
        material = self.material.index_select(0, hit.triangle)
        coverage = torch.ones_like(hit.u) if self.colors is None else self._color(hit)[3]
        textured, texel = self._texels("base_color", hit, material)
        if len(textured) > 0:
            coverage[textured.index] *= texel[3]
        return self.materials.opacity(material, coverage)

    def transmittance(self, hit: Hit, front: Tensor) -> Tensor | None:
        """Transmittance `[3, N]` of solids along the rays that end at hits; None if no solid of the scene absorbs light."""
        if not self.materials.absorbs:
            return None
        return self.materials.transmittance(self.material.index_select(0, hit.triangle), front, hit.distance)


def _separate_glass(surface: Surface) -> None:
    """Set the share of the transmissive part, and the share of metal in the opaque part alone.

    In glTF, a metal of the share m covers what is transmissive by the factor t. The transmissive part is t (1 - m) of the whole,
    and the metal m.
    """
    surface.transmission = surface.transmission * (1.0 - surface.metallic)
    surface.metallic = (surface.metallic / divisor(1.0 - surface.transmission, 1e-6)).clamp(max=1.0)


def _brushed(material: Material) -> Texture | None:
    """The texture by which the tangents of an anisotropic material run, None for another material."""
    if material.anisotropy == 0.0:
        return None
    return material.anisotropy_texture or material.normal_texture or Texture(np.ones((1, 1, 3), np.float32))


def _sides(rows: Tensor, origins: Tensor, directions: Tensor, hit: Hit) -> tuple[Tensor, ...]:
    """The first fields of `Surface`, up to `facing`, from the normals of triangles `[12, N]`."""
    geometric, outgoing = rows[0:3], -directions
    side = dot(geometric, outgoing)
    front = (side > 0.0).to(torch.float32)
    geometric = geometric * torch.copysign(torch.ones_like(side), side)
    normal = _interpolated_normal(rows, hit, geometric)
    # The geometric normal replaces a shading normal that faces away from the viewer.
    facing = (dot(normal, outgoing) > MIN_FACING).to(torch.float32)
    normal = normal * facing + geometric * (1.0 - facing)
    position = origins + hit.distance * directions
    return position, outgoing, geometric, normal, front, leaving_distance(position, hit.distance), facing


def _interpolated_normal(rows: Tensor, hit: Hit, geometric: Tensor) -> Tensor:
    """Shading normals `[3, N]` from the normals of triangles `[12, N]`, on the side of the geometric normals."""
    normal = _interpolate(rows[3:12], hit.u, hit.v)
    side = dot(normal, geometric)
    return normalize(normal * torch.copysign(torch.ones_like(side), side))


def leaving_distance(position: Tensor, distance: Tensor) -> Tensor:
    """Offset `[N]` of a new ray from `position` `[3, N]`, which a ray met after `distance` `[N]`."""
    return OFFSET * (position.abs().amax(0) + distance)


def emitted(rows: Tensor, front: Tensor) -> Tensor:
    """Radiance `[3, N]` that materials emit.

    rows: emission, and 1 for emission from both faces, else 0, `[4, N]`; front: as in `Surface`, `[N]`.
    """
    return rows[0:3] * torch.maximum(front, rows[3])


def _interpolate(rows: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Values `[C, N]` from rows `[3 C, N]` of first corners and differences."""
    count = rows.shape[0] // 3
    return rows[0:count] + u * rows[count : 2 * count] + v * rows[2 * count :]
