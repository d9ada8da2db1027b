"""Random numbers that belong to what they are for, whenever and in what order they are asked."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What random numbers are for."""

    STATION = 0
    SCATTER = 1
    RIPPLE = 2
    EDGES = 3
    READINGS = 4
    LOST_READINGS = 5
    SHOTS = 6
    LOST_SHOTS = 7
    LOST_EDGES = 8
    TEMPERATURES = 9
    PROFILES = 10
    LOST_COMMANDS = 11


class Draws:
    """Generators of one seed: the same purpose and place give the same numbers.

    So it does not matter how time is cut into pieces, and one thing that is switched on or off
    leaves the numbers of all others alone.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def of(self, stream: Stream, place: int = 0) -> np.random.Generator:
        """A generator for a purpose at a place, such as a tick."""
        return np.random.default_rng([self._seed, stream, place])
