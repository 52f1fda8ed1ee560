"""Light groups of whole renders: sums, native core, ranks, crops, adaptive SPP, states, and scenes without groups."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.limits import MAX_LIGHT_GROUPS
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks
from bokehguide.scene.light_groups import find_light_groups
from bokehguide.scene.types import Aperture, Environment, Material, Sun
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, make_loop
from bokehguide.train.adaptive import HalfLoop
from bokehguide.train.checkpoint import load_checkpoint, save_checkpoint
from tests.support.group_cases import NAMES, grouped, rendered
from tests.support.sharing_cases import spoil
from tests.support.thread_ranks import job
from tests.support.tracing import rectangle

MODES = ("uniform", "lis-b", "lis-o", "guided")


def settings_of(mode: str, **others) -> RenderSettings:
    return RenderSettings(mode, light_groups=True, threads=1, **others)


def groups_of(loop: RenderLoop | AdaptiveLoop) -> dict[str, np.ndarray]:
    return loop.picture().light_groups()


def check_sum(loop: RenderLoop | AdaptiveLoop) -> None:
    """The groups of `grouped` add up to the radiance, and none is dark."""
    beauty, groups = loop.picture().radiance().numpy(), groups_of(loop)
    assert tuple(groups) == NAMES and all(layer.max() > 0.02 for layer in groups.values())
    np.testing.assert_allclose(sum(groups.values()), beauty, rtol=1e-4, atol=1e-5)


@pytest.fixture(params=(True, False), ids=("core", "pytorch"))
def _core(request, monkeypatch) -> None:
    if not request.param:
        monkeypatch.setattr(native, "core", lambda: None)
    elif native.core() is None:
        pytest.skip("the native core is not built")


@pytest.mark.usefixtures("_core")
@pytest.mark.parametrize("mode", MODES)
def test_the_groups_add_up_to_the_beauty(mode):
    check_sum(rendered(grouped(), 10, settings_of(mode)))


@pytest.mark.usefixtures("_core")
def test_the_groups_add_up_without_a_control_variate_and_coats():
    """The weights of a vignetting lens are no control variate. Emission without coats is the same in all directions."""
    scene = grouped()
    scene = replace(scene, camera=replace(scene.camera, aperture=Aperture(blades=5, cat_eye=0.7)))
    scene = replace(scene, materials=tuple(replace(each, clearcoat=0.0) for each in scene.materials))
    check_sum(rendered(scene, 6, settings_of("guided")))


@pytest.mark.parametrize("mode", MODES)
def test_groups_change_no_bit_of_the_picture(mode):
    first = rendered(grouped(), 6, settings_of(mode)).picture().layers()
    second = rendered(grouped(), 6, replace(settings_of(mode), light_groups=False)).picture()
    assert not second.light_groups()
    for name, layer in second.layers().items():
        np.testing.assert_array_equal(first[name], layer, err_msg=name)


@pytest.mark.parametrize("mode, spp", [("uniform", 5), ("guided", 1)])
def test_pytorch_gives_the_groups_of_the_native_core(mode, spp, monkeypatch):
    """Later steps of `guided` choose by learned numbers, which rounding changes."""
    if native.core() is None:
        pytest.skip("the native core is not built")
    fast = groups_of(rendered(grouped(), spp, settings_of(mode)))
    monkeypatch.setattr(native, "core", lambda: None)
    slow = groups_of(rendered(grouped(), spp, settings_of(mode)))
    for name, layer in fast.items():  # a rounded ray may pass an edge
        assert float((np.abs(layer - slow[name]) > 1e-3 * (0.1 + layer)).mean()) < 0.02, name


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("mode, crop", [("uniform", None), ("guided", (3, 2, 20, 13))])
def test_ranks_give_the_groups_of_one_process(mode, crop, count):
    scene, settings = grouped(), settings_of(mode, seed=4, crop=crop)
    expected = groups_of(rendered(scene, 6, settings))

    def work(ranks: Ranks) -> dict[str, np.ndarray]:
        loop = RenderLoop(scene, settings, ranks)
        for _ in range(6):
            loop.step()
        return groups_of(loop)

    for found in job(count, work):
        for name, layer in expected.items():
            np.testing.assert_allclose(found[name], layer, rtol=1e-4, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_threads_and_resuming_change_no_bit(mode):
    whole = groups_of(rendered(grouped(), 7, settings_of(mode)))
    first = rendered(grouped(), 3, settings_of(mode))
    with RenderLoop(grouped(), replace(settings_of(mode), threads=3)) as second:
        second.load_state_dict(deepcopy(first.state_dict()))
        while second.step_number < 7:
            second.step()
        found = groups_of(second)
    for name, layer in whole.items():
        np.testing.assert_array_equal(found[name], layer, err_msg=name)


def test_a_crop_is_a_part_of_the_frame():
    settings = settings_of("uniform")
    frame, crop = (groups_of(rendered(grouped(), 5, each)) for each in (settings, replace(settings, crop=(5, 3, 12, 10))))
    for name, layer in frame.items():
        np.testing.assert_array_equal(crop[name], layer[3:13, 5:17], err_msg=name)


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_adaptive_groups_add_up(mode):
    loop = rendered(grouped(40, 40), 64, settings_of(mode, target_noise=0.2))
    assert isinstance(loop, AdaptiveLoop) and loop.finished_share > 0.0
    check_sum(loop)


@pytest.mark.parametrize("changed", ["without", "renamed", "moved"])
def test_a_checkpoint_of_other_groups_is_refused(changed, tmp_path):
    save_checkpoint(tmp_path / "a.ckpt", rendered(grouped(), 1, settings_of("uniform")), 1.0)
    scene, settings = grouped(), settings_of("uniform")
    materials = list(scene.materials)
    if changed == "without":
        settings = replace(settings, light_groups=False)
    else:
        name = "tubes" if changed == "renamed" else "lamps"
        materials = [replace(each, light_group=name) if each.light_group == "neon" else each for each in materials]
    scene = replace(scene, materials=tuple(materials))
    with make_loop(scene, settings) as loop, pytest.raises(BokehguideError, match="other light groups; render without --resume"):
        load_checkpoint(tmp_path / "a.ckpt", loop)


def test_a_scene_without_groups_is_refused():
    scene = grouped()
    bare = replace(
        scene,
        materials=tuple(replace(each, light_group="") for each in scene.materials),
        suns=tuple(replace(each, light_group="") for each in scene.suns),
        environment=None,
    )
    with pytest.raises(BokehguideError, match="no light of shared has a group; give"):
        RenderLoop(bare, settings_of("uniform"))


def test_too_many_groups_are_refused():
    suns = tuple(Sun((0.0, 1.0, 0.0), 1.0, (1.0, 1.0, 1.0), f"sun{number}") for number in range(MAX_LIGHT_GROUPS + 1))
    with pytest.raises(BokehguideError, match=f"give at most {MAX_LIGHT_GROUPS}"):
        find_light_groups(replace(grouped(), suns=suns))


def test_area_restir_is_refused():
    with pytest.raises(BokehguideError, match="light_groups: area-restir reuses samples"):
        settings_of("area-restir")


@pytest.mark.parametrize("name", ["two words", "a.b", "é", "x" * 41, 3])
def test_a_name_that_no_channel_can_have_is_refused(name):
    for kind, given in ((Material, ("m",)), (Sun, ((0.0, 1.0, 0.0), 1.0, (1.0, 1.0, 1.0))), (Environment, ((1.0, 1.0, 1.0),))):
        with pytest.raises(BokehguideError, match=f"{kind.__name__}.light_group: .* is no name of a light group"):
            kind(*given, light_group=name)


def test_materials_that_no_mesh_has_make_no_group():
    scene = grouped()
    unused = Material("unused", emission=(1.0, 1.0, 1.0), light_group="unused")
    assert find_light_groups(replace(scene, materials=(*scene.materials, unused))).names == NAMES


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_samples_outside_the_picture_do_not_count(mode):
    """The left half of a film gets no samples in the second half of the steps, as in `AdaptiveLoop`."""
    left = torch.arange(24 * 16) % 24 < 12
    with HalfLoop(grouped(), settings_of(mode), None) as loop:
        for step in range(8):
            if step == 4:
                loop.count_only(~left)
            loop.step()
    assert set(loop.film.layers()["sample_count"].reshape(-1)[left.numpy()]) == {4.0}
    check_sum(loop)


def test_samples_that_are_not_finite_do_not_count():
    with RenderLoop(grouped(), settings_of("guided")) as loop:
        for step in range(4):
            spoil(loop) if step == 1 else loop.step()
    assert loop.film.bad_count > 0
    check_sum(loop)


@pytest.mark.usefixtures("_core")
def test_a_group_that_is_dark_stays_exactly_dark():
    """The control variate of each pixel is shared out by the light of the groups. The light of one group reaches no pixel."""
    scene = grouped()
    hidden = Material("hidden", emission=(5.0, 5.0, 5.0), light_group="hidden")
    away = rectangle(len(scene.materials), (0.0, 50.0, 50.0), (-90.0, 0.0, 0.0))  # it faces up, above the scene
    scene = replace(scene, materials=(*scene.materials, hidden), meshes=(*scene.meshes, away))
    loop = rendered(scene, 10, settings_of("guided"))
    assert loop.mode.strategies["reuse"].control_variate.coefficients.any()
    groups = groups_of(loop)
    assert not groups.pop("hidden").any()
    assert all(layer.any() for layer in groups.values())
    np.testing.assert_allclose(sum(groups.values()), loop.picture().radiance().numpy(), rtol=1e-4, atol=1e-5)
