"""Agreement of the native core and PyTorch on mixtures of shapes on the lens, and on the reuse of primary hits."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from bokehguide.guiding.config import GuidedConfig
from bokehguide.guiding.emitter_guide import EmitterGuide
from bokehguide.guiding.light_sampler import LearnedLightSampler, LightSamples
from bokehguide.guiding.pixel_reuse import PixelPathReuse, PixelReuse
from bokehguide.models.ellipse_mixture import EllipseMixture, EmitterShapes, balls, packed
from bokehguide.models.emitters.parallelogram import ParallelogramEmitters
from bokehguide.models.native_mixture import CoreField, NativeEllipseMixture
from bokehguide.models.projection import FAR_OUTSIDE
from bokehguide.render.camera import ThinLensCamera
from bokehguide.runtime import native
from bokehguide.runtime.timer import PhaseTimer
from bokehguide.scene import Overrides, load_scene
from bokehguide.scene.types import Aperture, Camera
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.guides import mixture_of, pixel_batch, pytorch_mixture
from tests.support.lens_emitters import crowd, pole
from tests.support.native_cases import core, each_instruction_set, feature_scene
from tests.support.sharing_cases import step_of, terrace

WIDTH, HEIGHT = 64, 36
STEPS = 5
HEPTAGON = Aperture(blades=7, rotation=20.0, ratio=1.4, cat_eye=0.6)
MIXTURES = ("fairy-lights", "night-street", "emitters", "emitters, heptagon", "crowd", "zenith", "nadir")
REUSE = (
    "terrace",
    "sheets",
    "textures",
    "coats",
    "layers",
    "films",
    "lamps",
    "lamps from below",
    "suns",
    "hidden sky",
    "emitters, heptagon",
)


@cache
def loop_of(name: str) -> RenderLoop:
    """A loop that has learned for some steps in the native core."""
    core()
    name, _, aperture = name.partition(", ")
    if name == "terrace":
        scene = terrace(WIDTH, HEIGHT)
    elif name == "emitters":
        scene = scenes.emitters(WIDTH, HEIGHT)
    elif name == "crowd":
        scene = crowd(WIDTH, HEIGHT)
    elif name in ("zenith", "nadir"):
        scene = pole(WIDTH, HEIGHT, 50.0 if name == "zenith" else -50.0)
    elif name in ("fairy-lights", "night-street"):
        scene = load_scene(name, Overrides(width=WIDTH, height=HEIGHT))
    else:
        name, below = name.removesuffix(" from below"), name.endswith(" from below")
        film = replace(feature_scene(name).film, width=WIDTH, height=HEIGHT)
        eye, target = ((0.0, 0.5, 2.3), (0.3, 1.8, 0.2)) if below else ((0.0, 1.0, 2.9), (0.0, 0.5, 0.0))
        camera = Camera(eye, target, fov=45.0, aperture_radius=0.1, focus_distance=1.4)
        scene = replace(feature_scene(name), film=film, camera=camera)
    if aperture:
        scene = replace(scene, camera=replace(scene.camera, aperture=HEPTAGON))
    loop = RenderLoop(scene, RenderSettings("guided", threads=1))
    for _ in range(STEPS):
        loop.step()
    return loop


def guide_of(name: str) -> EmitterGuide:
    guide = loop_of(name).mode.lens
    assert isinstance(guide, EmitterGuide)
    return guide


@cache
def both(name: str) -> tuple[NativeEllipseMixture, EllipseMixture]:
    """The mixtures of all pixels in the native core and in PyTorch."""
    guide = guide_of(name)
    batch = pixel_batch(guide)
    found = mixture_of(guide, batch)
    assert isinstance(found, NativeEllipseMixture)
    return found, pytorch_mixture(guide, batch)


def numbers(seed: int) -> Tensor:
    return torch.rand(3, WIDTH * HEIGHT, generator=torch.Generator().manual_seed(seed)).clamp(1e-6, 1.0 - 1e-6)


def differing(found: Tensor, expected: Tensor, tolerance: float) -> float:
    """Share of entries that differ by more than a relative tolerance."""
    return float(((found - expected).abs() > tolerance * expected.abs() + 1e-30).double().mean())


@pytest.mark.parametrize("name", MIXTURES)
def test_shapes_and_weights_agree(name):
    found, expected = both(name)
    assert len(expected.weight) > 1000 or name.startswith("emitters")
    assert torch.equal(found.guided, expected.guided) and torch.equal(found.beta, expected.beta)
    assert torch.equal(found.owner, expected.owner)
    for field in ("expected_contribution", "weight"):
        assert differing(getattr(found, field), getattr(expected, field), 1e-4) <= 2e-3, field
        assert differing(getattr(found, field), getattr(expected, field), 1e-2) == 0.0, field


@pytest.mark.parametrize("name", MIXTURES)
def test_lens_points_agree(name):
    found, expected = both(name)
    radius, drawn = found.lens.radius, 0
    for seed in range(8):
        one, other = found.sample(numbers(seed)), expected.sample(numbers(seed))
        assert one.candidate is not None and other.candidate is not None
        assert (one.candidate != other.candidate).double().mean() <= 1e-3
        same = one.candidate == other.candidate
        off = (one.points - other.points)[:, same].abs().amax(0) > 1e-4 * radius
        assert off.double().mean() <= 1e-3
        drawn += int((other.candidate >= 0).sum())
    assert drawn > 1000


@pytest.mark.parametrize("name", MIXTURES)
def test_densities_agree(name):
    """At lens points of the mixture, and at points anywhere on the lens plane."""
    found, expected = both(name)
    anywhere = found.lens.radius * 1.2 * (2.0 * numbers(9)[:2] - 1.0)
    for points in (expected.sample(numbers(3)).points, expected.sample(numbers(4)).points, anywhere):
        one, other = found.evaluate(points), expected.evaluate(points)
        for field in ("components", "mixture", "density"):
            assert differing(getattr(one, field), getattr(other, field), 1e-3) <= 3e-3, field
        assert torch.equal(found.pdf(points), one.density)


PIXELS, CANDIDATES = 50, 600


def many_candidates() -> tuple[ThinLensCamera, Tensor, Tensor, Tensor, Tensor, torch.Generator]:
    """Camera, focus points of pixels, first candidate of each pixel, pixel of each candidate, and uniform numbers."""
    camera, generator = loop_of("emitters").camera, torch.Generator().manual_seed(6)
    uniforms = torch.rand(7, CANDIDATES, generator=generator)
    focus = camera.focus_points(uniforms[:2, :PIXELS] * torch.tensor([[float(WIDTH)], [float(HEIGHT)]]))
    owner = torch.arange(CANDIDATES) // (CANDIDATES // PIXELS)
    start = torch.arange(0, CANDIDATES + 1, CANDIDATES // PIXELS)
    return camera, focus, start, owner, uniforms, generator


@pytest.mark.parametrize("clips", (False, True))
def test_ellipsoids_that_cross_the_focal_plane_agree(clips):
    """Ellipsoids that are longer than their distance from the focal plane, in all directions, and lines."""
    camera, focus, start, owner, uniforms, generator = many_candidates()
    depth = camera.lens.focus_distance * (1.0 + 0.3 * (uniforms[2] - 0.5))
    focus[:2, 0] = 0.0
    aside = 0.3 * (uniforms[3:5] - 0.5) + focus[:2, owner]
    aside[:, 0] = 0.0  # in the middle of the lens
    mean = torch.cat((aside, depth[None]))
    axes = 0.1 * torch.randn(CANDIDATES, 3, 3, generator=generator)
    axes[0], axes[5::7, :, 1:] = 0.02 * torch.eye(3), 0.0  # a ball, and lines
    outline, weight = packed(axes @ axes.mT), uniforms[5] + 0.1
    assert 50 < int((outline[5] > (mean[2] - focus[2, owner]) ** 2).sum()) < CANDIDATES - 50
    none = torch.full((CANDIDATES,), -1)
    shapes, beta, scale = EmitterShapes(None, none, None, none, torch.empty(0)), torch.full((PIXELS,), 0.5), uniforms[6]
    field = CoreField.of(core(), mean, outline, weight, shapes)
    found = NativeEllipseMixture(camera.lens, focus, beta, start, field, torch.arange(CANDIDATES), scale, clips)
    expected = EllipseMixture(camera.lens, focus, beta, start, mean, outline, weight, scale, None, clips)
    for name in ("expected_contribution", "weight"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-7)
    points = camera.lens.radius * (2.0 * torch.rand(2, PIXELS, generator=generator) - 1.0)
    one, other = found.evaluate(points).components, expected.evaluate(points).components
    assert differing(one, other, 1e-3) <= 5e-3 and int((other > 0.0).sum()) > 50


def test_parallelograms_whose_planes_cut_the_lens_agree():
    """Ranges of their coordinates have no end. Rays from some lens points meet these planes from behind."""
    camera, focus, start, owner, uniforms, generator = many_candidates()
    eye = torch.cat((2.0 * camera.lens.radius * (uniforms[3:5] - 0.5), torch.zeros(1, CANDIDATES)))
    ray = focus[:, owner] - eye  # from lens points
    centre = focus[:, owner] + uniforms[2] * ray + 0.02 * torch.randn(3, CANDIDATES, generator=generator)
    along = 0.3 * ray + 0.01 * torch.randn(3, CANDIDATES, generator=generator)
    parallelograms = ParallelogramEmitters(centre, along, 0.1 * torch.randn(3, CANDIDATES, generator=generator))
    none, each = torch.full((CANDIDATES,), -1), torch.arange(CANDIDATES)
    shapes = EmitterShapes(None, none, parallelograms, each, uniforms[5] + 0.1)
    weight, scale, beta = torch.ones(CANDIDATES), torch.ones(CANDIDATES), torch.full((PIXELS,), 0.5)
    outline = balls(torch.full((CANDIDATES,), 0.3))
    field = CoreField.of(core(), centre, outline, weight, shapes)
    found = NativeEllipseMixture(camera.lens, focus, beta, start, field, each, scale)
    expected = EllipseMixture(camera.lens, focus, beta, start, centre, outline, weight, scale, shapes)
    windows = parallelograms.select(each).window(focus[:, owner], torch.tensor(camera.lens.radius))
    assert int((windows[1, 0] - windows[0, 0] >= 1.0).sum()) > 100
    contribution = expected.expected_contribution
    assert differing(found.expected_contribution[None], contribution[None], 1e-3) <= 5e-3
    assert int((contribution > 0.0).sum()) > 200
    points = camera.lens.radius * (2.0 * torch.rand(2, PIXELS, generator=generator) - 1.0)
    one, other = found.evaluate(points).components, expected.evaluate(points).components
    assert differing(one, other, 1e-3) <= 5e-3 and int((other > 0.0).sum()) > 20
    drawn = [(found.sample(numbers), expected.sample(numbers)) for numbers in torch.rand(200, 3, PIXELS, generator=generator)]
    one, other = (torch.cat([each.points for each in every], dim=1) for every in zip(*drawn))
    unseen = other[0] >= FAR_OUTSIDE
    assert differing(one / camera.lens.radius, other / camera.lens.radius, 1e-3) <= 5e-3
    assert int(unseen.sum()) > 20 and bool((one[0] >= FAR_OUTSIDE).eq(unseen).double().mean() > 0.995)


@pytest.mark.parametrize("name", ("night-street", "emitters, heptagon"))
def test_the_mixture_of_a_pixel_does_not_depend_on_its_batch(name):
    guide, whole = guide_of(name), both(name)[0]
    part = slice(7, WIDTH * HEIGHT - 5)
    alone = mixture_of(guide, pixel_batch(guide, part))
    assert isinstance(alone, NativeEllipseMixture)
    uniforms, every = numbers(5), whole.sample(numbers(5)).points
    points = alone.sample(uniforms[:, part]).points
    assert torch.equal(points, every[:, part])
    assert torch.equal(alone.pdf(points), whole.pdf(every)[part])


def test_all_instruction_sets_give_the_same_bits_of_mixtures():
    guide = guide_of("night-street")

    def results() -> tuple[Tensor, ...]:
        mixture = mixture_of(guide, pixel_batch(guide))
        points = mixture.sample(numbers(6)).points
        return points, mixture.pdf(points), mixture.weight

    first, *others = each_instruction_set(results)
    assert all(torch.equal(one, two) for other in others for one, two in zip(first, other))


@pytest.mark.parametrize("name", REUSE)
def test_reused_samples_agree(name, monkeypatch):
    """Radiance and weights of the pixels of one step, by both forms, from the same primary hits."""
    loop = loop_of(name)
    assert isinstance(loop.mode.reuse, PixelReuse)
    step = step_of(loop, seed=5)
    config = GuidedConfig()
    reuse = PixelPathReuse(loop.camera, loop.tracer, loop.film.width, 5, config.reuse_group, config.min_spread)
    found, rays = reuse.reuse(step.samples, PhaseTimer()), step.samples.paths.rays
    monkeypatch.setattr("bokehguide.guiding.pixel_reuse.native_reuse", lambda *_: None)
    expected = reuse.reuse(step.samples, PhaseTimer())
    assert step.samples.paths.rays - rays > 1000 or name == "hidden sky"
    assert differing(found.weight, expected.weight, 1e-3) <= 2e-3
    assert differing(found.radiance, expected.radiance, 1e-3) <= 4e-3
    assert float((found.weight - step.samples.drawn.weight).abs().max()) > 0.1


@pytest.mark.parametrize("consecutive", (True, False))
def test_sums_of_learning_agree(consecutive, monkeypatch):
    """Sums of light samples and of the control variate, with values that are not finite, and the corrected radiance."""
    loop, generator = loop_of("fairy-lights"), torch.Generator().manual_seed(3)
    lights = loop.mode.lights.sampler
    assert isinstance(lights, LearnedLightSampler) and isinstance(loop.mode.reuse, PixelReuse)
    control, count = deepcopy(loop.mode.reuse.control_variate), WIDTH * HEIGHT - 200
    places = slice(100, 100 + count) if consecutive else torch.randperm(WIDTH * HEIGHT, generator=generator)[:count].sort().values
    radiance, weight = torch.rand(3, count, generator=generator), 3.0 * torch.rand(count, generator=generator)
    radiance[1, 7], weight[8], radiance[2, 9] = torch.nan, torch.inf, -torch.inf
    control.coefficients.copy_(torch.randn(control.coefficients.shape, generator=generator))
    tiles, clusters = lights.probability.shape
    samples = [
        torch.randint(low, high, (count,), generator=generator, dtype=torch.int32) for low, high in ((0, tiles), (-1, clusters))
    ]
    samples += [(8.0 * torch.rand(count, generator=generator)).exp(), torch.rand(count, generator=generator)]
    samples += [torch.randn(count, generator=generator)]
    reflected = torch.randn(count, generator=generator)
    samples[2][:2] = samples[4][:2] = reflected[5:7] = torch.tensor((torch.nan, torch.inf))
    lights.factors.factor.copy_(torch.rand(tiles, generator=generator))
    results = []
    for form in ("1", "0"):
        monkeypatch.setenv(native.SWITCH, form)
        control.mine.zero_(), lights.mine.zero_(), lights.factors.mine.zero_()
        corrected = control.corrected(places, radiance, weight)
        lights.add([lights.batch(LightSamples(*samples), reflected)])
        results.append((corrected, control.mine.clone(), lights.mine.clone(), lights.factors.mine.clone()))
    lights.mine.zero_()
    for found, expected in zip(*results):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9, equal_nan=True)


def test_pytorch_takes_over_where_the_core_is_switched_off(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    with RenderLoop(terrace(WIDTH, HEIGHT), RenderSettings("guided", threads=1)) as loop:
        for _ in range(2):
            loop.step()
        guide = loop.mode.lens
        assert isinstance(guide, EmitterGuide) and isinstance(mixture_of(guide), EllipseMixture)
