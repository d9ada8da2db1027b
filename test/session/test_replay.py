# SPDX-License-Identifier: Apache-2.0
"""Replay obeys what was recorded, finds cycles where nothing was, and says where it differs."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any, NamedTuple

import numpy as np
import pytest
from joint_blocks import in_blocks
from shift import Shift, built, postures, warmed

from robocal_ros.bags.replay import NOT_BITS, feed, input_topics, read_events, replay
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    JointBlock,
    JointSample,
    PointSample,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Proposal
from robocal_ros.session import events
from robocal_ros.session.events import (
    CONFIGURE,
    Command,
    arguments_text,
    digest,
    outcome_text,
    read_command,
)
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.observations import Observation
from robocal_ros.thermal.session import (
    ThermalSession,
    automatic_commands,
    config_of,
    configuration,
    take_message,
    window_commands,
)

NS = 1_000_000_000
POSES = 8


class Recorded(NamedTuple):
    topic: str
    message: Any


def stamp(ns: int) -> Message:
    return Message(sec=ns // NS, nanosec=ns % NS)


def joint_message(sample: JointSample) -> Message:
    header = Message(stamp=stamp(sample.stamp_ns), frame_id="")
    return Message(header=header, name=list(sample.names), position=sample.position)


def point_message(ns: int, frame_id: str, x: float, y: float, z: float) -> Message:
    header = Message(stamp=stamp(ns), frame_id=frame_id)
    return Message(header=header, point=Message(x=x, y=y, z=z))


def recorded(sample: Any) -> Recorded:
    if isinstance(sample, JointBlock):
        return Recorded("/cell/joint_states", sample)
    if isinstance(sample, JointSample):
        return Recorded("/cell/joint_states", joint_message(sample))
    frame_id = f"{sample.frame}/{sample.target}"
    message = point_message(sample.stamp_ns, frame_id, *sample.position_m.tolist())
    return Recorded("/cell/measured_point", message)


@pytest.fixture(scope="module")
def visits(nominal):
    shift = Shift(nominal.joint_names)
    cold, q = built(nominal), postures(nominal, POSES)
    warm = warmed(cold)
    hot = warmed(cold, 25.0)
    parts = [
        list(shift.visit(arm, q, after_h))
        for arm, after_h in ((cold, 0.0), (warm, 2.0), (hot, 2.0))
    ]
    tail = list(shift.visit(warm, q[:1]))
    return [*parts, tail]


def session_in(folder: Path, nominal, config: ThermalConfig | None = None) -> ThermalSession:
    history = CalibrationHistory.open("s1", model_hash=nominal.model_hash, state_dir=folder)
    return ThermalSession(nominal, history, config or ThermalConfig(), "test")


def event(command: Command, outcome: str = "{}") -> Recorded:
    message = Message(
        stamp=stamp(command.stamp_ns or 0),
        command=command.name,
        arguments=arguments_text(command),
        outcome=outcome,
    )
    return Recorded("/thermal_node/session_events", message)


def live(session: ThermalSession, visits: Sequence[Sequence[Any]]) -> list[Recorded]:
    """What a node does: capture, identify, accept, identify; returns the recorded events."""
    found = [event(configuration(session))]

    def give(command: Command) -> None:
        session.submit(command)

    def play(part: Sequence[Any]) -> None:
        for sample in part:
            session.add(sample)
            for outcome in session.advance(wall_ns=3):
                found.append(event(outcome.command, outcome_text(outcome)))
                if outcome.document is not None and outcome.done:
                    give(Command(events.ACCEPT, {"id": outcome.calibration_id, "by": "me"}))

    play(visits[0])
    give(Command(events.CAPTURE_REFERENCE))
    play(visits[1])
    give(Command(events.IDENTIFY, {"cycle_id": "one"}))
    play(visits[2])
    give(Command(events.IDENTIFY, {"cycle_id": "two"}))
    play(visits[3])
    return found


@pytest.mark.parametrize("sizes", [[1], [10_000], [3, 50, 8]])
def test_a_recording_gives_the_live_results_bit_for_bit(nominal, visits, tmp_path, sizes):
    node = session_in(tmp_path / "live", nominal)
    log = live(node, visits)
    names = [r.message.command for r in log]
    assert names == [CONFIGURE, "capture_reference", "identify", "accept", "identify", "accept"]
    configured, commands = read_events(log)
    again = session_in(tmp_path / "again", nominal, config_of(configured.arguments))
    samples = [recorded(s) for s in in_blocks([s for part in visits for s in part], sizes)]
    report = replay(again, samples, commands, None, take_message)
    assert report.differs == []
    assert [digest(o.document) for o in report.outcomes] == [
        json.loads(r.message.outcome)["digest"] for r in log[1:]
    ]
    assert again.in_force.revision == node.in_force.revision == 2
    assert again.in_force.model == node.in_force.model


def test_ids_of_another_history_are_translated(nominal, visits, tmp_path):
    log = live(session_in(tmp_path / "live", nominal), visits)
    again = session_in(tmp_path / "again", nominal)
    other = Proposal(
        model_hash=nominal.model_hash,
        based_on=0,
        cycle_id="earlier",
        stamp_ns=0,
        created_ns=0,
        software="test",
        method="map",
        code=Code.WORSE_THAN_CURRENT,
        reason="",
        document={},
        model={},
    )
    assert again._history.propose(other) == 1  # ids are shifted now
    _, commands = read_events(log)
    report = replay(
        again, [recorded(s) for part in visits for s in part], commands, None, take_message
    )
    assert report.differs == []
    assert again.in_force.calibration_id == 4


def test_other_samples_are_reported_as_a_difference(nominal, visits, tmp_path):
    log = live(session_in(tmp_path / "live", nominal), visits)
    _, commands = read_events(log)
    samples = [recorded(s) for part in visits for s in part]
    at = next(i for i, s in enumerate(samples[800:], 800) if s.topic.endswith("point"))
    lost = samples[: at - 1] + samples[at:]  # the joint reading beside one warm measurement
    report = replay(session_in(tmp_path / "again", nominal), lost, commands, None, take_message)
    assert report.differs
    assert "identify at" in report.differs[0]


def test_a_difference_that_no_words_tell_is_called_so(nominal, visits, tmp_path):
    """As from another processor, on which a sum is rounded otherwise."""
    log = live(session_in(tmp_path / "live", nominal), visits)
    _, commands = read_events(log)
    samples = [recorded(s) for part in visits for s in part]
    rounded = [
        (command, outcome | ({"digest": "0" * 16} if outcome["digest"] else {}))
        for command, outcome in commands
    ]
    again = session_in(tmp_path / "again", nominal)
    report = replay(again, samples, rounded, None, take_message)
    assert report.differs
    assert all(f"as recorded in its words, {NOT_BITS}" in words for words in report.differs)


def test_a_recording_that_began_later_starts_from_what_was_then_in_force(nominal, visits, tmp_path):
    """Latched events of before are in the bag, their samples are not."""
    session = session_in(tmp_path, nominal)
    log = live(session, visits)
    later = configuration(session)
    first = visits[2][40].stamp_ns
    before = [r for r in log if r.message.stamp.sec * NS + r.message.stamp.nanosec < first]
    after = [r for r in log if r not in before]
    configured, commands = read_events([*before, event(later), *after], first)
    assert configured.arguments["model"] == later.arguments["model"]
    assert [c.name for c, _ in commands] == ["identify", "accept"]
    # One that is in the bag from the start is the one that counts, whatever follows.
    configured, commands = read_events([*log, event(later)])
    assert configured.arguments["model"] is None
    assert len(commands) == 5


@pytest.mark.parametrize(("jumped_before", "sizes"), [(0, [1]), (3, [1]), (0, [10_000])])
def test_a_clock_that_jumped_back_in_the_recording(nominal, visits, tmp_path, jumped_before, sizes):
    """A simulation that began again: a command belongs to its own run of the clock."""
    parts = [visits[1], visits[0], visits[1], visits[3]]
    node = session_in(tmp_path / "live", nominal)
    node.desk.jumps = jumped_before  # the recording began later
    log = [event(configuration(node))]

    def play(part: Sequence[Any]) -> None:
        for sample in part:
            node.add(sample)
            for outcome in node.advance(wall_ns=3):
                log.append(event(outcome.command, outcome_text(outcome)))

    play(parts[0])
    node.submit(Command(events.REJECT, {"id": 99}))  # late on the clock, early in the recording
    play(parts[1])
    node.submit(Command(events.CAPTURE_REFERENCE))
    play(parts[2])
    node.submit(Command(events.IDENTIFY))
    play(parts[3])
    assert node.desk.jumps == jumped_before + 1
    assert [r.message.command for r in log[1:]] == ["reject", "capture_reference", "identify"]
    _, commands = read_events(log)
    samples = [recorded(s) for s in in_blocks([s for part in parts for s in part], sizes)]
    report = replay(session_in(tmp_path / "again", nominal), samples, commands, None, take_message)
    assert report.differs == []
    assert [o.samples for o in report.outcomes] == [0, POSES, POSES]


def test_a_configuration_comes_back_whole(nominal, tmp_path):
    poses, tip = ((0.1, -1.2, 1.3, 0.0, 0.4, 0.5),) * 2, (0.0, 0.01, 0.4)
    config = ThermalConfig(
        "lsq", sigma_m=1.23e-5, work_poses=poses, tip_m=tip, target="cube", lateness_s=0.5, seed=7
    )
    session = session_in(tmp_path, nominal, config)
    command = configuration(session, {JOINTS: "/a/joint_states"})
    read = read_command(CONFIGURE, 0, arguments_text(command))
    assert config_of(read.arguments) == config
    assert input_topics([], read) == {"/a/joint_states": JOINTS}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"version": 1, "marks": 3, "arguments": {}}'])
def test_a_broken_record_is_named(text):
    with pytest.raises(InputError, match="identify"):
        read_command("identify", 0, text)


def test_a_record_of_another_version_is_refused():
    with pytest.raises(InputError, match="version 99"):
        read_command("identify", 0, '{"version": 99, "marks": {}, "arguments": {}}')


def test_topics_by_their_names():
    topics = ["/r/joint_states", "/joint_correction_node/joint_states", "/s/measured_pose", "/x"]
    assert input_topics(topics) == {"/r/joint_states": JOINTS, "/s/measured_pose": MEASURED_POSE}
    with pytest.raises(InputError, match=r"both /a/joint_states and /b/joint_states"):
        input_topics(["/a/joint_states", "/b/joint_states"])


def test_samples_that_cannot_be_used_are_counted(nominal, tmp_path):
    session = session_in(tmp_path, nominal)
    bad = point_message(5 * NS, "sensor/ball", float("nan"), 0.0, 0.0)
    feed(session, Recorded("/cell/measured_point", bad), None, take_message)
    odd = Message(
        header=Message(stamp=stamp(5 * NS), frame_id="sensor"),
        pose=Message(
            position=Message(x=0.0, y=0.0, z=0.0),
            orientation=Message(x=0.0, y=0.0, z=0.0, w=0.7),
        ),
    )
    feed(session, Recorded("/cell/measured_pose", odd), None, take_message)
    short = joint_message(JointSample(5 * NS, ("a1", "a2"), np.zeros(1)))
    feed(session, Recorded("/cell/joint_states", short), None, take_message)
    assert {topic: sum(c.values()) for topic, c in session.desk.ignored.items()} == {
        MEASURED_POINT: 1,
        MEASURED_POSE: 1,
        JOINTS: 1,
    }
    assert "not finite" in next(iter(session.desk.ignored[MEASURED_POINT]))


def test_the_configured_target_names_measurements_that_name_none(nominal, visits, tmp_path):
    config = ThermalConfig(target="cube")
    session = session_in(tmp_path, nominal, config)
    for sample in visits[0]:
        if isinstance(sample, JointSample):
            session.add(sample)
    middle = visits[0][75].stamp_ns  # at rest
    take_message(session, MEASURED_POINT, point_message(middle, "sensor", 1.0, 2.0, 3.0))
    (found,) = session.desk.window(-1, 2**62, {JOINTS: 2**62, MEASURED_POINT: 2**62})
    assert found.sample.target == "cube"


def test_cycles_are_found_where_no_command_was_recorded(nominal, visits, tmp_path):
    scout = session_in(tmp_path / "scout", nominal)
    samples = [recorded(s) for part in visits[:3] for s in part]
    for sample in samples:
        feed(scout, sample, None, take_message)
    found = scout.desk.window(-1, 2**62, {JOINTS: 2**62, MEASURED_POINT: 2**62})
    assert len(found) == 3 * POSES
    commands = automatic_commands(found)
    assert [c.name for c, _ in commands] == ["capture_reference", "identify", "identify"]
    report = replay(session_in(tmp_path / "real", nominal), samples, commands, None, take_message)
    assert [o.samples for o in report.outcomes] == [POSES] * 3
    assert [o.status for o in report.outcomes] == [Code.ACCEPT] * 3


def test_a_cycle_may_bring_a_second_target_to_the_same_poses():
    """Poses with one target, then the same poses with another: both are one cycle."""

    def cycle(start_s):
        places = [(target, pose) for target in ("ball", "cube") for pose in range(5)]
        for i, (target, pose) in enumerate(places):
            at_ns = (start_s + i) * 1_000_000_000
            for again in range(2):  # measured twice in a row
                sample = PointSample(at_ns + again, "hall", target, np.zeros(3))
                yield Observation(sample, np.full(6, 0.1 * pose), at_ns + again, np.zeros(6))

    found = [one for start_s in (0, 100, 200) for one in cycle(start_s)]
    commands = [command for command, _ in automatic_commands(found)]
    assert [c.name for c in commands] == ["capture_reference", "identify", "identify"]
    starts = [c.arguments["from_ns"] for c in commands]
    assert starts == [start * 1_000_000_000 for start in (0, 100, 200)]


def test_poses_that_never_recur_are_one_calibration(nominal, visits, tmp_path):
    scout = session_in(tmp_path, nominal)
    for sample in visits[0]:
        scout.add(sample)
    found = scout.desk.window(-1, 2**62, {JOINTS: 2**62, MEASURED_POINT: 2**62})
    ((command, outcome),) = automatic_commands(found)
    assert command.name == events.IDENTIFY
    assert command.arguments["from_ns"] == found[0].sample.stamp_ns
    assert command.stamp_ns == found[-1].sample.stamp_ns
    assert outcome == {}


def test_nothing_observed_is_an_error():
    with pytest.raises(InputError, match="no measurement at standstill"):
        automatic_commands([])


def test_windows_take_what_lies_in_them(nominal, visits, tmp_path):
    samples = [recorded(s) for part in visits for s in part]
    edges = [(part[0].stamp_ns, part[-1].stamp_ns) for part in visits]
    commands = window_commands(edges[0], [edges[2]])
    report = replay(session_in(tmp_path, nominal), samples, commands, None, take_message)
    captured, identified = report.outcomes
    assert (captured.samples, identified.samples) == (POSES, POSES)
    assert identified.command.arguments["cycle_id"] == "window-1"
    warm = identified.document["in_force"]["held_out"]["rms_mm"]
    assert warm > 0.3  # 25 K, not the 15 K of the window left out
