"""Fig. 10's distributions on the lens: what each histogram is of, and the figure."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import stats

from bokehguide.guiding.protocols import PixelBatch
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from bokehguide.runtime.timer import PhaseTimer
from tests.support.paths import REPOSITORY
from tests.support.restir_cases import RADIUS, WIDTH, loop_of

PIXEL = 8 * WIDTH + 16
"""In the emitter's disc."""


@pytest.fixture
def figures(monkeypatch):
    """Where the figures' scripts can be imported."""
    monkeypatch.syspath_prepend(str(REPOSITORY / "scripts/figures"))


def assert_same_means(one: torch.Tensor, other: torch.Tensor) -> None:
    """Of independent values `[N]`, by Welch's test."""
    assert stats.ttest_ind(one.double().numpy(), other.double().numpy(), equal_var=False).pvalue > 1e-4


def test_what_area_restir_chooses_stands_for_the_light_on_the_lens(figures):
    from restir_pixel import PixelReuse

    loop = loop_of("uniform")
    final = [PixelReuse(loop, PIXEL, RADIUS, 3, step, 2048).passes() for step in (1, 2, 3, 4)]
    weight = torch.cat([one.radiance_weight for one in final])
    x, y = torch.cat([one.radiance for one in final], dim=1)[:2]
    assert float((x * x + y * y)[weight > 0.0].max()) <= 1.0001

    random = PixelRandom(4, 1, torch.arange(1 << 17))
    raster = torch.tensor([[PIXEL % WIDTH], [PIXEL // WIDTH]]) + random.uniform(0, 2)
    points = loop.camera.lens.sample(random.uniform(2, 2))
    origins, directions = loop.camera.rays(loop.camera.focus_points(raster), points)
    light = luminance(loop.tracer.trace(origins, directions, random, PhaseTimer()).radiance)
    u, v = points / loop.camera.lens.radius
    for seen, expected in ((1.0, 1.0), (x, u), (y, v), (x * y, u * v), (x * x, u * u), (y * y, v * v)):
        assert_same_means(weight * seen, light * expected)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lis-o", "guided"])
def test_draws_for_one_pixel_are_as_if_drawn_one_by_one(mode, figures):
    from fig10 import focus_points, guided_points

    loop = loop_of(mode)
    for _ in range(12):
        loop.step()
    single = []
    for seed in range(800):
        random = PixelRandom(seed, 13, torch.tensor([PIXEL]))
        raster, focus = focus_points(loop, PIXEL, random)
        place = slice(PIXEL, PIXEL + 1)
        batch = PixelBatch(13, place, place, raster, raster % 1.0, focus, random, 1.0)
        single.append(loop.mode.lens.query(batch).sample().points)
    drawn = guided_points(loop, PIXEL)
    assert drawn.shape == (2, 1 << 16)
    for one, other in zip(torch.cat(single, dim=1), drawn):
        assert stats.ks_2samp(one.numpy(), other.numpy()).pvalue > 1e-4
    assert stats.ks_1samp(drawn[0].numpy() / loop.camera.lens.radius, stats.uniform(-1.0, 2.0).cdf).pvalue < 1e-9


@pytest.mark.slow
def test_the_figure_tells_one_method_from_another(figures, tmp_path, monkeypatch, capsys):
    import fig10

    monkeypatch.setattr(fig10, "DRAWS", 1 << 12)
    monkeypatch.setattr(fig10, "CELL_SAMPLES", 2)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["fig10.py", "--size", "48x27", "--spp", "16", "--out", "out"])
    fig10.main()
    assert "wrote" in capsys.readouterr().out
    found = json.loads((tmp_path / "out/fig10.json").read_text())["scenes"]["fairy-lights"]
    kl = found["kl"]
    assert list(kl) == ["uniform", "area-restir", "lis-o", "guided", "exact"]
    assert kl["exact"] < kl["guided"] < kl["area-restir"] < kl["uniform"]
    assert found["outside the lens"]["uniform"] == 0.0
    with Image.open(tmp_path / "out/fig10.png") as image:
        assert np.asarray(image.convert("L")).std() > 10
