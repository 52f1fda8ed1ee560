"""Neighbouring pixels that share what they found: against plain loops, and without a trace in the mean."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from restir_cases import same_means

from bokehguide.render.tracer import Hit
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Aperture, Material, Scene
from bokehguide.train import RenderLoop, RenderSettings, adaptive, sharing
from bokehguide.train.ranks import BAND, Ranks
from bokehguide.train.sharing import COLUMNS, LONG, NOWHERE, SHORT, _members
from tests.brute_force import every_hit
from tests.sharing_cases import CAMERA, FLOOR, SHEET, WALL, Step, leaning, loop_of, on_film, same, shown, step_of, taught, terrace
from tests.statistical import SIGNIFICANCE, z_test
from tests.test_render_first_surfaces import bumpy
from tests.tracing import rectangle

WIDTH, HEIGHT = 48, 32
COATED = replace(FLOOR, clearcoat=1.0, clearcoat_roughness=0.6)


def key_of(loop: RenderLoop, step: Step) -> int:
    """Of where the groups of a step begin."""
    return sharing.hash_int(sharing.hash_int(loop.sharing._seed ^ 0x68E31DA4) + step.number)


class Reference:
    """`PathSharing.share`, pair by pair in double precision."""

    def __init__(self, loop: RenderLoop, step: Step):
        self.loop, self.step = loop, step
        camera, scene = loop.camera, loop.scene
        self.axes, self.position = camera.axes.double().numpy(), camera.position[:, 0].double().numpy()
        self.points, self.focus = step.draw.points.double().numpy(), step.focus.double().numpy()
        self.corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in scene.meshes])
        material = np.concatenate([np.full(len(mesh.triangles), mesh.material) for mesh in scene.meshes])
        self.material = [scene.materials[number] for number in material]
        self.count = len(step.depth)
        self.first = {} if step.samples.first is None else {int(ray): n for n, ray in enumerate(step.samples.first.index)}

    def in_view(self, position: np.ndarray) -> np.ndarray:
        return self.axes.T @ (position - self.position)

    def surface(self, pixel: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Position and normal of what a pixel's sample met, camera frame; None: nothing."""
        if pixel not in self.first:
            return None
        met, place = self.step.samples.first.met, self.first[pixel]
        position, normal = (vectors[:, place].double().numpy() for vectors in (met.position, met.geometric_normal))
        return self.in_view(position), self.axes.T @ normal

    def shareable(self, pixel: int) -> bool:
        triangle = int(self.step.samples.triangle[pixel])
        if triangle < 0:
            return self.loop.scene.environment is not None and bool(self.step.draw.weight[pixel] > 0.0)
        return self.faces(self.points[:, pixel], pixel)

    def faces(self, point: np.ndarray, source: int) -> bool:
        """Whether shading normals of what `source` met need not give way, as a ray from `point` finds them."""
        first, place = self.step.samples.first, [self.first[source]]
        origin = self.axes @ np.append(point, 0.0) + self.position
        way = first.met.position[:, place].double().numpy()[:, 0] - origin
        ray = (torch.from_numpy(part).float()[:, None] for part in (origin, way / np.linalg.norm(way)))
        hit = Hit(*(field[place] for field in first.hit))
        return bool(self.loop.tracer.geometry.surface(*ray, hit).facing)

    def seen_through(self, point: np.ndarray, source: int, viewer: int) -> np.ndarray:
        """Where on the lens `viewer` sees what `source` sees through `point`."""
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
        """What opaque and sheer triangles before what `source` met leave of the light on its way to `viewer`."""
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
        lens, points = self.loop.camera.lens, torch.full((2, self.count), NOWHERE)
        points[:, viewer] = torch.from_numpy(point)
        if self.step.draw.batch is None:
            return float(lens.transmission(points)[viewer]) / lens.area
        return float(self.step.draw.batch.distribution.pdf(points)[viewer])

    def passing(self, point: np.ndarray, viewer: int) -> float:
        lens, points = self.loop.camera.lens, torch.from_numpy(point).float()[:, None]
        return float(lens.transmission(points) * lens.unblocked(points, self.step.focus[:, [viewer]])) / lens.area

    def radiance(self, source: int, point: np.ndarray) -> np.ndarray:
        surface = self.surface(source)
        if surface is None:
            return self.step.samples.radiance[:, source].double().numpy()
        way = self.axes @ (np.append(point, 0.0) - surface[0])
        outgoing = torch.from_numpy(way / np.linalg.norm(way)).float()[:, None]
        first, chosen = self.step.samples.first, torch.tensor([self.first[source]])
        return first.radiance(chosen, outgoing, int(first.parts[chosen]))[:, 0].double().numpy()

    def shared(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Radiance `[3, N]` and weights `[N]`, and how many samples others saw."""
        numbers = torch.arange(self.count) if isinstance(self.step.places, slice) else self.step.places
        members = _members(numbers, self.loop.film.width, key_of(self.loop, self.step), numbers.device).numpy()
        radiance, weights, seen = np.zeros((3, self.count)), np.zeros(self.count), 0
        for source in range(self.count):
            if not self.step.draw.weight[source] > 0.0:
                continue
            views = {source: (self.points[:, source], 1.0, 1.0)}
            if self.shareable(source):
                views[source] = (self.points[:, source], 1.0, self.arriving(self.points[:, source], source, source))
                for viewer in members[members[:, source] >= 0, source]:
                    point = self.seen_through(self.points[:, source], source, viewer)
                    if np.isfinite(point).all() and self.passing(point, viewer) > 0.0:
                        views[viewer] = (point, self.jacobian(source, viewer), self.arriving(point, source, viewer))
            total = sum(self.density(point, viewer) * jacobian * share for viewer, (point, jacobian, share) in views.items())
            for viewer, (point, jacobian, share) in views.items():
                weight = self.passing(point, viewer) * jacobian * share / total
                light = self.step.samples.radiance[:, source].double().numpy() if viewer == source else 0.0
                if viewer != source and weight > 0.0:
                    light, seen = self.radiance(source, point), seen + 1
                radiance[:, viewer] += weight * light
                weights[viewer] += weight
        return radiance, weights, seen


def unlike(loop: RenderLoop, step: Step) -> tuple[int, int]:
    """How many pixels are not as the reference has them, and how many samples were seen by others."""
    radiance, weights, seen = Reference(loop, step).shared()
    apart = ~np.isclose(step.shared.weight.numpy(), weights, rtol=2e-3, atol=1e-4)
    apart |= ~np.isclose(step.shared.radiance.numpy(), radiance, rtol=2e-3, atol=1e-4).all(0)
    return int(apart.sum()), seen


@pytest.mark.parametrize("steps", [0, 2])
@pytest.mark.parametrize("sheet, sky", [(False, True), (True, False), (True, True)])
def test_what_is_shared_is_what_plain_loops_make_of_it(sheet, sky, steps):
    """In two bands, one of two rows, in the first step and with what was learnt."""
    loop = taught(terrace(12, 10, sheet, sky), steps)
    step = step_of(loop, seed=5)
    assert bool((step.samples.triangle < 0).any()) and step.draw.batch is not None
    apart, seen = unlike(loop, step)
    assert apart == 0 and seen > 80


@pytest.mark.parametrize("material", [FLOOR, replace(FLOOR, normal_texture=bumpy()), replace(COATED, clearcoat_normal_texture=bumpy())])
def test_it_is_so_where_shading_normals_give_way(material):
    """Which is so for half of the lens points: who sees another normal has another surface before him."""
    loop = loop_of(leaning(12, 10, material))
    step = step_of(loop, seed=5)
    assert 0.2 < float(step.samples.first.met.facing.mean()) < 0.8
    apart, seen = unlike(loop, step)
    assert apart == 0 and 30 < seen < 0.8 * sum(step.shared.weight > 0.0) * (LONG * SHORT - 1)


def test_it_is_so_through_an_aperture_of_any_shape():
    scene = terrace(12, 10)
    aperture = Aperture(blades=5, rotation=10.0, edge=0.6, cat_eye=0.8)
    loop = taught(replace(scene, camera=replace(scene.camera, aperture=aperture)))
    assert loop.camera.lens.vignettes
    apart, seen = unlike(loop, step_of(loop, seed=6))
    assert apart == 0 and seen > 80


def lists(width: int, height: int, seed: int = 0) -> dict[str, torch.Tensor | slice]:
    """Whole films, whole bands of one, and pixels here and there."""
    few = torch.rand(width * height, generator=torch.Generator().manual_seed(seed)) < 0.4
    bands = slice(BAND * width, min(3 * BAND, height) * width)
    return {"whole": slice(0, width * height), "bands": bands, "sparse": few.nonzero()[:, 0]}


@pytest.mark.parametrize("kind", ["whole", "bands", "sparse"])
@pytest.mark.parametrize("width, height", [(21, 19), (3, 25), (1, 9), (2, 17), (16, 24), (70, 25)])
def test_groups_are_small_lie_in_bands_and_see_each_other(width, height, kind):
    """Each is within a tile of 4 × 2 or 2 × 4 pixels, by turns, and holds all of the tile's that there are."""
    places = lists(width, height)[kind]
    numbers = torch.arange(places.start, places.stop) if isinstance(places, slice) else places
    number_of = {pixel: i for i, pixel in enumerate(numbers.tolist())}
    shapes = set()
    for step in range(12):
        members = _members(places, width, sharing.hash_int(step), torch.device("cpu"))
        groups = [{i} for i in range(len(numbers))]
        for member in members.unbind():
            for i, other in enumerate(member.tolist()):
                if other >= 0:
                    assert other != i and other not in groups[i]
                    assert int(member[other]) == i
                    groups[i].add(other)
        for i, group in enumerate(groups):
            assert all(groups[other] == group for other in group)
            x, y = (np.array([part(int(numbers[j])) for j in group]) for part in (lambda n: n % width, lambda n: n // width))
            assert len(set(y // BAND)) == len(set(x // COLUMNS)) == 1
            wide, high = (np.ptp(x) < one and np.ptp(y) < other for one, other in ((LONG, SHORT), (SHORT, LONG)))
            assert wide or high
            shapes.add((wide, high))
            box = [(a, b) for a in range(x.min(), x.max() + 1) for b in range(y.min(), y.max() + 1)]
            assert all(number_of[b * width + a] in group for a, b in box if b * width + a in number_of)
    assert {(True, False), (False, True)} <= shapes or min(width, height) < LONG


@pytest.mark.parametrize("width, height", [(13, 19), (3, 9)])
def test_adjacent_pixels_of_a_band_share_a_group_in_some_steps_and_not_in_others(width, height):
    """By the share of tiles that hold both: three of four along them, one of two across; never across bands."""
    together, steps = np.zeros((2, height, width)), 400
    for step in range(steps):
        seen = _members(slice(0, width * height), width, sharing.hash_int(step), torch.device("cpu")).numpy()
        place = np.arange(width * height)
        for axis, offset in enumerate((1, width)):
            together[axis] += (seen == place + offset).any(0).reshape(height, width) / steps
    inside = np.arange(height - 1) % BAND != BAND - 1
    for share in (together[0, :, :-1], together[1, :-1][inside]):
        expected = 0.5 * (0.75 + 0.5)
        error = math.sqrt(expected * (1.0 - expected) / steps)
        assert float(np.abs(share - expected).max()) < 4.5 * error  # all pixels have one of a few places in tiles
    assert not together[1, :-1][~inside].any()


@pytest.mark.parametrize("count", [2, 3])
def test_ranks_have_whole_groups(count):
    """Every pixel is one rank's, and sees whom it would see if one had them all."""
    width, height, device = 13, 37, torch.device("cpu")
    whole = _members(slice(0, width * height), width, sharing.hash_int(7), device)
    found = []
    for rank in range(count):
        ranks = Ranks()
        ranks.rank, ranks.count = rank, count
        mine = ranks.rows(width, height, BAND, device)
        assert set((mine // width // BAND % count).tolist()) == {rank}
        for member, expected in zip(_members(mine, width, sharing.hash_int(7), device), whole):
            assert torch.equal(torch.where(member >= 0, mine[member], -1), expected[mine])
        found.append(mine)
    assert torch.equal(torch.cat(found).sort().values, torch.arange(width * height))


def test_what_adaptive_sampling_stops_holds_whole_groups():
    assert adaptive.BLOCK % COLUMNS == 0 and adaptive.BLOCK % BAND == 0


def pictures(scene: Scene, steps: int, learns: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """What sharing changes of the luminance and of the weights' mean, step by step, `[steps, H, W]` both."""
    loop, found = taught(scene, learns), []
    for seed in range(steps):
        step = step_of(loop, 1000 + seed)
        found.append(on_film(torch.stack((luminance(step.shared.radiance - step.own), step.shared.weight - 1.0)), scene))
    return np.stack(found, axis=1)


def none_but_noise(found: np.ndarray) -> float:
    return same_means(found, np.zeros_like(found))


@pytest.mark.parametrize("sheet, sky, learns", [(False, True, 0), (False, True, 2), (True, False, 2)])
def test_sharing_leaves_the_mean(sheet, sky, learns):
    """Of diffuse, glossy and emitting surfaces before and behind the focal plane, seen past a card, and of the sky."""
    light, weight = pictures(terrace(WIDTH, HEIGHT, sheet, sky), 80, learns)
    assert none_but_noise(light) > SIGNIFICANCE
    assert none_but_noise(weight) > SIGNIFICANCE


def test_sharing_leaves_the_mean_where_shading_normals_give_way():
    light, _ = pictures(leaning(24, 16), 200)  # the weights of a group, drawn evenly, always sum to the same
    assert none_but_noise(light) > SIGNIFICANCE


def test_sharing_leaves_the_mean_of_the_sky_beyond_the_edge_of_a_sheer_sheet():
    """In focus, so that half of the columns see all of the sky past it and half see all of it through the sheet."""
    across, down = 8, 256
    sheet = rectangle(0, (-9.9, 0.2, 0.3 - CAMERA.focus_distance), scale=(10.0, 90.0, 1.0))
    scene = shown([sheet], (SHEET,), across, down, peak=0.3, camera=replace(CAMERA, fov=20.0))
    _, weight = pictures(replace(scene, film=replace(scene.film, max_depth=1)), 100)
    columns = weight.mean(1)
    assert z_test(columns.mean(0), columns.std(0, ddof=1) / math.sqrt(len(columns))) > SIGNIFICANCE


def test_it_pays():
    """The luminance of most pixels has less than 0.6 of the variance, in a film of a few groups."""
    loop, own, shared = taught(terrace(WIDTH, HEIGHT)), [], []
    for seed in range(24):
        step = step_of(loop, seed)
        own.append(luminance(step.own))
        shared.append(luminance(step.shared.radiance))
    ratio = torch.stack(shared).var(0) / torch.stack(own).var(0).clamp(min=1e-12)
    assert float(ratio.median()) < 0.6


def groups(step: Step, loop: RenderLoop) -> np.ndarray:
    """The least pixel of each pixel's group, `[N]`."""
    members = _members(step.places, loop.film.width, key_of(loop, step), step.depth.device)
    every = torch.arange(len(step.depth))
    return torch.minimum(every, torch.where(members >= 0, members, every).amin(0)).numpy()


def test_weights_of_lens_points_drawn_evenly_sum_to_one_for_each():
    """What a sample gives the others of its group is what it loses itself."""
    meshes = [rectangle(0, (0.3, 0.4, -4.0), scale=0.8), rectangle(1, (-0.3, 0.2, -0.4), scale=0.2)]
    loop = loop_of(shown(meshes, (FLOOR, WALL), 22, 19, peak=0.3))
    step = step_of(loop, 3)
    assert step.draw.batch is None
    assert float((step.shared.weight - 1.0).abs().median()) > 0.01
    group = groups(step, loop)
    sums = np.bincount(group, step.shared.weight.numpy())
    np.testing.assert_allclose(sums, np.bincount(group), rtol=1e-5, atol=1e-5)


def filled(material: Material, depth: float = 3.5, turn: float = 0.0) -> Scene:
    """A wall that fills the frame, and a lamp beside the camera."""
    lamp = Material("bulb", (0.0, 0.0, 0.0), specular=0.0, emission=(9.0, 9.0, 9.0))
    wall = rectangle(0, (0.1, 0.2, 0.3 - depth), (0.0, turn, 0.0), 9.0)
    return shown([wall, rectangle(1, (1.0, 1.0, 0.5), (0.0, 180.0, 0.0), 0.3)], (material, lamp), 12, 10)


ABSORBING = replace(WALL, transmission=1.0, attenuation_color=(0.5, 0.2, 0.1), attenuation_distance=1.0)
LIMIT = 0.25 / 3.5
"""GGX α from which surfaces 3.5 m away are shared: half the angle that the lens is wide."""


@pytest.mark.parametrize(
    "material, turn, shares",
    [
        pytest.param(FLOOR, 0.0, True, id="matte"),
        pytest.param(WALL, 0.0, True, id="rough metal"),
        pytest.param(WALL, 180.0, True, id="rough metal, from behind"),
        pytest.param(replace(WALL, roughness=(1.1 * LIMIT) ** 0.5), 0.0, True, id="smoother metal"),
        pytest.param(replace(WALL, roughness=(0.9 * LIMIT) ** 0.5), 0.0, False, id="too smooth a metal"),
        pytest.param(COATED, 0.0, True, id="rough coat"),
        pytest.param(replace(FLOOR, clearcoat=1.0, clearcoat_roughness=0.1), 0.0, False, id="smooth coat"),
        pytest.param(replace(FLOOR, transmission=0.5, thin=True), 0.0, False, id="partly transmissive"),
        pytest.param(replace(WALL, transmission=0.5, thin=True), 0.0, True, id="metal that cannot transmit"),
        pytest.param(ABSORBING, 0.0, True, id="absorbing"),
        pytest.param(ABSORBING, 180.0, False, id="absorbing, from behind"),
    ],
)
def test_what_others_would_see_otherwise_is_not_shared(material, turn, shares):
    loop = loop_of(filled(material, turn=turn))
    step = step_of(loop, 2)
    assert bool((step.samples.triangle >= 0).all()) and float(luminance(step.own).max()) > 0.0
    shared = float((~torch.isclose(step.shared.weight, step.draw.weight, rtol=1e-3)).float().mean())
    assert shared > 0.8 if shares else shared == 0.0
    if not shares:
        assert same(step.shared.radiance, step.own)


def test_what_is_in_focus_is_its_pixels_own():
    step = step_of(loop_of(filled(FLOOR, depth=CAMERA.focus_distance)), 2)
    assert same(step.shared.weight, step.draw.weight) and same(step.shared.radiance, step.own)
    assert float(luminance(step.own).min()) > 0.0


def test_a_sky_that_is_not_seen_is_not_shared():
    scene = terrace(12, 10)
    hidden = replace(scene, environment=replace(scene.environment, visible=False))
    step = step_of(loop_of(hidden), 2)
    missed = step.samples.triangle < 0
    others = step.shared.weight[missed] >= step.draw.weight[missed] - 1e-5
    assert bool(others.all()) and int(missed.sum()) > 20
    seen = step_of(loop_of(scene), 2)
    assert bool((seen.shared.weight[missed] < 0.999 * seen.draw.weight[missed]).any())


def test_a_sample_that_is_not_finite_is_so_in_its_own_pixel_alone():
    scene = terrace(12, 10)
    loop = loop_of(scene)
    usual = step_of(loop, 4)
    group = groups(usual, loop)
    for pixel in (15, 40, 57, 110):
        assert not same(usual.shared.weight[pixel], usual.draw.weight[pixel])

        def spoil(samples, pixel=pixel) -> None:
            samples.radiance[:, pixel] = math.nan
            samples.first.indirect[:, samples.first.rays == pixel] = math.nan

        step = step_of(loop_of(scene), 4, spoil)
        finite = step.shared.radiance.isfinite().all(0)
        assert int((~finite).sum()) == 1 and not bool(finite[pixel])
        assert same(step.shared.weight, usual.shared.weight)
        apart = torch.from_numpy(group != group[pixel])
        assert torch.equal(step.shared.radiance[:, apart], usual.shared.radiance[:, apart])


def test_where_batches_are_cut_changes_no_bit(monkeypatch):
    monkeypatch.setattr("bokehguide.train.batches.SMALL_BATCH", 40)

    def picture(threads: int) -> RenderLoop:
        loop = loop_of(terrace(24, 37), seed=1, threads=threads)
        for _ in range(6):
            loop.step()
        assert len(loop._spans()) == min(threads, 5)
        return loop

    one = picture(1)
    layers, control = one.film.layers(), one.control.slopes
    assert bool(control.any())
    for threads in (2, 5):
        other = picture(threads)
        for name, layer in other.film.layers().items():
            np.testing.assert_array_equal(layer, layers[name], err_msg=name)
        assert torch.equal(other.control.slopes, control)


def test_batches_hold_whole_bands(monkeypatch):
    """Also of pixels here and there."""
    monkeypatch.setattr("bokehguide.train.batches.SMALL_BATCH", 60)
    loop = loop_of(terrace(24, 37), threads=4)
    active = torch.rand(24 * 37, generator=torch.Generator().manual_seed(3)) < 0.3
    for _ in range(2):
        places = torch.arange(24 * 37) if loop._places is None else loop._places
        spans = loop._spans()
        assert len(spans) > 2
        bands = [set((places[span] // (24 * BAND)).tolist()) for span in spans]
        assert sum(map(len, bands)) == len(set().union(*bands)) == 5
        loop.render_only(active)


def test_crops_at_odd_places_have_the_mean_of_the_frame():
    """Their groups and bands lie elsewhere, and they have learnt from what they see alone."""
    scene, (x, y, across, down) = terrace(WIDTH, HEIGHT), (5, 3, 24, 16)
    frames, crops = [], []
    for seed in range(24):
        for found, crop in ((frames, None), (crops, (x, y, across, down))):
            loop = RenderLoop(scene, RenderSettings("guided", seed=seed, threads=1, crop=crop))
            for _ in range(2):
                loop.step()
            light = luminance(loop.film.radiance().permute(2, 0, 1).flatten(1))
            found.append(light.reshape(loop.film.height, -1).double().numpy())
    assert same_means(np.stack(crops), np.stack(frames)[:, y : y + down, x : x + across]) > SIGNIFICANCE
