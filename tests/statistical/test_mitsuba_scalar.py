"""The integrator `guided_thinlens` in the scalar variants: the decisions and the pictures of the other variants."""

import numpy as np
import pytest

pytest.importorskip("mitsuba")
import drjit as dr
import mitsuba as mi

mi.set_variant("scalar_rgb")
MITSUBA_VARIANT = "scalar_rgb"

import bokehguide.mitsuba  # noqa: F401 - registers the integrator
from bokehguide.mitsuba import rendering
from bokehguide.mitsuba.one_by_one import OneByOne
from tests.support.mitsuba_scenes import PATH, agree, blocks, guided, lamps, runs


@pytest.fixture(scope="module")
def expected():
    """Block means by Mitsuba alone."""
    return runs(mi.load_dict(lamps()), mi.load_dict(PATH), 1024, seed=100)


@pytest.mark.parametrize("mode", ["lis-b", pytest.param("guided", marks=pytest.mark.slow)])
def test_the_means_are_mitsubas(mode, expected):
    assert agree(runs(mi.load_dict(lamps()), guided(mode), 12, count=6), expected)


def test_without_highlights_the_picture_is_mitsubas():
    """The pilot finds nothing that a lens point could aim at, and Mitsuba renders alone."""
    scene = mi.load_dict({name: part for name, part in lamps().items() if name not in ("round", "square", "cube")})
    ours, theirs = (
        np.array(mi.render(scene, integrator=integrator, spp=8, seed=3)) for integrator in (guided(), mi.load_dict(PATH))
    )
    np.testing.assert_array_equal(ours, theirs)


def test_pixels_beside_highlights_have_mitsubas_lens_points(expected, monkeypatch):
    """Their means, and the number of their paths."""
    traced = []
    original = OneByOne.trace_uniform

    def trace_uniform(self, pixels, count, *others):
        traced.append((pixels, count))
        original(self, pixels, count, *others)

    monkeypatch.setattr(OneByOne, "trace_uniform", trace_uniform)
    found = runs(mi.load_dict(lamps()), guided(), 24, count=6)
    assert all(count == 20 for _, count in traced) and len(traced) == 6
    beside = np.bincount(np.concatenate([pixels for pixels, _ in traced]), minlength=32 * 18).reshape(18, 32) == 6
    inside = blocks(np.repeat(beside[..., None], 3, axis=2)) == 1.0
    assert inside.sum() > 20, "blocks without a guided pixel"
    assert agree(found[:, inside], expected[:, inside])
    assert not agree(1.1 * found[:, inside], expected[:, inside]), "a tenth shows"


def measured(monkeypatch) -> tuple[list[float], float]:
    """The gains that the pilots of four renders tell, and the mean variance of their pixels."""
    gains = []
    original = rendering.expected_gain

    def expected_gain(*arguments):
        gains.append(original(*arguments))
        return gains[-1]

    with monkeypatch.context() as patch:
        patch.setattr(rendering, "expected_gain", expected_gain)
        scene, integrator = mi.load_dict(lamps(64, 36)), guided()
        pictures = [np.array(mi.render(scene, integrator=integrator, spp=16, seed=seed)).mean(axis=2) for seed in range(4)]
    return gains, float(np.var(pictures, axis=0, ddof=1).mean())


def test_gains_and_noise_are_those_of_the_other_variants(monkeypatch):
    """Equal seeds draw equal lens points, so the gains differ by the random numbers of the paths alone."""
    gains, variance = measured(monkeypatch)
    mi.set_variant("llvm_ad_rgb", "scalar_rgb")
    try:
        if mi.variant() == "scalar_rgb" or dr.detail.llvm_version()[0] < 17:
            pytest.skip("no LLVM that Mitsuba can use")
        others, other_variance = measured(monkeypatch)
        scene = mi.load_dict(lamps(64, 36))
        plain = [np.array(mi.render(scene, integrator=mi.load_dict(PATH), spp=16, seed=s)).mean(axis=2) for s in range(4)]
    finally:
        mi.set_variant("scalar_rgb")
    assert gains == pytest.approx(others, rel=0.1) and min(gains) > 2.0
    assert max(variance, other_variance) < 0.1 * np.var(plain, axis=0, ddof=1).mean()
