# SPDX-License-Identifier: Apache-2.0
"""Data files of a hand-eye calibration: the same bits come back, and anyone can read them."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader

from robocal_ros.bags.bags import PROFILE, read_bag, read_data_set, write_data_set
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.samples import cloud_points
from robocal_ros.kinematics.robots import load_robot

ARM = load_robot("ur10")
STAMP = 1_700_000_000_000_000_000


def data_set(columns: int = 2, points: int = 40) -> dict:
    rng = np.random.default_rng(3)
    return {
        "target": {"kind": "sphere" if columns == 2 else "camera", "radius_m": 0.02},
        "method": "best",
        "mount": "in-hand",
        "samples": [
            {
                "handle": handle,
                "mark": "near",
                "stamp_ns": STAMP + handle * 1_234_567_891,
                "q": rng.uniform(-3.0, 3.0, ARM.n).tolist(),
                "values": rng.uniform(-0.1, 0.2, (points, columns)).tolist(),
            }
            for handle in (2, 3, 7)
        ],
    }


@pytest.mark.parametrize(
    ("topic", "columns", "points"), [(PROFILE, 2, 40), ("target_pose", 7, 1), ("image", 2, 55)]
)
def test_a_data_set_comes_back_to_the_last_bit(tmp_path, topic, columns, points):
    path, document = tmp_path / "set.mcap", data_set(columns, points)
    write_data_set(path, document, topic, "laser", ARM)
    found = read_data_set(path, ARM)
    assert json.dumps({name: found[name] for name in document}) == json.dumps(document)
    assert [p.name for p in tmp_path.iterdir()] == ["set.mcap"]


def test_the_file_is_indexed_and_holds_common_messages(tmp_path):
    path, document = tmp_path / "set.mcap", data_set()
    write_data_set(path, document, PROFILE, "laser", ARM)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary.chunk_indexes
        assert summary.statistics.message_count == 7
    profiles = [m for m in read_bag(path) if m.topic == PROFILE]
    for recorded, row in zip(profiles, document["samples"], strict=True):
        assert recorded.msgtype == "sensor_msgs/msg/PointCloud2"
        assert recorded.message.header.frame_id == "laser"
        assert recorded.log_time_ns == row["stamp_ns"]
        points = cloud_points(recorded.message)
        assert np.array_equal(points[:, [0, 2]], row["values"])
        assert not np.any(points[:, 1])


def test_what_is_no_data_set_of_this_robot_is_refused(tmp_path):
    path = tmp_path / "set.mcap"
    write_data_set(path, data_set(), PROFILE, "laser", ARM)
    with pytest.raises(InputError, match="there already"):
        write_data_set(path, data_set(), PROFILE, "laser", ARM)
    with pytest.raises(InputError, match=f"cannot be written: no folder {tmp_path / 'none'}"):
        write_data_set(tmp_path / "none" / "set.mcap", data_set(), PROFILE, "laser", ARM)
    with pytest.raises(WrongRobotError, match="made with robot 'UR10'"):
        read_data_set(path, load_robot("kr150_r3100"))
    with pytest.raises(InputError):
        read_data_set(tmp_path / "nothing.mcap", ARM)
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(InputError):
        read_data_set(tmp_path / "text.mcap", ARM)


@pytest.mark.parametrize("share", [0.4, 0.7, 0.95])
def test_a_file_that_was_cut_off_is_told_as_that(tmp_path, share):
    whole, cut = tmp_path / "set.mcap", tmp_path / "cut.mcap"
    write_data_set(whole, data_set(points=400), PROFILE, "laser", ARM)
    cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    with pytest.raises(InputError, match="broke off"):
        read_data_set(cut, ARM)
