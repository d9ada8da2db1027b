"""The golden shift's excerpt, and what a session's events say, for its two live tests."""

import json
from pathlib import Path
from typing import Any

from robocal_msgs.msg import SessionEvent

from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Outcome, digest

BAG = Path(__file__).parents[2] / "bags" / "golden_excerpt.mcap"
ROBOT = "kr150_r3100"
THERMAL_EVENTS, TOOL_EVENTS = "/thermal_node/session_events", "/tcf_node/session_events"
NS = 1_000_000_000


def kept(state: Path, name: str) -> CalibrationHistory:
    return CalibrationHistory.open(name, model_hash=load_robot(ROBOT).model_hash, state_dir=state)


def told(outcome: Outcome) -> tuple[Any, ...]:
    """What an event says, the document by its fingerprint."""
    command = outcome.command
    return (
        command.name, command.stamp_ns, int(outcome.status), outcome.samples,
        digest(outcome.document),
    )  # fmt: skip


def said(event: SessionEvent) -> tuple[Any, ...]:
    found = json.loads(event.outcome)
    stamp_ns = event.stamp.sec * NS + event.stamp.nanosec
    return event.command, stamp_ns, found["status"], found["samples"], found["digest"]


def commands_of(live: list[SessionEvent]) -> list[SessionEvent]:
    return [event for event in live if event.command != events.CONFIGURE]


def arguments(event: SessionEvent) -> dict[str, Any]:
    return dict(json.loads(event.arguments)["arguments"])
