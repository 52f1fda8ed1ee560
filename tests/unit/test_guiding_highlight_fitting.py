"""The record buffer, and Gaussians and ellipsoids fitted to a record, on samples made by hand and on rendered emitters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from bokehguide.guiding.config import GaussianConfig, GuidedConfig, HighlightConfig
from bokehguide.guiding.highlight_fitting import find_highlights, fit_ellipsoids, fit_gaussians, label_patches
from bokehguide.guiding.record_buffer import RecordBuffer
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.vector import luminance
from bokehguide.scene.types import Camera, Environment, Scene
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes

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
    record.add([(record.cells(camera, points), points, torch.full((points.shape[1],), 0.1))])
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
    record.add([(record.cells(camera, points), points, torch.full_like(columns, radiance))])


def fitted(record: RecordBuffer, camera: ThinLensCamera, mean_luminance: float = 0.1) -> GaussianField:
    field = GaussianField()
    fit_gaussians(field, record, camera, mean_luminance, GaussianConfig())
    return field


def test_positions_are_weighted_by_radiance(camera):
    """An emitter of a hundredth of the cell's samples holds the position."""
    record = RecordBuffer(camera)
    emitter = points_at(camera, torch.tensor([200.5]), torch.tensor([20.5]), 4.0)
    wall = points_at(camera, torch.full((99,), 200.5), torch.full((99,), 20.5), WALL)
    points = torch.cat((emitter, wall), 1)
    light = torch.tensor([1e5] + [0.1] * 99)
    cells = record.cells(camera, points)
    record.add([(cells, points, light)])
    assert len(cells.unique()) == 1
    torch.testing.assert_close(record.positions(cells[:1]), emitter, rtol=1e-3, atol=1e-3)
    assert float(record.radiance().max()) == pytest.approx((1e5 + 9.9) / 100.0, rel=1e-5)


def test_the_margin_records_highlights_beyond_the_frame(camera):
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
    record.add([(torch.tensor([-1]), beyond[:, :1], torch.tensor([1e9]))])
    assert not record.sums.any()


@pytest.mark.parametrize("widths, patches", [(7.0, 1), (9.0, 2), (300.0, 2), (3e5, 2)])
def test_emitters_that_touch_are_split_by_depth(camera, widths, patches):
    """Two emitters of 3 cells side by side; the far one behind by some widths of the near one's cells."""
    far = 4.0 + widths * 4.0 * camera.pixel_slope
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([200.0, 201.0, 202.0]), 20.0, 4.0)
    light_up(record, camera, torch.tensor([203.0, 204.0, 205.0]), 20.0, far)
    field = fitted(record, camera)
    assert len(field) == patches
    if patches == 2:
        tolerance = 0.05 if widths > 100.0 else 1e-3  # the wall behind changes the mean depth
        torch.testing.assert_close(field.mean[2].sort().values, torch.tensor([4.0, far]), rtol=tolerance, atol=0.0)
        width = field.mean[2] * camera.pixel_slope
        torch.testing.assert_close(field.radius, 1.5 * width, rtol=0.05, atol=0.0)  # out to the ends of three cells


def test_a_receding_row_of_emitters_is_one_patch(camera):
    """Small steps of depth split no patch, however far apart its ends are."""
    record = wall_record(camera)
    light_up(record, camera, torch.arange(100.0, 300.0), 20.0, torch.linspace(3.0, 9.0, 200))
    assert len(fitted(record, camera)) == 1


def test_a_line_of_300_cells_is_one_patch(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.arange(50.0, 350.0), 20.0, 4.0)
    cells, points, _ = find_highlights(record, camera, 0.1, HighlightConfig())
    assert len(cells) == 300
    assert label_patches(
        record, cells, points[2], points[2] * camera.pixel_slope, HighlightConfig.depth_gap
    ).unique().tolist() == [0]


def test_the_bounding_sphere_of_one_cell_holds_a_ball_as_wide_as_the_cell(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([200.0]), 20.0, 4.0)
    field = fitted(record, camera)
    center = points_at(camera, torch.tensor([200.5]), torch.tensor([20.5]), 4.0)
    torch.testing.assert_close(field.mean, center, rtol=1e-3, atol=1e-3)
    width = field.mean[2] * camera.pixel_slope
    torch.testing.assert_close(field.radius, 0.5 * width, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(field.sigma, GaussianConfig.sigma_scale * field.radius)


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


def test_separate_emitters_are_separate_patches_in_any_order(camera):
    record = wall_record(camera)
    for column in (350.0, 40.0, 200.0):
        light_up(record, camera, torch.tensor([column, column + 1.0]), 20.0, 4.0)
    field = fitted(record, camera)
    columns = camera.raster(field.mean)[0].sort().values
    torch.testing.assert_close(columns, torch.tensor([41.0, 201.0, 351.0]), rtol=0.0, atol=0.05)
    torch.testing.assert_close(field.sigma, GaussianConfig.sigma_scale * field.radius)


def test_cells_in_focus_or_dim_are_no_highlights(camera):
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([100.0]), 20.0, 2.01)  # a CoC below 4 pixels
    light_up(record, camera, torch.tensor([200.0]), 20.0, 4.0, radiance=1.4)  # (0.1 + 1.4) / 2 is 7.5 means
    light_up(record, camera, torch.tensor([300.0]), 20.0, 4.0, radiance=1.6)
    cells, *_ = find_highlights(record, camera, 0.1, HighlightConfig())
    assert (cells % record.width - record.border).tolist() == [300]


def test_nothing_is_found_in_a_constant_frame():
    with RenderLoop(scenes.furnace(32, 18), RenderSettings("lis", threads=1)) as loop:
        for _ in range(5):
            stats = loop.step()
    assert stats.gaussians == 0 and np.isnan(stats.beta)
    record = wall_record(ThinLensCamera(CAMERA, WIDTH, HEIGHT))
    assert len(fitted(record, ThinLensCamera(CAMERA, WIDTH, HEIGHT))) == 0


def rendered(scene: Scene, steps: int) -> RenderLoop:
    """A loop of the mode `lis` after some steps."""
    with RenderLoop(scene, RenderSettings("lis", threads=1)) as loop:
        for _ in range(steps):
            loop.step()
    return loop


def gaussians_of(scene: Scene, steps: int = 12) -> GaussianField:
    return rendered(scene, steps).mode.lens.field


@pytest.mark.parametrize("light, length", [(1000.0, 1.0), (1.0, 100.0), (0.001, 0.01)])
def test_gaussians_do_not_depend_on_the_units(light, length):
    scene = scenes.emitters(64, 36)
    field, other = gaussians_of(scene), gaussians_of(scenes.scaled(scene, light, length))
    assert len(field) == len(other) > 0
    torch.testing.assert_close(other.mean, length * field.mean, rtol=1e-3, atol=1e-3 * length)
    torch.testing.assert_close(other.sigma, length * field.sigma, rtol=1e-2, atol=0.0)
    torch.testing.assert_close(other.energy, light * length**2 * field.energy, rtol=1e-2, atol=0.0)


@pytest.mark.parametrize("emitter", range(len(scenes.LAMP_RADII)))
def test_an_emitter_under_a_dim_sky_gives_its_gaussian(emitter, gaussians_of_emitters):
    """Found once; its centre within a fifth of its radius across and 3 % in depth, σ between R/2 and 2 R.

    The sky, recorded at 1000 focus distances, shares the cells of the emitter's rim.
    """
    field = gaussians_of_emitters
    assert len(field) == len(scenes.LAMP_RADII)
    x, y, z = scenes.LAMP_CENTRES[emitter]
    centre, radius = torch.tensor([x, y, -z], dtype=torch.float32), float(scenes.LAMP_RADII[emitter])
    nearest = int((field.mean - centre[:, None]).square().sum(0).argmin())
    mean = field.mean[:, nearest]
    assert float(mean[2]) == pytest.approx(float(centre[2]), rel=0.03)
    assert float((mean[:2] / mean[2] - centre[:2] / centre[2]).norm() * centre[2]) < 0.2 * radius
    assert 0.5 * radius < float(field.sigma[nearest]) < 2.0 * radius


@pytest.fixture(scope="module")
def gaussians_of_emitters() -> GaussianField:
    return gaussians_of(scenes.emitters(256, 144), steps=8)


def test_a_highlight_of_the_environment_is_recorded_far_away():
    """One bright texel straight ahead: a Gaussian on the axis at about 1000 focus distances."""
    sky = np.full((64, 128, 3), 0.01, np.float32)
    sky[31:33, 63:65] = 1000.0
    scene = replace(scenes.emitters(64, 36), environment=Environment(sky))
    scene = replace(scene, meshes=scenes.furnace(64, 36).meshes, materials=(scenes.BLACK,))
    field = gaussians_of(scene, steps=8)
    assert len(field) == 1
    focus_distance = scene.camera.focus_distance
    assert float(field.mean[2, 0]) == pytest.approx(1000.0 * focus_distance, rel=0.02)
    assert float((field.mean[:2, 0] / field.mean[2, 0]).norm()) < 0.01
    half_width = np.tan(np.pi / 64.0) * 1000.0 * focus_distance
    assert 0.5 * half_width < float(field.sigma[0]) < 2.0 * half_width


def light_where(record: RecordBuffer, camera: ThinLensCamera, lit, depth: float = 4.0, radiance: float = 1e5) -> None:
    """Add a bright sample to each cell of the frame whose middle's column and row are `lit`."""
    row, column = (values.ravel() + 0.5 for values in torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij"))
    inside = lit(column, row)
    points = points_at(camera, column[inside], row[inside], depth)
    record.add([(record.cells(camera, points), points, torch.full((points.shape[1],), radiance))])


def disc(x: float, y: float, radius: float):
    """Whether a cell's middle is within a disc."""
    return lambda column, row: (column - x).square() + (row - y).square() <= radius**2


def half_axes(outline: Tensor) -> Tensor:
    """Half axes `[3, G]` of packed outlines, the smallest first, in double precision."""
    xx, xy, xz, yy, yz, zz = outline.double()
    matrices = torch.stack((xx, xy, xz, xy, yy, yz, xz, yz, zz), dim=1).reshape(-1, 3, 3)
    squared = torch.linalg.eigvalsh(matrices)
    assert (squared > -1e-5 * squared[:, 2:]).all()
    return squared.clamp(min=0.0).sqrt().T


@pytest.mark.parametrize("cells", [3.0, 8.0, 15.0])
def test_the_ellipsoid_of_an_even_disc_is_as_wide_as_the_disc(camera, cells):
    """`highlight_axes` scales it, and 2 would fit an even disc. It is flat, and has the disc's place and energy."""
    record = wall_record(camera)
    light_where(record, camera, disc(200.0, 20.0, cells))
    found, mean, outline, largest, energy = fit_ellipsoids(record, camera, 0.1, GuidedConfig())
    assert mean.shape == (3, 1) and outline.shape == (6, 1) and largest.shape == energy.shape == (1,)
    torch.testing.assert_close(mean, points_at(camera, torch.tensor([200.0]), torch.tensor([20.0]), 4.0), rtol=1e-4, atol=1e-4)
    width = float(mean[2]) * camera.pixel_slope
    thin, *wide = half_axes(outline)[:, 0] / width
    radius = (len(found) / np.pi) ** 0.5  # of the lit cells
    assert [float(axis) for axis in wide] == pytest.approx([0.5 * GuidedConfig.highlight_axes * radius] * 2, rel=0.02)
    assert float(thin) < 0.1
    assert float(largest / width) == pytest.approx(float(wide[1]), rel=1e-3)
    # Half of each cell's samples show the wall; the outline counts with its whole area.
    assert float(energy) == pytest.approx(5e4 * float(wide[0] * wide[1]) * width**2, rel=0.01)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 135.0])
def test_the_ellipsoid_of_a_strip_lies_along_it(camera, degrees):
    """Four to one: it has the axes of an even strip, and the outline's covariance points along the strip (rows run downwards)."""
    along = torch.tensor([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], dtype=torch.float32)

    def strip(column: Tensor, row: Tensor) -> Tensor:
        x, y = column - 200.0, row - 20.0
        return ((along[0] * x + along[1] * y).abs() <= 16.0) & ((along[0] * y - along[1] * x).abs() <= 4.0)

    record = wall_record(camera)
    light_where(record, camera, strip)
    _, mean, outline, largest, _ = fit_ellipsoids(record, camera, 0.1, GuidedConfig())
    width = float(mean[2]) * camera.pixel_slope
    _, short, long = half_axes(outline)[:, 0] / width
    assert float(long) == pytest.approx(GuidedConfig.highlight_axes * 16.0 / 3.0**0.5, rel=0.03)
    assert float(short) == pytest.approx(GuidedConfig.highlight_axes * 4.0 / 3.0**0.5, rel=0.03)
    assert float(largest / width) == pytest.approx(float(long), rel=1e-3)
    xx, xy, _, yy, _, _ = outline[:, 0]
    spread = along[0] ** 2 * xx - 2.0 * along[0] * along[1] * xy + along[1] ** 2 * yy
    assert float(spread) ** 0.5 / width == pytest.approx(float(long), rel=0.01)


def dim_tails(column: Tensor, row: Tensor) -> Tensor:
    """Two cells high, to both sides of a disc of 4 cells."""
    return ((column - 200.0).abs() < 20.0) & ((row - 20.0).abs() < 1.0) & ~disc(200.0, 20.0, 4.0)(column, row)


def test_dim_cells_at_the_edge_hardly_count(camera):
    """Two tails of 0.02 % of the radiance: they enlarge the patch's box several times, and the ellipsoid hardly."""
    sizes = []
    for tails in (False, True):
        record = wall_record(camera)
        light_where(record, camera, disc(200.0, 20.0, 4.0))
        if tails:
            light_where(record, camera, dim_tails, radiance=20.0)
        found, _, _, largest, _ = fit_ellipsoids(record, camera, 0.1, GuidedConfig())
        sizes.append((len(found), float(largest), float(fitted(record, camera).radius)))
    (few, small, box), (many, same, wide) = sizes
    assert many == few + 64
    assert wide > 3.0 * box and same == pytest.approx(small, rel=0.02)


def test_two_patches_give_two_ellipsoids(camera):
    """Each as it is alone: neither has light of the other, whichever is brighter."""
    parts, together = [(100.5, 8.0, 4.0, 1e5), (300.5, 30.0, 6.0, 3e3)], wall_record(camera)
    alone = []
    for x, y, radius, radiance in parts:
        record = wall_record(camera)
        for each in (record, together):
            light_where(each, camera, disc(x, y, radius), radiance=radiance)
        alone.append(fit_ellipsoids(record, camera, 0.1, GuidedConfig()))
    both = fit_ellipsoids(together, camera, 0.1, GuidedConfig())
    assert both[1].shape == (3, 2) and len(both[0]) == len(alone[0][0]) + len(alone[1][0])
    order = both[1][0].argsort()
    for number in range(1, 5):
        expected = torch.cat([each[number] for each in alone], dim=-1)
        torch.testing.assert_close(both[number][..., order], expected, rtol=1e-4, atol=1e-6)


def test_no_highlights_give_no_ellipsoids(camera):
    for record in (RecordBuffer(camera), wall_record(camera)):
        found = fit_ellipsoids(record, camera, 0.1, GuidedConfig())
        assert [tuple(part.shape) for part in found] == [(0,), (3, 0), (6, 0), (0,), (0,)]
        assert not found[0].is_floating_point() and all(part.dtype == torch.float32 for part in found[1:])


def test_the_ellipsoid_of_one_cell_is_as_wide_as_the_cell(camera):
    """A square's standard deviation is its side over √12."""
    record = wall_record(camera)
    light_up(record, camera, torch.tensor([200.0]), 20.0, 4.0)
    _, mean, outline, largest, energy = fit_ellipsoids(record, camera, 0.1, GuidedConfig())
    width = float(mean[2]) * camera.pixel_slope
    assert float(largest / width) == pytest.approx(GuidedConfig.highlight_axes / 12.0**0.5, rel=1e-4)
    _, *wide = half_axes(outline)[:, 0] / width
    assert [float(axis) for axis in wide] == pytest.approx([GuidedConfig.highlight_axes / 12.0**0.5] * 2, rel=1e-4)
    assert float(energy) > 0.0 and outline.isfinite().all()


def random_patches(camera: ThinLensCamera, light: float = 1.0) -> RecordBuffer:
    """Many small patches, many samples a cell, of all depths and brightnesses."""
    generator = torch.Generator().manual_seed(0)
    record = RecordBuffer(camera)
    row, column = torch.meshgrid(torch.arange(record.height) + 0.5, torch.arange(record.width) + 0.5, indexing="ij")
    points = points_at(
        camera, column.ravel() - record.border, row.ravel() - record.border, WALL * camera.lens.focus_distance / 2.0
    )
    record.add([(record.cells(camera, points), points, torch.full((points.shape[1],), 0.1 * light))])
    cells = torch.rand(2, 20_000, generator=generator)
    bright = torch.exp(3.0 * torch.randn(20_000, generator=generator))
    depth = camera.lens.focus_distance * torch.exp(0.3 + 1.5 * torch.rand(20_000, generator=generator))
    points = points_at(camera, WIDTH * cells[0], HEIGHT * cells[1], depth)
    record.add([(record.cells(camera, points), points, bright * light)])
    return record


def test_outlines_are_positive_semidefinite(camera):
    """The largest half axis is that of the ellipsoid seen along the optical axis."""
    _, mean, outline, largest, energy = fit_ellipsoids(random_patches(camera), camera, 1.0, GuidedConfig())
    assert len(largest) > 50
    axes = half_axes(outline)  # asserts that the squares are not negative
    assert (axes[2] > 0.0).all() and (largest > 0.0).all() and (energy > 0.0).all() and (mean[2] > 0.0).all()
    xx, xy, _, yy, _, _ = outline.double()
    upright = torch.linalg.eigvalsh(torch.stack((xx, xy, xy, yy), dim=1).reshape(-1, 2, 2)).sqrt()
    torch.testing.assert_close(largest.double(), upright[:, 1], rtol=1e-3, atol=0.0)
    assert (upright[:, 0] >= GuidedConfig.highlight_axes / 12.0**0.5 * 0.999 * mean[2] * camera.pixel_slope / 3.0).all()


@pytest.mark.parametrize("light, length", [(0.01, 1.0), (100.0, 1.0), (1.0, 0.01), (1.0, 100.0), (1e-6, 1e-3), (1e12, 1e3)])
def test_ellipsoids_do_not_depend_on_the_units(camera, light, length):
    view = replace(CAMERA, aperture_radius=CAMERA.aperture_radius * length, focus_distance=CAMERA.focus_distance * length)
    other = ThinLensCamera(view, WIDTH, HEIGHT)
    cells, mean, outline, largest, energy = fit_ellipsoids(random_patches(camera), camera, 1.0, GuidedConfig())
    scaled = fit_ellipsoids(random_patches(other, light), other, light, GuidedConfig())
    assert len(set(cells.tolist()) ^ set(scaled[0].tolist())) <= 1 and scaled[1].shape == mean.shape
    torch.testing.assert_close(scaled[1] / length, mean, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(scaled[2] / scaled[3].square(), outline / largest.square(), rtol=1e-2, atol=1e-2)
    torch.testing.assert_close(scaled[3] / length, largest, rtol=1e-2, atol=0.0)
    torch.testing.assert_close(scaled[4] / (light * length**2), energy, rtol=1e-2, atol=0.0)


@pytest.mark.parametrize("radiance", [1e-30, 1e30, 1e36])
def test_ellipsoids_of_any_radiance_are_finite(camera, radiance):
    """A patch at 1000 focus distances, where the record has the environment."""
    record = RecordBuffer(camera)
    light_where(record, camera, disc(200.0, 20.0, 4.0), 1000.0 * CAMERA.focus_distance, radiance)
    _, mean, outline, largest, _ = fit_ellipsoids(record, camera, radiance / 100.0, GuidedConfig())
    width = float(mean[2]) * camera.pixel_slope
    assert float(mean[2]) == pytest.approx(1000.0 * CAMERA.focus_distance, rel=1e-3)
    assert outline.isfinite().all() and float(largest / width) == pytest.approx(0.5 * GuidedConfig.highlight_axes * 4.0, rel=0.1)


def test_the_ellipsoids_that_a_render_finds_are_its_emitters(ellipsoids_of_emitters):
    """Emitters under a dim sky: at their distance, and as wide as `highlight_axes` says within a cell."""
    _, mean, _, largest, _ = ellipsoids_of_emitters
    assert len(largest) == len(scenes.LAMP_RADII)
    for (x, y, z), radius in zip(scenes.LAMP_CENTRES, scenes.LAMP_RADII):
        nearest = int((mean - torch.tensor([[x], [y], [-z]])).square().sum(0).argmin())
        assert float(mean[2, nearest]) == pytest.approx(-z, rel=0.03)
        assert 0.9 * radius < float(largest[nearest]) < 1.7 * radius


@pytest.fixture(scope="module")
def ellipsoids_of_emitters() -> tuple[Tensor, ...]:
    loop = rendered(scenes.emitters(256, 144), 8)
    mean_luminance = float(luminance(loop.film.radiance().reshape(-1, 3).T).mean())
    return fit_ellipsoids(loop.mode.lens.record_buffer, loop.camera, mean_luminance, GuidedConfig())


@pytest.mark.parametrize(("width", "height", "border"), [(160, 90, 16), (90, 160, 9), (1000, 100, 100), (65536, 1, 1)])
def test_the_border_of_a_very_wide_frame_is_narrow(width, height, border):
    """Else the record of a frame of 65,536 x 1 pixels would have a thousand million cells."""
    record = RecordBuffer(ThinLensCamera(Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), aperture_radius=0.1), width, height))
    assert (record.border, record.width, record.height) == (border, width + 2 * border, height + 2 * border)


@pytest.mark.parametrize("seed", range(20))
def test_patches_are_the_components_that_scipy_finds(camera, seed):
    """Of random cells, sparse and dense, all at one depth. Cells that touch at a corner touch."""
    record = RecordBuffer(camera)
    bright = np.random.default_rng(seed).random((record.height, record.width)) < (0.002, 0.1, 0.3, 0.5)[seed % 4]
    cells = torch.from_numpy(np.flatnonzero(bright))
    depth = torch.ones(len(cells))
    patch = label_patches(record, cells, depth, depth, HighlightConfig.depth_gap)
    expected = torch.from_numpy(ndimage.label(bright, np.ones((3, 3), int))[0][bright])
    pairs = torch.stack((patch, expected.long()), dim=1).unique(dim=0)
    assert len(pairs) == len(patch.unique()) == len(expected.unique())
