"""Reuse of primary hits among neighbouring pixels: against plain loops, and without bias."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from bokehguide.color import LUMINANCE_WEIGHTS
from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.cross_fitting import cross_fitted
from bokehguide.guiding.lens_queries import UniformQuery
from bokehguide.guiding.native_reuse import NOWHERE
from bokehguide.guiding.pixel_groups import COLUMNS, SCATTERED_STEPS, PixelGroups
from bokehguide.guiding.pixel_reuse import GROUP_SPACING
from bokehguide.render import dimensions
from bokehguide.render.film import FilmSamples
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.random import PixelRandom, hash_int
from bokehguide.render.tracer import Hit
from bokehguide.render.vector import luminance
from bokehguide.runtime import native
from bokehguide.runtime.distributed import ROWS_PER_BAND, Ranks
from bokehguide.runtime.indexing import Pixels
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.types import Aperture, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings, adaptive
from tests.support.brute_force import every_hit
from tests.support.restir_cases import same_means
from tests.support.sharing_cases import (
    CAMERA,
    FLOOR,
    SHEET,
    WALL,
    Step,
    leaning,
    loop_of,
    on_film,
    same,
    scene_of,
    step_of,
    terrace,
    trained,
)
from tests.support.statistical import SIGNIFICANCE, z_test
from tests.support.tracing import bumpy, rectangle

WIDTH, HEIGHT = 48, 32
GROUP = GuidedConfig.reuse_group
COATED = replace(FLOOR, clearcoat=1.0, clearcoat_roughness=0.6)


def members_of(places, width: int, key: int, size: int = GROUP, scattered: bool = True) -> torch.Tensor:
    """For each other place in a group, the pixel there for each of N pixels, `[.., N]`, or -1."""
    return PixelGroups.of(width, size, key, scattered).members(places, torch.device("cpu"))


def key_of(step: Step, seed: int) -> int:
    """The key of the origin of the groups of a step."""
    return hash_int(hash_int(seed ^ 0x68E31DA4) + step.samples.batch.step)


def members_in(step: Step, seed: int, places, width: int) -> torch.Tensor:
    """`members_of` in a step."""
    return members_of(places, width, key_of(step, seed), scattered=step.samples.batch.step <= SCATTERED_STEPS)


LUMINANCE = np.array(LUMINANCE_WEIGHTS)


class Reference:
    """`PixelPathReuse.reuse`, pair by pair in double precision."""

    def __init__(self, loop: RenderLoop, step: Step):
        self.loop, self.step, self.samples = loop, step, step.samples
        self.paths = step.samples.paths
        camera, scene = loop.camera, loop.scene
        self.axes, self.position = camera.axes.double().numpy(), camera.position[:, 0].double().numpy()
        self.points, self.focus = (x.double().numpy() for x in (step.samples.drawn.points, step.samples.batch.focus))
        self.corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in scene.meshes])
        material = np.concatenate([np.full(len(mesh.triangles), mesh.material) for mesh in scene.meshes])
        self.material = [scene.materials[number] for number in material]
        self.count = len(step.samples.film.depth)
        hits = self.paths.primary_hits
        self.first = {} if hits is None else {int(ray): place for place, ray in enumerate(hits.rays)}

    def in_view(self, position: np.ndarray) -> np.ndarray:
        return self.axes.T @ (position - self.position)

    def surface(self, pixel: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Position and normal of a pixel's primary hit, camera frame; None for no hit."""
        if pixel not in self.first:
            return None
        met, place = self.paths.primary_hits.surface, self.first[pixel]
        position, normal = (vectors[:, place].double().numpy() for vectors in (met.position, met.geometric_normal))
        return self.in_view(position), self.axes.T @ normal

    def reusable(self, pixel: int) -> bool:
        triangle = int(self.paths.triangle[pixel])
        if triangle < 0:
            return self.loop.scene.environment is not None and bool(self.samples.drawn.weight[pixel] > 0.0)
        return self.faces(self.points[:, pixel], pixel)

    def faces(self, point: np.ndarray, source: int) -> bool:
        """Whether a ray from `point` to the hit of `source` keeps the shading normals there."""
        first, place = self.paths.primary_hits, [self.first[source]]
        origin = self.axes @ np.append(point, 0.0) + self.position
        way = first.surface.position[:, place].double().numpy()[:, 0] - origin
        ray = (torch.from_numpy(part).float()[:, None] for part in (origin, way / np.linalg.norm(way)))
        hit = Hit(*(field[place] for field in first.hit))
        return bool(self.loop.tracer.geometry.surface(*ray, hit).facing)

    def seen_through(self, point: np.ndarray, source: int, viewer: int) -> np.ndarray:
        """The lens point through which `viewer` sees what `source` sees through `point`."""
        surface, start = self.surface(source), np.append(point, 0.0)
        way = self.focus[:, source] - start
        if surface is None:
            return self.focus[:2, viewer] - way[:2]
        position, normal = surface
        target = start + way * ((position - start) @ normal) / (way @ normal)
        line = target - self.focus[:, viewer]
        return self.focus[:2, viewer] - line[:2] * self.focus[2, viewer] / line[2]

    def jacobian(self, source: int, viewer: int, step: float = 1e-6) -> float:
        columns = []
        for axis in np.eye(2):
            ends = [self.seen_through(self.points[:, source] + way * step * axis, source, viewer) for way in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * step))
        return abs(columns[0][0] * columns[1][1] - columns[0][1] * columns[1][0])

    def arriving(self, point: np.ndarray, source: int, viewer: int) -> float:
        """Transmittance of the triangles between the hit of `source` and the lens point of `viewer`."""
        surface, start = self.surface(source), np.append(point, 0.0)
        if surface is None:
            way, end = self.focus[:, viewer] - start, np.inf
        else:
            way, end = surface[0] - start, 1.0 - 1e-4
            if way @ surface[1] >= 0.0 or not self.faces(point, source):
                return 0.0
        origin, direction = self.axes @ start + self.position, self.axes @ way
        distances = every_hit(self.corners, origin[:, None], direction[:, None])[0][0]
        return math.prod(1.0 - self.material[triangle].opacity for triangle in np.flatnonzero(distances < end))

    def density(self, point: np.ndarray, viewer: int) -> float:
        points = torch.full((2, self.count), NOWHERE)
        points[:, viewer] = torch.from_numpy(point)
        return float(self.samples.query.pdf(points)[viewer])

    def passing(self, point: np.ndarray, viewer: int) -> float:
        lens, points = self.loop.camera.lens, torch.from_numpy(point).float()[:, None]
        return float(lens.transmission(points) * lens.unblocked(points, self.samples.batch.focus[:, [viewer]])) / lens.area

    def light(self, source: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light at a lens point from the hit of `source`: emission `[3]`, and BSDFs `[3, D]` of the directions of paths."""
        surface = self.surface(source)
        if surface is None:
            return self.paths.radiance[:, source].double().numpy(), np.zeros((3, 0))
        way = self.axes @ (np.append(point, 0.0) - surface[0])
        outgoing = torch.from_numpy(way / np.linalg.norm(way)).float()[:, None]
        first, chosen = self.paths.primary_hits, torch.tensor([self.first[source]])
        _, paths = first.paths_of(chosen, int(first.counts[chosen]))
        values = torch.cat(first.bsdf(paths, outgoing.expand(3, len(paths))), dim=1)
        return first.emitted(chosen, outgoing)[:, 0].double().numpy(), values.double().numpy()

    def incident(self, source: int) -> np.ndarray:
        """Incident light `[3, D]` over the density of its directions."""
        if source not in self.first:
            return np.zeros((3, 0))
        mine = self.paths.primary_hits.owner == self.first[source]
        return torch.cat([light[:, mine] for light in self.paths.primary_hits.reflection[1]], dim=1).double().numpy()

    def reused(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Radiance `[3, N]` and weights `[N]`, and the number of views by other pixels."""
        places = self.samples.batch.places
        numbers = torch.arange(self.count) if isinstance(places, slice) else places
        members = members_in(self.step, self.loop.settings.seed, numbers, self.loop.film.width).numpy()
        radiance, weights, seen = np.zeros((3, self.count)), np.zeros(self.count), 0
        for source in range(self.count):
            if not self.samples.drawn.weight[source] > 0.0:
                continue
            views = {source: (self.points[:, source], 1.0, 1.0)}
            if self.reusable(source):
                views[source] = (self.points[:, source], 1.0, self.arriving(self.points[:, source], source, source))
                for viewer in members[members[:, source] >= 0, source]:
                    point = self.seen_through(self.points[:, source], source, viewer)
                    if np.isfinite(point).all() and self.passing(point, viewer) > 0.0:
                        views[viewer] = (point, self.jacobian(source, viewer), self.arriving(point, source, viewer))
            density = {viewer: self.density(point, viewer) * jacobian * left for viewer, (point, jacobian, left) in views.items()}
            light = {viewer: self.light(source, point) for viewer, (point, _, _) in views.items()}
            total, bsdf = sum(density.values()), LUMINANCE @ light[source][1]
            of_directions = sum(density[viewer] * (LUMINANCE @ light[viewer][1]) for viewer in views)
            factors = np.divide(bsdf, of_directions, out=np.zeros_like(bsdf), where=of_directions > 0.0)
            for viewer, (point, jacobian, left) in views.items():
                share = self.passing(point, viewer) * jacobian * left
                emission, values = light[viewer]
                radiance[:, viewer] += share * (emission / total + (values * self.incident(source) * factors).sum(1))
                weights[viewer] += share / total
                seen += viewer != source and share > 0.0
        return radiance, weights, seen


def unlike(loop: RenderLoop, step: Step) -> tuple[int, int]:
    """The number of pixels that differ from the reference, and the number of views by other pixels."""
    radiance, weights, seen = Reference(loop, step).reused()
    differs = ~np.isclose(step.reused.weight.numpy(), weights, rtol=2e-3, atol=1e-4)
    differs |= ~np.isclose(step.reused.radiance.numpy(), radiance, rtol=2e-3, atol=1e-4).all(0)
    return int(differs.sum()), seen


@pytest.mark.slow
@pytest.mark.parametrize("steps", [0, 2, SCATTERED_STEPS])
@pytest.mark.parametrize("sheet, sky", [(False, True), (True, False), (True, True)])
def test_reused_samples_are_those_of_plain_loops(sheet, sky, steps):
    """In two bands, one of two rows, in the first step and after some epochs, with scattered and with compact groups."""
    loop = trained(terrace(16, 10, sheet, sky), steps)
    step = step_of(loop, seed=5)
    assert bool((step.samples.paths.triangle < 0).any()) and step.samples.query.varies
    different, seen = unlike(loop, step)
    assert different == 0 and seen > 80


LAYERED = replace(COATED, sheen_color=(1.0, 0.6, 0.3), sheen_roughness=0.5, anisotropy=0.7, diffuse_transmission=0.4)


@pytest.mark.parametrize(
    "material",
    [FLOOR, replace(FLOOR, normal_texture=bumpy()), replace(COATED, clearcoat_normal_texture=bumpy()), LAYERED],
)
def test_plain_loops_agree_where_shading_normals_are_replaced(material):
    """They are for half of the lens points, which then see another surface."""
    loop = loop_of(leaning(24, 16, material))
    step = step_of(loop, seed=5)
    assert 0.2 < float(step.samples.paths.primary_hits.surface.facing.mean()) < 0.8
    different, seen = unlike(loop, step)
    assert different == 0 and 30 < seen < 0.8 * sum(step.reused.weight > 0.0) * (GROUP - 1)


@pytest.mark.slow
def test_plain_loops_agree_through_an_aperture_of_any_shape():
    scene = terrace(16, 10)
    aperture = Aperture(blades=5, rotation=10.0, edge=0.6, cat_eye=0.8)
    loop = trained(replace(scene, camera=replace(scene.camera, aperture=aperture)))
    assert loop.camera.lens.vignettes
    different, seen = unlike(loop, step_of(loop, seed=6))
    assert different == 0 and seen > 80


def lists_of_pixels(width: int, height: int, seed: int = 0) -> dict[str, torch.Tensor | slice]:
    """Whole films, whole bands of one, and scattered pixels."""
    few = torch.rand(width * height, generator=torch.Generator().manual_seed(seed)) < 0.4
    bands = slice(ROWS_PER_BAND * width, min(3 * ROWS_PER_BAND, height) * width)
    return {"whole": slice(0, width * height), "bands": bands, "sparse": few.nonzero()[:, 0]}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["whole", "bands", "sparse"])
@pytest.mark.parametrize("scattered", [False, True], ids=["compact", "scattered"])
@pytest.mark.parametrize("size, long, short", [(GROUP, 8, 4), (8, 4, 4), (4, 4, 2), (1, 2, 1)])
@pytest.mark.parametrize("width, height", [(21, 19), (3, 25), (1, 9), (2, 17), (16, 24), (70, 25)])
def test_groups_are_tiles_within_bands(width, height, size, long, short, scattered, kind):
    """Each group has half of the listed pixels of a tile, which is wide or high, and each member lists the others."""
    places = lists_of_pixels(width, height)[kind]
    numbers = torch.arange(places.start, places.stop) if isinstance(places, slice) else places
    tiles = []
    for step in range(12):
        members = members_of(places, width, hash_int(step), size, scattered)
        tiles.append(PixelGroups.of(width, size, hash_int(step), scattered))
        half_of = [half_tile(tiles[-1], int(number)) for number in numbers]
        same_half = {half: {i for i, other in enumerate(half_of) if other == half} for half in set(half_of)}
        groups = [{i} for i in range(len(numbers))]
        for member in members.unbind():
            for i, other in enumerate(member.tolist()):
                if other >= 0:
                    assert other != i and other not in groups[i]
                    assert int(member[other]) == i
                    groups[i].add(other)
        for group in groups:
            assert all(groups[other] == group for other in group)
            x, y = (np.array([part(int(numbers[j])) for j in group]) for part in (lambda n: n % width, lambda n: n // width))
            assert len(set(y // ROWS_PER_BAND)) == len(set(x // COLUMNS)) == 1
            assert all(same_half[half_of[j]] == group for j in group)
            assert scattered or (np.ptp(x) + 1) * (np.ptp(y) + 1) <= size
        keys, member = (values.tolist() for values in tiles[-1].numbered(places, "cpu"))
        assert [{j for j, key in enumerate(keys) if key == keys[i]} for i in range(len(keys))] == groups
        assert all(len({member[j] for j in group}) == len(group) for group in groups) and set(member) <= set(range(size))
    assert {(tile.across, tile.down) for tile in tiles} == {(long, short), (short, long)}
    assert len({tile.mask for tile in tiles}) >= min(size, 3 if scattered else 2)
    assert all(len(tile.offsets()) == size for tile in tiles)


def half_tile(tile: PixelGroups, pixel: int) -> tuple[int, ...]:
    """Band, tile and half of the tile to which a pixel belongs."""
    (y, x), bits = divmod(pixel, tile.width), (tile.across * tile.down).bit_length() - 1
    row, line = divmod(y % ROWS_PER_BAND + tile.below, tile.down)
    column, place = divmod(x + tile.right[y % ROWS_PER_BAND], tile.across)
    number = line * tile.across + place
    half = sum(number >> bit & tile.mask >> bit & 1 for bit in range(bits)) % 2
    return y // ROWS_PER_BAND, x // COLUMNS, row, column, half


def test_groups_stay_for_an_epoch():
    """Then all hits of the group in the epoch are stratified together. Groups of two epochs seldom agree by chance."""
    loop = loop_of(scene_of([rectangle(0, (0.3, 0.4, -4.0))], (FLOOR, WALL), 22, 19, peak=0.3))
    groups = [loop.mode.reuse.paths.groups(step) for step in range(1, 65)]
    assert len(set(groups[16:32])) == len(set(groups[32:64])) == 1
    assert 5 <= len(set(groups)) <= 7


def test_lens_points_of_a_group_are_stratified_together():
    """The first numbers of a group's pixels over the epoch of the steps 5 to 8 are in different intervals of equal length."""
    loop = loop_of(scene_of([rectangle(0, (0.3, 0.4, -4.0))], (FLOOR, WALL), 32, 16, peak=0.3))
    places, steps = slice(0, 32 * 16), range(5, 9)
    randoms = [loop.mode.reuse.share(PixelRandom(4, step, places), places, step) for step in steps]
    numbers = torch.stack([random.stratified(dimensions.LENS, 3, 5)[0] for random in randoms], 1).numpy()
    of_group, _ = loop.mode.reuse.paths.groups(5).numbered(places, "cpu")
    whole = [numbers[of_group == key].flatten() for key in of_group.unique() if int((of_group == key).sum()) == GROUP]
    assert len(whole) > 8
    assert all(len(set((values * len(values)).astype(int))) == len(values) == 4 * GROUP for values in whole)


@pytest.mark.parametrize("crop", [None, (3, 5, 21, 13)], ids=["frame", "crop"])
def test_a_loop_draws_the_lens_points_of_groups(crop, monkeypatch):
    """In the epoch of the steps 5 to 8. The groups are those of the film, also in a crop."""
    scene = scene_of([rectangle(0, (0.3, 0.4, -4.0))], (FLOOR, WALL), 32, 24, peak=0.3)
    with RenderLoop(scene, RenderSettings("guided", seed=4, threads=1, crop=crop)) as loop:
        found, reuse = [], loop.mode.reuse.paths.reuse
        monkeypatch.setattr(loop.mode.reuse.paths, "reuse", lambda samples, timer: found.append(samples) or reuse(samples, timer))
        for _ in range(7):
            loop.step()
    batch = found[-1].batch
    assert len(found) == 7 and not found[-1].query.varies
    random = PixelRandom(4, 7, batch.pixels).in_groups(*loop.mode.reuse.paths.groups(7).numbered(batch.places, "cpu"), GROUP)
    expected = UniformQuery(loop.camera.lens, batch.focus, random.stratified(dimensions.LENS, 2, 5)).sample()
    assert torch.equal(found[-1].drawn.points, expected.points)


def share_together(width: int, height: int, size: int, scattered: bool, steps: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """The share of steps in which pixels are in the group of the next pixel, to the right and below, `[2, H, W]`. The second
    result is which rows have the pixels below in their band, bool `[H - 1]`."""
    together = np.zeros((2, height, width))
    for step in range(steps):
        seen = members_of(slice(0, width * height), width, hash_int(step), size, scattered).numpy()
        place = np.arange(width * height)
        for axis, offset in enumerate((1, width)):
            together[axis] += (seen == place + offset).any(0).reshape(height, width) / steps
    return together, np.arange(height - 1) % ROWS_PER_BAND != ROWS_PER_BAND - 1


@pytest.mark.parametrize("size, long, short", [(GROUP, 4, 4), (8, 4, 2)])
@pytest.mark.parametrize("width, height", [(13, 19), (3, 9)])
def test_adjacent_pixels_of_a_band_are_in_one_compact_group_in_some_steps(width, height, size, long, short):
    """In the share of groups with both: three of four along a side of four pixels; never across bands."""
    together, inside = share_together(width, height, size, scattered=False)
    for frequency in (together[0, :, :-1], together[1, :-1][inside]):
        expected = 0.5 * ((1.0 - 1.0 / long) + (1.0 - 1.0 / short))
        error = math.sqrt(expected * (1.0 - expected) / 400)
        assert float(np.abs(frequency - expected).max()) < 4.5 * error  # all pixels have one of a few places in groups
    assert not together[1, :-1][~inside].any()


@pytest.mark.parametrize("size, long, short", [(GROUP, 8, 4), (8, 4, 4), (4, 4, 2)])
@pytest.mark.parametrize("width, height", [(13, 19), (3, 9)])
def test_adjacent_pixels_of_a_band_are_in_one_scattered_group_in_few_steps(width, height, size, long, short):
    """Adjacent pixels of a row whose places in a tile differ in the lowest bit alone are never in one group. Others in a tile are
    in one group in every second step. No group crosses bands."""
    together, inside = share_together(width, height, size, scattered=True)
    shares = [(side - 2) / (4 * side) for side in (long, short)]
    expected = 0.5 * sum(shares)
    error = math.sqrt(expected * (1.0 - expected) / 400)
    assert float(np.abs(together[0, :, :-1] - expected).max()) < 4.5 * error  # all pixels have one of a few places in tiles
    down = together[1, :-1][inside]
    expected = 0.5 * (share_below(long, short) + share_below(short, long))
    if long == ROWS_PER_BAND:  # tiles as high as a band stay in their band
        expected = 0.5 * (share_below(short, long) * long / (long - 1) + share_below(long, short))
        assert abs(down[: ROWS_PER_BAND - 1].mean() - expected) < 4.5 * error
    else:
        assert float(np.abs(down - expected).max()) < 4.5 * error
    assert not together[1, :-1][~inside].any()


def share_below(across: int, down: int) -> float:
    """The share of all places, shifts and patterns of scattered tiles in which the pixel below is in the same group."""
    found, shifts = [], (0, 2)
    for x, y, first, second, pattern in product(range(across), range(down), shifts, shifts, range(across * down)):
        columns, row = (x + first, x + second), y + 1
        bits = (columns[0] ^ columns[1]) + across * (y ^ row) & (pattern | 1 | across)
        same_tile = columns[0] // across == columns[1] // across and row < down
        found.append(same_tile and bits.bit_count() % 2 == 0)
    return float(np.mean(found))


def test_scattered_tiles_have_ragged_edges():
    """Half of the rows shift by two columns. Compact tiles have straight edges."""
    for width in (4, 8):
        tiles = [PixelGroups.of(70, GROUP, hash_int(step), True) for step in range(200)]
        right = np.array([tile.right for tile in tiles if tile.across == width])
        least = right.min(1, keepdims=True)
        assert set(least.flat) >= set(range(width)) and set((right - least).flat) == {0, 2}
        assert abs(np.mean(right[:, 1:] == right[:, :1]) - 0.5) < 4.5 * 0.5 / math.sqrt(right[:, 1:].size)
    compact = [PixelGroups.of(70, GROUP, hash_int(step), False) for step in range(100)]
    assert all(len(set(tile.right)) == 1 for tile in compact)
    assert {tile.right[0] for tile in compact} == set(range(8))


@pytest.mark.parametrize("count", [2, 3])
def test_ranks_have_whole_groups(count):
    """Every pixel belongs to one rank, and its group is the one that a single rank would make."""
    width, height, device = 13, 37, torch.device("cpu")
    whole = members_of(slice(0, width * height), width, hash_int(7))
    found = []
    for rank in range(count):
        ranks = Ranks()
        ranks.rank, ranks.count = rank, count
        mine = ranks.rows(width, height, ROWS_PER_BAND, device)
        assert set((mine // width // ROWS_PER_BAND % count).tolist()) == {rank}
        for member, expected in zip(members_of(mine, width, hash_int(7)), whole):
            assert torch.equal(torch.where(member >= 0, mine[member], -1), expected[mine])
        found.append(mine)
    assert torch.equal(torch.cat(found).sort().values, torch.arange(width * height))


def test_blocks_of_adaptive_sampling_have_whole_groups():
    assert adaptive.BLOCK % COLUMNS == 0 and adaptive.BLOCK % ROWS_PER_BAND == 0


def pictures(scene: Scene, steps: int, learns: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Differences that reuse makes to the luminance and to the weights, step by step, `[steps, H, W]` each."""
    loop, found = trained(scene, learns), []
    for seed in range(steps):
        step = step_of(loop, 1000 + seed)
        found.append(on_film(torch.stack((luminance(step.reused.radiance - step.own), step.reused.weight - 1.0)), scene))
    return np.stack(found, axis=1)


def no_bias(found: np.ndarray) -> float:
    return same_means(found, np.zeros_like(found))


@pytest.mark.parametrize(
    "sheet, sky, learns",
    [*(pytest.param(False, True, learns, marks=pytest.mark.slow) for learns in (0, 2)), (True, False, 2)],
)
def test_reuse_keeps_the_mean(sheet, sky, learns):
    """Of diffuse, glossy and emitting surfaces before and behind the focal plane, seen past a card, and of the sky."""
    light, weight = pictures(terrace(WIDTH, HEIGHT, sheet, sky), 80, learns)
    assert no_bias(light) > SIGNIFICANCE
    assert no_bias(weight) > SIGNIFICANCE


@pytest.mark.slow
def test_reuse_keeps_the_mean_where_shading_normals_are_replaced():
    light, _ = pictures(leaning(24, 16), 200)  # the light of a group, drawn evenly, always sums to the same
    columns = light.mean(1)
    assert z_test(columns.mean(0), columns.std(0, ddof=1) / math.sqrt(len(columns))) > SIGNIFICANCE


@pytest.mark.parametrize("core", [False, True])
def test_a_group_of_one_pixel_keeps_its_own_sample_and_traces_no_ray(core, monkeypatch):
    if not core:
        monkeypatch.setattr(native, "core", lambda: None)
    elif native.core() is None:
        pytest.skip("the native core is not installed")
    traced = []
    step = step_of(trained(terrace(WIDTH, HEIGHT, sheet=True)), 7, lambda paths: traced.append(paths.rays), group=1)
    assert [step.samples.paths.rays] == traced
    assert same(step.reused.radiance, step.own) and same(step.reused.weight, step.samples.drawn.weight)


@pytest.mark.slow
def test_reuse_keeps_the_mean_of_the_sky_at_the_edge_of_a_translucent_sheet():
    """The sheet is in focus: half of the columns see the sky past the sheet, and half through it."""
    across, down = 8, 256
    sheet = rectangle(0, (-9.9, 0.2, 0.3 - CAMERA.focus_distance), scale=(10.0, 90.0, 1.0))
    scene = scene_of([sheet], (SHEET,), across, down, peak=0.3, camera=replace(CAMERA, fov=20.0))
    _, weight = pictures(replace(scene, film=replace(scene.film, max_depth=1)), 100)
    columns = weight.mean(1)
    assert z_test(columns.mean(0), columns.std(0, ddof=1) / math.sqrt(len(columns))) > SIGNIFICANCE


def test_reuse_reduces_the_variance():
    """The luminance of most pixels has less than 0.6 of the variance, in a film of a few groups."""
    loop, own, reused = trained(terrace(WIDTH, HEIGHT)), [], []
    for seed in range(24):
        step = step_of(loop, seed)
        own.append(luminance(step.own))
        reused.append(luminance(step.reused.radiance))
    ratio = torch.stack(reused).var(0) / torch.stack(own).var(0).clamp(min=1e-12)
    assert float(ratio.median()) < 0.6


def groups(step: Step, seed: int, width: int) -> np.ndarray:
    """The least pixel of each pixel's group, `[N]`."""
    members = members_in(step, seed, step.samples.batch.places, width)
    every = torch.arange(members.shape[1])
    return torch.minimum(every, torch.where(members >= 0, members, every).amin(0)).numpy()


def test_weights_of_uniform_lens_points_have_the_mean_one_in_each_group():
    """Other pixels of the group get the weight that the sample loses."""
    meshes = [rectangle(0, (0.3, 0.4, -4.0), scale=0.8), rectangle(1, (-0.3, 0.2, -0.4), scale=0.2)]
    loop = loop_of(scene_of(meshes, (FLOOR, WALL), 22, 19, peak=0.3))
    step = step_of(loop, 3)
    assert not step.samples.query.varies
    assert float((step.reused.weight - 1.0).abs().median()) > 0.01
    group = groups(step, 3, loop.film.width)
    sums = np.bincount(group, step.reused.weight.numpy())
    np.testing.assert_allclose(sums, np.bincount(group), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("roughness", [0.3, 1.0])
def test_reflected_light_of_uniform_lens_points_keeps_its_sum_in_each_group(roughness):
    """Other pixels of the group get the light that the sample loses, whatever they see of it: a grey wall under a grey sky."""
    loop = loop_of(leaning(24, 16, Material("metal", (0.7, 0.7, 0.7), metallic=1.0, roughness=roughness)))
    step = step_of(loop, 3)
    assert not step.samples.query.varies
    own, reused = (luminance(light).numpy() for light in (step.own, step.reused.radiance))
    assert float(np.abs(own - reused).max()) > 0.02
    group = groups(step, 3, loop.film.width)
    np.testing.assert_allclose(np.bincount(group, reused), np.bincount(group, own), rtol=1e-4, atol=1e-5)


def filled(material: Material, depth: float = 3.5, turn: float = 0.0) -> Scene:
    """A wall that fills the frame, and an emitter beside the camera."""
    emitter = Material("bulb", (0.0, 0.0, 0.0), specular=0.0, emission=(9.0, 9.0, 9.0))
    wall = rectangle(0, (0.1, 0.2, 0.3 - depth), (0.0, turn, 0.0), 9.0)
    return scene_of([wall, rectangle(1, (1.0, 1.0, 0.5), (0.0, 180.0, 0.0), 0.3)], (material, emitter), 24, 16)


ABSORBING = replace(WALL, transmission=1.0, attenuation_color=(0.5, 0.2, 0.1), attenuation_distance=1.0)
LIMIT = GuidedConfig.min_spread * 2.0 * 0.25 / 3.5 * GROUP_SPACING / 4.9
"""Least GGX α of reused surfaces 3.5 m away, where the CoC is 4.9 pixels: a part of the angle of the lens, times the share of the
CoC between two pixels of a group."""


@pytest.mark.parametrize(
    "material, turn, reusable",
    [
        pytest.param(FLOOR, 0.0, True, id="matte"),
        pytest.param(WALL, 0.0, True, id="rough metal"),
        pytest.param(WALL, 180.0, True, id="rough metal, from behind"),
        pytest.param(replace(WALL, roughness=(1.1 * LIMIT) ** 0.5), 0.0, True, id="smoother metal"),
        pytest.param(replace(WALL, roughness=(0.9 * LIMIT) ** 0.5), 0.0, False, id="too smooth a metal"),
        pytest.param(COATED, 0.0, True, id="rough coat"),
        pytest.param(replace(FLOOR, clearcoat=1.0, clearcoat_roughness=(0.9 * LIMIT) ** 0.5), 0.0, False, id="smooth coat"),
        pytest.param(replace(FLOOR, transmission=0.5, thin=True), 0.0, False, id="partly transmissive"),
        pytest.param(replace(WALL, transmission=0.5, thin=True), 0.0, True, id="metal that cannot transmit"),
        pytest.param(ABSORBING, 0.0, True, id="absorbing"),
        pytest.param(ABSORBING, 180.0, False, id="absorbing, from behind"),
    ],
)
def test_surfaces_that_look_different_to_others_are_not_reused(material, turn, reusable):
    loop = loop_of(filled(material, turn=turn))
    step = step_of(loop, 2)
    assert bool((step.samples.paths.triangle >= 0).all()) and float(luminance(step.own).max()) > 0.0
    reused = float((~torch.isclose(step.reused.weight, step.samples.drawn.weight, rtol=1e-3)).float().mean())
    assert reused > 0.8 if reusable else reused == 0.0
    if not reusable:
        assert same(step.reused.radiance, step.own)


def test_points_in_focus_belong_to_one_pixel():
    step = step_of(loop_of(filled(FLOOR, depth=CAMERA.focus_distance)), 2)
    assert same(step.reused.weight, step.samples.drawn.weight) and same(step.reused.radiance, step.own)
    assert float(luminance(step.own).min()) > 0.0


def test_a_hidden_environment_is_not_reused():
    scene = terrace(16, 10)
    hidden = replace(scene, environment=replace(scene.environment, visible=False))
    step = step_of(loop_of(hidden), 2)
    missed = step.samples.paths.triangle < 0
    own = step.reused.weight[missed] >= step.samples.drawn.weight[missed] - 1e-5
    assert bool(own.all()) and int(missed.sum()) > 20
    seen = step_of(loop_of(scene), 2)
    assert bool((seen.reused.weight[missed] < 0.999 * seen.samples.drawn.weight[missed]).any())


def test_the_film_takes_reused_samples_as_they_are():
    """Their weights are included: the film weights them by 1."""
    loop = loop_of(terrace(16, 10))
    step, shown = step_of(loop, 5), []
    assert float((step.samples.drawn.weight - 1.0).abs().max()) > 0.1

    def film(places: Pixels, samples: FilmSamples) -> torch.Tensor:
        shown.append(samples.value())
        return torch.ones(len(samples.weight), dtype=torch.bool)

    loop.mode.reuse.expose(step.samples, film, PhaseTimer())
    batch, reuse = step.samples.batch, loop.mode.reuse
    coefficient = reuse.control_variate.coefficient(batch.places)
    # The samples are those of a first step.
    of_step = (reuse.paths.groups(batch.step), step.reused.radiance, step.reused.weight)
    coefficient = coefficient + cross_fitted(batch.places, *of_step, None)[0]
    assert same(shown[0], step.reused.radiance - coefficient * (step.reused.weight - 1.0))


def test_a_sample_that_is_not_finite_stays_in_its_own_pixel():
    scene = terrace(16, 10)
    loop = loop_of(scene)
    usual = step_of(loop, 4)
    group = groups(usual, 4, loop.film.width)
    for pixel in (15, 40, 57, 110):
        assert not same(usual.reused.weight[pixel], usual.samples.drawn.weight[pixel])

        def spoil(paths: PathSamples, pixel: int = pixel) -> None:
            paths.radiance[:, pixel] = math.nan
            paths.primary_hits.indirect[:, paths.primary_hits.path_rays == pixel] = math.nan

        step = step_of(loop_of(scene), 4, spoil)
        finite = step.reused.radiance.isfinite().all(0)
        assert int((~finite).sum()) == 1 and not bool(finite[pixel])
        assert same(step.reused.weight, usual.reused.weight)
        apart = torch.from_numpy(group != group[pixel])
        assert torch.equal(step.reused.radiance[:, apart], usual.reused.radiance[:, apart])


@pytest.mark.slow
@pytest.mark.parametrize("crop", [None, (2, 0, 21, 37)], ids=["frame", "crop"])
def test_where_batches_are_cut_changes_no_bit(crop, monkeypatch):
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)

    def rendered(threads: int) -> RenderLoop:
        settings = RenderSettings("guided", seed=1, threads=threads, crop=crop)
        with RenderLoop(terrace(24, 37), settings) as loop:
            for _ in range(6):
                loop.step()
        assert len(loop._spans()) == min(threads, 5)
        return loop

    one = rendered(1)
    layers, control = one.film.layers(), one.mode.reuse.control_variate.coefficients
    assert bool(control.any())
    for threads in (2, 5):
        other = rendered(threads)
        for name, layer in other.film.layers().items():
            np.testing.assert_array_equal(layer, layers[name], err_msg=name)
        assert torch.equal(other.mode.reuse.control_variate.coefficients, control)


def test_batches_hold_whole_bands(monkeypatch):
    """Also batches of scattered pixels."""
    monkeypatch.setattr("bokehguide.train.scheduler.OVERHEAD", 1)
    loop = loop_of(terrace(24, 37), threads=4)
    active = torch.rand(24 * 37, generator=torch.Generator().manual_seed(3)) < 0.3
    for _ in range(2):
        places = torch.arange(24 * 37) if loop.pixels.active is None else loop.pixels.active
        spans = loop._spans()
        assert len(spans) > 2
        bands = [set((places[span] // (24 * ROWS_PER_BAND)).tolist()) for span in spans]
        assert sum(map(len, bands)) == len(set().union(*bands)) == 5
        loop.render_only(active)


@pytest.mark.slow
def test_crops_at_odd_places_have_the_mean_of_the_frame():
    """Their groups and bands lie elsewhere, and they learn from their own samples alone."""
    scene, (x, y, across, down) = terrace(WIDTH, HEIGHT), (5, 3, 24, 16)
    frames, crops = [], []
    for seed in range(24):
        for found, crop in ((frames, None), (crops, (x, y, across, down))):
            with RenderLoop(scene, RenderSettings("guided", seed=seed, threads=1, crop=crop)) as loop:
                for _ in range(2):
                    loop.step()
            light = luminance(loop.film.radiance().permute(2, 0, 1).flatten(1))
            found.append(light.reshape(loop.film.height, -1).double().numpy())
    assert same_means(np.stack(crops), np.stack(frames)[:, y : y + down, x : x + across]) > SIGNIFICANCE
