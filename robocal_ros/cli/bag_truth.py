"""What a simulated bag tells of the truth, on topics that are for judging only."""

import json
import math
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagReader
from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]
Transforms = list[tuple[int, Array]]

CHECK_POINTS, TOOL, HAND_EYE = "/truth/check_points", "/truth/tool", "/truth/hand_eye"
TRANSFORMS = {TOOL: "T_flange_tool", HAND_EYE: "T_flange_sensor"}
STATE = "/truth/state"  # of whichever node tells it
NEAREST_NS = 120_000_000_000  # a truth is told within two minutes of its cycle
SERIES = {  # of a state, by what it is called here, the first that is told
    "without_m": ("visited_tcp_error_rms_m", "tcp_error_rms_m"),
    "with_m": ("commanded_tcp_error_rms_m",),
    "p95_m": ("commanded_tcp_error_p95_m",),
    "lambda_without": ("visited_within_share", "within_share"),
    "lambda_with": ("commanded_within_share",),
}


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


@dataclass(frozen=True, eq=False)
class ToldStates:
    """States of a simulated cell: 48 bytes of each, however much it tells.

    Attributes
    ----------
    stamp_ns : (t,) when each was told.
    series : the `SERIES`, (t,) each; not a number where it is not told.
    faults : stamp, ns, fault and size, SI (0: it ended), as they changed.
    transforms : by their names, as they changed.
    """

    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    series: "dict[str, array[float]]" = field(
        default_factory=lambda: {name: array("d") for name in SERIES}
    )
    faults: list[tuple[int, str, float]] = field(default_factory=list)
    transforms: dict[str, Transforms] = field(
        default_factory=lambda: {name: [] for name in TRANSFORMS.values()}
    )
    _sizes: dict[str, float] = field(default_factory=dict)

    def add(self, stamp_ns: int, state: dict[str, Any]) -> None:
        """Take the next state. Raises ValueError or TypeError for what is no finite number."""
        self.stamp_ns.append(stamp_ns)
        for name, keys in SERIES.items():
            key = next((key for key in keys if key in state), None)
            self.series[name].append(math.nan if key is None else finite(state[key], key))
        now = state.get("faults", {})
        for fault in sorted({*now, *self._sizes}):
            size = finite(now.get(fault, 0.0), f"faults.{fault}")
            if size != self._sizes.get(fault, 0.0):
                self.faults.append((stamp_ns, fault, size))
                self._sizes[fault] = size
        for name, told in self.transforms.items():
            if name in state:
                _add_changed(told, stamp_ns, _transform(state, name))


class BagTruth:
    """The truth that a bag tells, of each robot by its namespace; the states are read once."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._topics = reader.info.topics

    @cached_property
    def states(self) -> dict[str, ToldStates]:
        """Those of each cell, by their topic; without a cell that tells none.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        found = {topic: ToldStates() for topic in self._topics if topic.endswith(STATE)}
        for topic, states in found.items():
            with self.reading(topic):
                for stamp_ns, state in self._told(topic):
                    states.add(stamp_ns, state)
        return {topic: states for topic, states in found.items() if states.stamp_ns}

    def state_topic(self, namespace: str) -> str | None:
        """Topic of the states that are told in a namespace, by a node or not; None without any.

        Raises
        ------
        InputError
            When there are several, and nothing says which is meant.
        """
        places = {topic: topic.removesuffix(STATE) for topic in self.states}
        found = [topic for topic, place in places.items() if place == namespace]
        found = found or [topic for topic, place in places.items() if above(place) == namespace]
        if len(found) > 1:
            raise InputError(
                f"{' and '.join(found)} tell two truths of what is in namespace "
                f"'{namespace or '/'}': give each robot's topics a namespace of their own",
                file=self._reader.info.path,
            )
        return found[0] if found else None

    def transforms(self, topic: str, namespace: str) -> Transforms:
        """Stamps, ns, and transforms (4, 4) from then on, of `TRANSFORMS`; empty: none is told.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        name, own = TRANSFORMS[topic], f"{namespace}{topic}"
        told: Transforms = []
        with self.reading(own):
            for stamp_ns, truth in self._told(own):
                _add_changed(told, stamp_ns, _transform(truth, name))
        if told:
            return told
        states = self.state_topic(namespace)
        return [] if states is None else self.states[states].transforms[name]

    def check_points(self, namespace: str) -> CheckPoints | None:
        """The true positions that a bag tells; None where it tells none.

        Raises
        ------
        InputError
            When they cannot be read.
        """
        topic = f"{namespace}{CHECK_POINTS}"
        stamps: list[int] = []
        positions: list[Array] = []
        with self.reading(topic):
            for stamp_ns, truth in self._told(topic):
                if not stamps:
                    q, tool = _array(truth, "q_rad"), _array(truth, "tool_in_flange_m")
                stamps.append(stamp_ns)
                positions.append(_array(truth, "position_m"))
            if not stamps:
                return None
            return CheckPoints(q, tool, np.array(stamps, dtype=np.int64), np.array(positions))

    def _told(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        if topic in self._topics:
            for recorded in self._reader.messages([topic]):
                yield recorded.log_time_ns, json.loads(recorded.message.data)

    @contextmanager
    def reading(self, topic: str) -> Iterator[None]:
        """Tell what goes wrong with a topic as an `InputError` that names it."""
        try:
            yield
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            why = f"no {error}" if isinstance(error, KeyError) else error
            words = f"topic {topic} cannot be read: {why}"
            raise InputError(words, file=self._reader.info.path) from error


def is_simulated(reader: BagReader) -> bool:
    """Whether a bag tells any truth: what is measured has none."""
    return any("truth" in topic.split("/") for topic in reader.info.topics)


def above(name: str) -> str:
    """The namespace of a node or topic: empty for the root."""
    return name.rpartition("/")[0]


def finite(value: Any, name: str) -> float:
    """A number that was told. Raises ValueError, with its name, when it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}, which is no finite number")
    return float(value)


def _array(truth: dict[str, Any], name: str) -> Array:
    found = np.array(truth[name], dtype=np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} holds what is no finite number: {truth[name]}")
    return found


def _transform(truth: dict[str, Any], name: str) -> Array:
    found = _array(truth, name)
    if found.shape != (4, 4):
        raise ValueError(f"{name} has the shape {found.shape}, not (4, 4)")
    return found


def _add_changed(told: Transforms, stamp_ns: int, T: Array) -> None:
    if not told or not np.array_equal(told[-1][1], T):
        told.append((stamp_ns, T))
