"""The record that keeps depths apart: against a plain dictionary, its bounds on memory, and in a render."""

from __future__ import annotations

import copy
import math
from collections import defaultdict

import pytest
import torch
from ablation_scenes import FAR, NEAR, mirror_balls

from bokehguide.guiding import layered_record
from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.layered_record import CELLS_PER_VOXEL, LAYERS, OCTAVES, PER_OCTAVE, VoxelRecord
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera, Scene
from bokehguide.train import RenderLoop, RenderSettings

FOCUS = 2.0
CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.05, focus_distance=FOCUS)
THRESHOLD = 5.0


def camera() -> ThinLensCamera:
    return ThinLensCamera(CAMERA, 64, 36)


def samples(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions `[3, N]` in the frame, from the lens to far behind the focal plane, and luminance `[N]`, high for some."""
    generator = torch.Generator().manual_seed(seed)
    x, y, z, light = torch.rand(4, count, generator=generator)
    depth = 0.2 * (1e4**z)
    return torch.stack((0.3 * (x - 0.5) * depth, 0.2 * (y - 0.5) * depth, depth)), 0.1 / (1.001 - light)


def layer(depth: float) -> int:
    """Layer from near to far by defocus: PER_OCTAVE to a doubling, the last of either side beyond 4."""
    defocus = 1.0 - FOCUS / depth
    place = min(max(math.floor(PER_OCTAVE * (math.log2(max(abs(defocus), 1e-30)) + OCTAVES - 2)), 0), LAYERS // 2 - 1)
    return LAYERS // 2 - 1 - place if defocus < 0.0 else LAYERS // 2 + place


def test_the_record_is_a_dictionary_of_bright_samples():
    """Two epochs. A dim sample counts only where its cell was bright in an earlier epoch."""
    record, lens = VoxelRecord(camera()), camera()
    seen, lit = defaultdict(lambda: [0.0] * 5), set()
    per_cell = defaultdict(int)
    for epoch in range(2):
        points, light = samples(3000, seed=epoch)
        cells = record.cells(lens, points)
        for part in (slice(0, 1000), slice(1000, 3000)):
            record.add([(cells[part], points[:, part], light[part])], THRESHOLD)
        record.merge_voxels()
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
    for number, (_, value, x, y, inverse) in sorted(seen.items()):
        nearer = sum(sums[0] for other, sums in seen.items() if other // LAYERS == number // LAYERS and other < number)
        mean = value / (per_cell[number // LAYERS] - nearer)
        if mean > 1.0:
            expected.append((number // LAYERS, x / inverse, y / inverse, value / inverse, mean))
    assert 10 < len(expected) < len(seen) and cells.tolist() == [int(row[0]) for row in expected]
    torch.testing.assert_close(torch.cat((points, radiance[None])).T, torch.tensor(expected)[:, 1:])


def test_highlights_behind_one_another_stay_two():
    """The farther one's mean is over the samples that the nearer one did not block."""
    record, lens = VoxelRecord(camera()), camera()
    depth = torch.tensor([0.8] * 30 + [6.0] * 10)
    points = torch.stack((0.01 * depth, 0.02 * depth, depth))
    record.add([(record.cells(lens, points), points, torch.tensor([20.0] * 30 + [40.0] * 10))], THRESHOLD)
    record.merge_voxels()
    cells, points, radiance = record.bright(THRESHOLD)
    assert len(cells.unique()) == 1 and radiance.tolist() == [15.0, 40.0]
    torch.testing.assert_close(points, torch.tensor([[0.01, 0.02, 1.0]]).T * torch.tensor([0.8, 6.0]))


def test_the_number_of_voxels_is_bounded(monkeypatch):
    """By a share of the cells; the voxels with the most light stay."""
    record, lens = VoxelRecord(camera()), camera()
    points, light = samples(40_000, seed=5)
    record.add([(record.cells(lens, points), points, light)], 0.0)
    monkeypatch.setattr(layered_record, "CELLS_PER_VOXEL", 1e-3)
    everything = VoxelRecord(camera())
    everything.add([(everything.cells(lens, points), points, light)], 0.0)
    record.merge_voxels()
    everything.merge_voxels()
    most = record.sums.shape[1] // CELLS_PER_VOXEL
    assert len(everything.voxels) > 2 * most and len(record.voxels) == most
    kept = torch.isin(everything.voxels[:, 0], record.voxels[:, 0])
    assert float(everything.voxels[kept, 2].min()) >= float(everything.voxels[~kept, 2].max())
    assert bool((record.voxels[:, 0].diff() > 0.0).all())


def test_the_number_of_waiting_samples_is_bounded():
    """At most the samples of one step, beside as many as there may be voxels; whether ranks merge in between or not."""
    merged, alone, lens = VoxelRecord(camera()), VoxelRecord(camera()), camera()
    most, emptied = merged.sums.shape[1] // CELLS_PER_VOXEL, 0
    for step in range(40):
        points, light = samples(100, seed=step)
        for record in (merged, alone):
            record.add([(record.cells(lens, points), points, light)], 0.0)
            if record is merged and step % 3 == 0:
                record.merge()
            record.end_step()
            waiting = int(record.waiting[:, 1].sum()) + sum(map(len, record._new))
            assert waiting <= most
        emptied += waiting == 0
    assert 5 < emptied < 30
    merged.merge_voxels()
    alone.merge_voxels()
    assert torch.equal(merged.voxels, alone.voxels)


def test_a_loaded_record_goes_on_as_the_saved_one():
    """Samples that the loading record had before are forgotten."""
    record, other = VoxelRecord(camera()), VoxelRecord(camera())
    lens = camera()
    for part in range(4):
        points, light = samples(500, seed=part)
        for one in (record, other) if part > 1 else (record,):
            one.add([(one.cells(lens, points), points, light)], THRESHOLD)
        if part == 0:
            record.merge_voxels()
        if part == 1:
            other.add([(other.cells(lens, points), points, light)], THRESHOLD)
            record.merge()
            other.load_state_dict(record.state_dict())
            assert torch.equal(other.waiting, record.waiting) and float(other.waiting[:, 1].sum()) > 0.0
    record.merge_voxels()
    other.merge_voxels()
    assert torch.equal(record.voxels, other.voxels) and torch.equal(record.sums, other.sums)


def test_merging_ranks_changes_nothing():
    """Within an epoch neither the lit cells change nor the sums at its end."""
    merged, alone = VoxelRecord(camera()), VoxelRecord(camera())
    lens = camera()
    for part in range(6):
        points, light = samples(500, seed=part)
        for record in (merged, alone):
            record.add([(record.cells(lens, points), points, light)], THRESHOLD)
        merged.merge()
        if part == 1:
            merged.merge_voxels()
            alone.merge_voxels()
    merged.merge_voxels()
    alone.merge_voxels()
    assert len(merged.voxels) > 50 and torch.equal(merged.voxels, alone.voxels)


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
def test_voxels_that_no_record_has_are_refused(voxels):
    record = VoxelRecord(camera())
    state = record.state_dict() | {"voxels": voxels.double()}
    with pytest.raises(ValueError, match="voxels"):
        record.load_state_dict(state)


def loop_of(scene: Scene, spp: int, config: GuidedConfig = GuidedConfig()) -> RenderLoop:
    return RenderLoop(scene, RenderSettings("guided", spp, threads=1, guided=config))


def found_depths(by_depth: bool) -> tuple[int, int]:
    """The number of highlights of the near and of the far balls that a guide has found."""
    with loop_of(mirror_balls(160, 90), 64, GuidedConfig(depth_layers=by_depth)) as loop:
        for _ in range(64):
            loop.step()
    depth = loop.mode.lens.field.mean[2]
    return int(((depth - NEAR).abs() < 0.05 * NEAR).sum()), int(((depth - FAR).abs() < 0.05 * FAR).sum())


@pytest.mark.slow
def test_a_render_finds_highlights_behind_one_another():
    near, far = found_depths(by_depth=True)
    _, far_without = found_depths(by_depth=False)
    assert near > 20 and far > 5 > far_without


@pytest.mark.slow
def test_saving_changes_no_bit():
    """Also within epochs, whatever the record has of highlights by then."""
    with loop_of(mirror_balls(96, 54), 24) as saved, loop_of(mirror_balls(96, 54), 24) as other:
        for step in range(1, 21):
            for loop in (saved, other):
                loop.step()
            if step in (4, 6, 7, 10, 13, 14):
                saved.state_dict()
    assert len(other.mode.lens.record_buffer.voxels) > 20
    assert torch.equal(saved.film.radiance(), other.film.radiance())
    assert torch.equal(saved.mode.lens.record_buffer.voxels, other.mode.lens.record_buffer.voxels)


def test_a_loaded_state_replaces_the_samples_of_a_loop():
    with loop_of(mirror_balls(96, 54), 24) as one, loop_of(mirror_balls(96, 54), 24) as other:
        for _ in range(6):
            one.step()
        for _ in range(7):
            other.step()
        other.load_state_dict(copy.deepcopy(one.state_dict()))
        for loop in (one, other):
            for _ in range(6):
                loop.step()
    assert torch.equal(one.film.radiance(), other.film.radiance())
