"""Sessions that start where a recorded one did."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hand_eye_driver import ARM
from tool_driver import config_of, noisy_cell

from robocal_ros.bags.replay import read_events
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.ground.samples import JOINTS, JUMPS
from robocal_ros.hand_eye import session as hand_eye_session
from robocal_ros.hand_eye.config import HandEyeConfig
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.kinematics.arm import model_document
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.thermal import session as thermal_session
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession, session_as_recorded
from robocal_ros.tool import session as tool_session
from robocal_ros.tool.session import ToolSession

NS = 1_000_000_000
KINDS = {
    "thermal": (
        lambda history: ThermalSession(ARM, history, ThermalConfig(), "test"),
        thermal_session.configuration,
        session_as_recorded,
    ),
    "tool": (
        lambda history: ToolSession(ARM, history, config_of(noisy_cell()), "test"),
        tool_session.configuration,
        tool_session.tool_session_as_recorded,
    ),
    "hand-eye": (
        lambda history: HandEyeSession(ARM, history, HandEyeConfig(), "test"),
        hand_eye_session.configuration,
        hand_eye_session.hand_eye_session_as_recorded,
    ),
}


@pytest.mark.parametrize(
    ("kind", "broken"), [*((kind, "config") for kind in KINDS), ("thermal", "tracker")]
)
def test_a_recording_that_cannot_be_read_leaves_the_history_empty(history, kind, broken):
    """What it left would be taken for the user's own at the next try."""
    begun, configuration, as_recorded = KINDS[kind]
    configured = configuration(begun(history), {})
    arguments = dict(configured.arguments) | {"model": model_document(ARM)}
    whole = Command(configured.name, json.loads(json.dumps(arguments)))
    with pytest.raises(InputError, match="cannot be read"):
        as_recorded(ARM, history, Command(whole.name, whole.arguments | {broken: {"x": 1}}), "test")
    assert not history.list(1)
    as_recorded(ARM, history, whole, "test")
    assert history.head(THERMAL).model == whole.arguments["model"]


def event(command: Command, outcome: str = "{}") -> SimpleNamespace:
    """As a bag gives it."""
    stamp = SimpleNamespace(sec=(command.stamp_ns or 0) // 10**9, nanosec=0)
    arguments = events.arguments_text(command)
    message = SimpleNamespace(
        command=command.name, stamp=stamp, arguments=arguments, outcome=outcome
    )
    return SimpleNamespace(topic="/n/session_events", message=message)


def test_nothing_is_awaited_that_came_before_the_recording():
    marks = {JOINTS: 8 * NS, "beam_events/x": 3 * NS, "beam_events/y": 7 * NS}
    recorded = [event(Command("measure_tool", {}, 8 * NS, marks))]
    _, ((command, _),) = read_events(recorded, 5 * NS)
    assert command.marks == {JOINTS: 8 * NS, "beam_events/y": 7 * NS, JUMPS: 0}


def test_a_thermal_model_accepted_meanwhile_is_followed(history):
    """By a tool session, which takes it from the thermal node."""
    begun, configuration, as_recorded = KINDS["tool"]
    first = replace(configuration(begun(history), {}), stamp_ns=1 * NS)
    model = json.loads(json.dumps(model_document(ARM)))
    later = replace(first, arguments=first.arguments | {"model": model}, stamp_ns=3 * NS)
    between = Command("break_off", {}, 2 * NS, {})
    configured, commands = read_events(map(event, (first, between, later)))
    assert [command.name for command, _ in commands] == ["break_off", "configure"]
    session = as_recorded(ARM, history, configured, "test")
    assert session.current.thermal.model is None
    session.submit(commands[1][0])
    (outcome,) = session.step(wall_ns=1, force=True)
    assert outcome.done
    assert session.current.thermal.model == model


def test_a_thermal_session_follows_its_own_decisions(history):
    begun, configuration, _ = KINDS["thermal"]
    first = replace(configuration(begun(history)), stamp_ns=1 * NS)
    later = replace(first, arguments=first.arguments | {"model": model_document(ARM)})
    between = Command("end_cycle", {}, 2 * NS, {})
    _, commands = read_events(map(event, (first, between, later)))
    assert [command.name for command, _ in commands] == ["end_cycle"]
