# SPDX-License-Identifier: Apache-2.0
"""Planned poses: judged before the robot moves, and mended; where they look for a sphere."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hand_eye_sets import (
    CELL,
    CENTRE,
    POSE_M,
    POSE_RAD,
    RADIUS_M,
    STAIRS,
    T_BASE_USER,
    data_of,
    sphere_task,
    stairs_target,
    step_task,
)
from long_form import more
from scipy.optimize import minimize

from bench.hand_eye_cell import (
    PoseRobot,
    SimulatedShots,
    TrueStairs,
    edge_shots,
    sphere_shots,
    step_shots,
)
from robocal_ros.cell_sim.sensors import ball_on_table
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.planning import (
    BEHIND,
    OFF_EQUATOR,
    PlannedLine,
    PlannedSphere,
    PlannedStairs,
    check_plan,
    looked_at,
)
from robocal_ros.hand_eye.profiles import SensorRange
from robocal_ros.hand_eye.result import (
    HandEyeSettings,
    PoseNoise,
    apart,
    at_origin,
    expected_error_m,
)
from robocal_ros.hand_eye.solve import solve_task
from robocal_ros.hand_eye.targets import Staircase

SENSOR = SensorRange(near_m=0.01, far_m=-0.01, width_m=0.09, noise_m=CELL.sensor.noise_m)
NOISE = PoseNoise(POSE_M, POSE_RAD, 2e-4)
LIMIT_M = 6e-4


def sphere_poses(count, cell=CELL, seed=0):
    return sphere_shots(
        cell, CENTRE, RADIUS_M, count, np.random.default_rng(seed)
    ).true_T_base_flange


def judged(target, poses, limit_m=LIMIT_M):
    return check_plan(target, poses, CELL.T_flange_sensor, NOISE, limit_m)


BALL = PlannedSphere(RADIUS_M, SENSOR, tuple(CENTRE))
PLANNED = {
    "sphere": (BALL, lambda: sphere_poses(5)),
    "line": (
        PlannedLine(SENSOR, np.stack([T_BASE_USER[:3, 3], T_BASE_USER[:3, 0]])),
        lambda: edge_shots(CELL, T_BASE_USER, 5, np.random.default_rng(1)).true_T_base_flange,
    ),
    "step": (
        PlannedStairs(stairs_target(), SENSOR, ("near", "far")),
        lambda: (
            step_shots(CELL, STAIRS, 2, np.random.default_rng(2), level=True).true_T_base_flange
        ),
    ),
}


def test_expected_error_is_that_of_a_calibration_from_these_poses():
    """The information of a plan against the covariance that profiles from it give."""
    shots = sphere_shots(CELL, CENTRE, RADIUS_M, 15, np.random.default_rng(3))
    settings = HandEyeSettings(POSE_M, POSE_RAD)
    result = solve_task(sphere_task(), data_of(shots), "best", settings)
    plan = judged(BALL, shots.true_T_base_flange)
    assert plan.rank == plan.unknowns == 9
    achieved = np.sqrt(np.diag(at_origin(result.covariance, result.pivot)))
    assert plan.sigma == pytest.approx(achieved, rel=0.1)  # the robot's error rules, not the arc


def test_light_is_laid_on_marks_by_eye():
    """Along the edges, nearly the laser plane's normal, it is what a calm robot's shots err by."""
    calm = PoseRobot(2e-5, 2e-5)
    rng = np.random.default_rng(5)
    shots = step_shots(replace(CELL, robot=calm), STAIRS, 16, rng)
    settings = HandEyeSettings(calm.position_m, calm.rotation_rad)
    result = solve_task(step_task(), data_of(shots), "best", settings)
    stairs, X = PlannedStairs(stairs_target(), SENSOR, ("near", "far")), CELL.T_flange_sensor
    plan = check_plan(stairs, shots.true_T_base_flange, X, settings.noise(), LIMIT_M)
    achieved = np.sqrt(np.diag(at_origin(result.covariance, result.pivot)))
    # How well the eye aims is found from 16 shots, two numbers each: to an eighth.
    assert plan.sigma[1] == pytest.approx(achieved[1], rel=0.4)


@pytest.mark.parametrize("strays", [0, 2])
@pytest.mark.parametrize("seed", [0, *more(1, 2, 3, 4)])
def test_a_sphere_of_unknown_place_is_where_the_poses_see_it(seed, strays):
    """Poses that saw it when they were shot see it in the plan, whatever side they pass it on."""
    rng = np.random.default_rng(100 + seed)
    shots = sphere_shots(CELL, CENTRE, RADIUS_M, 12, rng)
    rough = CELL.T_flange_sensor.copy()
    rough[:3, 3] += rng.normal(0.0, 1e-3, 3)
    poses = shots.true_T_base_flange.copy()
    poses[12 - strays :, :3, 3] += 0.3  # those look elsewhere
    plan = check_plan(PlannedSphere(RADIUS_M, SENSOR), poses, rough, NOISE, LIMIT_M)
    assert sorted(plan.unseen) == list(range(12 - strays, 12))
    if not strays:  # against what is achieved, at the same points of the field
        settings = HandEyeSettings(POSE_M, POSE_RAD)
        result = solve_task(sphere_task(), data_of(shots), "best", settings)
        covariance = at_origin(result.covariance, result.pivot)
        achieved_m = expected_error_m(covariance, SENSOR.field_points)
        # The place is found to 3 mm, and how well a circle tells it grows with the 11 mm or so by
        # which the laser planes pass the centre.
        assert abs(np.log(plan.working_error_m / achieved_m)) < 3.0 / 11.0


@pytest.mark.parametrize("kind", PLANNED)
def test_proposed_poses_mend_a_poor_plan(kind):
    target, poses = PLANNED[kind]
    plan = judged(target, poses(), 1.5e-4)
    assert not plan.verdict.accept
    assert plan.proposed_error_m < 1.5e-4
    every = np.concatenate([poses(), plan.proposed])
    mended = judged(target, every, 1.5e-4)
    assert mended.verdict.accept
    # The target is where it was, so the same information is added in another order.
    assert mended.working_error_m == pytest.approx(plan.proposed_error_m, rel=1e-6)


def test_marks_with_one_corner_each():
    """Only the first step is known: a pose that sees its corner sees all there is."""
    stairs = TrueStairs(T_BASE_USER, steps=2)
    drawn = Staircase(1, stairs.length_m, stairs.height_m, stairs.depth_m)
    target = drawn.target(T_BASE_USER)
    poses = step_shots(CELL, stairs, 6, np.random.default_rng(2)).true_T_base_flange
    poses[1, :3, 3] += [0.0, 0.0, 0.1]
    plan = judged(PlannedStairs(target, SENSOR, ("near", "far")), poses, 1e-4)
    assert list(plan.unseen) == [1]
    assert len(plan.proposed) >= 1
    assert plan.proposed_error_m < plan.working_error_m


def test_corners_out_of_view_tell_nothing():
    """Of five in a row, 14.1 mm apart and 5 mm aside at most, the field holds the middle three."""
    narrow = replace(SENSOR, width_m=2.0 * 0.021)
    poses = step_shots(CELL, STAIRS, 8, np.random.default_rng(4), level=True).true_T_base_flange
    whole = stairs_target()
    three_each = {mark: rows[1:4] for mark, rows in whole.corners.items()}
    middle = replace(whole, corners=three_each, convex=None)
    noise = PoseNoise(POSE_M, POSE_RAD)
    all_five, three = (
        check_plan(
            PlannedStairs(of, narrow, ("near", "far")), poses, CELL.T_flange_sensor, noise, 1.0
        )
        for of in (whole, middle)
    )
    assert not all_five.unseen
    assert all_five.working_error_m == pytest.approx(three.working_error_m, rel=1e-4)


@pytest.mark.parametrize("turned", [False, True])
def test_poses_without_enough_rotation_are_refused_in_words(turned):
    still = replace(CELL, tilt_rad=0.0, roll_rad=np.radians(60.0) * turned)
    plan = judged(BALL, sphere_poses(12, still))
    assert plan.verdict.code is Code.RANK_DEFICIENT
    assert plan.rank < plan.unknowns
    assert "translation" in plan.unobservable[0]
    missing = "about another axis" if turned else "about two axes"
    assert all(missing in words for words in plan.unobservable)


def test_poses_are_counted_that_differ():
    """From one pose the robot errs alike, however often it goes there."""
    poses = sphere_poses(4)
    plan = judged(BALL, np.concatenate([poses, poses]))
    assert plan.verdict.code is Code.TOO_FEW_SAMPLES
    assert plan.verdict.reason.startswith("4 poses that differ see the target")


@pytest.mark.parametrize(("known", "fewest"), [(False, 7), (True, 5)])
def test_noise_that_is_given_needs_no_pose_to_tell_it(known, fewest):
    line = np.stack([T_BASE_USER[:3, 3], T_BASE_USER[:3, 0]])
    target = PlannedLine(SENSOR, line if known else None)
    shots = edge_shots(CELL, T_BASE_USER, fewest, np.random.default_rng(1))
    codes = [
        check_plan(target, shots.true_T_base_flange, CELL.T_flange_sensor, noise, 1.0).verdict.code
        for noise in (NOISE, None)
    ]
    assert codes[0] is not Code.TOO_FEW_SAMPLES
    assert codes[1] is Code.TOO_FEW_SAMPLES


def test_an_unknown_edge_lies_across_the_light_whichever_way_round_the_sensor_is_held():
    shots = edge_shots(CELL, T_BASE_USER, 8, np.random.default_rng(1))
    T = shots.true_T_base_flange @ CELL.T_flange_sensor
    turned = T.copy()
    turned[::2, :3, :2] *= -1.0  # by half a turn about the beam
    (point, along), (other_point, other) = (PlannedLine(SENSOR).place(each) for each in (T, turned))
    assert other_point == pytest.approx(point)
    assert abs(other @ along) == pytest.approx(1.0)
    assert abs(along @ T_BASE_USER[:3, 0]) > np.cos(np.radians(40.0))  # one pose is off by no more


def test_too_few_poses():
    plan = judged(BALL, sphere_poses(4))
    assert plan.verdict.code is Code.TOO_FEW_SAMPLES
    assert len(plan.proposed) >= 1


@dataclass(frozen=True)
class FewPlaces(PlannedSphere):
    """A sphere for which there are few other places, the first of them without a view of it."""

    good: int = 0

    def candidates(self, T_base_sensor, place):
        return super().candidates(T_base_sensor, place)[: 1 + self.good] + BLIND[: 1 + self.good]


BLIND = np.zeros((13, 4, 4))
BLIND[0, 2, 3] = 1.0  # m above all the others


@pytest.mark.parametrize("good", [0, 3])
def test_only_poses_that_show_something_are_proposed_and_each_once(good):
    target = FewPlaces(RADIUS_M, SENSOR, tuple(CENTRE), good=good)
    plan = judged(target, sphere_poses(4), 1e-9)
    assert len(plan.proposed) == good
    assert (plan.proposed_error_m is None) == (good == 0)
    if good:
        assert not target.unseen(target.view(plan.proposed, CELL.T_flange_sensor, CENTRE))


def test_a_pose_that_does_not_see_the_target_is_told():
    poses = sphere_poses(8)
    poses[2, :3, 3] += [0.0, 0.0, 0.1]
    plan = judged(BALL, poses)
    assert list(plan.unseen) == [2]
    assert "mm" in plan.unseen[2]


def test_a_laser_plane_beside_the_sphere_is_told_as_that():
    """At the right height it is, however far aside; a sensor that is too high is too high."""
    R = frames.exp_rotation([np.pi, 0.0, 0.0])

    def told(aside_m: float, higher_m: float = 0.0) -> str:
        at = np.array([0.0, aside_m, SENSOR.middle_m - BEHIND * RADIUS_M - higher_m])
        sensor = frames.transform(R, CENTRE - R @ at)[None]
        return judged(BALL, sensor @ frames.invert(CELL.T_flange_sensor)).unseen.get(0, "")

    assert told(0.5 * RADIUS_M) == ""
    for aside_m in (1.05 * RADIUS_M, 3.0 * RADIUS_M):
        assert told(aside_m) == "the laser plane passes beside the sphere"
        assert told(aside_m, 0.1) == "the target is at -100 mm, the sensor sees 10 to -10 mm"


def test_a_moved_base_gives_the_same_judgement():
    poses = sphere_poses(8)
    T = frames.transform(frames.exp_rotation([0.2, 0.5, -0.7]), [1.0, 2.0, -0.5])
    moved = PlannedSphere(RADIUS_M, SENSOR, tuple((T @ np.append(CENTRE, 1.0))[:3]))
    here, there = judged(BALL, poses), judged(moved, T @ poses)
    assert here.working_error_m == pytest.approx(there.working_error_m, rel=1e-6)


@pytest.mark.parametrize("turned", [False, True])
def test_proposed_poses_do_what_they_promise(turned):
    """Shots from the mended plan, through the sensor and the solver: by another code path."""
    still = replace(CELL, tilt_rad=0.0, roll_rad=np.radians(60.0) * turned)
    poor = sphere_poses(6, still)
    plan = judged(BALL, poor)
    every = np.concatenate([poor, plan.proposed])
    rng = np.random.default_rng(8)
    scene = ball_on_table(CENTRE, RADIUS_M)
    profiles = [CELL.sensor.shoot(T @ CELL.T_flange_light, scene, rng) for T in every]
    stands = [CELL.robot.stand(T, rng) for T in every]
    reported = np.array([stand.T_base_flange for stand in stands])
    shots = SimulatedShots(every, reported, profiles, [""] * len(every), None)
    result = solve_task(sphere_task(), data_of(shots), "best", HandEyeSettings())
    assert result.verdict.accept
    assert len(result.rejected) <= 1  # nothing that is proposed is out of view
    off_m = apart(result.T_flange_sensor, CELL.T_flange_sensor, SENSOR.field_points)
    assert off_m < 3.0 * plan.proposed_error_m


def misfit(centre, T_base_sensor):
    """Of a centre (3,) with Cauchy's loss, one pose after the other."""
    off = OFF_EQUATOR * RADIUS_M
    allowed = [0.045, RADIUS_M - off, 0.01 + RADIUS_M]
    total = 0.0
    for T in T_base_sensor:
        s = T[:3, :3].T @ (centre - T[:3, 3])
        wanted = [0.0, np.copysign(off, s[1]), -BEHIND * RADIUS_M]
        total += np.log1p(np.sum(((s - wanted) / allowed) ** 2))
    return total


@pytest.mark.parametrize("strays", [0, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_centre_is_the_most_likely_one(seed, strays):
    shots = sphere_shots(CELL, CENTRE, RADIUS_M, 12, np.random.default_rng(seed))
    T = shots.true_T_base_flange @ CELL.T_flange_sensor
    T[12 - strays :, :3, 3] += 0.3
    centres, misfits = looked_at(T, RADIUS_M, SENSOR)
    best = np.argmin(misfits)
    least = minimize(misfit, CENTRE, (T,), method="Nelder-Mead", options={"xatol": 1e-7})
    assert misfits[best] == pytest.approx(least.fun, rel=1e-6)
    assert np.linalg.norm(centres[best] - least.x) < 1e-5  # both ends stop at 1e-6 or finer


def test_poses_that_look_alike_leave_both_sides_possible():
    """Without a turn the sphere may be before the laser planes or behind them."""
    sides = looked_at(np.tile(np.eye(4), (3, 1, 1)), RADIUS_M, SENSOR)
    y = np.sort(sides[0][:, 1])
    assert np.allclose(np.abs(y), OFF_EQUATOR * RADIUS_M, atol=1e-6)
    assert y[0] < 0.0 < y[-1]
    assert np.allclose(sides[1], 0.0, atol=1e-6)


@pytest.mark.parametrize("kind", PLANNED)
def test_a_field_counted_in_heights_about_its_middle_is_the_same_field(kind):
    target, shown = PLANNED[kind]
    more = {
        "sphere": lambda: sphere_poses(12),
        "line": lambda: (
            edge_shots(CELL, T_BASE_USER, 15, np.random.default_rng(1)).true_T_base_flange
        ),
    }
    poses = more.get(kind, shown)()
    middle_m = SENSOR.middle_m
    half_m = middle_m - SENSOR.near_m
    heights = replace(SENSOR, near_m=half_m, far_m=-half_m)
    turned = frames.transform(frames.exp_rotation([np.pi, 0.0, 0.0]), [0.0, 0.0, middle_m])
    mount = CELL.T_flange_sensor
    one = check_plan(target, poses, mount, NOISE, LIMIT_M)
    same = replace(target, sensor=heights)
    other = check_plan(same, poses, mount @ turned, NOISE, LIMIT_M)
    assert list(one.unseen) == list(other.unseen)
    assert one.working_error_m == pytest.approx(other.working_error_m, rel=1e-6)
    added_m = [plan.proposed_error_m or 0.0 for plan in (one, other)]
    assert added_m[0] == pytest.approx(added_m[1], rel=1e-3)
