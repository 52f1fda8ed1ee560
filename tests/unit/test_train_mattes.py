"""Mattes of whole renders: sums, names, native core, ranks, crops, adaptive SPP, and states."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from bokehguide.errors import BokehguideError
from bokehguide.image.cryptomatte import RANKS, floats
from bokehguide.render.film import Film
from bokehguide.runtime import native
from bokehguide.runtime.distributed import Ranks
from bokehguide.scene.types import Aperture, Material, Scene
from bokehguide.train import AdaptiveLoop, RenderLoop, RenderSettings, make_loop, matte_layers
from bokehguide.train.adaptive import HalfLoop
from bokehguide.train.mattes import triangle_objects
from tests.support.sharing_cases import CAMERA, FLOOR, SHEET, scene_of, terrace
from tests.support.thread_ranks import job
from tests.support.tracing import rectangle

pytest.importorskip("mmh3")

ALL_MODES = ("uniform", "lis-b", "lis-o", "guided", "area-restir", "area-restir+lis")


def named(width: int = 24, height: int = 24, sky: bool = False) -> Scene:
    """Five objects, of which one is translucent and two are called the same."""
    scene = terrace(width, height, sheet=True, sky=sky)
    names = ("plane", "plane", "lamp", "card", "")
    return replace(scene, meshes=tuple(replace(mesh, name=name) for mesh, name in zip(scene.meshes, names)))


def rendered(scene: Scene, spp: int, settings: RenderSettings) -> RenderLoop | AdaptiveLoop:
    with make_loop(scene, replace(settings, spp=spp)) as loop:
        while loop.step_number < spp and not (isinstance(loop, AdaptiveLoop) and loop.finished):
            loop.step()
    return loop


def coverage(loop: RenderLoop | AdaptiveLoop, kind: str = "object") -> torch.Tensor:
    """Coverage of each object by its number less 1, `[objects, pixels]`."""
    found = loop.picture().covered()[kind]
    total = torch.zeros(int(triangle_objects(loop.scene)[kind].max()), found.share.shape[1], dtype=torch.float64)
    for numbers, share in zip(found.numbers, found.share):
        for number in range(1, len(total) + 1):
            total[number - 1] += share * (numbers == number)
    return total


@pytest.mark.parametrize("mode", ALL_MODES)
def test_the_coverage_adds_up_to_alpha(mode):
    """In each mode, and for the materials as well: no environment is in view, and the slots suffice."""
    loop = rendered(named(), 12, RenderSettings(mode, cryptomatte=True, threads=1))
    alpha = loop.picture().layers()["alpha"].reshape(-1)
    assert 0.2 < alpha.mean() < 0.98
    for kind, count in (("object", 4), ("material", 5)):
        found = coverage(loop, kind)
        assert len(found) == count and bool((found.mean(1) > 0.001).all())
        np.testing.assert_allclose(found.sum(0), alpha, atol=2e-6)
    if mode == "guided":
        assert len(np.unique(alpha * 12 % 1.0)) > 10  # weights are in use


def test_the_coverage_adds_up_to_alpha_behind_a_vignette():
    scene = named()
    scene = replace(scene, camera=replace(scene.camera, aperture=Aperture(cat_eye=1.0)))
    loop = rendered(scene, 12, RenderSettings("guided", cryptomatte=True, threads=1))
    np.testing.assert_allclose(coverage(loop).sum(0), loop.picture().layers()["alpha"].reshape(-1), atol=2e-6)


@pytest.mark.parametrize("mode", ALL_MODES)
def test_mattes_change_no_bit_of_the_picture(mode):
    with_mattes, without = (
        rendered(named(sky=True), 6, RenderSettings(mode, cryptomatte=asked, threads=1)).picture() for asked in (True, False)
    )
    assert isinstance(without, Film) and not without.covered()
    for name, layer in without.layers().items():
        np.testing.assert_array_equal(with_mattes.layers()[name], layer, err_msg=name)


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_pytorch_gives_the_mattes_of_the_native_core(mode, monkeypatch):
    if native.core() is None:
        pytest.skip("the native core is not built")
    settings = RenderSettings(mode, cryptomatte=True, threads=1)
    fast = coverage(rendered(named(), 4, settings))
    monkeypatch.setattr(native, "core", lambda: None)
    slow = coverage(rendered(named(), 4, settings))
    assert bool((fast.mean(1) > 0.001).all())
    assert float(((fast - slow).abs() > 1e-4).double().mean()) < 2e-3  # a rounded ray may pass an edge


def test_a_sheet_covers_the_share_that_its_opacity_stops():
    """A translucent sheet of opacity 0.4 that fills the frame, and a wall behind the sheet."""
    ahead = (CAMERA.position[0], CAMERA.position[1])
    meshes = [rectangle(number, (*ahead, -depth), scale=20.0) for number, depth in enumerate((1.0, 3.0))]
    loop = rendered(scene_of(meshes, (SHEET, FLOOR), 24, 24, sky=False), 20, RenderSettings(cryptomatte=True, threads=1))
    sheet, wall = coverage(loop)
    assert float(sheet.mean()) == pytest.approx(0.4, abs=0.02)
    torch.testing.assert_close(sheet + wall, torch.ones_like(sheet))


def layers_of(loop: RenderLoop | AdaptiveLoop) -> dict[str, np.ndarray]:
    return matte_layers(loop.scene, loop.picture())


def test_layers_have_the_identifiers_of_the_names_by_descending_coverage():
    loop = rendered(named(), 16, RenderSettings("uniform", cryptomatte=True, threads=1))
    layers = layers_of(loop)
    assert list(layers) == [f"{kind}0{number}" for kind in ("object", "material") for number in range(RANKS // 2)]
    whole = np.concatenate([layers[f"object0{number}"] for number in range(RANKS // 2)], axis=-1)
    identifiers, shares = whole[..., 0::2].reshape(-1, RANKS), whole[..., 1::2].reshape(-1, RANKS)
    assert (np.diff(shares, axis=1) <= 0.0).all()
    np.testing.assert_array_equal(identifiers == 0.0, shares == 0.0)
    for name, expected in zip(("plane", "lamp", "card", "mesh 4"), coverage(loop)):
        found = (shares * (identifiers == floats([name])[0])).sum(1)
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("mode, crop", [("uniform", None), ("guided", (3, 2, 20, 19))])
def test_ranks_give_the_mattes_of_one_process(mode, crop, count):
    scene, settings = named(), RenderSettings(mode, seed=4, threads=1, crop=crop, cryptomatte=True)
    expected = layers_of(rendered(scene, 6, settings))

    def work(ranks: Ranks) -> dict[str, np.ndarray]:
        loop = RenderLoop(scene, settings, ranks)
        for _ in range(6):
            loop.step()
        return layers_of(loop)

    for found in job(count, work):
        for name, layer in expected.items():
            np.testing.assert_allclose(found[name], layer, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("mode", ["uniform", "lis-o", "guided"])
def test_threads_and_resuming_change_no_bit(mode):
    settings = RenderSettings(mode, threads=1, cryptomatte=True)
    whole = layers_of(rendered(named(), 7, settings))
    first = rendered(named(), 3, settings)
    with RenderLoop(named(), replace(settings, threads=3)) as second:
        second.load_state_dict(deepcopy(first.state_dict()))
        while second.step_number < 7:
            second.step()
        found = layers_of(second)
    for name, layer in whole.items():
        np.testing.assert_array_equal(found[name], layer, err_msg=name)


def test_a_crop_is_a_part_of_the_frame():
    settings = RenderSettings("uniform", threads=1, cryptomatte=True)
    frame, crop = (layers_of(rendered(named(), 5, each)) for each in (settings, replace(settings, crop=(5, 3, 12, 16))))
    for name, layer in frame.items():
        np.testing.assert_array_equal(crop[name], layer[3:19, 5:17], err_msg=name)


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_adaptive_mattes_are_the_mean_of_both_halves(mode):
    settings = RenderSettings(mode, threads=1, cryptomatte=True, target_noise=0.2)
    loop = rendered(named(40, 40), 64, settings)
    assert isinstance(loop, AdaptiveLoop)
    halves = [coverage(half) for half in loop.halves]  # pyright: ignore[reportAttributeAccessIssue]
    torch.testing.assert_close(coverage(loop), 0.5 * (halves[0] + halves[1]))
    assert float((halves[0] - halves[1]).abs().max()) > 0.01
    np.testing.assert_allclose(coverage(loop).sum(0), loop.picture().layers()["alpha"].reshape(-1), atol=2e-6)


def test_objects_without_a_name_have_their_numbers():
    scene = named()
    scene = replace(scene, materials=tuple(replace(each, name="") for each in scene.materials[:2]) + scene.materials[2:])
    loop = rendered(scene, 2, RenderSettings("uniform", threads=1, cryptomatte=True))
    identifiers = np.unique(np.concatenate([layer[..., 0::2].ravel() for layer in layers_of(loop).values()]))
    assert set(floats(["mesh 4", "material 0", "material 1", "card"])) <= set(identifiers)


def test_two_materials_of_one_name_are_one():
    scene = named()
    scene = replace(scene, materials=tuple(Material("paint") for _ in scene.materials))
    loop = rendered(scene, 3, RenderSettings("uniform", threads=1, cryptomatte=True))
    assert set(np.unique(layers_of(loop)["material00"][..., 0])) == {0.0, floats(["paint"])[0]}


def test_a_film_without_coverage_has_no_mattes():
    loop = rendered(named(), 1, RenderSettings("uniform", threads=1))
    with pytest.raises(BokehguideError, match="the film has no coverage"):
        layers_of(loop)


@pytest.mark.parametrize("mode", ["uniform", "guided"])
def test_samples_outside_the_picture_do_not_count(mode):
    """The left half of a film gets no samples in the second half of the steps, as in `AdaptiveLoop`."""
    scene, settings = named(), RenderSettings(mode, threads=1, cryptomatte=True)
    left = torch.arange(24 * 24) % 24 < 12
    with HalfLoop(scene, settings, None) as loop:
        for step in range(8):
            if step == 4:
                loop.count_only(~left)
            loop.step()
    film = loop.film
    assert set(film.layers()["sample_count"].reshape(-1)[left.numpy()]) == {4.0}
    np.testing.assert_allclose(coverage(loop).sum(0), film.layers()["alpha"].reshape(-1), atol=2e-6)
