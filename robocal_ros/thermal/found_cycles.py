"""Commands for a recording that has none: its cycles, by their times or found by their poses."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.session import events
from robocal_ros.session.decisions import NEWEST
from robocal_ros.session.events import Command
from robocal_ros.thermal.observation import Observation
from robocal_ros.thermal.spots import SAME_VISIT_RAD

LARGEST_CYCLE = 60  # more poses than this are a calibration, not a measuring cycle


def window_commands(
    cold: tuple[int, int] | None, warm: Sequence[tuple[int, int]]
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Commands for time windows (from, to; ns): the cold reference, then one cycle each."""
    commands: list[tuple[Command, Mapping[str, Any]]] = []
    if cold is not None:
        arguments = {"from_ns": cold[0], "by": "replay"}
        commands.append((Command(events.CAPTURE_REFERENCE, arguments, cold[1]), {}))
    for number, (start, end) in enumerate(warm, start=1):
        arguments = {"from_ns": start, "cycle_id": f"window-{number}"}
        commands.append((Command(events.IDENTIFY, arguments, end), {}))
    return commands


def automatic_commands(
    observations: Sequence[Observation],
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Find the cycles of a recording without commands.

    Poses that recur from cycle to cycle: the first visit is the cold reference, each later one
    a warm cycle. Otherwise everything is one calibration.

    Raises
    ------
    InputError
        When nothing was observed.
    """
    if not observations:
        raise InputError("no measurement at standstill in this recording")
    starts = _cycle_starts(observations)
    end = observations[-1].stamp_ns
    if len(starts) < 2:
        return window_commands(None, [(observations[0].stamp_ns, end)])
    edges = [observations[i].stamp_ns for i in starts]
    last = [observations[i - 1].stamp_ns for i in starts[1:]] + [end]
    windows = list(zip(edges, last, strict=True))
    return window_commands(windows[0], windows[1:])


def accepting(
    commands: Iterable[tuple[Command, Mapping[str, Any]]], by: str
) -> list[tuple[Command, Mapping[str, Any]]]:
    """The same commands, with each candidate accepted where its own verdict accepts it."""
    found: list[tuple[Command, Mapping[str, Any]]] = []
    for command, outcome in commands:
        found.append((command, outcome))
        if command.name == events.IDENTIFY:
            arguments = {"choose": NEWEST, "by": by, "reason": "its verdict accepts"}
            found.append((Command(events.ACCEPT, arguments, command.stamp_ns), {}))
    return found


def _cycle_starts(observations: Sequence[Observation]) -> list[int]:
    """Index of the first observation of each cycle; one alone when poses do not recur."""

    def same(a: Observation, b: Observation) -> bool:
        near = np.max(np.abs(a.q - b.q)) < SAME_VISIT_RAD
        return a.target == b.target and bool(near)

    first = observations[0]
    limit = min(len(observations), LARGEST_CYCLE + 1)
    length = next((i for i in range(1, limit) if same(first, observations[i])), None)
    if length is None:
        return [0]
    starts = [i for i, o in enumerate(observations) if same(first, o)]
    known = observations[:length]
    recurring = sum(any(same(o, k) for k in known) for o in observations[length:])
    return starts if recurring >= 0.9 * len(observations[length:]) else [0]
