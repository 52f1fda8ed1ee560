"""The guide of mode `guided`: emitters known from the start, highlights found, mixture weights, and epochs of learning."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_proposals import INFINITY, EmitterProposals, emitter_proposals
from bokehguide.models.ellipse_mixture import EllipseMixture
from bokehguide.models.projection import project_to_lens
from bokehguide.render.camera import ThinLensCamera
from bokehguide.render.random import PixelRandom
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box, unit_rectangle, unit_sphere
from bokehguide.scene.types import Environment, Material, Mesh, Scene, Sun
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.guides import mixture_of, mixture_query, pixel_batch, pytorch_mixture, samples_of, summary

WIDTH, HEIGHT = 64, 36


def rendered(scene: Scene, steps: int, config: GuidedConfig = GuidedConfig(), seed: int = 0) -> RenderLoop:
    """A loop after some steps."""
    with RenderLoop(scene, RenderSettings("guided", seed=seed, threads=1, guided=config)) as loop:
        for _ in range(steps):
            loop.step()
    return loop


def proposals(loop: RenderLoop) -> EmitterProposals:
    """The emitters that the loop's guide knows from the start."""
    return emitter_proposals(loop.scene, loop.tracer.emitters, loop.camera, loop.settings.guided)


def test_emitters_are_known_before_the_first_step():
    """In the camera's frame, whose z runs along the axis."""
    field = rendered(scenes.emitters(WIDTH, HEIGHT), 0).mode.lens.field
    order, expected = field.mean[2].argsort(), scenes.LAMP_CENTRES[np.argsort(-scenes.LAMP_CENTRES[:, 2])]
    np.testing.assert_allclose(field.mean[:, order].T, expected * (1.0, 1.0, -1.0), atol=1e-3)
    radii = scenes.LAMP_RADII[np.argsort(-scenes.LAMP_CENTRES[:, 2])]
    np.testing.assert_allclose(field.sigma[order], GuidedConfig.emitter_scale * radii, rtol=0.01)


@pytest.mark.parametrize("known", [True, False], ids=["mixture", "uniform"])
def test_lens_points_have_the_numbers_of_groups(known):
    guide = rendered(scenes.emitters(WIDTH, HEIGHT), 0, GuidedConfig(known_emitters=known)).mode.lens
    numbers = torch.arange(WIDTH * HEIGHT, dtype=torch.int32)
    alone = replace(pixel_batch(guide), random=PixelRandom(0, 1, numbers))
    grouped = replace(alone, grouped_random=alone.random.in_groups(numbers // 16, numbers % 16, 16))
    expected = guide.query(replace(alone, random=grouped.grouped_random)).sample().points
    assert torch.equal(guide.query(grouped).sample().points, expected)
    assert not torch.equal(guide.query(alone).sample().points, expected)


@pytest.mark.parametrize("steps", [0, 8])
def test_without_stratification_lens_points_have_the_numbers_of_their_pixels(steps):
    """Also in the first step of an epoch, so that the lens points of a group are independent in all steps alike."""
    guide = rendered(scenes.emitters(WIDTH, HEIGHT), steps, GuidedConfig(stratify=False)).mode.lens
    numbers, step = torch.arange(WIDTH * HEIGHT, dtype=torch.int32), steps + 1
    alone = replace(pixel_batch(guide), step=step, random=PixelRandom(0, step, numbers))
    grouped = replace(alone, grouped_random=alone.random.in_groups(numbers // 16, numbers % 16, 16))
    assert torch.equal(guide.query(grouped).sample().points, guide.query(alone).sample().points)


def test_emitters_that_are_not_compact_are_left_to_the_record():
    """A strip that reaches from before the emitters to beyond them, of the same mesh as one of them."""
    scene = scenes.emitters(WIDTH, HEIGHT)
    strip = transformed(unit_rectangle(), transform((0.0, 0.1, -5.0), scale=(0.6, 0.01, 1.0)))
    mesh = joined([strip, spheres(np.array([[0.0, -0.2, -5.0]]), 0.05, material=0)])
    loop = rendered(replace(scene, meshes=(replace(mesh, material=0),)), 8, seed=1)
    guide = loop.mode.lens
    assert len(proposals(loop).field) == 1 and len(guide.field) == 2 and len(guide.highlight_cells) > 0


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_guide_does_not_depend_on_the_unit_of_radiance(scale):
    def lit(factor: float) -> Scene:
        scene = scenes.emitters(WIDTH, HEIGHT)
        emitter = replace(scene.materials[0], emission=tuple(factor * c for c in scene.materials[0].emission))
        return replace(scene, materials=(emitter,), environment=scenes.constant_sky(0.1 * factor))

    one, other = rendered(lit(1.0), 12), rendered(lit(scale), 12)
    torch.testing.assert_close(other.mode.lens.beta, one.mode.lens.beta, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(other.film.radiance() / scale, one.film.radiance(), rtol=1e-2, atol=1e-3)
    rates, others = one.mode.lens.success_rates.rates, other.mode.lens.success_rates.rates
    assert bool((rates != 1.0).any())
    torch.testing.assert_close(others, rates, rtol=1e-2, atol=1e-3)


def shares_of_hits(emitter: Mesh) -> tuple[float, float]:
    """Share of the draws that meet the only emitter, and of draws from a ball about it, in pixels that see it in mid-lens."""
    materials = (replace(scenes.LAMP, double_sided=True),)
    scene = replace(scenes.emitters(WIDTH, HEIGHT), meshes=(emitter,), materials=materials, environment=None)
    balls = GuidedConfig(emitter_shapes=False, ellipsoids=False)
    return share_of_hits(rendered(scene, 0)), share_of_hits(rendered(scene, 0, balls))


def mixture_without_uniform(loop: RenderLoop) -> tuple[torch.Tensor, EllipseMixture]:
    """Focus points of all pixels `[3, pixels]`, and their mixtures without the uniform part."""
    batch = pixel_batch(loop.mode.lens)
    mixture = pytorch_mixture(loop.mode.lens, batch)
    mixture.beta = mixture.guided.float()
    return batch.focus, mixture


def share_of_hits(loop: RenderLoop) -> float:
    focus, mixture = mixture_without_uniform(loop)
    seen = mixture.owner[mixture.ellipses.center.norm(dim=0) < 0.3 * mixture.lens.radius]
    hits = 0.0
    for step in range(256):
        points = mixture.sample(torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step))).points
        hit = loop.tracer.geometry.tracer.intersect(*loop.camera.rays(focus[:, seen], points[:, seen]))
        hits += float((hit.triangle >= 0).float().mean()) / 256
    return hits


EDGE_ON, STRIP = ((0.0, 80.0, 0.0), (0.15, 0.15, 1.0)), ((0.0, 0.0, 30.0), (0.15, 0.01, 1.0))


def through(emitters: Scene, aperture: float) -> RenderLoop:
    """A loop through a lens of this radius, before its first step."""
    return rendered(replace(emitters, camera=replace(emitters.camera, aperture_radius=aperture)), 0)


def ball(position: tuple[float, float, float], radius: float) -> Scene:
    return replace(scenes.emitters(WIDTH, HEIGHT), meshes=(spheres(np.array([position]), radius, material=0),), environment=None)


def needle(turned: tuple[float, float, float]) -> Scene:
    mesh = transformed(unit_sphere(), transform((0.0, 0.0, -5.0), turned, (0.3, 0.02, 0.02)))
    return replace(scenes.emitters(WIDTH, HEIGHT), meshes=(mesh,), environment=None)


def sun(azimuth: float, angle: float) -> Scene:
    """Seen so many degrees off the axis."""
    far = Sun((math.sin(math.radians(azimuth)), 0.0, -math.cos(math.radians(azimuth))), angle, (1.0, 1.0, 1.0))
    behind = spheres(np.array([[0.0, 0.0, 9.0]]), 0.1, material=0)
    return replace(scenes.emitters(WIDTH, HEIGHT), meshes=(behind,), materials=(scenes.BLACK,), environment=None, suns=(far,))


@pytest.mark.parametrize(
    "emitters, aperture, least",
    [
        pytest.param(ball((0.4, 0.2, -5.0), 0.15), 0.4, 0.95, id="small"),
        pytest.param(ball((0.4, 0.2, -3.0), 0.45), 0.4, 0.95, id="near the focal plane"),
        pytest.param(ball((0.4, 0.2, -1.0), 0.2), 0.4, 0.95, id="before it"),
        pytest.param(ball((0.3, 0.1, -1.0), 0.3), 0.5, 0.95, id="large, before it"),
        pytest.param(needle((0.0, 60.0, 20.0)), 0.3, 0.75, id="long, and leaning away"),
        pytest.param(sun(0.0, 0.1), 0.3, 0.95, id="small sun"),
        pytest.param(sun(18.0, 0.53), 0.1, 0.95, id="sun at the side"),
    ],
)
def test_emitters_are_drawn_as_x_f_sees_them(emitters, aperture, least):
    """Draws meet the emitter, and every lens point that meets it has a density beside that of the uniform part."""
    loop = through(emitters, aperture)
    focus, mixture = mixture_without_uniform(loop)
    environment, drawn, missed, lit = loop.tracer.lights.environment, [], 0, 0
    assert bool((mixture.owner.diff() > 0).all())

    def meets(points: torch.Tensor) -> torch.Tensor:
        origins, directions = loop.camera.rays(focus, points)
        hit = loop.tracer.geometry.tracer.intersect(origins, directions).triangle >= 0
        return hit if environment is None else environment.radiance(directions)[0] > 0.0

    for step in range(64):
        numbers = torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step))
        points = mixture.sample(numbers).points
        drawn.append(float(meets(points)[mixture.guided].float().mean()))
        if step % 2:
            points[:, mixture.owner] += 0.3 * (points[:, mixture.owner] - mixture.ellipses.center)
        else:  # also where no candidate is drawn from
            points = loop.camera.lens.sample(numbers[1:])
        found = meets(points) & (loop.camera.lens.transmission(points) > 0.0)
        lit += int(found.sum())
        missed += int((found & (mixture.evaluate(points).mixture == 0.0)).sum())
    assert np.mean(drawn) > least
    assert lit > 1000 and missed < 1e-4 * lit


@pytest.mark.parametrize("angles, size", [EDGE_ON, STRIP], ids=["edge-on", "strip"])
def test_parallelograms_are_drawn_in_their_own_shape(angles, size):
    """Nearly all draws meet the emitter, several times as many as draws from a ball."""
    parallelogram = transformed(unit_rectangle(), transform((0.0, 0.0, -5.0), angles, size))
    exact, round_ = shares_of_hits(parallelogram)
    assert exact > 0.97 and exact > 3.0 * round_


@pytest.mark.parametrize("shape, size, least", [(unit_sphere, 0.15, 0.6), (unit_box, 0.3, 0.35)], ids=["ball", "box"])
def test_long_and_thin_emitters_are_drawn_by_their_outlines(shape, size, least):
    """A needle that leans to the side and away: the share of draws that meet it is its share of an ellipse about it."""
    needle = transformed(shape(), transform((0.0, 0.0, -5.0), (0.0, 25.0, 30.0), (size, size / 15.0, size / 15.0)))
    shaped, round_ = shares_of_hits(needle)
    assert shaped > least and shaped > 3.0 * round_


@pytest.mark.slow
def test_the_smallest_parallelograms_have_their_radiance():
    """Half a millimetre at 6 m, seen in all pixels: the mean is its share of the lens, and no pixel is bright."""
    scene = scenes.emitters(32, 18)
    parallelogram = transformed(unit_rectangle(), transform((0.0, 0.0, -6.0), (20.0, 30.0, 10.0), (5e-4, 5e-4, 1.0)))
    camera = replace(scene.camera, fov=3.0)
    loop = rendered(replace(scene, camera=camera, meshes=(parallelogram,), environment=None), 256)
    raster = torch.rand(2, 100_000, generator=torch.Generator().manual_seed(0)) * torch.tensor([[32.0], [18.0]])
    focus = loop.camera.focus_points(raster).double()
    corners = torch.from_numpy(parallelogram.vertices).double() * torch.tensor([1.0, 1.0, -1.0])
    first, second, third, _ = (project_to_lens(corner[:, None].expand_as(focus), focus) for corner in corners)
    (a, b), (c, d) = second - first, third - second
    expected = float((a * d - b * c).abs().mean()) / loop.camera.lens.area * scenes.LAMP.emission[1]
    found = loop.film.radiance()[:, :, 1]
    assert float(found.mean()) == pytest.approx(expected, rel=0.01) and float(found.max()) < 1.5 * expected


def test_proposals_are_larger_than_their_emitters_by_the_scale():
    scene = scenes.emitters(WIDTH, HEIGHT)
    camera = ThinLensCamera(scene.camera, WIDTH, HEIGHT)
    one, other = (
        emitter_proposals(scene, find_emitters(scene), camera, GuidedConfig(emitter_scale=scale)) for scale in (1.0, 1.2)
    )
    torch.testing.assert_close(other.field.radius, 1.2 * one.field.radius)
    torch.testing.assert_close(other.outlines, 1.44 * one.outlines)


def test_the_outline_of_a_sun_is_the_largest_ball_in_its_cone():
    """Its radius is the sine of half the angle, while the ball of the field has the tangent."""
    scene = replace(scenes.emitters(WIDTH, HEIGHT), meshes=(), suns=(Sun((0.0, 0.0, -1.0), 40.0, (1.0, 1.0, 1.0)),))
    camera = ThinLensCamera(replace(scene.camera, aperture_radius=0.5), WIDTH, HEIGHT)
    found = emitter_proposals(scene, find_emitters(scene), camera, GuidedConfig(emitter_scale=1.0))
    distance, half = INFINITY * camera.lens.focus_distance, math.radians(20.0)
    assert found.field.radius.tolist() == pytest.approx([math.tan(half) * distance])
    ball = [(math.sin(half) * distance) ** 2]
    assert found.outlines.flatten().tolist() == pytest.approx([*ball, 0.0, 0.0, *ball, 0.0, *ball])


def test_emitters_in_focus_behind_the_camera_or_dark_are_no_proposals():
    scene = scenes.emitters(WIDTH, HEIGHT)
    focused = spheres(np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 3.0]]), 0.05, material=0)
    dark = spheres(np.array([[0.0, 0.0, -5.0]]), 0.05, material=1)
    materials = (scenes.LAMP, replace(scenes.LAMP, emission=(0.0, 0.0, 0.0)))
    loop = rendered(replace(scene, meshes=(focused, dark), materials=materials), 3)
    assert len(proposals(loop).field) == 0 and loop.film.radiance().max() > 1.0


def test_peaks_of_an_environment_are_distant_emitters():
    radiance = np.full((64, 128, 3), 0.01, np.float32)
    radiance[30:32, 70:72] = 100.0
    scene = replace(scenes.emitters(WIDTH, HEIGHT), environment=Environment(radiance))
    focus = scene.camera.focus_distance
    field = rendered(scene, 0).mode.lens.field
    far = field.mean[2] > 0.5 * INFINITY * focus
    assert int(far.sum()) == 1
    direction = field.mean[:, far][:, 0] / (INFINITY * focus)
    azimuth, height = 2.0 * np.pi * (71 / 128 - 0.5), np.pi * (0.5 - 31 / 64)
    np.testing.assert_allclose(direction[0] / direction[2], np.tan(azimuth), rtol=0.02)
    np.testing.assert_allclose(direction[1], np.sin(height), rtol=0.02)
    unseen = replace(scene, environment=Environment(radiance, visible=False))
    assert len(rendered(unseen, 0).mode.lens.field) == len(field) - 1


def mirrored() -> Scene:
    """An emitter beside the camera, seen in a mirror that stands across the view."""
    scene = scenes.emitters(WIDTH, HEIGHT)
    emitter = spheres(np.array([[0.0, 0.4, 0.5]]), 0.03, material=0)
    mirror = replace(transformed(unit_rectangle(), transform((0.0, 0.0, -6.0), (-2.0, 0.0, 0.0), 4.0)), material=1)
    materials = (scenes.LAMP, Material("mirror", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0))
    film = replace(scene.film, max_depth=3)
    return replace(scene, meshes=(emitter, mirror), materials=materials, environment=None, film=film)


def test_reflections_are_found_and_emitters_are_not_found_twice():
    loop = rendered(mirrored(), 16)
    guide = loop.mode.lens
    assert len(guide.highlight_cells) > 0 and len(guide.field) > 0
    assert (guide.field.mean[2] > 1.0).all()  # the mirror, as the emitter itself is behind the lens
    straight = rendered(scenes.emitters(WIDTH, HEIGHT), 16).mode.lens
    assert len(straight.field) == 3 and len(straight.highlight_cells) == 0


def test_the_guide_learns_at_the_ends_of_epochs_only():
    states = []
    with RenderLoop(mirrored(), RenderSettings("guided", threads=1)) as loop:
        for _ in range(17):
            loop.step()
            states.append((int(loop.mode.lens.epoch), loop.mode.lens.beta.clone(), loop.mode.lens.field.mean.clone()))
    assert [epoch for epoch, _, _ in states] == [2, 3, 3, 5, 5, 5, 5, 9, 9, 9, 9, 9, 9, 9, 9, 17, 17]
    for before, after in pairwise(states):
        if before[0] == after[0]:
            assert torch.equal(before[1], after[1]) and torch.equal(before[2], after[2])
    assert not torch.equal(states[6][1], states[7][1])


def test_beta_has_the_least_variance():
    """Light in proportion to a mixture of the discs and the uniform lens: the best density has the same shares."""
    guide = rendered(scenes.emitters(WIDTH, HEIGHT), 0, GuidedConfig(blend_pool=1)).mode.lens
    pixels = WIDTH * HEIGHT
    for epoch in range(3):  # each brings β nearer to the best
        guide.moments.zero_()
        batch = pixel_batch(guide)
        query = mixture_query(guide, batch)
        mixture = query.mixture
        for step in range(64):
            drawn = mixture.sample(torch.rand(3, pixels, generator=torch.Generator().manual_seed(64 * epoch + step)))
            samples = samples_of(batch, query, drawn)
            at = samples.drawn.at
            light = (3.0 * at.mixture * mixture.lens.area + 1.0) * mixture.lens.contains(drawn.points)
            guide.learn_from(samples, query, light / (mixture.lens.area * at.density))
        guide.update(summary(64))
    ellipses = pytorch_mixture(guide, batch).ellipses
    beyond = ellipses.center.square().sum(0).sqrt() + torch.maximum(ellipses.width, ellipses.height) > mixture.lens.radius
    beyond = beyond.float()
    inside = mixture.guided & (torch.zeros(pixels).index_add(0, mixture.owner, beyond) == 0.0)
    assert inside.sum() > 20
    assert float(guide.beta[inside].median()) == pytest.approx(0.75, abs=0.03)


def test_beta_falls_where_emitters_are_hidden():
    """A wall hides all emitters; the sky lights the wall."""
    scene = scenes.emitters(WIDTH, HEIGHT)
    wall = replace(transformed(unit_rectangle(), transform((0.0, 0.0, -0.9), scale=3.0)), material=1)
    materials = (scenes.LAMP, Material("wall", (0.5, 0.5, 0.5)))
    film = replace(scene.film, max_depth=2)
    guide = rendered(replace(scene, meshes=(*scene.meshes, wall), materials=materials, film=film), 4).mode.lens
    counts = guide.candidates.counts()
    assert (counts > 0).sum() > 100
    assert float(guide.beta[counts > 0].median()) < 0.1
    assert float(guide.beta.min()) >= GuidedConfig.min_blend - 1e-6
    assert float(guide.beta.max()) <= GuidedConfig.max_blend + 1e-6


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_picture_does_not_depend_on_the_unit_of_length(scale):
    scene = scenes.emitters(WIDTH, HEIGHT)
    camera = replace(
        scene.camera,
        aperture_radius=scene.camera.aperture_radius * scale,
        focus_distance=scene.camera.focus_distance * scale,
    )
    meshes = tuple(transformed(mesh, transform(scale=scale)) for mesh in scene.meshes)
    one, other = (rendered(s, 12).film.radiance() for s in (scene, replace(scene, camera=camera, meshes=meshes)))
    changed = (one - other).abs().amax(2) > 1e-3 * (one.amax(2) + 0.1)
    assert changed.float().mean() < 0.02  # single draws at an emitter's edge fall on either side


def test_a_new_guide_that_loads_a_state_draws_from_the_same_densities(tmp_path):
    scene = mirrored()
    guide = rendered(scene, 9).mode.lens
    torch.save(guide.state_dict(), tmp_path / "guide.pt")
    loaded = rendered(scene, 0).mode.lens
    loaded.load_state_dict(torch.load(tmp_path / "guide.pt", weights_only=True))
    batch = pixel_batch(guide, raster=torch.rand(2, WIDTH * HEIGHT) * torch.tensor([[WIDTH], [HEIGHT]]))
    points = 0.05 * torch.randn(2, WIDTH * HEIGHT)
    old, new = (mixture_of(each, batch).pdf(points) for each in (guide, loaded))
    assert torch.equal(old, new) and int(loaded.epoch) == 9
    assert project_to_lens(loaded.field.mean[:, :1], batch.focus[:, :1]).isfinite().all()


OTHERS = {"behind": (0.0, 0.0, 5.0), "beside": (0.5, 0.2, 0.02), "aside": (9.0, 0.0, -3.0), "in focus": (0.0, 0.0, -2.0)}


@pytest.mark.parametrize("centre", OTHERS.values(), ids=OTHERS)
def test_emitters_are_known_whatever_else_their_mesh_holds(centre):
    """Three emitters in sight, in one mesh with an emitter that sends nothing straight into the frame, or is in focus."""
    scene = scenes.emitters(WIDTH, HEIGHT)
    mesh = spheres(np.array([*scenes.LAMP_CENTRES, centre]), np.array([*scenes.LAMP_RADII, 0.03]), material=0)
    loop = rendered(replace(scene, meshes=(mesh,)), 16)
    guide, depths = loop.mode.lens, np.sort(proposals(loop).field.mean[2].numpy())
    for depth in -scenes.LAMP_CENTRES[:, 2]:
        assert np.abs(depths - depth).min() < 0.01
    assert len(guide.highlight_cells) == 0 and len(guide.field) == len(depths)


def annulus(centre: tuple[float, float, float], radius: float) -> Mesh:
    """A thin flat ring across the view, of too few triangles to be divided. Its outline has many times the area that it shows."""
    angles = np.linspace(0.0, 2.0 * np.pi, 8)[:-1]
    rim = np.stack((np.cos(angles), np.sin(angles), 0.0 * angles), axis=1)
    inner, outer = np.arange(7, dtype=np.int32), np.arange(7, 14, dtype=np.int32)
    beside = np.roll(outer, -1)
    triangles = np.concatenate((np.stack((inner, outer, beside), 1), np.stack((inner, beside, np.roll(inner, -1)), 1)))
    return Mesh((centre + np.concatenate((0.99 * rim, 1.01 * rim)) * radius).astype(np.float32), triangles, 0)


def test_emitters_without_a_proposal_do_not_count_as_known():
    """A ring close beside the lens fills too little of its outline for a proposal."""
    scene = replace(scenes.emitters(WIDTH, HEIGHT), meshes=(annulus((0.13, 0.0, -0.2), 0.02),), environment=None)
    loop = rendered(replace(scene, materials=(replace(scenes.LAMP, double_sided=True),)), 64)
    assert float(loop.film.radiance().max()) > 0.1 and len(loop.mode.lens.field) == 0
    assert not proposals(loop).triangles.any()


BALL, RADIUS = np.array([0.0, 0.0, -7.0]), 2.0
AROUND = np.array([[2.0, 1.2, 0.0], [-2.2, 0.8, 0.5], [0.6, -1.6, 0.3]])


def ball_of_emitters() -> Scene:
    """Three emitters beside and behind the camera, far from its focus, mirrored in a metal ball that fills the frame."""
    camera = replace(scenes.emitters(WIDTH, HEIGHT).camera, fov=12.0, aperture_radius=0.3)
    emitters = spheres(AROUND, 0.3, material=0)
    ball = trimesh.creation.icosphere(subdivisions=5)
    points = np.asarray(ball.vertices)
    metal = Mesh((BALL + RADIUS * points).astype(np.float32), ball.faces.astype(np.int32), 1, points.astype(np.float32))
    materials = (scenes.LAMP, Material("metal", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0))
    scene = replace(
        scenes.emitters(WIDTH, HEIGHT), camera=camera, meshes=(emitters, metal), materials=materials, environment=None
    )
    return replace(scene, film=replace(scene.film, max_depth=2))


def images_in_the_ball() -> np.ndarray:
    """Virtual images of the emitters as the lens centre sees them, camera frame, `[3, 3]`.

    The reflection point is where the normal halves the angle. The distance behind it is that of a ball's image, averaged over
    the principal planes.
    """
    images = []
    for emitter in AROUND:
        normal = np.array([0.0, 0.0, 1.0])
        for _ in range(100):
            point = BALL + RADIUS * normal
            normal = -point / np.linalg.norm(point) + (emitter - point) / np.linalg.norm(emitter - point)
            normal /= np.linalg.norm(normal)
        reached, cosine = np.linalg.norm(point), -normal @ point / np.linalg.norm(point)
        behind = 1.0 / (1.0 / (np.linalg.norm(emitter - point) - 0.3) + (cosine + 1.0 / cosine) / RADIUS)
        images.append(point * (1.0 + behind / reached))
    return np.array(images) * (1.0, 1.0, -1.0)


def share_of_bright_draws(loop: RenderLoop) -> float:
    """Share of the draws from found highlights that bring light, in pixels whose discs lie within the lens."""
    focus, mixture = mixture_without_uniform(loop)
    within = mixture.owner[mixture.ellipses.center.norm(dim=0) < 0.8 * mixture.lens.radius].unique()
    assert len(within) > 100
    bright = []
    for step in range(64):
        points = mixture.sample(torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step))).points
        rays = loop.camera.rays(focus[:, within], points[:, within])
        samples = loop.tracer.trace(*rays, PixelRandom(7, step, within), PhaseTimer())
        bright.append(float((samples.radiance.amax(0) > 1.0).float().mean()))
    return float(np.mean(bright))


@pytest.fixture(scope="module")
def found_on_a_ball() -> RenderLoop:
    return rendered(ball_of_emitters(), 32, seed=2)


def test_highlights_on_a_metal_ball_are_found_at_their_virtual_images(found_on_a_ball):
    """Each once, behind the ball's surface, within a tenth of the image's distance from the surface."""
    expected, guide = images_in_the_ball(), found_on_a_ball.mode.lens
    assert len(proposals(found_on_a_ball).field) == 0 and len(guide.field) == 3
    away = np.linalg.norm(guide.field.mean.T.numpy()[:, None] - expected, axis=2)
    assert sorted(away.argmin(1)) == [0, 1, 2] and (away.min(1) < 0.03).all()


def test_most_draws_meet_highlights_on_a_metal_ball(found_on_a_ball):
    """Nearly the share of a found ellipse that an even disc fills; far fewer without virtual images."""
    share = share_of_bright_draws(found_on_a_ball)
    loop = rendered(ball_of_emitters(), 32, GuidedConfig(virtual_images=False))
    assert len(loop.mode.lens.field) == 3 and float(loop.mode.lens.field.mean[2].max()) < 5.2
    assert share > 0.8 * (2.0 / GuidedConfig.highlight_axes) ** 2 and share > 1.4 * share_of_bright_draws(loop)


def test_found_highlights_are_drawn_alike_from_a_checkpoint(found_on_a_ball, tmp_path):
    """With the same outlines, also in later epochs."""
    guide = found_on_a_ball.mode.lens
    torch.save(guide.state_dict(), tmp_path / "guide.pt")
    state = torch.load(tmp_path / "guide.pt", weights_only=True)
    loaded = rendered(ball_of_emitters(), 0).mode.lens
    assert loaded.outlines.shape == (6, 0)
    loaded.load_state_dict(state)
    assert loaded.outlines.shape == (6, 3) and torch.equal(loaded.outlines, guide.outlines)
    uniforms = torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(0))
    old, new = (mixture_of(each) for each in (guide, loaded))
    points, candidate = old.sample(uniforms)
    assert torch.equal(points, new.sample(uniforms).points) and torch.equal(old.pdf(points), new.pdf(points))
    assert (candidate >= 0).sum() > 100
    for outlines in (torch.full((6, 3), torch.nan), state["outlines"][:, :2]):
        with pytest.raises(ValueError):
            rendered(ball_of_emitters(), 0).mode.lens.load_state_dict(state | {"outlines": outlines})
