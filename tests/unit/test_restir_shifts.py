"""The two shift mappings: Jacobians by finite differences, there and back, what decides which one it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bokehguide.baselines.restir import shifts
from bokehguide.baselines.restir.reservoirs import Reservoirs
from bokehguide.baselines.restir.shifts import Shift, copied_share, reconnect, reconnection_jacobian
from bokehguide.models.projection import project_to_lens
from bokehguide.render.film import NO_DEPTH
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.train import RenderLoop
from bokehguide.train.batch_tracer import film_samples
from tests.support.restir_cases import FLOOR, HEIGHT, RADIUS, WIDTH, loop_of

FOCUS_DISTANCE = 1.5
CASES = 2000


def random_planes(count: int, seed: int = 0) -> dict[str, Tensor]:
    """Lens points, focus points of two pixels, and planes that the rays meet before or behind focus; float64."""
    random = np.random.default_rng(seed)
    lens = 0.5 * random.standard_normal((2, count))
    focus = np.stack([np.append(random.standard_normal(2), FOCUS_DISTANCE) for _ in range(count)], axis=1)
    shifted = focus + np.append(0.2 * random.standard_normal((2, count)), np.zeros((1, count)), axis=0)
    normal = random.standard_normal((3, count))
    normal /= np.linalg.norm(normal, axis=0)
    before, behind = 0.3 + 0.4 * random.random(count), 1.5 + 5.0 * random.random(count)
    depth = FOCUS_DISTANCE * np.where(random.random(count) < 0.5, before, behind)
    values = {"lens": lens, "focus": focus, "shifted": shifted, "normal": normal, "depth": depth}
    return {name: torch.from_numpy(value) for name, value in values.items()}


def hit(lens: Tensor, focus: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Where the rays from lens points through focus points meet the planes n · x = offset, `[3, N]`."""
    origin = torch.cat((lens, torch.zeros_like(lens[:1])))
    direction = focus - origin
    return origin + direction * ((offset - (origin * normal).sum(0)) / (direction * normal).sum(0))


def shifted_through_planes(case: dict[str, Tensor], lens: Tensor, offset: Tensor) -> Tensor:
    depth = hit(lens, case["focus"], case["normal"], offset)[2]
    return reconnect(lens, (case["shifted"] - case["focus"])[:2], depth, FOCUS_DISTANCE)


def determinant(function, lens: Tensor, step: float = 1e-6) -> Tensor:
    """|∂ function / ∂ lens| by central differences."""
    columns = []
    for axis in range(2):
        move = torch.zeros_like(lens)
        move[axis] = step
        columns.append((function(lens + move) - function(lens - move)) / (2.0 * step))
    return (columns[0][0] * columns[1][1] - columns[0][1] * columns[1][0]).abs()


def steady(case: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Plane offsets of the surfaces at the given depths, and which cases are not all but edge-on."""
    origin = torch.cat((case["lens"], torch.zeros_like(case["lens"][:1])))
    position = origin + (case["focus"] - origin) * (case["depth"] / FOCUS_DISTANCE)
    direction = torch.nn.functional.normalize(case["focus"] - origin, dim=0)
    return (position * case["normal"]).sum(0), (direction * case["normal"]).sum(0).abs() > 0.1


def test_reconnection_jacobian_is_that_of_finite_differences():
    case = random_planes(CASES)
    offset, kept = steady(case)
    moved = shifted_through_planes(case, case["lens"], offset)
    plane = torch.cat((case["normal"][:2], offset[None]))
    expected = determinant(lambda lens: shifted_through_planes(case, lens, offset), case["lens"])
    found = reconnection_jacobian(plane, case["lens"], moved)
    assert float((expected[kept].log()).std()) > 0.3  # they are not all about 1
    torch.testing.assert_close(found[kept], expected[kept], rtol=1e-5, atol=1e-7)


def test_reconnection_meets_the_same_point():
    """By the projection of that point through the new focus point, which is the way there and back too."""
    case = random_planes(CASES, seed=1)
    offset, kept = steady(case)
    position = hit(case["lens"], case["focus"], case["normal"], offset)
    moved = shifted_through_planes(case, case["lens"], offset)
    torch.testing.assert_close(moved, project_to_lens(position, case["shifted"]))
    torch.testing.assert_close(hit(moved, case["shifted"], case["normal"], offset)[:, kept], position[:, kept])
    back = reconnect(moved, (case["focus"] - case["shifted"])[:2], position[2], FOCUS_DISTANCE)
    torch.testing.assert_close(back, case["lens"])


def test_the_environment_keeps_its_direction():
    case = random_planes(CASES, seed=2)
    far = torch.full_like(case["depth"], NO_DEPTH)
    shift = (case["shifted"] - case["focus"])[:2]
    moved = reconnect(case["lens"], shift, far, FOCUS_DISTANCE)
    torch.testing.assert_close(case["shifted"][:2] - moved, case["focus"][:2] - case["lens"], rtol=1e-8, atol=1e-8)
    plane = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64).expand(3, CASES)
    found = reconnection_jacobian(plane, case["lens"], moved)
    torch.testing.assert_close(found, determinant(lambda lens: reconnect(lens, shift, far, FOCUS_DISTANCE), case["lens"]))


def test_nothing_in_focus_reconnects():
    in_focus = torch.tensor([FOCUS_DISTANCE])
    for shift in ([[0.01], [0.0]], [[0.0], [-0.02]]):
        moved = reconnect(torch.zeros(2, 1), torch.tensor(shift), in_focus, FOCUS_DISTANCE)
        assert not bool(loop_of("area-restir").camera.lens.contains(moved))


class Exchange:
    """Initial samples of the shared scene, and the same shifted from pixels to others near by."""

    def __init__(self, reconnects: bool, count: int = 6000):
        self.loop = first_pass()
        self.shift = Shift(self.loop.camera, self.loop.tracer)
        generator = torch.Generator().manual_seed(3)
        self.source = torch.randint(WIDTH * HEIGHT, (count,), generator=generator)
        near = torch.randint(-4, 5, (2, count), generator=generator)
        x = (self.source % WIDTH + near[0]).clamp(0, WIDTH - 1)
        y = (self.source // WIDTH + near[1]).clamp(0, HEIGHT - 1)
        self.target = y * WIDTH + x
        self.reconnects = torch.full((count,), reconnects)
        self.samples = self.loop.mode.reuse.spatial._reservoirs.select(self.source)
        self.there = self.moved(self.samples, self.source, self.target)

    def moved(self, samples: Reservoirs, source: Tensor, target: Tensor) -> shifts.Shifted:
        random = PixelRandom(0, 1, self.source)
        return self.shift(samples, random, source, target, self.reconnects, PhaseTimer())

    def arrived(self) -> Reservoirs:
        """What the shifted samples are in their new pixels, traced anew from where they should be."""
        camera, samples = self.loop.camera, self.samples
        focus = self.shift.focus_points(self.target, samples.subpixel)
        step = (focus - self.shift.focus_points(self.source, samples.subpixel))[:2]
        points = samples.lens_points
        if bool(self.reconnects.all()):
            points = reconnect(points, step, samples.depth, camera.lens.focus_distance)
        origins, directions = camera.rays(focus, points)
        path = self.loop.tracer.trace(origins, directions, PixelRandom(0, 1, self.source), PhaseTimer())
        inside = camera.lens.contains(points).float()
        found = film_samples(camera, path, directions, inside)
        return self.loop.mode.reuse.spatial.to_reservoirs(
            self.target, samples.subpixel, points, path, found, torch.ones_like(inside)
        )


def first_pass() -> RenderLoop:
    """A loop between the two passes of its first step."""
    loop = loop_of("area-restir")
    loop.step_number = 1
    loop._in_batches(loop._render_batch, [slice(0, loop.film.width * loop.film.height)])
    return loop


@pytest.mark.parametrize("reconnects", [True, False])
def test_there_and_back_is_where_it_was(reconnects):
    """What gets there comes back, with the radiance that it had and the inverse Jacobian."""
    exchange = Exchange(reconnects)
    there = exchange.there
    back = exchange.moved(exchange.arrived(), exchange.target, exchange.source)
    arrived = there.target > 0.0
    lit = exchange.samples.target > 0.0
    assert float((arrived & lit).float().sum() / lit.float().sum()) > 0.4
    returned = (back.target / exchange.samples.target - 1.0).abs() < 2e-3
    assert float(returned[arrived].float().mean()) > 0.998
    product = (there.jacobian * back.jacobian)[arrived & returned]
    torch.testing.assert_close(product, torch.ones_like(product), rtol=2e-3, atol=0.0)
    jacobian = there.jacobian[arrived]
    assert float(jacobian.log().std()) > 0.05 if reconnects else bool((jacobian == 1.0).all())


def test_without_looking_at_what_is_seen_samples_do_not_come_back(monkeypatch):
    monkeypatch.setattr(shifts, "same_point", lambda triangle, expected: torch.ones_like(triangle, dtype=torch.bool))
    exchange = Exchange(True)
    back = exchange.moved(exchange.arrived(), exchange.target, exchange.source)
    returned = (back.target / exchange.samples.target - 1.0).abs() < 2e-3
    assert float(returned[exchange.there.target > 0.0].float().mean()) < 0.95


def test_a_shifted_sample_is_what_the_camera_sees_there():
    exchange = Exchange(True)
    arrived, there = exchange.arrived(), exchange.there
    kept = (there.target > 0.0).nonzero()[:, 0]
    same = ((arrived.target / there.target)[kept] - 1.0).abs() < 1e-3
    assert float(same.float().mean()) > 0.999
    assert len(kept) > 1000


def test_only_what_can_succeed_is_traced():
    """Neither what is black nor what would have to pass outside the aperture."""
    exchange = Exchange(True)
    samples = exchange.samples
    samples.target[::2] = 0.0
    half = exchange.moved(samples, exchange.source, exchange.target)
    assert 0 < half.rays < 0.7 * exchange.there.rays
    assert not bool(half.target[::2].any())
    torch.testing.assert_close(half.target[1::2], exchange.there.target[1::2], rtol=1e-4, atol=1e-6)
    samples.lens_points[:] = 9.0
    assert exchange.moved(samples, exchange.source, exchange.target).rays == 0


def test_planes_are_those_of_the_floor():
    """y = FLOOR in the camera frame, whichever way its normal points; direction alone where there is nothing."""
    loop = first_pass()
    reservoirs = loop.mode.reuse.spatial._reservoirs
    floor = (reservoirs.triangle == 0) | (reservoirs.triangle == 1)
    assert int(floor.sum()) > 100
    expected = torch.tensor([[0.0], [1.0], [FLOOR]])
    torch.testing.assert_close(reservoirs.plane[:, floor], expected.expand(3, int(floor.sum())), rtol=0.0, atol=1e-5)
    missed = reservoirs.triangle < 0
    assert int(missed.sum()) > 100 and bool((reservoirs.depth[missed] == NO_DEPTH).all())
    assert bool((reservoirs.plane[:, missed] == torch.tensor([[0.0], [0.0], [1.0]])).all())


def test_the_share_of_lens_copies_falls_with_the_circle_of_confusion():
    coc = torch.tensor([0.0, 2.0, 2.001, 10.0, 100.0, 1e9])
    expected = [1.0, 1.0, 17.939 / 23.384 + 0.1, 17.939 / 31.383 + 0.1, 17.939 / 121.383 + 0.1, 0.1]
    np.testing.assert_allclose(copied_share(coc, 50.0).numpy(), expected, rtol=1e-5)
    torch.testing.assert_close(copied_share(coc / 10.0, 5.0), copied_share(coc, 50.0))


def test_which_shift_it_is_hangs_on_the_pinhole_hit_alone():
    """It is settled before there are samples, by the depth that the pixel's centre sees from the lens centre."""
    loop = loop_of("area-restir")
    copied = loop.mode.reuse.spatial._copied.clone()
    camera = loop.camera
    slope = 2.0 * np.tan(np.radians(25.0)) / WIDTH
    row = HEIGHT - 1  # sees the floor
    depth = FLOOR / ((0.5 * HEIGHT - row - 0.5) * slope)
    assert depth < 2.0
    coc = 2.0 * 0.25 * abs(depth - 1.5) / (depth * 1.5 * slope)
    expected = 32 * copied_share(torch.tensor([coc]), RADIUS)
    torch.testing.assert_close(copied.reshape(HEIGHT, WIDTH)[row, :10], expected.float().expand(10), rtol=1e-3, atol=0.0)
    assert camera.height == HEIGHT and len(copied.unique()) > 10
    loop.step()
    assert torch.equal(loop.mode.reuse.spatial._copied, copied)
