# SPDX-License-Identifier: Apache-2.0
"""``robocal hand-eye``: sphere, stairs, edge and groove from tables; what is refused, by name."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_eye_command import HEIGHTS, RANGE, chi_square, pose_of, robocal, shots, target
from hand_eye_tables import (
    CELL,
    CENTRE,
    CHECKS,
    RADIUS_M,
    ROBOT_M,
    SHOTS,
    STAIRS,
    T_BASE_USER,
    TRUE,
    hand_eye_tables,
    shots_of,
    target_of,
    write_part,
)
from joint_errors import with_joint_errors
from scipy.stats import chi2

from bench.hand_eye_cell import DOWN, ArmRobot, SimulatedShots, WantedView, sphere_shots, view
from bench.hand_eye_files import write_target
from bench.hand_eye_profiles import with_gears
from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.sensors import ball_on_table
from robocal_ros.cli.main import main
from robocal_ros.ground import frames
from robocal_ros.hand_eye import profiles
from robocal_ros.hand_eye.files import read_flange_mount, read_pose_table, write_pose_table
from robocal_ros.hand_eye.targets import LineTarget
from robocal_ros.kinematics.robots import load_robot, save_robot

FOLDERS = ("sphere", "step", "line", "groove")
JOINT_RAD = 2e-5  # by which joints of a robot like the shipped ones do not repeat: 0.02 mm
FAR_OFF = float(chi2.ppf(0.9999, 6))  # one in ten thousand is farther from the truth


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("hand_eye")
    for kind in FOLDERS:
        hand_eye_tables(root / kind, kind)
    return root


@pytest.fixture(scope="module")
def sphere(made) -> Any:
    """The document of the sphere."""
    return robocal("sphere", *shots(made / "sphere"), "--radius-mm", 20)


def several(folder: Path) -> list[object]:
    """Words of the sphere, the stairs and the edge together."""
    return [word for kind in ("sphere", "step", "line") for word in (f"--{kind}", folder / kind)]


@pytest.fixture(scope="module")
def together(made) -> Any:
    """The document of several targets together, judged by other shots."""
    return robocal("joint", *HEIGHTS, *several(made), "--check", "check.csv")


@pytest.fixture(scope="module")
def checked(made) -> Callable[[str], Any]:
    """The document of one kind, judged by other shots; each is made once."""

    @cache
    def of(kind: str) -> Any:
        folder, (action, words) = made / kind, line_of(kind)
        known = [] if action == "line" else target(folder)
        return robocal(action, *shots(folder), *known, *words, "--check", folder / "check.csv")

    return of


def line_of(kind: str) -> tuple[str, list[str]]:
    return ("line", ["--line-kind", "groove"]) if kind == "groove" else (kind, [])


class TestRecovered:
    @pytest.mark.parametrize("kind", FOLDERS)
    def test_the_truth_lies_within_what_the_covariance_says(self, checked, kind):
        action, found = line_of(kind)[0], checked(kind)
        assert found["verdict"]["accept"]
        assert chi_square(found) < FAR_OFF
        sigma = np.sqrt(np.diag(found["covariance"]))
        assert found["sigma"]["xyz_mm"] == pytest.approx(sigma[:3] * 1e3)
        assert found["sigma"]["rot_deg"] == pytest.approx(np.degrees(sigma[3:]))
        assert found["held_out"]["rejected"] == []
        # Of one edge in ten or so the sensor sees one side only.
        assert len(found["rejected"]) <= (SHOTS // 4 if action == "line" else 0)
        assert all("both of its sides" in why for why in found["rejected_because"].values())
        # three axes of the robot's scatter, the corners' machining and the mount's own error
        expected = np.hypot(np.sqrt(3.0) * ROBOT_M * 1e3, found["working_error_mm"])
        aim = found.get("aim_sigma_mm", 0.0) * np.sqrt(2.0)
        assert found["held_out"]["rms_mm"] < 2.0 * np.hypot(expected, aim)

    def test_the_sphere_and_the_line_that_were_found(self, made, sphere):
        centre_mm = sphere["target"]["center_mm"]
        assert np.linalg.norm(centre_mm - CENTRE * 1e3) < 4.0 * ROBOT_M * 1e3
        document = robocal("line", *shots(made / "line"))
        found, expected_mm = document["target"], document["working_error_mm"]
        assert not found["known"]
        direction = np.array(found["line"]["direction"])
        aside = np.array(found["line"]["point_mm"]) - T_BASE_USER[:3, 3] * 1e3
        along = abs(direction @ T_BASE_USER[:3, 0])
        assert 40.0 * np.arccos(min(along, 1.0)) < 3.0 * expected_mm  # at the ends of what was seen
        assert np.linalg.norm(np.cross(T_BASE_USER[:3, 0], aside)) < 3.0 * expected_mm

    def test_a_radius_and_a_target_file_say_the_same(self, made, sphere):
        assert robocal("sphere", *shots(made / "sphere"), *target(made / "sphere")) == sphere

    @pytest.mark.parametrize("kind", FOLDERS)
    def test_classic_tells_no_covariance_and_is_near(self, made, kind):
        action, more = line_of(kind)
        words = [*shots(made / kind), *target(made / kind), *more, "--method", "classic"]
        found = robocal(action, *words)
        assert (found["covariance"], found["sigma"]) == (None, None)
        away = pose_of(found)[:3, 3] - TRUE[:3, 3]
        assert 0.0 < np.linalg.norm(away) < 1e-2  # a closed form: a start, not a result

    def test_several_targets_together_are_better_than_each(self, together, sphere):
        found = together
        assert chi_square(found) < FAR_OFF
        assert found["working_error_mm"] < sphere["working_error_mm"]
        names = {name.split("/")[0] for name in found["residual_mm"]["per_sample"]}
        assert names == set(found["target"]) == {"sphere", "step", "line"}

    def test_other_shots_judge_several_targets_together(self, made, checked, together, tmp_path):
        found, words = together, ["--sphere", made / "sphere", "--line", tmp_path / "line"]
        shutil.copytree(made / "line", tmp_path / "line")
        assert found["verdict"]["accept"]
        judges = [checked(kind)["held_out"]["n"] for kind in ("sphere", "step", "line")]
        assert found["held_out"]["n"] == sum(judges)
        # 0.31 mm is to be expected: of the robot 0.12 mm in each axis and 0.1 mrad, at 20 of the 28
        # samples, the corners, the aim of 0.2 mm along the edges and its turn. Corners of one shot
        # share all of it: of four shots, each with three axes and an aim that weighs as much as
        # these together, 12 numbers are independent.
        assert found["held_out"]["rms_mm"] < 0.31 * np.sqrt(chi2.ppf(0.999, 12) / 12)
        some = shots_of("line")
        T = some.T_base_flange[SHOTS : SHOTS + CHECKS].copy()
        T[:, 2, 3] += 0.03  # as far as the edge was lowered before these were seen
        write_part(tmp_path / "line", "moved", some, range(SHOTS, SHOTS + CHECKS), T)
        refused = robocal("joint", *HEIGHTS, *words, "--check", "moved.csv")
        assert refused["verdict"]["code"] == "RESIDUAL_TOO_LARGE"
        assert "not used to solve" in refused["verdict"]["reason"]
        assert refused["held_out"]["n"] == CHECKS
        unjudged = robocal("joint", *HEIGHTS, *words)  # whoever judges changes no result
        assert refused["T_flange_sensor"] == unjudged["T_flange_sensor"]
        for name, said in (("poses.csv", "other shots must judge"), ("none.csv", "none of the")):
            failed = robocal("joint", *HEIGHTS, *words, "--check", name, status=2)
            assert said in failed["error"]["message"]

    @pytest.mark.long
    def test_what_tells_the_sensor_is_read_once(self, made, tmp_path, monkeypatch):
        file, read = tmp_path / "sensor.yaml", []
        file.write_text("z_grows: towards\n")
        reads = profiles.read_fields

        def counted(path: Path, what: str) -> Any:
            read.append(path)
            return reads(path, what)

        monkeypatch.setattr(profiles, "read_fields", counted)
        words = ["--sensor", file, *several(made), "--check", "check.csv"]
        assert robocal("joint", *words)["verdict"]["accept"]
        one = ["--poses", made / "line" / "poses.csv", "--profiles", made / "line" / "profiles"]
        robocal("line", "--sensor", file, *one, "--check", made / "line" / "check.csv")
        assert read == [file, file]

    def test_a_line_without_a_target_file_is_unknown_in_joint(self, made, tmp_path):
        shutil.copytree(made / "groove", tmp_path / "groove")
        (tmp_path / "groove" / "target.yaml").unlink()
        both = ["--sphere", made / "sphere", "--line", tmp_path / "groove"]
        found = robocal("joint", *HEIGHTS, *both, "--line-kind", "groove")
        assert not found["target"]["line"]["known"]
        assert chi_square(found) < FAR_OFF

    def test_joints_of_a_robot_instead_of_poses(self, tmp_path):
        arm = load_robot("ur10")
        rng = np.random.default_rng(0)
        true = rigid_robot(arm, 0.0, rng)
        effects = replace(true.effects, noise=True)
        true = replace(true, repeatability=JOINT_RAD, effects=effects)
        some = sphere_shots(replace(CELL, robot=ArmRobot(true, Q_NEAR)), CENTRE, RADIUS_M, 8, rng)
        path = write_part(tmp_path, "poses", some, range(8), joints=(arm, some.q))
        table = np.genfromtxt(path, delimiter=",", dtype=str)
        path.write_text("\n".join(",".join(row) for row in table[:, :-7]) + "\n")
        found = robocal("sphere", *shots(tmp_path), "--radius-mm", 20, "--robot", "ur10")
        assert chi_square(found) < FAR_OFF
        refused = robocal("sphere", *shots(tmp_path), "--radius-mm", 20, status=2)
        assert "name the robot" in refused["error"]["message"]

    def test_joints_that_err_are_said_where_the_joints_are_known(self, made, tmp_path):
        """Of poses within some degrees; not where the robot's file holds what the joints err by."""
        rng = np.random.default_rng(5)
        cell = replace(CELL, robot=with_gears(rng), tilt_rad=0.14, roll_rad=0.14)
        some = sphere_shots(cell, CENTRE, RADIUS_M, 8, rng)
        arm = load_robot("ur10")
        write_part(tmp_path, "poses", some, range(8), joints=(arm, some.q))
        sphere = ("sphere", *shots(tmp_path), "--radius-mm", 20)
        found = robocal(*sphere, "--robot", "ur10")
        factor = found["joint_errors"]["factor"]
        assert factor > 1.2
        assert found["verdict"]["reason"].endswith(
            f"to the mount's sigma: count {factor:.1f} of it"
        )
        silent = robocal(*sphere, "--robot", "ur10", "--joint-error-urad", 0)
        assert silent["joint_errors"] is None
        assert found["covariance"] == silent["covariance"]
        assert found["verdict"]["reason"].startswith(silent["verdict"]["reason"])
        save_robot(with_joint_errors(arm, 1), tmp_path / "full.yaml")
        full = robocal(*sphere, "--robot", tmp_path / "full.yaml")
        assert full["joint_errors"] is None
        assert robocal(*sphere)["joint_errors"] is None  # poses alone
        words = "needs the joints of each pose"
        failed = robocal(*sphere, "--joint-error-urad", 50, status=2)
        assert words in failed["error"]["message"]
        failed = robocal("joint", *HEIGHTS, *several(made), "--joint-error-urad", 50, status=2)
        assert words in failed["error"]["message"]

    def test_people_read_the_verdict_first(self, made, capsys):
        words = ["sphere", *shots(made / "sphere"), "--radius-mm", 20]
        judges = ["--check", made / "sphere" / "check.csv"]
        assert main(["hand-eye", *map(str, [*words, *judges])]) == 0
        printed = capsys.readouterr().out.splitlines()
        assert printed[0].startswith("ACCEPT: ")
        assert any(line.startswith("Sensor in the flange frame, mm: ") for line in printed)
        assert any(line.startswith("Not used to solve, 4 samples") for line in printed)


class TestMistakes:
    """Each is refused, or left out, by code and words."""

    def refused(self, code: str, *words: str, run: tuple[Any, ...]) -> Any:
        status = 2 if code == "BAD_INPUT" else 3
        found = robocal(*run, status=status)
        assert found["error"]["code"] == found["verdict"]["code"] == code
        for word in words:
            assert word in found["error"]["message"]
        return found

    def sphere(self, folder: Path, radius_mm: float = 20.0) -> tuple[Any, ...]:
        return ("sphere", *shots(folder), "--radius-mm", radius_mm)

    def copy(self, made: Path, folder: Path) -> Path:
        return Path(shutil.copytree(made / "sphere", folder / "sphere"))

    def test_one_line_of_corners_from_one_pose(self, made, tmp_path):
        write_part(tmp_path, "poses", shots_of("step", 1), [0])
        run = ("step", *shots(tmp_path), *target(made / "step"))
        found = self.refused("RANK_DEFICIENT", "from several poses", run=run)
        assert found["unobservable"] == ["rotation about the line of the corners"]

    def test_turns_about_one_axis(self, tmp_path):
        cell = replace(CELL, tilt_rad=0.0)
        some = sphere_shots(cell, CENTRE, RADIUS_M, SHOTS, np.random.default_rng(0))
        write_part(tmp_path, "poses", some, range(SHOTS))
        words = ("all poses turn about", "another axis")
        found = self.refused("RANK_DEFICIENT", *words, run=self.sphere(tmp_path))
        assert any("translation along" in words for words in found["unobservable"])

    def test_the_sphere_always_at_the_same_place_of_the_profile(self, tmp_path):
        """At one distance, in the middle: the sensor may turn about the sphere."""
        write_part(tmp_path, "poses", same_place(), range(SHOTS))
        found = robocal(*self.sphere(tmp_path))
        assert found["verdict"]["code"] == "POSES_NOT_INFORMATIVE"
        for words in found["unobservable"]:
            assert words.startswith("rotation about")
            assert "other distances" in words
        assert min(found["sigma"]["rot_deg"]) > 5.0

    def test_two_swapped_pairs_are_left_out_by_name(self, tmp_path):
        some = shots_of("sphere")
        T = some.T_base_flange[:SHOTS].copy()
        T[[2, 7]] = T[[7, 2]]
        write_part(tmp_path, "poses", some, range(SHOTS), T)
        found = robocal(*self.sphere(tmp_path))
        assert set(found["rejected"]) == {"s3", "s8"}
        assert "fits the pose of s8" in found["rejected_because"]["s3"]
        assert chi_square(found) < FAR_OFF

    def test_stairs_from_a_wrong_pose_are_rejected_as_a_shot(self, tmp_path):
        some = shots_of("step")
        T = some.T_base_flange[:SHOTS].copy()
        T[4, 2, 3] += 0.004  # 20 times what the robot errs by
        write_part(tmp_path, "poses", some, range(SHOTS), T)
        write_target(tmp_path / "target.yaml", target_of("step"))
        found = robocal("step", *shots(tmp_path), *target(tmp_path))
        assert found["rejected"] == ["s5"]
        assert found["rejected_because"] == {"s5": "does not fit the others"}
        assert not any(name.startswith("s5/") for name in found["residual_mm"]["per_sample"])

    def test_another_radius_is_named(self, made):
        run = self.sphere(made / "sphere", 21.0)
        found = self.refused("RESIDUAL_TOO_LARGE", "check which sphere", run=run)
        named = float(found["error"]["message"].split("radius ")[1].split(" mm")[0])
        assert named == pytest.approx(20.0, abs=0.2)

    def test_an_empty_profile_stops_no_other(self, made, tmp_path):
        folder = self.copy(made, tmp_path)
        (folder / "profiles" / "s4.csv").write_text("x_mm,z_mm\n")
        found = robocal(*self.sphere(folder))
        assert found["rejected"] == ["s4"]
        assert "profile s4 is empty" in found["rejected_because"]["s4"]
        assert len(found["residual_mm"]["per_sample"]) == SHOTS - 1
        assert chi_square(found) < FAR_OFF

    def test_only_empty_profiles(self, made, tmp_path):
        folder = self.copy(made, tmp_path)
        for file in (folder / "profiles").iterdir():
            file.write_text("x_mm,z_mm\n")
        words = ("0 profiles show the sphere", f"{SHOTS} show none", "empty")
        self.refused("TOO_FEW_SAMPLES", *words, run=self.sphere(folder))

    @pytest.mark.parametrize(("kind", "fewest"), [("sphere", 5), ("line", 5)])
    def test_fewer_shots_than_unknowns(self, made, tmp_path, kind, fewest):
        write_part(tmp_path, "poses", shots_of(kind), range(fewest - 1))
        known = ["--radius-mm", 20] if kind == "sphere" else []
        words = f"{fewest - 1} profiles show the {kind}, at least {fewest} are needed"
        run = (kind, *shots(tmp_path), *known)
        self.refused("TOO_FEW_SAMPLES", words, run=run)

    def test_a_missing_profile(self, made, tmp_path):
        folder = self.copy(made, tmp_path)
        (folder / "profiles" / "s5.csv").unlink()
        found = self.refused("BAD_INPUT", "no file 's5.csv'", run=self.sphere(folder))
        assert (found["error"]["row"], found["error"]["column"]) == (6, "profile")

    def test_judges_that_were_used(self, made):
        folder = made / "sphere"
        run = (*self.sphere(folder), "--check", folder / "poses.csv")
        self.refused("BAD_INPUT", "'s1.csv' is in --poses too", run=run)

    def test_judges_of_a_sphere_that_was_touched_refuse(self, made, tmp_path):
        folder = self.copy(made, tmp_path)
        T = shots_of("sphere").T_base_flange[SHOTS:].copy()
        T[:, 0, 3] += 5e-3
        write_part(folder, "check", shots_of("sphere"), range(SHOTS, SHOTS + len(T)), T)
        found = robocal(*self.sphere(folder), "--check", folder / "check.csv")
        assert found["verdict"]["code"] == "RESIDUAL_TOO_LARGE"
        assert "not used to solve" in found["verdict"]["reason"]
        assert found["held_out"]["rms_mm"] == pytest.approx(5.0, abs=0.5)

    @pytest.mark.parametrize(
        ("action", "more", "words"),
        [
            ("sphere", [], "--radius-mm or --target"),
            ("sphere", ["--radius-mm", 20, "--target", "target.yaml"], "twice"),
            ("step", [], "give --target"),
            ("step", ["--target", "target.yaml"], "describes a sphere, not a step"),
            ("sphere", ["--radius-mm", 20, "--robot-sigma-deg", 1], "--robot-sigma-mm"),
        ],
    )
    def test_options_that_do_not_go_together(self, made, action, more, words):
        folder = made / "sphere"
        more = [folder / word if word == "target.yaml" else word for word in more]
        self.refused("BAD_INPUT", words, run=(action, *shots(folder), *more))

    def test_one_target_is_not_several(self, made):
        run = ("joint", "--sphere", made / "sphere")
        self.refused("BAD_INPUT", "at least two", run=run)


def step(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    """A pose (4, 4) moved by (3,) along its own axes."""
    return T @ frames.transform(np.eye(3), p)


def same_place() -> SimulatedShots:
    """Shots with the sphere always at one place of the profile."""
    rng = np.random.default_rng(4)
    at = [0.0, 0.6 * RADIUS_M, 0.2 + 0.8 * RADIUS_M]

    def wanted():
        while True:
            yield WantedView(
                view(DOWN, np.radians([25.0, 25.0, 60.0]) * rng.uniform(-1, 1, 3), CENTRE, at)
            )

    return CELL.shoot(ball_on_table(CENTRE, RADIUS_M), wanted(), SHOTS, rng)


class TestPlan:
    @pytest.fixture
    def mount(self, tmp_path) -> Path:
        """As drawn: off by 1 mm and 0.5 deg about each axis."""
        path = tmp_path / "mount.yaml"
        T = TRUE @ frames.transform(frames.exp_rotation([9e-3, -9e-3, 9e-3]), [1e-3, -1e-3, 1e-3])
        rpy = np.degrees(frames.rpy(T[:3, :3])).tolist()
        xyz = (T[:3, 3] * 1e3).tolist()
        path.write_text(f"T_flange_sensor: {{xyz_mm: {xyz}, rpy_deg: {rpy}}}\n")
        return path

    def plan(self, kind: str, poses: Path, mount: Path, *more: object) -> list[object]:
        words = ["--target-kind", kind, "--poses", poses, "--mount", mount, *more]
        return ["check-plan", *words, *([] if "--near-mm" in words else RANGE)]

    def centre(self) -> list[object]:
        return ["--radius-mm", 20, "--center-mm", ",".join(str(1e3 * v) for v in CENTRE)]

    def test_a_good_plan_tells_what_comes_of_it(self, made, mount, sphere):
        """The expected error is that of the same poses, solved, where the plan knows the robot.

        There its noise is found from 20 shots of 3 numbers for 9 unknowns: to 10 %, three times
        that is open. The plan's field is the sensor's, the result's what was seen of it, which is
        less: up to half more is expected by the plan.
        """
        known = [
            "--robot-sigma-mm",
            1e3 * ROBOT_M,
            "--robot-sigma-deg",
            np.degrees(CELL.robot.rotation_rad),
        ]
        poses = made / "sphere" / "poses.csv"
        plan = robocal(*self.plan("sphere", poses, mount, *self.centre(), *known))
        assert plan["verdict"]["accept"]
        assert (plan["rank"], plan["unknowns"]) == (9, 9)
        assert (plan["unobservable"], plan["proposed"], plan["unseen"]) == ([], [], {})
        ratio = plan["working_error_mm"] / sphere["working_error_mm"]
        assert 0.7 < ratio < 1.3 * 1.5

    @pytest.mark.parametrize("kind", ["sphere", "step", "line"])
    def test_the_poses_that_it_proposes_will_do(self, made, mount, tmp_path, kind):
        """One pose is too few; with those that are proposed the plan is accepted."""
        known = self.centre() if kind == "sphere" else target(made / kind)
        poses = (made / kind / "poses.csv").read_text().splitlines()[:2]
        one, more = tmp_path / "one.csv", tmp_path / "more.csv"
        one.write_text("\n".join(poses) + "\n")
        run = self.plan(kind, one, mount, *known, "--limit-mm", 0.3, "--propose", more)
        found = robocal(*run)
        assert found["verdict"]["code"] == "TOO_FEW_SAMPLES"
        assert found["rank"] < found["unknowns"]
        assert found["unobservable"]
        proposed = more.read_text().splitlines()
        assert len(proposed) - 1 == len(found["proposed"]) > 0
        header, *rows = poses
        place = [header.split(",").index(name) for name in proposed[0].split(",")]
        merged = [proposed[0], *(",".join(row.split(",")[i] for i in place) for row in rows)]
        one.write_text("\n".join([*merged, *proposed[1:]]) + "\n")
        again = robocal(*self.plan(kind, one, mount, *known, "--limit-mm", 0.3))
        assert again["verdict"]["accept"], again["verdict"]
        # the same poses, but for what lies beyond the 12 digits of the table
        assert again["working_error_mm"] == pytest.approx(found["proposed_error_mm"], rel=1e-6)

    def test_marks_of_proposed_poses(self, made, mount, tmp_path):
        """The light of each lies on the mark that is told, by the place of the stairs."""
        poses = tmp_path / "poses.csv"
        rows = (made / "step" / "poses.csv").read_text().splitlines()
        poses.write_text("\n".join(rows[:2]) + "\n")
        more = tmp_path / "more.csv"
        run = self.plan("step", poses, mount, *target(made / "step"), "--propose", more)
        found = robocal(*run, "--limit-mm", 0.05)
        written = read_pose_table(more, None, None)
        assert list(written.mark) == found["proposed_marks"]
        assert len(written) == len(found["proposed"]) > 1
        for T_base_flange, mark in zip(written.T_base_flange, written.mark, strict=True):
            T = frames.invert(T_base_flange @ read_flange_mount(mount).T_parent_sensor)
            lit = T[:3, :3] @ STAIRS.middle(mark) + T[:3, 3]
            assert abs(lit[1]) < 1e-3

    def test_one_place_of_the_profile_is_not_enough(self, mount, tmp_path):
        poses = write_part(tmp_path, "poses", same_place(), range(SHOTS))
        found = robocal(*self.plan("sphere", poses, mount, *self.centre()))
        assert found["verdict"]["code"] in ("RANK_DEFICIENT", "POSES_NOT_INFORMATIVE")
        assert found["proposed"]

    def test_light_square_to_a_line_shows_three_of_six(self, made, tmp_path):
        """Shifts along the line and turns out of the plane stay open, in poses as they are drawn.

        Rounding must not count as something seen.
        """
        mount = tmp_path / "mount.yaml"
        mount.write_text("T_flange_sensor: {xyz_mm: [0, 0, 100], rpy_deg: [0, 0, 0]}\n")
        T_base_user = frames.transform(np.diag([1.0, -1.0, -1.0]), [0.8, 0.0, 0.03])
        known = tmp_path / "line.yaml"
        write_target(known, LineTarget(T_base_user[:3, 3], T_base_user[:3, 1]))
        at = np.random.default_rng(0).uniform([-0.01, -0.05, 0.29], [0.01, 0.05, 0.31], (10, 3))
        poses = tmp_path / "plan.csv"
        write_pose_table(poses, np.stack([step(T_base_user, -p) for p in at]))
        field = ["--near-mm", 190, "--far-mm", 210]
        found = robocal(*self.plan("line", poses, mount, "--target", known, *field))
        assert (found["rank"], found["unknowns"]) == (3, 6)
        assert len(found["unobservable"]) == 3
        assert found["verdict"]["code"] == "RANK_DEFICIENT"
        assert (found["sigma"], found["working_error_mm"]) == (None, None)

    def test_the_field_is_counted_as_the_sensor_counts(self, made, mount, tmp_path):
        """As hand_eye_node does: distances of one that tells heights are from the middle."""
        poses = write_part(tmp_path, "poses", shots_of("sphere"), range(SHOTS))

        def plan(sensor, near_mm, far_mm, status=0):
            field = ["--near-mm", near_mm, "--far-mm", far_mm, "--sensor", sensor]
            run = self.plan("sphere", poses, mount, *self.centre(), *field)
            return robocal(*run, status=status)

        refused = plan("wenglor", 10, -10, status=2)["error"]["message"]
        assert "from 10 to -10 mm, but its z grows away from it" in refused
        assert plan("keyence", 190, 210) == plan("keyence", 10, -10)

    def test_poses_out_of_range_are_named(self, made, mount, tmp_path):
        some = shots_of("sphere")
        T = some.T_base_flange[:SHOTS].copy()
        T[4, 2, 3] += 0.5
        poses = write_part(tmp_path, "poses", some, range(SHOTS), T)
        found = robocal(*self.plan("sphere", poses, mount, *self.centre()))
        assert list(found["unseen"]) == ["s5"]
        assert "the sensor sees 10 to -10 mm" in found["unseen"]["s5"]

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("T_flange_sensor: {xyz_mm: [1, 2, 3], quat_xyzw: [0, 0, 0, 1.2]}", "length 1.2"),
            ("T_flange_sensor: {xyz_mm: [1, 2, 3]}", "needs an orientation"),
            ("T_flange_sensor: {xyz_mm: [60000, 2, 3], rpy_deg: [0, 0, 0]}", "a thousand times"),
            ("T_base_sensor: {xyz_mm: [1, 2, 3], rpy_deg: [0, 0, 0]}", "beside the robot"),
            ("xyz_mm: [1, 2, 3]", "either T_flange_sensor or T_base_sensor"),
        ],
    )
    def test_a_mount_file_that_is_none(self, made, tmp_path, text, words):
        path = tmp_path / "mount.yaml"
        path.write_text(text)
        run = self.plan("sphere", made / "sphere" / "poses.csv", path, "--radius-mm", 20)
        found = robocal(*run, status=2)
        assert found["error"]["code"] == "BAD_INPUT"
        assert words in found["error"]["message"]

    def test_a_mark_that_the_stairs_do_not_have(self, made, mount, tmp_path):
        poses = tmp_path / "poses.csv"
        poses.write_text((made / "step" / "poses.csv").read_text().replace("far", "left"))
        found = robocal(*self.plan("step", poses, mount, *target(made / "step")), status=2)
        assert "mark 'left' is not one of near, far" in found["error"]["message"]


class TestVerify:
    @pytest.fixture
    def result(self, sphere, tmp_path) -> Path:
        path = tmp_path / "result.json"
        path.write_text(json.dumps(sphere))
        return path

    def run(self, result: Path, kind: str, folder: Path, *more: object) -> list[object]:
        return ["verify", "--result", result, "--target-kind", kind, *shots(folder), *more]

    @pytest.mark.parametrize("kind", FOLDERS)
    def test_a_sphere_s_result_holds_on_every_target(self, made, result, kind):
        more = ["--line-kind", "groove"] if kind == "groove" else target(made / kind)
        found = robocal(*self.run(result, line_of(kind)[0], made / kind, *more))
        assert found["verdict"]["accept"]
        assert found["held_out"]["n"] == len(found["per_sample_mm"])

    @pytest.mark.parametrize("kind", ["sphere", "step", "line"])
    def test_another_mount_is_refused(self, made, result, kind):
        """Turned by 2 deg about the flange: 7 mm at the working distance."""
        document = json.loads(result.read_text())
        T = frames.transform(frames.exp_rotation([0.035, 0.0, 0.0]), np.zeros(3)) @ TRUE
        document["T_flange_sensor"] = {
            "xyz_mm": (T[:3, 3] * 1e3).tolist(),
            "quat_xyzw": frames.quat_xyzw(T).tolist(),
        }
        result.write_text(json.dumps(document))
        found = robocal(*self.run(result, kind, made / kind, *target(made / kind)))
        assert found["verdict"]["code"] == "RESIDUAL_TOO_LARGE"

    def test_a_result_that_is_no_pose_of_the_flange(self, made, result):
        document = json.loads(result.read_text())
        long = {**document["T_flange_sensor"], "quat_xyzw": [0.0, 0.0, 0.0, 1.2]}
        result.write_text(json.dumps(document | {"T_flange_sensor": long}))
        run = self.run(result, "line", made / "line")
        assert "has length 1.2, not 1" in robocal(*run, status=2)["error"]["message"]
        pose = document.pop("T_flange_sensor")
        result.write_text(json.dumps(document | {"T_base_sensor": pose}))
        assert "beside the robot" in robocal(*run, status=2)["error"]["message"]

    @pytest.mark.parametrize("format", ["urdf", "xacro", "yaml", "static-transform"])
    def test_export(self, result, format):
        run = ["export", "--result", result, "--format", format]
        found = robocal(*run, "--child", "scanner")
        assert (found["parent"], found["child"]) == ("tool0", "scanner")
        assert "scanner" in found["text"]
        assert (
            f"{json.loads(result.read_text())['T_flange_sensor']['xyz_mm'][0] * 1e-3:.7f}"
            in (found["text"])
        )

    @pytest.mark.parametrize(
        ("accept", "code"),
        [(False, "POSES_NOT_INFORMATIVE"), (False, "ACCEPT"), (True, "RESIDUAL_TOO_LARGE")],
    )
    def test_only_what_was_accepted_is_exported(self, result, accept, code):
        document = json.loads(result.read_text())
        document["verdict"] = {"accept": accept, "code": code, "reason": "few"}
        result.write_text(json.dumps(document))
        found = robocal("export", "--result", result, "--format", "urdf", status=2)
        assert f"accept {str(accept).lower()} and code {code}" in found["error"]["message"]

    def test_what_people_took_back_is_not_exported(self, result):
        """As ``robocal history show --json`` tells it: the verdict alone accepts it for ever."""
        document = json.loads(result.read_text())
        run = ["export", "--result", result, "--format", "urdf"]
        for state, status in (("in_force", 0), ("rejected", 2), ("rolled_back", 2), ("refused", 2)):
            shown = {"calibration": {"id": 1, "state": state}, "document": document}
            result.write_text(json.dumps(shown))
            found = robocal(*run, status=status)
            if status:
                told = state.replace("_", " ")
                assert f"calibration was {told}: take one" in found["error"]["message"]
