"""Tone mapping and PNG."""

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.image import Display, tone_map, write_png


def test_srgb_values_of_the_standard():
    # IEC 61966-2-1: middle grey 0.18 lies at 46.1 % (118 of 255), 0.5 at 73.5 % (188 of 255).
    linear = torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0])
    expected = torch.tensor([0.0, 0.04045, 0.46136, 0.73536, 1.0])
    torch.testing.assert_close(tone_map(linear), expected, atol=2e-5, rtol=0)


def test_exposure_is_in_stops():
    linear = torch.tensor([0.01, 0.1, 0.2])
    torch.testing.assert_close(tone_map(linear, 2.0), tone_map(4.0 * linear))
    torch.testing.assert_close(tone_map(linear, -1.0), tone_map(0.5 * linear))


def test_clips_and_never_decreases():
    shown = tone_map(torch.linspace(-1.0, 3.0, 4001))
    assert shown.min() == 0.0
    assert 1.0 - 1e-6 <= shown.max() <= 1.0
    assert (shown.diff() >= -1e-6).all()
    assert not shown.isnan().any()


def test_png_rounds_to_the_nearest_level(tmp_path):
    display = torch.tensor([0.0, 0.4 / 255, 0.6 / 255, 127.49 / 255, 127.51 / 255, 1.0, 1.5, -1.0])
    write_png(tmp_path / "a.png", display[None, :, None].expand(2, -1, 3))
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture)
    assert pixels.shape == (2, 8, 3)
    assert pixels[1, :, 2].tolist() == [0, 0, 1, 127, 128, 255, 255, 0]
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_png_of_16_bits_with_alpha(tmp_path):
    display = torch.tensor([0.0, 0.4 / 65535, 0.6 / 65535, 0.25, 1.0, 1.5, -1.0])[None, :, None].repeat(2, 1, 4)
    display[1, :, 3] = 0.5
    write_png(tmp_path / "a.png", display, bits=16)
    hint = oiio.ImageSpec()
    hint["oiio:UnassociatedAlpha"] = 1  # the values of the file
    image = oiio.ImageInput.open(str(tmp_path / "a.png"), hint)
    assert image.spec().format == oiio.UINT16 and image.spec().channelnames == ("R", "G", "B", "A")
    pixels = image.read_image(oiio.UINT16)
    assert pixels[0, :, 3].tolist() == pixels[1, :, 1].tolist() == [0, 0, 1, 16384, 65535, 65535, 0]
    assert (pixels[1, :, 3] == 32768).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_straight_display_values_are_those_of_the_covered_part():
    colour, alpha = np.array([0.4, 0.2, 0.1], np.float32), np.array([[1.0, 0.25, 0.0, 1.02, -0.01, np.nan]], np.float32)
    radiance = colour * np.nan_to_num(alpha)[..., None]
    display = Display(0.5, "srgb")
    shown = display.show_straight(radiance, alpha)
    opaque = display.show(colour[None, None])[0, 0]
    torch.testing.assert_close(shown[0, :2, :3], opaque.expand(2, 3))
    torch.testing.assert_close(shown[0, 3, :3], display.show(1.02 * colour[None, None])[0, 0])
    assert not shown[0, [2, 4, 5], :3].any()
    assert shown[0, :, 3].tolist() == [1.0, 0.25, 0.0, 1.0, 0.0, 0.0]


def test_a_metered_exposure_is_that_of_the_premultiplied_picture():
    radiance, alpha = np.full((8, 8, 3), 0.02, np.float32), np.full((8, 8), 0.5, np.float32)
    exposure = Display().metered(radiance, alpha).exposure
    torch.testing.assert_close(Display().show_straight(radiance, alpha), Display(exposure).show_straight(radiance, alpha))


@pytest.mark.parametrize("bits", [8, 16])
def test_a_folder_that_cannot_be_written(bits, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(BokehguideError, match="cannot be written"):
        write_png(tmp_path / "file" / "a.png", torch.zeros(2, 2, 3), bits)
