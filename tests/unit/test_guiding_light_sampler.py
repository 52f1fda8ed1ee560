"""The learned choice of light samples: by tile, at the ends of epochs, without bias."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.learned_lights import LearnedLights
from bokehguide.guiding.light_sampler import (
    MIN_VISIBILITY,
    PRIOR_VISIBLE,
    SMALLEST,
    TILES,
    LearnedLightSampler,
    LightSamples,
)
from bokehguide.guiding.mis_factors import MIN_FACTOR, STEPS
from bokehguide.guiding.tile_pools import OWN, POOLS, SCALE_SQUARE, SQUARES
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.shapes import spheres, transform, transformed, unit_rectangle
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.rooms import sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, z_test

WIDTH, HEIGHT = 48, 27


def parted(factor: float = 1.0) -> Scene:
    """A floor, a wall across it and an emitter on either side: each lights one half, and the right one is much brighter."""
    white, black = Material("white", (0.7,) * 3, specular=0.0), Material("black", (0.0,) * 3, specular=0.0)
    bulbs = [Material(f"bulb {each:g}", (0.0,) * 3, specular=0.0, emission=(each * factor,) * 3) for each in (30.0, 600.0)]
    floor = transformed(unit_rectangle(), transform((0.0, 0.0, 0.0), (-90.0, 0.0, 0.0), 3.0))
    wall = transformed(unit_rectangle(), transform((0.0, 1.0, 0.0), (0.0, 90.0, 0.0), (3.0, 1.0, 1.0)))
    emitters = [replace(spheres(np.array([[x, 0.8, 0.0]]), 0.05, 1), material=2 + side) for side, x in enumerate((-1.0, 1.0))]
    meshes = (floor, replace(wall, material=1), *emitters)
    camera = Camera((0.0, 5.0, 0.01), (0.0, 0.0, 0.0), fov=40.0, aperture_radius=0.02, focus_distance=5.0)
    materials = (white, replace(black, double_sided=True), *bulbs)
    return Scene("parted", camera, meshes, materials, film=FilmSettings(WIDTH, HEIGHT, 2))


def camera(width: int = WIDTH, height: int = HEIGHT) -> ThinLensCamera:
    return ThinLensCamera(parted().camera, width, height, torch.device("cpu"))


def guide_of(width: int = WIDTH, height: int = HEIGHT, clusters: int = 5) -> LearnedLightSampler:
    power = SimpleNamespace(lights=SimpleNamespace(clusters=SimpleNamespace(count=clusters, triangles=clusters, map=False)))
    return LearnedLightSampler(camera(width, height), power, GuidedConfig())


def loop_of(scene: Scene, seed: int = 0, config: GuidedConfig = GuidedConfig(), mode: str = "guided") -> RenderLoop:
    return RenderLoop(scene, RenderSettings(mode, seed=seed, threads=1, guided=config))


def rendered(scene: Scene, steps: int) -> RenderLoop:
    with loop_of(scene) as loop:
        for _ in range(steps):
            loop.step()
    return loop


def seen_in(camera: ThinLensCamera, pixels: torch.Tensor, depth: float = 5.0) -> torch.Tensor:
    """World points `[3, N]` that the lens centre sees at pixel centres, at `depth` metres along the axis."""
    raster = torch.stack((pixels % camera.width + 0.5, pixels // camera.width + 0.5))
    x, y = camera.slopes(raster) * depth
    return camera.axes @ torch.stack((x, y, torch.full_like(x, depth))) + camera.position


@pytest.mark.parametrize("depth", [0.3, 5.0, 400.0])
@pytest.mark.parametrize("width, height", [(48, 27), (200, 100), (90, 333), (1, 1)])
def test_tiles_are_squares_and_few(width, height, depth):
    """As the lens centre sees them, at any distance."""
    guide = guide_of(width, height)
    tiles = guide.tiles(seen_in(camera(width, height), torch.arange(width * height), depth)).reshape(height, width)
    size = max(-(-max(width, height) // TILES), SMALLEST)
    assert torch.equal(tiles[::size, ::size].flatten(), torch.arange(len(guide.probability)))
    assert bool((tiles == tiles[::size, ::size].repeat_interleave(size, 0).repeat_interleave(size, 1)[:height, :width]).all())
    assert len(guide.probability) <= TILES**2


def test_points_outside_the_frame_have_a_tile_at_its_edge():
    guide, view = guide_of(), camera()
    corners = torch.tensor([0, WIDTH - 1, (HEIGHT - 1) * WIDTH, HEIGHT * WIDTH - 1])
    inside = seen_in(view, corners)
    middle = view.position + 5.0 * view.axes[:, 2:]
    assert torch.equal(guide.tiles(middle + 3.0 * (inside - middle)), guide.tiles(inside))
    everywhere = torch.cat((torch.randn(3, 1000) * 100.0, view.position, torch.full((3, 1), 1e37)), dim=1)
    tiles = guide.tiles(everywhere)
    assert tiles.min() >= 0 and tiles.max() < len(guide.probability)


def test_the_probability_is_proportional_to_the_roots_of_estimated_moments():
    """Against plain loops over tiles, but for the estimates of moments."""
    guide = guide_of(20 * SMALLEST, 12 * SMALLEST)
    generator = torch.Generator().manual_seed(1)
    count = 3000
    tiles = torch.randint(240, (count,), generator=generator)
    clusters = torch.randint(-1, 4, (count,), generator=generator)  # the last cluster is never seen
    contribution_rms = torch.rand(count, generator=generator) * (tiles > 60)
    seen = torch.rand(count, generator=generator) * (clusters != 3)
    guide.add([guide.batch(LightSamples(tiles.int(), clusters.int(), contribution_rms, seen, seen), seen)])
    guide.update(2)
    sums = np.zeros((12, 20, 3, 5))
    for tile, cluster, value, arrived in zip(tiles.tolist(), clusters.tolist(), contribution_rms.tolist(), seen.tolist()):
        if cluster >= 0:
            sums[tile // 20, tile % 20, :, cluster] += value**2, 1.0, arrived
    estimates = guide.pools.shrunk(*(torch.from_numpy(sums[:, :, each].reshape(240, 5)) for each in (0, 2))).numpy()
    for row in range(12):
        for column in range(20):
            pooled = 0.0
            for size, share in ((1, OWN), *POOLS):
                half = size // 2
                around = sums[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
                pooled = pooled + share * around.mean((0, 1))
            _, tried, arrived = pooled
            roots = np.sqrt(estimates[row * 20 + column])
            expected = roots / roots.sum() if roots.any() else np.full(5, 0.2)
            np.testing.assert_allclose(guide.probability[row * 20 + column], expected, rtol=1e-4, atol=1e-12)
            share = np.maximum((arrived + PRIOR_VISIBLE) / (tried + PRIOR_VISIBLE), MIN_VISIBILITY)
            np.testing.assert_allclose(guide.visibility[row * 20 + column], share, rtol=1e-4)
    assert bool((guide.visibility[:, 4] == 1.0).all()) and 0.0 < float(guide.visibility[:, 3].max()) < 1.0


def test_one_infinite_sample_leaves_the_rest_of_the_frame_as_it_is():
    size = (20 * SMALLEST, 12 * SMALLEST)
    generator = torch.Generator().manual_seed(3)
    count = 3000
    tiles, clusters = (torch.randint(end, (count,), generator=generator).int() for end in (240, 5))
    contribution_rms, seen = torch.rand(2, count, generator=generator)
    spoilt, whole = guide_of(*size), guide_of(*size)
    for guide in (spoilt, whole):
        guide.add([guide.batch(LightSamples(tiles, clusters, contribution_rms, seen, seen - 0.5), seen)])
    first, infinite = torch.zeros(500, dtype=torch.int32), torch.full((500,), torch.inf)
    spoilt.add([spoilt.batch(LightSamples(first, first, infinite, torch.ones(500), infinite), torch.ones(500))])
    for guide in (spoilt, whole):
        guide.update(2)
    reach = SQUARES[0] // 2 + SCALE_SQUARE // 2
    beyond = torch.ones(12, 20, dtype=torch.bool)
    beyond[: reach + 1, : reach + 1] = False
    assert torch.equal(spoilt.probability[beyond.flatten()], whole.probability[beyond.flatten()])
    assert torch.equal(spoilt.factors.factor[beyond.flatten()], whole.factors.factor[beyond.flatten()])
    assert bool(spoilt.factors.factor.isfinite().all())
    assert bool(spoilt.probability.isfinite().all()) and float(spoilt.probability[0, 0]) > 3.0 * float(whole.probability[0, 0])


def test_an_emitter_behind_the_wall_is_hardly_sampled():
    loop = rendered(parted(), 16)
    emitters = loop.tracer.lights
    triangles = torch.arange(len(loop.tracer.geometry.material))[-len(emitters.triangles) :]
    left = loop.tracer.geometry.corners(triangles).mean(0)[0] < 0.0
    cluster = emitters.grid.cluster(emitters.emitter[triangles])
    of_left = torch.zeros(emitters.clusters.count, dtype=torch.bool)
    of_left[cluster[left]] = True
    sampler = loop.mode.lights.sampler
    tiles = sampler.tiles(seen_in(loop.camera, torch.arange(HEIGHT * WIDTH)))
    by_left = (sampler.probability * of_left).sum(1)[tiles].reshape(HEIGHT, WIDTH)
    assert by_left[:, :8].min() > 0.9 and by_left[:, 28:].max() < 0.05


def errors(learns: bool) -> tuple[np.ndarray, np.ndarray]:
    """Means over the shade of 24 renders of 8 steps, and the variance of its pixels."""
    found = []
    for seed in range(24):
        with loop_of(parted(), seed, GuidedConfig(learn_lights=learns)) as loop:
            for _ in range(8):
                loop.step()
        found.append(loop.film.radiance()[:, :20, 1].numpy())
    found = np.stack(found)
    return found.mean((1, 2)), found.var(axis=0, ddof=1)


@pytest.mark.slow
def test_learning_halves_the_variance_and_keeps_the_mean():
    learning, by_cell = errors(True), errors(False)
    assert np.median(learning[1]) < 0.5 * np.median(by_cell[1])
    difference = learning[0].mean() - by_cell[0].mean()
    error = np.sqrt(learning[0].var(ddof=1) / 24 + by_cell[0].var(ddof=1) / 24)
    assert z_test(np.array([difference]), np.array([error])) > SIGNIFICANCE
    assert error < 0.02 * by_cell[0].mean()


def test_the_sampler_learns_at_the_ends_of_epochs_only():
    seen = []
    with loop_of(parted()) as loop:
        for _ in range(9):
            loop.step()
            seen.append((int(loop.mode.lights.sampler.epoch), loop.mode.lights.sampler.probability.clone()))
    assert [epoch for epoch, _ in seen] == [2, 3, 3, 5, 5, 5, 5, 9, 9]
    assert all(torch.equal(one[1], two[1]) == (one[0] == two[0]) for one, two in pairwise(seen))


def test_the_sampler_does_not_depend_on_the_unit_of_radiance():
    """A power of two, so that nothing is rounded."""
    dim, bright = rendered(parted(), 9), rendered(parted(2.0**20), 9)
    assert torch.equal(dim.mode.lights.sampler.probability, bright.mode.lights.sampler.probability)
    assert torch.equal(dim.film.radiance() * 2.0**20, bright.film.radiance())


@pytest.mark.parametrize("emissive, map_, counts", [(True, True, (5, 0)), (True, False, (5, 0)), (False, True, (4, 1))])
def test_bsdf_candidates_are_for_scenes_that_a_map_alone_lights(emissive, map_, counts):
    lit = replace(parted(), environment=sky_with_a_window(6.0) if map_ else None)
    if not emissive:
        lit = replace(lit, materials=tuple(replace(material, emission=(0.0,) * 3) for material in lit.materials))
    with RenderLoop(lit, RenderSettings(spp=2)) as loop:
        assert loop.mode.lights.sampler.counts == counts


def test_modes_of_the_paper_and_dark_scenes_learn_no_lights():
    with loop_of(parted(), mode="lis-o") as loop:
        assert not isinstance(loop.mode.lights, LearnedLights)
    dark = rendered(parted(0.0), 3)
    assert not isinstance(dark.mode.lights, LearnedLights) and not dark.film.radiance().any()


def test_a_loop_without_light_goes_on():
    """No path reaches the emitters: nothing is learned, and nothing fails."""
    shut = replace(scenes.emitters(32, 18), film=FilmSettings(32, 18, 1))
    sampler = rendered(shut, 5).mode.lights.sampler
    assert not sampler.sums[0].any()
    assert bool((sampler.probability == 1.0 / sampler.probability.shape[1]).all())


def test_factors_of_mis_weights_minimise_the_second_moment():
    """Of X = U + θ D, by plain loops over the pooled samples, among factors in range; tiles without samples keep 1."""
    guide, generator = guide_of(20 * SMALLEST, 12 * SMALLEST), torch.Generator().manual_seed(2)
    size, pools = (12, 20), ((1, OWN), *POOLS)
    own = torch.rand(240, generator=generator)
    own[200:] = torch.tensor((1.6, -0.6)).repeat_interleave(10).repeat(2)
    products = np.zeros((2, *size, 2))
    for epoch in range(2):  # the second epoch adds to samples with the factors of the first
        tiles = torch.randint(120, 240, (6000,), generator=generator)
        change, noise = torch.randn(2, 6000, generator=generator)
        rest = 0.1 * noise - own[tiles] * change
        reflected = rest + guide.factors.factor[tiles] * change
        samples = LightSamples(tiles.int(), torch.zeros_like(tiles).int(), noise.abs(), noise.abs(), change)
        guide.add([guide.batch(samples, reflected)])
        for tile, one, other in zip(tiles.tolist(), rest.tolist(), change.tolist()):
            products[epoch, tile // 20, tile % 20] += one * other, other * other
        guide.update(2 + epoch)
        sums = products[: epoch + 1].sum(0)
        for row, column in ((0, 3), (6, 0), (7, 8), (11, 19), (11, 2), (9, 10)):
            pooled = 0.0
            for width, share in pools:
                half = width // 2
                around = sums[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
                pooled = pooled + share * around.mean((0, 1))
            expected = np.clip(-pooled[0] / pooled[1], MIN_FACTOR, 1.0) if pooled[1] > 0.0 else 1.0
            np.testing.assert_allclose(guide.factors.factor[row * 20 + column], np.round(expected * STEPS) / STEPS, rtol=1e-6)
    learned = guide.factors.factor[120:]
    assert float(learned.min()) < 0.4 and float(learned.max()) > 0.6 and bool((guide.factors.factor[:20] == 1.0).all())


def test_factors_of_mis_weights_do_not_depend_on_the_batches():
    generator = torch.Generator().manual_seed(5)
    tiles = torch.randint(0, 240, (9000,), generator=generator).int()
    change = 10.0 ** torch.empty(9000).uniform_(-6.0, 6.0, generator=generator)
    reflected = change * torch.rand(9000, generator=generator)
    found = []
    for size in (9000, 1000, 77, 1):
        guide = guide_of(20 * SMALLEST, 12 * SMALLEST)
        for first in range(0, 9000, size):
            part = slice(first, first + size)
            one = torch.ones(len(tiles[part]))
            guide.add([guide.batch(LightSamples(tiles[part], tiles[part] * 0, one, one, change[part]), reflected[part])])
        guide.update(2)
        found.append(guide.factors.factor)
    assert float(found[0].std()) > 0.1 and all(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.slow
def test_broad_light_moves_to_bsdf_samples_where_shadow_rays_are_blocked():
    """Under an even sky, a wall blocks shadow rays of a floor. The variance falls, and the mean remains."""
    sky = np.ones((8, 16, 3), np.float32)
    sky[3] = 1.5  # an even map has no light samples
    scene = replace(parted(0.0), environment=Environment(sky))
    found = {}
    for learns in (True, False):
        loops = []
        for seed in range(24):
            with loop_of(scene, seed, GuidedConfig(reuse_group=1, learn_mis=learns)) as loop:
                for _ in range(8):
                    loop.step()
            loops.append(loop)
        factors = torch.stack([loop.mode.lights.sampler.factors.factor for loop in loops])
        assert (float(factors.median()) < 0.9) == learns
        found[learns] = np.stack([loop.film.radiance()[..., 1].numpy() for loop in loops])
    assert np.median(found[True].var(axis=0)) < 0.85 * np.median(found[False].var(axis=0))
    one, other = (found[learns].mean((1, 2)) for learns in (True, False))
    error = np.sqrt((one.var(ddof=1) + other.var(ddof=1)) / 24)
    assert z_test(np.array([one.mean() - other.mean()]), np.array([error])) > SIGNIFICANCE


@pytest.mark.parametrize("name, value", [("factors.sums", torch.nan), ("factors.factor", 0.01), ("factors.factor", 1.5)])
def test_factors_out_of_range_are_refused(name, value):
    state = guide_of().state_dict()
    state[name] = torch.full_like(state[name], value)
    with pytest.raises(ValueError, match="out of range"):
        guide_of().load_state_dict(state)


@pytest.mark.parametrize("name, value", [("sums", -1.0), ("visibility", -0.1), ("probability", -0.1), ("probability", 0.4)])
def test_states_that_no_render_has_are_refused(name, value):
    guide = guide_of()
    guide.update(2)
    state = guide.state_dict()
    state[name] = state[name].clone()
    state[name][..., 3, 2] = value
    with pytest.raises(ValueError, match="do not sum to 1"):
        guide_of().load_state_dict(state)
