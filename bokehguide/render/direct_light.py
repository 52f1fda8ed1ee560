"""Light samples and their MIS weights; where the choice of lights is learnt, the best of a few."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bokehguide.render import mis
from bokehguide.render.geometry import Surface
from bokehguide.render.kernels import kernel
from bokehguide.render.light_choice import LightChoice
from bokehguide.render.lights import LightQuery, Lights, LightSample
from bokehguide.render.random import PixelRandom
from bokehguide.render.scattering import Scattering
from bokehguide.render.vector import luminance

CANDIDATES = 2
"""Light samples under a `LightChoice` of which one is kept."""
FIRST_CANDIDATE = 1 << 16
"""Random dimensions from here on are those of the candidates after the first, SPARE of them each."""
SPARE = 8


class DirectLight(NamedTuple):
    """One light sample for each of N paths.

    direction: unit, `[3, N]`; distance `[N]`; value: what it would bring, unshadowed, over its density and with its MIS
    weight, `[3, N]`; pdf: the density with which the BSDF samples its direction, `[N]`. Under a `LightChoice`, also its
    cluster, int32 `[N]`, and its worth (see `PathSamples`) if nothing blocks it, `[N]`.
    """

    direction: Tensor
    distance: Tensor
    value: Tensor
    pdf: Tensor
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
    light, other = _candidate(lights, query, scattering, uniforms)
    if choice is None:
        return DirectLight(light.direction, light.distance, _worth(light, other, None)[0], other[1])
    value, total = _worth(light, other, choice.visibility(light.cluster))
    kept = _Kept(light.direction, light.distance, value, light.share, total, light.cluster, other[1])
    for number in range(1, CANDIDATES):
        spare = random.uniform(FIRST_CANDIDATE + SPARE * number, 7)
        # The choice among clusters is even over the candidates, as it is over the steps.
        spare[0] = ((uniforms[0] + number / CANDIDATES) % 1.0).clamp(2.0**-24, 1.0 - 2.0**-24)
        light, other = _candidate(lights, query, scattering, spare)
        kept, total = _better(kept, total, light, other, choice.visibility(light.cluster), spare[6])
    scale = total / (CANDIDATES * kept.target.clamp(min=1e-30))
    worth = luminance(kept.value) * (kept.share * scale).sqrt()
    return DirectLight(kept.direction, kept.distance, kept.value * scale, kept.pdf, kept.cluster, worth)


class _Kept(NamedTuple):
    """The candidate that is kept so far; target: what it is kept by, the luminance it may be expected to bring, `[N]`;
    pdf: the BSDF's."""

    direction: Tensor
    distance: Tensor
    value: Tensor
    share: Tensor
    target: Tensor
    cluster: Tensor
    pdf: Tensor


def _candidate(lights: Lights, query: LightQuery, scattering: Scattering, uniforms: Tensor) -> tuple[LightSample, tuple[Tensor, Tensor]]:
    """A light sample, and the BSDF times cosine `[3, N]` and the density of scattering `[N]` towards it."""
    light = lights.draw(query, uniforms)
    return light, scattering.evaluate(light.direction)


def _weighed(light: LightSample, scattered: Tensor, pdf: Tensor) -> Tensor:
    """Scattered radiance over the sample's density, with its MIS weight, `[3, N]`."""
    return scattered * light.radiance * (mis.power_heuristic(light.pdf, pdf) / light.pdf.clamp(min=1e-30))


@kernel
def _worth(light: LightSample, scattered: tuple[Tensor, Tensor], seen: Tensor | None) -> tuple[Tensor, ...]:
    """What a sample would bring over its density, with its MIS weight, `[3, N]`; and the luminance to expect of it, `[N]`."""
    value = _weighed(light, *scattered)
    return (value,) if seen is None else (value, luminance(value) * seen)


@kernel
def _better(
    kept: _Kept, total: Tensor, light: LightSample, scattered: tuple[Tensor, Tensor], seen: Tensor, uniform: Tensor
) -> tuple[_Kept, Tensor]:
    """The candidate kept so far or one more, by chance, and the sum of what they are kept by, `[N]`."""
    value = _weighed(light, *scattered)
    target = luminance(value) * seen
    total = total + target
    changes = uniform * total < target
    new = (light.direction, light.distance, value, light.share, target, light.cluster, scattered[1])
    return _Kept(*(torch.where(changes, one, other) for one, other in zip(new, kept))), total
