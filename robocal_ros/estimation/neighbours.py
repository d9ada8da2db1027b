"""Points of a profile that are on a curve together, and those that are there by chance."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WINDOW = 13  # columns
_CLOSE = 5.0  # limits within which a point that is off the curve is another surface's that meets it
_AGAINST = 2.0  # weight of such a point against that of one on the curve
_AGREEING = 0.7  # weight of the neighbours that are on the curve
_PIECE = 0.2  # smallest piece, of the largest


def on_curve(excess: Array) -> Mask:
    """Which points (n,) are on a curve, with most of their neighbours and in a large piece.

    Where another surface meets or crosses the curve, the points near both are left out. Far ones,
    spikes and what is behind the curve, have no say.

    Parameters
    ----------
    excess : (n,) a point's squared distance from the curve over the largest that its noise
        explains, in the order of the columns.
    """
    near = excess < 1.0
    window = np.ones(min(_WINDOW, len(near)))
    votes = np.convolve(near.astype(np.float64), window, mode="same")
    against = np.convolve((~near & (excess < _CLOSE**2)).astype(np.float64), window, mode="same")
    rows = np.flatnonzero(near & (votes > _AGREEING * (votes + _AGAINST * against)))
    piece = np.cumsum(np.diff(rows, prepend=rows[:1]) > _WINDOW)
    size = np.bincount(piece, minlength=1)
    kept = np.zeros(len(near), dtype=np.bool_)
    kept[rows[size[piece] >= _PIECE * size.max()]] = True
    return kept
