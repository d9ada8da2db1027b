# SPDX-License-Identifier: Apache-2.0
"""A published UR10 before a Leica tracker with T-Mac, four campaigns, as tables and bags.

Data: Landgraf, Ernst, Schleth, Fabritius, Huber, IEEE CASE 2021 (MIT licence). `convert_campaign`
writes for a series, say A:

- ``A.csv`` for ``robocal identify``, and the same rows in two halves, ``A_train.csv`` and
  ``A_check.csv``; rows with equal joint targets are in the same half;
- ``A.mcap`` for ``robocal replay`` and the live nodes: ``joint_states`` around each measurement,
  so that the robot is seen at standstill, and ``measured_pose``.
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.estimation.assessment import hold_out, pose_groups
from robocal_ros.ground import frames
from robocal_ros.ground.files import quoted
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import Cells, read_published, write_measurements

SERIES = {
    "A": "measurements_grid.csv",
    "B": "measurements_joint_configurations.csv",
    "C": "measurements_random_poses.csv",
    "D": "measurements_iso_cubes.csv",
}
# Only series A has its times, to the second. In the others a spreadsheet left year and month:
# their stamps here are made, one pose every 30 s from an arbitrary day of that month on.
MADE_START = {
    "B": datetime(2020, 11, 2, tzinfo=UTC),
    "C": datetime(2020, 11, 9, tzinfo=UTC),
    "D": datetime(2021, 3, 1, tzinfo=UTC),
}
MADE_STEP_NS = 30_000_000_000
AROUND_NS = tuple(int(offset * 1e6) for offset in (-400, -200, 0, 200, 400))
MEASURED = tuple(f"measurement_{name}" for name in ("x", "y", "z", "rx", "ry", "rz"))
FRAME, TARGET = "tracker", "tmac"
SPLIT_SEED = 0


def load_campaign(series: str, folder: Path) -> Measurements:
    """Read a series in order of time: joint targets and poses of the T-Mac in the tracker frame.

    ``folder`` holds ``Series_A`` and its like, as they are published. Orientation is intrinsic XYZ
    in degrees. A sample's id is the series and its row in the file (the header is row 1). The
    tracker's own scatter is not passed on as ``sigma``: the robot's repeatability is several times
    larger.

    Raises `InputError` when the file is not there, or is not the published one.
    """
    path = folder / f"Series_{series}" / SERIES[series]
    joints = load_robot("ur10").joint_names
    columns = [*joints, *MEASURED]
    table = read_published(path, ["Timestamp", *columns], ";")
    values = np.stack([table.numbers(name) for name in columns], axis=1)
    stamps = _stamps(series, table)
    data = Measurements(
        q=values[:, :6],
        position=values[:, 6:9] * 1e-3,
        rotation=Rotation.from_euler("XYZ", values[:, 9:], degrees=True).as_matrix(),
        target=(TARGET,) * len(values),
        sample=tuple(f"{series}{row}" for row in table.rows),
        stamp_ns=stamps,
    )
    return data.take(np.argsort(stamps))


def _stamps(series: str, table: Cells) -> NDArray[np.int64]:
    """Nanoseconds of each row; series A's clock is taken as UTC and its file is not in order."""
    if series in MADE_START:
        start_ns = int(MADE_START[series].timestamp()) * 1_000_000_000
        return start_ns + MADE_STEP_NS * np.arange(len(table.rows), dtype=np.int64)
    stamps = []
    for index, text in enumerate(table.words("Timestamp")):
        try:
            time = datetime.strptime(text, "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        except ValueError:
            table.fail(f"{quoted(text)} is no time such as 20200714163904", index, "Timestamp")
        stamps.append(int(time.timestamp()) * 1_000_000_000)
    return np.array(stamps, dtype=np.int64)


def halves(data: Measurements) -> tuple[Measurements, Measurements]:
    """Split at random (seeded); visits of one pose stay together."""
    held = hold_out(pose_groups(data.q), 0.5, SPLIT_SEED)
    return data.take(~held), data.take(held)


def write_bag(path: Path, data: Measurements, joint_names: tuple[str, ...]) -> None:
    """Write a bag in which the robot stands at each row's joints while it is measured.

    The joints are the targets: the controller's readings are not in the data.
    """
    if data.stamp_ns is None or data.rotation is None:
        raise ValueError("a bag needs stamps and orientations")
    quat = frames.quat_xyzw(data.rotation)
    names = list(joint_names)
    with BagWriter(path) as bag:
        for i, stamp_ns in enumerate(data.stamp_ns.tolist()):
            for offset_ns in AROUND_NS:
                at_ns = stamp_ns + offset_ns
                header = {"stamp": ros_time(at_ns), "frame_id": "base"}
                state = {"header": header, "name": names, "position": data.q[i]}
                bag.write("/joint_states", "sensor_msgs/msg/JointState", state, at_ns)
                if offset_ns == 0:
                    pose = _pose(stamp_ns, data.position[i].tolist(), quat[i].tolist())
                    bag.write("/measured_pose", "geometry_msgs/msg/PoseStamped", pose, at_ns)


def _pose(stamp_ns: int, xyz: list[float], quat: list[float]) -> dict[str, object]:
    return {
        "header": {"stamp": ros_time(stamp_ns), "frame_id": f"{FRAME}/{TARGET}"},
        "pose": {
            "position": dict(zip("xyz", xyz, strict=True)),
            "orientation": dict(zip("xyzw", quat, strict=True)),
        },
    }


def convert_campaign(series: str, folder: Path, out: Path) -> tuple[str, list[Path]]:
    """Write tables and bag of a series; returns how much they hold, in words, and the files.

    Raises `InputError` as `load_campaign`, before anything is written, and when ``out`` cannot be
    written to.
    """
    arm, data = load_robot("ur10"), load_campaign(series, folder)
    train, check = halves(data)
    out.mkdir(parents=True, exist_ok=True)
    tables = {"": data, "_train": train, "_check": check}
    files = [out / f"{series}{part}.csv" for part in tables]
    for path, rows in zip(files, tables.values(), strict=True):
        write_measurements(path, rows, arm)
    bag = out / f"{series}.mcap"
    write_bag(bag, data, arm.joint_names)
    return f"{len(data)} poses ({len(train)} to train, {len(check)} to check)", [*files, bag]
