"""A moving surface as one small file: arrays packed, quadrilaterals drawn as triangles."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import IntArray


def triangles(quads: IntArray) -> IntArray:
    """Two triangles for each quadrilateral, (2 Q, 3) from (Q, 4)."""
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def pack(**arrays: NDArray[Any]) -> bytes:
    """Arrays as the bytes of an ``.npz``."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()
