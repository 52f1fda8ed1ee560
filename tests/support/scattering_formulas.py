"""What surfaces scatter, in float64 numpy, written from the published formulas.

Directions are `[3, N]` in the local frame, z along the normal. Independent of what is tested:
glTF 2.0 appendix B with KHR_materials_ior, _specular and _clearcoat; Walter et al. 2007.
"""

from __future__ import annotations

from functools import cache

import numpy as np

Alpha = float | tuple[float, float]
"""α of GGX, or α along x and along y."""


def ggx(half: np.ndarray, alpha: Alpha) -> np.ndarray:
    """D, `[N]`, in slopes as Heitz 2014 has it."""
    x, y = np.broadcast_to(alpha, 2)
    slopes = (half[0] / (x * half[2])) ** 2 + (half[1] / (y * half[2])) ** 2
    return 1.0 / (np.pi * x * y * half[2] ** 4 * (1.0 + slopes) ** 2)


def smith_lambda(directions: np.ndarray, alpha: Alpha) -> np.ndarray:
    """Λ of Smith's masking for GGX, `[N]`: G₁ = 1 / (1 + Λ) and G₂ = 1 / (1 + Λ + Λ)."""
    x, y = np.broadcast_to(alpha, 2)
    return 0.5 * (np.sqrt(1.0 + ((x * directions[0]) ** 2 + (y * directions[1]) ** 2) / directions[2] ** 2) - 1.0)


def mirrors(outgoing: np.ndarray, incoming: np.ndarray, alpha: Alpha) -> np.ndarray:
    """D G₂ / (4 cos cos), `[N]`."""
    half = outgoing + incoming
    half = half / np.linalg.norm(half, axis=0)
    masking = 1.0 / (1.0 + smith_lambda(outgoing, alpha) + smith_lambda(incoming, alpha))
    return ggx(half, alpha) * masking / (4.0 * outgoing[2] * incoming[2])


@cache
def coat_albedos(alpha: float) -> np.ndarray:
    """Albedos `[2, 257]` of microfacets that reflect all, and (1 - cos)⁵, of light; for cosines (n / 256)⁴.

    Gauss-Legendre quadrature over the projected disc of visible normals (Heitz 2018).
    """
    nodes, weights = np.polynomial.legendre.leggauss(80)
    across, up = np.meshgrid(0.5 * (nodes + 1.0), 0.5 * (nodes + 1.0))
    area = np.outer(weights, weights).ravel() * 0.5 * across.ravel()  # 2 r dr
    radius, angle = across.ravel(), np.pi * up.ravel()  # the half turn in which x is at least 0
    x, flat = radius * np.sin(angle), radius * np.cos(angle)
    found = []
    for cosine in np.maximum((np.arange(257) / 256.0) ** 4, 1e-6):
        outgoing = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
        view = outgoing * (alpha, alpha, 1.0)
        view = view / np.linalg.norm(view)
        side, down = np.array([0.0, 1.0, 0.0]), np.array([-view[2], 0.0, view[0]])
        share = 0.5 * (1.0 + view[2])
        y = (1.0 - share) * np.sqrt(1.0 - x * x) + share * flat
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        half = (np.outer(side, x) + np.outer(down, y) + np.outer(view, z)) * np.array([alpha, alpha, 1.0])[:, None]
        half = half / np.linalg.norm(half, axis=0)
        towards = outgoing @ half
        incoming = 2.0 * towards * half - outgoing[:, None]
        incoming = np.where(incoming[2] > 1e-12, incoming, np.array([0.0, 0.0, 1.0])[:, None])
        lost = smith_lambda(outgoing[:, None], alpha)
        weight = (1.0 + lost) / (1.0 + lost + smith_lambda(incoming, alpha)) * (2.0 * towards * half[2] > outgoing[2])
        found.append((area @ weight, area @ (weight * (1.0 - towards) ** 5)))
    return np.array(found).T


def stopped(cosine: np.ndarray, f0: float, f90: float, alpha: float) -> np.ndarray:
    """T: the albedo of an isotropic coat, `[N]`."""
    steep, grazing = coat_albedos(alpha)
    return np.interp(np.abs(cosine) ** 0.25, np.arange(257) / 256.0, f0 * steep + (f90 - f0) * grazing)


def stopped_anisotropic(directions: np.ndarray, f0: float, f90: float, alphas: tuple[float, float]) -> np.ndarray:
    """T of coats of α along x and along y, `[N]`."""
    if alphas[0] == alphas[1]:
        return stopped(directions[2], f0, f90, alphas[0])
    steep, grazing = np.concatenate([_anisotropic(part, alphas) for part in np.array_split(directions, 20, axis=1)], axis=1)
    return f0 * steep + (f90 - f0) * grazing


def _anisotropic(directions: np.ndarray, alphas: tuple[float, float]) -> np.ndarray:
    """Albedos `[2, N]` as those of `coat_albedos`, by quadrature over the caps of visible normals (Dupuy and Benyoub 2023)."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    turn, height = np.meshgrid(2.0 * np.pi * (np.arange(64) + 0.5) / 64.0, 0.5 * (nodes + 1.0))
    weight, scale = np.repeat(0.5 * weights / 64.0, 64), np.array([*alphas, 1.0])
    outgoing = np.stack((directions[0], directions[1], np.abs(directions[2])))[:, :, None]
    view = outgoing * scale[:, None, None]
    view = view / np.linalg.norm(view, axis=0)
    z = (1.0 - height.ravel()) * (1.0 + view[2]) - view[2]
    sine = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    half = (np.stack((sine * np.cos(turn.ravel()), sine * np.sin(turn.ravel()), z)) + view) * scale[:, None, None]
    half = half / np.linalg.norm(half, axis=0)
    towards = (outgoing * half).sum(0)
    incoming = 2.0 * towards * half - outgoing
    above = incoming[2] > 1e-12
    incoming = np.where(above, incoming, np.array([0.0, 0.0, 1.0])[:, None, None])
    lost = smith_lambda(outgoing, alphas)
    kept = (1.0 + lost) / (1.0 + lost + smith_lambda(incoming, alphas)) * above
    return np.stack((kept @ weight, (kept * (1.0 - towards) ** 5) @ weight))


def mean_stopped(f0: float, f90: float, alphas: tuple[float, float]) -> float:
    """The mean of T under uniform illumination."""
    angle = (np.arange(4096) + 0.5) / 4096
    if alphas[0] == alphas[1]:
        return 2.0 * (stopped(angle, f0, f90, alphas[0]) * angle).mean()
    cosine, azimuth = (x.ravel() for x in np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(24) + 0.5) / 48 * np.pi))
    sine = np.sqrt(1.0 - cosine**2)
    directions = np.stack((sine * np.cos(azimuth), sine * np.sin(azimuth), cosine))
    return 2.0 * (stopped_anisotropic(directions, f0, f90, alphas) * cosine).mean()


def gain(outgoing: np.ndarray, base: np.ndarray, alphas: tuple[float, float]) -> np.ndarray:
    """Factor `[3, 1]` of the BRDF of metals by multiple scattering (Kulla and Conty 2017, Turquin 2019).

    outgoing: one direction, `[3, N]`. base: colour `[3, 1]`.
    """
    albedo = stopped_anisotropic(outgoing[:, :1], 1.0, 1.0, alphas)
    angle = (np.arange(4096) + 0.5) / 4096
    mean = mean_stopped(1.0, 1.0, alphas)
    schlick = 2.0 * ((base + (1.0 - base) * (1.0 - angle) ** 5) * angle).mean(1, keepdims=True)
    return 1.0 + schlick * mean / (1.0 - schlick * (1.0 - mean)) * (1.0 - albedo) / albedo


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
    sheen_color=(0.0, 0.0, 0.0),
    sheen_roughness=0.0,
    anisotropy=0.0,
    diffuse_transmission=0.0,
    transmission_color=(1.0, 1.0, 1.0),
    single_scattering=0.0,
) -> np.ndarray:
    """The opaque BSDF `[3, N]` towards directions above the surface or, of diffuse transmission alone, below.

    The base lies under a coat that light passes twice, and both under a sheen and a clearcoat. x is the direction of larger
    roughness.
    """
    alpha = max(roughness**2, 1e-3)
    below = incoming[2] < 0.0
    light = np.stack((incoming[0], incoming[1], np.abs(incoming[2])))
    alphas = (alpha + (1.0 - alpha) * anisotropy**2, alpha)
    half = outgoing + incoming
    schlick = (1.0 - (outgoing * half).sum(0) / np.linalg.norm(half, axis=0)) ** 5
    f0 = np.minimum(((ior - 1.0) / (ior + 1.0)) ** 2 * np.asarray(specular_color), 1.0) * specular
    peak, base = f0.max(), np.asarray(base_color)[:, None]
    coat = f0[:, None] + (specular - f0[:, None]) * schlick
    under = np.multiply(*[1.0 - stopped_anisotropic(one, peak, specular, alphas) for one in (outgoing[:, :1], light)])
    entering = 1.0 - mean_stopped(peak, specular, alphas)
    facets = np.where(below, 0.0, mirrors(outgoing, light, alphas))
    through = np.asarray(transmission_color)[:, None] * diffuse_transmission
    lambertian = np.where(below, through, base * (1.0 - diffuse_transmission))
    dielectric = lambertian / np.pi * under / max(entering, 0.2) + coat * facets
    metal = (base + (1.0 - base) * schlick) * facets * (1.0 if single_scattering else gain(outgoing, base, alphas))
    beneath = (1.0 - metallic) * dielectric + metallic * metal
    if any(sheen_color):
        passing, over = sheen_layer(outgoing, light, sheen_color, sheen_roughness)
        beneath = beneath * passing + np.where(below, 0.0, over)
    if clearcoat == 0.0:
        return beneath
    passing, over = clearcoat_layer(outgoing, light, clearcoat, clearcoat_roughness)
    return beneath * passing + np.where(below, 0.0, over)


def iridescent(f0: np.ndarray, ior: float, thickness: float, cosine: np.ndarray) -> np.ndarray:
    """Reflectance `[3, N]` of a film of `thickness` nm in air, by the steps of KHR_materials_iridescence; f0: `[3, 1]`.

    At most what both interfaces reflect in phase.
    """
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    r0 = ((ior - 1.0) / (ior + 1.0)) ** 2
    r12 = r0 + (1.0 - r0) * (1.0 - cosine) ** 5
    base = (1.0 + np.sqrt(f0 + 1e-4)) / (1.0 - np.sqrt(f0 + 1e-4))
    r1 = ((base - ior) / (base + ior)) ** 2
    r23 = r1 + (1.0 - r1) * (1.0 - inside) ** 5
    phi = np.pi + np.where(base < ior, np.pi, 0.0)
    r123 = np.clip(r12 * r23, 1e-5, 0.9999)
    rs = (1.0 - r12) ** 2 * r23 / (1.0 - r123)
    total, order = r12 + rs, rs - (1.0 - r12)
    for m in (1, 2):
        order = order * np.sqrt(r123)
        phase = 2.0 * np.pi * m * 2.0 * ior * thickness * inside * 1e-9
        xyz = []
        for value, position, variance in (
            (5.4856e-13, 1.6810e6, 4.3278e9),
            (4.4201e-13, 1.7953e6, 9.3046e9),
            (5.2481e-13, 2.2084e6, 6.6121e9),
        ):
            shift = m * phi[len(xyz)]
            xyz.append(value * np.sqrt(2.0 * np.pi * variance) * np.cos(position * phase + shift) * np.exp(-variance * phase**2))
        extra = (
            9.7470e-14 * np.sqrt(2.0 * np.pi * 4.5282e9) * np.cos(2.2399e6 * phase + m * phi[0]) * np.exp(-4.5282e9 * phase**2)
        )
        xyz[0] = xyz[0] + extra
        matrix = [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
        total = total + order * 2.0 * (np.array(matrix) @ (np.stack(xyz) / 1.0685e-7))
    return np.clip(total, 0.0, ((np.sqrt(r12) + np.sqrt(r23)) / (1.0 + np.sqrt(r12 * r23))) ** 2)


def charlie(sine2: np.ndarray, cosines: tuple[np.ndarray, np.ndarray], alpha: float) -> np.ndarray:
    """D V of KHR_materials_sheen, with the visibility of Ashikhmin and Premože."""
    inverse = 1.0 / alpha
    distribution = (2.0 + inverse) * np.power(sine2, inverse * 0.5) / (2.0 * np.pi)
    return distribution / (4.0 * (cosines[0] + cosines[1] - cosines[0] * cosines[1]))


def sheen_albedos(cosines: np.ndarray, roughness: float) -> np.ndarray:
    """Directional albedos of a white sheen by a midpoint rule, for cosines `[N]`."""
    known = (np.arange(257) / 256.0) ** 2
    z, azimuth = ((np.arange(400) + 0.5)[:, None] / 400.0) ** 2, (np.arange(200) + 0.5) / 200.0 * np.pi
    found = []
    for cosine in np.maximum(known, 1e-5):
        x = np.sqrt(1.0 - cosine**2) + np.sqrt(1.0 - z**2) * np.cos(azimuth)
        y = np.sqrt(1.0 - z**2) * np.sin(azimuth)
        sine2 = (x**2 + y**2) / (x**2 + y**2 + (z + cosine) ** 2)
        found.append((charlie(sine2, (z, cosine), roughness**2) * z * np.sqrt(z) * 2.0 / 400.0 * 2.0 * np.pi / 200.0).sum())
    return np.interp(np.sqrt(cosines), np.sqrt(known), found)


def sheen_layer(outgoing: np.ndarray, incoming: np.ndarray, color, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """What counts of the layers beneath a sheen `[N]`, and its own BRDF `[3, N]`, which no albedo above 1 is left of."""
    roughness = max(roughness, 0.07)
    half = outgoing + incoming
    half = half / np.linalg.norm(half, axis=0)
    albedo = np.maximum(sheen_albedos(outgoing[2], roughness), sheen_albedos(incoming[2], roughness))
    value = charlie(half[0] ** 2 + half[1] ** 2, (outgoing[2], incoming[2]), roughness**2) / np.maximum(albedo, 1.0)
    return 1.0 - max(color) * np.minimum(albedo, 1.0), np.asarray(color)[:, None] * value


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
