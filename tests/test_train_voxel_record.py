"""The record of highlights by depth: against a plain dictionary, its bounds, and in a render."""

from __future__ import annotations

import copy
import math
from collections import defaultdict

import pytest
import torch
from ablation_scenes import FAR, NEAR, mirror_balls

from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.voxel_record import LAYERS, OCTAVES, PER_OCTAVE, TEXELS, VoxelRecord

FOCUS = 2.0
CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.05, focus_distance=FOCUS)
THRESHOLD = 5.0


def camera() -> ThinLensCamera:
    return ThinLensCamera(CAMERA, 64, 36)


def samples(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions `[3, N]` all over the frame and from the lens to far behind the focal plane, and luminance `[N]`, some of it high."""
    generator = torch.Generator().manual_seed(seed)
    x, y, z, light = torch.rand(4, count, generator=generator)
    depth = 0.2 * (1e4**z)
    return torch.stack((0.3 * (x - 0.5) * depth, 0.2 * (y - 0.5) * depth, depth)), 0.1 / (1.001 - light)


def layer(depth: float) -> int:
    """By defocus: PER_OCTAVE to a doubling, the last of either side beyond 4 times, from near to far."""
    defocus = 1.0 - FOCUS / depth
    place = min(max(math.floor(PER_OCTAVE * (math.log2(max(abs(defocus), 1e-30)) + OCTAVES - 2)), 0), LAYERS // 2 - 1)
    return LAYERS // 2 - 1 - place if defocus < 0.0 else LAYERS // 2 + place


def test_it_is_a_dictionary_of_bright_samples():
    """Two blocks: of what is dim, only that counts which comes after a block in which its cell was bright."""
    record, lens = VoxelRecord(camera()), camera()
    seen, lit = defaultdict(lambda: [0.0] * 5), set()
    per_cell = defaultdict(int)
    for block in range(2):
        points, light = samples(3000, seed=block)
        cells = record.cells(lens, points)
        for part in (slice(0, 1000), slice(1000, 3000)):
            record.add([(cells[part], points[:, part], light[part])], THRESHOLD)
        record.settle()
        for cell, (x, y, z), value in zip(cells.tolist(), points.T.double().tolist(), light.double().tolist()):
            per_cell[cell] += 1
            if value > THRESHOLD or cell in lit:
                sums = seen[cell * LAYERS + layer(z)]
                for place, term in enumerate((1.0, value, value * x / z, value * y / z, value / z)):
                    sums[place] += term
        lit = {number // LAYERS for number in seen}
    assert record.voxels[:, 0].tolist() == sorted(seen)
    torch.testing.assert_close(record.voxels[:, 1:], torch.tensor([seen[number] for number in sorted(seen)], dtype=torch.float64))
    cells, points, radiance = record.bright(1.0)
    expected = []
    for number, (count, value, x, y, inverse) in sorted(seen.items()):
        nearer = sum(sums[0] for other, sums in seen.items() if other // LAYERS == number // LAYERS and other < number)
        mean = value / (per_cell[number // LAYERS] - nearer)
        if mean > 1.0:
            expected.append((number // LAYERS, x / inverse, y / inverse, value / inverse, mean))
    assert 10 < len(expected) < len(seen) and cells.tolist() == [int(row[0]) for row in expected]
    torch.testing.assert_close(torch.cat((points, radiance[None])).T, torch.tensor(expected)[:, 1:])


def test_highlights_behind_one_another_stay_two():
    """The farther one's mean is over the samples that the nearer one let pass."""
    record, lens = VoxelRecord(camera()), camera()
    depth = torch.tensor([0.8] * 30 + [6.0] * 10)
    points = torch.stack((0.01 * depth, 0.02 * depth, depth))
    record.add([(record.cells(lens, points), points, torch.tensor([20.0] * 30 + [40.0] * 10))], THRESHOLD)
    record.settle()
    cells, points, radiance = record.bright(THRESHOLD)
    assert len(cells.unique()) == 1 and radiance.tolist() == [15.0, 40.0]
    torch.testing.assert_close(points, torch.tensor([[0.01, 0.02, 1.0]]).T * torch.tensor([0.8, 6.0]))


def test_there_are_no_more_voxels_than_a_share_of_the_cells():
    record, lens = VoxelRecord(camera()), camera()
    points, light = samples(40_000, seed=5)
    record.add([(record.cells(lens, points), points, light)], 0.0)
    everything = VoxelRecord(camera())
    everything._most = 10**9
    everything.add([(everything.cells(lens, points), points, light)], 0.0)
    record.settle()
    everything.settle()
    most = record.sums.shape[1] // TEXELS
    assert len(everything.voxels) > 2 * most and len(record.voxels) == most
    kept = torch.isin(everything.voxels[:, 0], record.voxels[:, 0])
    assert float(everything.voxels[kept, 2].min()) >= float(everything.voxels[~kept, 2].max())
    assert bool((record.voxels[:, 0].diff() > 0.0).all())


def test_few_samples_wait():
    """Those of one step, beside as many as there are voxels at most; told to other ranks in between or not."""
    told, quiet, lens = VoxelRecord(camera()), VoxelRecord(camera()), camera()
    most, settled = told.sums.shape[1] // TEXELS, 0
    for step in range(40):
        points, light = samples(100, seed=step)
        for record in (told, quiet):
            record.add([(record.cells(lens, points), points, light)], 0.0)
            if record is told and step % 3 == 0:
                record.merge()
            record.end_step()
            waits = int(record.waiting[:, 1].sum()) + sum(map(len, record._new))
            assert waits <= most
        settled += waits == 0
    assert 5 < settled < 30
    told.settle()
    quiet.settle()
    assert torch.equal(told.voxels, quiet.voxels)


def test_what_is_saved_goes_on():
    record, other = VoxelRecord(camera()), VoxelRecord(camera())
    lens = camera()
    for part in range(4):
        points, light = samples(500, seed=part)
        for one in (record, other) if part > 1 else (record,):
            one.add([(one.cells(lens, points), points, light)], THRESHOLD)
        if part == 0:
            record.settle()
        if part == 1:
            other.add([(other.cells(lens, points), points, light)], THRESHOLD)  # forgotten
            record.merge()
            other.load_state_dict(record.state_dict())
            assert other._arrived == 0 and other._waiting == float(other.waiting[:, 1].sum()) > 0.0
    record.settle()
    other.settle()
    assert torch.equal(record.voxels, other.voxels) and torch.equal(record.sums, other.sums)


def test_telling_other_ranks_changes_nothing():
    """Within a block: neither which cells are lit, nor what is added up in the end."""
    told, quiet = VoxelRecord(camera()), VoxelRecord(camera())
    lens = camera()
    for part in range(6):
        points, light = samples(500, seed=part)
        for record in (told, quiet):
            record.add([(record.cells(lens, points), points, light)], THRESHOLD)
        told.merge()
        if part == 1:
            told.settle()
            quiet.settle()
    told.settle()
    quiet.settle()
    assert len(told.voxels) > 50 and torch.equal(told.voxels, quiet.voxels)


@pytest.mark.parametrize(
    "voxels",
    [
        torch.tensor([[0.5, 1, 1, 0, 0, 1]]),
        torch.tensor([[-1.0, 1, 1, 0, 0, 1]]),
        torch.tensor([[1e12, 1, 1, 0, 0, 1]]),
        torch.tensor([[3.0, -1, 1, 0, 0, 1]]),
        torch.tensor([[3.0, 0, 1, 0, 0, 1]]),
        torch.tensor([[3.0, 1, 1, 0, 0, 0]]),
        torch.tensor([[3.0, 1, 1, 0, 0, 1]] * 2),
        torch.zeros(1, 5),
        torch.zeros(6),
    ],
)
def test_voxels_that_are_none_are_refused(voxels):
    record = VoxelRecord(camera())
    state = record.state_dict() | {"voxels": voxels.double()}
    with pytest.raises(ValueError, match="voxels"):
        record.load_state_dict(state)


def found_depths(monkeypatch: pytest.MonkeyPatch, layered: bool) -> tuple[int, int]:
    """How many highlights of the near and of the far balls a guide has found."""
    if not layered:
        monkeypatch.setattr(VoxelRecord, "_layers", lambda self, depth: torch.zeros_like(depth, dtype=torch.int64))
    loop = RenderLoop(mirror_balls(160, 90), RenderSettings("guided", 64, threads=1))
    for _ in range(64):
        loop.step()
    depth = loop.guide.field.mean[2]
    return int(((depth - NEAR).abs() < 0.05 * NEAR).sum()), int(((depth - FAR).abs() < 0.05 * FAR).sum())


def test_a_render_finds_highlights_behind_one_another(monkeypatch):
    near, far = found_depths(monkeypatch, layered=True)
    without = found_depths(monkeypatch, layered=False)
    assert near > 20 and far > 5 > without[1]


def test_saving_changes_no_bit():
    """Also in the middle of blocks, whatever is then known of highlights."""
    saved, quiet = (RenderLoop(mirror_balls(96, 54), RenderSettings("guided", 24, threads=1)) for _ in range(2))
    for step in range(1, 21):
        for loop in (saved, quiet):
            loop.step()
        if step in (4, 6, 7, 10, 13, 14):
            saved.state_dict()
    assert len(quiet.guide.record.voxels) > 20
    assert torch.equal(saved.film.radiance(), quiet.film.radiance())
    assert torch.equal(saved.guide.record.voxels, quiet.guide.record.voxels)


def test_a_state_takes_the_place_of_what_a_loop_has_seen():
    one, other = (RenderLoop(mirror_balls(96, 54), RenderSettings("guided", 24, threads=1)) for _ in range(2))
    for _ in range(6):
        one.step()
    for _ in range(7):
        other.step()
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for loop in (one, other):
        for _ in range(6):
            loop.step()
    assert torch.equal(one.film.radiance(), other.film.radiance())
