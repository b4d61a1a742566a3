"""What hangs together through links."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import IntArray


def connected_parts(num: int, first: IntArray, second: IntArray) -> IntArray:
    """Number of the connected component of each of ``num`` items, (num,), given linked pairs.

    Args:
        first, second: The two items of every link, (num_links,).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(first), np.int8), (first, second)), shape=(num, num))
    return connected_components(graph, directed=False)[1].astype(np.int64)
