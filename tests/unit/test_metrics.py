"""The error measures against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from bokehguide import metrics
from bokehguide.errors import BokehguideError
from bokehguide.image import write_exr
from bokehguide.metrics import compare, mape, read_reference, relmse


def test_mape_and_relmse_by_hand():
    reference = torch.tensor([[[0.99, 0.0, 0.49]]])
    image = torch.tensor([[[1.49, 0.01, 0.24]]])
    # |I - R| / (R + 0.01) = 0.5, 1, 0.5
    assert mape(image, reference) == pytest.approx(2.0 / 3.0, rel=1e-6)
    assert relmse(image, reference) == pytest.approx((0.25 + 1.0 + 0.25) / 3.0, rel=1e-6)


def test_the_reference_is_the_denominator():
    dark, bright = torch.full((1, 1, 3), 0.09), torch.full((1, 1, 3), 0.99)
    assert mape(dark, bright) == pytest.approx(0.9)
    assert mape(bright, dark) == pytest.approx(9.0)


def test_equal_images_have_no_error():
    image = torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(1)) * 5.0
    metrics = compare(image, image.clone())
    assert (metrics.mape, metrics.relmse) == (0.0, 0.0)
    assert metrics.ssim == pytest.approx(1.0, abs=1e-6)
    assert metrics.psnr == math.inf


def test_psnr_is_of_the_tone_mapped_values():
    # sRGB 0.5 and 0.6 lie 0.1 apart: PSNR = 20 dB.
    linear = [((value + 0.055) / 1.055) ** 2.4 for value in (0.5, 0.6)]
    image, reference = (torch.full((12, 12, 3), value) for value in linear)
    assert compare(image, reference).psnr == pytest.approx(20.0, abs=1e-3)
    # What is brighter than white looks alike.
    assert compare(image + 2.0, reference + 5.0).psnr == math.inf


def test_ssim_of_flat_images_by_hand():
    # Without variance SSIM is (2 a b + C1) / (a² + b² + C1), C1 = 0.01².
    linear = [((value + 0.055) / 1.055) ** 2.4 for value in (0.5, 0.8)]
    image, reference = (torch.full((12, 12, 3), value) for value in linear)
    expected = (2 * 0.5 * 0.8 + 1e-4) / (0.25 + 0.64 + 1e-4)
    assert compare(image, reference).ssim == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("measure", [mape, relmse, compare])
def test_what_cannot_be_compared_is_refused(measure):
    good = torch.ones(12, 13, 3)
    bad = good.clone()
    bad[3, 4, 1] = math.nan
    with pytest.raises(BokehguideError, match="the image has 1 NaN or infinite"):
        measure(bad, good)
    with pytest.raises(BokehguideError, match="the reference has 1 NaN or infinite"):
        measure(good, bad)
    with pytest.raises(BokehguideError, match="the image is 13x12 and the reference 12x13 pixels"):
        measure(good, torch.ones(13, 12, 3))
    with pytest.raises(BokehguideError, match=r"negative value, -0\.5; clamp it, or render it with more SPP$"):
        measure(good, good - 1.5)


@pytest.mark.parametrize("measure", [mape, relmse, compare])
def test_arrays_are_measured_as_tensors(measure):
    image, reference = (np.random.default_rng(seed).random((12, 13, 3), np.float32) for seed in (0, 1))
    expected = measure(torch.from_numpy(image), torch.from_numpy(reference))
    image.setflags(write=False)
    assert measure(image, reference[:, ::-1].copy()[:, ::-1]) == measure(image, torch.from_numpy(reference)) == expected


@pytest.mark.parametrize("measure", [mape, relmse, compare])
@pytest.mark.parametrize("kind", [np.uint8, np.int64])
def test_whole_numbers_are_measured_as_others(measure, kind):
    image, reference = (np.random.default_rng(seed).integers(0, 256, (12, 13, 3)).astype(kind) for seed in (0, 1))
    expected = measure(image.astype(np.float32), reference.astype(np.float32))
    assert measure(torch.from_numpy(image), torch.from_numpy(reference)) == measure(image, reference) == expected


@pytest.mark.parametrize("measure", [mape, relmse, compare])
@pytest.mark.parametrize(
    ("bad", "found"),
    [
        (np.ones((12, 13)), r"shape \(12, 13\)"),
        (torch.ones(0, 13, 3), r"shape \(0, 13, 3\)"),
        ([[1.0]], "type list"),
        (np.array("x"), r"shape \(\)"),
        (np.ones((12, 13, 1)), r"shape \(12, 13, 1\)"),
        (torch.ones(12, 13, 4), r"shape \(12, 13, 4\)"),
        (np.ones((12, 13, 3), bool), "type bool"),
        (torch.ones(12, 13, 3, dtype=torch.bool), r"type torch\.bool"),
        (np.ones((12, 13, 3), complex), "type complex128"),
        (torch.ones(12, 13, 3, dtype=torch.complex64), r"type torch\.complex64"),
    ],
)
def test_what_is_no_image_is_refused(measure, bad, found):
    with pytest.raises(BokehguideError, match=f"the reference has {found}; give an array or a tensor"):
        measure(np.ones((12, 13, 3)), bad)


def test_negative_values_of_a_reference_file_become_0_with_a_line(tmp_path, caplog):
    pixels = np.full((2, 4, 3), 0.5, np.float32)
    pixels[0, 1] = -0.25, -1.0, 0.25
    write_exr(tmp_path / "a.exr", {"beauty": pixels})
    np.testing.assert_array_equal(read_reference(tmp_path / "a.exr", 4, 2).numpy(), pixels.clip(0.0))
    told = f"{tmp_path}/a.exr: the reference has 2 negative values, 0 in their place; more SPP avoid such values"
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [("WARNING", told)]
    pixels[0, 1] = -math.inf
    write_exr(tmp_path / "a.exr", {"beauty": pixels})
    with pytest.raises(BokehguideError, match=r"a\.exr: the reference has 3 NaN or infinite values"):
        read_reference(tmp_path / "a.exr")
    write_exr(tmp_path / "a.exr", {"beauty": pixels.clip(0.0)})
    with pytest.raises(BokehguideError, match=r"a\.exr: the image is 2x4 and the reference 4x2 pixels"):
        read_reference(tmp_path / "a.exr", 2, 4)
    assert len(caplog.records) == 1


def test_too_small_for_ssim():
    ones = torch.ones(10, 40, 3)
    metrics = compare(ones, ones)
    assert (metrics.mape, metrics.ssim, metrics.psnr) == (0.0, None, math.inf)
    assert compare(torch.ones(11, 11, 3), torch.ones(11, 11, 3)).ssim == pytest.approx(1.0)


def test_ssim_in_bands_is_ssim_of_the_whole(monkeypatch):
    rng = np.random.default_rng(0)
    image, reference = (torch.from_numpy(rng.random((101, 40, 3), np.float32)) for _ in range(2))
    whole = compare(image, reference).ssim
    for pixels in (11 * 40, 20 * 40, 50 * 40, 95 * 40):
        monkeypatch.setattr(metrics, "SSIM_PIXELS", pixels)
        assert compare(image, reference).ssim == pytest.approx(whole, abs=1e-6)
