"""All random dimensions of a sample. A dimension numbers a random decision, and no two random numbers of a path share a
dimension.

| dimensions                 | numbers                                              |
|----------------------------|------------------------------------------------------|
| 0, 1                       | position on the film                                 |
| 2 … 6                      | lens point                                           |
| 7, 8                       | lens point of the ray that initialises the film      |
| 32 + 16 (d - 1) …          | vertex d of a path                                   |
| 2^16 + c                   | choice of candidate c of the primary hit, c ≥ 1      |
| 2^20 + 256 d …             | translucent surfaces that segment d crosses          |
| 2^30                       | neighbours of a pixel                                |
| 2^30 + 1 …                 | choices among the samples of neighbours              |

At a vertex: 0 opaque or transmissive part, 1 Russian roulette, 2 … 4 BSDF sample, 5 … 10 light sample, 11 roulette of the
shadow ray.

The roulette and the BSDF sample share a sequence (`SCATTER`). The two paths of a pair at a primary hit have nearly equal numbers
in the first coordinate of a sequence (`PixelRandom.copies`), so that the BSDF sample has the other three.
"""

from __future__ import annotations

from torch import Tensor

FILM = 0
LENS = 2
LENS_COUNT = 5
INITIAL_LENS = 7
NEIGHBOURS = 1 << 30
NEIGHBOUR_CHOICE = NEIGHBOURS + 1

PART, SCATTER, LIGHT, SHADOW = 0, 1, 5, 11
"""Offsets from `vertex`."""
SCATTER_COUNT, LIGHT_COUNT = 4, 6
MAX_CROSSINGS = 256
"""Largest number of translucent surfaces that a ray passes. The ray stops at the next translucent surface."""
_FIRST_VERTEX, _PER_VERTEX = 32, 16
_FIRST_CHOICE = 1 << 16
_FIRST_CROSSING = 1 << 20


def vertex(depth: int) -> int:
    """First dimension of the vertex at the end of segment `depth`. The primary hit is vertex 1."""
    return _FIRST_VERTEX + _PER_VERTEX * (depth - 1)


def bsdf_numbers(numbers: Tensor) -> Tensor:
    """The numbers `[3, N]` of a BSDF sample, lobe, angle and radius, among the numbers of SCATTER `[4, N]`."""
    return numbers[1:].roll(1, 0)


def choice(number: int) -> int:
    """Dimension of the choice between candidate `number` ≥ 1 of the primary hit and the candidates before it.

    All candidates are further samples of the dimensions of the vertex (`PixelRandom.stratified`).
    """
    return _FIRST_CHOICE + number


def crossing(depth: int) -> int:
    """First dimension of the translucent surfaces that segment `depth` crosses."""
    return _FIRST_CROSSING + MAX_CROSSINGS * depth
