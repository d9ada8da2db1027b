"""The bag of a simulated hand-eye session: all that was said, and what came of it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "sessions"))  # for hand_eye_driver

from hand_eye_driver import ARM, FRAME, START_NS, TYPE, Driver, Recorded

from robocal_ros.sessions import events
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.hand_eye import HandEyeSession
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.hand_eye_recorded import configuration
from robocal_ros.sessions.records import arguments_text, outcome_text
from robocal_ros.storage.bag_writer import ros_time
from robocal_ros.storage.bags import BagWriter
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.hand_eye_bags import read_data_set, write_data_set

EVENTS = "/hand_eye_node/session_events"


def hand_eye_bag(path: Path) -> None:
    """A sphere, a capture without a profile, a result that is accepted, a set from a file."""
    with CalibrationHistory.open("K1", state_dir=path.parent / "state_hand_eye") as history:
        config = HandEyeConfig(sensor_frame=FRAME, capture_timeout_s=1.0)
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
