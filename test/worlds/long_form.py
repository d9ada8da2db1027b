# SPDX-License-Identifier: Apache-2.0
"""What ``make test`` shows briefly and ``make soak`` at length, by the same tests.

A test takes as many draws, cases or rounds as can still show its promise broken; where more of the
same are worth hours, ``ROBOCAL_LONG=1`` adds them. ``bench.soak`` sets it for each file that
imports this one, or marks a test ``long``: that one runs at length alone.
"""

import os
from typing import TypeVar

T = TypeVar("T")
LONG = os.environ.get("ROBOCAL_LONG", "0") == "1"


def amount(briefly: T, at_length: T) -> T:
    """Of draws, rounds or seconds; a bound that depends on it is computed from it."""
    return at_length if LONG else briefly


def more(*cases: T) -> list[T]:
    """Cases of the long form alone, for ``parametrize``, beside those that always run."""
    return list(cases) if LONG else []
