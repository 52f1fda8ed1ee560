"""Vectors as component arrays: a batch of N vectors is one `[3, N]` tensor.

Component arrays keep every operation contiguous. Code avoids `torch.linalg.vector_norm` and `torch.where`: on a CPU, either costs
tens of multiplications.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.color import LUMINANCE_WEIGHTS


def divisor(x: Tensor, least: float = 1e-30) -> Tensor:
    """Non-negative values of any shape as divisors, at least `least`.

    A quotient 0 / 0 becomes 0, and no other quotient overflows.
    """
    return x.clamp(min=least)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot products of `[3, N]` vectors, `[N]`."""
    return torch.linalg.vecdot(a, b, dim=0)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of `[3, N]` vectors, `[3, N]`."""
    ax, ay, az = a.unbind(0)
    bx, by, bz = b.unbind(0)
    return torch.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def length(a: Tensor) -> Tensor:
    """Lengths of `[3, N]` vectors, `[N]`."""
    return dot(a, a).sqrt()


def normalize(a: Tensor) -> Tensor:
    """Unit vectors `[3, N]`; a zero vector stays zero."""
    return a * divisor(dot(a, a), 1e-37).rsqrt()


def polar_angle(y: Tensor, x: Tensor) -> Tensor:
    """Angle `[N]` of `torch.atan2`, but with a last bit that does not depend on the position in the batch or on the crop."""
    acute = (y / divisor(x.abs())).atan()
    return torch.where(x < 0.0, torch.copysign(torch.full_like(y, math.pi), y) - acute, acute)


def luminance(color: Tensor) -> Tensor:
    """Rec.709 luminance of linear `[3, N]` colours, `[N]`."""
    red, green, blue = color.unbind(0)
    of_red, of_green, of_blue = LUMINANCE_WEIGHTS
    return of_red * red + of_green * green + of_blue * blue


def fifth_power(x: Tensor) -> Tensor:
    """x⁵ of any shape, as in Schlick's approximation."""
    return x.square().square() * x


def tangent_frame(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit tangents `[3, N]` that complete `normal` to a right-handed frame.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
    x, y, z = normal.unbind(0)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = torch.stack((1.0 + sign * x * x * a, sign * b, -sign * x))
    bitangent = torch.stack((b, sign + y * y * a, -y))
    return tangent, bitangent


def aligned_frame(normal: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit tangents `[3, N]` as of `tangent_frame`; the first is `along` `[3, N]`, projected along the normal.

    Where the projection is 0, the first tangent is arbitrary.
    """
    projected = along - normal * dot(normal, along)
    known = (dot(projected, projected) > 1e-12).to(torch.float32)
    tangent = tangent_frame(normal)[0]
    tangent = tangent + (normalize(projected) - tangent) * known
    return tangent, cross(normal, tangent)


def to_world(local: Tensor, tangent: Tensor, bitangent: Tensor, normal: Tensor) -> Tensor:
    """Local `[3, N]` coordinates (z along the normal) to world space."""
    return local[0] * tangent + local[1] * bitangent + local[2] * normal


def to_local(world: Tensor, tangent: Tensor, bitangent: Tensor, normal: Tensor) -> Tensor:
    """World `[3, N]` coordinates to the local frame (z along the normal)."""
    return torch.stack((dot(world, tangent), dot(world, bitangent), dot(world, normal)))
