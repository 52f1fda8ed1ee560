"""The modules that learn: state dicts, bounds, memory, and the parameters that an Adam step moves."""

from __future__ import annotations

import pytest
import torch

from bokehguide.guiding.config import GaussianConfig
from bokehguide.guiding.gaussian_guide import Gradients
from bokehguide.models.blend_weight import MAX_BLEND, MIN_BLEND, BlendWeightMap
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.polynomial_offset import PolynomialOffset
from tests.support.gaussians import HEIGHT, WIDTH, frozen_guide, scattered_field, small_camera
from tests.support.guides import gaussian_guide, learned_record, mixture_of, mixture_query, pixel_batch, samples_of, summary
from tests.support.lens_cases import grid, histogram_check, seen_by_pixel
from tests.support.statistical import SIGNIFICANCE


def reloaded(module: torch.nn.Module, other: torch.nn.Module, path) -> torch.nn.Module:
    """`other` with the state of `module`, by way of a file."""
    torch.save(module.state_dict(), path)
    other.load_state_dict(torch.load(path, weights_only=True))
    assert other.state_dict().keys() == module.state_dict().keys()
    for name, value in module.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name
    return other


def test_gaussian_field_round_trip(tmp_path):
    field = scattered_field(7, seed=2)
    other = reloaded(field, GaussianField(), tmp_path / "field.pt")
    assert len(other) == 7
    assert torch.equal(other.lens_weights(2.0), field.lens_weights(2.0))


def test_gaussian_field_refuses_invalid_gaussians():
    field, one = GaussianField(), torch.ones(1)
    mean = torch.tensor([[0.0], [0.0], [5.0]])
    for arguments in ((mean * float("nan"), one, one, one), (mean, -one, one, one), (mean, one, 0.0 * one, one)):
        with pytest.raises(ValueError, match="finite means and positive"):
            field.assign(*arguments)


def test_blend_weight_map_round_trip(tmp_path):
    blend = BlendWeightMap(100)
    with torch.no_grad():
        blend.logit.normal_(generator=torch.Generator().manual_seed(3))
    other = reloaded(blend, BlendWeightMap(100), tmp_path / "blend.pt")
    assert torch.equal(other(slice(10, 20)), blend(slice(10, 20)))


def test_polynomial_offset_round_trip(tmp_path):
    field = scattered_field(7, seed=2)
    offsets = PolynomialOffset(field, small_camera())
    with torch.no_grad():
        offsets.coefficients.normal_(generator=torch.Generator().manual_seed(4))
    other = reloaded(offsets, PolynomialOffset(field, small_camera()), tmp_path / "offsets.pt")
    gaussian, raster = torch.arange(7), torch.rand(2, 7) * WIDTH
    assert torch.equal(other(gaussian, raster), offsets(gaussian, raster))


@pytest.mark.parametrize("mode", ["lis", "lis-b", "lis-o"])
def test_lens_guide_round_trip(mode, tmp_path):
    """A new guide that loads the state draws from the same densities."""
    guide = gaussian_guide(small_camera(), mode)
    guide.field = scattered_field(5, seed=2)
    if mode == "lis-o":
        guide = frozen_guide()
    else:
        guide.set_candidates()
    other = reloaded(guide, gaussian_guide(small_camera(), mode), tmp_path / "guide.pt")
    batch = pixel_batch(guide, raster=torch.rand(2, WIDTH * HEIGHT) * torch.tensor([[WIDTH], [HEIGHT]]))
    points = 0.1 * torch.randn(2, WIDTH * HEIGHT)
    old, new = (mixture_of(each, batch).pdf(points) for each in (guide, other))
    assert torch.equal(old, new)


def test_blend_weight_starts_at_0_8_and_keeps_its_bounds():
    blend = BlendWeightMap(3)
    torch.testing.assert_close(blend(), torch.full((3,), 0.8))
    with torch.no_grad():
        blend.logit.copy_(torch.tensor([-1e4, 0.0, 1e4]))
    torch.testing.assert_close(blend(), torch.tensor([MIN_BLEND, 0.5, MAX_BLEND]))
    assert (MIN_BLEND, MAX_BLEND) == (0.05, 0.95)


def test_blend_weight_takes_12_bytes_a_pixel_with_its_optimiser():
    guide = gaussian_guide(small_camera(), "lis-b")
    pixels = slice(0, WIDTH * HEIGHT)
    guide.accumulate([learned_record(Gradients(pixels, torch.ones(WIDTH * HEIGHT), None))], summary(1))
    guide.update(summary(1))
    logit = guide.blend.logit
    assert (logit < BlendWeightMap(1).logit).all(), "the gradient was followed"
    assert logit.grad is None
    tensors = [logit, *(value for value in guide.optimizers["blend"].state[logit].values() if value.numel() > 1)]
    assert sum(tensor.numel() * tensor.element_size() for tensor in tensors) == 12 * WIDTH * HEIGHT


def test_adam_moves_beta_where_there_is_light_and_never_without_candidates():
    guide = gaussian_guide(small_camera(), "lis-b")
    pixels = WIDTH * HEIGHT
    guide.field.assign(torch.tensor([[0.0], [0.0], [1.0]]), torch.tensor([0.02]), torch.tensor([0.01]), torch.tensor([1.0]))
    guide.set_candidates()
    guide.refit = lambda mean_luminance: None
    before = guide.blend.logit.detach().clone()
    batch = pixel_batch(guide)
    query = mixture_query(guide, batch)
    mixture = query.mixture
    for step in (2, 3, 4):
        drawn = mixture.sample(torch.rand(5, pixels, generator=torch.Generator().manual_seed(step)))
        samples = samples_of(batch, query, drawn)
        ratio = mixture.lens.contains(drawn.points) / (mixture.lens.area * samples.drawn.at.density)
        guide.accumulate([learned_record(guide.learn_from(samples, query, ratio))], summary(step))
        guide.update(summary(step))
        if step == 2:
            moved = (guide.blend.logit.detach() - before).abs()
            learns = mixture.guided & (ratio > 0.0)
            torch.testing.assert_close(
                moved[learns], torch.full_like(moved[learns], GaussianConfig.blend_rate), rtol=1e-3, atol=1e-4
            )
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
