# SPDX-License-Identifier: Apache-2.0
"""What fails as an output jumped is not run again: a second try would hide what comes at times.

`make test` reruns node tests, which others on the machine may have starved, except for these. A
test may try anew what jumped while a process is known to have waited for a core
(``Graph.undisturbed``).
"""

import numpy as np
from numpy.typing import ArrayLike


class JumpError(AssertionError):
    """An output changed faster, or further, than it may."""


def no_jump(is_so: ArrayLike, words: str) -> None:
    """Raise `JumpError` unless all of it is so."""
    fine = np.asarray(is_so)
    if not fine.all():
        raise JumpError(f"{words}: not so {np.count_nonzero(~fine)} times of {fine.size}")
