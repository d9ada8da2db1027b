# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag of a laser tracker: ``python bags/make_tracker.py``.

Simulated: a laser tracker and a line laser on the flange of a UR10 calibrate by multiple coordinate
transformations: the tracker's target on two arcs, a sphere, five points on each of two faces, and
profiles of a scan, each captured at its own standstill. Once the tracker's beam is broken: that
capture fails and is asked for again. ``joint_states``, ``tracker_point``, ``profile``, the events
and ``/truth/hand_eye`` in ``hand_eye_tracker.mcap`` as those of ``make_hand_eye``; the target file
(``.yaml``) beside it.
"""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from hand_eye_recorder import record_session
from make_hand_eye import CLOUD_FIELDS, FOLDER, FRAME, START_NS, TRUTH
from numpy.typing import NDArray

from bench.hand_eye_files import write_tracker_target
from bench.laser_tracker import TrackerCell, six_axis_cell
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.hand_eye.data import SCAN
from robocal_ros.hand_eye.profiles import sensor_of
from robocal_ros.hand_eye.session import HandEyeConfig
from robocal_ros.hand_eye.targets import FACES, SPHERE, read_target, target_document
from robocal_ros.kinematics.joint_errors import SIZE_URAD
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome

Array = NDArray[np.float64]

BAG = FOLDER / "hand_eye_tracker.mcap"
ARM = load_robot("ur10")
Q_NEAR = np.radians([-30.0, -100.0, -110.0, -60.0, 90.0, 20.0])
SEED, JITTER_SEED, JITTER_RAD = 41, 42, 1e-6
RATE_HZ = 50.0
MOVE_S, REST_S, ASK_S, SHOT_S = 0.2, 0.8, 0.1, 0.5  # the last two: after the arrival
TIMEOUT_S = 1.0
BROKEN, AGAIN_S = 3, 1.6  # capture that the tracker does not see at first; asked for again then
CORNERS = [0, 2, 4, 6, 8]  # of nine points on a face
CONFIG = HandEyeConfig(
    sensor_frame=FRAME,
    sensor=sensor_of("", "away"),
    capture_timeout_s=TIMEOUT_S,
    joint_error_rad=1e-6 * SIZE_URAD,
)


def captures(cell: TrackerCell) -> Iterator[tuple[Array, str, Array]]:
    """Joints, mark, and the tracker's point (3,) or a profile (n, 2), with all noise of the cell.

    Every other point of the arcs and every third profile.
    """
    data = cell.measure(np.random.default_rng(SEED))
    for arc in data.arcs:
        for q, point in zip(arc.q[::2], arc.points[::2], strict=True):
            yield q, arc.name, point
    still = data.arcs[0].q[0]
    for point in data.sphere:
        yield still, SPHERE, point
    for name, points in zip(FACES, data.faces, strict=True):
        for point in points[CORNERS]:
            yield still, name, point
    for q, profile in list(zip(data.q, data.profiles, strict=True))[::3]:
        yield q, SCAN, profile.points


def _ns(time_s: float) -> int:
    return START_NS + round(time_s * 1e6) * 1000


def _cloud(points: Array) -> dict[str, Any]:
    data = np.insert(points, 1, 0.0, axis=1).astype("<f4")
    return {
        "height": 1, "width": len(data), "fields": CLOUD_FIELDS, "is_bigendian": False,
        "point_step": 12, "row_step": 12 * len(data),
        "data": np.frombuffer(data.tobytes(), dtype=np.uint8), "is_dense": False,
    }  # fmt: skip


def record(path: Path) -> Outcome:
    """Make the bag and the target file beside it; what was calibrated."""
    cell, rng = six_axis_cell(ARM, Q_NEAR), np.random.default_rng(JITTER_SEED)
    file = path.with_suffix(".yaml")
    write_tracker_target(file, cell.sizes.target)
    told = {"simulated": True, "T_flange_sensor": cell.T_flange_sensor.tolist()}
    records: list[tuple[float, str, str, dict[str, Any]]] = [
        (0.0, TRUTH, "std_msgs/msg/String", {"data": json.dumps(told)})
    ]
    start = {
        "target": target_document("tracker", read_target(file)), "feature": "edge",
        "method": "best", "mount": "in-hand",
    }  # fmt: skip
    asked, now_s, here = [(_ns(0.5 * MOVE_S), Command(events.START, start))], 0.0, Q_NEAR
    for number, (q, mark, seen) in enumerate(captures(cell)):
        arrival_s = now_s + MOVE_S
        longer_s = AGAIN_S if number == BROKEN else 0.0
        asks = sorted({arrival_s + ASK_S, arrival_s + ASK_S + longer_s})
        shot_s, leave_s = arrival_s + SHOT_S + longer_s, arrival_s + REST_S + longer_s
        asked += [(_ns(at), Command(events.CAPTURE, {"mark": mark})) for at in asks]
        times = now_s + np.arange(1, round((leave_s - now_s) * RATE_HZ) + 1) / RATE_HZ
        share = np.clip((times - now_s) / MOVE_S, 0.0, 1.0)[:, None]
        way = here + share * (q - here) + JITTER_RAD * rng.standard_normal((len(times), ARM.n))
        for at, row in zip(times.tolist(), way, strict=True):
            header = {"stamp": ros_time(_ns(at)), "frame_id": ""}
            joints = {"header": header, "name": list(ARM.joint_names), "position": row}
            records.append((at, "/joint_states", "sensor_msgs/msg/JointState", joints))
        header = {"stamp": ros_time(_ns(shot_s)), "frame_id": FRAME if mark == SCAN else "tracker"}
        if mark == SCAN:
            shot = ("/profile", "sensor_msgs/msg/PointCloud2", {"header": header} | _cloud(seen))
        else:
            point = dict(zip("xyz", seen.tolist(), strict=True))
            kind = "geometry_msgs/msg/PointStamped"
            shot = ("/tracker_point", kind, {"header": header, "point": point})
        records.append((shot_s + 0.01, *shot))
        now_s, here = leave_s, q
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs.mcap"
        with BagWriter(inputs) as bag:
            for at, topic, kind, message in sorted(records, key=lambda one: one[0]):
                bag.write(topic, kind, message, _ns(at))
        return record_session(inputs, path, CONFIG, asked, TRUTH)


def main() -> None:
    """Write the bag beside this script."""
    found = record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated; {found.message}")


if __name__ == "__main__":
    main()
