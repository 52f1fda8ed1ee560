"""Resampled light samples: which candidate is kept, its weight, and the second moments that it reports."""

import pytest
import torch

from bokehguide.guiding.cluster_lights import ClusterSample, Counts, MixtureLights
from bokehguide.render import dimensions
from bokehguide.render.bsdf.mixture import Scattering
from bokehguide.render.geometry import Geometry
from bokehguide.render.lights.base import DirectLight
from bokehguide.render.mis import BROAD
from bokehguide.render.path_tracer import PathTracer
from bokehguide.render.random import PixelRandom
from bokehguide.render.vector import luminance
from tests.support.choice_cases import COUNTS, learned_choice
from tests.support.rooms import MATERIALS, checkered, room, sky_with_a_window
from tests.support.statistical import SIGNIFICANCE, z_test

COUNT = 40_000


class Spot:
    """COUNT copies of a place on the floor of a room with emitters of several kinds and a sky, under a learned choice."""

    def __init__(self, material: str = "coated", counts: Counts = COUNTS):
        self.count, self.bsdf_count = counts
        tracer = PathTracer(room(MATERIALS[material], sky_with_a_window(6.0), checkered()))
        self.power = tracer.light_sampler
        self.geometry: Geometry = tracer.geometry
        origin = torch.tensor([0.1, 1.3, 1.5])[:, None].repeat(1, COUNT)
        direction = torch.nn.functional.normalize(torch.tensor([-0.1, -0.8, -1.5]), dim=0)[:, None].repeat(1, COUNT)
        self.surface = self.geometry.surface(origin, direction, self.geometry.tracer.intersect(origin, direction))
        self.scattering = Scattering(self.surface, None)
        learned = learned_choice(self.power, COUNT)
        self.factor = learned._tables.factor[learned._row]
        shares = torch.linspace(0.05, 1.0, self.power.lights.clusters.count).repeat(3, 1)
        self.lights = MixtureLights(self.power, learned._row, learned._tables._replace(visibility=shares), counts)
        self.random = PixelRandom(3, 1, torch.arange(COUNT))

    def sample(self) -> DirectLight:
        return self.lights.sample(self.surface, self.scattering, self.random.uniform(0, 6), self.random)

    def weighed(self, light: torch.Tensor, pdf: torch.Tensor, bsdf_pdf: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Contributions of reflected light that all candidates together find with the density `pdf`, as if each light sample
        found all of the light: with the factor of the broad part, and by the power heuristic alone."""
        whole = light * (self.count * pdf / (pdf.square() + bsdf_pdf.square()).clamp(min=1e-30))
        broad = bsdf_pdf.square() / (bsdf_pdf.square() + (pdf / BROAD).square()).clamp(min=1e-30)
        return whole * (1.0 - (1.0 - self.factor) * broad), whole

    def light_value(self, light: ClusterSample) -> tuple[torch.Tensor, ...]:
        """`weighed` for a light sample, and the density of the BSDF."""
        value, pdf = self.scattering.evaluate(light.direction)
        of_bsdf = torch.where(light.distance > 1e30, self.bsdf_count * pdf, 0.0)
        return *self.weighed(value * light.radiance, self.count * light.pdf + of_bsdf, pdf), pdf

    def bsdf_value(self, uniforms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The same for a BSDF sample, and its direction."""
        direction, weight, pdf = self.scattering.sample(uniforms)
        together = self.count * self.lights.environment_pdf(self.surface.position, direction) + self.bsdf_count * pdf
        light = weight * pdf * self.power.lights.environment.radiance(direction)
        return *self.weighed(light, together, pdf), pdf, direction

    def candidates(self) -> tuple[torch.Tensor, ...]:
        """Direction `[C, 3, COUNT]` of each of C candidates; luminance and resampling target, float64, and density of the BSDF,
        `[C, COUNT]`. The choices of cluster are stratified."""
        query, first, found = self.power.lights.query(self.surface.position), dimensions.vertex(1), []
        for number in range(self.count):
            light = self.random.stratified(first + dimensions.LIGHT, 6, 1, number) if number else self.random.uniform(0, 6)
            stratum = (light[:1] + number) / self.count
            drawn = self.lights.draw(query, torch.cat((stratum, light[1:])))
            found.append((*self.light_value(drawn), drawn.direction, drawn.cluster))
        for number in range(1, self.bsdf_count + 1):
            scatter = self.random.stratified(first + dimensions.SCATTER, dimensions.SCATTER_COUNT, 1, number)
            *values, direction = self.bsdf_value(dimensions.bsdf_numbers(scatter))
            texel = self.power.lights.sampled_environment.texels(direction)
            found.append((*values, direction, self.power.lights.clusters.cluster(texel)))
        value, whole, densities, directions, cluster = (torch.stack(each) for each in zip(*found))
        bright, whole = (torch.stack([luminance(each).double() for each in light]) for light in (value, whole))
        target = whole * torch.stack([self.lights.expected_visibility(each) for each in cluster])
        return directions, bright, target, densities


@pytest.mark.parametrize("counts", [COUNTS, Counts(3, 0), Counts(2, 3)])
def test_candidates_are_kept_in_proportion_to_their_targets(counts):
    """Against plain arithmetic over all candidates: which one is kept, how often, and its weight."""
    spot = Spot(counts=counts)
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


@pytest.mark.parametrize("bsdf, share", [(0, 0.6), (1, 1.0)])
@pytest.mark.parametrize("material", ["coated", "glossy metal"])
def test_resampling_keeps_the_mean_and_reduces_the_variance(material, bsdf, share):
    """With four light samples; against one light sample and the BSDF sample, if there is one."""
    spot = Spot(material, Counts(4, bsdf))
    bright, best = spot.candidates()[1], luminance(spot.sample().value).double()
    light = spot.lights.draw(spot.power.lights.query(spot.surface.position), PixelRandom(8, 1, torch.arange(COUNT)).uniform(0, 6))
    one = luminance(spot.light_value(light)[0]).double() + bright[4:].sum(0) / 4
    error = ((one.var() + best.var()) / COUNT).sqrt()
    assert z_test((one.mean() - best.mean())[None].numpy(), error[None].numpy()) > SIGNIFICANCE
    assert float(best.var()) < share * float(one.var())


def test_squared_contributions_are_second_moments_by_cluster():
    """Against samples of the same choice without resampling."""
    spot = Spot()
    query = spot.power.lights.query(spot.surface.position)
    light = spot.lights.draw(query, PixelRandom(9, 1, torch.arange(COUNT)).uniform(0, 6))
    plain = (luminance(spot.light_value(light)[0]).square() * light.share).double()
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
    lights = MixtureLights(spot.power, row, spot.lights._tables._replace(visibility=visibility), COUNTS)
    assert torch.equal(lights.expected_visibility(cluster), visibility.flatten())
