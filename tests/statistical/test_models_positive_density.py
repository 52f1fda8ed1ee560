"""No draw that meets what it is drawn of has the density 0: it would count for far too much, or not at all.

Numbers are those of a render, multiples of 2^-23 shifted by half a step.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bokehguide.models.ellipse_mixture import EllipseMixture, balls, packed
from bokehguide.models.emitters.parallelogram import ParallelogramEmitters, ViewedParallelograms
from bokehguide.render.lens import Lens

LENS = Lens(0.1, 2.0)
BATCH = 250_000
FOCUS = torch.tensor((0.3, -0.2, 2.0))[:, None].repeat(1, BATCH)


def numbers(seed: int, most: int = 1 << 23) -> Tensor:
    """`[2, BATCH]`, of the first `most` places."""
    return (torch.randint(0, most, (2, BATCH), generator=torch.Generator().manual_seed(seed)) + 0.5) / 2.0**23


def spread(seed: int, *low_high: tuple[float, float]) -> Tensor:
    """Even between bounds, `[rows, BATCH]`."""
    low, high = torch.tensor(low_high).T[:, :, None]
    return low + (high - low) * torch.rand(len(low_high), BATCH, generator=torch.Generator().manual_seed(seed))


def seen_at(shown: Tensor, way: Tensor) -> Tensor:
    """Points `[3, BATCH]` on the lines from lens points `[2, BATCH]` through FOCUS, `way` times as far."""
    return torch.lerp(torch.cat((shown, torch.zeros(1, BATCH))), FOCUS, way)


def parallelograms(seed: int) -> tuple[Tensor, Tensor]:
    """Draws, two thirds of them at the edges: whether each meets its parallelogram, in double precision, and its density.

    Parallelograms have many sizes and orientations behind the focal plane. None is seen edge-on.
    """
    centre = seen_at(spread(seed, (-0.09, 0.09), (-0.09, 0.09)), spread(seed + 1, (1.5, 4.0))[0])
    size = 10.0 ** spread(seed + 2, (-3.0, -0.3))
    right, up = (torch.randn(3, BATCH, generator=torch.Generator().manual_seed(seed + turn)) for turn in (3, 4))
    up = up - right * (up * right).sum(0) / right.square().sum(0)
    right, up = size * right / right.norm(dim=0), size * up / up.norm(dim=0)
    count = torch.arange(BATCH)
    seen = ViewedParallelograms(ParallelogramEmitters(centre, right, up), count, count, FOCUS, torch.tensor(LENS.radius))
    edge, place = numbers(seed + 5, 3)[0], numbers(seed + 6)
    edge = torch.where(place[1] < 0.5, edge, 1.0 - edge)
    place = torch.where(count % 3 == 0, torch.stack((edge, place[0])), place)
    place = torch.where(count % 3 == 1, torch.stack((place[0], edge)), place)
    points = seen.sample(count, place)
    facing = torch.linalg.cross(right, up, dim=0) / (right.norm(dim=0) * up.norm(dim=0))
    start = torch.cat((points, torch.zeros(1, BATCH))).double()
    columns = torch.stack((FOCUS.double() - start, -right.double(), -up.double()), dim=0)
    found = torch.linalg.solve(columns.permute(2, 1, 0), (centre.double() - start).T)
    meets = (found[:, 1:].abs() <= 1.0).all(1) & (found[:, 0] > 0.0) & (LENS.transmission(points) > 0.0)
    return meets & (facing[2].abs() > 0.3), seen.pdf(points)


def discs(seed: int) -> tuple[Tensor, Tensor]:
    """Draws at the rim of ellipses: whether they lie within the aperture, and their densities.

    The ellipsoids are large against the rounding of lens points. The draws avoid the places where the rim crosses the axis of
    the clip.
    """
    shown = spread(seed, (-0.12, 0.12), (-0.12, 0.12))
    mean = seen_at(shown, torch.where(spread(seed + 1, (0.0, 1.0))[0] < 0.5, 0.6, 2.5))
    size = 10.0 ** spread(seed + 2, (-2.0, -1.0))[0]
    axes = size[:, None, None] * (
        torch.eye(3) + 0.3 * torch.randn(BATCH, 3, 3, generator=torch.Generator().manual_seed(seed + 3))
    )
    outline = torch.where(torch.arange(BATCH) % 2 == 0, balls(size), packed(axes.transpose(1, 2) @ axes))
    ones = torch.ones(BATCH)
    drawn = EllipseMixture(LENS, FOCUS, ones, torch.arange(BATCH + 1), mean, outline, ones, ones)
    clip, place, rim = drawn.ellipses.clip, numbers(seed + 5), numbers(seed + 6, 3)
    whole = (clip.low <= -1.0) & (clip.high >= 1.0)
    place = torch.where(whole, torch.stack((1.0 - rim[0], place[1])), torch.stack((place[0], rim[1])))
    points = drawn.sample(torch.cat((torch.full_like(place[:1], 0.5), place))).points
    center, width, tilt, height, _ = drawn.ellipses
    x, y = points - center
    along = clip.axis[0] * x / width + clip.axis[1] * (y - tilt * x / width) / height
    inside = LENS.transmission(points) > 0.0
    return inside & drawn.guided & (torch.minimum(width, height) > 0.02) & (whole | (along.abs() < 0.5)), drawn.pdf(points)


def at_the_rim(angle: Tensor) -> Tensor:
    """Lens points `[2, BATCH]` just inside the lens circle."""
    return LENS.radius * (1.0 - 1e-6) * torch.stack((angle.cos(), angle.sin()))


def test_ellipses_have_a_density_at_the_ends_of_the_lens():
    """At the nearest and at the farthest point of the lens, as seen from the centres of large ellipses."""
    mean = seen_at(spread(1, (-1.5, 1.5), (-1.5, 1.5)), torch.full((BATCH,), 2.5))
    ones, size = torch.ones(BATCH), 10.0 ** spread(2, (-1.0, 0.5))[0]
    mixture = EllipseMixture(LENS, FOCUS, ones, torch.arange(BATCH + 1), mean, balls(size), ones, ones)
    center, width, tilt, height, _ = mixture.ellipses
    farthest = torch.where(torch.arange(BATCH) % 2 == 0, 0.0, torch.pi)
    points = at_the_rim(torch.atan2(center[1], center[0]) + farthest)
    x, y = (points - center) / torch.stack((width, height))
    inside = (x * x + (y - tilt / height * x).square() < 0.99) & mixture.guided
    assert int(inside.sum()) > 10_000
    assert not bool((mixture.component_pdf(points) == 0.0)[inside].any())


DRAWN = pytest.mark.parametrize("drawn", [parallelograms, discs], ids=lambda drawn: drawn.__name__)


def lost(drawn, seed: int) -> int:
    meets, density = drawn(seed)
    assert float(meets.float().mean()) > 0.1
    return int((meets & (density == 0.0)).sum())


@DRAWN
def test_no_draw_is_lost(drawn):
    assert lost(drawn, 0) == 0


@pytest.mark.slow
@DRAWN
def test_no_draw_of_ten_million_is_lost(drawn):
    assert sum(lost(drawn, 100 * batch) for batch in range(1, 41)) == 0
