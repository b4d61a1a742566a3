"""What fitted start states leave of an error of readings."""

import numpy as np
import torch
from scipy import sparse

from diffsim.identify.starts import left_by_starts


def test_it_is_what_least_squares_leave_in_each_window():
    rng = np.random.default_rng(2)
    slopes = rng.normal(size=(3, 8, 2))
    fitted = np.linalg.pinv(slopes)
    change = rng.normal(size=(21, 4)) * (rng.random((21, 4)) < 0.5)  # the last window is cut
    left = left_by_starts(sparse.csr_array(change), *map(torch.from_numpy, (slopes, fitted)))
    padded = np.concatenate([change, np.zeros((3, 4))]).reshape(3, 8, 4)
    expected = [c - s @ np.linalg.lstsq(s, c)[0] for s, c in zip(slopes, padded, strict=True)]
    np.testing.assert_allclose(left.toarray(), np.concatenate(expected)[:21], atol=1e-12)
