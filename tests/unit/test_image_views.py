"""Views: greys, hues, NaN and infinities."""

import colorsys

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.image import Display, to_display, tone_map, views
from bokehguide.image.views import ROLL_OFF, VIEWS, rolled_off

LAMP = torch.tensor([4000.0, 300.0, 100.0]) / 4000.0


@pytest.mark.parametrize("view", VIEWS)
def test_grey_stays_grey_and_grows(view):
    ramp = torch.logspace(-3, 3, 200)
    shown = to_display(ramp[None, :, None].expand(1, -1, 3), view=view)
    assert shown.dtype == torch.float32 and shown.min() >= 0.0 and shown.max() <= 1.0
    assert float((shown.amax(-1) - shown.amin(-1)).max()) < 0.004  # a level of 255
    assert (shown[0, :, 1].diff() >= -1e-4).all()
    middle = float(to_display(torch.full((1, 1, 3), 0.18), view=view)[0, 0, 1])
    assert 0.3 < middle < 0.5


@pytest.mark.parametrize("view", VIEWS)
def test_an_exposure_from_a_file_gives_the_same_picture(view):
    """Files store exposures in single precision."""
    radiance = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(1))
    for exposure in (2.38, -1.1, 0.07):
        assert torch.equal(to_display(radiance, exposure, view), to_display(radiance, float(np.float32(exposure)), view))


@pytest.mark.parametrize("view", VIEWS)
def test_bands_of_rows_change_no_bit(view, monkeypatch):
    radiance = torch.rand(71, 23, 3, generator=torch.Generator().manual_seed(2)) ** 8 * 1000.0
    whole = to_display(radiance, 1.0, view)
    monkeypatch.setattr(views, "BAND", 1)  # bands of ROWS rows; the last has fewer
    assert torch.equal(to_display(radiance, 1.0, view), whole)


def test_srgb_is_the_clip_and_exposure_is_in_stops():
    picture = torch.rand(4, 5, 3) * 2.0
    torch.testing.assert_close(to_display(picture, 1.0, "srgb"), tone_map(2.0 * picture))
    torch.testing.assert_close(to_display(picture, 1.0), to_display(2.0 * picture), atol=1e-4, rtol=0)
    np.testing.assert_array_equal(to_display(picture.numpy()), to_display(picture))


@pytest.mark.parametrize("radiance", [4.0, 32.0, 400.0])
def test_photo_keeps_the_hue_of_a_lamp(radiance):
    color = colorsys.rgb_to_hsv(*to_display((radiance * LAMP).expand(1, 1, 3))[0, 0].tolist())
    assert color[1] > 0.28
    assert min(color[0], 1.0 - color[0]) < 0.06  # red to orange


def test_photo_ends_in_white_and_is_aces_below_the_roll_off():
    assert to_display((1e12 * LAMP).expand(1, 1, 3)).min() > 0.9
    dim = torch.rand(6, 7, 3) * ROLL_OFF
    torch.testing.assert_close(to_display(dim), to_display(dim, view="aces"))


def test_the_roll_off_is_smooth_and_keeps_ratios():
    scale = torch.linspace(1.0, 3.0, 2001, dtype=torch.float64)
    rolled = rolled_off(scale[:, None] * LAMP.double())
    slopes = rolled[:, 0].diff() / scale.diff()
    assert (slopes > 0.0).all() and float(slopes.diff().abs().max()) < 0.01
    torch.testing.assert_close(rolled[:, 1] / rolled[:, 0], torch.full_like(scale, 0.075))


@pytest.mark.parametrize("view", VIEWS)
def test_what_is_no_colour_has_a_display_value(view):
    odd = torch.tensor([[[torch.nan] * 3, [torch.inf] * 3, [-1.0] * 3, [1e38] * 3]])
    shown = to_display(odd, 100.0, view)
    assert shown[0, :, 1].tolist() == pytest.approx([0.0, 1.0, 0.0, 1.0], abs=0.01)


def test_an_unknown_view_is_refused_and_a_display_meters():
    with pytest.raises(BokehguideError, match="'film' is unknown; choose one of photo"):
        to_display(torch.zeros(1, 1, 3), view="film")
    picture = torch.full((8, 8, 3), 40.0)
    display = Display().metered(picture)
    assert display.exposure is not None and display.exposure < -6.0
    assert display.metered(100.0 * picture) == display
    torch.testing.assert_close(Display().show(picture), Display().show(4.0 * picture), atol=0.01, rtol=0)
