"""The thin-lens camera against its geometry."""

import math
from dataclasses import replace

import pytest
import torch

from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.lens import Lens
from bokehguide.render.random import PixelRandom
from bokehguide.scene.types import Aperture, Camera
from tests.support.light_checks import (
    lens_uniformity,
)
from tests.support.statistical import SIGNIFICANCE

TILTED = Camera((1.0, 2.0, 3.0), (0.5, 1.0, -4.0), up=(0.2, 1.0, 0.1), fov=55.0, aperture_radius=0.3, focus_distance=4.0)
ALONG_Z = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=60.0, aperture_radius=0.1, focus_distance=2.0)


def random_raster(camera: ThinLensCamera, count: int) -> torch.Tensor:
    uniforms = PixelRandom(1, 0, torch.arange(count)).uniform(0, 2)
    return uniforms * torch.tensor([[camera.width], [camera.height]])


def to_camera(camera: ThinLensCamera, points: torch.Tensor) -> torch.Tensor:
    """World points `[3, N]` in the camera frame."""
    return camera.axes.T @ (points - camera.position)


def test_every_lens_point_sees_a_raster_position_through_the_same_focus_point():
    camera = ThinLensCamera(TILTED, 64, 48)
    focus = camera.focus_points(random_raster(camera, 1000))
    target = camera.axes @ focus + camera.position
    for seed in range(4):
        points = camera.lens.sample(PixelRandom(seed, 0, torch.arange(1000)).uniform(0, 2))
        origin, direction = camera.rays(focus, points)
        to_target = target - origin
        assert torch.allclose(direction.norm(dim=0), torch.ones(1000), atol=1e-6)
        assert torch.linalg.cross(to_target, direction, dim=0).norm(dim=0).max() < 1e-5
        assert ((to_target * direction).sum(0) > 0).all()


def test_ray_origins_lie_on_the_lens():
    camera = ThinLensCamera(TILTED, 64, 48)
    points = camera.lens.sample(PixelRandom(3, 0, torch.arange(500)).uniform(0, 2))
    origin, _ = camera.rays(camera.focus_points(random_raster(camera, 500)), points)
    local = to_camera(camera, origin)
    assert torch.allclose(local[:2], points, atol=1e-5)
    assert local[2].abs().max() < 1e-5


def test_focus_points_lie_on_the_focal_plane():
    camera = ThinLensCamera(TILTED, 64, 48)
    assert torch.equal(camera.focus_points(random_raster(camera, 10))[2], torch.full((10,), 4.0))


def test_projection_inverts_the_pinhole_rays():
    camera = ThinLensCamera(TILTED, 64, 48)
    raster = random_raster(camera, 1000)
    focus = camera.focus_points(raster)
    origin, direction = camera.rays(focus, torch.zeros(2, 1000))
    reach = 0.1 + 50.0 * PixelRandom(5, 0, torch.arange(1000)).uniform(0, 1)[0]
    assert torch.allclose(camera.raster(to_camera(camera, origin + reach * direction)), raster, atol=1e-3)


def test_axes_are_orthonormal_and_turn_the_left_handed_frame_into_the_world():
    axes = ThinLensCamera(TILTED, 64, 48).axes
    assert torch.allclose(axes.T @ axes, torch.eye(3), atol=1e-6)
    assert torch.det(axes).item() == pytest.approx(-1.0, abs=1e-6)


def test_image_right_is_world_right_and_rows_go_down():
    camera = ThinLensCamera(ALONG_Z, 100, 50)
    raster = torch.tensor([[50.0, 90.0, 50.0], [25.0, 25.0, 45.0]])
    _, direction = camera.rays(camera.focus_points(raster), torch.zeros(2, 3))
    centre, right, low = direction.T
    assert torch.allclose(centre, torch.tensor([0.0, 0.0, -1.0]), atol=1e-6)
    assert right[0] > 0.1 and abs(right[1]) < 1e-6
    assert low[1] < -0.1 and abs(low[0]) < 1e-6


def test_lens_x_is_world_right_and_lens_y_is_up():
    camera = ThinLensCamera(ALONG_Z, 100, 50)
    focus = camera.focus_points(torch.tensor([[50.0, 50.0], [25.0, 25.0]]))
    origin, _ = camera.rays(focus, torch.tensor([[0.1, 0.0], [0.0, 0.1]]))
    assert torch.allclose(origin.T, torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), atol=1e-7)


@pytest.mark.parametrize("fov", [10.0, 60.0, 120.0])
def test_field_of_view_is_horizontal(fov):
    camera = ThinLensCamera(Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=fov, focus_distance=1.0), 100, 30)
    edges = torch.tensor([[0.0, 100.0], [15.0, 15.0]])
    _, direction = camera.rays(camera.focus_points(edges), torch.zeros(2, 2))
    angle = math.degrees(math.acos(float((direction[:, 0] * direction[:, 1]).sum())))
    assert angle == pytest.approx(fov, abs=1e-3)


@pytest.mark.parametrize("depth", [0.7, 1.5, 2.0, 3.0, 40.0])
def test_circle_of_confusion_is_what_the_rim_of_the_lens_draws(depth):
    """Rays from the lens rim through a point meet the focal plane at the film points that see it."""
    camera = ThinLensCamera(ALONG_Z, 400, 300)
    point = torch.tensor([0.1, -0.2, 1.0])[:, None] * depth
    angle = torch.linspace(0.0, 2.0 * math.pi, 65)[:-1]
    rim = torch.stack((angle.cos(), angle.sin(), torch.zeros(64))) * 0.1
    film = camera.raster(rim + (point - rim) * (2.0 / depth))
    centre = camera.raster(point)
    radii = (film - centre).norm(dim=0)
    expected = camera.coc_diameter(torch.tensor([depth])) / 2.0
    assert torch.allclose(radii, expected.expand(64), rtol=1e-3, atol=1e-3)


def test_lens_area():
    assert Lens(0.5, 1.0).area == pytest.approx(math.pi / 4.0)


def test_lens_points_are_even_over_the_disc():
    assert lens_uniformity() > SIGNIFICANCE


def test_every_lens_point_drawn_lies_in_the_aperture():
    lens = Lens(0.7, 1.0)
    points = lens.sample(PixelRandom(9, 0, torch.arange(100_000)).uniform(0, 2))
    assert lens.contains(points * (1.0 - 1e-6)).all()
    assert not lens.contains(points / points.norm(dim=0) * 0.7001).any()


def test_the_lens_barrel_is_shifted_by_the_cats_eye_in_the_corners_of_the_frame():
    camera = ThinLensCamera(replace(ALONG_Z, aperture=Aperture(cat_eye=1.0)), 400, 300)
    corners = torch.tensor([[0.0, 400.0, 0.0, 400.0], [0.0, 0.0, 300.0, 300.0]])
    focus = camera.focus_points(corners)
    towards = focus[:2] / focus[:2].norm(dim=0)
    for shift, passes in ((-0.02, 1.0), (0.02, 0.0)):
        assert torch.equal(camera.lens.unblocked(shift * camera.lens.radius * towards, focus), torch.full((4,), passes))
