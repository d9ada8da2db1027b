"""One thread for linear algebra, so that the same samples give the same bits everywhere."""

import os
import sys

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread() -> bool:
    """Hold BLAS to one thread; must be called before NumPy is imported.

    With several threads the order of additions, hence the last bits of a result, depends on the
    number of cores.

    Returns
    -------
    bool
        False when NumPy is there already and the setting comes too late.
    """
    for name in _VARIABLES:
        os.environ[name] = "1"
    return "numpy" not in sys.modules
