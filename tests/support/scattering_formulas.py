"""What surfaces scatter, in float64 numpy, written from the published formulas.

Directions are `[3, N]` in the local frame, z along the normal. Independent of what is tested:
glTF 2.0 appendix B with KHR_materials_ior, _specular and _clearcoat; Walter et al. 2007.
"""

from __future__ import annotations

import numpy as np


def ggx(half: np.ndarray, alpha: float) -> np.ndarray:
    """D, `[N]`, in tan² θ as Walter et al. have it."""
    tangent2 = (half[0] ** 2 + half[1] ** 2) / half[2] ** 2
    return alpha**2 / (np.pi * half[2] ** 4 * (alpha**2 + tangent2) ** 2)


def smith_lambda(directions: np.ndarray, alpha: float) -> np.ndarray:
    """Λ of Smith's masking for GGX, `[N]`: G₁ = 1 / (1 + Λ) and G₂ = 1 / (1 + Λ + Λ)."""
    return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / directions[2] ** 2 - 1.0)) - 1.0)


def mirrors(outgoing: np.ndarray, incoming: np.ndarray, alpha: float) -> np.ndarray:
    """D G₂ / (4 cos cos), `[N]`."""
    half = outgoing + incoming
    half = half / np.linalg.norm(half, axis=0)
    masking = 1.0 / (1.0 + smith_lambda(outgoing, alpha) + smith_lambda(incoming, alpha))
    return ggx(half, alpha) * masking / (4.0 * outgoing[2] * incoming[2])


def stopped(cosine: np.ndarray, f0: float, f90: float, alpha: float) -> np.ndarray:
    """T: what a coat keeps from the layers beneath it, never less than its albedo."""
    spread = 0.06 + 0.934 / (1.0 + (alpha / 0.27) ** 3)
    return f0 + (f90 - f0) * (0.006 + spread * (1.0 - cosine) ** 5)


def brdf(
    outgoing: np.ndarray,
    incoming: np.ndarray,
    base_color=(0.8, 0.5, 0.3),
    metallic=0.0,
    roughness=0.5,
    specular=1.0,
    ior=1.5,
    specular_color=(1.0, 1.0, 1.0),
    clearcoat=0.0,
    clearcoat_roughness=0.0,
) -> np.ndarray:
    """The opaque BRDF `[3, N]` towards directions above the surface.

    The base lies under a coat that light passes twice, and all of it under the clearcoat.
    """
    alpha = max(roughness**2, 1e-3)
    half = outgoing + incoming
    schlick = (1.0 - (outgoing * half).sum(0) / np.linalg.norm(half, axis=0)) ** 5
    f0 = np.minimum(((ior - 1.0) / (ior + 1.0)) ** 2 * np.asarray(specular_color), 1.0) * specular
    peak, base = f0.max(), np.asarray(base_color)[:, None]
    coat = f0[:, None] + (specular - f0[:, None]) * schlick
    cosines = (outgoing[2], incoming[2])
    under = np.multiply(*[1.0 - stopped(cosine, peak, specular, alpha) for cosine in cosines])
    angle = (np.arange(4096) + 0.5) / 4096
    entering = 2.0 * ((1.0 - stopped(angle, peak, specular, alpha)) * angle).mean()
    facets = mirrors(outgoing, incoming, alpha)
    dielectric = base / np.pi * under / max(entering, 1e-9) + coat * facets
    metal = (base + (1.0 - base) * schlick) * facets
    beneath = (1.0 - metallic) * dielectric + metallic * metal
    if clearcoat == 0.0:
        return beneath
    passing, over = clearcoat_layer(outgoing, incoming, clearcoat, clearcoat_roughness)
    return beneath * passing + over


def clearcoat_layer(outgoing: np.ndarray, incoming: np.ndarray, weight: float, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """What counts of the layers beneath a clearcoat, and its own BRDF, `[N]` each, in its own frame."""
    alpha = max(roughness**2, 1e-3)
    cosines = (outgoing[2], np.maximum(incoming[2], 0.0))
    passing = np.minimum(*[1.0 - weight * stopped(cosine, 0.04, 1.0, alpha) for cosine in cosines])
    half = outgoing + incoming
    schlick = (1.0 - (outgoing * half).sum(0) / np.linalg.norm(half, axis=0)) ** 5
    return passing, weight * (0.04 + 0.96 * schlick) * mirrors(outgoing, incoming, alpha)


def tilted_clearcoat(
    outgoing: np.ndarray, incoming: np.ndarray, frame: np.ndarray, clearcoat=1.0, clearcoat_roughness=0.0, **beneath
) -> np.ndarray:
    """`brdf` times cosine `[3, N]` where the clearcoat has a frame of its own: rows x, y, normal.

    Each layer has the cosine to its own normal, and nothing from below its own horizon.
    """
    passing, over = clearcoat_layer(frame @ outgoing, frame @ incoming, clearcoat, clearcoat_roughness)
    lower = np.where(incoming[2] > 0.0, brdf(outgoing, incoming, **beneath) * incoming[2], 0.0)
    cosine = frame[2] @ incoming
    return lower * passing + np.where(cosine > 0.0, over * cosine, 0.0)


def reflectance(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Unpolarised Fresnel reflectance, by Snell's law and complex cosines."""
    cosine = np.asarray(cosine, np.complex128)
    transmitted = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    s = (cosine - eta * transmitted) / (cosine + eta * transmitted)
    p = (eta * cosine - transmitted) / (eta * cosine + transmitted)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


def sheet_reflectance(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Reflectance of a thin sheet: all orders between its two faces."""
    single = reflectance(cosine, eta)
    return single + (1.0 - single) ** 2 * single / (1.0 - single**2)


def glass_reflection(outgoing: np.ndarray, incoming: np.ndarray, alpha: float, eta: float, thin: bool) -> np.ndarray:
    """BRDF `[N]` of rough glass towards directions above it (Walter et al., Eq. 20)."""
    half = outgoing + incoming
    half = half / np.linalg.norm(half, axis=0)
    fresnel = sheet_reflectance if thin else reflectance
    return fresnel((outgoing * half).sum(0), eta) * mirrors(outgoing, incoming, alpha)


def glass_refraction(outgoing: np.ndarray, incoming: np.ndarray, alpha: float, eta: float) -> np.ndarray:
    """BTDF of radiance `[N]` towards directions below (Walter et al., Eq. 21); eta: index below over above."""
    sum_ = outgoing + eta * incoming
    half = sum_ / np.linalg.norm(sum_, axis=0)
    half = half * np.sign(half[2])
    o, i = (outgoing * half).sum(0), (incoming * half).sum(0)
    masking = 1.0 / (1.0 + smith_lambda(outgoing, alpha) + smith_lambda(incoming, alpha))
    value = np.abs(o * i / (outgoing[2] * incoming[2])) * (1.0 - reflectance(np.abs(o), eta)) * ggx(half, alpha) * masking
    return np.where((o > 0.0) & (i < 0.0), value / (o + eta * i) ** 2, 0.0)


def sheet_transmission(outgoing: np.ndarray, incoming: np.ndarray, alpha: float, eta: float) -> np.ndarray:
    """BTDF `[N]` of a thin sheet: its mirrored reflection lobe with what it does not reflect."""
    mirrored = incoming * np.array([1.0, 1.0, -1.0])[:, None]
    half = outgoing + mirrored
    half = half / np.linalg.norm(half, axis=0)
    return (1.0 - sheet_reflectance((outgoing * half).sum(0), eta)) * mirrors(outgoing, mirrored, alpha)
