"""Values and factors of the paper's modes that other tests read from the code."""

from __future__ import annotations

import pytest
import torch

from bokehguide.baselines.restir.spatial_reuse import NEIGHBOURS
from bokehguide.errors import BokehguideError
from bokehguide.guiding.config import GaussianConfig, HighlightConfig
from bokehguide.models.candidates import MAX_CANDIDATES
from bokehguide.models.gaussian_field import GaussianField
from bokehguide.models.polynomial_offset import PolynomialOffset
from bokehguide.models.projection import project_to_lens
from bokehguide.train import RenderLoop, RenderSettings
from tests.support import scenes
from tests.support.gaussians import frozen_guide, scattered_field, small_camera


def test_defaults_are_those_of_the_paper():
    """Sections 4.2, 5.1, 6.1 and 6.2, but for the last line: see docs/explanation/method.md."""
    config, highlights = GaussianConfig(), HighlightConfig()
    assert (config.blend, config.blend_rate, config.offset_rate, config.offset_degree) == (0.8, 0.1, 0.01, 2)
    assert (config.fits, config.sigma_scale, NEIGHBOURS) == (8, 0.5, 32)
    assert (highlights.radiance_threshold, highlights.coc_threshold, highlights.depth_gap) == (8.0, 4.0, 8.0)
    assert (MAX_CANDIDATES, config.offset_slack) == (16, 2.0)


def test_weights_are_radiance_times_the_area_on_the_lens():
    """Of three discs of radiance 1 at different depths, parallel to the lens and projected through a focus point as polygons."""
    depth, radius, focus_distance = torch.tensor([1.2, 4.0, 30.0]), torch.tensor([0.01, 0.02, 0.3]), 2.0
    mean, field = torch.stack((0.1 * depth, -0.05 * depth, depth)), GaussianField()
    field.assign(mean, radius, radius, torch.pi * radius.square())
    angle = torch.arange(4096) / 4096 * 2.0 * torch.pi
    circle = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)))
    focus = torch.tensor([[0.2], [0.1], [focus_distance]]).double().expand(3, 4096)
    rims = [project_to_lens((mean[:, i, None] + radius[i] * circle).double(), focus) for i in range(3)]
    areas = torch.stack([0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum().abs() for x, y in rims])
    found = field.lens_weights(focus_distance).double()
    torch.testing.assert_close(found / found.sum(), areas / areas.sum(), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("toward", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_frozen_gaussian_is_a_candidate_of_pixels_that_see_its_moved_mean(toward):
    """Up to an offset of two σ."""
    guide = frozen_guide()
    camera, field, gaussian = guide.camera, guide.field, guide.candidates.gaussian.long()
    owner, every = torch.repeat_interleave(guide.candidates.counts()), torch.arange(camera.width * camera.height)
    raster = torch.stack((every % camera.width, every // camera.width)) + 0.5
    _, radius = field.footprints(camera)
    for number in range(len(field)):
        listed = torch.zeros(len(every), dtype=torch.bool)
        listed[owner[gaussian == number]] = True
        mean = field.mean[:, number] + 2.0 * field.sigma[number] * torch.tensor([*toward, 0.0])
        seen = (raster - camera.raster(mean[:, None])).norm(dim=0) < radius[number]
        assert bool(listed[seen].all())


def test_offsets_are_constant_beyond_two_radii():
    camera, field = small_camera(), scattered_field(3, seed=1)
    offsets = PolynomialOffset(field, camera)
    with torch.no_grad():
        offsets.coefficients.normal_(generator=torch.Generator().manual_seed(2))
        center, radius = field.footprints(camera)
        near, *far = [offsets(torch.arange(3), center + radii * radius) for radii in (1.9, 2.0, 3.0, 9.0)]
    assert torch.allclose(far[0], far[1]) and torch.allclose(far[0], far[2])
    assert not torch.isclose(near, far[0]).all(0).any()


@pytest.mark.parametrize("light", [1e-9, 1e6])
def test_beta_does_not_depend_on_the_unit_of_radiance(light):
    logits, scene = [], scenes.emitters(64, 36)
    for each in (scene, scenes.scaled(scene, light, 1.0)):
        with RenderLoop(each, RenderSettings("lis-b", threads=1)) as loop:
            for _ in range(3):
                loop.step()
            logits.append(loop.mode.lens.blend.logit.detach().clone())
    assert len(logits[0].unique()) > 2
    assert float(((logits[0] - logits[1]).abs() > 1e-3).float().mean()) < 0.01


@pytest.mark.parametrize("blend", [0.05, 0.5, 0.95])
def test_a_fixed_beta(blend):
    """Figure 6 has β = 0.95, a bound of the map."""
    with RenderLoop(scenes.emitters(16, 10), RenderSettings("lis", 1, gaussian=GaussianConfig(blend=blend))) as loop:
        assert float(loop.mode.lens.blend().detach()[0]) == pytest.approx(blend, abs=1e-4)
        assert loop.step().step == 1


@pytest.mark.parametrize("blend", [0.049, 0.951])
def test_a_beta_outside_the_bounds_is_refused(blend):
    with pytest.raises(BokehguideError, match=r"^GaussianConfig\.blend: .*0\.05 to 0\.95"):
        GaussianConfig(blend=blend)


@pytest.mark.parametrize("fits, last", [(1, 1), (3, 4), (8, 8)])
def test_lis_o_freezes_after_a_power_of_two_of_fits(fits, last):
    settings = RenderSettings("lis-o", threads=1, gaussian=GaussianConfig(fits=fits))
    with RenderLoop(scenes.emitters(80, 45), settings) as loop:
        while loop.mode.lens.offsets is None and loop.step_number < 10:
            loop.step()
        assert loop.step_number == last
