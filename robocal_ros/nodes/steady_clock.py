"""The clock of whoever moves the robot."""

import time


def steady_s() -> float:
    """Seconds that no setting of the clock changes, those of a suspended host included.

    What was heard before it was suspended is old when it wakes.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)
