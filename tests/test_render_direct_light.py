"""Resampled light samples: what is kept, how much it counts, and what is learnt from it."""

from dataclasses import replace

import pytest
import torch

from bokehguide.render.direct_light import CANDIDATES, FIRST_CANDIDATE, SPARE, DirectLight, direct_light
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights import Lights
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.scattering import Scattering
from bokehguide.render.vector import luminance
from tests.statistical import SIGNIFICANCE, z_test
from tests.test_render_lights import learnt_choice
from tests.test_render_mis import MATERIALS, checkered, room, sky_with_a_window

COUNT = 40_000


class Spot:
    """COUNT times the same place on the floor of a room with lamps of several kinds and a sky, under a learnt choice."""

    def __init__(self, material: str = "coated"):
        tracer = PathTracer(room(MATERIALS[material], sky_with_a_window(6.0), checkered()))
        self.lights: Lights = tracer.lights
        self.geometry: Geometry = tracer.geometry
        origin = torch.tensor([0.1, 1.3, 1.5])[:, None].repeat(1, COUNT)
        direction = torch.nn.functional.normalize(torch.tensor([-0.1, -0.8, -1.5]), dim=0)[:, None].repeat(1, COUNT)
        self.surface = self.geometry.surface(origin, direction, self.geometry.tracer.intersect(origin, direction))
        self.scattering = Scattering(self.surface, None)
        learnt = learnt_choice(self.lights, COUNT)
        shares = torch.linspace(0.05, 1.0, self.lights.clusters.count).repeat(int(learnt.row.max()) + 1, 1)
        self.choice = replace(learnt, seen=shares)
        self.random = PixelRandom(3, 1, torch.arange(COUNT))

    def sample(self, learnt: bool = True) -> DirectLight:
        choice = self.choice if learnt else None
        return direct_light(self.lights, self.surface, self.scattering, choice, self.random.uniform(0, 6), self.random)

    def candidates(self) -> tuple[torch.Tensor, ...]:
        """Of each candidate, one after the other: direction `[CANDIDATES, 3, COUNT]`, what it would bring and what it is
        kept by, float64, and with which density the BSDF samples it, `[CANDIDATES, COUNT]`."""
        query = self.lights.query(self.surface.position, self.choice)
        first, directions, bright, target, densities = self.random.uniform(0, 6), [], [], [], []
        for number in range(CANDIDATES):
            uniforms = self.random.uniform(FIRST_CANDIDATE + SPARE * number, 6) if number else first.clone()
            uniforms[0] = ((first[0] + number / CANDIDATES) % 1.0).clamp(2.0**-24, 1.0 - 2.0**-24)
            light = self.lights.draw(query, uniforms)
            value, pdf = self.scattering.evaluate(light.direction)
            weight = 1.0 / (1.0 + (pdf / light.pdf).square()) / light.pdf
            directions.append(light.direction)
            bright.append(luminance(value * light.radiance * weight).double())
            target.append(bright[-1] * self.choice.seen[self.choice.row, light.cluster])
            densities.append(pdf)
        return tuple(torch.stack(values) for values in (directions, bright, target, densities))


def test_candidates_are_kept_by_what_is_expected_of_them_and_count_for_all():
    """Against plain arithmetic over all of them: which one, how often, how much, and what is learnt from it."""
    spot = Spot()
    directions, bright, target, densities = spot.candidates()
    found = spot.sample()
    lit = target.sum(0) > 0.0
    same = (directions == found.direction[None]).all(1) & lit
    assert bool((same.sum(0) == lit).all())
    torch.testing.assert_close(found.pdf * lit, (densities * same).amax(0))
    chance = target / target.sum(0).clamp(min=1e-30)
    difference = (same.double() - chance) * lit
    errors = (chance * (1.0 - chance)).sum(1).sqrt()
    assert z_test(difference.sum(1).numpy(), errors.numpy()) > SIGNIFICANCE
    kept = (same * bright).sum(0)
    expected = kept / (CANDIDATES * (same * chance).sum(0).clamp(min=1e-30))
    torch.testing.assert_close(luminance(found.value).double(), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("material", ["coated", "glossy metal"])
def test_resampling_keeps_the_mean_and_lessens_the_variance(material, monkeypatch):
    """With four candidates."""
    monkeypatch.setattr("bokehguide.render.direct_light.CANDIDATES", 4)
    spot = Spot(material)
    one, best = spot.candidates()[1][1], luminance(spot.sample().value).double()
    error = ((one.var() + best.var()) / COUNT).sqrt()
    assert z_test((one.mean() - best.mean())[None].numpy(), error[None].numpy()) > SIGNIFICANCE
    assert float(best.var()) < 0.6 * float(one.var())


def test_worth_squared_is_the_sum_of_second_moments_by_cluster():
    """Against samples of the same choice that were not resampled."""
    spot = Spot()
    query = spot.lights.query(spot.surface.position, spot.choice)
    light = spot.lights.draw(query, PixelRandom(9, 1, torch.arange(COUNT)).uniform(0, 6))
    value, pdf = spot.scattering.evaluate(light.direction)
    weight = 1.0 / (1.0 + (pdf / light.pdf).square()) / light.pdf
    plain = (luminance(value * light.radiance * weight).square() * light.share).double()
    found = spot.sample()
    squared = found.worth.double().square()
    differences, errors = [], []
    for cluster in light.cluster.unique().tolist():
        one, other = plain * (light.cluster == cluster), squared * (found.cluster == cluster)
        if int((one > 0.0).sum()) >= 50:  # of fewer no spread can be told
            differences.append(one.mean() - other.mean())
            errors.append(((one.var() + other.var()) / COUNT).sqrt())
    assert len(errors) > 10
    assert z_test(torch.stack(differences).numpy(), torch.stack(errors).numpy()) > SIGNIFICANCE
