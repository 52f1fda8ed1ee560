"""What Area ReSTIR renders is right on average, whoever the neighbours are, and its defects show."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from bokehguide.baselines.restir import neighbours, shifts, spatial_reuse
from bokehguide.render.lens import ShapedLens
from bokehguide.scene.types import Aperture, Scene
from tests.support import scenes
from tests.support.restir_cases import HEIGHT, WIDTH, loop_of, luminance_by_step, same_means, scene
from tests.support.statistical import SIGNIFICANCE

STEPS, NEIGHBOURS = 24, 6


@pytest.fixture(autouse=True)
def few_neighbours(monkeypatch):
    monkeypatch.setattr(spatial_reuse, "NEIGHBOURS", NEIGHBOURS)


def rendered(mode: str, shown: Scene) -> np.ndarray:
    return luminance_by_step(loop_of(mode, seed=7, shown=shown), STEPS)


@lru_cache
def uniform() -> np.ndarray:
    """Of the same samples as Area ReSTIR's initial ones, which makes the comparison sharp."""
    return rendered("uniform", scene())


@lru_cache
def guided() -> np.ndarray:
    """Emitters in the mode that draws `area-restir+lis`'s initial samples: nearly the same ones."""
    return rendered("lis-o", scenes.emitters(WIDTH, HEIGHT))


def look_to_one_side(monkeypatch) -> None:
    """Neighbours below the pixel: those above and below would make up for each other's Jacobians."""
    whole = neighbours.disc_offsets

    def below(count):
        x, y = whole(count)
        return torch.stack((0.3 * x, y.abs()))

    monkeypatch.setattr(neighbours, "disc_offsets", below)


def reconnect_all(monkeypatch) -> None:
    monkeypatch.setattr(spatial_reuse, "copied_share", lambda coc, radius: torch.zeros_like(coc))


def test_means_are_those_of_the_uniform_lens():
    reused = rendered("area-restir", scene())
    assert same_means(reused, uniform()) > SIGNIFICANCE
    assert reused.var(0).mean() < 0.7 * uniform().var(0).mean()


@pytest.mark.slow
def test_means_with_guided_samples_are_those_of_the_uniform_lens():
    assert same_means(rendered("area-restir+lis", scene()), uniform()) > SIGNIFICANCE


def test_means_of_guided_samples_stay():
    reused = rendered("area-restir+lis", scenes.emitters(WIDTH, HEIGHT))
    assert same_means(reused, guided()) > SIGNIFICANCE
    assert reused.var(0).mean() < 0.9 * guided().var(0).mean()


def shaped() -> Scene:
    """Through an aperture that passes more at its rim, and less of it away from the frame's middle."""
    aperture = Aperture(blades=5, edge=0.9, cat_eye=0.8)
    return replace(scene(), camera=replace(scene().camera, aperture=aperture))


@pytest.mark.slow
def test_means_are_right_through_a_shaped_aperture():
    assert same_means(rendered("area-restir", shaped()), rendered("uniform", shaped())) > SIGNIFICANCE


@pytest.mark.slow
def test_means_are_right_with_neighbours_on_one_side_and_reconnection_only(monkeypatch):
    look_to_one_side(monkeypatch)
    reconnect_all(monkeypatch)
    assert same_means(rendered("area-restir", scene()), uniform()) > SIGNIFICANCE
    assert same_means(rendered("area-restir+lis", scenes.emitters(WIDTH, HEIGHT)), guided()) > SIGNIFICANCE


def without_jacobian(monkeypatch) -> None:
    monkeypatch.setattr(shifts, "reconnection_jacobian", lambda plane, old, new: torch.ones_like(old[0]))


def blind_to_what_is_seen(monkeypatch) -> None:
    """Reconnections to a surface that another one hides count."""
    monkeypatch.setattr(shifts, "same_point", lambda triangle, expected: torch.ones_like(triangle, dtype=torch.bool))


def without_mis(monkeypatch) -> None:
    """Each sample counts 1 / C, whoever else may have found it."""
    monkeypatch.setattr(spatial_reuse, "neighbour_weight", lambda own, shifted, jacobian, count: 1.0 / (count + 1.0))
    monkeypatch.setattr(spatial_reuse, "centre_share", lambda own, shifted, jacobian, count: 0.0 * count)


def as_if_drawn_evenly(monkeypatch) -> None:
    """The neighbours' samples without their 1 / q."""
    exchange = spatial_reuse.SpatialReuse._exchange

    def exchanged(*arguments):
        samples, here, there = exchange(*arguments)
        samples.weight[:] = 1.0
        return samples, here, there

    monkeypatch.setattr(spatial_reuse.SpatialReuse, "_exchange", exchanged)


@pytest.mark.slow
def test_a_forgotten_transmission_fails_the_means(monkeypatch):
    """Shifted samples that count as if the aperture passed the same everywhere."""
    expected = rendered("uniform", shaped())
    transmission = ShapedLens.transmission
    shift = shifts.Shift.__call__

    def evenly(*arguments):
        monkeypatch.setattr(ShapedLens, "transmission", lambda self, points: (transmission(self, points) > 0.0).float())
        shifted = shift(*arguments)
        monkeypatch.setattr(ShapedLens, "transmission", transmission)
        return shifted

    monkeypatch.setattr(shifts.Shift, "__call__", evenly)
    assert same_means(rendered("area-restir", shaped()), expected) < SIGNIFICANCE


DEFECTS = [without_jacobian, blind_to_what_is_seen, without_mis]


@pytest.mark.slow
@pytest.mark.parametrize("mutate", DEFECTS, ids=lambda mutate: mutate.__name__)
def test_defects_fail_the_means(mutate, monkeypatch):
    look_to_one_side(monkeypatch)
    reconnect_all(monkeypatch)
    mutate(monkeypatch)
    assert same_means(rendered("area-restir", scene()), uniform()) < SIGNIFICANCE


def test_forgotten_densities_fail_the_means(monkeypatch):
    as_if_drawn_evenly(monkeypatch)
    assert same_means(rendered("area-restir+lis", scenes.emitters(WIDTH, HEIGHT)), guided()) < SIGNIFICANCE
