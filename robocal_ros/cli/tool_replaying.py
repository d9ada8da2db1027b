"""From the bag of a tool node to its tools: what ``robocal replay`` computes of it."""

from collections.abc import Iterable
from typing import Any

from robocal_ros.bags.replay import ReplayReport
from robocal_ros.cli.output import Document
from robocal_ros.cli.recording import BagOverview
from robocal_ros.cli.replay_parts import commanded_document, replay_commanded, seconds
from robocal_ros.ground.frames import transform_document
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Outcome
from robocal_ros.tool.recorded import take_tool_message, tool_session_as_recorded
from robocal_ros.tool.session import ToolSession


def replay_tool(
    recording: BagOverview, arm: SerialArm, history: CalibrationHistory, samples: Iterable[Any]
) -> Document:
    """Replay what a tool node recorded: each run with its answer.

    Raises
    ------
    InputError, WrongRobotError
        The bag lacks what a replay needs.
    """
    report, session = replay_commanded(
        recording, arm, history, samples, tool_session_as_recorded, take_tool_message
    )
    return _document(report, session, recording)


def _document(report: ReplayReport, session: ToolSession, recording: BagOverview) -> Document:
    return commanded_document(report, session, recording) | {
        "runs": [_run(o) for o in report.outcomes if o.document is not None],
        "final_tool": transform_document(session.current.tool.T_flange_tool)
        | {"revision": session.in_force.revision},
    }


def _run(outcome: Outcome) -> Document:
    number = outcome.command.arguments.get("run", 0)
    return {"stamp": seconds(outcome.command.stamp_ns), "run": number, **(outcome.document or {})}
