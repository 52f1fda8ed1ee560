"""Connected components against those of SciPy."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csgraph

from bokehguide.scene.components import connected_components


def expected(pairs: np.ndarray, count: int) -> np.ndarray:
    """SciPy's labels, numbered in the order of the first nodes."""
    edges = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    labels = csgraph.connected_components(edges, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    return np.argsort(np.argsort(first))[labels]


@pytest.mark.parametrize("seed", range(20))
def test_components_are_those_of_scipy(seed):
    """From mostly single nodes to one component."""
    rng, count = np.random.default_rng(seed), 200
    pairs = rng.integers(0, count, (20 * seed, 2))
    found = connected_components(pairs, count)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, expected(pairs, count))


@pytest.mark.parametrize("seed", range(5))
def test_a_long_chain_in_any_order_is_one_component(seed):
    """Two chains: labels travel far, in both directions."""
    order = np.random.default_rng(seed).permutation(2000)
    chains = order.reshape(2, 1000)
    pairs = np.stack((chains[:, :-1], chains[:, 1:]), axis=-1).reshape(-1, 2)
    found = connected_components(pairs, 2000)
    assert found[0] == 0 and found.max() == 1
    assert all(len(np.unique(found[chain])) == 1 for chain in chains)


def test_nodes_without_pairs_are_components():
    assert connected_components(np.zeros((0, 2), int), 3).tolist() == [0, 1, 2]
    assert connected_components(np.zeros((0, 2), int), 0).tolist() == []
