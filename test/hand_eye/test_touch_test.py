# SPDX-License-Identifier: Apache-2.0
"""Marked points scanned and touched: accuracy, stability, and against how many shots."""

import json
from pathlib import Path

import numpy as np
import pytest
from command import robocal, robocal_json
from scipy.stats import chi2

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.files import ScannedPoints, SensorMount
from robocal_ros.hand_eye.touch_test import touch_test

TRUE = frames.transform(frames.exp_rotation([2.5, -0.3, 0.4]), [0.04, -0.06, 0.11])
POINTS = {"a": np.array([0.6, 0.1, 0.2]), "b": np.array([0.7, -0.2, 0.25])}
SIGMA_M = 5e-5  # of a scan along each axis of the base
LIMIT_M = 1e-3


def scans(each: int, seed: int = 1, sigma_m: float = SIGMA_M) -> ScannedPoints:
    """Points seen in the laser plane from poses all about them."""
    rng = np.random.default_rng(seed)
    names, T, seen = [], [], []
    for name, point in POINTS.items():
        for _ in range(each):
            x, z = rng.uniform([-0.01, 0.19], [0.01, 0.21])
            R = frames.exp_rotation(rng.uniform(-0.4, 0.4, 3)) @ np.diag([1.0, -1.0, -1.0])
            t = point + sigma_m * rng.standard_normal(3) - R @ [x, 0.0, z]
            T.append(frames.transform(R, t) @ frames.invert(TRUE))
            names.append(name)
            seen.append([x, z])
    return ScannedPoints(tuple(names), np.array(seen), np.array(T))


def judged(T: np.ndarray, data: ScannedPoints, touched=POINTS):
    return touch_test(SensorMount("flange", T), data, touched, LIMIT_M)


def test_a_right_mount_shows_the_scatter_of_a_scan():
    """Within what chi-square allows in one case in a thousand, of 2 x 200 scans of three axes."""
    found = judged(TRUE, scans(200))
    assert found.verdict.code is Code.ACCEPT
    ratio = np.mean(found.distance_m**2) / (3.0 * SIGMA_M**2)
    low, high = chi2.ppf([0.0005, 0.9995], 1200) / 1200
    assert low < ratio < high
    # The worst of three axes of two points: each within its own chi-square.
    worst = np.sqrt(chi2.ppf(0.9995, 199) / 199)
    assert 3.0 * SIGMA_M * 0.9 < found.stability_m < 3.0 * SIGMA_M * worst
    assert found.count == (200, 200)


def test_a_turned_mount_is_off_by_the_lever():
    """Turned by 0.01 rad about the flange's x: by lever times angle at each scan, exactly."""
    turn = frames.transform(frames.exp_rotation([0.01, 0.0, 0.0]), np.zeros(3))
    data = scans(5, sigma_m=0.0)
    found = judged(turn @ TRUE, data)
    p = np.column_stack([data.points[:, 0], np.zeros(10), data.points[:, 1]])
    p_flange = frames.apply(TRUE, p)
    lever = np.hypot(p_flange[:, 1], p_flange[:, 2])
    assert found.distance_m == pytest.approx(2.0 * np.sin(0.005) * lever, rel=1e-9)
    assert found.verdict.code is Code.RESIDUAL_TOO_LARGE
    assert found.stability_m > 1e-3  # it turns with the flange: one point seems to wander


def test_what_all_scans_share_shows_only_where_a_point_was_touched():
    """The flange never turns: steady, wherever on it the sensor sits."""
    data = scans(1, sigma_m=0.0)
    names = tuple(np.repeat(data.point, 3))
    seen, T = data.points.repeat(3, 0), data.T_base_flange.repeat(3, 0)
    step = 0.01 * np.tile(np.arange(3.0), 2)  # along the sensor's x
    seen[:, 0] -= step
    T[:, :3, 3] += step[:, None] * (T @ TRUE)[:, :3, 0]
    moved = ScannedPoints(names, seen, T)
    elsewhere = frames.transform(TRUE[:3, :3], TRUE[:3, 3] + [0.0, 0.05, 0.0])
    alone, against = judged(elsewhere, moved, {}), judged(elsewhere, moved)
    assert alone.verdict.code is Code.ACCEPT
    assert "no point was touched" in alone.verdict.reason
    assert against.verdict.code is Code.RESIDUAL_TOO_LARGE


def at_one_pose(data, rng, count):
    """What is scanned again and again by a robot that stands: its readings tremble by 1 um."""
    rows = np.repeat(np.arange(len(data.point)), count)
    T = data.T_base_flange[rows]
    T[:, :3, 3] += 1e-6 * rng.standard_normal((len(rows), 3))
    seen = data.points[rows] + 1e-5 * rng.standard_normal((len(rows), 2))
    return ScannedPoints(tuple(data.point[i] for i in rows), seen, T)


def test_scans_from_one_pose_tell_no_steadiness():
    """Twelve of each point, or twelve from the first of two poses: any mount would pass."""
    rng = np.random.default_rng(3)
    wrong = np.eye(4)
    for poses in (1, 2):
        found = judged(wrong, at_one_pose(scans(poses, sigma_m=0.0), rng, 12), {})
        assert found.verdict.code is Code.TOO_FEW_SAMPLES
        assert "none scanned from 3 poses" in found.verdict.reason
        assert (found.stability_m, found.count) == (None, (12 * poses, 12 * poses))
    assert judged(wrong, at_one_pose(scans(3), rng, 12), {}).verdict.code is Code.RESIDUAL_TOO_LARGE


def test_scanning_often_from_one_pose_makes_no_mount_steadier():
    data, rng = scans(3), np.random.default_rng(4)
    often = at_one_pose(data, rng, 1)
    first = [data.point.index(name) for name in POINTS for _ in range(50)]
    again = ScannedPoints(
        (*often.point, *(data.point[i] for i in first)),
        np.concatenate([often.points, data.points[first]]),
        np.concatenate([often.T_base_flange, data.T_base_flange[first]]),
    )
    turned = frames.transform(frames.exp_rotation([0.01, 0.0, 0.0]), np.zeros(3)) @ TRUE
    once, many = judged(turned, often, {}), judged(turned, again, {})
    assert many.stability_m == pytest.approx(once.stability_m, rel=0.05)


def test_too_little_to_say_anything():
    one = scans(1)
    found = judged(TRUE, one, {})
    assert found.verdict.code is Code.TOO_FEW_SAMPLES
    assert found.stability_m is None
    with pytest.raises(InputError, match="'c' was touched but not scanned"):
        judged(TRUE, one, {"c": np.zeros(3)})


@pytest.fixture
def tables(tmp_path) -> Path:
    data = scans(5)
    quat = frames.quat_xyzw(data.T_base_flange)
    rows = ["point,sensor_x_mm,sensor_z_mm,x_mm,y_mm,z_mm,qx,qy,qz,qw"]
    for name, seen, T, q in zip(data.point, data.points, data.T_base_flange, quat, strict=True):
        numbers = [*(1e3 * seen), *(1e3 * T[:3, 3]), *q]
        rows.append(",".join([name, *(f"{x:.9f}" for x in numbers)]))
    (tmp_path / "scans.csv").write_text("\n".join(rows) + "\n")
    lines = ["point,x_mm,y_mm,z_mm"]
    lines += [",".join([name, *(f"{1e3 * x:.6f}" for x in p)]) for name, p in POINTS.items()]
    (tmp_path / "touched.csv").write_text("\n".join(lines) + "\n")
    for shots, turn in ((5, 2e-3), (15, 0.0)):
        T = frames.transform(frames.exp_rotation([turn, 0.0, 0.0]), np.zeros(3)) @ TRUE
        per = {f"shot_{i}": 0.01 for i in range(shots)}
        made = {"T_flange_sensor": transform_document(T), "residual_mm": {"per_sample": per}}
        (tmp_path / f"of_{shots}.json").write_text(json.dumps(made))
    return tmp_path


@pytest.mark.long
def test_results_of_few_and_of_many_shots_side_by_side(tables):
    document = robocal_json(
        "hand-eye.verify.json", "hand-eye", "verify", "--target-kind", "point",
        "--result", tables / "of_5.json", "--result", tables / "of_15.json",
        "--poses", tables / "scans.csv", "--touched", tables / "touched.csv",
    )  # fmt: skip
    few, many = document["results"]
    assert (few["shots"], many["shots"]) == (5, 15)
    assert few["accuracy_mm"]["mean_mm"] > 3.0 * many["accuracy_mm"]["mean_mm"]
    assert many["accuracy_mm"]["n"] == 10
    assert many["three_sigma_mm"] < 3.0 * 1e3 * SIGMA_M * np.sqrt(chi2.ppf(0.9999, 4) / 4)
    # Its own verdict: both pass or not, and which is the best.
    passed = [row["verdict"]["accept"] for row in document["results"]]
    assert document["verdict"]["accept"] == all(passed)
    assert f"{sum(passed)} of 2 pass" in document["verdict"]["reason"]
    assert f"best is {tables / 'of_15.json'}" in document["verdict"]["reason"]


def test_one_that_fails_among_several_decides(tables):
    """Turned by 2 mrad at 0.2 m: 0.4 mm, above a limit of 0.2; the other is within it."""
    document = robocal_json(
        "hand-eye.verify.json", "hand-eye", "verify", "--target-kind", "point",
        "--result", tables / "of_5.json", "--result", tables / "of_15.json",
        "--poses", tables / "scans.csv", "--touched", tables / "touched.csv",
        "--limit-mm", "0.2",
    )  # fmt: skip
    few, many = document["results"]
    assert many["verdict"]["accept"]
    assert document["verdict"]["code"] == few["verdict"]["code"] == "RESIDUAL_TOO_LARGE"
    assert f"not {tables / 'of_5.json'}" in document["verdict"]["reason"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--target-kind", "point"], "needs --poses"),
        (
            ["--target-kind", "sphere", "--radius-mm", "20", "--touched", "t.csv"],
            "target-kind point",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(tables, more, words):
    done = robocal("hand-eye", "verify", "--result", tables / "of_5.json", *more)
    assert done.returncode == 2
    assert words in done.stderr
