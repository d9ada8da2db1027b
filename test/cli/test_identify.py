# SPDX-License-Identifier: Apache-2.0
"""``robocal identify`` on tables: figures that hold, refusals that say why, exit status, JSON."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaign import NOISE_M, ROBOT, edited, measured, renamed, table, true_arm, with_rotations
from command import conforms, robocal, robocal_json

from robocal_ros.cli.main import main
from robocal_ros.estimation.assessment import hold_out, pose_groups
from robocal_ros.ground.errors import ConflictError, StaleError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import REFERENCE, THERMAL
from robocal_ros.identification import identify_and_judge
from robocal_ros.kinematics.arm import arm_of, model_document, random_postures
from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.session.events import bring_into_force
from robocal_ros.thermal.proposing import head_without_reference, keep_identified


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tables")


@pytest.fixture(scope="module")
def data(folder: Path) -> Path:
    return table(folder / "data.csv", measured(100))


@pytest.fixture
def identify(capsys: pytest.CaptureFixture[str]):
    """Run the command in this process: exit status and its one document, checked."""

    def run(*arguments: object, robot: str = ROBOT):
        command = ["identify", "--robot", robot, *map(str, arguments), "--json"]
        status = main(command)
        document = json.loads(capsys.readouterr().out)
        conforms(document, "identify.json")
        if status:
            conforms(document, "error.json")
        return status, document

    return run


class TestAnswer:
    def test_held_out_figures_are_those_of_fresh_poses(self, data: Path, identify) -> None:
        """The judged error is what 400 poses that nobody measured see, noise added."""
        status, document = identify("--data", data)
        assert status == 0
        assert document["verdict"] == document["verdict"] | {"accept": True, "code": "ACCEPT"}
        assert document["data"]["train"] + document["data"]["check"] == 100
        assert document["nominal"] == document["in_force"]
        held_out = document["calibrated"]["held_out"]
        assert held_out["n"] == document["data"]["check"] == 50
        fresh = measured(400, 77)
        nominal = load_robot(ROBOT)
        found = [row["value"] for row in document["parameters"].values()]
        chosen = nominal.parameters
        arm = nominal.with_mdh(
            chosen.add(nominal.mdh, np.array(found) / chosen.to_display - chosen.read(nominal.mdh))
        )
        base, ball = document["T_frame_base"], document["T_flange_target"]["ball"]
        error = np.linalg.norm(_predicted(arm, base, ball, fresh.q) - fresh.position, axis=1) * 1e3
        rms = float(np.sqrt(np.mean(error**2)))
        assert held_out["rms_mm"] == pytest.approx(rms, rel=0.2)  # 50 held-out poses: 8 %
        assert document["calibrated"]["predicted"]["total_rms_mm"] == pytest.approx(rms, rel=0.2)
        assert document["noise_mm"] == pytest.approx(NOISE_M * 1e3, rel=0.2)
        assert document["nominal"]["held_out"]["rms_mm"] > 5 * rms

    def test_the_whole_command_and_its_one_document(self, data: Path) -> None:
        document = robocal_json("identify.json", "identify", "--robot", ROBOT, "--data", data)
        assert document["verdict"]["accept"]
        assert (document["rank"], document["unknowns"]) == (27, 33)
        assert len(document["unobservable"]) == 6

    def test_people_read_the_verdict_first(self, data: Path) -> None:
        done = robocal("identify", "--robot", ROBOT, "--data", data)
        assert done.returncode == 0
        first = done.stdout.splitlines()[0]
        assert first.startswith("ACCEPT: held-out mean 0.0")
        assert "at 50 measurements not used to solve" in first
        assert "theta3_deg" in done.stdout
        assert "Not seen in the data, left to the prior" in done.stdout

    def test_errors_over_the_workspace_are_drawn(self, data: Path, folder: Path, identify) -> None:
        asked = ("--data", data, "--model", "geometric")
        _, plain = identify(*asked)
        _, drawn = identify(*asked, "--figures", folder / "drawn")
        assert Path(drawn["figures"]) == folder / "drawn/errors.svg"
        assert (folder / "drawn/errors.svg").read_text().startswith("<svg")
        assert drawn | {"figures": None} == plain

    def test_the_same_seed_gives_the_same_document(self, data: Path, identify) -> None:
        once, again = (identify("--data", data, "--seed", 5)[1] for _ in range(2))
        assert once == again
        _, other = identify("--data", data, "--seed", 6)
        assert other["calibrated"] != once["calibrated"]
        assert once["data"]["seed"] == 5

    def test_share_and_groups(self, folder: Path, identify) -> None:
        """Three visits of each pose stay on one side."""
        one = measured(30, 4)
        q = np.tile(one.q, (3, 1))
        path = table(folder / "visits.csv", measured(90, 4, q=q))
        _, document = identify("--data", path, "--hold-out", "0.3")
        assert document["data"] == document["data"] | {"hold_out": 0.3, "train": 63, "check": 27}

    def test_check_file(self, data: Path, folder: Path, identify) -> None:
        check = table(folder / "check.csv", measured(60, 9))
        status, document = identify("--data", data, "--check", check)
        assert status == 0
        assert document["verdict"]["accept"]
        assert document["calibrated"]["held_out"]["n"] == 60
        assert document["data"]["train"] == 100
        assert document["data"]["hold_out"] is None

    def test_check_in_another_set_up(self, data: Path, folder: Path, identify) -> None:
        """The device moved and another target hangs on the flange."""
        moved = measured(60, 9, place=(-1.0, 0.5, 0.2), targets=("peg",))
        check = table(folder / "moved.csv", moved)
        status, document = identify("--data", data, "--check", check, "--check-refit", "base,tool")
        assert status == 0
        assert document["verdict"]["accept"]
        assert document["calibrated"]["held_out"]["mean_mm"] < 0.12
        status, document = identify("--data", data, "--check", check)
        assert status == 2
        assert "target 'peg' is not in" in document["error"]["message"]
        assert document["error"]["file"] == str(check)
        assert "--check-refit" in document["error"]["message"]

    def test_another_target_is_placed_as_the_message_advises(
        self, data: Path, folder: Path, identify
    ) -> None:
        check = table(folder / "peg.csv", measured(60, 9, targets=("peg",)))
        status, document = identify("--data", data, "--check", check)
        assert status == 2
        assert "--check-refit tool" in document["error"]["message"]
        status, document = identify("--data", data, "--check", check, "--check-refit", "tool")
        assert (status, document["verdict"]["code"]) == (0, "ACCEPT")
        assert document["calibrated"]["held_out"]["mean_mm"] < 0.12

    def test_a_sigma_that_is_too_small_is_told(self, folder: Path, identify) -> None:
        fine = replace(measured(100), sigma=np.full(100, 0.1 * NOISE_M))
        status, document = identify("--data", table(folder / "fine.csv", fine))
        assert (status, document["verdict"]["code"]) == (0, "RESIDUAL_TOO_LARGE")
        assert document["noise_over_sigma"] == pytest.approx(10.0, rel=0.2)
        assert any("sigma_mm" in words for words in document["warnings"])

    def test_a_ball_seen_from_the_flange(self, folder: Path, identify) -> None:
        q = measured(60).q
        seen = np.linalg.inv(true_arm().fk(q)) @ np.array([1.5, 0.4, 0.6, 1.0])
        ball = replace(measured(60, q=q), position=seen[:, :3])
        for sigma in (None, np.full(60, NOISE_M)):
            path = table(folder / "flange.csv", replace(ball, sigma=sigma))
            status, document = identify("--data", path)
            assert status == 2
            assert "the sensor sits on the flange" in document["error"]["message"]

    def test_another_set_up_unsaid_is_no_calibration_error(
        self, data: Path, folder: Path, identify
    ) -> None:
        check = table(folder / "aside.csv", measured(60, 9, place=(-1.0, 0.5, 0.2)))
        status, document = identify("--data", data, "--check", check)
        assert status == 0
        assert document["verdict"]["code"] == "RESIDUAL_TOO_LARGE"
        assert any("--check-refit base,tool" in words for words in document["warnings"])

    @pytest.mark.parametrize("refit", [(), ("--check-refit", "tool")])
    @pytest.mark.parametrize("moved_m", [3e-3, 0.5])
    def test_a_device_that_moved_is_told_with_the_remedy(
        self, data: Path, folder: Path, identify, refit: tuple[str, ...], moved_m: float
    ) -> None:
        """By 3 mm the model is still the better one of two that are off by 3 mm."""
        check = measured(60, 9)
        moved = replace(check, position=check.position + np.array([moved_m, 0.0, 0.0]))
        path = table(folder / "moved.csv", moved)
        status, document = identify("--data", data, "--check", path, *refit)
        told = [words for words in document["warnings"] if "--check-refit base,tool" in words]
        assert (status, len(told)) == (0, 1)
        before = document["calibrated"]["held_out"]["rms_mm"]
        assert f"rms instead of {before:.3g} mm" in told[0]
        _, anew = identify("--data", data, "--check", path, "--check-refit", "base,tool")
        left = anew["calibrated"]["held_out"]["rms_mm"]
        free = 1.0 - 9 / 180  # of the coordinates: six of the base, three of the target
        assert f"by {left / np.sqrt(free):.3g} mm rms instead" in told[0]
        assert not any("--check-refit" in words for words in anew["warnings"])

    def test_where_nothing_moved_none_is_suspected(
        self, data: Path, folder: Path, identify
    ) -> None:
        for count in (6, 60):
            check = table(folder / f"fresh{count}.csv", measured(count, 9))
            _, document = identify("--data", data, "--check", check)
            assert not any("--check-refit" in words for words in document["warnings"])

    def test_a_target_that_would_only_judge_is_named_with_file_and_remedy(
        self, folder: Path, identify
    ) -> None:
        one = measured(60)
        names = list(one.target)
        held = np.flatnonzero(hold_out(pose_groups(one.q), 0.5, 0))
        names[held[0]] = "peg"
        path = table(folder / "peg_once.csv", replace(one, target=tuple(names)))
        status, document = identify("--data", path)
        assert (status, document["error"]["file"]) == (2, str(path))
        assert document["error"]["column"] == "target"
        for words in ("'peg'", "its measurements (1) are all held out", "take another seed"):
            assert words in document["error"]["message"]
        assert identify("--data", path, "--seed", 1)[0] == 0

    def test_several_targets_and_sigma(self, folder: Path, identify) -> None:
        two = measured(120, 3, targets=("ball", "peg"))
        two = replace(two, sigma=np.full(len(two), NOISE_M))
        _, document = identify("--data", table(folder / "two.csv", two))
        assert set(document["T_flange_target"]) == {"ball", "peg"}
        assert document["verdict"]["accept"]
        assert document["noise_mm"] == pytest.approx(NOISE_M * 1e3)

    def test_least_squares_names_what_it_holds(self, data: Path, identify) -> None:
        _, document = identify("--data", data, "--method", "lsq")
        assert document["method"] == "lsq"
        assert len(document["held"]) == 6
        assert all(document["parameters"][name]["sigma"] is None for name in document["held"])
        assert document["verdict"]["accept"]

    def test_without_geometry_nothing_can_be_gained(self, data: Path, identify) -> None:
        status, document = identify("--data", data, "--fit", "base,tool")
        assert status == 0
        assert document["verdict"]["code"] == "NO_SIGNIFICANT_GAIN"
        assert "geometry stays" in document["verdict"]["reason"]
        assert document["calibrated"]["held_out"] == document["nominal"]["held_out"]
        assert all(row["sigma"] is None for row in document["parameters"].values())

    def test_orientations_in_one_file_only(self, data: Path, folder: Path, identify) -> None:
        turned = with_rotations(measured(40, 9), true_arm())
        check = table(folder / "turned.csv", turned)
        status, document = identify("--data", data, "--check", check)
        assert (status, document["verdict"]["code"]) == (0, "ACCEPT")
        assert any("has orientations" in words for words in document["warnings"])
        status, document = identify("--data", check, "--check", data)
        assert (status, document["verdict"]["code"]) == (0, "ACCEPT")

    def test_orientations_of_other_rows_are_refused(self, folder: Path, identify) -> None:
        turned = with_rotations(measured(60, 9), true_arm())
        mixed = replace(turned, rotation=turned.rotation[::-1])
        status, document = identify("--data", table(folder / "mixed.csv", mixed))
        assert status == 2
        assert "measured orientations miss the model by" in document["error"]["message"]

    def test_readings_beyond_the_limits_are_told(self, folder: Path, identify) -> None:
        beyond = measured(60)
        q = beyond.q.copy()
        q[3, 1] = 0.1
        path = table(folder / "beyond.csv", measured(60, q=q))
        _, document = identify("--data", path)
        limits, masses = document["warnings"]
        assert "joint 2 (joint_a2): 1 of 60 readings beyond -140" in limits
        assert "the robot file has no masses of the links, so compliances were sought" in masses
        _, document = identify("--data", path, "--model", "geometric")
        assert document["warnings"] == [limits]


class TestPlan:
    def test_poses_to_measure_are_written(self, folder: Path, identify) -> None:
        """From poses that the robot may be driven to; the table takes what is measured then."""
        source, path = table(folder / "all.csv", measured(120)), folder / "plan.csv"
        status, document = identify("--plan", 30, "--data", source, "--output", path)
        assert (status, document["candidates"], len(document["plan"])) == (0, 120, 30)
        lines = path.read_text().splitlines()
        assert lines[0] == "sample,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"
        written = np.radians([[float(cell) for cell in line.split(",")[1:]] for line in lines[1:]])
        away = np.abs(written[:, None] - measured(120).q).max(axis=2)
        assert away.min(axis=1).max() < 1e-9
        assert np.all(np.diff(document["predicted_mm"]) < 0.0)
        status, again = identify("--plan", 30, "--data", path)
        assert (status, again["candidates"]) == (0, 30)

    def test_without_a_table_poses_are_within_the_limits(self, identify) -> None:
        status, document = identify("--plan", 5, robot="ur10")
        assert (status, len(document["plan"])) == (0, 5)
        assert "collisions" in document["warnings"][0]

    def test_poses_beyond_the_limits_are_none_to_drive_to(self, folder: Path, identify) -> None:
        q = measured(60).q.copy()
        q[3, 1] = 0.1
        source = table(folder / "beyond.csv", measured(60, q=q))
        status, document = identify("--plan", 59, "--data", source)
        assert (status, document["candidates"]) == (0, 59)
        assert "1 poses are beyond the joint limits" in document["warnings"][0]
        status, document = identify("--plan", 60, "--data", source)
        assert (status, document["error"]["code"]) == (3, "TOO_FEW_SAMPLES")

    def test_a_plan_is_for_the_full_model(self, identify) -> None:
        for option in (("--model", "geometric"), ("--fit", "base"), ("--method", "lsq")):
            status, document = identify("--plan", 5, *option)
            assert (status, document["error"]["code"]) == (2, "BAD_INPUT")

    def test_there_is_nothing_to_judge(self, data: Path, identify) -> None:
        for options in (("--check", data), ("--hold-out", "0.5"), ("--seed", 1)):
            status, document = identify("--plan", 5, *options)
            assert (status, document["error"]["code"]) == (2, "BAD_INPUT")
        status, document = identify()
        assert (status, document["error"]["code"]) == (2, "BAD_INPUT")


class TestOutput:
    def test_an_accepted_model_is_a_robot_file(self, data: Path, folder: Path, identify) -> None:
        path = folder / "model.yaml"
        _, document = identify("--data", data, "--output", path)
        assert document["output"] == str(path)
        written = load_description(path)
        nominal = load_description(ROBOT)
        shown = written.arm.parameters.read(written.arm.mdh) * written.arm.parameters.to_display
        values = [row["value"] for row in document["parameters"].values()]
        np.testing.assert_allclose(shown, values, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(written.arm.lower, nominal.arm.lower)
        text = path.read_text()
        assert text.startswith("# Identified by robocal")
        assert "# ACCEPT: held-out mean" in text
        assert nominal.arm.model_hash in text

    def test_a_refused_model_is_not_written(self, folder: Path, identify) -> None:
        nominal = load_robot(ROBOT)
        source = table(folder / "same.csv", measured(60, 2, arm=nominal))
        path = folder / "refused.yaml"
        status, document = identify("--data", source, "--output", path)
        assert status == 0
        assert document["output"] is None
        assert not path.exists()
        assert any("is not written: the verdict is" in words for words in document["warnings"])

    def test_a_kept_model_comes_into_force_by_a_decision(
        self, data: Path, folder: Path, identify
    ) -> None:
        """As a robot file and in the history it is one model; the next is judged against it."""
        state = folder / "state"
        keep = ("--keep", "--robot-serial", "R1", "--state", state)
        path = folder / "kept.yaml"
        status, document = identify("--data", data, "--output", path, *keep)
        assert (status, document["calibration_id"]) == (0, 1)
        nominal = load_robot(ROBOT)
        with CalibrationHistory.open(
            "R1", model_hash=nominal.model_hash, state_dir=state
        ) as history:
            assert history.head().revision == 0
            history.accept(1, by="Ada", reason="", wall_ns=0)
            found = arm_of(history.head().model, nominal)
            assert history.inputs(1)["q"].shape == (document["data"]["train"], 6)
        q = random_postures(nominal, 20)
        np.testing.assert_allclose(found.fk(q), load_robot(str(path)).fk(q), atol=1e-12)
        again = table(folder / "again.csv", measured(60, 9))
        _, document = identify("--data", again, *keep)
        assert document["calibration_id"] == 2
        errors = [document[name]["held_out"]["rms_mm"] for name in ("in_force", "nominal")]
        assert errors[0] < errors[1] / 3

    def test_no_model_is_kept_beside_a_cold_reference(
        self, data: Path, folder: Path, identify
    ) -> None:
        state, nominal = folder / "cold", load_robot(ROBOT)
        with CalibrationHistory.open(
            "R1", model_hash=nominal.model_hash, state_dir=state
        ) as history:
            bring_into_force(history, REFERENCE, nominal, model_document(nominal), "test")
        status, document = identify(
            "--data", data, "--keep", "--robot-serial", "R1", "--state", state
        )
        assert (status, document["error"]["code"]) == (3, "CONFLICT")
        assert "--kind reference --to nominal" in document["error"]["message"]

    def test_what_came_into_force_meanwhile_makes_a_kept_model_stale(self, tmp_path: Path) -> None:
        """It was judged against the model before; and a reference may have been captured."""
        nominal, used = load_robot(ROBOT), measured(60, 9)
        judged = identify_and_judge(nominal, used, measured(40, 8))
        with CalibrationHistory.open(
            "R1", model_hash=nominal.model_hash, state_dir=tmp_path
        ) as history:
            head = head_without_reference(history)
            bring_into_force(history, THERMAL, nominal, model_document(nominal), "test")
            kept = keep_identified(history, judged, used, "map", head.revision, 0)
            assert history.get(kept).state == "stale"
            with pytest.raises(StaleError):
                history.accept(kept, by="Ada", reason="", wall_ns=0)
            again = head_without_reference(history).revision
            kept = keep_identified(history, judged, used, "map", again, 0)
            assert history.get(kept).state == "pending"
            bring_into_force(history, REFERENCE, nominal, model_document(nominal), "test")
            with pytest.raises(ConflictError, match="cold reference is in force"):
                keep_identified(history, judged, used, "map", again, 0)
            assert history.list()[0].kind == REFERENCE

    def test_no_folder_for_it(self, data: Path, folder: Path, identify) -> None:
        status, document = identify("--data", data, "--output", folder / "no" / "m.yaml")
        assert status == 2
        assert document["error"]["file"] == str(folder / "no")


class TestRefusals:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (("--check", "x.csv", "--hold-out", "0.5"), "not allowed with"),
            (("--check-refit", "base,tool"), "give them with --check"),
            (("--check", "x.csv", "--seed", "1"), "--seed chooses what is held out"),
            (("--check", "x.csv", "--check-refit", "geometry"), "only base and tool"),
            (("--fit", "base,wrist"), "'wrist' is not one of base, tool, geometry"),
            (("--fit", "base,base"), "names a part twice"),
            (("--fit", ""), "is not one of"),
            (("--method", "magic"), "invalid choice: 'magic'"),
            (("--hold-out", "1"), "not a share between 0 and 1"),
            (("--hold-out", "nan"), "not a share between 0 and 1"),
            (("--seed", "-1"), "not a whole number from 0"),
            (("--keep",), "give --robot-serial"),
            (("--state", "x"), "for --keep"),
        ],
    )
    def test_options_without_sense(self, data: Path, identify, options, words) -> None:
        status, document = identify("--data", data, *options)
        assert status == 2
        assert document["error"]["code"] == "BAD_INPUT"
        assert words in document["error"]["message"]

    def test_files(self, data: Path, folder: Path, identify) -> None:
        for path, words in (
            (folder / "none.csv", "no such table"),
            (folder, "directory"),
        ):
            status, document = identify("--data", path)
            assert status == 2
            assert words in document["error"]["message"].lower()
            assert document["error"]["file"] == str(path)
        status, document = identify("--data", data, robot="no_such_robot")
        assert status == 2
        assert "ur10" in document["error"]["message"]

    def test_robot_of_another_joint_count(self, data: Path, identify) -> None:
        status, document = identify("--data", data, robot="p1r2p3")
        assert status == 2
        assert document["error"]["row"] == 1
        assert document["error"]["column"].startswith("q")

    def test_bad_cell_is_named(self, data: Path, identify) -> None:
        path = edited(data, "y_mm", lambda cell: "nan" if cell.startswith("-") else cell)
        status, document = identify("--data", path)
        assert status == 2
        assert document["error"]["column"] == "y_mm"
        assert document["error"]["row"] >= 2
        assert document["error"]["file"] == str(path)

    @pytest.mark.parametrize(
        ("spoil", "words"),
        [
            (lambda p: renamed(p, x_mm="x_m", y_mm="y_m", z_mm="z_m"), "1000 times too large"),
            (lambda p: renamed(p, q2_deg="q3_deg", q3_deg="q2_deg"), "joints 2 and 3 are swapped"),
        ],
    )
    def test_mistakes_are_named(self, data: Path, identify, spoil, words) -> None:
        """Two of those of test_mismatch."""
        path = spoil(data)
        status, document = identify("--data", path)
        assert status == 2
        assert document["error"]["code"] == "BAD_INPUT"
        assert words in document["error"]["message"]
        assert document["error"]["file"] == str(path)

    def test_check_data_in_another_unit(self, data: Path, folder: Path, identify) -> None:
        check = renamed(
            table(folder / "metres.csv", measured(50, 8)), x_mm="x_m", y_mm="y_m", z_mm="z_m"
        )
        for refit in ((), ("--check-refit", "base,tool")):
            status, document = identify("--data", data, "--check", check, *refit)
            assert status == 2
            assert "1000 times too large" in document["error"]["message"]
            assert document["error"]["file"] == str(check)

    def test_check_data_that_were_used_to_solve(self, data: Path, folder: Path, identify) -> None:
        both = measured(100).take(np.arange(10))
        status, document = identify("--data", data, "--check", table(folder / "s.csv", both))
        assert status == 2
        assert "10 of 10 measurements are in" in document["error"]["message"]

    def test_the_same_poses_measured_again_are_told(
        self, data: Path, folder: Path, identify
    ) -> None:
        again = measured(100, 12, q=measured(100).q)
        status, document = identify("--data", data, "--check", table(folder / "a.csv", again))
        assert status == 0
        assert any("100 of 100 check measurements are at poses" in w for w in document["warnings"])


class TestTooLittle:
    def test_rows_held_out_are_told_where_too_few_are_left(self, folder: Path, identify) -> None:
        path = table(folder / "few.csv", measured(8))
        status, document = identify("--data", path)
        assert status == 3
        assert f"{path}: 4 samples" in document["error"]["message"]
        assert "4 of its 8 measurements are held out to judge" in document["error"]["message"]

    def test_too_few_poses_to_judge_carry_their_figures(self, folder: Path, identify) -> None:
        path = table(folder / "scarce.csv", measured(16))
        status, document = identify("--data", path, "--hold-out", "0.2")
        assert status == 3
        assert document["error"]["code"] == document["verdict"]["code"] == "TOO_FEW_SAMPLES"
        assert document["calibrated"]["held_out"]["n"] == 3

    def test_all_rows_at_one_pose(self, folder: Path, identify) -> None:
        q = np.tile(measured(1).q, (40, 1))
        path = table(folder / "one.csv", measured(40, q=q))
        status, document = identify("--data", path)
        assert (status, document["error"]["code"]) == (3, "TOO_FEW_SAMPLES")
        assert "1 distinct pose" in document["error"]["message"]
        check = table(folder / "fine.csv", measured(40, 8))
        status, document = identify("--data", path, "--check", check)
        assert (status, document["error"]["code"]) == (3, "RANK_DEFICIENT")


def test_no_table_crashes_it(data: Path, folder: Path, identify) -> None:
    """Sixty spoilt tables: each ends with a verdict; ``identify`` checks status and schema."""
    rng = np.random.default_rng(0)
    both = measured(30, 2, targets=("ball", "peg"))
    source = table(folder / "both.csv", with_rotations(both, true_arm()))
    header, *rows = [line.split(",") for line in source.read_text().splitlines()]
    values = ["1e300", "1e-300", "0", "1e8", "-1e6", "5e-324", "720", "1", "-0"]
    codes = set()
    for number in range(60):
        spoilt = [row.copy() for row in rows]
        for _ in range(rng.integers(1, 4)):
            column = int(rng.integers(2, len(header)))
            first = int(rng.integers(len(rows)))
            for row in spoilt[first : first + 1] if rng.random() < 0.3 else spoilt:
                row[column] = values[number % len(values)]
        few = int(rng.choice([1, 3, 8, 13, 30, 30, 30]))
        path = folder / "spoilt.csv"
        path.write_text("\n".join(",".join(row) for row in [header, *spoilt[:few]]) + "\n")
        fit = ("base,tool,geometry", "geometry", "tool,geometry", "base,tool")[number % 4]
        method = ("map", "lsq")[number % 2]
        status, document = identify("--data", path, "--fit", fit, "--method", method)
        assert status in (0, 2, 3)
        codes.add(document["verdict"]["code"])
    assert {"BAD_INPUT", "TOO_FEW_SAMPLES", "RANK_DEFICIENT"} <= codes


def _predicted(arm, base, ball, q):
    from robocal_ros.ground import frames

    T = frames.transform_from_quat(np.array(base["xyz_mm"]) * 1e-3, np.array(base["quat_xyzw"]))
    point = np.append(np.array(ball["xyz_mm"]) * 1e-3, 1.0)
    return (T @ arm.fk(q) @ point)[:, :3]
