# SPDX-License-Identifier: Apache-2.0
"""Levels of digital inputs as drivers tell them, and the edges in them; scans as profiles.

Works on any object with the attributes of the ROS message. Nothing is debounced here: a contact
that bounces has all of its edges, `tool.edges` judges them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot, isfinite, sqrt
from typing import Any

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array

BOOL, UR_IO, GPIO = "bool", "ur_io", "gpio"
NS = 1_000_000_000
ANALOG_HIGH = 0.5  # of a gpio interface, which is a double: 0.0 and 1.0 are its levels
LONGEST_SCAN_S = 10.0  # to its middle: more is no time


@dataclass(frozen=True)
class InputTiming:
    """When a level was at the sensor, by when the driver told it.

    ``latency_s``: from the sensor to the stamp, or to the publication of a message that has none.
    ``jitter_s``: standard deviation of that.
    ``period_s``: of a driver that tells the level again and again; 0: only when it changes.
    """

    latency_s: float
    jitter_s: float
    period_s: float = 0.0


@dataclass(frozen=True)
class LevelChange:
    """An edge at the sensor: its stamp, and a standard deviation of that."""

    blocked: bool
    stamp_ns: int
    sigma_s: float


class BeamLevel:
    """Finds the edges of one beam; ``blocked``: its level, None before any message."""

    def __init__(self, timing: InputTiming) -> None:
        self._timing = timing
        self.blocked: bool | None = None
        self.told_ns = 0

    def hear(self, blocked: bool, told_ns: int) -> LevelChange | None:
        """Take a level that was told at ``told_ns``; None where it has not changed.

        Of a level that is told every T the edge lies anywhere since the message before: half way,
        with a sigma of T / sqrt(12). T is what passed, so a message that was lost makes the sigma
        larger. The first message tells no edge.

        Raises `InputError` when messages are out of order; the level counts from that one on.
        """
        before, before_ns = self.blocked, self.told_ns
        self.blocked, self.told_ns = blocked, told_ns
        if before is not None and told_ns < before_ns:
            raise InputError(
                f"told at {told_ns} ns after {before_ns} ns: two publishers, or a clock set back"
            )
        if before is None or before is blocked:
            return None
        timing = self._timing
        since_s = (told_ns - before_ns) / NS if timing.period_s else 0.0
        late_s = timing.latency_s + 0.5 * since_s
        sigma_s = hypot(timing.jitter_s, since_s / sqrt(12.0))
        return LevelChange(blocked, told_ns - round(late_s * NS), sigma_s)


def bool_levels(message: Any) -> Mapping[str, bool]:
    """The level of a ``std_msgs/Bool``, whose topic is the input."""
    return {"": bool(message.data)}


def ur_levels(message: Any) -> Mapping[str, bool]:
    """Digital inputs of a ``ur_msgs/IOStates`` by pin: 0 to 7 standard, 8 to 15 configurable,
    16 and 17 of the tool.
    """
    return {str(int(pin.pin)): bool(pin.state) for pin in message.digital_in_states}


def gpio_levels(message: Any) -> Mapping[str, bool]:
    """Interfaces by ``group/name`` of what gpio_controllers publish; those without a value are out.

    ``control_msgs/DynamicInterfaceGroupValues``, before 2025 ``DynamicJointState``.

    Raises `InputError` when names and values differ in number: whose is which is not known then.
    """
    names = getattr(message, "interface_groups", None)
    groups, told = message.joint_names if names is None else names, message.interface_values
    pairs = list(zip(groups, told, strict=False))
    sizes = [("groups", len(groups), len(told))]
    sizes += [(f"names of {g}", len(v.interface_names), len(v.values)) for g, v in pairs]
    for what, count, values in sizes:
        if count != values:
            words = f"has {count} {what}, but {values} of their values"
            raise InputError(f"{words}: its publisher is at fault, mend or update that")
    return {
        f"{group}/{name}": value > ANALOG_HIGH
        for group, values in pairs
        for name, value in zip(values.interface_names, values.values, strict=True)
        if isfinite(value)
    }


LEVELS: Mapping[str, Callable[[Any], Mapping[str, bool]]] = {
    BOOL: bool_levels,
    UR_IO: ur_levels,
    GPIO: gpio_levels,
}


def level_of(levels: Mapping[str, bool], source: str) -> bool:
    """The level of an input. Raises `InputError` when the message does not have it."""
    if source not in levels:
        raise InputError(f"has no input '{source}'; it has {', '.join(levels) or 'none'}")
    return levels[source]


def changes_in(
    levels: Mapping[str, bool],
    beams: Mapping[str, tuple[BeamLevel, str]],
    high_is_blocked: bool,
    told_ns: int,
) -> tuple[Mapping[str, LevelChange], InputError | None]:
    """Edges of beams, each with its input, in levels told at once; what one of them lacks.

    A beam that cannot be heard leaves the others to be heard.
    """
    found: dict[str, LevelChange] = {}
    wrong: InputError | None = None
    for beam, (level, source) in beams.items():
        try:
            change = level.hear(level_of(levels, source) is high_is_blocked, told_ns)
        except InputError as error:
            wrong = wrong or error
        else:
            found |= {} if change is None else {beam: change}
    return found, wrong


def source_fault(kind: str, beams: Sequence[str], sources: Sequence[str]) -> str:
    """What is wrong with the inputs that are named for the beams; empty: nothing."""
    if len(sources) != len(beams) or not beams or len(set(beams)) < len(beams):
        return f"{len(beams)} beams ({', '.join(beams)}) and {len(sources)} sources: one for each"
    if len(set(sources)) < len(sources):
        return f"sources = {', '.join(sources)}: two beams share an input"
    wrong = next((s for s in sources if kind == UR_IO and not s.isdecimal()), None)
    if wrong is not None:
        return f"sources: '{wrong}' is no number of a digital input"
    wrong = next((s for s in sources if kind == GPIO and "/" not in s), None)
    return f"sources: '{wrong}' is no group/interface" if wrong is not None else ""


def scan_profile(message: Any) -> tuple[Array, float]:
    """Points (n, 2) of a ``sensor_msgs/LaserScan``, x along the scan and z along its zero beam, m.

    A scan's zero beam is its frame's x, and it turns about its z (REP-103): so the profile's frame
    is that frame with its axes (y, z, x). What is out of range is not-a-number. Second: seconds
    from the stamp, which is the first ray's, to the middle of the scan.

    Raises `InputError` when the scan has no rays, no angles or no time.
    """
    ranges = np.asarray(message.ranges, dtype=np.float64)
    step = float(message.angle_increment)
    if not len(ranges) or not isfinite(step) or step == 0.0 or not isfinite(message.angle_min):
        raise InputError(f"a scan of {len(ranges)} rays, {step:g} rad apart, is no profile")
    angle = float(message.angle_min) + step * np.arange(len(ranges))
    farthest = float(message.range_max) if message.range_max > 0.0 else np.inf
    seen = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= farthest)
    ranges = np.where(seen, ranges, np.nan)
    middle_s = 0.5 * (len(ranges) - 1) * float(message.time_increment)
    if not abs(middle_s) <= LONGEST_SCAN_S:
        raise InputError(f"a scan whose middle is {middle_s:g} s from its stamp is no profile")
    return ranges[:, None] * np.column_stack([np.sin(angle), np.cos(angle)]), middle_s
