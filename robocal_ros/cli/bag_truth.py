"""What a simulated bag tells of the truth, on topics that are for judging only."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError
from robocal_ros.storage.bags import BagReader

Array = NDArray[np.float64]

CHECK_POINTS, TOOL, HAND_EYE = "/truth/check_points", "/truth/tool", "/truth/hand_eye"
STATE = "/truth/state"  # of whichever node tells it
NEAREST_NS = 120_000_000_000  # a truth is told within two minutes of its cycle


@dataclass(frozen=True, eq=False)
class CheckPoints:
    """Where the tool truly was at poses that were never measured, without correction.

    Attributes
    ----------
    q : (m, n) joints commanded, rad.
    tool : (3,) in the flange, m.
    stamp_ns : (t,) when it was told.
    position : (t, m, 3), base, m; the first is the cold robot.
    """

    q: Array
    tool: Array
    stamp_ns: NDArray[np.int64]
    position: Array

    def moved(self, at_ns: int) -> Array | None:
        """Displacement (m, 3) since the cold robot, told nearest to a stamp; None: not near it."""
        away = np.abs(self.stamp_ns - at_ns)
        nearest = int(np.argmin(away))
        if away[nearest] > NEAREST_NS:
            return None
        return np.asarray(self.position[nearest] - self.position[0])


def is_simulated(reader: BagReader) -> bool:
    """Whether a bag tells any truth: what is measured has none."""
    return any("truth" in topic.split("/") for topic in reader.info.topics)


def check_points(reader: BagReader) -> CheckPoints | None:
    """The true positions that a bag tells; None where it tells none.

    Raises
    ------
    InputError
        When they cannot be read.
    """
    told = _told(reader, CHECK_POINTS)
    if not told:
        return None
    try:
        first = told[0][1]
        return CheckPoints(
            q=np.array(first["q_rad"]),
            tool=np.array(first["tool_in_flange_m"]),
            stamp_ns=np.array([stamp for stamp, _ in told], dtype=np.int64),
            position=np.array([truth["position_m"] for _, truth in told]),
        )
    except (KeyError, ValueError) as error:
        raise _unreadable(reader, CHECK_POINTS, error) from error


def true_transforms(reader: BagReader, topic: str, name: str) -> list[tuple[int, Array]]:
    """Stamps, ns, and transforms (4, 4) that a bag tells from then on; empty where it tells none.

    Raises
    ------
    InputError
        When they cannot be read.
    """
    states = [(stamp, state) for stamp, state in told_states(reader) if name in state]
    try:
        told = _told(reader, topic) or states
        return [(stamp, np.array(truth[name])) for stamp, truth in told]
    except (KeyError, ValueError) as error:
        raise _unreadable(reader, topic, error) from error


def told_states(reader: BagReader) -> list[tuple[int, dict[str, Any]]]:
    """Stamps, ns, and states of a simulated cell; empty where a bag tells none.

    Raises
    ------
    InputError
        When they cannot be read.
    """
    topics = [topic for topic in reader.info.topics if topic.endswith(STATE)]
    return _told(reader, topics[0]) if topics else []


def _told(reader: BagReader, topic: str) -> list[tuple[int, dict[str, Any]]]:
    if topic not in reader.info.topics:
        return []
    try:
        return [(m.log_time_ns, json.loads(m.message.data)) for m in reader.messages([topic])]
    except ValueError as error:
        raise _unreadable(reader, topic, error) from error


def _unreadable(reader: BagReader, topic: str, error: Exception) -> InputError:
    return InputError(f"topic {topic} cannot be read: {error}", file=reader.info.path)
