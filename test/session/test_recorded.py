# SPDX-License-Identifier: Apache-2.0
"""What replay does with a recording: its configuration, and joint readings that decide nothing."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hand_eye_driver import ARM
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from joint_blocks import in_blocks
from tool_driver import config_of, noisy_cell

from robocal_ros.bags.replay import read_events, replay
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POINT,
    JointBlock,
    JointSample,
    JointStream,
    PointSample,
    StandstillRule,
)
from robocal_ros.hand_eye import session as hand_eye_session
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome, reached
from robocal_ros.thermal import session as thermal_session
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.observations import ObservationDesk
from robocal_ros.thermal.session import ThermalSession, session_as_recorded
from robocal_ros.tool import session as tool_session
from robocal_ros.tool.session import ToolSession, take_tool_message

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


MS = 1_000_000
NAMES = ("a", "b")
RULE = StandstillRule(before_s=0.3, after_s=0.1, tolerance_rad=1e-3, gap_s=0.25)
START_MS = 10_000_000

STEPS_MS = (8, 8, 8, 50, 100, 250, 260, 900)
LEAPS_MS = (-3_600_000, -5000, -1001, -1000, -999, -100, -8, 0, 999, 1000, 1001, 1500, 60_000)


class Recorded(NamedTuple):
    topic: str
    message: Any


@st.composite
def streams(draw: st.DrawFn, names: tuple[str, ...] = NAMES) -> list[Any]:
    """Joint readings with leaps of the clock, wrong stamps, disorder, pauses, motion; points."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    at_ms, q = START_MS, rng.normal(size=len(names))
    orders = [names, (*reversed(names), "gripper"), names[:1]]
    found: list[Any] = []

    def joints(ms: int, order: tuple[str, ...] = names) -> None:
        values = dict(zip(names, q + 1e-5 * rng.normal(size=len(names)), strict=True))
        row = np.array([values.get(name, 7.0) for name in order])
        found.append(JointSample(ms * MS, order, row))

    for _ in range(draw(st.integers(1, 12))):
        order = orders[draw(st.sampled_from((0, 0, 0, 0, 1, 2)))]
        step_ms = draw(st.sampled_from(STEPS_MS))
        for _ in range(draw(st.integers(1, 60))):
            at_ms += step_ms
            joints(at_ms, order)
        match draw(st.sampled_from(("point", "point", "wrong", "leap", "move", "zero"))):
            case "point":
                stamp = (at_ms + draw(st.integers(-2500, 2500))) * MS
                found.append(PointSample(stamp, "sensor", "ball", rng.normal(size=3)))
            case "wrong":
                joints(at_ms + draw(st.sampled_from(LEAPS_MS)))
            case "leap":
                at_ms += draw(st.sampled_from(LEAPS_MS))
            case "move":
                q = rng.normal(size=len(names))
            case "zero":
                joints(0)
    return found


class Desk:
    """A desk as a session: its one command uses the observations up to its stamp."""

    def __init__(self) -> None:
        self.desk = ObservationDesk(NAMES, RULE)
        self.desk.stream = JointStream(NAMES, capacity=16)
        self.queue: list[Command] = []
        self.told: list[Any] = []

    @property
    def newest_joints_ns(self) -> int:
        return self.desk.newest_ns.get(JOINTS, 0)

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        self.queue.append(command)

    def take_plain(self, block: JointBlock, start: int) -> int:
        marks = (self.queue[0].marks if self.queue else None) or {}
        wanted_ns, newest_ns = marks.get(JOINTS, -1), self.desk.newest_ns.get(JOINTS, -1)
        return self.desk.take_plain(block, start, wanted_ns if newest_ns < wanted_ns else None)

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        if not self.queue:
            return []
        marks, desk = self.queue[0].marks or {}, self.desk
        if not force and not reached(marks, desk.marks):
            return []
        command = self.queue.pop(0)
        found = desk.window(-1, command.stamp_ns or 0, marks | {MEASURED_POINT: 2**62})
        self.told.append((wall_ns, [o.sample.stamp_ns for o in found], desk.marks, state_of(desk)))
        desk.use(command.stamp_ns or 0)
        return [Outcome(command, Code.ACCEPT, "")]


def take(session: Desk, kind: str, sample: Any) -> None:
    joint = isinstance(sample, JointSample)
    (session.desk.add_joints if joint else session.desk.add_measurement)(sample)


def of_stream(stream: JointStream) -> tuple[Any, ...]:
    stamps, q = stream.window(-(2**62), 2**62)
    held = stream._held and (stream._held[0], stream._held[1].tobytes())
    return stamps.tobytes(), q.tobytes(), held, stream.gap_count, stream.longest_gap_ns


def state_of(desk: ObservationDesk) -> tuple[Any, ...]:
    observed = [(o.ready_ns, o.q.tobytes(), id(o.sample)) for o in desk._observed]
    behind = [(at_ns, id(sample)) for at_ns, sample in desk._behind]
    waiting = [id(sample) for sample in desk._pending]
    counted = dict(desk.received), dict(desk.ignored), dict(desk.ignored._last)
    times = dict(desk.newest_ns), desk.used_ns, desk._complete_ns, desk._left_ns, desk.jumps
    return of_stream(desk.stream), observed, behind, waiting, counted, times


MARKS = st.lists(st.tuples(st.integers(0, 80_000), st.integers(0, 2)), max_size=4)
SIZES = st.lists(st.sampled_from((1, 2, 7, 33, 1000)), min_size=1, max_size=5)


def commands_at(marks: list[tuple[int, int]], name: str, arguments: Any) -> list[Any]:
    return [
        (Command(name, arguments, at, {JOINTS: at, JUMPS: jumps}), {})
        for at, jumps in (((START_MS + ms) * MS, jumps) for ms, jumps in marks)
    ]


@settings(max_examples=50, deadline=None)
@given(streams(), SIZES, MARKS)
def test_a_desk_knows_the_same(samples, sizes, marks):
    ends = []
    for messages in (samples, list(in_blocks(samples, sizes))):
        session = Desk()
        stream = [Recorded("x", message) for message in messages]
        replay(session, stream, commands_at(marks, "look", {}), None, take)
        ends.append((session.told, state_of(session.desk)))
    assert ends[0] == ends[1]


@pytest.fixture(scope="module")
def cell():
    return noisy_cell()


CELL_NAMES = tuple(noisy_cell().arm.joint_names)


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(samples=streams(CELL_NAMES), sizes=SIZES, marks=MARKS)
def test_a_tool_session_knows_the_same(cell, history, samples, sizes, marks):
    """The command begins a run, which watches each reading until it is broken off."""
    joints = [sample for sample in samples if isinstance(sample, JointSample)]
    ends = []
    for messages in (joints, list(in_blocks(joints, sizes))):
        session = ToolSession(cell.arm, history, config_of(cell), "test")
        stream = [Recorded(JOINTS, message) for message in messages]
        commands = commands_at(marks, events.MEASURE_TOOL, {"mode": "full"})
        report = replay(session, stream, commands, None, take_tool_message)
        told = [(o.command, o.status, o.message) for o in report.outcomes]
        counted = dict(session.received), dict(session.ignored), session.marks, session._over
        ends.append((told, of_stream(session.stream), counted, watched(session)))
    assert ends[0] == ends[1]


def watched(session: ToolSession) -> list[Any]:
    """What the watch of the open run has seen lately."""
    watch = None if session.run is None else session.run._watch
    return [] if watch is None else [(time_s, at.tobytes()) for time_s, at in watch._recent]


def test_what_decides_nothing_is_taken_at_once():
    """The fast way is taken at all: of 1000 readings few come one by one."""
    samples = [JointSample((START_MS + 8 * i) * MS, NAMES, np.zeros(2)) for i in range(1000)]
    samples.insert(500, PointSample((START_MS + 4200) * MS, "sensor", "ball", np.zeros(3)))
    singles = []

    def counted(session: Desk, kind: str, sample: Any) -> None:
        singles.append(sample)
        take(session, kind, sample)

    session = Desk()
    stream = [Recorded("x", message) for message in in_blocks(samples, [10_000])]
    replay(session, stream, commands_at([(3000, 0)], "look", {}), None, counted)
    assert session.desk.received[JOINTS] == 1000
    assert len(session.told) == 1
    assert len(singles) == 2 + 1 + 1 + 1  # the beginning, the command, the point, its joints
