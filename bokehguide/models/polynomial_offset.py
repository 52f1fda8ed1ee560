"""Polynomial 3D Gaussians: an offset of each mean that depends on the pixel (Eq. 27-29)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera


def exponents(degree: int) -> list[tuple[int, int]]:
    """(i, j) of the monomials x^i y^j with i + j ≤ degree; 6 of them for degree 2 (Eq. 29)."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def monomials(position: Tensor, degree: int = 2) -> Tensor:
    """x^i y^j, `[K, N]`, at positions `[2, N]`, in the order of `exponents`."""
    x, y = position.unbind(0)
    return torch.stack([x**i * y**j for i, j in exponents(degree)])


class PolynomialOffset(nn.Module):
    """D(x_r), the offset of each Gaussian's mean as a polynomial of the raster position; 0 at the start.

    The argument of the polynomial is (raster position - pinhole projection of the mean) / radius of the Gaussian's disc on the
    raster. Both components are clamped to -2 … 2, as pixels outside the disc may have the Gaussian as a candidate. The
    coefficients are in units of the Gaussian's R_b. One learning rate then suits every scene and resolution. If no pixel samples
    a Gaussian in a step, its gradient is 0. Adam's momentum may still move the Gaussian.

    degree: of the polynomial. coefficients: component by monomial by Gaussian, `[3, 6, G]`.
    """

    center: Tensor
    inverse_radius: Tensor
    unit: Tensor

    def __init__(self, field: GaussianField, camera: ThinLensCamera, degree: int = 2):
        super().__init__()
        self.degree = degree
        center, radius = field.footprints(camera)
        self.register_buffer("center", center)
        self.register_buffer("inverse_radius", 1.0 / radius)
        self.register_buffer("unit", field.radius.clone())
        self.coefficients = nn.Parameter(torch.zeros(3, len(exponents(degree)), len(field), device=center.device))

    def basis(self, gaussian: Tensor, raster: Tensor) -> Tensor:
        """∂D / ∂a of Eq. 29, R_b times the monomials, `[6, N]`, for Gaussians `[N]` at raster positions `[2, N]`."""
        center, inverse_radius, unit = (
            of_field.index_select(-1, gaussian) for of_field in (self.center, self.inverse_radius, self.unit)
        )
        return monomials(((raster - center) * inverse_radius).clamp(-2.0, 2.0), self.degree) * unit

    def forward(self, gaussian: Tensor, raster: Tensor) -> Tensor:
        """Offsets `[3, N]` in metres of Gaussians int64 `[N]` at raster positions `[2, N]`."""
        basis = self.basis(gaussian, raster)
        rows, zero = self.coefficients.flatten(0, 1).index_select(1, gaussian), torch.zeros_like(basis[0])
        # Term by term, because the last bits of torch.sum over more than four rows depend on the place in an array.
        return torch.stack([sum((a * monomial for a, monomial in zip(component, basis)), zero) for component in rows.chunk(3)])
