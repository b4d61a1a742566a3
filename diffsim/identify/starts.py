"""Start states that are fitted to windows of a record, and what they leave of a change."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from torch import Tensor


def left_by_starts(change: sparse.csr_array, tangent: Tensor, gain: Tensor) -> sparse.csr_array:
    """Change of predicted readings less what the best start states make up for.

    Args:
        change: Of the readings of all windows, one after the other, (num_rows, K); the last window
            may be longer than what was recorded.
        tangent: d readings / d start of each window, (num_windows, length, num_starts).
        gain: d start / d misfit of each, (num_windows, num_starts, length).
    """
    length, parts = tangent.shape[1], []
    for k, (slopes, fitted) in enumerate(zip(tangent.numpy(), gain.numpy(), strict=True)):
        own = change[k * length : (k + 1) * length]
        touched = np.unique(own.indices)
        moved = slopes[: own.shape[0]] @ (fitted[:, : own.shape[0]] @ own[:, touched].toarray())
        into = np.arange(len(touched)), touched
        place = sparse.csr_array((np.ones(len(touched)), into), (len(touched), change.shape[1]))
        parts.append(own - sparse.csr_array(moved) @ place)
    return sparse.csr_array(sparse.vstack(parts))
