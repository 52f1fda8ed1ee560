"""Reflectance of a thin film over a surface (KHR_materials_iridescence).

Interference in a film is integrated over the spectrum analytically (Belcour and Barla 2017), with Schlick's reflectances of both
interfaces as in the extension. The optical path difference is 2 η d cos θ₂, with the angle θ₂ inside the film. The conversion to
Rec.709 can exceed the reflectance of both interfaces in phase. This reflectance is the upper bound here.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bokehguide.render.vector import fifth_power

# Gaussian fits of the colour matching functions X, Y and Z in Fourier space: amplitude, position (rad/m), variance (rad²/m²).
FITS = ((5.4856e-13, 1.6810e6, 4.3278e9), (4.4201e-13, 1.7953e6, 9.3046e9), (5.2481e-13, 2.2084e6, 6.6121e9))
SECOND_LOBE_OF_X = (9.7470e-14, 2.2399e6, 4.5282e9)
WHITE_POINT = 1.0685e-7
TO_REC709 = ((3.2404542, -1.5371385, -0.4985314), (-0.9692660, 1.8760108, 0.0415560), (0.0556434, -0.2040259, 1.0572252))
THINNEST = 0.03
"""Nanometres over which a film appears."""


def film_reflectance(f0: Tensor, ior: Tensor, thickness: Tensor, cosine: Tensor) -> Tensor:
    """Reflectance `[3, N]` in air.

    f0: of the surface without a film, `[3, N]`; ior, thickness: of the film, the latter in nm, `[N]`; cosine: between ray and
    normal, `[N]`.
    """
    ior = film_ior(ior, thickness)
    first, second, inside = _interfaces(f0, ior, cosine)
    shift = math.pi * ((ior >= 1.0).float() + (base_ior(f0) < ior).float())
    passed, both = 1.0 - first, (first * second).clamp(1e-5, 0.9999)
    returned = passed.square() * second / (1.0 - both)
    total, order = first + returned, returned - passed
    difference = 2.0 * ior * thickness * inside
    for number in (1.0, 2.0):
        order = order * both.sqrt()
        total = total + 2.0 * order * _sensitivity(number * difference, number * shift)
    return torch.minimum(total.clamp(min=0.0), _in_phase(first, second))


def film_bound(f0: Tensor, ior: Tensor, thickness: Tensor, cosine: Tensor) -> Tensor:
    """Upper bound `[N]` of the reflectance in the largest channel, which grows towards grazing angles."""
    first, second, _ = _interfaces(f0, film_ior(ior, thickness), cosine)
    return _in_phase(first, second).amax(0)


def _in_phase(first: Tensor, second: Tensor) -> Tensor:
    """Reflectance of two interfaces whose reflections add up in phase."""
    return ((first.sqrt() + second.sqrt()) / (1.0 + (first * second).sqrt())).square()


def _interfaces(f0: Tensor, ior: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Reflectances of the outer interface `[N]` and of the inner `[3, N]`, and the cosine inside the film `[N]`."""
    inside = (1.0 - (1.0 - cosine.square()) / ior.square()).clamp(min=0.0).sqrt()
    outer = ((ior - 1.0) / (ior + 1.0)).square()
    base = base_ior(f0)
    lower = ((base - ior) / (base + ior)).square()
    first = outer + (1.0 - outer) * fifth_power(1.0 - cosine)
    return first, lower + (1.0 - lower) * fifth_power(1.0 - inside), inside


def film_ior(ior: Tensor, thickness: Tensor) -> Tensor:
    """Index of refraction `[N]` of the film, which tends to that of air for films of no thickness."""
    t = (thickness / THINNEST).clamp(0.0, 1.0)
    return 1.0 + (ior - 1.0) * t * t * (3.0 - 2.0 * t)


def base_ior(f0: Tensor) -> Tensor:
    """Index of refraction `[3, N]` of the surface."""
    root = (f0 + 1e-4).clamp(max=0.9999).sqrt()
    return (1.0 + root) / (1.0 - root)


def _sensitivity(difference: Tensor, shift: Tensor) -> Tensor:
    """Response `[3, N]` in Rec.709 to a cosine fringe; difference: optical path difference in nm, `[N]`; shift: `[3, N]`."""
    phase = 2.0e-9 * math.pi * difference

    def lobe(fit: tuple[float, float, float], shift: Tensor) -> Tensor:
        amplitude, position, variance = fit
        height = amplitude * math.sqrt(2.0 * math.pi * variance) / WHITE_POINT
        return height * (position * phase + shift).cos() * (-variance * phase.square()).exp()

    x, y, z = (lobe(fit, shift[axis]) for axis, fit in enumerate(FITS))
    x = x + lobe(SECOND_LOBE_OF_X, shift[0])
    return torch.stack([red * x + green * y + blue * z for red, green, blue in TO_REC709])
