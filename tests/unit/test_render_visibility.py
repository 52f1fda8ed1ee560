"""Rays through masks and blended sheets: each crossing against brute force, and light in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.render import mis, path_tracer
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.power_sampler import PowerLightSampler
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE, Hit
from bokehguide.render.visibility import Visibility
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Material, Mesh, Texture
from tests.support.brute_force import every_hit
from tests.support.light_checks import (
    LIGHT,
    RECTANGLE,
    polygon_irradiance,
)
from tests.support.rooms import bsdf_sampling_only, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import DOWN, UP, agreement, emitter, estimates, matte, mean_test, rectangle, scene, sky, trace


def sheet(opacity: float, color: float = 0.0, **others) -> Material:
    return replace(matte(color, **others), opacity=opacity, alpha_mode="blend")


def checker(cutoff: float = 0.5) -> Material:
    """A mask of 4 × 4 fields that starts with a hole at the top left."""
    image = np.ones((4, 4, 4), np.float32)
    image[::2, ::2, 3] = image[1::2, 1::2, 3] = 0.0
    texture = Texture(image, wrap=("clamp", "clamp"))
    return replace(matte(0.0), base_color_texture=texture, alpha_mode="mask", alpha_cutoff=cutoff)


def soup() -> tuple[list[Mesh], list[Material]]:
    """80 triangles of four materials of opacity 1, 0.3, 0.8 and 0 in a cube."""
    generator = np.random.default_rng(7)
    meshes = []
    for material in (0, 1, 2, 1, 3):
        corners = generator.uniform(-1, 1, (16, 1, 3)) + generator.normal(0, 0.4, (16, 3, 3))
        meshes.append(Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(48, dtype=np.int32).reshape(16, 3), material))
    return meshes, [matte(), sheet(0.3), sheet(0.8), replace(sheet(0.2), alpha_mode="mask")]


OPACITY = np.repeat([1.0, 0.3, 0.8, 0.3, 0.0], 16)


def crossings(meshes: list[Mesh], origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances `[N, T]` at which rays `[3, N]` meet each triangle in float64, infinite where they do not."""
    return every_hit(np.concatenate([m.vertices[m.triangles] for m in meshes]), origins, directions)[0]


def rays(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """From around the cube to points in it."""
    generator = np.random.default_rng(8)
    origins = generator.uniform(-2, 2, (3, count))
    directions = generator.uniform(-1, 1, (3, count)) - origins
    directions /= np.linalg.norm(directions, axis=0)
    return torch.from_numpy(origins).float(), torch.from_numpy(directions).float()


def stops(visibility: Visibility, origins: torch.Tensor, directions: torch.Tensor, random: PixelRandom) -> Hit:
    """Where all of the rays stop, those too that leave the scene."""
    arrivals, _ = visibility.nearest(origins, directions, random, 1000, PhaseTimer())
    count = origins.shape[1]
    met = torch.arange(count) if arrivals.met is None else arrivals.met
    assert torch.equal(torch.cat((met, arrivals.missed)).sort().values, torch.arange(count)) and len(arrivals.ended) == 0
    hit = Hit(torch.full((count,), -1, dtype=torch.int32), torch.full((count,), MISS_DISTANCE), *torch.zeros(2, count))
    for values, found in zip(hit, arrivals.hit):
        values[met] = found
    return hit


@pytest.mark.parametrize("translucent", [False, True])
@pytest.mark.parametrize("ended", [0, 1500, 4000])
def test_rays_are_sorted_by_what_becomes_of_them(translucent, ended):
    meshes, materials = soup()
    materials = materials if translucent else [matte()] * 4
    materials[2] = replace(materials[2], emission=(1.0, 1.0, 1.0))
    origins, directions = rays(4000)
    alive = torch.ones(4000)
    alive[torch.randperm(4000, generator=torch.Generator().manual_seed(3))[:ended]] = 0.0
    visibility, random = Visibility(Geometry(scene(meshes, materials)), tuple(meshes)), PixelRandom(0, 0, torch.arange(4000))
    counts = (torch.arange(4000) % 5 + 1).float()
    found, traced = visibility.nearest(origins, directions, random, 1000, PhaseTimer(), alive, counts)
    every = stops(visibility, origins, directions, random)
    met = torch.arange(4000) if found.met is None else found.met
    assert torch.equal(found.ended, (alive == 0.0).nonzero()[:, 0])
    assert torch.equal(found.missed, ((alive > 0.0) & (every.triangle < 0)).nonzero()[:, 0])
    assert torch.equal(met, ((alive > 0.0) & (every.triangle >= 0)).nonzero()[:, 0])
    assert all(torch.equal(values, whole[met]) for values, whole in zip(found.hit, every))
    assert torch.equal(found.emitters, (found.hit.triangle // 16 == 2).nonzero()[:, 0])
    assert found.path_count == int(counts[met].sum())
    assert traced >= 4000 - ended if translucent else traced == 4000 - ended


@pytest.mark.parametrize("translucent", [False, True])
def test_shadow_rays_of_weight_0_are_not_traced(translucent):
    meshes, materials = soup()
    origins, directions = rays(4000)
    visibility = Visibility(Geometry(scene(meshes, materials if translucent else [matte()] * 4)), tuple(meshes))
    limit, weight = torch.full((4000,), 3.0), (torch.arange(4000) % 3).float()
    every, most = visibility.transmittance(origins, directions, limit, torch.ones(4000), PhaseTimer())
    found, traced = visibility.transmittance(origins, directions, limit, weight, PhaseTimer())
    assert torch.equal(found, every * (weight > 0.0)) and 0.0 < float(every.mean()) < 1.0
    assert traced < 0.7 * most if translucent else (traced, most) == (2666, 4000)
    nothing, none = visibility.transmittance(origins, directions, limit, torch.zeros(4000), PhaseTimer())
    assert not nothing.any() and none == 0


@pytest.mark.parametrize("translucent", [False, True])
def test_what_arrives_is_what_comes_through(translucent):
    """The host knows along which rays."""
    meshes, materials = soup()
    materials = materials if translucent else [matte()] * 4
    visibility = Visibility(Geometry(scene(meshes, materials)), tuple(meshes))
    origins, directions = rays(4000)
    limit, weight = torch.full((4000,), 1.7), torch.randint(0, 4, (4000,)).float()
    share, traced = visibility.transmittance(origins, directions, limit, weight, PhaseTimer())
    found, as_many = visibility.visible_rays(origins, directions, limit, weight, PhaseTimer())
    asked = int((weight > 0.0).sum())
    assert traced == as_many and 0 < len(found.rays) < asked <= traced and (traced > asked) == translucent
    assert torch.equal(torch.zeros(4000).scatter(0, found.rays, found.transmittance), share)
    assert torch.equal(found.weight, weight[found.rays]) and torch.equal(found.distance, limit[found.rays])


def test_transmittance_is_the_product_over_all_crossings():
    meshes, materials = soup()
    origins, directions = rays(4000)
    limit = torch.from_numpy(np.random.default_rng(9).uniform(0.0, 4.0, 4000)).float()
    visibility = Visibility(Geometry(scene(meshes, materials)), tuple(meshes))
    found, traced = visibility.transmittance(origins, directions, limit, torch.ones(4000), PhaseTimer())
    met = crossings(meshes, origins.numpy(), directions.numpy()) < limit.numpy()[:, None]
    expected = np.where(met, 1.0 - OPACITY, 1.0).prod(axis=1)
    assert ((met & (OPACITY < 1.0)).sum(axis=1) > 2).sum() > 100 and traced > 4000
    assert (np.abs(found.numpy() - expected) < 1e-5).mean() > 0.997  # an edge may fall to either side


@pytest.mark.slow
def test_nearest_stops_at_each_surface_as_often_as_it_is_opaque():
    meshes, materials = soup()
    origins, directions = rays(40_000)
    visibility = Visibility(Geometry(scene(meshes, materials)), tuple(meshes))
    hit = stops(visibility, origins, directions, PixelRandom(0, 0, torch.arange(40_000)))
    t = crossings(meshes, origins.numpy(), directions.numpy())
    order = t.argsort(axis=1)
    crossed = np.isfinite(np.take_along_axis(t, order, axis=1))
    reached = np.where(crossed, 1.0 - OPACITY[order], 1.0).cumprod(axis=1)
    reached = np.concatenate((np.ones((len(t), 1)), reached), axis=1)
    probability = np.zeros((len(t), t.shape[1] + 1))  # of each triangle; the last is a miss
    np.put_along_axis(probability, order, np.where(crossed, reached[:, :-1] * OPACITY[order], 0.0), axis=1)
    probability[:, -1] = reached[:, -1]
    triangle = hit.triangle.numpy()
    found = np.eye(t.shape[1] + 1)[triangle]
    assert (probability[np.arange(len(t)), triangle] > 0.0).mean() > 0.998
    error = np.sqrt((probability * (1.0 - probability)).sum(axis=0)) + 2e-4 * len(t)
    used = probability.sum(axis=0) > 20
    assert z_test((found - probability).sum(axis=0)[used], error[used]) > SIGNIFICANCE
    met = triangle >= 0
    same = probability[np.arange(len(t)), triangle] > 0.0
    np.testing.assert_allclose(hit.distance.numpy()[met & same], t[np.arange(len(t)), triangle][met & same], rtol=1e-3, atol=1e-4)
    assert (hit.distance[~met] == MISS_DISTANCE).all()


@pytest.mark.parametrize("away", [0.0, 100.0])
@pytest.mark.parametrize("tilt", [0.0, 80.0, 89.9])
def test_a_sheet_counts_once_however_it_is_met(away, tilt):
    plate = rectangle(0, (away, 0.0, -1.0), (0.0, tilt, 0.0), 100.0)
    origins = torch.tensor([[away], [0.0], [0.0]]) + 0.3 * torch.randn(3, 2000, generator=torch.Generator().manual_seed(1))
    directions = torch.tensor([[0.0], [0.0], [-1.0]]).repeat(1, 2000)
    meshes = (plate, rectangle(1, (away, 0.0, 200.0), scale=9.0))
    visibility = Visibility(Geometry(scene(meshes, [sheet(0.4), matte()])), meshes)
    met = crossings([plate], origins.numpy(), directions.numpy()) < 150.0
    share, _ = visibility.transmittance(origins, directions, torch.full((2000,), 150.0), torch.ones(2000), PhaseTimer())
    np.testing.assert_allclose(share.numpy(), 1.0 - 0.4 * met.any(axis=1), rtol=1e-6)
    random = PixelRandom(0, 0, torch.arange(2000))
    hit = stops(visibility, origins, directions, random)
    assert (hit.triangle.numpy() >= 0).tolist() == (met.any(axis=1) & (random.uniform(1000, 1)[0].numpy() < 0.4)).tolist()


def test_a_wall_close_behind_a_sheet_is_met():
    """Half a millimetre behind it, seen from 50 m, by camera rays and by shadow rays."""
    meshes = (rectangle(0, scale=30.0), rectangle(1, (0.0, 0.0, -5e-4), scale=30.0))
    visibility = Visibility(Geometry(scene(meshes, [sheet(0.0), matte()])), meshes)
    direction = torch.nn.functional.normalize(torch.tensor([[0.05], [0.02], [-1.0]]), dim=0).repeat(1, 100)
    origins = torch.tensor([[0.3], [0.2], [50.0]]).repeat(1, 100)
    hit = stops(visibility, origins, direction, PixelRandom(0, 0, torch.arange(100)))
    assert (hit.triangle >= 2).all()
    assert not visibility.transmittance(origins, direction, torch.full((100,), 90.0), torch.ones(100), PhaseTimer())[0].any()


def test_a_sheet_before_a_constant_sky():
    for opacity in (0.0, 0.3, 1.0):
        seen = scene([rectangle(0)], [sheet(opacity, 0.6)], sky(2.0))
        samples = estimates(seen, (0, 0, 1), (0.1, 0.2, -1.0))
        assert mean_test(samples, 2.0 * ((1.0 - opacity) + 0.6 * opacity), tolerance=1e-5) > SIGNIFICANCE


def test_a_furnace_full_of_white_sheets_stays_white():
    meshes = [rectangle(0, (0.0, 0.1 * i, -0.2 * i), (20.0 * i, 30.0 * i, 0.0)) for i in range(6)]
    samples = estimates(scene(meshes, [sheet(0.5, 1.0)], sky(1.0), max_depth=60), (0, 0, 1), (0.1, 0.05, -1.0))
    assert mean_test(samples, 1.0, tolerance=1e-4) > SIGNIFICANCE


def test_crossings_are_no_segments_and_masks_are_sharp():
    """Forty sheets, then an emitter, seen by paths of one segment."""
    panes = [rectangle(0, (0.0, 0.0, -0.01 * i)) for i in range(40)]
    behind = scene([*panes, rectangle(1, (0.0, 0.0, -1.0))], [sheet(0.02), emitter()], max_depth=1)
    assert mean_test(estimates(behind, (0, 0, 1), (0, 0, -1), 50_000), 0.98**40 * LIGHT) > SIGNIFICANCE
    masked = scene([rectangle(0), rectangle(1, (0.0, 0.0, -1.0))], [checker(), emitter()], max_depth=1)
    for x in (-0.75, -0.26, -0.24, 0.25, 0.75):
        for y in (-0.75, -0.25, 0.24, 0.26, 0.75):
            hole = (math.floor(2 * x) + math.floor(2 * y)) % 2 == 1  # u grows with x, v with -y
            assert (estimates(masked, (x, y, 1), (0, 0, -1), 5)[0] == hole).all()


def test_the_surface_that_counts_is_the_one_reported():
    seen = scene([rectangle(0), rectangle(1, (0, 0, -2.0), (0.0, 0.0, 0.0))], [sheet(0.25, 0.9), matte(0.2)])
    found = trace(seen, (0.3, 0, 1), (0, 0, -1), 20_000)
    front = found.albedo[0] > 0.5
    assert z_test(front.double().mean().item() - 0.25, math.sqrt(0.25 * 0.75 / 20_000)) > SIGNIFICANCE
    torch.testing.assert_close(found.distance, torch.where(front, 1.0, 3.0))
    assert found.rays > 20_000 * 1.7


def one_technique(technique: str, monkeypatch) -> None:
    """Leave one of the two techniques of direct light."""
    if technique == "bounce rays":
        bsdf_sampling_only(monkeypatch)
    elif technique == "light samples":
        monkeypatch.setenv(native.SWITCH, "0")
        monkeypatch.setattr(PowerLightSampler, "triangle_pdf", lambda *arguments: torch.full_like(arguments[-1], math.inf))
        monkeypatch.setattr(mis, "power_heuristic", lambda pdf, other: (other < math.inf).float())


HUNG = rectangle(1, (0.3, 1.0, 0.1), DOWN, 0.5)
DIRECT = 0.7 / math.pi * 5.0 * LIGHT * polygon_irradiance(RECTANGLE, np.array([0.0, 1.0, 0.0]))
"""What a matte floor of albedo 0.7 shows of that emitter."""


def below(meshes: list[Mesh], materials: list[Material]) -> np.ndarray:
    """Estimates of the floor's radiance at the origin with more meshes, of materials from 2 on, over it."""
    lit = scene([rectangle(0, rotate=UP, scale=20.0), HUNG, *meshes], [matte(0.7), emitter(5.0), *materials])
    return estimates(lit, (0.0, 0.02, 0.0), (0.0, -1.0, 0.0), 60_000)


@pytest.mark.parametrize("technique", ["both", "bounce rays", "light samples"])
def test_sheets_before_a_lamp_dim_it(technique, monkeypatch):
    one_technique(technique, monkeypatch)
    panes = [rectangle(2, (0, 0.3, 0), UP, 9.0), rectangle(3, (0, 0.5, 0), (60.0, 0.0, 0.0), 9.0)]
    samples = below(panes, [sheet(0.4), sheet(0.2)])
    assert mean_test(samples, 0.6 * 0.8 * DIRECT) > SIGNIFICANCE


@pytest.mark.parametrize("technique", ["both", "bounce rays", "light samples"])
def test_a_mask_casts_the_shadow_of_its_fields(technique, monkeypatch):
    """Against the same fields as rectangles."""
    one_technique(technique, monkeypatch)
    mask = rectangle(2, (0.2, 0.6, 0.1), UP, 0.4)
    samples = below([mask], [checker()])
    centres = (np.arange(4) - 1.5) * 0.2
    fields = [
        rectangle(2, (0.2 + x, 0.6, 0.1 + z), UP, 0.1)
        for i, x in enumerate(centres)
        for j, z in enumerate(centres)  # v grows with z
        if (i + j) % 2 == 1
    ]
    expected = below(fields, [matte(0.0)])
    assert agreement(samples, expected) > SIGNIFICANCE
    assert mean_test(samples, DIRECT) < SIGNIFICANCE


@pytest.mark.parametrize("technique", ["both", "bounce rays", "light samples"])
def test_a_translucent_lamp_shines_as_far_as_it_is_there(technique, monkeypatch):
    """An emitter of opacity 0.3 before one of half the size that is opaque."""
    one_technique(technique, monkeypatch)
    glow = replace(emitter(5.0), opacity=0.3, alpha_mode="blend")
    over = rectangle(3, (0.3, 1.0, 0.1), DOWN, 0.5)
    lit = scene([rectangle(0, rotate=UP, scale=20.0), over], [matte(0.7), emitter(5.0), matte(), glow])
    samples = estimates(lit, (0.0, 0.02, 0.0), (0.0, -1.0, 0.0), 60_000)
    assert mean_test(samples, 0.3 * DIRECT) > SIGNIFICANCE
    assert mean_test(estimates(lit, (0.3, 0.5, 0.1), (0, 1, 0)), 0.3 * 5.0 * LIGHT) > SIGNIFICANCE


def crowded(material: Material):
    """Sheets close to a plate, to an emitter and between them, a translucent emitter, a masked one, and a window in the sky."""
    stars = np.ones((2, 2, 4), np.float32)
    stars[0, 0, 3] = stars[1, 1, 3] = 0.0
    masked = replace(emitter(4.0, double_sided=True), base_color_texture=Texture(stars), alpha_mode="mask")
    meshes = [
        rectangle(0, rotate=UP, scale=3.0),
        rectangle(1, (0.0, 0.5, 0.0), (-60.0, 20.0, 0.0), 0.5),
        rectangle(4, (0.0, 0.505, 0.003), (-60.0, 20.0, 0.0), 0.3),
        rectangle(2, (0.4, 1.6, 0.3), DOWN, 0.5),
        rectangle(4, (0.4, 1.599, 0.3), DOWN, 0.4),
        rectangle(3, (-0.8, 1.0, 0.5), (0.0, 110.0, 0.0), 0.4),
        rectangle(5, (0.3, 1.0, -0.8), (0.0, 0.0, 0.0), 0.4),
        rectangle(4, (0.2, 1.1, 0.2), (20.0, 0.0, 10.0), 0.3),
    ]
    materials = [
        matte(0.3),
        material,
        emitter(2.0),
        replace(emitter(3.0), opacity=0.6, alpha_mode="blend"),
        sheet(0.5, 0.4),
        masked,
    ]
    return scene(meshes, materials, sky_with_a_window(6.0), max_depth=4)


@pytest.mark.parametrize(
    "material",
    [matte(0.6), Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)],
    ids=["matte", "metal"],
)
def test_both_techniques_through_sheets_agree_with_one_alone(material, monkeypatch):
    ray = ((0.1, 1.3, 1.5), (-0.1, -0.8, -1.5))
    both = estimates(crowded(material), *ray, count=60_000)
    bsdf_sampling_only(monkeypatch)
    alone = estimates(crowded(material), *ray, count=120_000, seed=1)
    assert both.mean() > 0.01
    assert agreement(both, alone) > SIGNIFICANCE


def test_a_path_through_sheets_does_not_depend_on_those_beside_it():
    tracer = PathTracer(crowded(matte(0.6)))
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(3, 3000, generator=generator), dim=0)
    origins, random = torch.tensor([[0.1], [0.8], [0.4]]).repeat(1, 3000), PixelRandom(0, 1, torch.arange(3000))
    whole = tracer.trace(origins, directions, random, path_tracer.PhaseTimer())
    index = torch.arange(0, 3000, 7)
    part = tracer.trace(origins[:, index], directions[:, index], random.select(index), path_tracer.PhaseTimer())
    torch.testing.assert_close(part.radiance, whole.radiance[:, index], rtol=1e-5, atol=1e-6)


def test_no_random_number_is_used_twice(monkeypatch):
    """Crossings draw from dimensions of their own, whatever the segment."""
    monkeypatch.setenv(native.SWITCH, "0")  # the native core draws by itself
    drawn = []

    def record(kind: str) -> None:
        draw = getattr(PixelRandom, kind)

        def recorded(self, dimension, count, **keywords):
            drawn.extend(range(dimension, dimension + count))
            return draw(self, dimension, count, **keywords)

        monkeypatch.setattr(PixelRandom, kind, recorded)

    record("uniform")
    record("stratified")
    estimates(crowded(matte(0.6)), (0.1, 1.3, 1.5), (-0.1, -0.8, -1.5), 500)
    assert len(drawn) > 30
    assert len(set(drawn)) == len(drawn)
