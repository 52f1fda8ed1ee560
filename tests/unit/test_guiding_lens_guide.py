"""`LensGuide`: distributions in the form of torch.distributions, state, errors, and the example of another renderer."""

from __future__ import annotations

import math
import runpy
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide import BokehguideError, Camera, LensGuide
from bokehguide.scene import Aperture
from tests.support.paths import REPOSITORY
from tests.support.statistical import SIGNIFICANCE, block_means, chi_square, z_test

EXAMPLE = runpy.run_path(str(REPOSITORY / "examples/guide_your_renderer.py"))
CAMERA = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.3, focus_distance=2.0)
WIDTH, HEIGHT = 24, 16
LAMP, LAMP_RADIUS = torch.tensor((0.6, 0.3, 6.0)), 0.25
"""A lamp behind the focal plane, camera frame."""


def raster(shift: float = 0.5) -> torch.Tensor:
    row, column = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return torch.stack((column.flatten(), row.flatten()), dim=1) + shift


def trace(guide: LensGuide, places: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Luminance and distance of the lamp, a sphere of radiance 50 on black, along rays from lens points `[..., N, 2]`."""
    focus = guide.camera.focus_points(places.T).T
    origins = torch.nn.functional.pad(points * guide.camera.lens.radius, (0, 1))
    directions = torch.nn.functional.normalize(focus - origins, dim=-1)
    towards = LAMP - origins
    along = (towards * directions).sum(-1)
    inside = LAMP_RADIUS**2 - (towards**2).sum(-1) + along**2
    distance = torch.where(inside > 0.0, along - inside.clamp(min=0.0).sqrt(), torch.inf)
    return 50.0 * (inside > 0.0), distance


def step(guide: LensGuide, generator: torch.Generator, samples: tuple[int, ...] = ()) -> torch.Tensor:
    """One step with `samples` for each pixel; returns the weighted luminance `[*samples, N]`."""
    places = raster(0.0) + torch.rand(WIDTH * HEIGHT, 2, generator=generator)
    lens = guide.distribution(places)
    points = lens.sample(uniforms=torch.rand(*samples, WIDTH * HEIGHT, 5, generator=generator))
    light, distance = trace(guide, places, points)
    guide.observe(points, distance, light)
    guide.update()
    return lens.weight(points) * light


def trained(steps: int = 12, camera: Camera = CAMERA) -> LensGuide:
    guide, generator = LensGuide(camera, WIDTH, HEIGHT), torch.Generator().manual_seed(2)
    for _ in range(steps):
        step(guide, generator)
    return guide


@pytest.fixture(scope="module")
def guide() -> LensGuide:
    return trained()


def test_the_guide_finds_the_lamp(guide):
    assert guide.highlights == 1 and guide.step == 12
    np.testing.assert_allclose(guide._guide.field.mean[:, 0], LAMP, atol=0.3)
    assert guide.distribution(raster()).mixture is not None


@pytest.mark.parametrize("aperture", [None, Aperture(blades=5, rotation=20.0)])
def test_draws_follow_the_density(aperture):
    """Chi-square over a grid on the lens plane and the rest of the plane, in a pixel whose lens sees the lamp."""
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov=40.0, aperture_radius=0.3, focus_distance=2.0, aperture=aperture)
    guide = trained(camera=camera)
    lens = guide.distribution(raster())
    assert lens.mixture is not None
    pixel = int(
        torch.where(lens.mixture.guided, 1.0 - (guide.camera.raster(LAMP[:, None]) - raster().T).norm(dim=0), -1e9).argmax()
    )
    draws, cells, fine = 200_000, 24, 24
    one = guide.distribution(raster()[pixel].expand(draws, 2))
    generator = torch.Generator().manual_seed(1)
    points = one.sample(uniforms=torch.rand(draws, 5, generator=generator)).double().numpy()
    edges = np.linspace(-1.5, 1.5, cells + 1)
    observed = np.histogram2d(*points.T, bins=(edges, edges))[0]
    places = (np.arange(cells * fine) + 0.5) / (cells * fine) * 3.0 - 1.5
    x, y = np.meshgrid(places, places, indexing="ij")
    grid = torch.from_numpy(np.stack((x.ravel(), y.ravel()), axis=1)).float()
    density = guide.distribution(raster()[pixel].expand(len(grid), 2)).log_prob(grid).exp().double().numpy().reshape(x.shape)
    probability = density.reshape(cells, fine, cells, fine).sum((1, 3)) * (3.0 / (cells * fine)) ** 2
    # The rim of the aperture crosses cells, where the midpoint rule errs by less than the count's own deviation.
    assert probability.sum() == pytest.approx(observed.sum() / draws, abs=5.0 / math.sqrt(draws))
    rest = [[draws - observed.sum()], [max(1.0 - probability.sum(), 0.0)]]
    counts, shares = (np.append(values.ravel(), more) for values, more in zip((observed, probability), rest))
    inner = np.hypot(*np.meshgrid(edges, edges, indexing="ij"))
    rim = (np.minimum.reduce([inner[:-1, :-1], inner[1:, :-1], inner[:-1, 1:], inner[1:, 1:]]) < 1.0) & (
        np.maximum.reduce([inner[:-1, :-1], inner[1:, :-1], inner[:-1, 1:], inner[1:, 1:]]) > 0.75
    )
    rim = np.append(rim.ravel(), False)
    pooled = [np.append(values[~rim], values[rim].sum()) for values in (counts, shares)]
    assert chi_square(pooled[0], pooled[1] / pooled[1].sum()) > SIGNIFICANCE
    assert chi_square(pooled[0][::-1], pooled[1] / pooled[1].sum()) < SIGNIFICANCE


def test_the_density_integrates_to_one(guide):
    """Over the plane, in polar coordinates with a radius of tan, in pixels near the lamp's bokeh and far from it."""
    size = 400
    r, angle = torch.meshgrid((torch.arange(size) + 0.5) / size, (torch.arange(size) + 0.5) / size * 2.0 * math.pi, indexing="ij")
    radius = (r * math.pi / 2.0).tan().flatten().double()
    area = radius * (1.0 + radius**2) * math.pi / 2.0 / size * 2.0 * math.pi / size
    points = torch.stack((radius * angle.flatten().cos(), radius * angle.flatten().sin()), dim=1).float()
    for pixel in (0, WIDTH * (HEIGHT // 2) + WIDTH // 2, WIDTH * 5 + 15):
        density = guide.distribution(raster()[pixel].expand(len(points), 2)).log_prob(points).exp().double()
        assert float((density * area).sum()) == pytest.approx(1.0, abs=5e-3)


def test_the_form_of_torch_distributions(guide):
    lens = guide.distribution(raster())
    assert isinstance(lens, torch.distributions.Distribution)
    assert lens.batch_shape == (WIDTH * HEIGHT,) and lens.event_shape == (2,)
    points = lens.sample((3, 2))
    assert points.shape == (3, 2, WIDTH * HEIGHT, 2)
    assert lens.log_prob(points).shape == lens.weight(points).shape == (3, 2, WIDTH * HEIGHT)
    uniforms = torch.rand(3, 2, WIDTH * HEIGHT, 5)
    whole = lens.sample(uniforms=uniforms)
    torch.testing.assert_close(whole[2, 1], lens.sample(uniforms=uniforms[2, 1]), rtol=0, atol=0)
    torch.testing.assert_close(lens.log_prob(whole)[1, 0], lens.log_prob(whole[1, 0]), rtol=0, atol=0)


def test_weights_are_one_over_the_density_within_the_aperture(guide):
    lens = guide.distribution(raster())
    points = lens.sample((50,))
    within = (points.norm(dim=-1) < 1.0).float()
    assert 0.0 < float(within.mean()) < 1.0
    torch.testing.assert_close(lens.weight(points) * math.pi * lens.log_prob(points).exp(), within)


def test_before_the_first_update_the_lens_is_uniform():
    lens = LensGuide(CAMERA, WIDTH, HEIGHT).distribution(raster())
    points = lens.sample((100,))
    assert float(points.norm(dim=-1).max()) <= 1.0
    np.testing.assert_allclose(lens.log_prob(points), -math.log(math.pi), atol=1e-5)
    np.testing.assert_allclose(lens.weight(points), 1.0, atol=1e-5)
    outside = torch.full((WIDTH * HEIGHT, 2), 0.8)
    assert not lens.weight(outside).any() and bool(lens.log_prob(outside).isneginf().all())


def test_where_the_lens_barrel_blocks_the_weight_is_0():
    camera = replace(CAMERA, aperture=Aperture(cat_eye=1.0))
    places = raster()
    lens = LensGuide(camera, WIDTH, HEIGHT).distribution(places)
    points = lens.sample((100,))
    centre = (places - torch.tensor([0.5 * WIDTH, 0.5 * HEIGHT])) * torch.tensor([1.0, -1.0]) / (0.5 * math.hypot(WIDTH, HEIGHT))
    distance = (points + centre).norm(dim=-1)
    clear = (distance - 1.0).abs() > 1e-3
    assert 0.1 < float((distance > 1.0).float().mean()) < 0.6
    torch.testing.assert_close(lens.weight(points)[clear], (distance < 1.0).float()[clear], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_means_agree_with_the_uniform_lens_while_the_guide_learns():
    """Blocks of 4 × 4 pixels, and the frame; an error of a tenth would fail. The guided variance is several times lower."""
    guide, uniform = LensGuide(CAMERA, WIDTH, HEIGHT), LensGuide(CAMERA, WIDTH, HEIGHT)
    generator, places = torch.Generator().manual_seed(5), torch.Generator().manual_seed(6)
    guided = torch.stack([step(guide, generator) for _ in range(256)]).double().numpy()
    at = raster(0.0) + torch.rand(2048, WIDTH * HEIGHT, 2, generator=places)
    points = uniform.distribution(raster()).sample((2048,))
    even = torch.stack([trace(uniform, place, point)[0] for place, point in zip(at, points)]).double().numpy()
    means = [samples.mean(0).reshape(HEIGHT, WIDTH) for samples in (guided, even)]
    errors = [samples.var(0, ddof=1).reshape(HEIGHT, WIDTH) / len(samples) for samples in (guided, even)]
    difference, variance = block_means(means[0] - means[1], 4), block_means(errors[0] + errors[1], 4) / 16.0
    assert z_test(difference, np.sqrt(variance)) > SIGNIFICANCE
    whole, error = difference.mean(), math.sqrt(variance.mean() / variance.size)
    assert z_test(whole, error) > SIGNIFICANCE
    assert z_test(whole + 0.1 * means[1].mean(), error) < SIGNIFICANCE
    assert guided[32:].var(0).mean() < 0.35 * even.var(0).mean()


def test_parts_of_a_frame_and_several_samples():
    """Two halves of the frame teach as the whole frame does, and several samples a pixel teach as well."""
    whole, halves = trained(3), LensGuide(CAMERA, WIDTH, HEIGHT)
    generator = torch.Generator().manual_seed(2)
    for _ in range(3):
        places = raster(0.0) + torch.rand(WIDTH * HEIGHT, 2, generator=generator)
        uniforms = torch.rand(WIDTH * HEIGHT, 5, generator=generator)
        for part in (slice(0, 100), slice(100, None)):
            lens = halves.distribution(places[part])
            points = lens.sample(uniforms=uniforms[part])
            light, distance = trace(halves, places[part], points)
            halves.observe(points, distance, light)
        halves.update()
    expected = whole.distribution(raster()).log_prob(torch.zeros(WIDTH * HEIGHT, 2))
    torch.testing.assert_close(
        halves.distribution(raster()).log_prob(torch.zeros(WIDTH * HEIGHT, 2)), expected, rtol=1e-4, atol=1e-4
    )
    several, generator = LensGuide(CAMERA, WIDTH, HEIGHT), torch.Generator().manual_seed(3)
    for _ in range(3):
        step(several, generator, (4,))
    assert several.highlights == 1


def test_a_state_continues(guide):
    other = LensGuide(CAMERA, WIDTH, HEIGHT)
    other.load_state_dict({**guide.state_dict()})
    again, pictures = trained(), []
    for each in (again, other):
        generator = torch.Generator().manual_seed(9)
        pictures.append([step(each, generator) for _ in range(3)])  # the second step shows whether Adam continued
    torch.testing.assert_close(*pictures, rtol=0, atol=0)
    torch.testing.assert_close(again._guide.blend_weights(), other._guide.blend_weights(), rtol=0, atol=0)
    assert other.step == 15 and other.mean_luminance > 0.0
    with pytest.raises(BokehguideError, match=r"LensGuide\.load_state_dict: not a state of this guide"):
        LensGuide(CAMERA, 8, 8).load_state_dict(guide.state_dict())
    with pytest.raises(BokehguideError, match=r"LensGuide\.load_state_dict: not a state of this guide"):
        LensGuide(CAMERA, 8, 8).load_state_dict({})


def test_values_that_are_no_numbers_count_as_black():
    guide = LensGuide(CAMERA, WIDTH, HEIGHT)
    points = guide.distribution(raster()).sample()
    light, distance = torch.full((WIDTH * HEIGHT,), math.nan), torch.full((WIDTH * HEIGHT,), math.nan)
    guide.observe(points, distance, light)
    guide.update()
    assert guide.mean_luminance == 0.0 and guide.highlights == 0


def test_arrays_of_numpy_are_taken():
    guide = LensGuide(CAMERA, WIDTH, HEIGHT)
    points = guide.distribution(raster().numpy().astype(np.float64)).sample().numpy()
    guide.observe(points, np.full(len(points), np.inf), np.ones(len(points)))
    guide.update()
    assert guide.mean_luminance == pytest.approx(1.0)


def test_wrong_calls_are_named():
    guide = LensGuide(CAMERA, WIDTH, HEIGHT)
    none = torch.zeros(0)
    with pytest.raises(BokehguideError, match="pinhole with one lens point"):
        LensGuide(Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)), WIDTH, HEIGHT)
    with pytest.raises(BokehguideError, match=r"LensGuide\.observe: no distribution yet"):
        guide.observe(none, none, none)
    with pytest.raises(BokehguideError, match=r"LensGuide\.update: nothing was observed"):
        guide.update()
    with pytest.raises(BokehguideError, match=r"raster has shape \(2, 3\), not \(N, 2\)"):
        guide.distribution(torch.zeros(2, 3))
    with pytest.raises(BokehguideError, match=r"positions outside the 24 × 16 pixels"):
        guide.distribution(torch.tensor([[24.5, 1.0]]))
    lens = guide.distribution(raster())
    with pytest.raises(BokehguideError, match=r"luminance has shape \(3,\), not \(384,\)"):
        guide.observe(lens.sample(), torch.zeros(384), torch.zeros(3))
    with pytest.raises(BokehguideError, match=r"sample: uniforms: has shape \(384, 2\), not \(\.\.\., 384, 5\)"):
        lens.sample(uniforms=torch.zeros(384, 2))


def test_values_out_of_range_are_refused_and_change_nothing():
    guide = LensGuide(CAMERA, WIDTH, HEIGHT)
    lens = guide.distribution(raster())
    points, one = lens.sample(), torch.ones(WIDTH * HEIGHT)
    bad = one.clone()
    bad[7:9] = -2.0
    for values, told in [
        ((points, one, bad), "LensGuide.observe: luminance: 2 values are out of range, such as -2; give 0 or more"),
        ((points, bad, one), "LensGuide.observe: distances: 2 values are out of range, such as -2; give 0 or more"),
        (
            (points * math.nan, one, one),
            "LensGuide.observe: points: 768 values are out of range, such as nan; give finite numbers",
        ),
        (("a", one, one), "LensGuide.observe: points: a str is no array of numbers; give one"),
    ]:
        with pytest.raises(BokehguideError) as error:
            guide.observe(*values)
        assert str(error.value) == told
    with pytest.raises(BokehguideError, match=r"nothing was observed"):
        guide.update()
    assert guide.mean_luminance == 1.0
    for number in (math.nan, -0.1, 1.1):
        with pytest.raises(BokehguideError, match=r"uniforms: 1920 values are out of range, such as .*; give from 0 to 1"):
            lens.sample(uniforms=torch.full((WIDTH * HEIGHT, 5), number))


def test_values_of_another_type_are_named(guide):
    with pytest.raises(BokehguideError, match="LensGuide: camera: a NoneType is no Camera; give one"):
        LensGuide(None, 48, 27)
    with pytest.raises(BokehguideError, match="LensGuide: config: a int is no GaussianConfig; give one"):
        LensGuide(CAMERA, 48, 27, 3)
    with pytest.raises(BokehguideError, match=r"LensGuide\.distribution: raster: a str is no array of numbers; give one"):
        guide.distribution("x")
    with pytest.raises(BokehguideError, match=r"LensGuide\.load_state_dict: not a state"):
        LensGuide(CAMERA, WIDTH, HEIGHT).load_state_dict(None)


def test_the_example(capsys, tmp_path):
    EXAMPLE["main"](["--spp", "2", "--width", "32", "--out", str(tmp_path / "new")])
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == ["uniform", "guided"]
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"uniform.png", "guided.png"}


@pytest.mark.slow
def test_the_guided_picture_of_the_example_has_the_lower_error(capsys):
    EXAMPLE["main"](["--spp", "16", "--width", "128"])
    uniform, guided = (float(line.split()[2]) for line in capsys.readouterr().out.splitlines())
    assert guided < 0.7 * uniform


@pytest.mark.slow
def test_the_means_of_the_example_agree():
    """Guided and uniform pictures of the toy renderer: z-tests of blocks, from eight pictures each."""
    toy = EXAMPLE["ToyRenderer"](96, 54)
    pictures = {
        guided: np.stack([EXAMPLE["render"](toy, spp, guided, seed)[:48].mean(2) for seed in range(8)])
        for guided, spp in ((True, 16), (False, 128))
    }
    blocks = {guided: np.stack([block_means(each, 24) for each in found]) for guided, found in pictures.items()}
    difference = blocks[True].mean(0) - blocks[False].mean(0)
    variance = sum(each.var(0, ddof=1) / len(each) for each in blocks.values())
    assert z_test(difference / 2.0, np.sqrt(variance)) > SIGNIFICANCE  # eight pictures underestimate the variance at times
