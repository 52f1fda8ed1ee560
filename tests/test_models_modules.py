"""The modules that learn: state dicts, bounds, memory, and what an Adam step moves."""

from __future__ import annotations

import pytest
import torch
from lens_cases import grid, histogram_check, seen_by_pixel
from statistical import SIGNIFICANCE
from test_models_reference import CAMERA, scattered_field

from bokehguide.models.blend_weight import HIGHEST, LOWEST, BlendWeightMap
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.render.camera import ThinLensCamera
from bokehguide.train import RenderSettings
from bokehguide.train.guide import BLEND_RATE, BatchLesson, LensGuide

WIDTH, HEIGHT = 32, 18


def camera() -> ThinLensCamera:
    return ThinLensCamera(CAMERA, WIDTH, HEIGHT)


def reloaded(module: torch.nn.Module, fresh: torch.nn.Module, path) -> torch.nn.Module:
    """`fresh` with the state of `module`, by way of a file."""
    torch.save(module.state_dict(), path)
    fresh.load_state_dict(torch.load(path, weights_only=True))
    assert fresh.state_dict().keys() == module.state_dict().keys()
    for name, value in module.state_dict().items():
        assert torch.equal(fresh.state_dict()[name], value), name
    return fresh


def frozen_guide(seed: int = 1) -> LensGuide:
    """A lis-o guide with three frozen spots that many pixels see, and random offsets and β."""
    guide = LensGuide(camera(), RenderSettings("lis-o"))
    mean = torch.tensor([[0.1, -0.4, 0.05], [0.05, 0.2, -0.1], [5.0, 6.0, 1.2]])
    radius = torch.tensor([0.06, 0.1, 0.02])
    guide.field.assign(mean, radius, 0.5 * radius, torch.tensor([1.0, 2.0, 0.5]))
    guide.freeze()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        guide.offsets.coefficients.copy_(0.3 * torch.randn(guide.offsets.coefficients.shape, generator=generator))
        guide.blend.logit.copy_(torch.randn(guide.blend.logit.shape, generator=generator))
    return guide


def test_gaussian_field_round_trip(tmp_path):
    field = scattered_field(7, seed=2)
    fresh = reloaded(field, GaussianField(), tmp_path / "field.pt")
    assert len(fresh) == 7
    assert torch.equal(fresh.lens_weights(2.0), field.lens_weights(2.0))


def test_gaussian_field_refuses_what_is_no_gaussian():
    field, one = GaussianField(), torch.ones(1)
    mean = torch.tensor([[0.0], [0.0], [5.0]])
    for arguments in ((mean * float("nan"), one, one, one), (mean, -one, one, one), (mean, one, 0.0 * one, one)):
        with pytest.raises(ValueError, match="finite means and positive"):
            field.assign(*arguments)


def test_blend_weight_map_round_trip(tmp_path):
    blend = BlendWeightMap(100)
    with torch.no_grad():
        blend.logit.normal_(generator=torch.Generator().manual_seed(3))
    fresh = reloaded(blend, BlendWeightMap(100), tmp_path / "blend.pt")
    assert torch.equal(fresh(slice(10, 20)), blend(slice(10, 20)))


def test_polynomial_offset_round_trip(tmp_path):
    field = scattered_field(7, seed=2)
    offsets = PolynomialOffset(field, camera())
    with torch.no_grad():
        offsets.coefficients.normal_(generator=torch.Generator().manual_seed(4))
    fresh = reloaded(offsets, PolynomialOffset(field, camera()), tmp_path / "offsets.pt")
    gaussian, raster = torch.arange(7), torch.rand(2, 7) * WIDTH
    assert torch.equal(fresh(gaussian, raster), offsets(gaussian, raster))


@pytest.mark.parametrize("mode", ["lis", "lis-b", "lis-o"])
def test_lens_guide_round_trip(mode, tmp_path):
    """A fresh guide that loads the state draws from the same densities."""
    guide = LensGuide(camera(), RenderSettings(mode))
    guide.field = scattered_field(5, seed=2)
    if mode == "lis-o":
        guide = frozen_guide()
    else:
        guide.set_candidates()
    fresh = reloaded(guide, LensGuide(camera(), RenderSettings(mode)), tmp_path / "guide.pt")
    raster = torch.rand(2, WIDTH * HEIGHT) * torch.tensor([[WIDTH], [HEIGHT]])
    focus = guide.camera.focus_points(raster)
    points = 0.1 * torch.randn(2, WIDTH * HEIGHT)
    old, new = (one.distribution(slice(0, WIDTH * HEIGHT), raster, focus).distribution.pdf(points) for one in (guide, fresh))
    assert torch.equal(old, new)


def test_blend_weight_starts_at_0_8_and_keeps_its_bounds():
    blend = BlendWeightMap(3)
    torch.testing.assert_close(blend(), torch.full((3,), 0.8))
    with torch.no_grad():
        blend.logit.copy_(torch.tensor([-1e4, 0.0, 1e4]))
    torch.testing.assert_close(blend(), torch.tensor([LOWEST, 0.5, HIGHEST]))
    assert (LOWEST, HIGHEST) == (0.05, 0.95)


def test_blend_weight_takes_12_bytes_a_pixel_with_its_optimiser():
    guide = LensGuide(camera(), RenderSettings("lis-b"))
    pixels = slice(0, WIDTH * HEIGHT)
    guide.update(1, [BatchLesson(0.0, pixels, torch.ones(WIDTH * HEIGHT), None)], 1.0)
    logit = guide.blend.logit
    assert (logit < BlendWeightMap(1).logit).all(), "the gradient was followed"
    assert logit.grad is None
    tensors = [logit, *(value for value in guide.optimizers["blend"].state[logit].values() if value.numel() > 1)]
    assert sum(tensor.numel() * tensor.element_size() for tensor in tensors) == 12 * WIDTH * HEIGHT


def test_adam_moves_beta_where_there_was_light_and_never_without_candidates():
    guide = LensGuide(camera(), RenderSettings("lis-b"))
    pixels = WIDTH * HEIGHT
    guide.field.assign(torch.tensor([[0.0], [0.0], [1.0]]), torch.tensor([0.02]), torch.tensor([0.01]), torch.tensor([1.0]))
    guide.set_candidates()
    guide.refit = lambda mean_luminance: None
    before = guide.blend.logit.detach().clone()
    raster = torch.stack((torch.arange(pixels) % WIDTH, torch.arange(pixels) // WIDTH)) + 0.5
    batch = guide.distribution(slice(0, pixels), raster, guide.camera.focus_points(raster))
    mixture = batch.distribution
    for step in (2, 3, 4):
        points = mixture.sample(torch.rand(5, pixels, generator=torch.Generator().manual_seed(step)))
        at = mixture.evaluate(points)
        ratio = mixture.lens.contains(points) / (mixture.lens.area * at.density)
        guide.update(step, [guide.study(batch, ratio, at)], 1.0)
        if step == 2:
            moved = (guide.blend.logit.detach() - before).abs()
            learns = mixture.guided & (ratio > 0.0)
            torch.testing.assert_close(moved[learns], torch.full_like(moved[learns], BLEND_RATE), rtol=1e-3, atol=1e-4)
            assert not moved[~learns].any()
    counts = guide.candidates.counts()
    assert 20 < int((counts == 0).sum()) < pixels - 20
    assert torch.equal(guide.blend.logit.detach()[counts == 0], before[counts == 0])


def test_draws_follow_the_density_with_offsets():
    guide = frozen_guide()
    case = seen_by_pixel(guide, 9 * WIDTH + 17)
    assert len(case.weight) > 1
    pixel = slice(9 * WIDTH + 17, 9 * WIDTH + 18)
    shifts = torch.tensor(case.mean) - guide.field.mean[:, guide.candidates.batch(pixel)[1]]
    assert float(shifts.abs().min()) > 1e-4
    cells = grid(case)
    observed = cells.count(case.draw(1_000_000, seed=5))
    assert histogram_check(observed, cells.integrate(case.pdf)) > SIGNIFICANCE
