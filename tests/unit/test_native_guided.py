"""Agreement of the native core and PyTorch on the traces of the mode `guided`: splits, learned lights, virtual images."""

import pytest
import torch

from bokehguide.render.native_hits import NativeHits
from tests.support.guided_traces import COUNT, FLIPS, Traced, differing
from tests.support.native_cases import FEATURES, MANY_SUNS, both_tracers, each_instruction_set, rays

LIT = tuple(name for name in FEATURES if name != "dark")
BUILT_IN = ("fairy-lights", "chrome", "daylight", "cutout")


def both(name: str, count: int = COUNT, **options) -> tuple[Traced, Traced]:
    """The trace in the native core and in PyTorch."""
    native, reference = (Traced(tracer, name, rays(name, count), **options) for tracer in both_tracers(name))
    assert isinstance(native.hits, NativeHits) and not isinstance(reference.hits, NativeHits)
    return native, reference


@pytest.mark.parametrize("learned", (False, True))
@pytest.mark.parametrize("name", (*LIT, "fairy-lights", "daylight"))
def test_split_paths_agree(name, learned):
    """Rows of the record agree but for a few paths that rounding sends elsewhere."""
    alive = torch.rand(COUNT, generator=torch.Generator().manual_seed(3)) - 0.1
    found, expected = both(name, learned=learned, alive=alive)
    assert differing(found.samples.radiance, expected.samples.radiance) <= 4.0 * FLIPS
    for field in ("distance", "normal", "albedo", "emission", "alpha"):
        assert differing(getattr(found.samples, field), getattr(expected.samples, field)) <= FLIPS, field
    assert abs(found.samples.rays - expected.samples.rays) <= 2.0 * FLIPS * expected.samples.rays
    assert torch.equal(found.hits.rays, expected.hits.rays)
    assert torch.equal(found.hits.counts, expected.hits.counts) and torch.equal(found.hits.owner, expected.hits.owner)
    for field in ("light_direction", "direct", "scattered_direction", "indirect"):
        assert differing(getattr(found.hits, field), getattr(expected.hits, field)) <= 3.0 * FLIPS, field
    for field, values in vars(expected.hits.surface).items():
        if values is None:
            assert getattr(found.hits.surface, field) is None
        else:
            assert differing(getattr(found.hits.surface, field), values) <= FLIPS, field


@pytest.mark.parametrize("learned", (False, True))
@pytest.mark.parametrize("name", (*LIT, *BUILT_IN))
def test_records_of_light_samples_agree(name, learned):
    found, expected = (traced.lights.samples[0] for traced in both(name, learned=learned))
    assert torch.equal(found.row, expected.row)
    assert (found.cluster != expected.cluster).float().mean() <= 2.0 * FLIPS
    assert differing(found.visibility, expected.visibility) <= 2.0 * FLIPS
    assert differing(found.contribution_rms, expected.contribution_rms) <= 2.0 * FLIPS
    assert differing(found.difference, expected.difference) <= 3.0 * FLIPS and bool(expected.difference.any())
    assert len(expected.cluster.unique()) > 1 or name in ("spot in the dark", "coats", "sheets")


@pytest.mark.parametrize("count", MANY_SUNS)
def test_clusters_from_tables_of_any_length_agree(count):
    """The core searches rows of at most 16 entries at once, and longer ones line by line."""
    found, expected = (traced.lights.samples[0] for traced in both(f"suns: {count}"))
    assert (found.cluster != expected.cluster).float().mean() <= 2.0 * FLIPS
    assert len(expected.cluster.unique()) > 0.7 * count


@pytest.mark.parametrize("name", ("textures", "coats", "glass", "lamps", "mirror ball", "chrome", "fairy-lights"))
def test_distances_of_virtual_images_agree(name):
    found, expected = both(name)
    distances = expected.images.distances()
    own = expected.samples.distance
    images = distances != own
    assert differing(found.images.distances(), distances) <= 4.0 * FLIPS
    assert differing(found.images.distances()[images], distances[images]) <= 0.05
    if name in ("glass", "chrome", "mirror ball"):
        assert int((images & (distances < 1e30)).sum()) > 20


def test_nan_and_infinite_rays_split_as_in_pytorch():
    given = rays("lamps", 16)
    given[1][0, 3], given[1][:, 4], given[0][1, 5] = torch.nan, 0.0, torch.inf
    found, expected = (Traced(tracer, "lamps", given, max_depth=2) for tracer in both_tracers("lamps"))
    assert torch.equal(found.hits.rays, expected.hits.rays)
    whole = torch.tensor([0, 1, 2, *range(6, 16)])
    assert differing(found.samples.radiance[:, whole], expected.samples.radiance[:, whole]) == 0.0


def test_rays_that_all_miss_or_are_dead_have_no_hits():
    origin, direction, random = rays("spot in the dark", 20)
    for given in ({"alive": torch.zeros(20)}, {"max_depth": 1}):
        found, expected = (
            Traced(tracer, "spot in the dark", (origin, direction, random), **given)
            for tracer in both_tracers("spot in the dark")
        )
        assert found.samples.primary_hits is None and expected.samples.primary_hits is None
        assert torch.equal(found.images.distances(), expected.images.distances())
        assert found.lights.samples == expected.lights.samples == []


@pytest.mark.parametrize("name", ("textures", "sheets", "lamps", "fairy-lights"))
def test_a_split_path_does_not_depend_on_its_batch(name):
    tracer, _ = both_tracers(name)
    origin, direction, random = rays(name, 2500)
    counts = torch.randint(1, 17, (2500,), generator=torch.Generator().manual_seed(4)).float()
    whole = Traced(tracer, name, (origin, direction, random), counts=counts)
    part = torch.arange(3, 2500, 3)
    alone = Traced(tracer, name, (origin[:, part], direction[:, part], random.select(part)), counts=counts[part])
    assert torch.equal(alone.samples.radiance, whole.samples.radiance[:, part])
    assert torch.equal(alone.images.distances(), whole.images.distances()[part])
    every = torch.isin(whole.hits.path_rays, part)
    assert torch.equal(alone.hits.indirect, whole.hits.indirect[:, every])
    assert torch.equal(alone.lights.samples[0].contribution_rms, whole.lights.samples[0].contribution_rms[every])


def test_all_instruction_sets_give_the_same_bits_of_guided():
    tracer, _ = both_tracers("lamps")
    given = rays("lamps", 1001)
    first, *others = each_instruction_set(lambda: Traced(tracer, "lamps", given))
    for other in others:
        torch.testing.assert_close(other.samples.radiance, first.samples.radiance, rtol=0.0, atol=0.0, equal_nan=True)
        assert torch.equal(other.images.distances(), first.images.distances())
