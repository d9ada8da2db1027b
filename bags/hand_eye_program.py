# SPDX-License-Identifier: Apache-2.0
"""What the robot's program does in a golden hand-eye bag: standstills, shots, captures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import SmoothPath
from robocal_ros.hand_eye.targets import KIND_OF, LaserTarget, target_document
from robocal_ros.session import events
from robocal_ros.session.events import Command

Array = NDArray[np.float64]

SHOTS = 15
MOVE_S, REST_S, SHOT_S = 1.5, 1.0, 0.6  # a shot is taken so long after the arrival
ASK_S = 0.2  # before it the capture is asked for
EARLY, BLIND = 4, 8  # standstills whose first capture fails: the robot moves, nothing returned
EARLY_S, BLIND_S = -0.1, 0.4  # after the arrival: the shots in vain
TIMEOUT_S, RETRY_S = 1.0, 1.2  # of a capture; a standstill is so much longer where one fails
REMOVED = 11  # standstill whose sample is removed


def waits() -> Array:
    """How much longer (m,) than the others each standstill is, s."""
    longer = np.zeros(SHOTS)
    longer[[EARLY, BLIND]] = RETRY_S
    return longer


def arrivals() -> Array:
    """When (m,) the robot arrives at each standstill, s."""
    before = np.append(0.0, np.cumsum(REST_S + waits())[:-1])
    return np.asarray(MOVE_S * np.arange(1, SHOTS + 1) + before)


def shot_times() -> Array:
    """When (m,) the shot of each standstill is taken, s."""
    return np.asarray(arrivals() + waits() + SHOT_S)


def way(q_start: Array, q: Array) -> SmoothPath:
    """From joints (n,) to the standstills (m, n)."""
    rests = np.append(0.0, arrivals())
    departs = np.append(0.0, arrivals() + REST_S + waits())
    return SmoothPath(rests, departs, np.vstack([q_start, q]))


def asked(marks: Sequence[str], target: LaserTarget) -> list[tuple[float, Command]]:
    """What the program asks of the session, each with its time, s; ``marks`` of the shots."""
    start = {
        "target": target_document(KIND_OF[type(target)], target),
        "feature": "edge",
        "method": "best",
        "mount": "in-hand",
    }
    captures = [
        (time_s, events.CAPTURE, {"mark": mark})
        for time_s, mark in zip(shot_times() - ASK_S, marks, strict=False)
    ]
    for index, shot_s in ((EARLY, EARLY_S), (BLIND, BLIND_S)):
        time_s = arrivals()[index] + shot_s
        captures.append((time_s - 0.5 * ASK_S, events.CAPTURE, {"mark": marks[index]}))
    captures.sort(key=lambda one: one[0])
    removed = shot_times()[REMOVED] + ASK_S
    handle = sum(time_s < removed for time_s, *_ in captures)
    commands = [
        (arrivals()[0] - ASK_S, events.START, start),
        *captures,
        (removed, events.REMOVE, {"handle": handle}),
    ]
    commands.sort(key=lambda one: one[0])
    return [(time_s, Command(name, words)) for time_s, name, words in commands]
