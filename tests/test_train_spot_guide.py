"""The guide of mode `guided`: what it knows from the start, what it finds, how it weighs, and when."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
import trimesh

from bokehguide.models.disc_distribution import DiscLensDistribution, balls
from bokehguide.models.projection import project_to_lens
from bokehguide.render.path_tracer import PathSamples
from bokehguide.render.random import PixelRandom
from bokehguide.render.timer import PhaseTimer
from bokehguide.scene.shapes import joined, spheres, transform, transformed, unit_box, unit_rectangle, unit_sphere
from bokehguide.scene.types import Environment, Material, Mesh, Scene, Sun
from bokehguide.train import RenderLoop, RenderSettings, spot_guide
from bokehguide.train.fitting import AXES
from bokehguide.train.guide import GuidedBatch
from bokehguide.train.known_lamps import INFINITY, REACH
from bokehguide.train.spot_guide import HIGHEST, LOWEST

WIDTH, HEIGHT = 64, 36


def rendered(scene: Scene, steps: int, seed: int = 0, threads: int = 1) -> RenderLoop:
    loop = RenderLoop(scene, RenderSettings("guided", seed=seed, threads=threads))
    for _ in range(steps):
        loop.step()
    return loop


def test_the_lamps_are_known_before_the_first_step():
    """In the camera's frame, whose z runs along the axis."""
    field = rendered(scenes.lamps(WIDTH, HEIGHT), 0).guide.field
    order, expected = field.mean[2].argsort(), scenes.LAMP_CENTRES[np.argsort(-scenes.LAMP_CENTRES[:, 2])]
    np.testing.assert_allclose(field.mean[:, order].T, expected * (1.0, 1.0, -1.0), atol=1e-3)
    radii = scenes.LAMP_RADII[np.argsort(-scenes.LAMP_CENTRES[:, 2])]
    np.testing.assert_allclose(field.sigma[order], REACH * radii, rtol=0.01)


def test_what_is_no_compact_lamp_is_left_to_be_found():
    """A strip that reaches from before the lamps to beyond them, of the same mesh as one of them."""
    scene = scenes.lamps(WIDTH, HEIGHT)
    strip = transformed(unit_rectangle(), transform((0.0, 0.1, -5.0), scale=(0.6, 0.01, 1.0)))
    mesh = joined([strip, spheres(np.array([[0.0, -0.2, -5.0]]), 0.05, material=0)])
    loop = rendered(replace(scene, meshes=(replace(mesh, material=0),)), 8)
    guide = loop.guide
    assert len(guide._lamps.field) == 1 and len(guide.field) == 2 and len(guide.spotlights) > 0


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_scenes_brightness_changes_nothing(scale):
    def lit(factor: float) -> Scene:
        scene = scenes.lamps(WIDTH, HEIGHT)
        lamp = replace(scene.materials[0], emission=tuple(factor * c for c in scene.materials[0].emission))
        return replace(scene, materials=(lamp,), environment=scenes.constant_sky(0.1 * factor))

    one, other = rendered(lit(1.0), 12), rendered(lit(scale), 12)
    torch.testing.assert_close(other.guide.beta, one.guide.beta, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(other.film.radiance() / scale, one.film.radiance(), rtol=1e-2, atol=1e-3)


def shares_of_hits(lamp: Mesh) -> tuple[float, float]:
    """Share of the draws that meet the only lamp, and of draws from a ball about it, in pixels that see it in mid-lens."""
    materials = (replace(scenes.LAMP, double_sided=True),)
    loop = rendered(replace(scenes.lamps(WIDTH, HEIGHT), meshes=(lamp,), materials=materials, environment=None), 0)
    shaped, guide = share_of_hits(loop), loop.guide
    guide.outlines, guide._numbers = balls(guide.field.sigma), torch.full_like(guide._numbers, -1)
    return shaped, share_of_hits(loop)


def guided_alone(loop: RenderLoop) -> tuple[torch.Tensor, DiscLensDistribution]:
    """Focus points of all pixels `[3, pixels]`, and their mixtures without the uniform part."""
    pixels = WIDTH * HEIGHT
    raster = torch.stack((torch.arange(pixels) % WIDTH, torch.arange(pixels) // WIDTH)) + 0.5
    focus = loop.camera.focus_points(raster)
    mixture, *_ = loop.guide._mixture(slice(0, pixels), focus)
    mixture.beta = mixture.guided.float()
    return focus, mixture


def share_of_hits(loop: RenderLoop) -> float:
    focus, mixture = guided_alone(loop)
    seen = mixture.owner[mixture.ellipses.center.norm(dim=0) < 0.3 * mixture.lens.radius]
    hits = 0.0
    for step in range(256):
        points = mixture.sample(torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step)))
        hit = loop.tracer.geometry.tracer.intersect(*loop.camera.rays(focus[:, seen], points[:, seen]))
        hits += float((hit.triangle >= 0).float().mean()) / 256
    return hits


EDGE_ON, STRIP = ((0.0, 80.0, 0.0), (0.15, 0.15, 1.0)), ((0.0, 0.0, 30.0), (0.15, 0.01, 1.0))


def lit_alone(lamps: Scene, aperture: float) -> RenderLoop:
    """Under nothing else, through another lens."""
    return rendered(replace(lamps, camera=replace(lamps.camera, aperture_radius=aperture)), 0)


def ball(position: tuple[float, float, float], radius: float) -> Scene:
    return replace(scenes.lamps(WIDTH, HEIGHT), meshes=(spheres(np.array([position]), radius, material=0),), environment=None)


def needle(turned: tuple[float, float, float]) -> Scene:
    mesh = transformed(unit_sphere(), transform((0.0, 0.0, -5.0), turned, (0.75, 0.02, 0.02)))
    return replace(scenes.lamps(WIDTH, HEIGHT), meshes=(mesh,), environment=None)


def sun(azimuth: float, angle: float) -> Scene:
    """Seen so many degrees off the axis."""
    far = Sun((math.sin(math.radians(azimuth)), 0.0, -math.cos(math.radians(azimuth))), angle, (1.0, 1.0, 1.0))
    behind = spheres(np.array([[0.0, 0.0, 9.0]]), 0.1, material=0)
    return replace(scenes.lamps(WIDTH, HEIGHT), meshes=(behind,), materials=(scenes.BLACK,), environment=None, suns=(far,))


@pytest.mark.parametrize(
    "lamps, aperture, least",
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
def test_lamps_are_drawn_as_x_f_sees_them(lamps, aperture, least):
    """What is drawn meets them, and what meets them is drawn, and not by the uniform part alone: at points beside them, too."""
    loop = lit_alone(lamps, aperture)
    focus, mixture = guided_alone(loop)
    environment, drawn, missed, lit = loop.tracer.lights.environment, [], 0, 0
    assert bool((mixture.owner.diff() > 0).all())

    def meets(points: torch.Tensor) -> torch.Tensor:
        origins, directions = loop.camera.rays(focus, points)
        hit = loop.tracer.geometry.tracer.intersect(origins, directions).triangle >= 0
        return hit if environment is None else environment.radiance(directions)[0] > 0.0

    for step in range(64):
        numbers = torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step))
        points = mixture.sample(numbers)
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
def test_panels_are_drawn_in_their_own_shape(angles, size):
    """Nearly all of the draws meet it, and many times those of a ball."""
    panel = transformed(unit_rectangle(), transform((0.0, 0.0, -5.0), angles, size))
    exact, round_ = shares_of_hits(panel)
    assert exact > 0.97 and exact > 3.0 * round_


@pytest.mark.parametrize("shape, size, least", [(unit_sphere, 0.15, 0.6), (unit_box, 0.3, 0.35)], ids=["ball", "box"])
def test_what_is_long_and_thin_is_drawn_by_its_outline(shape, size, least):
    """A needle that leans to the side and away: as many draws meet it as it fills of an ellipse about it."""
    needle = transformed(shape(), transform((0.0, 0.0, -5.0), (0.0, 25.0, 30.0), (size, size / 15.0, size / 15.0)))
    shaped, round_ = shares_of_hits(needle)
    assert shaped > least and shaped > 3.0 * round_


def test_the_smallest_panels_are_as_bright_as_they_are():
    """Half a millimetre at 6 m, seen in all pixels: the share of the lens that shows it, with no bright pixel among them."""
    scene = scenes.lamps(32, 18)
    panel = transformed(unit_rectangle(), transform((0.0, 0.0, -6.0), (20.0, 30.0, 10.0), (5e-4, 5e-4, 1.0)))
    camera = replace(scene.camera, fov=3.0)
    loop = rendered(replace(scene, camera=camera, meshes=(panel,), environment=None), 256)
    raster = torch.rand(2, 100_000, generator=torch.Generator().manual_seed(0)) * torch.tensor([[32.0], [18.0]])
    focus = loop.camera.focus_points(raster).double()
    corners = torch.from_numpy(panel.vertices).double() * torch.tensor([1.0, 1.0, -1.0])
    first, second, third, _ = (project_to_lens(corner[:, None].expand_as(focus), focus) for corner in corners)
    (a, b), (c, d) = second - first, third - second
    expected = float((a * d - b * c).abs().mean()) / loop.camera.lens.area * scenes.LAMP.emission[1]
    found = loop.film.radiance()[:, :, 1]
    assert float(found.mean()) == pytest.approx(expected, rel=0.01) and float(found.max()) < 1.5 * expected


def test_lamps_in_focus_behind_the_camera_or_unlit_are_none():
    scene = scenes.lamps(WIDTH, HEIGHT)
    focused = spheres(np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 3.0]]), 0.05, material=0)
    dark = spheres(np.array([[0.0, 0.0, -5.0]]), 0.05, material=1)
    materials = (scenes.LAMP, replace(scenes.LAMP, emission=(0.0, 0.0, 0.0)))
    loop = rendered(replace(scene, meshes=(focused, dark), materials=materials), 3)
    assert len(loop.guide._lamps.field) == 0 and loop.film.radiance().max() > 1.0


def test_peaks_of_an_environment_are_far_lamps():
    radiance = np.full((64, 128, 3), 0.01, np.float32)
    radiance[30:32, 70:72] = 100.0
    scene = replace(scenes.lamps(WIDTH, HEIGHT), environment=Environment(radiance))
    focus = scene.camera.focus_distance
    field = rendered(scene, 0).guide.field
    far = field.mean[2] > 0.5 * INFINITY * focus
    assert int(far.sum()) == 1
    direction = field.mean[:, far][:, 0] / (INFINITY * focus)
    azimuth, height = 2.0 * np.pi * (71 / 128 - 0.5), np.pi * (0.5 - 31 / 64)
    np.testing.assert_allclose(direction[0] / direction[2], np.tan(azimuth), rtol=0.02)
    np.testing.assert_allclose(direction[1], np.sin(height), rtol=0.02)
    unseen = replace(scene, environment=Environment(radiance, visible=False))
    assert len(rendered(unseen, 0).guide.field) == len(field) - 1


def mirrored() -> Scene:
    """A lamp beside the camera, seen in a mirror that stands across the view."""
    scene = scenes.lamps(WIDTH, HEIGHT)
    lamp = spheres(np.array([[0.0, 0.4, 0.5]]), 0.03, material=0)
    mirror = replace(transformed(unit_rectangle(), transform((0.0, 0.0, -6.0), (-2.0, 0.0, 0.0), 4.0)), material=1)
    materials = (scenes.LAMP, Material("mirror", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0))
    film = replace(scene.film, max_depth=3)
    return replace(scene, meshes=(lamp, mirror), materials=materials, environment=None, film=film)


def test_reflections_are_found_and_lamps_are_not_found_twice():
    loop = rendered(mirrored(), 16)
    guide = loop.guide
    assert len(guide.spotlights) > 0 and len(guide.field) > 0
    assert (guide.field.mean[2] > 1.0).all()  # the mirror, as the lamp itself is behind the lens
    straight = rendered(scenes.lamps(WIDTH, HEIGHT), 16).guide
    assert len(straight.field) == 3 and len(straight.spotlights) == 0


def test_it_learns_at_the_ends_of_blocks_only():
    loop = RenderLoop(mirrored(), RenderSettings("guided", threads=1))
    states = []
    for _ in range(17):
        loop.step()
        states.append((int(loop.guide.block), loop.guide.beta.clone(), loop.guide.field.mean.clone()))
    assert [block for block, _, _ in states] == [2, 3, 3, 5, 5, 5, 5, 9, 9, 9, 9, 9, 9, 9, 9, 17, 17]
    for before, after in zip(states[:-1], states[1:]):
        if before[0] == after[0]:
            assert torch.equal(before[1], after[1]) and torch.equal(before[2], after[2])
    assert not torch.equal(states[6][1], states[7][1])


def test_beta_is_that_of_least_variance(monkeypatch):
    """Light in proportion to a mixture of the discs and the uniform lens: the best density has the same shares."""
    monkeypatch.setattr(spot_guide, "POOLED", 1)
    guide = rendered(scenes.lamps(WIDTH, HEIGHT), 0).guide
    pixels = WIDTH * HEIGHT
    raster = torch.stack((torch.arange(pixels) % WIDTH, torch.arange(pixels) // WIDTH)) + 0.5
    for block in range(3):  # nearer to it with every block
        guide.moments.zero_()
        mixture, _, slots = guide._mixture(slice(0, pixels), guide.camera.focus_points(raster))
        for step in range(64):
            points = mixture.sample(torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(64 * block + step)))
            at = mixture.evaluate(points)
            light = (3.0 * at.mixture * mixture.lens.area + 1.0) * mixture.lens.contains(points)
            guide.study(GuidedBatch(slice(0, pixels), raster, mixture, slots=slots), light / (mixture.lens.area * at.density), at)
        guide.update(64, [], 1.0)
    beyond = (mixture.ellipses.center.square().sum(0).sqrt() + torch.maximum(mixture.ellipses.width, mixture.ellipses.height) > mixture.lens.radius).float()
    inside = mixture.guided & (torch.zeros(pixels).index_add(0, mixture.owner, beyond) == 0.0)
    assert inside.sum() > 20
    assert float(guide.beta[inside].median()) == pytest.approx(0.75, abs=0.03)


def test_beta_falls_where_nothing_comes_from_the_lamps():
    """A wall hides them; the wall itself is lit by the sky."""
    scene = scenes.lamps(WIDTH, HEIGHT)
    wall = replace(transformed(unit_rectangle(), transform((0.0, 0.0, -0.9), scale=3.0)), material=1)
    materials = (scenes.LAMP, Material("wall", (0.5, 0.5, 0.5)))
    film = replace(scene.film, max_depth=2)
    guide = rendered(replace(scene, meshes=(*scene.meshes, wall), materials=materials, film=film), 4).guide
    counts = guide.candidates.counts()
    assert (counts > 0).sum() > 100
    assert float(guide.beta[counts > 0].median()) < 0.1
    assert float(guide.beta.min()) >= LOWEST - 1e-6 and float(guide.beta.max()) <= HIGHEST + 1e-6


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_scenes_scale_changes_nothing(scale):
    scene = scenes.lamps(WIDTH, HEIGHT)
    camera = replace(
        scene.camera,
        aperture_radius=scene.camera.aperture_radius * scale,
        focus_distance=scene.camera.focus_distance * scale,
    )
    meshes = tuple(transformed(mesh, transform(scale=scale)) for mesh in scene.meshes)
    one, other = (rendered(s, 12).film.radiance() for s in (scene, replace(scene, camera=camera, meshes=meshes)))
    changed = (one - other).abs().amax(2) > 1e-3 * (one.amax(2) + 0.1)
    assert changed.float().mean() < 0.02  # single draws at the edge of a lamp fall to the other side


def test_a_fresh_guide_that_loads_the_state_draws_alike(tmp_path):
    scene = mirrored()
    loop = rendered(scene, 9)
    torch.save(loop.guide.state_dict(), tmp_path / "guide.pt")
    fresh = rendered(scene, 0).guide
    fresh.load_state_dict(torch.load(tmp_path / "guide.pt", weights_only=True))
    raster = torch.rand(2, WIDTH * HEIGHT) * torch.tensor([[WIDTH], [HEIGHT]])
    focus = loop.camera.focus_points(raster)
    points = 0.05 * torch.randn(2, WIDTH * HEIGHT)
    old, new = (guide._mixture(slice(0, WIDTH * HEIGHT), focus)[0].pdf(points) for guide in (loop.guide, fresh))
    assert torch.equal(old, new) and int(fresh.block) == 9
    assert project_to_lens(fresh.field.mean[:, :1], focus[:, :1]).isfinite().all()


OTHERS = {"behind": (0.0, 0.0, 5.0), "beside": (0.5, 0.2, 0.02), "aside": (9.0, 0.0, -3.0), "in focus": (0.0, 0.0, -2.0)}


@pytest.mark.parametrize("centre", OTHERS.values(), ids=OTHERS)
def test_lamps_are_known_whatever_else_their_mesh_holds(centre):
    """Three lamps in sight, in one mesh with a lamp that sends nothing straight into the frame, or is in focus."""
    scene = scenes.lamps(WIDTH, HEIGHT)
    mesh = spheres(np.array([*scenes.LAMP_CENTRES, centre]), np.array([*scenes.LAMP_RADII, 0.03]), material=0)
    guide = rendered(replace(scene, meshes=(mesh,)), 16).guide
    depths = np.sort(guide._lamps.field.mean[2].numpy())
    for depth in -scenes.LAMP_CENTRES[:, 2]:
        assert np.abs(depths - depth).min() < 0.01
    assert len(guide.spotlights) == 0 and len(guide.field) == len(depths)


def annulus(centre: tuple[float, float, float], radius: float) -> Mesh:
    """A thin flat ring, whose outline has many times the area that it shows, across the view."""
    angles = np.linspace(0.0, 2.0 * np.pi, 61)[:-1]
    rim = np.stack((np.cos(angles), np.sin(angles), 0.0 * angles), axis=1)
    inner, outer = np.arange(60, dtype=np.int32), np.arange(60, 120, dtype=np.int32)
    beside = np.roll(outer, -1)
    triangles = np.concatenate((np.stack((inner, outer, beside), 1), np.stack((inner, beside, np.roll(inner, -1)), 1)))
    return Mesh((centre + np.concatenate((0.99 * rim, 1.01 * rim)) * radius).astype(np.float32), triangles, 0)


def test_what_lights_the_picture_and_is_no_lamp_of_the_field_is_not_known():
    """A ring close beside the lens, whose other half sees it: too much of a tangle to be a lamp."""
    scene = replace(scenes.lamps(WIDTH, HEIGHT), meshes=(annulus((0.13, 0.0, -0.2), 0.02),), environment=None)
    loop = rendered(replace(scene, materials=(replace(scenes.LAMP, double_sided=True),)), 64)
    assert float(loop.film.radiance().max()) > 0.1 and len(loop.guide.field) == 0
    assert not loop.guide._lamps.triangles.any()


BALL, RADIUS = np.array([0.0, 0.0, -7.0]), 2.0
AROUND = np.array([[2.0, 1.2, 0.0], [-2.2, 0.8, 0.5], [0.6, -1.6, 0.3]])


def ball_of_lamps() -> Scene:
    """Three lamps beside and behind the camera, far from its focus, mirrored in a metal ball that fills the frame."""
    camera = replace(scenes.lamps(WIDTH, HEIGHT).camera, fov=12.0, aperture_radius=0.3)
    lamps = spheres(AROUND, 0.3, material=0)
    ball = trimesh.creation.icosphere(subdivisions=5)
    points = np.asarray(ball.vertices)
    metal = Mesh((BALL + RADIUS * points).astype(np.float32), ball.faces.astype(np.int32), 1, points.astype(np.float32))
    materials = (scenes.LAMP, Material("metal", (1.0, 1.0, 1.0), metallic=1.0, roughness=0.0))
    scene = replace(scenes.lamps(WIDTH, HEIGHT), camera=camera, meshes=(lamps, metal), materials=materials, environment=None)
    return replace(scene, film=replace(scene.film, max_depth=2))


def images_in_the_ball() -> np.ndarray:
    """Where the middle of the lens sees the lamps, camera frame `[3, 3]`: on the ball, where the normal halves the angle, and
    from there on as far as a ball's image is on average over the principal planes."""
    images = []
    for lamp in AROUND:
        normal = np.array([0.0, 0.0, 1.0])
        for _ in range(100):
            point = BALL + RADIUS * normal
            normal = -point / np.linalg.norm(point) + (lamp - point) / np.linalg.norm(lamp - point)
            normal /= np.linalg.norm(normal)
        reached, cosine = np.linalg.norm(point), -normal @ point / np.linalg.norm(point)
        behind = 1.0 / (1.0 / (np.linalg.norm(lamp - point) - 0.3) + (cosine + 1.0 / cosine) / RADIUS)
        images.append(point * (1.0 + behind / reached))
    return np.array(images) * (1.0, 1.0, -1.0)


def share_of_bright_draws(loop: RenderLoop) -> float:
    """Share of the draws from what was found that bring light, in pixels whose discs lie within the lens."""
    focus, mixture = guided_alone(loop)
    within = mixture.owner[mixture.ellipses.center.norm(dim=0) < 0.8 * mixture.lens.radius].unique()
    assert len(within) > 100
    bright = []
    for step in range(64):
        points = mixture.sample(torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(step)))
        rays = loop.camera.rays(focus[:, within], points[:, within])
        samples = loop.tracer.trace(*rays, PixelRandom(7, step, within), PhaseTimer())
        bright.append(float((samples.radiance.amax(0) > 1.0).float().mean()))
    return float(np.mean(bright))


@pytest.fixture(scope="module")
def found_on_a_ball() -> RenderLoop:
    return rendered(ball_of_lamps(), 32)


def test_highlights_on_a_metal_ball_are_found_where_its_images_are(found_on_a_ball):
    """Each once, behind the ball's surface, within a tenth of what the ball's image lies behind it."""
    expected, guide = images_in_the_ball(), found_on_a_ball.guide
    assert len(guide._lamps.field) == 0 and len(guide.field) == 3
    away = np.linalg.norm(guide.field.mean.T.numpy()[:, None] - expected, axis=2)
    assert sorted(away.argmin(1)) == [0, 1, 2] and (away.min(1) < 0.03).all()


def test_most_draws_meet_highlights_on_a_metal_ball(found_on_a_ball, monkeypatch):
    """Nearly as many as AXES leaves of an even disc; far fewer where the highlights are taken to lie on the ball."""
    share = share_of_bright_draws(found_on_a_ball)
    monkeypatch.setattr(PathSamples, "image", property(lambda samples: samples.distance))
    loop = rendered(ball_of_lamps(), 32)
    assert len(loop.guide.field) == 3 and float(loop.guide.field.mean[2].max()) < 5.2
    assert share > 0.8 * (2.0 / AXES) ** 2 and share > 1.4 * share_of_bright_draws(loop)


def test_what_was_found_is_drawn_alike_from_a_checkpoint(found_on_a_ball, tmp_path):
    """With the very outlines, and from then on."""
    torch.save(found_on_a_ball.guide.state_dict(), tmp_path / "guide.pt")
    state = torch.load(tmp_path / "guide.pt", weights_only=True)
    fresh = rendered(ball_of_lamps(), 0).guide
    assert fresh.outlines.shape == (6, 0)
    fresh.load_state_dict(state)
    assert fresh.outlines.shape == (6, 3) and torch.equal(fresh.outlines, found_on_a_ball.guide.outlines)
    pixels = WIDTH * HEIGHT
    raster = torch.stack((torch.arange(pixels) % WIDTH, torch.arange(pixels) // WIDTH)) + 0.5
    focus, uniforms = fresh.camera.focus_points(raster), torch.rand(3, pixels, generator=torch.Generator().manual_seed(0))
    old, new = (guide._mixture(slice(0, pixels), focus)[0] for guide in (found_on_a_ball.guide, fresh))
    points = old.sample(uniforms)
    assert torch.equal(points, new.sample(uniforms)) and torch.equal(old.pdf(points), new.pdf(points))
    assert (old.chosen >= 0).sum() > 100
    for outlines in (torch.full((6, 3), torch.nan), state["outlines"][:, :2]):
        with pytest.raises(ValueError):
            rendered(ball_of_lamps(), 0).guide.load_state_dict(state | {"outlines": outlines})
