"""Light groups of whole renders."""

from __future__ import annotations

import numpy as np
import pytest

from bokehguide.train import RenderSettings
from tests.support.group_cases import NAMES, grouped, rendered

MODES = ("uniform", "lis-b", "lis-o", "guided")


@pytest.fixture(params=(True, False), ids=("core", "pytorch"))
def core(request, monkeypatch) -> bool:
    if not request.param:
        monkeypatch.setenv("BOKEHGUIDE_NATIVE", "0")
    return request.param


@pytest.mark.parametrize("mode", MODES)
def test_the_groups_add_up_to_the_beauty(mode, core):
    picture = rendered(grouped(), 10, RenderSettings(mode, light_groups=True, threads=1)).picture()
    beauty, groups = picture.radiance().numpy(), picture.light_groups()
    assert tuple(groups) == NAMES and all(layer.max() > 0.02 for layer in groups.values())
    assert np.allclose(sum(groups.values()), beauty, rtol=1e-4, atol=1e-5)
