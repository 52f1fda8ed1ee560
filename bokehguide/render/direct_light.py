"""Light samples and their MIS weights; where the choice of lights is learnt, the best of a few."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render import mis
from bokehguide.render.geometry import Surface
from bokehguide.render.light_choice import LightChoice
from bokehguide.render.lights import LightQuery, Lights, LightSample
from bokehguide.render.random import PixelRandom
from bokehguide.render.scattering import Scattering
from bokehguide.render.vector import luminance

CANDIDATES = 4
"""Light samples under a `LightChoice` of which one is kept."""
FIRST_CANDIDATE = 1 << 16
"""Random dimensions from here on are those of the candidates after the first, SPARE of them each."""
SPARE = 8


class DirectLight(NamedTuple):
    """One light sample for each of N paths.

    direction: unit, `[3, N]`; distance `[N]`; value: what it would bring, unshadowed, over its density and with its MIS
    weight, `[3, N]`. Under a `LightChoice`, also its cluster, int64 `[N]`, and its worth (see `PathSamples`) if nothing
    blocks it, `[N]`.
    """

    direction: Tensor
    distance: Tensor
    value: Tensor
    cluster: Tensor | None = None
    worth: Tensor | None = None


def direct_light(
    lights: Lights,
    surface: Surface,
    scattering: Scattering,
    choice: LightChoice | None,
    uniforms: Tensor,
    random: PixelRandom,
) -> DirectLight:
    """Next-event estimation from uniform numbers `[6, N]`.

    Under a choice it is resampled (Talbot et al. 2005): of CANDIDATES samples one is kept by the luminance that it may
    be expected to bring. For MIS they count as one: what blocks the way to a light is asked for one alone.
    """
    query = lights.query(surface.position, choice)
    light, value = _candidate(lights, query, scattering, uniforms)
    if choice is None:
        return DirectLight(light.direction, light.distance, value)
    target = total = _target(value, light, choice)
    kept, cluster = _joined(light, value, target), light.cluster
    for number in range(1, CANDIDATES):
        spare = random.uniform(FIRST_CANDIDATE + SPARE * number, 7)
        # The choice among clusters is even over the candidates, as it is over the steps.
        spare[0] = ((uniforms[0] + number / CANDIDATES) % 1.0).clamp(2.0**-24, 1.0 - 2.0**-24)
        light, value = _candidate(lights, query, scattering, spare)
        target = _target(value, light, choice)
        total = total + target
        better = (spare[6] * total < target).nonzero()[:, 0]
        kept.index_copy_(1, better, _joined(light, value, target).index_select(1, better))
        cluster.index_copy_(0, better, light.cluster.index_select(0, better))
    scale = total / (CANDIDATES * kept[8].clamp(min=1e-30))
    worth = luminance(kept[4:7]) * (kept[7] * scale).sqrt()
    return DirectLight(kept[0:3], kept[3], kept[4:7] * scale, cluster, worth)


def _target(value: Tensor, light: LightSample, choice: LightChoice) -> Tensor:
    """What candidates are kept by, `[N]`: the luminance they may be expected to bring."""
    return luminance(value) * choice.visibility(light.cluster)


def _joined(light: LightSample, value: Tensor, target: Tensor) -> Tensor:
    return torch.cat((light.direction, light.distance[None], value, light.share[None], target[None]))


def _candidate(lights: Lights, query: LightQuery, scattering: Scattering, uniforms: Tensor) -> tuple[LightSample, Tensor]:
    """A light sample, and BSDF times cosine times radiance over its density, with its MIS weight, `[3, N]`."""
    light = lights.draw(query, uniforms)
    value, pdf = scattering.evaluate(light.direction)
    return light, value * light.radiance * (mis.power_heuristic(light.pdf, pdf) / light.pdf.clamp(min=1e-30))
