"""Samplers of the native core: draws follow their densities, which integrate to one."""

import numpy as np
import pytest
import torch

from bokehguide.render.native_tables import native_scene
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.timer import PhaseTimer
from tests.support.native_cases import BUILT_IN, SUNS, both_tracers, core, rays, rows_of, sky, tables
from tests.support.sphere import SphereGrid, surface, tilted
from tests.support.statistical import SIGNIFICANCE, chi_square, z_test
from tests.support.tracing import agreement, emitter, inward, scene, sphere

GRID = SphereGrid(24, 48, 12)
POINTS = GRID.directions.shape[1]
DRAWS = 200_000
LIGHTS = SphereGrid(16, 32, 24)

# Degrees from the normal, the number that chooses the opaque part (1) or the transmissive one (0), surface.
SURFACES = [
    (30.0, 1.0, {"roughness": 0.5, "specular_color": (1.0, 1.0, 1.0), "clearcoat": 0.0}),
    (75.0, 1.0, {"roughness": 0.6, "metallic": 0.5, "specular_color": (1.0, 0.5, 0.2), "clearcoat": 0.0}),
    (60.0, 1.0, {"roughness": 0.8, "clearcoat": 0.8, "clearcoat_roughness": 0.4}),
    (40.0, 1.0, {"roughness": 0.6, "clearcoat": 1.0, "clearcoat_roughness": 0.6, "clearcoat_normal": (0.2, 0.0, 0.98)}),
    (60.0, 1.0, {"roughness": 0.7, "sheen_color": (0.9, 0.5, 0.2), "sheen_roughness": 0.5}),
    (50.0, 1.0, {"roughness": 0.5, "metallic": 1.0, "anisotropy": 0.8}),
    (30.0, 1.0, {"roughness": 0.6, "diffuse_transmission": 0.6, "transmission_color": (0.9, 0.5, 0.2)}),
    (20.0, 0.0, {"roughness": 0.5, "transmission": 1.0}),
    (60.0, 0.0, {"roughness": 0.6, "transmission": 1.0, "front": 0.0}),
    (50.0, 0.0, {"roughness": 0.6, "transmission": 1.0, "thin": 1.0}),
]


def uniforms(count: int, numbers: int) -> torch.Tensor:
    return PixelRandom(1, 0, torch.arange(count)).uniform(0, numbers)


@pytest.mark.parametrize("degrees, choice, parameters", SURFACES)
def test_directions_follow_their_density(degrees, choice, parameters):
    """Draws of `sample` follow the density of `evaluate`; the rest falls below the surface and has no weight."""
    layered = any(name in parameters for name in ("sheen_color", "anisotropy", "diffuse_transmission"))
    found, scene_tables = core(), tables("layers" if layered else "textures")

    def rows(count: int) -> torch.Tensor:
        return rows_of(surface(count, outgoing=tilted(degrees, count).contiguous(), **parameters))

    drawn, values = torch.empty(7, DRAWS), torch.empty(4, POINTS)
    found.sample(scene_tables, rows(DRAWS), torch.full((DRAWS,), choice), uniforms(DRAWS, 3), drawn)
    found.evaluate(scene_tables, rows(POINTS), torch.full((POINTS,), choice), GRID.directions, values)
    valid = drawn[6 if choice else 3] > 0.0
    cells = GRID.cell_integrals(values[3])
    counts = np.append(GRID.histogram(drawn[0:3, valid]), DRAWS - int(valid.sum()))
    expected = np.append(cells, max(1.0 - cells.sum(), 0.0) + 1e-6)
    assert -2e-3 < 1.0 - cells.sum() < 0.5
    assert chi_square(counts, expected / expected.sum()) > SIGNIFICANCE
    weighted = (drawn[3:6] * valid).double().numpy()
    albedo = GRID.integral(values[0:3])
    error = weighted.std(axis=1) / np.sqrt(DRAWS) + 2e-3 * albedo
    assert z_test(weighted.mean(axis=1) - albedo, error) > SIGNIFICANCE


@pytest.mark.parametrize("suns", [(), SUNS], ids=["no sun", "suns"])
def test_light_samples_follow_their_density(suns):
    """Inside a closed emitter, under a sky that none of it sees."""
    found = core()
    shell = scene([inward(sphere(0, (0.2, 0.1, -0.3), 1.5))], [emitter()], sky())
    tracer = PathTracer(type(shell)(**{**vars(shell), "suns": suns}))
    of_native = native_scene(found, tracer.geometry, tracer.lights, tracer.visibility)
    place = torch.tensor([0.3, -0.2, 0.4])[:, None]
    samples, count = torch.empty(8, DRAWS), LIGHTS.directions.shape[1]
    found.lights(of_native, place.repeat(1, DRAWS), uniforms(DRAWS, 6), samples)
    points = place.repeat(1, count)
    hit = tracer.geometry.tracer.intersect(points, LIGHTS.directions)
    normal = tracer.geometry.face_normals(hit.triangle)
    cosine = (normal * LIGHTS.directions).sum(0)
    near, far = torch.empty(8, count), torch.empty(5, count)
    hits = torch.stack((*hit[1:], torch.ones(count), cosine))
    found.emitters(of_native, points, -LIGHTS.directions, hit.triangle, hits, near)
    found.environment(of_native, points, LIGHTS.directions, far)
    expected = LIGHTS.cell_integrals(near[3]) + LIGHTS.cell_integrals(far[4])
    assert expected.sum() == pytest.approx(1.0, abs=4e-3)
    if not suns:  # the disc of a sun falls between the points of the quadrature
        assert chi_square(LIGHTS.histogram(samples[0:3]), expected / expected.sum()) > SIGNIFICANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILT_IN)
def test_means_of_other_samples_agree_with_those_of_pytorch(name):
    tracer, reference = both_tracers(name)
    found, expected = (
        np.concatenate(
            [each.trace(*rays(name, 30_000, seed + 10 * part), PhaseTimer()).radiance.double().numpy() for part in range(4)],
            axis=1,
        )
        for seed, each in ((1, tracer), (2, reference))
    )
    assert agreement(found, expected) > SIGNIFICANCE
