# SPDX-License-Identifier: Apache-2.0
"""Times of all estimators beside others of their kind."""

from collections.abc import Sequence

from bench import hand_eye_camera, hand_eye_profiles, speed, thermal, tool
from bench.tables import Table


def tables() -> Sequence[Table]:
    """All tables of times."""
    rooms = (thermal, tool, hand_eye_profiles, hand_eye_camera)
    return [*speed.tables(), *(room.speed_table() for room in rooms)]
