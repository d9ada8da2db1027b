# SPDX-License-Identifier: Apache-2.0
"""The bag of a simulated hand-eye session: all that was said, and what came of it."""

from pathlib import Path

from hand_eye_driver import ARM, FRAME, LASER, START_NS, TYPE, Driver, Recorded

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter, read_data_set, write_data_set
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession, configuration
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome, arguments_text, outcome_text

EVENTS = "/hand_eye_node/session_events"


def hand_eye_bag(path: Path) -> None:
    """A sphere, a capture without a profile, a result that is accepted, a set from a file."""
    with CalibrationHistory.open("K1", state_dir=path.parent / "state_hand_eye") as history:
        config = HandEyeConfig(sensor_frame=FRAME, sensor=LASER, capture_timeout_s=1.0)
        driver = Driver(HandEyeSession(ARM, history, config, "test"))
        first = configuration(driver.session, {kind: f"/{kind}" for kind in TYPE})
        driver.sphere(10)
        driver.ask(events.CAPTURE)
        driver.robot.move(driver.robot.q + 0.1, 1.5)
        found = driver.ask(events.CALIBRATE)
        driver.ask(events.ACCEPT, id=found.calibration_id, by="me")
        data, saved = driver.session.data, path.with_name("saved.mcap")
        write_data_set(saved, data.document(), data.topic, FRAME, ARM)
        driver.ask(events.LOAD, path="saved.mcap", set=read_data_set(saved, ARM))
        driver.ask(events.CALIBRATE, handles=list(range(1, 9)))
        _write(path, first, driver.recorded)


def _write(path: Path, first: Command, recorded: list[Recorded | Outcome]) -> None:
    now_ns, sequence = START_NS, 0
    with BagWriter(path, latched=[EVENTS]) as bag:
        for one in (first, *recorded):
            if isinstance(one, Recorded):
                now_ns = max(now_ns, one.stamp_ns)
                bag.write(f"/{one.kind}", TYPE[one.kind], one.fields, now_ns)
                continue
            command = one if isinstance(one, Command) else one.command
            sequence += 1
            event = {
                "stamp": ros_time(command.stamp_ns or 0),
                "sequence": sequence,
                "command": command.name,
                "arguments": arguments_text(command),
                "outcome": outcome_text(one) if isinstance(one, Outcome) else "{}",
            }
            bag.write(EVENTS, "robocal_msgs/msg/SessionEvent", event, now_ns)
