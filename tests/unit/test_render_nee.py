"""Resampled light samples: which candidate is kept, its weight, and the second moments that it reports."""

import pytest
import torch

from bokehguide.guiding.cluster_lights import MixtureLights
from bokehguide.guiding.config import GuidedConfig
from bokehguide.render import dimensions
from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from tests.support.choice_cases import learned_choice
from tests.support.rooms import MATERIALS, checkered, room, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, z_test

COUNT = 40_000


class Spot:
    """COUNT copies of a place on the floor of a room with emitters of several kinds and a sky, under a learned choice."""

    def __init__(self, material: str = "coated", count: int = GuidedConfig.light_candidates):
        self.count = count
        tracer = PathTracer(room(MATERIALS[material], sky_with_a_window(6.0), checkered()))
        self.power = tracer.light_sampler
        self.geometry: Geometry = tracer.geometry
        origin = torch.tensor([0.1, 1.3, 1.5])[:, None].repeat(1, COUNT)
        direction = torch.nn.functional.normalize(torch.tensor([-0.1, -0.8, -1.5]), dim=0)[:, None].repeat(1, COUNT)
        self.surface = self.geometry.surface(origin, direction, self.geometry.tracer.intersect(origin, direction))
        self.scattering = Scattering(self.surface, None)
        learned = learned_choice(self.power, COUNT)
        shares = torch.linspace(0.05, 1.0, self.power.lights.clusters.count).repeat(3, 1)
        self.lights = MixtureLights(self.power, learned._row, learned._tables._replace(visibility=shares), count)
        self.random = PixelRandom(3, 1, torch.arange(COUNT))

    def sample(self) -> DirectLight:
        return self.lights.sample(self.surface, self.scattering, self.random.uniform(0, 6), self.random)

    def weight(self, pdf: torch.Tensor, bsdf_pdf: torch.Tensor) -> torch.Tensor:
        """Weight of the multi-sample power heuristic (Veach 1997), divided by the density of one candidate."""
        return 1.0 / (1.0 + (bsdf_pdf / (self.count * pdf)).square()) / pdf

    def candidates(self) -> tuple[torch.Tensor, ...]:
        """Direction `[C, 3, COUNT]` of each of C candidates; luminance and resampling target, float64, and density of the BSDF,
        `[C, COUNT]`."""
        query = self.power.lights.query(self.surface.position)
        first, directions, bright, target, densities = self.random.uniform(0, 6), [], [], [], []
        for number in range(self.count):
            uniforms = self.random.uniform(dimensions.candidate(number), 6) if number else first.clone()
            uniforms[0] = ((first[0] + number / self.count) % 1.0).clamp(2.0**-24, 1.0 - 2.0**-24)
            light = self.lights.draw(query, uniforms)
            value, pdf = self.scattering.evaluate(light.direction)
            weight = self.weight(light.pdf, pdf)
            directions.append(light.direction)
            bright.append(luminance(value * light.radiance * weight).double())
            target.append(bright[-1] * self.lights.expected_visibility(light.cluster))
            densities.append(pdf)
        return tuple(torch.stack(values) for values in (directions, bright, target, densities))


def test_candidates_are_kept_in_proportion_to_their_targets():
    """Against plain arithmetic over all candidates: which one is kept, how often, and its weight."""
    spot = Spot()
    directions, bright, target, densities = spot.candidates()
    found = spot.sample()
    lit = target.sum(0) > 0.0
    same = (directions == found.direction[None]).all(1) & lit
    assert bool((same.sum(0) == lit).all())
    torch.testing.assert_close(found.bsdf_pdf * lit, (densities * same).amax(0))
    chance = target / target.sum(0).clamp(min=1e-30)
    difference = (same.double() - chance) * lit
    errors = (chance * (1.0 - chance)).sum(1).sqrt()
    assert z_test(difference.sum(1).numpy(), errors.numpy()) > SIGNIFICANCE
    kept = (same * bright).sum(0)
    expected = kept / (spot.count * (same * chance).sum(0).clamp(min=1e-30))
    torch.testing.assert_close(luminance(found.value).double(), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("material", ["coated", "glossy metal"])
def test_resampling_keeps_the_mean_and_reduces_the_variance(material):
    """With four candidates."""
    spot = Spot(material, 4)
    one, best = spot.candidates()[1][1], luminance(spot.sample().value).double()
    error = ((one.var() + best.var()) / COUNT).sqrt()
    assert z_test((one.mean() - best.mean())[None].numpy(), error[None].numpy()) > SIGNIFICANCE
    assert float(best.var()) < 0.6 * float(one.var())


def test_squared_contributions_are_second_moments_by_cluster():
    """Against samples of the same choice without resampling."""
    spot = Spot()
    query = spot.power.lights.query(spot.surface.position)
    light = spot.lights.draw(query, PixelRandom(9, 1, torch.arange(COUNT)).uniform(0, 6))
    value, pdf = spot.scattering.evaluate(light.direction)
    weight = spot.weight(light.pdf, pdf)
    plain = (luminance(value * light.radiance * weight).square() * light.share).double()
    found = spot.sample()
    squared = found.clusters.contribution_rms.double().square()
    differences, errors = [], []
    for cluster in light.cluster.unique().tolist():
        one, other = plain * (light.cluster == cluster), squared * (found.clusters.cluster == cluster)
        if int((one > 0.0).sum()) >= 50:  # fewer do not show the spread
            differences.append(one.mean() - other.mean())
            errors.append(((one.var() + other.var()) / COUNT).sqrt())
    assert len(errors) > 10
    assert z_test(torch.stack(differences).numpy(), torch.stack(errors).numpy()) > SIGNIFICANCE


def test_the_expected_visibility_is_that_of_the_row_and_the_cluster():
    spot = Spot()
    count = spot.power.lights.clusters.count
    visibility = torch.rand(3, count, generator=torch.Generator().manual_seed(1))
    row, cluster = torch.cartesian_prod(torch.arange(3), torch.arange(count)).int().T.contiguous()
    lights = MixtureLights(spot.power, row, spot.lights._tables._replace(visibility=visibility))
    assert torch.equal(lights.expected_visibility(cluster), visibility.flatten())
