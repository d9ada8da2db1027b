# SPDX-License-Identifier: Apache-2.0
"""The golden bag of a measuring robot: replayed bit for bit, and what its corrected points miss."""

import json
from pathlib import Path

import numpy as np
import pytest
from command import beyond_rounding, robocal_json

from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.replay import read_events
from robocal_ros.ground.frames import apply
from robocal_ros.ground.samples import JOINTS, SPHERE_CENTER, joint_sample, point_sample, stamp_ns
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.thermal.drift_following import FLANGE, ThermalConfig
from robocal_ros.thermal.observations import PlacedShot, PointQueue, SensorShot
from robocal_ros.thermal.screening import share_within
from robocal_ros.thermal.session import ThermalSession

BAG = Path(__file__).parents[2] / "bags" / "measuring_shift.mcap"
EVENT_TOPIC = "/thermal_node/session_events"
POINTS = 12  # of the part, in each cycle
LAMBDA, LIMIT_M = 0.95, 1e-4  # share of points, and within what


@pytest.fixture(scope="module")
def placed(tmp_path_factory) -> tuple[np.ndarray, np.ndarray]:
    """The part's points (c, 12, 3) in base in each cycle: with the model of then, and nominal."""
    nominal = load_robot("kr150_r3100")
    folder = tmp_path_factory.mktemp("measuring")
    config = ThermalConfig(arrangement=FLANGE)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    with (
        CalibrationHistory.open("s", model_hash=nominal.model_hash, state_dir=folder) as history,
        BagReader(BAG) as reader,
    ):
        session = ThermalSession(nominal, history, config, "test")
        _, commands = read_events(reader.messages([EVENT_TOPIC]), 0)
        waiting = [command for command, _ in commands]
        queue = PointQueue(session.desk.stream)
        for recorded in reader.messages([JOINTS, SPHERE_CENTER, "point"]):
            while waiting and (waiting[0].stamp_ns or 0) < recorded.log_time_ns:
                command = waiting.pop(0)
                session.submit(command)
                for outcome in session.advance(wall_ns=1, force=True):
                    assert outcome.done or command.name == events.IDENTIFY, outcome.message
            message = recorded.message
            if recorded.topic == JOINTS:
                session.add(joint_sample(message))
            elif recorded.topic == SPHERE_CENTER:
                session.add(point_sample(message, topic=SPHERE_CENTER))
            else:
                p = message.point
                at = stamp_ns(message.header.stamp)
                queue.add(SensorShot(at, message.header.frame_id, np.array([[p.x, p.y, p.z]])))
            if session.reference is not None:
                X = session.reference.spheres.T_flange_sensor
                for shot, one in queue.ready(session.current.arm, X):
                    assert isinstance(one, PlacedShot)
                    q = session.desk.stream.at(shot.stamp_ns, 0.05)
                    found.append((one.points[0], apply(nominal.fk(q) @ X, shot.points)[0]))
    both = np.array(found)
    assert len(both) == 5 * POINTS  # the cold cycle and four warm ones
    return tuple(both[:, i].reshape(-1, POINTS, 3) for i in range(2))


def test_corrected_points_stay_where_the_part_stands(placed):
    """The part does not move: what its points wander since the cold cycle is the robot's."""
    corrected, nominal = placed
    wander, without = corrected[1:] - corrected[0], nominal[1:] - nominal[0]
    assert share_within(without.reshape(-1), LIMIT_M) < 0.5
    assert share_within(wander.reshape(-1), LIMIT_M) >= LAMBDA


def test_replay_gives_the_recorded_session_again(tmp_path):
    document = robocal_json("replay.json", "replay", str(BAG), "--state", str(tmp_path))
    assert (document["recorded"], beyond_rounding(document)) == (True, [])
    assert len(document["candidates"]) == 4


def test_the_command_places_the_same_points(placed, tmp_path):
    """With the last model in force, of the history that a replay left."""
    robocal_json("replay.json", "replay", str(BAG), "--state", str(tmp_path))
    table = tmp_path / "base.csv"
    document = robocal_json(
        "correct-points.json", "correct-points", "--robot", "kr150_r3100",
        "--robot-serial", "measuring_shift",
        "--state", str(tmp_path), "--bag", str(BAG), "--output", str(table),
    )  # fmt: skip
    assert document["not_placed"] == []
    last = np.array([row["xyz_mm"] for row in document["points"]])[-POINTS:]
    assert last == pytest.approx(1e3 * placed[0][-1], abs=1e-6)
    assert table.read_text().splitlines()[0] == "sample,stamp_s,x_mm,y_mm,z_mm"


def test_the_bag_tells_that_it_is_simulated():
    with BagReader(BAG) as reader:
        (truth,) = (json.loads(m.message.data) for m in reader.messages(["/truth/part"]))
    assert truth["simulated"]
    assert len(truth["part_m"]) == POINTS
