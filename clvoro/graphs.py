"""Connected components of graphs."""

from __future__ import annotations

import numpy as np
import scipy


def components(n: int, i: np.ndarray, j: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of connected components of a graph of `n` nodes with edges `i` to `j`, and each node's."""
    graph = scipy.sparse.coo_array((np.ones(len(i), bool), (i, j)), shape=(n, n))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)


def first_nodes(n: int, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return for each node of a graph of `n` nodes with edges `i` to `j` the first one of its component, (n,) int."""
    label = components(n, i, j)[1]
    return np.unique(label, return_index=True)[1][label]
