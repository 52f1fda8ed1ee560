"""Connected components of graphs."""

from __future__ import annotations

import numpy as np


def connected_components(pairs: np.ndarray, count: int) -> np.ndarray:
    """The component of each of `count` nodes, numbered in the order of the first nodes, int32 `[count]`.

    pairs: connected nodes, `[E, 2]`. Each node takes the least number that it finds across its pairs, round by round. The import
    of SciPy's function takes longer than most calls of this one.
    """
    first, ends = np.arange(count), np.ascontiguousarray(pairs.T)
    while True:
        one, other = first[ends]
        if (one == other).all():
            return np.unique(first, return_inverse=True)[1].astype(np.int32)
        least = np.minimum(one, other)
        np.minimum.at(first, one, least)
        np.minimum.at(first, other, least)
        first = first[first]
