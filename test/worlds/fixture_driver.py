# SPDX-License-Identifier: Apache-2.0
"""Drives a fixture session with standstills and points, and writes the bag of it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.measured_fixture import ARM, FRAME, LIMITS, PLATE, MeasuredFixture, fixture_poses
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.fixture import T_FLANGE_SENSOR
from robocal_ros.fixture.files import fixture_document
from robocal_ros.fixture.session import (
    POINT,
    FixtureConfig,
    FixturePointSample,
    FixtureSession,
    fixture_configuration,
)
from robocal_ros.ground import frames
from robocal_ros.ground.samples import JOINTS, JointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import hand_eye_kind
from robocal_ros.session import events
from robocal_ros.session.events import Command, arguments_text, outcome_text

EVENTS = "/fixture_node/session_events"
TYPE = {JOINTS: "sensor_msgs/msg/JointState", POINT: "geometry_msgs/msg/PointStamped"}

CONFIG = FixtureConfig(fixture=fixture_document(PLATE), sensor_frame=FRAME, limits=LIMITS)
SECOND = 1_000_000_000


@dataclass
class Sent:
    topic: str
    message: Any


def mounted(history, T_flange_sensor=T_FLANGE_SENSOR):
    """The sensor's place on the flange comes into force, as hand_eye_node proposes it."""
    events.bring_into_force(
        history,
        hand_eye_kind(FRAME),
        ARM,
        {"parent": "tool0", "child": FRAME, "T_parent_sensor": T_flange_sensor.tolist()},
        "test",
    )


def visit(points, begin_s):
    """Joint readings at 50 Hz of standstills of 1 s, each with its point in the sensor."""
    sent = []
    for i, (q, T, p) in enumerate(zip(points.q, points.T_base_flange, points.p, strict=True)):
        at = int((begin_s + i) * SECOND)
        seen = frames.apply(frames.invert(T @ T_FLANGE_SENSOR), p)
        for k in range(46):
            stamp = at + k * 20_000_000
            sent.append(Sent(JOINTS, JointSample(stamp, ARM.joint_names, q)))
            if k == 20:
                sent.append(Sent(POINT, FixturePointSample(stamp + 1, FRAME, seen)))
    return sent


class Driven:
    """A session that is fed, and what a recorder would have."""

    def __init__(self, history):
        self.session = FixtureSession(ARM, history, CONFIG, "test")
        self.configured = fixture_configuration(self.session, {kind: f"/{kind}" for kind in TYPE})
        self.newest, self.sent, self.told, self.all = self.configured, [], [], []

    def look(self):
        """As the node before each command: what came into force is told."""
        self.session.poll()
        now = fixture_configuration(self.session, self.newest.arguments["topics"])
        if now.arguments != self.newest.arguments:
            self.newest = now
            self.all.append(now)

    def feed(self, sent):
        for one in sent:
            self.session.add(one.message)
        self.sent += sent
        self.all += sent

    def ask(self, name, **arguments):
        self.session.submit(Command(name, arguments))
        # joints go on, until the command's samples are complete
        stamp, q = self.session.newest_joints_ns, fixture_poses()[-1]
        for k in range(1, 12):
            self.feed([Sent(JOINTS, JointSample(stamp + k * 20_000_000, ARM.joint_names, q))])
        self.look()
        done = self.session.step(wall_ns=self.session.newest_joints_ns)
        self.told += [(outcome.command, json.loads(outcome_text(outcome))) for outcome in done]
        self.all += done
        return done[-1]


def fixture_bag(path: Path) -> None:
    """Taught, accepted, moved, measured: all that was said, and what came of it."""
    state = path.parent / "state_fixture"
    with CalibrationHistory.open("F1", model_hash=ARM.model_hash, state_dir=state) as history:
        mounted(history)
        cell, driven = MeasuredFixture(3), Driven(history)
        driven.feed(visit(cell.points(cell.faults(), 3, 1), 10.0))
        driven.ask(events.CALIBRATE, teach=True)
        driven.ask(events.ACCEPT, choose="only", by="me")
        driven.ask(events.START)
        driven.feed(visit(cell.points(cell.faults("fixture_moved", 4e-4), 2, 2), 100.0))
        driven.ask(events.CALIBRATE)
        driven.ask(events.ACCEPT, choose="only", by="me")
    now_ns, sequence = 1, 0
    with BagWriter(path, latched=[EVENTS]) as bag:
        for one in (driven.configured, *driven.all):
            if isinstance(one, Sent):
                now_ns = max(now_ns, one.message.stamp_ns)
                bag.write(f"/{one.topic}", TYPE[one.topic], _fields(one.message), now_ns)
                continue
            command = one if isinstance(one, Command) else one.command
            sequence += 1
            event = {
                "stamp": ros_time(command.stamp_ns or 0),
                "sequence": sequence,
                "command": command.name,
                "arguments": arguments_text(command),
                "outcome": "{}" if isinstance(one, Command) else outcome_text(one),
            }
            bag.write(EVENTS, "robocal_msgs/msg/SessionEvent", event, now_ns)


def _fields(sample: Any) -> dict[str, Any]:
    point = isinstance(sample, FixturePointSample)
    header = {
        "stamp": ros_time(sample.stamp_ns),
        "frame_id": sample.frame if point else "",
    }
    if point:
        return {"header": header, "point": dict(zip("xyz", sample.p.tolist(), strict=True))}
    names, q = list(sample.names), sample.position
    return {"header": header, "name": names, "position": q, "velocity": q[:0], "effort": q[:0]}
