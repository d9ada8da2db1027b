# SPDX-License-Identifier: Apache-2.0
"""Sphere, stairs, edge and groove from profiles: recovered, or refused with what is wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hand_eye_sets import (
    CELL,
    CENTRE,
    FAR_OFF,
    LINE,
    POSE_RAD,
    RADIUS_M,
    SPHERE,
    STAIRS,
    T_BASE_USER,
    chi_square,
    data_of,
    line_task,
    sphere_task,
    stairs_target,
    step_task,
)
from long_form import amount, more

from bench.hand_eye_cell import (
    HandEyeCell,
    PoseRobot,
    SimulatedShots,
    TrueStairs,
    edge_block,
    edge_shots,
    groove_shots,
    sphere_shots,
    step_shots,
)
from robocal_ros.cell_sim.sensors import ProfileSensor, Scene, ball_on_table, table
from robocal_ros.estimation import estimation
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.hand_eye import solve as solving
from robocal_ros.hand_eye.mount_fit import LARGEST_POSE_M, distances, first_look, fit_mount
from robocal_ros.hand_eye.mount_problem import in_plane
from robocal_ros.hand_eye.result import HandEyeSettings, apart, at_origin, expected_error_m
from robocal_ros.hand_eye.solve import (
    features,
    field_of,
    held_out,
    look,
    looked,
    solve_joint,
    solve_task,
    verify,
)
from robocal_ros.hand_eye.stairs import nine_unknowns, task_of
from robocal_ros.hand_eye.targets import SphereTarget
from robocal_ros.hand_eye.tasks import HandEyeData

SETTINGS = HandEyeSettings()
TRUE = CELL.T_flange_sensor
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def sphere_data(seed=0, count=15, cell=CELL):
    return data_of(sphere_shots(cell, CENTRE, RADIUS_M, count, np.random.default_rng(seed)))


def solve(data):
    return solve_task(sphere_task(), data, "best", SETTINGS)


def solve_step(data, target=None):
    return solve_task(step_task(target), data, "best", SETTINGS)


@pytest.fixture(scope="module")
def data():
    return sphere_data()


@pytest.fixture(scope="module")
def result(data):
    return solve(data)


@pytest.fixture(scope="module")
def few():
    """As many as tell a mistake, and show the sensor's linearity."""
    return sphere_data(count=8)


class TestSphere:
    def test_recovers_the_sensor_and_the_sphere(self, result):
        assert result.verdict.accept
        assert chi_square(result, TRUE) < FAR_OFF
        assert np.linalg.norm(result.place - CENTRE) < 5e-4  # the robot is off by 0.1 mm

    def test_sides_of_the_laser_plane_need_not_be_told(self):
        rng = np.random.default_rng(1)
        shots = sphere_shots(CELL, CENTRE, RADIUS_M, 12, rng, signs=(-1,))
        assert chi_square(solve(data_of(shots)), TRUE) < FAR_OFF

    def test_best_beats_classic(self):
        """In translation at least twice, over five data sets (rms); over many see the bench."""
        off = []
        for seed in range(amount(5, 10)):
            data = sphere_data(seed, cell=HandEyeCell(robot=PoseRobot(1e-4)))
            task = sphere_task()
            view = features(task, data).view
            best = fit_mount((view,), look(task, view)[0]).state
            states = best, task.classic(view, best)
            off.append([np.linalg.norm((X.T_flange_sensor - TRUE)[:3, 3]) for X in states])
        best_m, classic_m = np.sqrt(np.mean(np.square(off), axis=0))
        assert classic_m > 2.0 * best_m

    def test_shots_from_one_pose_are_not_measurements_of_their_own(self):
        """What the robot errs by, most of the error here, is the same in all of them."""
        rng = np.random.default_rng(7)
        shots = sphere_shots(CELL, CENTRE, RADIUS_M, 8, rng)
        again, scene = np.repeat(np.arange(8), 5), ball_on_table(CENTRE, RADIUS_M)
        profiles = [
            CELL.sensor.shoot(shots.true_T_base_flange[i] @ CELL.T_flange_light, scene, rng)
            for i in again
        ]
        jitter = frames.transform(np.eye(3), 1e-5 * rng.standard_normal((len(again), 3)))
        T_base_flange = shots.T_base_flange[again] @ jitter  # readings at standstill
        marks = [""] * len(again)
        many = solve(data_of(replace(
            shots, T_base_flange=T_base_flange, profiles=profiles, marks=marks
        )))  # fmt: skip
        assert chi_square(many, TRUE) < FAR_OFF
        once = solve(data_of(shots))
        assert many.working_error_m > 0.5 * once.working_error_m

    def test_left_out_samples_are_off_more_than_those_used(self, result):
        assert np.all(result.leave_one_out_m > 0.99 * result.residual_m)

    def test_a_dirty_scene_changes_nothing(self):
        sensor = ProfileSensor(spikes=0.03, dropouts=0.05, gaps=3, ghosts=0.02)
        rough = sphere_data(2, cell=replace(CELL, sensor=sensor))
        assert chi_square(solve(rough), TRUE) < FAR_OFF

    def test_a_moved_robot_sees_the_same_sensor(self, data, result):
        T = frames.transform(frames.exp_rotation([0.3, -0.5, 1.2]), [0.7, -2.0, 0.4])
        moved = solve(replace(data, T_base_flange=T @ data.T_base_flange))
        error = moved.T_flange_sensor - result.T_flange_sensor
        sigma = np.sqrt(np.diag(at_origin(result.covariance, result.pivot))[:3].max())
        assert np.linalg.norm(error[:3, 3]) < 0.02 * sigma

    def test_held_out_shots_of_the_same_sphere(self, result):
        other = held_out(sphere_task(), sphere_data(9, 10), result.T_flange_sensor, result.place)
        there = np.array([[0.0, 0.0, 0.2]]) - result.pivot
        mount_m = expected_error_m(result.covariance, there)
        largest = mount_m + 1e-4 + 1e-4  # of the mount, the robot, the circle
        assert np.sqrt(np.mean(other.distance_m**2)) < 2.0 * largest


class TestMistakes:
    """Each is named, by code and words."""

    def refused(self, data, *words, error=ResidualError, target=SPHERE):
        with pytest.raises(error) as caught:
            solve_task(sphere_task(target), data, "best", SETTINGS)
        for word in words:
            assert word in str(caught.value), str(caught.value)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda T: np.roll(T, 1, axis=0), ("shifted by one",)),
            (frames.invert, ("inverted",)),
            (lambda T: _negated(T, 1), ("y of their positions", "left-handed")),
            (lambda T: _in_unit(T, 1e-3), ("1000 times larger",)),
            *more(
                (lambda T: np.roll(T, -1, axis=0), ("shifted by one",)),
                (lambda T: _in_unit(T, 1e3), ("smaller",)),
            ),
        ],
    )
    def test_poses(self, few, change, words):
        self.refused(replace(few, T_base_flange=change(few.T_base_flange)), *words)

    def test_no_rotation_at_all(self):
        cell = replace(CELL, tilt_rad=0.0, roll_rad=0.0)
        self.refused(sphere_data(5, 15, cell), "translation", "turn the flange about two axes",
                     error=RankDeficientError)  # fmt: skip

    def test_a_weak_direction_is_told_with_its_sigma_and_what_would_show_it(self):
        """Poses that tilt by 0.3 deg: millimetres along the beam, and all else is known."""
        data = sphere_data(5, 15, replace(CELL, tilt_rad=float(np.radians(0.3))))
        found = solve(data)
        assert found.verdict.code is Code.POSES_NOT_INFORMATIVE
        (words,) = found.unobservable
        assert "tilt the flange about another axis" in words
        sigma_mm = float(re.search(r"known to ([\d.]+) mm", words).group(1))
        assert sigma_mm > 3.0
        assert found.working_error_m * 1e3 == pytest.approx(sigma_mm, rel=0.5)
        assert chi_square(found, TRUE) < FAR_OFF
        assert found.leave_one_out_m is not None


class OnTable(HandEyeCell):
    """What stands, stands on a table that is seen."""

    def shoot(self, scene, *more):
        return super().shoot(Scene((*scene.bodies, table(T_BASE_USER[:3, 3]))), *more)


class TestStep:
    def shots(self, seed, count=5, **more):
        return data_of(step_shots(CELL, STAIRS, count, np.random.default_rng(seed), **more))

    @pytest.mark.parametrize("aim_m", [2e-4, *more(0.0)])
    def test_recovers_the_sensor(self, aim_m):
        for seed in range(
            amount(1, 2)
        ):  # that errors are as the covariance says: test_hand_eye_mount
            found = solve_step(self.shots(seed, 8, aim_m=aim_m))
            assert found.verdict.accept
            assert chi_square(found, TRUE) < FAR_OFF

    def test_an_error_of_the_taught_frame_is_in_the_covariance(self):
        rng = np.random.default_rng(8)
        taught = T_BASE_USER @ frames.transform(
            frames.exp_rotation(1e-3 * rng.standard_normal(3)), 2e-4 * rng.standard_normal(3)
        )
        known = stairs_target(taught, user_sigma_m=2e-4, user_sigma_rad=1e-3)
        shots = self.shots(8, 8)
        found, exact = solve_step(shots, known), solve_step(shots)
        assert chi_square(found, TRUE) < FAR_OFF
        assert np.trace(found.covariance[:3, :3]) > 2.0 * np.trace(exact.covariance[:3, :3])

    def test_of_a_calm_robot_light_is_laid_on_marks_by_eye_all_the_same(self):
        known = stairs_target(user_sigma_m=2e-4, user_sigma_rad=1e-3)
        calm = replace(CELL, robot=PoseRobot(2e-5, 2e-5))
        data = data_of(step_shots(calm, STAIRS, 10, np.random.default_rng(8)))
        found = verify(step_task(known), data, TRUE, HandEyeSettings(2e-5, 2e-5))
        assert not found.rejected

    def test_classic_has_nine_unknowns_and_a_right_handed_frame(self):
        """Exact corners give the sensor; r2 = r3 x r1 of such that are off is no mirror image."""
        rng = np.random.default_rng(12)
        value = np.column_stack([rng.uniform(-0.03, 0.03, (9, 2)), np.zeros(9)])
        there = frames.apply(TRUE, in_plane(value))
        assert nine_unknowns(value, there) == pytest.approx(TRUE, abs=1e-12)
        off = nine_unknowns(value, there + 1e-3 * rng.standard_normal((9, 3)))
        assert np.linalg.det(off[:3, :3]) == pytest.approx(1.0)
        with pytest.raises(RankDeficientError, match="one line"):
            nine_unknowns(value * [1.0, 0.0, 0.0], there)

    def test_a_left_handed_target_file(self):
        drawn = stairs_target()
        mirror = np.array([-1.0, 1.0, 1.0])
        corners = {mark: mirror * places for mark, places in drawn.corners.items()}
        with pytest.raises(ResidualError, match="left-handed"):
            solve_step(self.shots(3, 8), replace(drawn, corners=corners))

    @pytest.mark.parametrize("corners", ["convex", *more("both")])
    def test_stairs_on_a_table_show_as_many_inner_edges_and_are_not_laid_along_these(self, corners):
        """Else the sensor is told a step away, with all shots in use and a tenth of that told."""
        low = TrueStairs(T_BASE_USER, steps=3)
        target = stairs_target(stairs=low, corners=corners)
        for seed in range(3, 3 + amount(1, 5)):
            rng = np.random.default_rng([31, seed])
            shots = data_of(step_shots(OnTable(), low, 8, rng, level=corners != "convex"))
            assert chi_square(solve_step(shots, target), TRUE) < FAR_OFF

    @pytest.mark.parametrize("convex", [None, np.array([False, False])])
    def test_corners_that_lie_alike_in_two_places_are_not_laid_by_chance(self, convex):
        """Inner edges of equal steps: the foot at the table looks as they do."""
        low = TrueStairs(T_BASE_USER, steps=3)
        target = stairs_target(stairs=low, corners="concave", convex=convex)
        for seed in range(amount(1, 5)):
            rng = np.random.default_rng([32, seed])
            shots = data_of(step_shots(OnTable(), low, 8, rng, level=True))
            with pytest.raises(ResidualError, match="all 2 corners of the target alone, in one"):
                solve_step(shots, target)

    def test_an_unknown_mark(self):
        data = replace(self.shots(2), marks=("middle",) * 5)
        with pytest.raises(InputError, match=r"'middle' is not one of near, far"):
            solve_step(data)


class TestLine:
    @pytest.mark.parametrize("known", [True, False])
    @pytest.mark.parametrize(("kind", "shoot"), [("edge", edge_shots), ("groove", groove_shots)])
    def test_recovers_the_sensor(self, kind, shoot, known):
        shots = data_of(shoot(CELL, T_BASE_USER, 20, np.random.default_rng(3)))
        found = solve_task(line_task(LINE if known else None, kind), shots, "best", SETTINGS)
        assert chi_square(found, TRUE) < FAR_OFF
        seen_at = (T_BASE_USER @ [0.1, 0.0, 0.0, 1.0])[:3]  # the middle of what is shown
        away = seen_at - found.place[0]
        across = away - (away @ found.place[1]) * found.place[1]
        sigma = expected_error_m(found.covariance, np.array([[0.0, 0.0, 0.2]]) - found.pivot)
        assert np.linalg.norm(across) < 4.0 * sigma + 1e-4  # and what the robot repeats to

    @pytest.mark.parametrize("known", [True, False])
    def test_starts_that_are_given_up_lead_to_no_better_place(self, known):
        """Nor to another that is nearly as good: each start followed to its end."""
        task = line_task(LINE if known else None)
        for seed in range(amount(1, 10)):
            shots = data_of(edge_shots(CELL, T_BASE_USER, 12, np.random.default_rng([4, seed])))
            view = features(task, shots).view
            squares = []
            for start in task.starts(view):
                end = first_look((view,), start)
                squares.append((float(np.sum(distances((view,), end) ** 2)), end))
            least, best = min(squares, key=lambda pair: pair[0])
            near, doubt = look(task, view)
            seen = in_plane(view.sightings.value)
            rms_m = np.sqrt(least / len(seen))
            nearer, best = (first_look((view,), end) for end in (near, best))  # looks end unsettled
            assert apart(nearer.T_flange_sensor, best.T_flange_sensor, seen) < 0.01 * rms_m
            places = [apart(end.T_flange_sensor, best.T_flange_sensor, seen)
                      for far, end in squares if far < 1.1 * least]  # fmt: skip
            assert max(places) < LARGEST_POSE_M
            assert not doubt

    @pytest.mark.parametrize(
        ("most_deg", "words"),
        [
            (0.0, "turn the flange about two axes"),
            (
                25.0,
                r"turn about \(.+\) of .*tilt the flange about another axis",
            ),
        ],
    )
    def test_no_rotation_but_about_the_line_is_refused(self, most_deg, words):
        rng = np.random.default_rng(4)
        cell = replace(CELL, tilt_rad=0.0, roll_rad=0.0)
        straight = edge_shots(cell, T_BASE_USER, 20, rng).true_T_base_flange
        about = np.radians(most_deg) * rng.uniform(-1.0, 1.0, (20, 1)) * [1.0, 0.0, 0.0]
        turn = T_BASE_USER @ frames.transform(frames.exp_rotation(about), np.zeros(3))
        stands = [CELL.robot.stand(T, rng) for T in turn @ frames.invert(T_BASE_USER) @ straight]
        scene = Scene((edge_block(T_BASE_USER),))
        light = [stand.true_T_base_flange @ CELL.T_flange_light for stand in stands]
        profiles = [CELL.sensor.shoot(T_base_light, scene, rng) for T_base_light in light]
        reported = np.array([stand.T_base_flange for stand in stands])
        turns = frames.log_rotation(reported[:, :3, :3] @ reported[0, :3, :3].T)
        # But for what the robot errs by: 60 numbers, two poses each, at five sigma.
        aside = np.cross(turns, T_BASE_USER[:3, 0])
        assert np.allclose(aside, 0.0, atol=5.0 * np.sqrt(2.0) * POSE_RAD)
        extent_deg = np.degrees(np.ptp(turns @ T_BASE_USER[:3, 0]))
        assert most_deg <= extent_deg <= 2.0 * most_deg + np.degrees(10.0 * POSE_RAD)
        data = data_of(SimulatedShots(reported, reported, profiles, [""] * 20, None))
        with pytest.raises(RankDeficientError, match=words):
            solve_task(line_task(LINE), data, "best", SETTINGS)


@pytest.mark.parametrize("share", [1.02, *more(0.98, 1.2)])
def test_targets_together_find_a_wrong_radius(share):
    rng = np.random.default_rng(5)
    ball = data_of(sphere_shots(CELL, CENTRE, RADIUS_M, 12, rng))
    edge = data_of(edge_shots(CELL, T_BASE_USER, 12, rng))
    parts = [(sphere_task(SphereTarget(share * RADIUS_M)), ball), (line_task(), edge)]
    with pytest.raises(RobocalError, match="radius"):
        solve_joint(parts, SETTINGS)


def test_profiles_that_show_nothing_are_not_said_to_contradict(data):
    """Six of fifteen are too many to lose, and eight to judge: underexposed, not off."""

    def dark(count):
        empty = TooFewSamplesError("profile has 0 points")
        return replace(data, profiles=[*data.profiles[:-count], *[empty] * count])

    found = solve(dark(6)).verdict
    assert found.code is Code.RESIDUAL_TOO_LARGE
    assert found.reason == "6 of 15 samples show nothing or do not fit: see the rejected ones"
    found = verify(sphere_task(), dark(8), TRUE, SETTINGS).verdict
    assert found.code is Code.RESIDUAL_TOO_LARGE
    assert found.reason.endswith(", but 8 show nothing or do not fit")


def test_a_place_that_was_not_reached_blames_no_mount(result, monkeypatch):
    edge = data_of(edge_shots(CELL, T_BASE_USER, 12, np.random.default_rng(6)))
    monkeypatch.setattr("robocal_ros.estimation.estimation.MOST_ITERATIONS", 1)
    with pytest.raises(RankDeficientError, match="still crept"):
        verify(line_task(), edge, result.T_flange_sensor, SETTINGS)


def test_a_classic_line_that_creeps_is_a_weak_answer(monkeypatch):
    """It stops after one step: as far off as it then is from the best estimate, it says."""
    edge = data_of(edge_shots(CELL, T_BASE_USER, 12, np.random.default_rng(6)))
    best = solve_task(line_task(), edge, "best", SETTINGS)

    def stopped(*given, **named):
        with monkeypatch.context() as patch:
            patch.setattr("robocal_ros.estimation.estimation.MOST_ITERATIONS", 1)
            return estimation.solve(*given, **named)

    monkeypatch.setattr("robocal_ros.hand_eye.tasks.solve", stopped)
    found = solve_task(line_task(), edge, "classic", SETTINGS)
    away_m = apart(found.T_flange_sensor, best.T_flange_sensor, field_of(edge))
    assert 0.0 < away_m <= found.working_error_m
    assert found.verdict.accept == (found.working_error_m <= SETTINGS.limit_m)


class TestStepMistakes:
    """Which corner is which depends on the poses: mistakes in them are found all the same."""

    @pytest.fixture
    def shots(self):
        return data_of(step_shots(CELL, STAIRS, 8, np.random.default_rng(11)))

    @pytest.mark.parametrize(
        ("words", "undo"),
        [
            ("mirrored as a whole: .* left-handed", lambda T: MIRROR @ T @ MIRROR),
            ("read as w, x, y, z", lambda T: _read_as_xyzw(T)),
            *more(
                ("shifted by one", lambda T: np.roll(T, 1, axis=0)),
                ("inverted", frames.invert),
                ("y of their positions negated", lambda T: _negated(T, 1)),
            ),
        ],
    )
    def test_poses(self, shots, words, undo):
        wrong = replace(shots, T_base_flange=undo(shots.T_base_flange))
        with pytest.raises(ResidualError, match=words):
            solve_step(wrong)

    def test_marks_exchanged(self, shots):
        other = tuple({"near": "far", "far": "near"}[mark] for mark in shots.marks)
        with pytest.raises(ResidualError, match="near and far exchanged"):
            solve_step(replace(shots, marks=other))

    def test_two_shots_swapped(self, shots):
        T = shots.T_base_flange.copy()
        T[[1, 3]] = T[[3, 1]]  # of one mark
        found = solve_step(replace(shots, T_base_flange=T))
        assert {name.partition("/")[0] for name in found.rejected} == {"p2", "p4"}
        assert all("swapped" in words for words in found.rejected.values())


@pytest.mark.parametrize("kind", ["line", *more("sphere", "step")])
def test_a_sensor_that_counts_distances_is_found_in_its_own_coordinates(kind):
    """0.2 m less the height: its frame is where the light leaves."""
    rng = np.random.default_rng(41)
    shots, target = {
        "sphere": lambda: (sphere_shots(CELL, CENTRE, RADIUS_M, 15, rng), SPHERE),
        "step": lambda: (step_shots(CELL, STAIRS, 8, rng), stairs_target()),
        "line": lambda: (edge_shots(CELL, T_BASE_USER, 20, rng), LINE),
    }[kind]()
    distances = [np.column_stack([p[:, 0], 0.2 - p[:, 1]]) for p in shots.profiles]
    data = data_of(replace(shots, profiles=distances))
    result = solve_task(task_of(target, "edge"), data, "best", SETTINGS)
    assert result.verdict.accept
    assert chi_square(result, CELL.T_flange_light) < FAR_OFF


def _negated(T, axis):
    wrong = T.copy()
    wrong[:, axis, 3] *= -1.0
    return wrong


def _in_unit(T, factor):
    return frames.transform(T[:, :3, :3], factor * T[:, :3, 3])


def _read_as_xyzw(T):
    """Poses whose quaternions were written w, x, y, z and read x, y, z, w."""
    return frames.transform_from_quat(T[:, :3, 3], np.roll(frames.quat_xyzw(T), 1, axis=1))


def test_a_sphere_that_was_knocked_is_not_the_poses_fault():
    rng = np.random.default_rng(12)
    before = sphere_shots(CELL, CENTRE, RADIUS_M, 8, rng)
    after = sphere_shots(CELL, CENTRE + np.array([5e-3, 0.0, 0.0]), RADIUS_M, 7, rng)
    first, second = data_of(before), data_of(after)
    both = HandEyeData(
        tuple(f"p{i}" for i in range(15)),
        np.concatenate([first.T_base_flange, second.T_base_flange]),
        [*first.profiles, *second.profiles],
    )
    with pytest.raises(ResidualError, match="has the target moved"):
        solve(both)


def test_one_of_two_tilted_shots_of_taught_stairs_places_no_sensor():
    """Its corners lie on one line: nothing is told of each without itself."""
    taught = stairs_target(user_sigma_m=1e-4, user_sigma_rad=1e-3)
    shots = data_of(step_shots(CELL, STAIRS, 2, np.random.default_rng(13)))
    found = solve_step(shots, taught)
    assert found.verdict.code is Code.TOO_FEW_SAMPLES
    assert found.leave_one_out_m is None


def test_two_poses_cannot_tell_the_robots_noise():
    shots = data_of(step_shots(CELL, STAIRS, 2, np.random.default_rng(13), level=True))
    found = solve_step(shots)
    assert found.verdict.code is Code.TOO_FEW_SAMPLES
    assert "to tell the robot's noise" in found.verdict.reason
    assert "show the target from more poses" in found.verdict.reason  # more shots tell no more
    assert solve_task(step_task(), shots, "classic", SETTINGS).verdict == found.verdict


def test_a_closed_form_is_refused_where_the_best_estimate_that_judges_it_is():
    """Three profiles of a known line are six numbers for six unknowns: they fit whatever erred."""
    few = data_of(edge_shots(CELL, T_BASE_USER, 3, np.random.default_rng(1)))
    best, classic = (solve_task(line_task(LINE), few, way, SETTINGS) for way in ("best", "classic"))
    assert best.verdict.code is Code.TOO_FEW_SAMPLES
    assert classic.verdict == best.verdict


def test_a_doubt_of_the_best_estimate_is_one_of_the_closed_form(data, monkeypatch):
    monkeypatch.setattr(solving, "looked", lambda *given: (looked(*given)[0], "another place fits"))
    for method in ("best", "classic"):
        verdict = solve_task(sphere_task(), data, method, HandEyeSettings(limit_m=1.0)).verdict
        assert (verdict.code, verdict.reason) == (Code.POSES_NOT_INFORMATIVE, "another place fits")
