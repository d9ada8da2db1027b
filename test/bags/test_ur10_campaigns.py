# SPDX-License-Identifier: Apache-2.0
"""Real campaigns become tables and bags that say the same."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocal_ros.bags import ur10_campaigns
from robocal_ros.bags.bags import bag_info, read_bag
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements, StandstillRule, joint_sample, pose_sample
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import beyond_limits, read_measurements
from robocal_ros.thermal.observations import ObservationDesk


@pytest.fixture(scope="module")
def campaign(data_dir: Path) -> Measurements:
    return ur10_campaigns.load_campaign("D", data_dir / "ur10_tmac")


@pytest.mark.data
def test_orientations_turn_as_the_arm_turns(data_dir: Path) -> None:
    """The turn from pose to pose does not depend on base or tool: it shows the convention."""
    campaign = ur10_campaigns.load_campaign("C", data_dir / "ur10_tmac")
    arm = load_robot("ur10")
    assert campaign.rotation is not None

    def angles(R: np.ndarray) -> np.ndarray:
        return Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude()

    flange = angles(arm.fk(campaign.q)[:, :3, :3])
    euler = Rotation.from_matrix(campaign.rotation).as_euler("XYZ")
    assert np.median(np.abs(angles(campaign.rotation) - flange)) < np.radians(0.05)
    extrinsic = angles(Rotation.from_euler("xyz", euler).as_matrix())
    assert np.median(np.abs(extrinsic - flange)) > np.radians(0.25)


@pytest.mark.data
def test_table_and_bag_say_the_same(campaign: Measurements, data_dir: Path, tmp_path: Path) -> None:
    words, files = ur10_campaigns.convert_campaign("D", data_dir / "ur10_tmac", tmp_path)
    assert words.startswith("632 poses (")
    assert {path.name for path in files} == {path.name for path in tmp_path.iterdir()}
    arm = load_robot("ur10")
    table = read_measurements(tmp_path / "D.csv", arm)
    assert len(table) == 632
    assert (table.sample[0], table.sample[-1]) == ("D2", "D633")
    assert beyond_limits(table, arm) == ()
    np.testing.assert_allclose(table.q, campaign.q, atol=1e-11)

    topics = {name: topic.messages for name, topic in bag_info(tmp_path / "D.mcap").topics.items()}
    assert topics == {"/joint_states": 5 * 632, "/measured_pose": 632}
    desk = ObservationDesk(arm.joint_names, StandstillRule())
    stamps = []
    for recorded in read_bag(tmp_path / "D.mcap"):
        if recorded.topic == "/joint_states":
            sample = joint_sample(recorded.message)
            stamps.append(sample.stamp_ns)
            desk.add_joints(sample)
        else:
            pose = pose_sample(recorded.message)
            assert (pose.frame, pose.target) == ("tracker", "tmac")
            desk.add_measurement(pose)
    assert np.all(np.diff(stamps) > 0)
    assert not desk.ignored
    observed = desk._observed
    assert [o.sample.stamp_ns for o in observed] == list(table.stamp_ns)
    np.testing.assert_allclose([o.q for o in observed], table.q, atol=1e-11)
    np.testing.assert_allclose([o.sample.position_m for o in observed], table.position, atol=1e-11)
    np.testing.assert_allclose([o.sample.rotation for o in observed], table.rotation, atol=1e-11)


@pytest.mark.long
@pytest.mark.data
@pytest.mark.parametrize(("series", "visits"), [("D", 1), ("B", 2)])
def test_halves_keep_visits_of_a_pose_together(data_dir: Path, series: str, visits: int) -> None:
    data = ur10_campaigns.load_campaign(series, data_dir / "ur10_tmac")
    train, check = ur10_campaigns.halves(data)
    assert abs(len(train) - len(check)) < 0.15 * len(data)
    assert sorted(train.sample + check.sample) == sorted(data.sample)
    distance = np.max(np.abs(train.q[:, None] - check.q[None]), axis=2)
    assert np.min(distance) > 1e-3
    nearest = np.sort(np.max(np.abs(train.q[:, None] - train.q[None]), axis=2), axis=1)[:, 1]
    assert np.mean(nearest < 1e-3) > (0.3 if visits == 2 else 0.0)
    again = ur10_campaigns.halves(data)
    assert again[0].sample == train.sample


@pytest.mark.long
@pytest.mark.data
def test_series_a_is_put_in_order_of_its_clock(data_dir: Path) -> None:
    data = ur10_campaigns.load_campaign("A", data_dir / "ur10_tmac")
    assert data.stamp_ns is not None
    assert len(data) == 11911
    assert np.all(np.diff(data.stamp_ns) >= 3_000_000_000)
    assert data.stamp_ns[0] == 1594744744_000_000_000  # 2020-07-14 16:39:04


@pytest.mark.data
@pytest.mark.parametrize(
    ("wrong", "place", "words"),
    [
        ("no day", ("Timestamp", 3), "'no day' is no time such as 20200714163904"),
        ("1,2,3", ("measurement_x", 2), "'1.2.3' is not a number"),
        (None, ("", 4), "cells, but the header has"),
    ],
)
def test_a_damaged_file_is_told_with_its_place(
    data_dir: Path, tmp_path: Path, wrong: str | None, place: tuple[str, int], words: str
) -> None:
    path = Path("Series_A") / ur10_campaigns.SERIES["A"]
    lines = (data_dir / "ur10_tmac" / path).read_text(encoding="utf-8-sig").splitlines()[:6]
    column, row = place
    cells = lines[row - 1].split(";")
    cells = cells[:9] if wrong is None else cells
    if wrong is not None:
        cells[lines[0].split(";").index(column)] = wrong
    lines[row - 1] = ";".join(cells)
    (tmp_path / "Series_A").mkdir()
    (tmp_path / path).write_text("\n".join(lines))
    with pytest.raises(InputError, match=words) as told:
        ur10_campaigns.convert_campaign("A", tmp_path, tmp_path / "out")
    assert (told.value.file, told.value.row) == (str(tmp_path / path), row)
    assert told.value.column == (column or None)
    assert not (tmp_path / "out").exists()
