"""Polynomial 3D Gaussians: an offset of each mean that depends on the pixel (Eq. 27-29)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.kernels import kernel

DEGREE = 2
EXPONENTS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]


def monomials(position: Tensor) -> Tensor:
    """x^i y^j for i + j ≤ 2, `[6, N]`, at `[2, N]`."""
    x, y = position.unbind(0)
    return torch.stack([x**i * y**j for i, j in EXPONENTS])


class PolynomialOffset(nn.Module):
    """D(x_r), the offset of each Gaussian's mean as a polynomial of the raster position.

    The polynomial's argument is (raster - the Gaussian's pinhole centre) / its radius on
    the raster, and D is in units of the Gaussian's R_b, so that one learning rate suits
    every scene and resolution. It starts at 0. Every Gaussian in view is drawn from by
    many pixels in every step; one that is not has a zero gradient in that step, and Adam's
    momentum may still move it.

    coefficients: `[3, 6, G]`, component by monomial by Gaussian.
    """

    def __init__(self, field: GaussianField, camera: ThinLensCamera):
        super().__init__()
        center, radius = field.footprints(camera)
        self.register_buffer("center", center)
        self.register_buffer("inverse_radius", 1.0 / radius)
        self.register_buffer("unit", field.radius.clone())
        self.coefficients = nn.Parameter(torch.zeros(3, len(EXPONENTS), len(field), device=center.device))

    def basis(self, gaussian: Tensor, raster: Tensor) -> Tensor:
        """R_b times the monomials `[6, N]`: ∂D / ∂a of Eq. 29, for Gaussians `[N]` at raster positions `[2, N]`."""
        return _basis(self.center, self.inverse_radius, self.unit, gaussian, raster)

    def forward(self, gaussian: Tensor, raster: Tensor) -> Tensor:
        """Offsets in metres `[3, N]` of Gaussians int `[N]` seen from raster positions `[2, N]`."""
        rows = self.coefficients.reshape(-1, self.coefficients.shape[-1])
        return _offset(rows, gaussian, self.basis(gaussian, raster))


@kernel
def _basis(center: Tensor, inverse_radius: Tensor, unit: Tensor, gaussian: Tensor, raster: Tensor) -> Tensor:
    center, inverse_radius, unit = (of_field.index_select(-1, gaussian) for of_field in (center, inverse_radius, unit))
    return monomials(((raster - center) * inverse_radius).clamp(-2.0, 2.0)) * unit


@kernel
def _offset(rows: Tensor, gaussian: Tensor, basis: Tensor) -> Tensor:
    """Sums `[3, N]` of the basis `[6, N]` times the coefficients `[18, G]` of Gaussians `[N]`."""
    rows = rows.index_select(1, gaussian)
    # Term by term: `sum` of more than four rows rounds the last elements of an array otherwise.
    return torch.stack([sum(a * monomial for a, monomial in zip(component, basis)) for component in rows.chunk(3)])
