"""A session that starts where a recorded one started."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import REFERENCE, THERMAL
from robocal_ros.ground.samples import JOINTS
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.decisions import NEWEST, History, require_robot, seeded
from robocal_ros.session.events import CONFIGURE, Command
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.drift_following import FollowerState
from robocal_ros.thermal.observations import Observation
from robocal_ros.thermal.reference import SAME_VISIT_RAD
from robocal_ros.thermal.session import ThermalSession


def session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> ThermalSession:
    """Make a session with the recorded settings; an empty history gets what was in force.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        The configuration cannot be read.
    """
    require_robot(nominal, configured)
    arguments = configured.arguments
    try:
        model, reference = arguments["model"], arguments["reference"]
        tracker = arguments["tracker"]
    except KeyError as error:
        raise InputError(f"the recorded configuration lacks {error}") from error
    config = config_of(arguments)
    state = None if tracker is None else FollowerState.of_document(tracker)
    in_force = {THERMAL: model, REFERENCE: reference}
    fresh = seeded(history, nominal, in_force, software)
    session = ThermalSession(nominal, history, config, software)
    if fresh and state is not None and session.follower is not None:
        session.follower.go_on_from(state)
    return session


OWN = "tracker"  # only a thermal session's configuration has it


def configuration(session: ThermalSession, topics: Mapping[str, str] | None = None) -> Command:
    """The session's settings and what is in force, so that replay can start from the same.

    Recorded at the start and after each change of what is in force: a recording that begins
    later has it too. ``topics``: name of each input's topic.
    """
    return Command(
        CONFIGURE,
        {
            "robot": session.nominal.name,
            "model_hash": session.nominal.model_hash,
            "topics": dict(topics or {}),
            "config": asdict(session.config),
            "model": session.in_force.model,
            "reference": session.reference_model,
            OWN: None if session.follower is None else session.follower.state.document(),
        },
        session.desk.newest_ns.get(JOINTS, 0),
        session.desk.marks,
    )


def is_thermal_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a thermal session."""
    return configured is not None and OWN in configured.arguments


def config_of(arguments: Mapping[str, Any]) -> ThermalConfig:
    """Read the settings back from a configuration record.

    Raises
    ------
    InputError
        When the record has other settings than this version knows.
    """
    try:
        values = dict(arguments["config"])
        rule = StandstillRule(**values.pop("standstill"))
        sphere = SphereRule(**values.pop("sphere"))
        for name in ("drift_parameters", "tip_m"):
            values[name] = tuple(values.get(name, ()))
        values["work_poses"] = tuple(tuple(q) for q in values.get("work_poses", ()))
        return ThermalConfig(standstill=rule, sphere=sphere, **values)
    except (KeyError, TypeError) as error:
        raise InputError(f"the recorded configuration cannot be read: {error}") from error


# ---- found cycles -------------------------------------------------------------------------------


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
