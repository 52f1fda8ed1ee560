"""White furnaces: what surfaces reflect and let through under even light, at every roughness and angle.

Each albedo is the quadrature of the code's values. It must be that of the formulas, in
float64 on a finer grid, and never above 1.
"""

import math

import numpy as np
import pytest
import torch
from coat_table import integrated_brushed_table, integrated_table

from bokehguide.render.bsdf.brushed_albedo import ALPHAS, LENGTH, STRENGTHS, brushed_table
from bokehguide.render.bsdf.coat_albedo import CoatAlbedo, coat_table
from bokehguide.render.bsdf.dielectric import DielectricBSDF
from bokehguide.render.bsdf.microfacets import Microfacets
from bokehguide.render.bsdf.opaque import OpaqueBSDF
from bokehguide.render.random import PixelRandom
from bokehguide.render.surface import MIN_ALPHA
from tests.support.scattering_formulas import (
    brdf,
    glass_reflection,
    glass_refraction,
    mean_stopped,
    sheet_transmission,
    stopped,
    stopped_anisotropic,
)
from tests.support.sphere import LobeGrid, even_square, surface, tilted, visible_normals

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
ROUGHNESS = [0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0]
DEGREES = [0.0, 15.0, 30.0, 45.0, 60.0, 70.0, 77.0, 82.0, 86.0, 89.0]
ROUNDING = 1e-3
"""Float32 half vectors at grazing angles, and the quadrature's own error."""

OPAQUE = {
    "white metal": {"base_color": WHITE, "metallic": 1.0},
    "coat over white": {"base_color": WHITE},
    "coat over black": {"base_color": BLACK},
    "half a metal": {"base_color": (1.0, 0.6, 0.2), "metallic": 0.5, "specular": 0.5},
    "coloured coat": {"base_color": WHITE, "specular": 0.9, "specular_color": (0.2, 1.0, 4.0), "ior": 1.8},
    "coat that lets nothing through": {"base_color": WHITE, "specular_color": (30.0, 10.0, 0.0)},
    "clearcoat over a white metal": {"base_color": WHITE, "metallic": 1.0, "clearcoat": 1.0, "clearcoat_roughness": 0.3},
    "clearcoat over coat over white": {"base_color": WHITE, "clearcoat": 0.8, "clearcoat_roughness": 0.1},
}


def albedo(degrees: float, log2_count: int, alphas: list[float], values) -> np.ndarray:
    """∫ f cos `[3]` of `values(outgoing, incoming)`, f cos `[3, N]` in float64."""
    outgoing = tilted(degrees, 1).double().numpy()
    grid = LobeGrid(outgoing, alphas, log2_count, seed=log2_count)
    return values(outgoing, grid.directions) @ grid.solid_angle


def check_opaque(parameters: dict, degrees: float) -> float:
    """The furnace at one angle; returns the largest channel of the albedo."""

    def tested(outgoing, incoming):
        count = incoming.shape[1]
        bsdf = OpaqueBSDF(tilted(degrees, count), surface(count, **parameters))
        return bsdf.evaluate(torch.from_numpy(incoming).float())[0].double().numpy()

    def expected(outgoing, incoming):
        return brdf(outgoing, incoming, **parameters) * incoming[2]

    alphas = [max(parameters[name] ** 2, MIN_ALPHA) for name in ("roughness", "clearcoat_roughness") if name in parameters]
    result = albedo(degrees, 13, alphas, tested)
    np.testing.assert_allclose(result, albedo(degrees, 14, alphas, expected), atol=ROUNDING)
    return result.max()


@pytest.mark.slow
@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("material", OPAQUE)
def test_opaque_surfaces_reflect_what_the_formulas_say_and_no_more_than_arrives(material, roughness):
    parameters = OPAQUE[material] | {"roughness": roughness}
    reflected = [check_opaque(parameters, degrees) for degrees in DEGREES]
    assert min(reflected) > 0.003 and max(reflected) < 1.0 + ROUNDING


@pytest.mark.slow
@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("beneath", [{"metallic": 1.0, "roughness": 0.1}, {"roughness": 0.5}])
def test_clearcoats_of_every_roughness_create_nothing(beneath, roughness):
    parameters = {"base_color": WHITE, "clearcoat": 1.0, "clearcoat_roughness": roughness} | beneath
    reflected = [check_opaque(parameters, degrees) for degrees in DEGREES]
    assert max(reflected) < 1.0 + ROUNDING
    assert reflected[0] > 0.93


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_a_white_base_under_a_coat_reflects_all_light_at_every_angle(roughness, ior):
    parameters = {"base_color": WHITE, "roughness": roughness, "ior": ior}

    def values(outgoing, incoming):
        count = incoming.shape[1]
        bsdf = OpaqueBSDF(torch.from_numpy(outgoing).float().expand(3, count), surface(count, **parameters))
        return bsdf.evaluate(torch.from_numpy(incoming).float())[0].double().numpy()

    reflected = [albedo(degrees, 13, [max(roughness**2, MIN_ALPHA)], values).max() for degrees in DEGREES]
    assert min(reflected) > 0.995 and max(reflected) < 1.0 + ROUNDING


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_metals_reflect_at_every_angle_what_kulla_and_conty_say(roughness):
    """Single and multiple scattering together, which is all light for a white metal."""
    alpha = max(roughness**2, MIN_ALPHA)
    angle = (np.arange(4096) + 0.5) / 4096
    mean = 2.0 * (stopped(angle, 1.0, 1.0, alpha) * angle).mean()
    for degrees in DEGREES:
        single, *found = (
            metal_albedo(degrees, roughness, base_color=color, single_scattering=float(flag))
            for color, flag in (((0.8, 0.2, 1.0), True), (WHITE, False), ((0.8, 0.2, 1.0), False))
        )
        np.testing.assert_allclose(found[0], 1.0, atol=5e-3)
        reflectance = np.array((0.8, 0.2, 1.0)) * 20.0 / 21.0 + 1.0 / 21.0
        once = stopped(np.cos(np.radians(degrees)), 1.0, 1.0, alpha)
        further = reflectance * mean / (1.0 - reflectance * (1.0 - mean)) * (1.0 - once) / once
        np.testing.assert_allclose(found[1], single * (1.0 + further), atol=5e-3)
        assert max(found[0].max(), found[1].max()) < 1.0 + ROUNDING


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 75.0, 85.0])
@pytest.mark.parametrize("roughness, anisotropy", [(0.1, 1.0), (0.3, 0.5), (0.5, 0.9), (0.6, 0.3)])
def test_anisotropic_metals_and_coats_lose_little(roughness, anisotropy, degrees):
    count = 200_000
    uniforms = PixelRandom(0, 0, torch.arange(count)).uniform(0, 3)
    for metallic, least in ((1.0, 0.96), (0.0, 0.985)):
        white = surface(count, WHITE, metallic, roughness, anisotropy=anisotropy)
        bsdf = OpaqueBSDF(tilted(degrees, count), white)
        value, pdf = bsdf.evaluate(bsdf.sample(uniforms))
        weights = (value[0] / pdf.clamp(min=1e-20)).double()
        error = 4.0 * float(weights.std()) / math.sqrt(count)
        assert least - error < float(weights.mean()) < 1.0 + ROUNDING + error


def metal_albedo(degrees: float, roughness: float, **parameters) -> np.ndarray:
    """Albedo `[3]` of a metal."""

    def values(outgoing, incoming):
        count = incoming.shape[1]
        metal = surface(count, metallic=1.0, roughness=roughness, **parameters)
        bsdf = OpaqueBSDF(torch.from_numpy(outgoing).float().expand(3, count), metal)
        return bsdf.evaluate(torch.from_numpy(incoming).float())[0].double().numpy()

    return albedo(degrees, 13, [max(roughness**2, MIN_ALPHA)], values)


def test_the_file_of_the_table_of_coats_is_current():
    torch.testing.assert_close(coat_table(torch.device("cpu"))[:, ::21], integrated_table(21), atol=1e-6, rtol=0.0)


def test_the_file_of_the_table_of_anisotropic_microfacets_is_current():
    table = brushed_table(torch.device("cpu")).view(2, ALPHAS, STRENGTHS, LENGTH)[:, 1::5]
    expected = integrated_brushed_table(start=1, every=5)[:, 1::5].float()
    torch.testing.assert_close(table[..., :-1], expected[..., :-1], atol=3e-4, rtol=0.0)


@pytest.mark.parametrize("alpha, along", [(1e-3, 0.9), (0.02, 0.3), (0.09, 0.09), (0.25, 0.4), (0.2, 1.0), (0.6, 0.8)])
def test_the_albedos_of_anisotropic_microfacets_are_upper_bounds(alpha, along):
    cosine, azimuth = (torch.rand(150, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    cosine, azimuth = cosine.square().clamp(min=0.01), azimuth * math.tau
    sine = (1.0 - cosine.square()).sqrt()
    direction = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), cosine))
    facets = Microfacets(direction, torch.full_like(cosine, alpha), torch.full_like(cosine, along))
    light = direction.double().numpy()
    for f0, f90 in ((1.0, 1.0), (0.0, 1.0), (0.04, 1.0)):
        coat = CoatAlbedo(facets, torch.full_like(cosine, f0), torch.full_like(cosine, f90 - f0))
        excess = coat.towards(direction, cosine).numpy() - stopped_anisotropic(light, f0, f90, (along, alpha))
        assert excess.min() > -2e-3 and excess.max() < 0.025
        assert coat.mean()[0].item() == pytest.approx(mean_stopped(f0, f90, (along, alpha)), abs=0.015)


@pytest.mark.parametrize("alpha", [MIN_ALPHA, 0.0123, 0.087, 0.25, 0.5, 1.0])
def test_the_table_of_coats_holds_their_albedos(alpha):
    cosine = torch.linspace(0.15, 1.0, 97) ** 4
    direction = torch.stack(((1.0 - cosine**2).sqrt(), torch.zeros_like(cosine), cosine))
    facets = Microfacets(direction, torch.full_like(cosine, alpha))
    for f0 in (0.0, 0.04, 0.5, 1.0):
        coat = CoatAlbedo(facets, torch.full_like(cosine, f0), torch.full_like(cosine, 1.0 - f0))
        expected = stopped(cosine.double().numpy(), f0, 1.0, alpha)
        np.testing.assert_allclose(coat.towards(direction, cosine).numpy(), expected, atol=3e-3)
        angle = (np.arange(4096) + 0.5) / 4096
        mean = 2.0 * (stopped(angle, f0, 1.0, alpha) * angle).mean()
        np.testing.assert_allclose(coat.mean().numpy(), mean, atol=1e-3)


def check_glass(degrees: float, roughness: float, thin: bool, front: bool) -> None:
    """Reflected and transmitted shares at one angle, the latter in power: radiance times η²."""
    outgoing, alpha = tilted(degrees, 1).double().numpy(), roughness**2
    eta = 1.5 if front or thin else 1.0 / 1.5

    def tested(incoming):
        count = incoming.shape[1]
        parameters = surface(count, WHITE, roughness=roughness, transmission=1.0, thin=float(thin), front=float(front))
        return DielectricBSDF(tilted(degrees, count), parameters).evaluate(torch.from_numpy(incoming).float())[0][0].numpy()

    def through(incoming):
        formula = sheet_transmission if thin else glass_refraction
        return formula(outgoing, incoming, alpha, eta) * np.abs(incoming[2])

    def reflected(incoming):
        return glass_reflection(outgoing, incoming, alpha, eta, thin) * incoming[2]

    shares = [glass_shares(outgoing, alpha, None if thin else eta, 13, tested, tested)]
    shares += [glass_shares(outgoing, alpha, None if thin else eta, 14, reflected, through)]
    np.testing.assert_allclose(shares[0], shares[1], atol=ROUNDING)
    assert 0.3 < sum(shares[0]) < 1.0 + ROUNDING


def glass_shares(outgoing, alpha, eta, log2_count, reflected, through) -> tuple[float, float]:
    """Power reflected and transmitted; eta: of the solid below, None for a sheet."""
    half, density = visible_normals(outgoing, alpha, even_square(log2_count, seed=log2_count))
    density = density * 2.0**log2_count
    cosine = (outgoing * half).sum(0)
    up = 2.0 * cosine * half - outgoing
    weight = 4.0 * cosine / density
    kept = up[2] > 1e-9
    first = reflected(up[:, kept]) @ weight[kept]
    if eta is None:
        return first, through((up * np.array([1.0, 1.0, -1.0])[:, None])[:, kept]) @ weight[kept]
    squared = 1.0 - (1.0 - cosine**2) / eta**2
    transmitted = np.sqrt(np.maximum(squared, 0.0))
    down = (cosine / eta - transmitted) * half - outgoing / eta
    jacobian = eta**2 * transmitted / (cosine - eta * transmitted) ** 2  # dω(half) / dω(down)
    kept = (down[2] < -1e-9) & (squared > 1e-9)
    return first, through(down[:, kept]) @ (1.0 / (jacobian * density)[kept]) * eta**2


@pytest.mark.parametrize("roughness", ROUGHNESS[2:])
@pytest.mark.parametrize("thin, front", [(False, True), (False, False), (True, True)])
def test_glass_splits_light_as_the_formulas_say_and_creates_none(thin, front, roughness):
    for degrees in DEGREES:
        check_glass(degrees, roughness, thin, front)


@pytest.mark.parametrize("alpha", [1e-3, 0.01, 0.3, 1.0])
def test_the_quadrature_integrates_what_is_known(alpha):
    for degrees in DEGREES:
        outgoing = tilted(degrees, 1).double().numpy()
        grid = LobeGrid(outgoing, [alpha])
        assert (grid.directions[2] / np.pi) @ grid.solid_angle == pytest.approx(1.0, abs=5e-4)
        lobe = grid.directions[2] ** 3
        assert lobe @ grid.solid_angle == pytest.approx(np.pi / 2.0, abs=1e-3)
