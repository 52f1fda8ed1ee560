"""First surfaces seen from elsewhere: the light that paths found there is what paths from elsewhere find."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.primary_hits import PrimaryHits
from bokehguide.render.random import PixelRandom
from bokehguide.render.splitting import SplitPaths
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Cone, Material, Scene, Texture
from tests.support.rooms import bsdf_sampling_only, checkered, neon, room, sky_with_a_window
from tests.support.seen_hits import seen_radiance
from tests.support.statistical import SIGNIFICANCE
from tests.support.tracing import agreement, bumpy, emitter, matte, rectangle, scene

COUNT = 12_000
PLATE = rectangle(1, (0.0, 0.5, 0.0), (-60.0, 20.0, 0.0), 0.5)
POINT = np.array([0.15, 0.25, 0.4, 0.2]) @ PLATE.vertices.astype(np.float64)
"""On the slanted plate of the room, off its middle."""
HERE, ELSEWHERE = np.array([0.5, 1.1, 1.2]), np.array([-0.5, 0.9, 0.4])


def spotty() -> Texture:
    generator = np.random.default_rng(4)
    return Texture(generator.uniform(0.2, 0.9, (8, 8, 3)).astype(np.float32))


MATERIALS = {
    "matte": matte((0.6, 0.3, 0.1)),
    "coated": Material("coated", (0.6, 0.5, 0.4), roughness=0.5),
    "rough metal": Material("metal", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.5),
    "clear-coated": Material("car", (0.5, 0.1, 0.1), roughness=0.8, clearcoat=1.0, clearcoat_roughness=0.5),
    "rough coat on bumps": Material("bumps", roughness=0.7, clearcoat=0.8, clearcoat_roughness=0.6, normal_texture=bumpy()),
    "emissive": matte(0.4, emission=(0.5, 1.0, 1.5)),
    "spotlight": matte(0.4, emission=(5.0, 10.0, 15.0), emission_cone=Cone((-0.4, 0.6, 0.69), 5.0, 60.0)),
    "emissive under a coat": matte(0.3, emission=(1.0, 2.0, 3.0), clearcoat=1.0, clearcoat_roughness=0.5),
    "textured": Material(
        "textured", roughness=0.9, metallic=0.8, base_color_texture=spotty(), metallic_roughness_texture=spotty(),
        emission=(1.0, 1.0, 1.0), emission_texture=spotty(),
    ),
}  # fmt: skip


def lit(material: Material) -> Scene:
    return room(material, sky_with_a_window(6.0), emitter(2.0))


def traced(tracer: PathTracer, origin: np.ndarray, seed: int, parts: int | Tensor = 2, count: int = COUNT) -> PathSamples:
    """Rays from a place to POINT."""
    direction = (POINT - origin) / np.linalg.norm(POINT - origin)
    rays = (torch.tensor(part, dtype=torch.float32)[:, None].repeat(1, count) for part in (origin, direction))
    random = PixelRandom(seed, 1, torch.arange(count))
    with torch.no_grad():
        return tracer.trace(*rays, random, PhaseTimer(), splitting=SplitPaths(torch.as_tensor(parts).expand(count)))


def towards(first: PrimaryHits, place: np.ndarray) -> Tensor:
    way = torch.tensor(place, dtype=torch.float32)[:, None] - first.surface.position
    return torch.nn.functional.normalize(way, dim=0)


def from_elsewhere(tracer: PathTracer, seed: int = 0) -> np.ndarray:
    first = traced(tracer, HERE, seed).primary_hits
    return seen_radiance(first, torch.arange(COUNT), towards(first, ELSEWHERE), len(first.owner)).double().numpy()


@pytest.mark.parametrize("name", MATERIALS)
def test_towards_where_the_ray_came_from_it_is_what_was_found(name):
    parts = torch.randint(1, 5, (COUNT,), generator=torch.Generator().manual_seed(1))
    samples = traced(PathTracer(lit(MATERIALS[name])), HERE, 0, parts)
    found = seen_radiance(
        samples.primary_hits, torch.arange(COUNT), towards(samples.primary_hits, HERE), len(samples.primary_hits.owner)
    )
    torch.testing.assert_close(found, samples.radiance, rtol=1e-4, atol=1e-5)
    assert float(samples.radiance.std()) > 0.01


@pytest.mark.parametrize("name", MATERIALS)
def test_towards_elsewhere_its_mean_is_what_is_seen_from_there(name):
    tracer = PathTracer(lit(MATERIALS[name]))
    expected = traced(tracer, ELSEWHERE, 1).radiance.double().numpy()
    assert agreement(from_elsewhere(tracer), expected) > SIGNIFICANCE
    if name != "matte" and name != "emissive":  # the others look different from there
        assert agreement(traced(tracer, HERE, 2).radiance.double().numpy(), expected) < 1e-6


@pytest.mark.parametrize("light", [checkered(), neon()], ids=["checkered", "neon"])
def test_so_it_is_under_lamps_with_textures_and_coats(light):
    tracer = PathTracer(room(MATERIALS["coated"], None, light))
    assert agreement(from_elsewhere(tracer), traced(tracer, ELSEWHERE, 1).radiance.double().numpy()) > SIGNIFICANCE


def test_without_light_samples_it_has_the_same_mean(monkeypatch):
    """All light is then what paths run into."""
    tracer = PathTracer(lit(MATERIALS["coated"]))
    expected = traced(tracer, ELSEWHERE, 1).radiance.double().numpy()
    bsdf_sampling_only(monkeypatch)
    samples = traced(tracer, HERE, 0)
    assert not samples.primary_hits.direct.any() and bool(samples.primary_hits.indirect.any())
    found = seen_radiance(
        samples.primary_hits, torch.arange(COUNT), towards(samples.primary_hits, HERE), len(samples.primary_hits.owner)
    )
    torch.testing.assert_close(found, samples.radiance, rtol=1e-4, atol=1e-5)
    assert agreement(from_elsewhere(tracer), expected) > SIGNIFICANCE


def test_in_the_dark_it_is_black():
    samples = traced(PathTracer(scene([PLATE], [matte(), MATERIALS["coated"]], max_depth=4)), HERE, 0)
    assert samples.primary_hits is not None
    assert not seen_radiance(
        samples.primary_hits, torch.arange(COUNT), towards(samples.primary_hits, ELSEWHERE), len(samples.primary_hits.owner)
    ).any()


def scattered(material: Material, count: int = 900) -> PathSamples:
    """Rays from one place to all sides, of which every third is not traced; some see the sky."""
    tracer = PathTracer(lit(material))
    origin = torch.tensor([0.0, 1.2, 0.6])[:, None].repeat(1, count)
    direction = torch.nn.functional.normalize(torch.randn(3, count, generator=torch.Generator().manual_seed(2)), dim=0)
    alive = torch.arange(count) % 3 / 2.0
    random, parts = PixelRandom(0, 1, torch.arange(count)), torch.arange(count) % 4 + 1
    return tracer.trace(origin, direction, random, PhaseTimer(), alive=alive, splitting=SplitPaths(parts))


@pytest.mark.parametrize("name", ["coated", "spotlight", "textured"])
def test_it_is_of_those_asked_for_alone(name):
    """Some of them, one, none, and in any order, each as among all."""
    samples = scattered(MATERIALS[name])
    first = samples.primary_hits
    number = len(first.rays)
    assert 200 < number < 399
    back = seen_radiance(first, torch.arange(number), first.surface.outgoing, len(first.owner))
    torch.testing.assert_close(back, samples.radiance[:, first.rays], rtol=1e-4, atol=1e-5)
    outgoing = torch.nn.functional.normalize(first.surface.outgoing + 0.5 * first.surface.geometric_normal, dim=0)
    whole = seen_radiance(first, torch.arange(number), outgoing, len(first.owner))
    shuffled = torch.randperm(number, generator=torch.Generator().manual_seed(3))
    for chosen in (torch.arange(0, number, 3), torch.tensor([17]), torch.tensor([], dtype=torch.int64), shuffled, shuffled[:50]):
        found = seen_radiance(first, chosen, outgoing[:, chosen], int(first.counts[chosen].sum()))
        torch.testing.assert_close(found, whole[:, chosen], rtol=1e-5, atol=1e-6)
    assert float((whole - samples.radiance[:, first.rays]).abs().max()) > 0.02


def test_the_owners_are_those_of_the_paths():
    first = scattered(MATERIALS["matte"]).primary_hits
    assert torch.equal(first.rays[first.owner], first.path_rays)
    assert torch.equal(torch.bincount(first.owner), first.rays % 4 + 1)
    assert bool((first.owner.diff() >= 0).all() and (first.rays.diff() > 0).all())
    torch.testing.assert_close(first.path_surface.position, first.surface.position[:, first.owner])
