"""What was sent, as a function of time."""

from dataclasses import replace

import numpy as np
from robocal_ros.correction.memory import RESPONSE_S
from robocal_ros.correction.starting import Sent

EVERY_S = 2e-4


def test_thousands_of_trajectories_within_the_response_are_remembered() -> None:
    """Each replaces the one before it after a fifth of a millisecond; all stand still."""
    index, times = np.arange(6), np.array([0.0, 1.0])
    latest: Sent | None = None
    for i in range(1500):
        taught = np.full((2, 6), float(i))
        sent = Sent(index, EVERY_S * i, times, taught, taught + 0.5)
        now = EVERY_S * i
        latest = sent if latest is None else replace(sent, before=latest.since(now - RESPONSE_S))
    assert latest is not None
    found = latest.around(now)
    assert found is not None
    taught, corrected = found
    assert np.allclose(corrected - taught, 0.5, atol=1e-12)
    # the number of the trajectory that held then: since the response's time ago, until now
    assert abs(taught[0, 0] - (1499 - RESPONSE_S / EVERY_S)) <= 1.0
    assert taught[-1, 0] == 1499.0
