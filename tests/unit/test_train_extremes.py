"""Numbers that go wrong, in every mode: what cannot be counted, black scenes, lenses and scenes of any size.

docs/reference/numbers.md lists these cases, under "Unusual input".
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from weakref import WeakKeyDictionary

import numpy as np
import pytest
import torch
from scipy import stats

from bokehguide.guiding.uniform import UniformLens
from bokehguide.models.projection import lens_density, log_density_gradient, project_to_lens
from bokehguide.render.bad_samples import BadSample
from bokehguide.render.random import PixelRandom
from bokehguide.scene.shapes import transform, transformed, unit_rectangle, unit_sphere
from bokehguide.scene.types import Camera, Environment, FilmSettings, Material, Mesh, Scene, Sun
from bokehguide.train import LENS_MODES, MODES, RenderLoop, RenderSettings
from tests.support.statistical import SIGNIFICANCE

RESTIR_MODES = tuple(mode for mode in MODES if mode not in LENS_MODES)

WIDTH, HEIGHT, SEED = 32, 18, 5
GUIDED = LENS_MODES[1:]
ALL = (*LENS_MODES, "area-restir+lis")
"""One mode of each kind that reuses samples is enough, where it is not about reuse: they are slow."""
FEW = 3
"""Steps of those modes."""
FRAMES: WeakKeyDictionary[RenderLoop, np.ndarray] = WeakKeyDictionary()
"""The frame's mean luminance in each step of a render."""
DARK = np.zeros((2, 4, 3), np.float32)


def shape(of: Mesh, material: int, translate=(0.0, 0.0, 0.0), rotate=(0.0, 0.0, 0.0), scale=1.0) -> Mesh:
    return replace(transformed(of, transform(translate, rotate, scale)), material=material)


def stage(*more: Mesh, light: float = 1.0, size: float = 1.0, depth: int = 3, **camera) -> Scene:
    """A floor, a ball, and two emitters before and behind the focal plane, under a dim sky; `more` is added.

    light: multiplies all radiances; size: all lengths.
    """
    materials = (
        Material("floor", (0.6, 0.5, 0.4)),
        Material("ball", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.3),
        Material("emitter", (0.0, 0.0, 0.0), specular=0.0, emission=(40.0 * light, 30.0 * light, 20.0 * light)),
        Material("glass", (1.0, 1.0, 1.0), transmission=1.0, roughness=0.0),
    )
    meshes = (
        shape(unit_rectangle(), 0, (0.0, -0.4, -4.0), (-90.0, 0.0, 0.0), 4.0),
        shape(unit_sphere(), 1, (0.4, -0.1, -2.0), scale=0.3),
        shape(unit_sphere(), 2, (-0.4, 0.25, -5.0), scale=0.08),
        shape(unit_sphere(), 2, (0.1, 0.15, -1.1), scale=0.02),
        *more,
    )
    meshes = tuple(replace(mesh, vertices=mesh.vertices * np.float32(size)) for mesh in meshes)
    view = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -size), fov=50.0, aperture_radius=0.1 * size, focus_distance=2.0 * size)
    sky = Environment(np.full((2, 4, 3), 0.1 * light, np.float32))
    return Scene("stage", replace(view, **camera), meshes, materials, FilmSettings(WIDTH, HEIGHT, depth), sky)


def without_lamps(scene: Scene, *more: Mesh) -> Scene:
    """The scene with no sky, and no emitters but `more`."""
    meshes = tuple(mesh for mesh in scene.meshes if mesh.material != 2)
    return replace(scene, meshes=(*meshes, *more), environment=None)


def rendered(scene: Scene, mode: str, steps: int = 4, seed: int = SEED) -> RenderLoop:
    """A loop after some steps; at most FEW where it reuses samples."""
    loop = RenderLoop(scene, RenderSettings(mode, seed=seed, threads=1, reuse_radius=4.0))
    totals = [0.0]
    for step in range(1, 1 + (min(steps, FEW) if mode in RESTIR_MODES else steps)):
        loop.step()
        totals.append(step * loop.film.mean_luminance())
    FRAMES[loop] = np.diff(totals)
    return loop


@lru_cache
def reference(scene: Callable[[], Scene]) -> RenderLoop:
    """The uniform lens's picture of what `scene` makes, with little noise."""
    return rendered(scene(), "uniform", 128, seed=99)


def sound(loop: RenderLoop, bad: int = 0) -> bool:
    """Whether film and guide hold finite numbers only, and so many samples were left out."""
    arrays = [torch.from_numpy(layer) for layer in loop.film.layers().values()]
    arrays += [*loop.mode.lens.state_dict().values()] if loop.mode.lens is not None else []
    return loop.film.bad_count == bad and all(bool(array.isfinite().all()) for array in arrays)


def beauty(loop: RenderLoop) -> np.ndarray:
    return loop.film.radiance().double().numpy()


def same_light(one: RenderLoop, other: RenderLoop) -> float:
    """p-value of two renders having the same mean luminance, by the spread of their steps' means."""
    a, b = FRAMES[one], FRAMES[other]
    t = (np.mean(a) - np.mean(b)) / math.sqrt(np.var(a, ddof=1) / len(a) + np.var(b, ddof=1) / len(b) + 1e-12 * np.mean(b) ** 2)
    return float(2.0 * stats.t.sf(abs(t), len(a) - 1))


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ by more than a thousandth."""
    return float((np.abs(one - other).max(2) > 1e-3 * (one.max(2) + 0.1)).mean())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("mode", MODES)
def test_what_is_no_number_is_named_and_left_out(mode, bad):
    """One sample of a pixel whose lens nobody guides, at step 2; all else of the picture is there."""
    loop = rendered(stage(depth=1), mode, 1)
    trace, pixel = loop.tracer.trace, (HEIGHT - 1) * WIDTH + 3
    key = PixelRandom(SEED, 2, torch.tensor([pixel])).pixel_keys

    def spoilt(origin, direction, random, *others, **named):
        samples = trace(origin, direction, random, *others, **named)
        samples.radiance[:, random.pixel_keys == key] = bad
        return samples

    loop.tracer.trace = spoilt
    loop.step()
    loop.tracer.trace = trace
    loop.step()
    assert loop.film.bad_count == 1 and loop.film.bad_samples == [BadSample(3, HEIGHT - 1, 2, SEED)]
    assert sound(loop, bad=1)
    counts = loop.film.layers()["sample_count"]
    assert counts[HEIGHT - 1, 3] == 2.0 and (counts == 3.0).sum() == counts.size - 1


@pytest.mark.parametrize(("mode", "radius"), [*((mode, 0.0) for mode in MODES), *((mode, 1e-12) for mode in LENS_MODES)])
def test_a_pinhole_is_a_pinhole_in_every_mode(mode, radius):
    """Nothing is guided; a lens so small that no emitter fits on it is none either. Area ReSTIR has its own samples."""
    pinhole = partial(stage, depth=1, aperture_radius=0.0)
    loop = rendered(stage(depth=1, aperture_radius=radius), mode, 16)
    assert sound(loop)
    assert isinstance(loop.mode.lens, UniformLens) or (radius > 0.0 and loop.mode.lens.candidates is None)
    if mode in RESTIR_MODES:
        assert same_light(loop, reference(pinhole)) > SIGNIFICANCE
    else:
        assert changed(beauty(rendered(pinhole(), "uniform", 16)), beauty(loop)) < 0.01


def unfocused(focus: float) -> Scene:
    return stage(depth=1, focus_distance=focus)


FOCUSED_FAR = {focus: partial(unfocused, focus) for focus in (1e8, math.inf)}


@pytest.mark.parametrize(("mode", "focus"), [("lis", 1e8), *((mode, math.inf) for mode in ALL[1:])])
def test_focus_at_infinity(mode, focus):
    loop = rendered(unfocused(focus), mode, 48)
    assert sound(loop)
    assert same_light(loop, reference(FOCUSED_FAR[focus])) > SIGNIFICANCE
    assert len(loop.mode.lens.field) > 0 and 0.0 < loop.step().outside < 1.0


def test_the_limit_of_an_infinite_focus():
    """The lens sees a Gaussian at p, depth Z, in parallel light of slope m: around p - m Z, as wide as it is."""
    focus = 1e12 * torch.tensor([[0.3], [-0.2], [1.0]])
    mean, sigma = torch.tensor([[1.55], [-0.95], [5.0]]), torch.tensor([0.02])
    torch.testing.assert_close(project_to_lens(mean, focus), torch.tensor([[0.05], [0.05]]), rtol=0.0, atol=1e-6)
    points = torch.tensor([[0.05, 0.07, 0.04], [0.05, 0.05, 0.02]])
    rays = (points, focus.expand(3, 3), mean.expand(3, 3), sigma.expand(3))
    axis = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
    axis /= axis.norm()
    offset = torch.cat((points - 0.05, torch.zeros(1, 3))).double()
    across = offset - axis[:, None] * (axis @ offset)
    expected = axis[2] / (2.0 * math.pi * 0.02**2) * torch.exp(-0.5 * across.square().sum(0) / 0.02**2)
    torch.testing.assert_close(lens_density(*rays).double(), expected, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(log_density_gradient(*rays).double(), across / 0.02**2, rtol=1e-3, atol=0.05)


def focused_on_lamps() -> Scene:
    """A ball's centre and a flat emitter exactly in focus, beside emitters that are not."""
    ball = shape(unit_sphere(), 2, (-0.2, 0.1, -2.0), scale=0.03)
    return stage(ball, shape(unit_rectangle(), 2, (0.1, 0.3, -2.0), scale=0.03), depth=1)


@pytest.mark.parametrize("mode", ALL)
def test_lamps_in_the_focal_plane(mode):
    loop = rendered(focused_on_lamps(), mode, 48)
    assert sound(loop)
    assert same_light(loop, reference(focused_on_lamps)) > SIGNIFICANCE
    if loop.mode.lens.learns:
        assert bool(((loop.mode.lens.field.mean[2] - 2.0).abs() > 0.1).all())


@pytest.mark.parametrize("mode", ALL)
def test_a_camera_inside_an_object(mode):
    """Black in what lets no light in, the emitter's own radiance in an emitter that shines inwards, and light through glass."""
    black = rendered(stage(shape(unit_sphere(), 0, scale=0.5)), mode, 2)
    assert sound(black) and not beauty(black).any() and (black.film.layers()["alpha"] == 1.0).all()
    scene = stage(shape(unit_sphere(), 2, scale=0.5), depth=2)
    emitter = replace(scene.materials[2], double_sided=True)
    inside = rendered(replace(scene, materials=(*scene.materials[:2], emitter, scene.materials[3])), mode, 16)
    assert sound(inside)
    # A black emitter that is guided to emitters outside keeps the weights of the guide.
    np.testing.assert_allclose(beauty(inside).mean((0, 1)), (40.0, 30.0, 20.0), rtol=1e-6 if mode == "uniform" else 0.03)
    glass = rendered(stage(shape(unit_sphere(), 3, scale=0.5), depth=2), mode)
    assert sound(glass) and beauty(glass).max() > 1.0


def lamp_across_the_lens() -> Scene:
    """Part of it lies before the lens plane, part behind: depths down to 0."""
    return stage(shape(unit_sphere(), 2, (0.05, 0.0, 0.0), scale=0.02), depth=1)


@pytest.mark.parametrize("mode", ALL)
def test_a_lamp_across_the_lens(mode):
    loop = rendered(lamp_across_the_lens(), mode, 32)
    assert sound(loop)
    assert same_light(loop, reference(lamp_across_the_lens)) > SIGNIFICANCE


@lru_cache
def plain(mode: str, depth: int) -> RenderLoop:
    return rendered(stage(depth=depth), mode, 8)


def same_mean(one: RenderLoop, other: RenderLoop, light: float = 1.0) -> float:
    """p-value of the frames' means, that of the other over `light`, as if they were independent."""
    error = math.sqrt(sum(float(loop.film.variance().double().sum()) / unit**2 for loop, unit in ((one, 1.0), (other, light))))
    off = (other.film.mean_luminance() / light - one.film.mean_luminance()) * WIDTH * HEIGHT
    return float(2.0 * stats.norm.sf(abs(off) / error))


@pytest.mark.parametrize("light", [1e8, 1e-8])
@pytest.mark.parametrize("mode", ALL)
def test_radiance_of_any_size_gives_the_same_picture(mode, light):
    """And so do its squares: the variance, and what the guide weighs."""
    one, other = plain(mode, 1), rendered(stage(light=light, depth=1), mode, 8)
    assert sound(other)
    assert changed(beauty(one), beauty(other) / light) < 0.02
    variances = [float(loop.film.variance().double().mean()) for loop in (one, other)]
    assert variances[1] == pytest.approx(light**2 * variances[0], rel=0.01)
    if mode not in RESTIR_MODES:
        assert same_mean(plain(mode, 3), rendered(stage(light=light), mode, 8), light) > SIGNIFICANCE


@pytest.mark.parametrize("mode", ALL)
def test_a_sun_beyond_what_can_be_squared(mode):
    """Radiance of 4e21: its square is no float32."""
    scene = replace(stage(depth=1), suns=(Sun((0.0, 0.1, -1.0), 1.0, (1e18, 1e18, 1e18)),))
    loop = rendered(scene, mode, 6)
    assert sound(loop) and beauty(loop).max() > 1e20


@pytest.mark.parametrize("mode", ALL)
def test_nothing_that_shines(mode):
    """No light at all, and a black map; alpha tells them apart."""
    dark = without_lamps(stage(depth=2))
    for scene, alpha in ((dark, 0.0), (replace(dark, environment=Environment(DARK)), 1.0)):
        loop = rendered(scene, mode)
        assert sound(loop) and not beauty(loop).any()
        assert loop.film.mean_luminance() == loop.film.relative_noise() == 0.0
        assert loop.film.layers()["alpha"][0, 0] == alpha


@pytest.mark.parametrize("mode", GUIDED)
def test_light_that_comes_after_a_black_step(mode):
    """While the frame is black there is no unit to learn in; afterwards all is as ever."""
    loop = rendered(stage(depth=1), mode, 0)
    trace = loop.tracer.trace

    def unlit(*others, **named):
        samples = trace(*others, **named)
        samples.radiance.zero_()
        return samples

    loop.tracer.trace = unlit
    loop.step()
    loop.tracer.trace = trace
    loop.step()
    assert mode != "guided" or not loop.mode.lens.moments.any()
    for _ in range(14):
        loop.step()
    assert sound(loop)
    other = rendered(stage(depth=1), mode, 16)
    assert beauty(loop).mean() == pytest.approx(beauty(other).mean() * 15 / 16, rel=0.1)
    if mode == "guided":
        guided = loop.mode.lens.candidates.start.diff() > 0
        assert float((loop.mode.lens.beta - other.mode.lens.beta)[guided].abs().mean()) < 0.2


def lit_from(place: tuple[float, float, float]) -> Scene:
    return without_lamps(stage(depth=2), shape(unit_sphere(), 2, place, scale=0.3))


UNSEEN = {place: partial(lit_from, place) for place in ((0.0, 1.0, 3.0), (4.0, 2.0, -2.0))}


@pytest.mark.parametrize("mode", LENS_MODES)
@pytest.mark.parametrize("place", UNSEEN)
def test_the_only_lamp_is_out_of_sight(mode, place):
    """Behind the camera, or beside the frame."""
    loop = rendered(lit_from(place), mode, 24)
    assert sound(loop) and beauty(loop).mean() > 0.0
    assert same_light(loop, reference(UNSEEN[place])) > SIGNIFICANCE


def through(radius: float) -> Scene:
    return stage(aperture_radius=radius, depth=1)


WIDE = {radius: partial(through, radius) for radius in (20.0, 1e12)}


@pytest.mark.parametrize("mode", ALL)
@pytest.mark.parametrize("radius", WIDE)
def test_a_lens_larger_than_the_scene(mode, radius):
    loop = rendered(through(radius), mode, 24)
    assert sound(loop)
    assert same_light(loop, reference(WIDE[radius])) > SIGNIFICANCE


SIZES = [(mode, size) for mode in ALL for size in (0.01, 100.0)] + [
    (mode, size) for mode in ("lis-o", "guided") for size in (1e-4, 1e5)
]


@pytest.mark.parametrize(("mode", "size"), SIZES)
def test_the_scenes_size_changes_nothing(mode, size):
    """Direct emission agrees to rounding, other light in the mean: triangles of an emitter join clusters by rounding."""
    one, other = plain(mode, 1), rendered(stage(size=size, depth=1), mode, 8)
    assert sound(other)
    assert changed(beauty(one), beauty(other)) < 0.01
    depths = [np.where(layer < 1e9, layer, 0.0) for layer in (loop.film.layers()["depth"] for loop in (one, other))]
    np.testing.assert_allclose(depths[1], size * depths[0], rtol=1e-2, atol=1e-3 * size)
    if one.mode.lens.learns:
        torch.testing.assert_close(other.mode.lens.field.mean, size * one.mode.lens.field.mean, rtol=1e-3, atol=1e-3 * size)
    if mode not in RESTIR_MODES:
        assert same_mean(plain(mode, 3), rendered(stage(size=size), mode, 8)) > SIGNIFICANCE
