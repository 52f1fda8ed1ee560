"""Virtual images: against pencils of rays reflected by quadrics in double precision, and along whole paths."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
import trimesh

from bokehguide.guiding.virtual_images import ImageDistances, ImageRecorder, mirror_power
from bokehguide.render.path_tracer import PathSamples, PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.tracer import MISS_DISTANCE
from bokehguide.render.vector import luminance
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.shapes import transform, transformed, unit_box
from bokehguide.scene.types import Material, Mesh, Scene
from tests.support.tracing import emitter, matte, rectangle, scene, sky, sphere

FINE = 1e-4
"""Displacements within a pencil, metres."""
SIZE = 0.005
"""Size of the triangles that stand for a surface, metres."""


@dataclass(frozen=True)
class Quadric:
    """The points p, near the origin, of p·Ap + b·p = 0, in double precision. The normal at the origin is b's direction."""

    a: np.ndarray
    b: np.ndarray

    def normal(self, point: np.ndarray) -> np.ndarray:
        return unit(2.0 * self.a @ point + self.b)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The point nearest the origin where a line meets the quadric."""
        square, linear = direction @ self.a @ direction, 2.0 * origin @ self.a @ direction + self.b @ direction
        rest = origin @ self.a @ origin + self.b @ origin
        roots = [-rest / linear] if abs(square) < 1e-12 else np.roots([square, linear, rest]).real
        return min((origin + root * direction for root in roots), key=np.linalg.norm)

    def triangle(self, turn: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners and normals `[3, 3]` of a triangle around the origin, turned by an angle about the normal."""
        upright = unit(self.b)
        first, second = across(upright)
        angles = turn + 2.0 * np.pi * np.arange(3) / 3.0
        flat = [SIZE * (math.cos(angle) * first + math.sin(angle) * second) for angle in angles]
        corners = [self.hit(point, upright) for point in flat]
        return np.array(corners), np.array([self.normal(corner) for corner in corners])


def unit(vector) -> np.ndarray:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector)


def across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors perpendicular to a direction and to each other."""
    first = unit(np.cross(direction, (0.3, 0.9, -0.1)))
    return first, np.cross(direction, first)


def mirrored(direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return direction - 2.0 * (direction @ normal) * normal


def bulging(radius: float) -> Quadric:
    """A ball whose outside faces +z; hollow where the radius is negative."""
    return Quadric(np.eye(3) / (2.0 * radius), np.array([0.0, 0.0, 1.0]))


def rod(radius: float, degrees: float) -> Quadric:
    """A cylinder whose outside faces +z and whose axis is turned by an angle from x."""
    side = np.array([-math.sin(math.radians(degrees)), math.cos(math.radians(degrees)), 0.0])
    return Quadric((np.outer(side, side) + np.diag([0.0, 0.0, 1.0])) / (2.0 * radius), np.array([0.0, 0.0, 1.0]))


PLANE = Quadric(np.zeros((3, 3)), np.array([0.0, 0.0, 1.0]))
EGG = Quadric(np.array([[0.9, 0.2, 0.1], [0.2, 0.4, -0.1], [0.1, -0.1, 0.6]]), np.array([0.0, 0.0, 1.0]))
SADDLE = Quadric(np.array([[0.5, 0.4, 0.0], [0.4, -0.3, 0.0], [0.0, 0.0, 0.0]]), np.array([0.0, 0.0, 1.0]))
SURFACES = {
    "plane": PLANE,
    "ball": bulging(0.7),
    "bowl": bulging(-3.0),
    "rod": rod(0.7, 0.0),
    "rod askew": rod(0.7, 35.0),
    "rod upright": rod(0.7, 90.0),
    "gutter askew": rod(-3.0, 35.0),
    "egg": EGG,
    "saddle": SADDLE,
}


def incoming(degrees: float) -> np.ndarray:
    """The direction of a ray that meets the xy plane from above, at an angle to its normal."""
    return np.array([math.sin(math.radians(degrees)), 0.0, -math.cos(math.radians(degrees))])


def meetings(surface: Quadric, direction: np.ndarray, emitter_distance: float) -> np.ndarray:
    """Inverse distances behind the origin at which rays of an emitter's pencil meet the central ray: the least and the largest.

    The central ray returns along `direction`. Other rays are displaced to all sides, and meet it in the plane in which they
    begin. The two extremes lie in the principal planes.
    """
    from_emitter = -mirrored(direction, surface.normal(np.zeros(3)))
    place = -emitter_distance * from_emitter
    found = []
    for angle in np.arange(0.0, np.pi, np.pi / 180.0):
        first, second = across(from_emitter)
        aside = math.cos(angle) * first + math.sin(angle) * second
        way = unit(from_emitter + FINE / emitter_distance * aside), unit(from_emitter - FINE / emitter_distance * aside)
        found.append(np.mean([meeting(surface, place, each, direction) for each in way]))
    return np.array([min(found), max(found)])


def meeting(surface: Quadric, place: np.ndarray, way: np.ndarray, direction: np.ndarray) -> float:
    """Inverse distance along `direction` at which a ray's mirror image crosses the line through the origin."""
    point = surface.hit(place, way)
    back = mirrored(way, surface.normal(point))
    slope = back / (back @ direction) - direction
    offset = point - (point @ direction) * (slope + direction)
    return -(slope @ offset) / (offset @ offset)


def power(surface: Quadric, direction: np.ndarray, turn: float = 0.4, backwards: bool = False, flipped: bool = False) -> float:
    """`mirror_power` of a small triangle about the origin. backwards: reverse the corners; flipped: negate the normals."""
    corners, normals = surface.triangle(turn)
    order = [2, 1, 0] if backwards else [0, 1, 2]
    return float(of_triangle(corners[order], normals[order] * (-1.0 if flipped else 1.0), direction))


def of_triangle(corners, normals, direction) -> torch.Tensor:
    """`mirror_power` of one triangle, `[1]`."""
    values = (torch.tensor(np.asarray(values), dtype=torch.float32)[..., None] for values in (corners, normals, direction))
    return mirror_power(*values)


def test_the_pencils_agree_with_textbooks():
    """Straight on: an emitter 2 m before a ball of 1 m is seen 0.4 m behind it, the sun half a radius before a bowl."""
    down = np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(meetings(PLANE, down, 2.0), 0.5, rtol=1e-5)
    np.testing.assert_allclose(meetings(bulging(1.0), down, 2.0), 2.5, rtol=1e-5)
    np.testing.assert_allclose(meetings(bulging(-1.0), down, 1e4), -2.0, rtol=1e-3)
    np.testing.assert_allclose(meetings(rod(1.0, 20.0), down, 2.0), [0.5, 2.5], rtol=1e-3)  # one pencil for each degree


@pytest.mark.slow
@pytest.mark.parametrize("distance", [0.5, 4.0, 1e4])
@pytest.mark.parametrize("degrees", [0.0, 20.0, 50.0, 75.0])
@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_the_image_is_where_pencils_of_rays_meet(surface, degrees, distance):
    """The mean over the principal planes of inverse distances, for any distance of the emitter."""
    direction = incoming(degrees)
    expected = meetings(surface, direction, distance).mean() - 1.0 / distance
    assert power(surface, direction) == pytest.approx(expected, rel=2e-3, abs=2e-4)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("name", ["ball", "bowl", "rod askew", "egg"])
def test_neither_the_winding_nor_the_side_of_the_normals_matters(name, flipped, backwards):
    direction = incoming(40.0)
    expected = meetings(SURFACES[name], direction, 3.0).mean() - 1.0 / 3.0
    assert abs(expected) > 0.5
    assert power(SURFACES[name], direction, 0.0, backwards, flipped) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("turn", np.linspace(0.0, 6.0, 7))
def test_the_triangles_own_orientation_does_not_matter(turn):
    for direction in (incoming(0.0), incoming(60.0)):
        expected = meetings(EGG, direction, 3.0).mean() - 1.0 / 3.0
        assert power(EGG, direction, turn) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.5, 0.0, 0.0), (7.0, -2.0, 0.0)])
def test_the_place_of_a_triangle_seen_straight_on_does_not_matter(place):
    """A rod of the radius 2 m, also with two corners whose sum is zero or parallel to the normal."""
    corners = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0]])
    normals = np.array([[-0.25, 0.0, 1.0], [0.25, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert float(of_triangle(corners + place, normals, incoming(0.0))) == pytest.approx(0.5)


def test_the_back_of_a_bulging_surface_is_hollow():
    """The same triangle from both sides: a ball is a bowl from inside."""
    for degrees in (0.0, 50.0):
        corners, normals = bulging(0.7).triangle(0.4)
        outside, inside = (of_triangle(corners, normals, side * incoming(degrees)) for side in (1.0, -1.0))
        assert float(outside) > 1.0 and float(inside) == pytest.approx(-float(outside), rel=1e-3)


def test_flat_faces_have_no_power():
    """A ball's faces with the normal of the face at each corner."""
    corners, _ = bulging(0.7).triangle(0.4)
    face = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    for degrees in (0.0, 40.0, 89.0):
        assert float(of_triangle(corners, [face] * 3, incoming(degrees))) == 0.0


@pytest.mark.parametrize("segments", [16, 64, 256])
def test_long_thin_triangles_have_the_curvature_of_their_rod(segments):
    """A rod 2 m long and 4 cm thick: straight on, half the curvature of a ball, from each corner."""
    radius, step = 0.02, 2.0 * np.pi / segments
    angles = np.array([0.0, step, step]) - 2.0 / 3.0 * step
    normals = np.stack((np.sin(angles), np.zeros(3), np.cos(angles)), axis=1)
    corners = radius * normals + np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    for first in range(3):
        found = of_triangle(np.roll(corners, first, 0), np.roll(normals, first, 0), (0.0, 0.0, -1.0))
        assert float(found) == pytest.approx(1.0 / radius, rel=0.05)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e3, 1e6])
def test_the_unit_of_length_does_not_matter(size):
    corners, normals = EGG.triangle(0.4)
    direction = incoming(50.0)
    assert float(of_triangle(size * corners, normals, direction)) * size == pytest.approx(power(EGG, direction), rel=1e-3)


def degenerate() -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals `[M, 3, 3]` of triangles that are points, lines or needles, or without valid normals."""
    corners, normals = bulging(0.7).triangle(0.4)
    a, b, _ = corners
    shapes = [[a, a, a], [a, a, b], [a, b, a], [b, a, a], [a, b, a + 0.5 * (b - a)], [a, b, a + (1.0 + 1e-6) * (b - a)]]
    shapes += [1e-12 * corners, 1e-20 * corners, 1e12 * corners, np.zeros((3, 3))]
    others = [normals, np.zeros((3, 3)), [normals[0], -normals[0], normals[1]], [normals[0]] * 3]
    pairs = [(shape, other) for shape in [*shapes, corners] for other in others]
    return tuple(np.array(values) for values in zip(*pairs))


def test_degenerate_triangles_and_grazing_rays_give_no_nan():
    corners, normals = degenerate()
    angles = [0.0, 1e-6, 45.0, 89.0, 89.999, 90.0, 90.001, 135.0, 180.0]
    directions = [*(incoming(degrees) for degrees in angles), np.zeros(3)]
    for direction in directions:
        ways = np.broadcast_to(direction, (len(corners), 3)).T
        values = (np.moveaxis(corners, 0, 2), np.moveaxis(normals, 0, 2), ways)
        found = mirror_power(*(torch.tensor(value, dtype=torch.float32) for value in map(np.array, values)))
        assert found.shape == (len(corners),) and not found.isnan().any()


# Whole paths.

COUNT = 2000
POLISHED = Material("polished", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
BRIGHT = emitter(100.0)
EYE = np.zeros(3)


class Seen(PathSamples):
    """Samples of rays, and the distances of the images that the rays see, `[N]`."""

    image: torch.Tensor


def traced(scene: Scene, directions, count: int = COUNT, alive: torch.Tensor | None = None, bright: float = 0.0) -> Seen:
    """Paths from the eye; directions: one, or `[3, N]`; alive: positive for the rays to trace, None for all."""
    directions = np.asarray(directions, np.float64)
    directions = np.repeat(directions[:, None], count, axis=1) if directions.ndim == 1 else directions
    directions = torch.tensor(directions / np.linalg.norm(directions, axis=0), dtype=torch.float32)
    random = PixelRandom(0, 1, torch.arange(directions.shape[1]))
    with torch.no_grad():
        tracer = PathTracer(scene)
        images = ImageRecorder(tracer.geometry, directions.shape[1])
        rays = torch.zeros_like(directions), directions, random
        samples = tracer.trace(*rays, PhaseTimer(), alive=alive, observers=(images,))
        seen = Seen(**vars(samples))
        seen.image = ImageDistances(images, samples.radiance, samples.distance, bright).distances()
        return seen


def lit(samples: Seen) -> np.ndarray:
    """Image distances `[M]` of the rays with light."""
    assert not samples.image.isnan().any() and (samples.image > 0.0).all()
    return samples.image[samples.radiance.amax(0) > 0.0].double().numpy()


def beyond(samples: Seen) -> np.ndarray:
    """Distances of images that are not at the primary hit: all but the few of rays that a mirror scatters far."""
    found = lit(samples)
    own = samples.distance[samples.radiance.amax(0) > 0.0].double().numpy()
    assert len(found) > 0.9 * len(samples.image) and np.mean(found == own) < 0.02
    return found[found != own]


MIRROR = rectangle(0, (0.0, 0.0, -4.0), (10.0, -15.0, 0.0), 2.0)
EMITTER_PLACE = np.array([1.2, 0.9, -0.5])


def image_in_mirror(place: np.ndarray) -> np.ndarray:
    """The mirror image of a point in MIRROR."""
    corners = MIRROR.vertices[MIRROR.triangles[0]].astype(np.float64)
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    return place - 2.0 * ((place - corners[0]) @ normal) * normal


def flat_mirror(material: Material = POLISHED, radius: float = 0.1, mirror: Mesh = MIRROR) -> Scene:
    return scene([mirror, sphere(1, EMITTER_PLACE, radius)], [material, BRIGHT])


@pytest.mark.parametrize("flipped", [False, True])
def test_a_flat_mirror_shows_an_emitter_as_far_behind_it(flipped):
    """At the length of the unfolded ray, to the emitter's surface; from the mirror's front and from its back."""
    mirror = replace(MIRROR, triangles=np.ascontiguousarray(MIRROR.triangles[:, ::-1])) if flipped else MIRROR
    place = image_in_mirror(EMITTER_PLACE)
    samples = traced(flat_mirror(mirror=mirror), place)
    np.testing.assert_allclose(beyond(samples), np.linalg.norm(place) - 0.1, rtol=0.006)


@pytest.mark.parametrize("roughness, radius", [(0.05, 0.1), (0.1, 0.1), (0.1, 0.03), (0.2, 0.1)])
def test_polished_mirrors_show_emitters_smaller_than_their_lobe_at_the_image(roughness, radius):
    """For most of the light, from samples of the BSDF and of the emitter."""
    place = image_in_mirror(EMITTER_PLACE)
    samples = traced(flat_mirror(replace(POLISHED, roughness=roughness), radius), place, count=20_000)
    light = samples.radiance[0].double().numpy()
    behind = np.abs(samples.image.double().numpy() / np.linalg.norm(place) - 1.0) < 0.05
    assert light[behind].sum() > 0.8 * light.sum() > 0.0


def test_a_flat_mirror_shows_the_environment_at_infinity():
    samples = traced(scene([MIRROR], [POLISHED], sky(1.0)), (0.0, 0.0, -1.0))
    assert (samples.distance < 5.0).all() and samples.image.isfinite().all()
    assert (beyond(samples) >= np.float32(MISS_DISTANCE)).all()


def test_rounded_normals_of_a_flat_mirror_leave_the_environment_at_infinity():
    """A finely cut mirror whose normals differ in their last digits is concave in places, and flat for practical purposes."""
    points, triangles = MIRROR.vertices.astype(np.float64), MIRROR.triangles
    for _ in range(6):
        points, triangles = trimesh.remesh.subdivide(points, triangles)
    normals = np.tile(unit(np.cross(points[1] - points[0], points[2] - points[0])), (len(points), 1))
    mesh = Mesh(points.astype(np.float32), triangles.astype(np.int32), 0, normals.astype(np.float32))
    noise = np.random.default_rng(0).integers(-1, 2, mesh.normals.shape)
    mesh = replace(mesh, normals=mesh.normals + (noise * 2.0**-24).astype(np.float32))
    directions = np.random.default_rng(1).uniform(-0.2, 0.2, (3, COUNT)) + np.array([[0.0], [0.0], [-1.0]])
    samples = traced(scene([mesh], [POLISHED], sky(1.0)), directions)
    assert (samples.distance < 10.0).all()
    assert float((samples.image > 1e3).float().mean()) > 0.99


BALL_CENTRE, BALL_RADIUS = np.array([0.0, 0.0, -4.0]), 0.5


def fine_ball(centre: np.ndarray, radius: float) -> Mesh:
    """A ball of 20,480 triangles, with exact normals."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    points = np.asarray(ball.vertices)
    return Mesh((centre + radius * points).astype(np.float32), ball.faces.astype(np.int32), 0, points.astype(np.float32))


def paraxial(degrees: float, radius: float, distance: float) -> float:
    """Distance of the image behind a ball's surface: the mean over the principal planes of inverse distances."""
    cosine = math.cos(math.radians(degrees))
    return 1.0 / (1.0 / distance + (cosine + 1.0 / cosine) / radius)


@pytest.mark.parametrize("at", [0.0, 25.0, 50.0, 65.0])
def test_a_metal_ball_shows_an_emitter_close_behind_its_surface(at):
    """at: degrees around the ball, from the point nearest to the eye."""
    normal = np.array([math.sin(math.radians(at)), 0.0, math.cos(math.radians(at))])
    point = BALL_CENTRE + BALL_RADIUS * normal
    direction, reached = unit(point), np.linalg.norm(point)
    degrees = math.degrees(math.acos(-direction @ normal))
    away, size = 3.0, 0.2
    aside = np.array([0.0, 0.15, 0.0]) if at == 0.0 else 0.0  # or the emitter would surround the eye
    place = point + away * unit(mirrored(direction, normal) + aside)
    if at == 0.0:
        direction = unit(point + np.array([0.0, 0.5 * 0.15 * BALL_RADIUS, 0.0]))
    ball = fine_ball(BALL_CENTRE, BALL_RADIUS)
    samples = traced(scene([ball, sphere(1, place, size)], [POLISHED, BRIGHT]), direction)
    depth = paraxial(degrees, BALL_RADIUS, away - size)
    np.testing.assert_allclose(beyond(samples) - reached, depth, atol=0.02 * BALL_RADIUS)
    assert depth > 0.15 * BALL_RADIUS


def test_a_metal_ball_shows_the_sky_half_a_radius_behind_it():
    samples = traced(scene([sphere(0, BALL_CENTRE, BALL_RADIUS)], [POLISHED], sky(1.0)), BALL_CENTRE)
    np.testing.assert_allclose(beyond(samples), 3.75, atol=0.01)


def test_a_concave_mirror_shows_an_emitter_before_it():
    """An emitter 2 m before a bowl of 1 m radius, seen upside down in the air, 2/3 m before the bowl."""
    hollow = sphere(0, (0.0, 0.0, -3.0), 1.0)
    near = hollow.vertices[hollow.triangles].mean(1)[:, 2] < -3.5
    hollow = replace(hollow, triangles=np.ascontiguousarray(hollow.triangles[near]))
    place = np.array([0.0, 0.2, -2.0])
    lens = scene([hollow, sphere(1, place, 0.1)], [POLISHED, BRIGHT])
    directions = np.stack((np.zeros(400), np.linspace(-0.2, 0.2, 400), -np.ones(400)))
    samples = traced(lens, directions)
    seen = (samples.radiance.amax(0) > 1.0) & (samples.emission.amax(0) == 0.0)
    assert int(seen.sum()) > 10
    found = samples.image[seen & (samples.image != samples.distance)].numpy()
    assert len(found) > 0.8 * int(seen.sum())
    np.testing.assert_allclose(found, 4.0 + paraxial(0.0, -1.0, 2.0 - 0.1), atol=0.05)


def test_a_ball_of_flat_faces_is_a_set_of_flat_mirrors():
    ball = replace(sphere(0, BALL_CENTRE, BALL_RADIUS), normals=None)
    samples = traced(scene([ball], [POLISHED], sky(1.0)), BALL_CENTRE)
    assert (beyond(samples) >= np.float32(MISS_DISTANCE)).all()


ROUGH = {
    "rough metal": Material("rough", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.6),
    "matte": matte(0.8),
}


@pytest.mark.parametrize("material", ROUGH.values(), ids=ROUGH)
def test_rough_surfaces_have_no_images(material):
    for more in (flat_mirror(material), flat_mirror(material, 0.6)):
        samples = traced(more, image_in_mirror(EMITTER_PLACE))
        assert len(lit(samples)) > 0.3 * COUNT and torch.equal(samples.image, samples.distance)
    samples = traced(scene([MIRROR], [material], sky(1.0)), (0.0, 0.0, -1.0))
    assert torch.equal(samples.image, samples.distance) and (samples.distance < 5.0).all()


def test_emitters_and_skies_seen_directly_have_no_images():
    """Also an emitter that mirrors another, dimmer one."""
    shining = replace(POLISHED, emission=(1000.0, 1000.0, 1000.0))
    samples = traced(flat_mirror(shining), image_in_mirror(EMITTER_PLACE))
    assert torch.equal(samples.image, samples.distance)
    samples = traced(flat_mirror(), EMITTER_PLACE)
    assert (samples.emission > 0.0).all() and torch.equal(samples.image, samples.distance)
    samples = traced(scene([rectangle(0, (0.0, 0.0, 1.0))], [POLISHED], sky(1.0)), (0.0, 0.0, -1.0))
    assert (samples.image >= MISS_DISTANCE).all()


GLASS = Material("glass", (1.0, 1.0, 1.0), transmission=1.0, roughness=0.0)
PANE = replace(GLASS, thin=True)


def box(centre, size, rotate) -> Mesh:
    return transformed(unit_box(), transform(centre, rotate, size))


def assert_seen(samples: Seen, expected: float, tolerance: float, share: float = 0.9) -> None:
    """Nearly all rays with light see the image at this distance; some are reflected on the way."""
    found = lit(samples)
    assert len(found) > 0.8 * COUNT and np.mean(np.abs(found - expected) <= tolerance) > share, np.median(found)


@pytest.mark.parametrize("angle", [0.0, 40.0])
@pytest.mark.parametrize("thick", [None, 0.5], ids=["sheet", "slab"])
def test_an_emitter_behind_a_pane_is_seen_at_its_place(thick, angle):
    """At the length of the ray through a sheet; in a slab of index 1.5, two thirds of the length count."""
    pane, emitter_place = rectangle(0, (0.0, 0.0, -4.0), (0.0, angle, 0.0), 3.0), np.array([0.0, 0.0, -7.0])
    if thick is None:
        samples = traced(scene([pane, sphere(1, emitter_place, 0.5)], [PANE, BRIGHT], max_depth=3), emitter_place)
        assert_seen(samples, 6.5, 0.005)
        return
    slab = box((0.0, 0.0, -4.0), (6.0, 6.0, thick), (0.0, angle, 0.0))
    samples = traced(scene([slab, sphere(1, emitter_place, 0.5)], [GLASS, BRIGHT], max_depth=6), emitter_place)
    turn = math.radians(angle)
    bent = math.asin(math.sin(turn) / 1.5)
    inside = thick / math.cos(bent)
    aside, onward = inside * math.sin(turn - bent), inside * math.cos(turn - bent)
    assert_seen(samples, 7.0 - math.sqrt(0.25 - aside**2) - onward + inside / 1.5, 0.005)


@pytest.mark.parametrize("radius", [0.1, 0.5])
def test_a_ball_of_glass_shows_the_sky_at_its_focus(radius):
    """At the focal length n r / (2 (n - 1)) before the ball's centre: the image is real and upside down."""
    ball = fine_ball(BALL_CENTRE, radius)
    samples = traced(scene([ball], [GLASS], sky(1.0), max_depth=6), BALL_CENTRE)
    focal = 1.5 * radius / (2.0 * 0.5)
    assert_seen(samples, 4.0 - focal, 0.02 * radius)


def test_a_ball_of_water_magnifies_emitters_before_its_focus():
    """An emitter 0.2 m behind a ball of 0.5 m, refracted by both surfaces."""
    ball = fine_ball(BALL_CENTRE, BALL_RADIUS)
    water = replace(GLASS, ior=1.33)
    place, size = np.array([0.0, 0.0, -4.0 - BALL_RADIUS - 0.25]), 0.05
    samples = traced(scene([ball, sphere(1, place, size)], [water, BRIGHT], max_depth=6), (0.0, 0.0, -1.0))
    first = 1.33 / (1.0 / 0.2 - 0.33 / BALL_RADIUS)  # before the far side, seen from within
    behind = 1.0 / (1.33 / (2.0 * BALL_RADIUS + first) - 0.33 / BALL_RADIUS)
    assert_seen(samples, 3.5 + behind, 0.03)


def test_an_emitter_at_the_centre_of_a_ball_of_glass_is_seen_there():
    ball = fine_ball(BALL_CENTRE, BALL_RADIUS)
    samples = traced(scene([ball, sphere(1, BALL_CENTRE, 0.01)], [GLASS, BRIGHT], max_depth=6), (0.0, 0.0, -1.0))
    assert_seen(samples, 4.0 - 0.01, 0.02)


def refracted(way: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Snell's law, for a unit direction against the normal; ratio: of the refractive indices before and behind the surface."""
    cosine = -way @ normal
    return ratio * way + (ratio * cosine - math.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))) * normal


def test_the_back_of_a_ball_of_glass_reflects_the_sky_close_before_it():
    """Where a paraxial ray crosses the axis after one reflection inside."""
    height = 1e-4
    place, way = np.array([height, math.sqrt(BALL_RADIUS**2 - height**2)]), np.array([0.0, -1.0])
    way = refracted(way, unit(place), 1.0 / 1.5)
    for turn in (lambda way, normal: mirrored(way, normal), lambda way, normal: refracted(way, normal, 1.5)):
        place = place - 2.0 * (place @ way) * way
        way = turn(way, -unit(place))
    expected = 4.0 - (place[1] - place[0] / way[0] * way[1])
    dark_behind = rectangle(1, (0.0, 0.0, -5.0), scale=3.0)
    lens = scene([fine_ball(BALL_CENTRE, BALL_RADIUS), dark_behind], [GLASS, matte(0.0)], sky(1.0), max_depth=8)
    samples = traced(lens, BALL_CENTRE, count=20_000)
    found = samples.image[(samples.radiance.amax(0) > 0.0)].double().numpy()
    assert np.mean(np.abs(found - expected) < 0.02) > 0.2


@pytest.mark.parametrize("roughness", [0.05, 0.1])
def test_a_mirror_in_a_mirror_shows_a_small_emitter_at_the_image(roughness):
    """Most of the light comes from light samples at the second mirror."""
    lower, upper = rectangle(0, (0.0, 0.0, -4.0), (-45.0, 0.0, 0.0), 0.8), rectangle(2, (0.0, 2.0, -4.0), (135.0, 0.0, 0.0), 0.8)
    small = scene(
        [lower, upper, sphere(1, (0.0, 2.0, -9.0), 0.05)], [POLISHED, BRIGHT, replace(POLISHED, roughness=roughness)], max_depth=4
    )
    samples = traced(small, (0.0, 0.0, -1.0), count=20_000)
    light = samples.radiance[0].double().numpy()
    there = np.abs(samples.image.double().numpy() - (4.0 + 2.0 + 4.95)) < 0.5
    assert light[there].sum() > 0.9 * light.sum() > 0.0


def test_two_mirrors_show_an_emitter_at_the_length_of_the_path():
    """A periscope of two flat mirrors at 45 degrees, and the emitter before the upper one."""
    lower, upper = (rectangle(0, (0.0, height, -4.0), (angle, 0.0, 0.0), 0.8) for height, angle in ((0.0, -45.0), (2.0, 135.0)))
    samples = traced(scene([lower, upper, sphere(1, (0.0, 2.0, -9.0), 0.3)], [POLISHED, BRIGHT], max_depth=4), (0.0, 0.0, -1.0))
    assert_seen(samples, 4.0 + 2.0 + 4.7, 0.02, 0.95)


def test_glass_reflects_some_of_the_light():
    """A pane before an emitter beside the eye: the image is as far behind the pane."""
    pane = replace(MIRROR, material=0)
    samples = traced(scene([pane, sphere(1, EMITTER_PLACE, 0.1)], [PANE, BRIGHT]), image_in_mirror(EMITTER_PLACE), count=20_000)
    found = lit(samples)
    assert len(found) > 0.03 * 20_000
    np.testing.assert_allclose(found, np.linalg.norm(image_in_mirror(EMITTER_PLACE)) - 0.1, rtol=0.006)


def test_dim_light_in_a_mirror_is_recorded_at_infinity():
    """Light from a rough surface is recorded at the surface, bright or dim."""
    place = image_in_mirror(EMITTER_PLACE)
    for material, seen in ((POLISHED, np.float32(MISS_DISTANCE)), (matte(0.8), None)):
        dim, bright = (traced(flat_mirror(material), place, bright=limit) for limit in (1000.0, 50.0))
        found = dim.image.numpy()
        assert np.mean(found == (dim.distance.numpy() if seen is None else seen)) > 0.98
        if seen is not None:
            images = bright.image[luminance(bright.radiance) > 50.0].numpy()
            assert np.mean(np.abs(images / (np.linalg.norm(place) - 0.1) - 1.0) < 0.006) > 0.98


def test_images_close_to_the_eye_are_left_out():
    """A bowl has a real image of an emitter before it. An image nearer to the eye than to the bowl counts as on the bowl."""
    for radius, seen in ((4.0, 1.0), (7.3, 0.0)):  # images 2.3 and 5 m before a bowl that is 8 m away
        hollow = sphere(0, (0.0, 0.0, radius - 8.0), radius)
        near = hollow.vertices[hollow.triangles].mean(1)[:, 2] < -7.0
        hollow = replace(hollow, triangles=np.ascontiguousarray(hollow.triangles[near]))
        lens = scene([hollow, sphere(1, (0.0, 0.4, 5.5), 0.05)], [POLISHED, BRIGHT])
        samples = traced(lens, np.stack((np.zeros(8000), np.linspace(-0.2, 0.2, 8000), -np.ones(8000))))
        image_distances = (samples.radiance.amax(0) > 1.0) & (samples.emission.amax(0) == 0.0)
        afloat = (samples.image != samples.distance)[image_distances].float()
        assert int(image_distances.sum()) > 10 and abs(float(afloat.mean()) - seen) < 0.1


def test_a_subset_of_rays_has_the_same_samples():
    """With the same bits; the other rays have the samples of a miss."""
    index = torch.arange(100) * 3 + 1
    alive = torch.zeros(300).index_fill(0, index, 0.3)
    traces = (traced(flat_mirror(), image_in_mirror(EMITTER_PLACE), 300, rays) for rays in (None, alive, 0.0 * alive))
    all_of_them, some, none = (dict(vars(samples)) for samples in traces)
    others = torch.ones(300, dtype=torch.bool).index_fill(0, index, False)
    assert some.pop("rays") < all_of_them.pop("rays") and none.pop("rays") == 0
    for name, value in some.items():
        if value is not None:
            assert torch.equal(value[..., index], all_of_them[name][..., index]), name
            assert torch.equal(value[..., others], none[name][..., others]), name
    assert float(some["radiance"][:, index].sum()) > 0.0 and bool((some["distance"][others] == MISS_DISTANCE).all())


def test_all_rays_over_polished_balls_and_needles_give_finite_images():
    """A grid of rays over a ball from edge to edge, over flat needles and over triangles that are lines."""
    ball = sphere(0, BALL_CENTRE, BALL_RADIUS)
    corners, normals = degenerate()
    flat = corners.reshape(-1, 3) + np.array([0.0, 0.0, -2.0])
    flat[np.abs(flat).max(1) > 100.0] = 0.0
    order = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    needles = Mesh(flat.astype(np.float32), order, 0, normals.reshape(-1, 3).astype(np.float32))
    edge = math.asin(BALL_RADIUS / 4.0)
    x, y = np.meshgrid(np.linspace(-1.001, 1.001, 301), np.linspace(-1.001, 1.001, 101))
    directions = np.stack((np.tan(edge * x), np.tan(edge * y), -np.ones_like(x))).reshape(3, -1)
    for environment in (None, sky(1.0)):
        samples = traced(scene([ball, needles, sphere(1, (0.0, 2.0, 0.0), 0.5)], [POLISHED, BRIGHT], environment), directions)
        assert samples.image.isfinite().all() and (samples.image > 0.0).all()
        assert (samples.image[samples.triangle < 0] >= MISS_DISTANCE).all()
