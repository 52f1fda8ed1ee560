"""Radiance of recorded primary hits towards other directions."""

from __future__ import annotations

from torch import Tensor

from bokehguide.render.primary_hits import PrimaryHits


def seen_radiance(hits: PrimaryHits, chosen: Tensor, outgoing: Tensor, count: int) -> Tensor:
    """Radiance `[3, J]` of the surfaces `chosen`, int64 `[J]`, with `count` paths together, towards unit directions `[3, J]`."""
    index, paths = hits.paths_of(chosen, count)
    radiance = hits.emitted(chosen, outgoing).clone()
    for value, incident in zip(hits.bsdf(paths, outgoing.index_select(1, index)), hits.reflection[1]):
        radiance.index_add_(1, index, value * incident.index_select(1, paths))
    return radiance
