# SPDX-License-Identifier: Apache-2.0
"""Files of a simulated calibration by laser tracker, in the folder `SCAN` and beside it."""

from pathlib import Path

import numpy as np

from bench.hand_eye_files import write_profile, write_tracker_points, write_tracker_target
from bench.laser_tracker import TrackerCell
from robocal_ros.hand_eye.files import write_pose_table
from robocal_ros.hand_eye.tracker_data import TrackerData

SCAN = "scan"


def tracker_files(folder: Path, cell: TrackerCell) -> TrackerData:
    """What was measured, written: scan_poses.csv, tracker.csv, tracker_target.yaml, profiles."""
    data = cell.measure(np.random.default_rng(4))
    (folder / SCAN).mkdir()
    files = [f"{profile.name}.csv" for profile in data.profiles]
    for file, profile in zip(files, data.profiles, strict=True):
        write_profile(folder / SCAN / file, profile.points)
    write_pose_table(
        folder / "scan_poses.csv", data.arm.fk(data.q), files, joints=(data.arm, data.q)
    )
    write_tracker_points(folder / "tracker.csv", data)
    write_tracker_target(folder / "tracker_target.yaml", cell.sizes.target)
    return data
