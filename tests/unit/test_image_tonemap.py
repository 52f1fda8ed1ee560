"""Tone mapping and PNG."""

import numpy as np
import pytest
import torch
from PIL import Image

from bokehguide.errors import BokehguideError
from bokehguide.image import tone_map, write_png


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


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(BokehguideError, match="cannot be written"):
        write_png(tmp_path / "file" / "a.png", torch.zeros(2, 2, 3))
