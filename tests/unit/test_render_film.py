"""The film: means, variances, alpha under weights, and samples that are not numbers."""

import math
import pickle
from copy import deepcopy

import numpy as np
import pytest
import torch

from bokehguide.render.bad_samples import KEPT_BAD_SAMPLES, BadSample
from bokehguide.render.features import ControlVariateFeatures, MeanFeatures, RatioFeatures
from bokehguide.render.film import NO_DEPTH, Film, FilmSamples
from bokehguide.render.halves_film import HalfFilm, HalvesFilm
from bokehguide.render.random import PixelRandom
from bokehguide.render.split_film import SplitFilm
from bokehguide.render.vector import luminance
from bokehguide.runtime.indexing import bands
from tests.support.statistical import SIGNIFICANCE, z_test


def samples(radiance: torch.Tensor, weight=1.0, alpha=1.0, depth=2.0) -> FilmSamples:
    """Film samples of `radiance` `[3, N]`, the other fields numbers or `[N]`."""

    def whole(value):
        return torch.as_tensor(value, dtype=torch.float32).expand(radiance.shape[1]).clone()

    normal = torch.zeros_like(radiance)
    normal[2] = 1.0
    alpha, albedo = whole(alpha), torch.tensor([[0.2], [0.4], [0.6]])
    return FilmSamples(whole(weight), radiance, alpha, whole(depth), normal * alpha, albedo * alpha, 0.25 * radiance)


def random(step: int, count: int) -> torch.Tensor:
    return PixelRandom(11, step, torch.arange(count)).uniform(0, 4)


def test_mean_and_variance_are_those_of_the_weighted_samples():
    film, history = Film(5, 4), []
    for step in range(1, 9):
        uniforms = random(step, 20)
        weight = 2.0 * uniforms[3]
        film.add(slice(None), samples(uniforms[:3], weight), step)
        history.append(uniforms[:3].double() * weight)
    history = torch.stack(history)
    expected = history.mean(0).T.reshape(4, 5, 3).float()
    torch.testing.assert_close(film.radiance(), expected)
    light = luminance(history.transpose(0, 1))
    torch.testing.assert_close(film.variance(), (light.var(0) / 8).reshape(4, 5).float(), rtol=1e-4, atol=1e-8)
    assert film.mean_luminance() == pytest.approx(float(light.mean()), rel=1e-5)
    noise = ((light.var(0) / 8).sqrt() / (light.mean(0) + 0.01)).mean()
    assert film.relative_noise() == pytest.approx(float(noise), rel=1e-4)


def test_variance_is_zero_before_the_second_sample():
    film = Film(3, 2)
    assert not film.variance().any()
    film.add(slice(None), samples(random(1, 6)[:3]), 1)
    assert not film.variance().any()


def test_many_bright_samples_lose_no_digits():
    film = Film(1, 1)
    value = torch.full((3, 1), 1e6) + 0.0625
    for step in range(3000):
        film.add(slice(None), samples(value.clone()), step)
    assert film.radiance()[0, 0, 0].item() == value[0, 0].item()


@pytest.mark.parametrize(
    "cut", [(slice(13, 20), slice(0, 13)), (torch.arange(0, 20, 3), torch.tensor([i for i in range(20) if i % 3]))]
)
def test_batches_fall_on_their_own_pixels(cut):
    whole, parts = Film(5, 4), Film(5, 4)
    for step in (1, 2):
        uniforms = random(step, 20)
        radiance, weight = uniforms[:3], 2.0 * uniforms[3]
        radiance[1, 17] = math.nan if step == 2 else 0.5
        whole.initialise(slice(None), samples(radiance))
        whole.add(slice(None), samples(radiance, weight), step)
        for pixels in cut:
            parts.initialise(pixels, samples(radiance[:, pixels]))
            parts.add(pixels, samples(radiance[:, pixels], weight[pixels]), step)
    assert parts.bad_samples == whole.bad_samples == [BadSample(2, 3, 2, 0)]
    for name, layer in whole.layers().items():
        np.testing.assert_array_equal(parts.layers()[name], layer)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_pixels_that_are_opaque_or_empty_throughout_have_exactly_that_alpha(alpha):
    """The first step is uniform, so its weights are 1; the weights that follow may be anything."""
    film = Film(8, 8)
    film.add(slice(None), samples(random(1, 64)[:3], 1.0, alpha), 1)
    for step in range(2, 40):
        uniforms = random(step, 64)
        weight = (uniforms[3] > 0.3) * 3.0 * uniforms[0]
        film.add(slice(None), samples(uniforms[:3], weight, alpha * (weight > 0.0)), step)
    np.testing.assert_array_equal(film.layers()["alpha"], alpha)


def test_samples_that_are_not_finite_stay_off_the_film_and_are_reported():
    film, clean = Film(5, 4, seed=9), Film(5, 4)
    for step in (1, 2, 3):
        radiance, weight = random(step, 20)[:3], torch.ones(20)
        kept = torch.ones(20, dtype=torch.bool)
        clean.add(slice(None), samples(radiance.clone()), step)
        if step == 2:
            radiance[1, 7], radiance[:, 13], weight[4] = math.nan, math.inf, math.nan
            kept[[4, 7, 13]] = False
            untouched = film.radiance().reshape(20, 3)[~kept]
        good = film.add(slice(None), samples(radiance, weight), step)
        assert torch.equal(good, kept)
        if step == 2:
            torch.testing.assert_close(film.radiance().reshape(20, 3)[~kept], untouched)
    assert film.bad_count == 3
    assert film.bad_samples == [(4, 0, 2, 9), (2, 1, 2, 9), (3, 2, 2, 9)]
    assert film.bad_samples[0]._fields == ("x", "y", "step", "seed")
    layers = film.layers()
    counts = layers["sample_count"].reshape(20)
    assert counts[[4, 7, 13]].tolist() == [2.0, 2.0, 2.0] and counts.sum() == 57
    assert all(np.isfinite(layer).all() for layer in layers.values())
    hidden = np.ones(20, bool)
    hidden[[4, 7, 13]] = False
    np.testing.assert_allclose(
        layers["beauty"].reshape(20, 3)[hidden], clean.layers()["beauty"].reshape(20, 3)[hidden], rtol=1e-6
    )
    np.testing.assert_array_equal(layers["alpha"], 1.0)


KINDS = {"plain": MeanFeatures, "weighted": ControlVariateFeatures, "vignetted": RatioFeatures}


@pytest.mark.parametrize("kind", KINDS)
def test_samples_that_do_not_count_are_as_if_they_had_never_been(kind):
    """A sixth of them is not finite. Where weights are controlled, what does not count may tell of the control all the same:
    there the surfaces are opaque and at one depth."""
    masked, few = Film(8, 6, features=KINDS[kind]), Film(8, 6, features=KINDS[kind])
    for step in range(1, 13):
        uniforms, choice = random(step, 48), PixelRandom(12, step, torch.arange(48)).uniform(0, 4)
        counted = (choice[0] < 0.6) | (step == 1)
        weight = torch.ones(48) if kind == "plain" else 2.0 * uniforms[3]
        alpha, depth = (choice[1] < 0.7).float(), 2.0 + (choice[2] * counted).round()
        every = samples(uniforms[:3], weight, 1.0 if kind == "weighted" else alpha, 2.0 if kind == "weighted" else depth)
        every.radiance[1, choice[3] < 1.0 / 6.0] = math.nan
        masked.add(slice(None), every, step, counted=counted)
        kept = counted.nonzero()[:, 0]
        chosen = {name: values[..., kept] for name, values in vars(every).items() if values is not None}
        few.add(kept, FilmSamples(**chosen), step)
    found, expected = masked.layers(), few.layers()
    assert 0.0 < expected["sample_count"].min() < expected["sample_count"].max() < 12.0
    for name in found:  # the control is a mean of other samples, of the same value but for rounding
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-6 if kind == "weighted" else 0.0, err_msg=name)
    if kind == "vignetted":
        np.testing.assert_allclose(found["normal"][..., 2], found["alpha"], rtol=1e-6)


def test_bad_samples_of_a_crop_are_told_by_their_place_in_the_frame():
    film = Film(4, 3, seed=5, corner=(10, 20))
    radiance = random(1, 12)[:3]
    radiance[0, 6] = math.nan
    film.add(slice(None), samples(radiance), 3)
    assert film.bad_samples == [BadSample(x=12, y=21, step=3, seed=5)]


def test_every_bad_sample_is_counted_and_the_first_are_kept():
    film = Film(50, 3)
    film.add(slice(None), samples(torch.full((3, 150), math.nan)), 1)
    assert film.bad_count == 150
    assert len(film.bad_samples) == KEPT_BAD_SAMPLES
    assert not film.layers()["beauty"].any()


def test_layers_are_contiguous_float32_of_the_frames_shape():
    film = Film(5, 4)
    film.add(slice(None), samples(random(1, 20)[:3]), 1)
    layers = film.layers()
    for name, layer in layers.items():
        colored = name in ("beauty", "normal", "albedo", "emission")
        assert layer.shape == ((4, 5, 3) if colored else (4, 5)), name
        assert layer.dtype == np.float32 and layer.flags.c_contiguous, name


@pytest.mark.parametrize("features", [MeanFeatures, RatioFeatures, ControlVariateFeatures])
def test_bands_change_no_bit(features, monkeypatch):
    film = Film(5, 4, features=features)
    film.initialise(slice(None), samples(random(9, 20)[:3]))
    for step in (1, 2, 3):
        uniforms = random(step, 20)
        depth = torch.where(uniforms[0] < 0.3, NO_DEPTH, 1.0 + uniforms[1])
        film.add(slice(None), samples(uniforms[:3], 2.0 * uniforms[3], uniforms[2], depth), step)
    found = {**film.layers(), "radiance": film.radiance(), "noise": film.relative_noise()}
    monkeypatch.setattr(Film, "_bands", lambda _: bands(20, 7))
    for name, layer in {**film.layers(), "radiance": film.radiance(), "noise": film.relative_noise()}.items():
        np.testing.assert_array_equal(layer, found[name], err_msg=name)


def test_depth_is_the_mean_over_the_samples_that_met_a_surface():
    film = Film(3, 1)
    radiance = torch.zeros(3, 3)
    film.add(slice(None), samples(radiance, torch.tensor([1.0, 1.0, 1.0]), 1.0, torch.tensor([2.0, 4.0, NO_DEPTH])), 1)
    film.add(slice(None), samples(radiance, torch.tensor([1.0, 0.0, 1.0]), 1.0, torch.tensor([6.0, 9.0, NO_DEPTH])), 2)
    film.add(slice(None), samples(radiance, torch.tensor([1.0, 1.0, 1.0]), 0.0, NO_DEPTH), 3)
    np.testing.assert_allclose(film.layers()["depth"], [[4.0, 4.0, NO_DEPTH]])


def test_depth_stays_within_what_was_seen():
    """However the weights fall: as they do here, a quotient of means alone would be 8."""
    film = Film(1, 1)
    for step, (weight, depth) in enumerate([(1.0, 2.0), (3.0, 6.0)], start=1):
        film.add(slice(None), samples(torch.zeros(3, 1), torch.tensor([weight]), 1.0, torch.tensor([depth])), step)
    np.testing.assert_allclose(film.layers()["depth"], [[6.0]])


def test_a_primed_film_is_exact_from_the_first_sample_on():
    """Whatever that sample's weight, and without a sample more."""
    film = Film(2, 1)
    film.initialise(slice(None), samples(torch.zeros(3, 2), torch.ones(2), 1.0, torch.tensor([5.0, 5.0])))
    assert not film.layers()["sample_count"].any()
    film.add(slice(None), samples(torch.zeros(3, 2), torch.tensor([0.0, 7.0]), 1.0, torch.tensor([5.0, 5.0])), 1)
    layers = film.layers()
    np.testing.assert_array_equal(layers["alpha"], 1.0)
    np.testing.assert_array_equal(layers["depth"], 5.0)
    np.testing.assert_array_equal(layers["sample_count"], 1.0)


def test_what_is_the_same_in_every_sample_comes_out_so_whatever_the_weights():
    film = Film(8, 8)
    for step in range(1, 30):
        uniforms = random(step, 64)
        film.add(slice(None), samples(uniforms[:3], 1.0 if step == 1 else 5.0 * uniforms[3].square()), step)
    layers = film.layers()
    np.testing.assert_allclose(layers["albedo"], np.broadcast_to([0.2, 0.4, 0.6], (8, 8, 3)), rtol=1e-5)
    np.testing.assert_array_equal(layers["normal"], np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3)))


def test_emission_has_the_weights_of_the_beauty():
    film = Film(8, 8)
    for step in range(1, 9):
        uniforms = random(step, 64)
        film.add(slice(None), samples(uniforms[:3], 2.0 * uniforms[3]), step)
    layers = film.layers()
    np.testing.assert_allclose(layers["emission"], 0.25 * layers["beauty"], rtol=1e-6)


def test_a_sample_that_is_not_finite_leaves_alpha_exact_even_if_it_is_the_first():
    film = Film(4, 1)
    for step in range(1, 6):
        radiance = random(step, 4)[:3]
        if step == 1:
            radiance[:] = math.nan
        one = samples(radiance, 1.0 if step == 1 else 3.0 * random(step, 4)[3])
        if step == 1:
            one.normal[:] = math.nan
        film.add(slice(None), one, step)
    layers = film.layers()
    np.testing.assert_array_equal(layers["alpha"], 1.0)
    assert all(np.isfinite(layer).all() for layer in layers.values()) and layers["sample_count"].max() == 4.0


def test_alpha_is_unbiased_when_draws_favour_what_is_opaque():
    """Half the lens is covered; guided steps draw there 63 % of the time, elsewhere 27 %, and outside the rest."""
    film = Film(128, 64)
    for step in range(1, 30):
        draw = random(step, 8192)[0]
        covered, outside = draw < 0.63, draw > 0.9
        weight = torch.where(covered, 0.5 / 0.63, 0.5 / 0.27) * ~outside
        if step == 1:
            covered, weight = draw < 0.5, torch.ones(8192)
        film.add(slice(None), samples(torch.zeros(3, 8192), weight, covered.float()), step)
    layers = film.layers()
    expected = {"alpha": 0.5, "albedo": (0.1, 0.2, 0.3), "normal": (0.0, 0.0, 0.5)}
    for name, value in expected.items():
        layer = layers[name].astype(float).reshape(8192, -1)
        assert z_test(layer.mean(0) - value, layer.std(0) / math.sqrt(8192)) > SIGNIFICANCE, name


@pytest.mark.parametrize("emitter", [0.01, 0.3])
def test_alpha_is_nearly_as_smooth_with_a_guide_as_without(emitter):
    """Opaque emitters before nothing, which cover `emitter` of the lens and get four draws of five."""
    plain, guided = Film(128, 64), Film(128, 64)
    for step in range(1, 17):
        draw = random(step, 8192)[0]
        plain.add(slice(None), samples(torch.zeros(3, 8192), 1.0, (draw < emitter).float()), step)
        share = emitter if step == 1 else 0.8 + 0.2 * emitter
        covered = draw < share
        weight = torch.where(covered, emitter / share, (1.0 - emitter) / (1.0 - share))
        guided.add(slice(None), samples(torch.zeros(3, 8192), weight, covered.float()), step)
    errors = [float(np.sqrt(np.square(film.layers()["alpha"] - emitter).mean())) for film in (plain, guided)]
    assert errors[1] < 2.0 * errors[0]


def test_a_control_from_before_the_block_leaves_stratified_samples_unbiased():
    """One sample in either half of the lens, in random order: weights 0.5 and 1.5, of which the first sees a surface."""
    expected, found = 0.25, {}
    for recenter in (False, True):
        means = []
        for order in ((0, 1), (1, 0)):
            film = Film(1, 1)
            film.initialise(slice(None), samples(torch.zeros(3, 1), torch.ones(1), 0.3, torch.tensor([2.0])))
            for step, half in enumerate(order, start=1):
                one = samples(torch.zeros(3, 1), torch.tensor([(0.5, 1.5)[half]]), (1.0, 0.0)[half], torch.tensor([2.0]))
                film.add(slice(None), one, step, recenter=recenter or step == 1)
            means.append(film.layers()["alpha"].item())
        found[recenter] = np.mean(means)
    assert found[False] == pytest.approx(expected, abs=1e-6)
    assert abs(found[True] - expected) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("features", [ControlVariateFeatures, RatioFeatures])
def test_ten_thousand_steps_do_not_drift(features):
    """Against sums in double precision; a float32 sum of 0.3 is off by 4e-4 then."""
    film = Film(4, 2, features=features)
    constant = FilmSamples(
        torch.ones(8), *(0.3 * torch.ones(3, 8), torch.ones(8), torch.full((8,), 0.7)), *(0.3 * torch.ones(3, 3, 8))
    )
    noise = random(1, 10_000).double()
    for step in range(10_000):
        constant.radiance = noise[:3, step, None].float().expand(3, 8).clone()
        film.add(slice(None), constant, step + 1)
    layers = film.layers()
    np.testing.assert_allclose(layers["beauty"][0, 0], noise[:3].mean(1).numpy(), rtol=2e-7)
    for name in ("normal", "albedo", "emission"):
        np.testing.assert_allclose(layers[name], np.float32(0.3), rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(layers["depth"], np.float32(0.7), rtol=1e-7)
    np.testing.assert_array_equal(layers["alpha"], 1.0)
    assert (layers["sample_count"] == 10_000).all()
    light = luminance(noise[:3])
    np.testing.assert_allclose(layers["variance"], float(light.var() / 10_000), rtol=1e-6)


def test_the_features_of_a_pixel_whose_samples_are_all_blocked_are_0():
    features = RatioFeatures(2, rows=1)
    features.add(slice(0, 2), torch.full((1, 2), 3.0), torch.tensor([0.0, 0.5]), torch.ones(2))
    assert features.means(torch.ones(2)).tolist() == [[0.0, 3.0]]


def test_a_weight_that_is_not_a_number_stays_off_the_film():
    """Also where the radiance has a weight of its own, as that of pixels that share samples."""
    film, radiance = Film(3, 2), random(1, 6)[:3]
    film.add(slice(None), samples(radiance), 1)
    for step, wrong in ((2, math.nan), (3, math.inf)):
        weight = torch.ones(6)
        weight[4] = wrong
        bad = samples(radiance, weight)
        bad.radiance_weight = torch.ones(6)
        assert film.add(slice(None), bad, step).tolist() == [True] * 4 + [False, True]
    assert all(np.isfinite(layer).all() for layer in film.layers().values())
    assert [(sample.x, sample.y, sample.step) for sample in film.bad_samples] == [(1, 1, 2), (1, 1, 3)]


COPIES = {"deepcopy": deepcopy, "pickle": lambda film: pickle.loads(pickle.dumps(film))}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("kind", [Film, SplitFilm, HalfFilm, HalvesFilm])
def test_films_can_be_copied_and_pickled(kind, copied):
    """With all layers, and with bad samples that are not yet counted. A copy goes on by itself."""
    objects, bad = {"object": torch.tensor([1, 2], dtype=torch.int32)}, torch.ones(3, 20)
    bad[0, 7] = math.nan
    films = []
    for seed in range(2):
        film = (Film if kind is HalvesFilm else kind)(5, 4, seed, objects=objects, groups=("lamps",))
        for step, radiance in enumerate((random(1 + seed, 20)[:3], bad), 1):
            added = samples(radiance)
            added.triangle, added.groups = torch.zeros(20, dtype=torch.int32), radiance[None]
            film.add(slice(None), added, step)
        films.append(film)
    film = HalvesFilm(*films) if kind is HalvesFilm else films[0]
    other = copied(film)
    assert type(other) is kind and other.bad_samples == film.bad_samples and other.bad_count == film.bad_count > 0
    for name, layer in film.layers().items():
        np.testing.assert_array_equal(other.layers()[name], layer, err_msg=name)
    np.testing.assert_array_equal(other.light_groups()["lamps"], film.light_groups()["lamps"])
    assert torch.equal(other.covered()["object"].numbers, film.covered()["object"].numbers)
    if kind is not HalvesFilm:
        other.load_state_dict(copied(film.state_dict()))
        other.add(slice(None), added, 3)
        assert other.samples() == film.samples() + 19
