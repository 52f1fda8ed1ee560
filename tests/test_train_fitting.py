"""The record buffer and the Gaussians fitted to it, on samples made by hand and on lamps rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from torch import Tensor

from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.scene.types import Camera, Environment
from bokehguide.train import RenderLoop, RenderSettings
from bokehguide.train.fitting import ALPHA, find_spotlights, fit_gaussians, label_patches
from bokehguide.train.record_buffer import RecordBuffer

CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.1, focus_distance=2.0)
WIDTH, HEIGHT, WALL = 400, 40, 8.0


@pytest.fixture
def camera() -> ThinLensCamera:
    return ThinLensCamera(CAMERA, WIDTH, HEIGHT)


def points_at(camera: ThinLensCamera, column: Tensor, row: Tensor, depth: Tensor | float) -> Tensor:
    """Camera-frame points `[3, N]` seen at raster positions."""
    x, y = camera.slopes(torch.stack((column, row)))
    depth = torch.as_tensor(depth, dtype=torch.float32).expand_as(x)
    return torch.stack((x * depth, y * depth, depth))


def wall_record(camera: ThinLensCamera) -> RecordBuffer:
    """A record of a dim wall, one sample in each cell of the frame and its margin."""
    record = RecordBuffer(camera)
    row, column = torch.meshgrid(torch.arange(record.height) + 0.5, torch.arange(record.width) + 0.5, indexing="ij")
    points = points_at(camera, column.ravel() - record.border, row.ravel() - record.border, WALL)
    record.add(record.cells(camera, points), points, torch.full((points.shape[1],), 0.1))
    return record


def light_up(
    record: RecordBuffer,
    camera: ThinLensCamera,
    columns: Tensor,
    row: float,
    depth: Tensor | float,
    radiance: float = 1000.0,
) -> None:
    """Add one bright sample at the middle of each of some cells of one row."""
    points = points_at(camera, columns + 0.5, torch.full_like(columns, row + 0.5), depth)
    record.add(record.cells(camera, points), points, torch.full_like(columns, radiance))


def fitted(record: RecordBuffer, camera: ThinLensCamera, mean_luminance: float = 0.1) -> GaussianField:
    field = GaussianField()
    fit_gaussians(field, record, camera, mean_luminance)
    return field


def test_positions_are_weighted_by_radiance(camera):
    """A lamp of a hundredth of the cell's samples holds the position."""
    record = RecordBuffer(camera)
    lamp = points_at(camera, torch.tensor([200.5]), torch.tensor([20.5]), 4.0)
    wall = points_at(camera, torch.full((99,), 200.5), torch.full((99,), 20.5), WALL)
    points = torch.cat((lamp, wall), 1)
    light = torch.tensor([1e5] + [0.1] * 99)
    cells = record.cells(camera, points)
    record.add(cells, points, light)
    assert len(cells.unique()) == 1
    torch.testing.assert_close(record.positions(cells[:1]), lamp, rtol=1e-3, atol=1e-3)
    assert float(record.radiance().max()) == pytest.approx((1e5 + 9.9) / 100.0, rel=1e-5)


def test_the_margin_keeps_spots_beyond_the_frame(camera):
    record = wall_record(camera)
    for column in (-30.0, WIDTH + 30.0):
        light_up(record, camera, torch.tensor([column]), 20.0, 4.0)
    field = fitted(record, camera)
    raster = camera.raster(field.mean)[0].sort().values
    torch.testing.assert_close(raster, torch.tensor([-29.5, WIDTH + 30.5]), rtol=0.0, atol=0.1)


def test_points_beyond_the_margin_and_behind_the_lens_have_no_cell(camera):
    record = RecordBuffer(camera)
    columns, rows = torch.tensor([[-41.0, WIDTH + 41.0, 0.0, 0.0], [0.0, 0.0, -41.0, HEIGHT + 41.0]])
    beyond = points_at(camera, columns, rows, 4.0)
    assert record.cells(camera, beyond).tolist() == [-1] * 4
    behind = torch.tensor([[0.0], [0.0], [-3.0]])
    assert record.cells(camera, behind).tolist() == [-1]
    record.add(torch.tensor([-1]), beyond[:, :1], torch.tensor([1e9]))
    assert not record.sums.any()


@pytest.mark.parametrize("widths, patches", [(7.0, 1), (9.0, 2), (300.0, 2), (3e5, 2)])
def test_lamps_that_touch_are_split_on_depth(camera, widths, patches):
    """Two lamps of 3 cells side by side; the far one behind by some widths of the near one's cells."""
    far = 4.0 + widths * 4.0 * camera.pixel_slope
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([200.0, 201.0, 202.0]), 20.0, 4.0)
    light_up(record, camera, torch.tensor([203.0, 204.0, 205.0]), 20.0, far)
    field = fitted(record, camera)
    assert len(field) == patches
    if patches == 2:
        tolerance = 0.05 if widths > 100.0 else 1e-3  # the wall behind weighs on the depth
        torch.testing.assert_close(field.mean[2].sort().values, torch.tensor([4.0, far]), rtol=tolerance, atol=0.0)
        width = field.mean[2] * camera.pixel_slope
        torch.testing.assert_close(field.radius, 1.5 * width, rtol=0.05, atol=0.0)  # out to the ends of three cells


def test_a_receding_row_of_lamps_is_one_patch(camera):
    """Depths in small steps do not leap, however far apart their ends are."""
    record = wall_record(camera)
    light_up(record, camera, torch.arange(100.0, 300.0), 20.0, torch.linspace(3.0, 9.0, 200))
    assert len(fitted(record, camera)) == 1


def test_a_line_of_300_cells_is_one_patch(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.arange(50.0, 350.0), 20.0, 4.0)
    cells, points = find_spotlights(record, camera, 0.1)
    assert len(cells) == 300
    assert label_patches(record, cells, points[2], points[2] * camera.pixel_slope).unique().tolist() == [0]


def test_the_bounding_sphere_of_one_cell_holds_a_ball_as_wide_as_the_cell(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([200.0]), 20.0, 4.0)
    field = fitted(record, camera)
    center = points_at(camera, torch.tensor([200.5]), torch.tensor([20.5]), 4.0)
    torch.testing.assert_close(field.mean, center, rtol=1e-3, atol=1e-3)
    width = field.mean[2] * camera.pixel_slope
    torch.testing.assert_close(field.radius, 0.5 * width, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(field.sigma, ALPHA * field.radius)


@pytest.mark.parametrize("cells", [3.0, 8.0, 15.0])
def test_the_bounding_sphere_of_a_disc_is_as_wide_as_the_disc(camera, cells):
    """And not as the square around it, whose corners are √2 further out."""
    record = wall_record(camera)
    for row in range(int(20 - cells), int(20 + cells)):
        across = (cells**2 - (row + 0.5 - 20.0) ** 2) ** 0.5
        columns = torch.arange(400.0)
        light_up(record, camera, columns[(columns + 0.5 - 200.0).abs() <= across], float(row), 4.0, radiance=1e5)
    field = fitted(record, camera)
    assert len(field) == 1
    assert float(field.radius[0] / (field.mean[2] * camera.pixel_slope)) == pytest.approx(cells, abs=0.75)
    torch.testing.assert_close(camera.raster(field.mean)[:, 0], torch.tensor([200.0, 20.0]), rtol=0.0, atol=0.05)


def test_lamps_apart_are_patches_apart_whatever_their_order(camera):
    record = wall_record(camera)
    for column in (350.0, 40.0, 200.0):
        light_up(record, camera, torch.tensor([column, column + 1.0]), 20.0, 4.0)
    field = fitted(record, camera)
    columns = camera.raster(field.mean)[0].sort().values
    torch.testing.assert_close(columns, torch.tensor([41.0, 201.0, 351.0]), rtol=0.0, atol=0.05)
    torch.testing.assert_close(field.sigma, ALPHA * field.radius)


def test_what_is_in_focus_or_dim_is_no_spotlight(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([100.0]), 20.0, 2.01)  # a CoC below 4 pixels
    light_up(record, camera, torch.tensor([200.0]), 20.0, 4.0, radiance=1.4)  # (0.1 + 1.4) / 2 is 7.5 means
    light_up(record, camera, torch.tensor([300.0]), 20.0, 4.0, radiance=1.6)
    cells, _ = find_spotlights(record, camera, 0.1)
    assert (cells % record.width - record.border).tolist() == [300]


def test_nothing_is_found_in_a_constant_frame():
    loop = RenderLoop(scenes.furnace(32, 18), RenderSettings("lis", threads=1))
    for _ in range(5):
        stats = loop.step()
    assert stats.gaussians == 0 and np.isnan(stats.beta)
    record = wall_record(ThinLensCamera(CAMERA, WIDTH, HEIGHT))
    assert len(fitted(record, ThinLensCamera(CAMERA, WIDTH, HEIGHT))) == 0


def spots_of(scene, steps: int = 12) -> GaussianField:
    loop = RenderLoop(scene, RenderSettings("lis", threads=1))
    for _ in range(steps):
        loop.step()
    return loop.guide.field


def scaled(scene, light: float, length: float):
    """The scene with all light and all lengths multiplied."""
    camera = scene.camera
    camera = replace(
        camera,
        position=tuple(length * x for x in camera.position),
        target=tuple(length * x for x in camera.target),
        aperture_radius=length * camera.aperture_radius,
        focus_distance=length * camera.focus_distance,
    )
    return replace(
        scene,
        camera=camera,
        meshes=tuple(replace(mesh, vertices=mesh.vertices * np.float32(length)) for mesh in scene.meshes),
        materials=tuple(replace(m, emission=tuple(light * c for c in m.emission)) for m in scene.materials),
        environment=replace(scene.environment, radiance=np.float32(light) * scene.environment.radiance),
    )


@pytest.mark.parametrize("light, length", [(1000.0, 1.0), (1.0, 100.0), (0.001, 0.01)])
def test_spots_do_not_depend_on_the_units(light, length):
    scene = scenes.lamps(64, 36)
    field, other = spots_of(scene), spots_of(scaled(scene, light, length))
    assert len(field) == len(other) > 0
    torch.testing.assert_close(other.mean, length * field.mean, rtol=1e-3, atol=1e-3 * length)
    torch.testing.assert_close(other.sigma, length * field.sigma, rtol=1e-2, atol=0.0)
    torch.testing.assert_close(other.energy, light * length**2 * field.energy, rtol=1e-2, atol=0.0)


@pytest.mark.parametrize("lamp", range(len(scenes.LAMP_RADII)))
def test_a_lamp_under_a_dim_sky_gives_its_gaussian(lamp, gaussians_of_lamps):
    """Found once; its centre within a fifth of its radius across and 3 % in depth, σ between R/2 and 2 R.

    The sky, recorded at 1000 focus distances, shares the cells of the lamp's rim.
    """
    field = gaussians_of_lamps
    assert len(field) == len(scenes.LAMP_RADII)
    x, y, z = scenes.LAMP_CENTRES[lamp]
    centre, radius = torch.tensor([x, y, -z], dtype=torch.float32), float(scenes.LAMP_RADII[lamp])
    nearest = int((field.mean - centre[:, None]).square().sum(0).argmin())
    mean = field.mean[:, nearest]
    assert float(mean[2]) == pytest.approx(float(centre[2]), rel=0.03)
    assert float((mean[:2] / mean[2] - centre[:2] / centre[2]).norm() * centre[2]) < 0.2 * radius
    assert 0.5 * radius < float(field.sigma[nearest]) < 2.0 * radius


@pytest.fixture(scope="module")
def gaussians_of_lamps() -> GaussianField:
    return spots_of(scenes.lamps(256, 144), steps=8)


def test_a_spot_of_the_environment_is_recorded_far_away():
    """One bright texel straight ahead: a Gaussian on the axis at about 1000 focus distances."""
    sky = np.full((64, 128, 3), 0.01, np.float32)
    sky[31:33, 63:65] = 1000.0
    scene = replace(scenes.lamps(64, 36), environment=Environment(sky))
    scene = replace(scene, meshes=scenes.furnace(64, 36).meshes, materials=(scenes.BLACK,))
    field = spots_of(scene, steps=8)
    assert len(field) == 1
    focus_distance = scene.camera.focus_distance
    assert float(field.mean[2, 0]) == pytest.approx(1000.0 * focus_distance, rel=0.02)
    assert float((field.mean[:2, 0] / field.mean[2, 0]).norm()) < 0.01
    half_width = np.tan(np.pi / 64.0) * 1000.0 * focus_distance
    assert 0.5 * half_width < float(field.sigma[0]) < 2.0 * half_width
