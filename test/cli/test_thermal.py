# SPDX-License-Identifier: Apache-2.0
"""``robocal thermal``: from tables to a placed sensor, a drift and a prior."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from command import robocal, robocal_json
from drift_cell import postures
from drift_tables import ROBOT, SIGMA, drifted, fixed_tables, session, visits

from robocal_ros.cell_sim import kr150
from robocal_ros.ground import frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("thermal")
    fixed_tables(folder)
    session(folder / "one.csv", 60, 1)
    session(folder / "two.csv", 60, 2)
    session(folder / "unseen.csv", 40, 3)
    sensor(folder, "--output", folder / "s.yaml")
    return folder


def sensor(folder: Path, *more: object) -> dict:
    words = ["--robot", ROBOT, "--data", folder / "sensor.csv", *more]
    return robocal_json("thermal.sensor.json", "thermal", "calibrate-sensor", *words)


def fixed(folder: Path, *more: object, status: int = 0, **files: str) -> dict:
    named = {"sensor": "s.yaml", "cold": "cold.csv", "warm": "warm.csv"} | files
    words = [word for name, file in named.items() for word in (f"--{name}", folder / file)]
    return robocal_json(
        "thermal.identify.json", "thermal", "identify", "--robot", ROBOT, *words, *more,
        status=status,
    )  # fmt: skip


@pytest.mark.parametrize("method", ["ml", "classic"])
def test_a_sensor_is_placed_to_the_arms_static_error(folder, method):
    document = sensor(folder, "--method", method)
    assert document["verdict"]["accept"]
    where = np.array(document["T_sensor_base"]["xyz_mm"]) * 1e-3
    assert np.linalg.norm(where - kr150.T_SENSOR_BASE[:3, 3]) < 5e-3
    assert np.linalg.norm(np.array(document["sphere_in_flange_mm"]) * 1e-3 - kr150.BALL) < 2e-3
    assert (document["covariance"] is None) == (method == "classic")


def test_the_sensor_file_holds_what_was_found(folder):
    kept = yaml.safe_load((folder / "s.yaml").read_text())
    found = sensor(folder)
    assert kept["T_sensor_base"]["xyz_mm"] == found["T_sensor_base"]["xyz_mm"]
    assert set(kept) == {
        "T_sensor_base",
        "sphere_in_flange_mm",
        "covariance",
        "robot",
        "model_hash",
    }


def test_a_drift_is_found_and_judged_at_unseen_poses(folder):
    document = fixed(folder, "--check", folder / "check.csv")
    assert document["verdict"]["code"] == "ACCEPT"
    assert [one["cycle"] for one in document["cycles"]] == ["early", "late"]
    assert document["calibrated"]["held_out"]["n"] == 14
    before, after = document["nominal"]["held_out"], document["calibrated"]["held_out"]
    assert after["rms_mm"] < 0.5 * before["rms_mm"]
    assert after["rms_mm"] < 2.0 * document["calibrated"]["predicted"]["total_rms_mm"]
    assert len(document["parameters"]) == 24


def test_without_check_each_pose_is_judged_by_the_others(folder):
    document = fixed(folder)
    assert document["calibrated"]["held_out"]["n"] == 6


@pytest.mark.parametrize("named", [True, False])
def test_check_visits_judge_the_cycle_that_they_name_else_the_last(folder, named):
    """Also where its name is a number; a cycle without check visits is judged by its own poses."""
    q, cycles = postures(20), {"1": drifted(1.0), "2": drifted(2.0)}
    visits(folder / "numbered.csv", cycles, {f"p{i}": q[i] for i in range(6)}, 7)
    own, unseen = "1" if named else "2", {f"c{i}": q[i] for i in range(6, 20)}
    check = visits(folder / f"check_{own}.csv", {own: cycles[own]}, unseen, 8)
    if not named:
        rows = [line.split(",") for line in check.read_text().splitlines()]
        check.write_text("".join(",".join([pose, *rest]) + "\n" for pose, _, *rest in rows))
    document = fixed(folder, "--check", check, warm="numbered.csv")
    judges = {one["cycle"]: one["calibrated"]["held_out"]["n"] for one in document["cycles"]}
    assert judges == ({"1": 14, "2": 6} if named else {"1": 6, "2": 14})


def test_a_subset_holds_the_rest(folder):
    document = fixed(folder, "--method", "subset", "--parameters", "a1_mm,a2_mm,d4_mm,beta2_deg")
    solved = [name for name, row in document["parameters"].items() if row["sigma"] is not None]
    assert solved == ["a1_mm", "beta2_deg", "a2_mm", "d4_mm"]
    assert document["method"] == "subset"
    assert len(document["held"]) == 20


def test_a_learned_prior_is_taken(folder):
    """Where a dozen small drifts were seen, less is expected; the forecast stays honest."""
    words = ["--robot", ROBOT, "--sensor", folder / "s.yaml", "--cold", folder / "cold.csv"]
    words += ["--warm", folder / "history.csv", "--output", folder / "prior.yaml"]
    learned = robocal_json("thermal.prior.json", "thermal", "learn-prior", *words)
    assert learned["cycles"] == 12
    check = ["--check", folder / "check.csv"]
    default = fixed(folder, *check)["calibrated"]["predicted"]
    prior = fixed(folder, *check, "--prior", folder / "prior.yaml")["calibrated"]
    assert prior["predicted"]["model_rms_mm"] < default["model_rms_mm"]
    assert prior["held_out"]["rms_mm"] < 2.0 * prior["predicted"]["total_rms_mm"]


def flange(folder: Path, *more: object, status: int = 0) -> dict:
    words = ["--robot", ROBOT, "--arrangement", "flange-sensor", *more]
    return robocal_json("thermal.identify.json", "thermal", "identify", *words, status=status)


def test_a_measuring_robot_is_judged_on_an_unseen_session(folder):
    data = ["--data", folder / "one.csv", "--data", folder / "two.csv"]
    document = flange(folder, *data, "--check", folder / "unseen.csv")
    assert document["verdict"]["accept"], document["verdict"]
    assert set(document["spheres"]) == {"a@1", "b@1", "a@2", "b@2"}
    X = frames.transform_from_quat(
        np.array(document["T_flange_sensor"]["xyz_mm"]) * 1e-3,
        document["T_flange_sensor"]["quat_xyzw"],
    )
    assert np.linalg.norm(X[:3, 3] - [0.08, -0.05, 0.22]) < 3e-3
    # Noise of a distance from a mean of 20: sqrt(3) sigma, times what the model adds.
    assert document["calibrated"]["held_out"]["rms_mm"] < 2.0 * np.sqrt(3.0) * SIGMA * 1e3


def edited(path: Path, old: str, new: str) -> Path:
    copy = path.with_name(f"edited-{path.name}")
    text = path.read_text()
    assert old in text
    copy.write_text(text.replace(old, new))
    return copy


BAD = [
    ({"sensor": "cold.csv"}, [], 2, "BAD_INPUT", "keys and values"),
    ({"cold": "none.csv"}, [], 2, "BAD_INPUT", "no such table"),
    ({"warm": "check.csv"}, ["--check", "warm.csv"], 0, "", ""),
    ({}, ["--check", "warm.csv"], 2, "BAD_INPUT", "in the warm table too"),
    ({}, ["--check", "judges.csv"], 2, "BAD_INPUT", "cycle '0' is not in the warm table"),
    ({}, ["--data", "one.csv"], 2, "BAD_INPUT", "flange-sensor"),
    ({}, ["--method", "subset"], 2, "BAD_INPUT", "belong together"),
    ({}, ["--method", "subset", "--parameters", "d9_mm"], 2, "BAD_INPUT", "d9_mm"),
    ({}, ["--sigma-mm", "0"], 2, "BAD_INPUT", "above 0"),
]


@pytest.mark.parametrize(("files", "more", "status", "code", "words"), BAD)
def test_what_makes_no_sense_is_refused(folder, files, more, status, code, words):
    placed = [folder / word if word.endswith(".csv") else word for word in more]
    document = fixed(folder, *placed, status=status, **files)
    if status:
        assert document["error"]["code"] == code
        assert words in document["error"]["message"]


def test_a_pose_that_was_not_cold_is_named(folder):
    other = edited(folder / "warm.csv", "p3,early", "p99,early")
    error = fixed(folder, warm=other.name, status=2)["error"]
    assert "pose 'p99' was not visited cold" in error["message"]
    assert (error["file"], error["column"]) == (str(other), "pose")


def test_a_sensor_of_another_robot_is_refused(folder):
    other = folder / "other.yaml"
    kept = yaml.safe_load((folder / "s.yaml").read_text()) | {"model_hash": "0" * 16}
    other.write_text(yaml.safe_dump(kept))
    assert fixed(folder, sensor=other.name, status=2)["error"]["code"] == "WRONG_ROBOT"


def test_a_sensor_file_of_another_placement_is_refused(folder):
    """The sensor stands turned by 15 deg since: cold and warm would agree, the drift turned too."""
    kept = yaml.safe_load((folder / "s.yaml").read_text())
    pose = kept["T_sensor_base"]
    turn = frames.transform(frames.exp_rotation([0.0, 0.0, np.radians(15.0)]), np.zeros(3))
    moved = frames.transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"]) @ turn
    kept["T_sensor_base"] = frames.transform_document(moved)
    (folder / "turned.yaml").write_text(yaml.safe_dump(kept))
    error = fixed(folder, "--check", folder / "check.csv", sensor="turned.yaml", status=3)["error"]
    assert error["code"] == "RESIDUAL_TOO_LARGE"
    assert str(folder / "turned.yaml") in error["message"]
    assert "calibrate the sensor anew" in error["message"]


def test_people_get_the_verdict_first(folder):
    words = ["--robot", ROBOT, "--sensor", folder / "s.yaml", "--cold", folder / "cold.csv"]
    done = robocal("thermal", "identify", *words, "--warm", folder / "warm.csv")
    assert done.returncode == 0
    assert done.stdout.startswith("ACCEPT: held-out mean")


def test_screening_reports_every_round_and_draws_them(folder):
    words = ["--robot", ROBOT, "--sensor", folder / "s.yaml", "--cold", folder / "cold.csv"]
    words += ["--warm", folder / "shift.csv", "--check", folder / "judges.csv"]
    words += ["--wanted", 4, "--best-subset", "--plot", folder / "rounds.png"]
    document = robocal_json("thermal.screen.json", "thermal", "screen", *words)
    assert [row["parameters"] for row in document["rounds"]] == list(range(24, 3, -1))
    assert len(document["chosen"]) == len(document["best_subset"]["names"]) == 4
    best = max(row["share"] for row in document["rounds"] if row["share"] is not None)
    assert best > document["uncompensated"]
    assert (folder / "rounds.png").read_bytes().startswith(b"\x89PNG")


def test_screening_by_ljung_box(folder):
    """The tests differ in which series they call stationary on this shift, and it is told."""
    words = ["--robot", ROBOT, "--sensor", folder / "s.yaml", "--cold", folder / "cold.csv"]
    words += ["--warm", folder / "shift.csv", "--check", folder / "judges.csv", "--wanted", 20]
    found = {}
    for test in ("autocorrelation", "ljung-box"):
        more = [*words, "--stationarity", test]
        document = robocal_json("thermal.screen.json", "thermal", "screen", *more)
        assert document["stationarity"] == test
        found[test] = [row["stationary"] for row in document["rounds"]]
    assert found["autocorrelation"] != found["ljung-box"]


def test_planned_poses_beat_random_and_own_ones(folder):
    words = ["--robot", ROBOT, "--sensor", folder / "s.yaml", "--own", folder / "warm.csv"]
    words += ["--working", folder / "check.csv", "--output", folder / "planned.csv"]
    document = robocal_json("thermal.plan.json", "thermal", "plan-poses", *words)
    assert len(document["poses"]) == 6
    assert document["predicted_mm"] < document["random_mm"] < document["before_mm"]
    assert document["gain"] > 0.0
    rows = (folder / "planned.csv").read_text().splitlines()
    assert rows[0] == "pose,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"
    assert len(rows) == 7
    again = robocal_json("thermal.plan.json", "thermal", "plan-poses", *words)
    assert again["poses"] == document["poses"]
