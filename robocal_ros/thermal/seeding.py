"""A session that starts where a recorded one started."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.ground.samples import JOINTS
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import CONFIGURE, Command
from robocal_ros.session.history import History, require_robot, seeded
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.follower_state import FollowerState
from robocal_ros.thermal.in_force import REFERENCE
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
