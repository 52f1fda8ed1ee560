"""Agreement of the native core and PyTorch on sums over samples, for each number of threads, and on the numbers of groups."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.layered_record import VoxelRecord
from bokehguide.guiding.light_sampler import LearnedLightSampler, LightBatch
from bokehguide.guiding.pixel_groups import PixelGroups
from bokehguide.guiding.record_buffer import RecordBuffer
from bokehguide.guiding.success_rates import SuccessRates
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.features import ControlVariateFeatures, MeanFeatures, RatioFeatures
from bokehguide.render.film import NO_DEPTH, Film, FilmSamples
from bokehguide.runtime import native
from bokehguide.scene import load_scene

WIDTH, HEIGHT = 83, 37
THREADS = (1, 2, 3, 16)
BATCHES = (45_000, 0, 1, 25_000)
"""Numbers of samples of the batches: enough for several threads."""

pytestmark = pytest.mark.skipif(native.core() is None, reason="the native core is not built")


def camera() -> ThinLensCamera:
    return ThinLensCamera(load_scene("chrome").camera, WIDTH, HEIGHT)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def split(*values: Tensor) -> list[tuple[Tensor, ...]]:
    """The values `[.., N]` of each batch."""
    return list(zip(*(each.split(BATCHES, -1) for each in values)))


def agree(monkeypatch, compute: Callable[[int], Sequence[Tensor]], **tolerance: float) -> Sequence[Tensor]:
    """The results of PyTorch, which those of the core must equal for each number of threads."""
    monkeypatch.setenv(native.SWITCH, "0")
    expected = compute(1)
    monkeypatch.setenv(native.SWITCH, "1")
    for threads in THREADS:
        for found, value in zip(compute(threads), expected, strict=True):
            torch.testing.assert_close(found, value, **(tolerance or {"rtol": 0.0, "atol": 0.0}), equal_nan=True)
    return expected


def hits(cells: int) -> list[tuple[Tensor, ...]]:
    """Cells, positions and luminance of many samples in 60 cells from the first to the last. Some are in no cell."""
    count, random = sum(BATCHES), generator(5)
    at = torch.randint(-1, 60, (count,), generator=random) * (cells - 1) // 59
    points = torch.randn(3, count, generator=random)
    points[2] = points[2].abs() * 4.0 + 0.01
    points[2, 7::50] = camera().lens.focus_distance
    points[2, 9::50] = 1e9
    light = torch.exp(3.0 * torch.randn(count, generator=random))
    light[3::40] = 0.0
    return split(at.clamp(min=-1), points, light)


def test_records_have_the_same_bits(monkeypatch):
    def sums(threads: int) -> list[Tensor]:
        record = RecordBuffer(camera())
        record.add(hits(record.sums.shape[1]), threads)
        record.add(hits(record.sums.shape[1])[::-1], threads)
        return [record.mine]

    (found,) = agree(monkeypatch, sums)
    assert (found[0] > 0).sum() == 60 and found[0, 0] > 0 and found[0, -1] > 0


@pytest.mark.parametrize("by_depth", (True, False))
def test_voxels_have_the_same_bits(by_depth, monkeypatch):
    def sums(threads: int) -> list[Tensor]:
        record = VoxelRecord(camera(), by_depth=by_depth)
        for threshold in (20.0, 1.0):  # the second time, some cells have voxels
            record.add(hits(record.sums.shape[1]), threshold, threads)
            record.merge_voxels()
        record.add(hits(record.sums.shape[1])[:2], 1e30, threads)
        return [record.mine, record.sums, record.voxels, *record._new]

    *_, voxels, waiting = agree(monkeypatch, sums)
    assert len(voxels) > (100 if by_depth else 30) and 500 < len(waiting) < BATCHES[0]


def test_draws_have_the_same_bits(monkeypatch):
    slots = torch.randint(0, 40, (sum(BATCHES),), generator=generator(1), dtype=torch.int32)
    squared = torch.exp(4.0 * torch.randn(len(slots), generator=generator(2)))

    def sums(threads: int) -> list[Tensor]:
        rates = SuccessRates(camera(), 12)
        rates.add(split(slots, squared), threads)
        return [rates.mine]

    (found,) = agree(monkeypatch, sums)
    assert found[0].sum() == len(slots) and (found[1] > 0.0).sum() == 40


def light_sampler(width: int, height: int, clusters: int = 5) -> LearnedLightSampler:
    power = SimpleNamespace(lights=SimpleNamespace(clusters=SimpleNamespace(count=clusters, triangles=clusters, map=False)))
    return LearnedLightSampler(ThinLensCamera(load_scene("chrome").camera, width, height), power, GuidedConfig())


def test_light_samples_have_the_same_bits(monkeypatch):
    count, clusters, random = sum(BATCHES), 5, generator(8)
    tiles = torch.randint(0, 210, (count,), generator=random, dtype=torch.int32)
    cluster = torch.randint(-1, clusters, (count,), generator=random, dtype=torch.int32)
    contribution = torch.exp(9.0 * torch.randn(count, generator=random))
    contribution[::90], contribution[1::90], contribution[2::90] = torch.nan, torch.inf, 1e30
    visibility = torch.rand(count, generator=random)

    def sums(threads: int) -> list[Tensor]:
        lights = light_sampler(WIDTH, HEIGHT, clusters)
        moments = torch.rand(*lights.factors.sums.shape, generator=generator(3), dtype=torch.float64)
        lights.add([LightBatch(*batch, moments) for batch in split(tiles, cluster, contribution, visibility)], threads)
        return [lights.mine, lights.factors.mine]

    found, _ = agree(monkeypatch, sums)
    assert found.shape[1:] == (210, clusters) and found[1].sum() == (cluster >= 0).sum() and found[0].max() > 1e30


@pytest.mark.parametrize("width, height", ((83, 37), (37, 83), (9, 400), (3, 3)))
def test_pools_of_tiles_agree(width, height, monkeypatch):
    lights = light_sampler(width, height, clusters := 400)
    total = torch.exp(5.0 * torch.randn(len(lights.probability), clusters, generator=generator(4), dtype=torch.float64))
    (pooled,) = agree(monkeypatch, lambda threads: [lights.pools.pooled(total, threads)], rtol=1e-13, atol=0.0)
    assert len(total) == 1 or bool((pooled != total).all())


@pytest.mark.parametrize("width, height", ((320, 180), (37, 83), (9, 400), (3, 3)))
@pytest.mark.parametrize("clusters", (1, 40, 256))
def test_estimates_of_second_moments_agree(width, height, clusters, monkeypatch):
    """Also where nothing arrived, in tiles, in clusters and by chance."""
    pools, random = light_sampler(width, height, clusters).pools, generator(4)
    moments, arrived = torch.exp(5.0 * torch.randn(2, pools.across * pools.down, clusters, generator=random, dtype=torch.float64))
    moments[arrived < 0.1] = arrived[arrived < 0.1] = 0.0
    moments[1::7] = arrived[1::7] = 0.0
    moments[:, 1::5] = arrived[:, 1::5] = 0.0
    (found,) = agree(monkeypatch, lambda threads: [pools.shrunk(moments, arrived, threads)], rtol=1e-12, atol=0.0)
    assert bool((found[:, 1::5] == 0.0).all()) and (found > 0.0).any() == moments.any()


@pytest.mark.parametrize("features", (MeanFeatures, ControlVariateFeatures, RatioFeatures))
@pytest.mark.parametrize("consecutive", (True, False))
def test_sums_of_films_agree(features, consecutive, monkeypatch):
    """Some samples miss all surfaces, and some are not finite."""
    count = 1001
    pixels = slice(5, 5 + count) if consecutive else torch.arange(1, 3 * count, 3)

    def sums(_: int) -> list[Tensor]:
        film, random = Film(WIDTH, HEIGHT, features=features), generator(7)
        for step in range(1, 4):
            radiance, normal, albedo, emission, (weight, alpha, depth) = 2.0 * torch.rand(5, 3, count, generator=random)
            depth[step::3], weight[::5], radiance[1, 40], weight[41] = NO_DEPTH, 0.0, torch.nan, torch.inf
            given = FilmSamples(weight, radiance, alpha.clamp(max=1.0), depth, normal, albedo, emission)
            film.add(pixels, given, step)
        return list(film._sums().values())

    found = agree(monkeypatch, sums, rtol=1e-5, atol=1e-6)
    assert all(bool(values.any()) for values in found)


@pytest.mark.parametrize("width", (1, 16, 33, 83))
@pytest.mark.parametrize("size", (2, 4, 16, 64))
def test_groups_have_the_same_numbers(width, size, monkeypatch):
    for key in (0, 1, 0x12345678, 0xFEDCBA98):
        for scattered in (False, True):
            groups = PixelGroups.of(width, size, key, scattered)
            for places in (slice(0, width * HEIGHT), slice(width, 3 * width), torch.arange(0, width * HEIGHT, 3)):
                agree(monkeypatch, lambda _, groups=groups, places=places: groups.numbered(places, "cpu"))


def test_cells_outside_the_record_are_refused():
    for record in (RecordBuffer(camera()), VoxelRecord(camera())):
        outside = torch.tensor([record.sums.shape[1]]), torch.ones(3, 1), torch.ones(1)
        with pytest.raises(IndexError, match="cell outside the record"):
            record.add([outside], 0.0, 2) if isinstance(record, VoxelRecord) else record.add([outside], 2)
