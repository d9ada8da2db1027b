"""Points of a profile that are near a curve together, and those that are there by chance."""

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

_WINDOW = 9  # columns
_PIECE = 0.2  # smallest piece, of the largest


def together(near: Mask, agreeing: float) -> Mask:
    """Those of the points near a curve (n,), in the order of columns, that belong together.

    More than a share ``agreeing`` of a point's neighbours are near the curve too, and it belongs
    to a large piece; where another surface crosses the curve, neither holds.
    """
    window = np.ones(min(_WINDOW, len(near)))
    votes = np.convolve(near.astype(np.float64), window, mode="same")
    votes /= np.convolve(np.ones(len(near)), window, mode="same")
    rows = np.flatnonzero(near & (votes > agreeing))
    piece = np.cumsum(np.diff(rows, prepend=rows[:1]) > _WINDOW)
    size = np.bincount(piece, minlength=1)
    kept = np.zeros(len(near), dtype=np.bool_)
    kept[rows[size[piece] >= _PIECE * size.max()]] = True
    return kept
