"""The table of random dimensions."""

from __future__ import annotations

from bokehguide.render import dimensions

DEPTHS, CANDIDATES = range(1, 65), range(1, 17)


def test_no_two_numbers_of_a_path_share_a_dimension():
    ranges = [(dimensions.FILM, 2), (dimensions.LENS, dimensions.LENS_COUNT), (dimensions.INITIAL_LENS, 2)]
    counts = {dimensions.PART: 1, dimensions.SCATTER: dimensions.SCATTER_COUNT, dimensions.LIGHT: dimensions.LIGHT_COUNT}
    parts = (*counts.items(), (dimensions.SHADOW, 1))
    ranges += [(dimensions.vertex(depth) + first, count) for depth in DEPTHS for first, count in parts]
    ranges += [(dimensions.choice(number), 1) for number in CANDIDATES]
    ranges += [(dimensions.crossing(depth), dimensions.MAX_CROSSINGS) for depth in DEPTHS]
    ranges += [(dimensions.NEIGHBOURS, 1), (dimensions.NEIGHBOUR_CHOICE, 1000)]
    used = [first + number for first, count in ranges for number in range(count)]
    assert len(set(used)) == len(used)
