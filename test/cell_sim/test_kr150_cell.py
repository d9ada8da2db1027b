# SPDX-License-Identifier: Apache-2.0
"""The whole cell: what its robot does to it, and what it shows of that."""

import re
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cell_plans import measured
from kr150_shift import (
    ABOVE,
    ARM,
    CYCLE,
    HOME,
    NOMINAL,
    WORK,
    cell_of,
    first_circle,
    go,
    true_laser,
    went,
    worked,
)

from bench.cell_samples import SPIN_RAD, CellSamples, programme
from bench.laser_tracker import shift
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.cell import (
    DUTY,
    FLOOR,
    T_BASE_LASER,
    T_FLANGE_LASER,
    TARGET,
    TARGET_RADIUS_M,
    TAUGHT,
    SimulatedCell,
    kr150_cell,
    poses,
)
from robocal_ros.cell_sim.robot import Effects, Warmth, turn
from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.cell_sim.trajectory_controller import LAG_S
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody
from robocal_ros.thermal.screening import share_within
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.driving import approach, measuring
from robocal_ros.tool.run import MeasuringPlan

PAGE = Path(__file__).parents[2] / "docs" / "simulation.md"
SILENT = replace(Effects(), noise=False, outliers=False)


def told(came):
    """Everything that came, in a form that compares."""
    joints = [part.tolist() for part in (came.time_s, came.q, came.qd)]
    shots = [(s.time_s, *s.centre, *s.floor, *s.points.ravel()) for s in came.shots]
    return joints, came.edges, shots, [(t.time_s, *t.celsius) for t in came.temperatures]


def run(cut, readings=True, seed=3):
    """Shows the ball, goes to the beams, drives a circle; asked at the times that `cut` gives."""
    cell = cell_of(seed, points=50)
    parts = []

    def until(end_s):
        parts.extend(cell.advance(t, readings) for t in cut(cell.now_s, end_s))

    go(cell, [CYCLE[0], ABOVE])
    until(0.8 * cell.motion.end_s)
    cell.set_fault("collision", 3.0)
    until(cell.motion.end_s + 0.3)
    cell.drive(first_circle(cell))
    until(cell.now_s + 0.9)
    cell.set_fault("lost_messages", 0.3)
    until(cell.motion.end_s + 0.3)
    go(cell, HOME)
    until(cell.motion.end_s)
    every = [told(part) for part in parts]
    joints = [list(chain(*(part[0][i] for part in every))) for i in range(3)]
    rest = [list(chain(*(part[i] for part in every))) for i in (1, 2, 3)]
    return joints, *rest, cell.flange(np.array([cell.now_s]))


def pieces(begin, end, rng=None):
    rng = rng or np.random.default_rng(round(end * 1e3))
    inside = np.sort(rng.uniform(begin, end, 40))
    return [*inside.tolist(), end]


@pytest.mark.long
def test_the_seed_tells_everything_however_time_is_cut():
    whole, cut = run(lambda begin, end: [end]), run(pieces)
    assert len(whole[1]) > 3
    assert len(whole[2]) > 0
    assert len(whole[3]) > 5
    assert whole[:4] == cut[:4]
    assert np.array_equal(whole[4], cut[4])
    assert run(pieces, seed=4)[3] != whole[3]


@pytest.mark.long
def test_without_readings_all_else_is_the_same():
    whole, without = run(pieces), run(pieces, readings=False)
    assert without[0] == [[], [], []]
    assert without[1:4] == whole[1:4]


@pytest.mark.long
def test_work_warms_the_robot_and_a_break_cools_it():
    cell = cell_of()
    worked(cell, 0.08)
    goal = kr150.WARM_UP.motor_rise * DUTY
    share = 1.0 - np.exp(-cell.now_s / kr150.WARM_UP.motor_tau_s)
    assert cell.warmth.motor == pytest.approx(goal * share, rel=0.04)
    warm, end_s = cell.warmth.motor, cell.now_s + 600.0
    assert not cell.moving
    cell.advance(end_s, readings=False)
    assert cell.warmth.motor == pytest.approx(warm * np.exp(-600.0 / 2400.0), rel=1e-3)
    before, aside = cell.warmth.motor, HOME + np.eye(6)[0]
    for _ in range(10):  # only the first joint works
        went(cell, [aside, HOME], 0.1)
    assert (cell.warmth.motor > before).tolist() == [True, *[False] * 5]


def test_heat_can_be_taken_away():
    cell = cell_of()
    cell.heating.level = 0.0
    came = went(cell, WORK, readings=False)
    assert cell.warmth.motor == pytest.approx(np.zeros(6), abs=0.0)
    celsius = np.array([t.celsius for t in came.temperatures])
    assert celsius.mean(axis=0) == pytest.approx(
        np.full(6, 22.0), abs=5 * 0.1 / len(celsius) ** 0.5
    )


def test_temperatures_are_told_each_second():
    came = went(cell_of(), CYCLE)
    times = [t.time_s for t in came.temperatures]
    assert times == pytest.approx(np.arange(1, len(times) + 1))
    assert times[-1] == int(came.time_s[-1])


def test_the_drift_has_the_published_size():
    cell = cell_of(5)
    state, moved = Warmth.cold(6), []
    tip = TAUGHT[:3, 3]
    cold = cell.plan.robot.point(WORK, state, tip)
    for _ in range(90):
        state = kr150.WARM_UP.step(state, DUTY, 300.0)
        moved.append(cell.plan.robot.point(WORK, state, tip) - cold)
    assert 0.40 < share_within(np.array(moved)) < 0.52  # published: 43 to 49 %


def test_the_ball_is_measured_at_each_pose_of_the_cycle():
    cell = cell_of(effects=SILENT)
    came = went(cell, CYCLE, rest_s=1.0)
    assert len(came.shots) == len(CYCLE)
    sensor = cell.plan.sphere.sensor
    before = np.vstack([HOME, CYCLE[:-1]])
    for shot, pose, last in zip(came.shots, CYCLE, before, strict=True):
        standing = np.max(np.abs(came.qd[np.abs(came.time_s - shot.time_s) < 0.3]))
        assert standing == 0.0
        behind = cell.plan.robot.backlash.behind(pose - last)[None]
        T = sensor.T_sensor_base @ cell.plan.robot.flange(pose, Warmth.cold(6), behind=behind)[0]
        centre = T[:3, :3] @ sensor.ball + T[:3, 3]
        # Its sensor and stem warm up within this minute; the readings are in counts of 1e-6 rad.
        assert shot.centre == pytest.approx(centre, abs=1e-5)
        assert shot.floor == pytest.approx(cell.plan.sphere.floor, abs=5e-5)


def test_nothing_is_measured_on_the_way_nor_out_of_the_field():
    cell = cell_of()
    assert went(cell, np.vstack([CYCLE, HOME]), rest_s=0.3).shots == []
    assert went(cell, np.vstack([HOME, WORK[:3], ABOVE])).shots == []


def test_a_cloud_holds_the_ball():
    came = went(cell_of(effects=SILENT, points=2000), CYCLE)
    alone = went(cell_of(effects=SILENT), CYCLE)
    for shot, plain in zip(came.shots, alone.shots, strict=True):
        assert shot.points.shape == (2000, 3)
        fit = fit_sphere(shot.points, SphereRule(0.01905))
        assert fit.centre == pytest.approx(plain.centre, abs=5e-5)


def test_a_measurement_is_told_after_its_delay():
    cell = cell_of()
    go(cell, CYCLE[:1])
    while not (came := cell.advance(cell.now_s + 0.01)).shots:
        assert cell.now_s < cell.motion.end_s + 2.0
    assert cell.now_s - came.shots[0].time_s == pytest.approx(0.15, abs=0.02)


def test_each_visit_has_its_own_scatter_in_the_joints():
    cell = cell_of(effects=replace(Effects.none(), noise=True))
    off = []
    for _ in range(150):
        went(cell, [HOME, HOME + 0.01], rest_s=0.2, readings=False)
        at = np.array([cell.now_s])
        q = cell.motion.at(at)[0]
        off.append((cell.flange(at) - cell.plan.robot.flange(q, Warmth.cold(6)))[0, :3, 3])
    J = ARM.jacobian(HOME + 0.01)[:3]
    wanted = kr150.REPEATABILITY_RAD * np.sqrt(np.sum(J**2, axis=1))
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    assert spread == pytest.approx(wanted, rel=4.0 / np.sqrt(2 * 150))


def test_a_healthy_cold_robot_has_no_error_at_work():
    cell = cell_of()
    assert np.max(np.abs(cell.tcp_error(WORK))) == 0.0
    worked(cell, 0.1)
    wanted = cell.plan.robot.point(WORK, cell.warmth, TAUGHT[:3, 3]) - cell.plan.robot.point(
        WORK, Warmth.cold(6), TAUGHT[:3, 3]
    )
    assert cell.tcp_error(WORK) == pytest.approx(wanted, abs=1e-12)
    turned = WORK + 1e-4 * np.eye(6)[0]
    reach = np.hypot(*(ARM.fk(WORK) @ TAUGHT[:, 3])[:, :2].T)
    way = np.linalg.norm(cell.tcp_error(turned) - cell.tcp_error(WORK), axis=1)
    assert way == pytest.approx(1e-4 * reach, rel=0.01)


def test_a_bend_is_found_at_the_beams():
    """What the robot's own errors make of a tool cancels in the change of it."""
    cell, noise = cell_of(2), RobotNoise(3e-5, 1e-5)
    went(cell, ABOVE)
    laser = true_laser(cell)
    healthy, _ = measured(cell, laser, noise, TAUGHT, SPIN_RAD)
    cell.set_fault("collision", 3.0)
    bent, counts = measured(cell, laser, noise, TAUGHT, SPIN_RAD)
    assert counts == [8, 8, 8, 4, 4]
    change = cell.tool.T_flange_tool[:3, 3] - TAUGHT[:3, 3]
    sigma = np.sqrt(np.diag(healthy.covariance + bent.covariance)[:3])
    assert np.all(np.abs(bent.tip - healthy.tip - change) < 4.0 * sigma)
    assert np.max(4.0 * sigma) < 0.1 * np.linalg.norm(change)


def test_samples_for_sessions_say_what_happened():
    cell = cell_of(points=500)
    rule = SphereRule(0.01905)
    came = went(cell, CYCLE[:2])
    samples = CellSamples(NOMINAL.joint_names, rule, start_ns=10**18).of(came, cell.faults)
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(stamps)
    kinds = [type(sample).__name__ for sample in samples]
    counts = {kind: kinds.count(kind) for kind in set(kinds)}
    assert counts == {
        "JointSample": len(came.time_s),
        "PointSample": 2 * len(came.shots),
        "TemperatureSample": 6 * len(came.temperatures),
    }
    balls = [s for s in samples if type(s).__name__ == "PointSample" and s.target == "ball"]
    assert [s.stamp_ns for s in balls] == [10**18 + round(s.time_s * 1e9) for s in came.shots]
    for sample, shot in zip(balls, came.shots, strict=True):
        assert np.linalg.norm(sample.position_m - shot.centre) < 6.0 * sample.sigma_m


def test_the_sample_of_the_page_runs():
    (sample,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    made: dict[str, Any] = {}
    exec(sample, made)
    assert made["came"].shots
    off_m = np.linalg.norm(made["error_m"], axis=1)
    assert off_m == pytest.approx(np.full(len(WORK), 2e-3), rel=0.1)


def test_the_programme_keeps_its_speed_and_rests():
    time, q, qd, qdd = programme(HOME, WORK, speed=1.2, rest_s=0.5)
    cell = SimulatedCell(kr150_cell(NOMINAL))
    cell.follow(time, q, qd, qdd)
    at = np.arange(0.0, time[-1], 0.004)
    seen, moving = cell.motion.at(at)
    # It begins a cycle late, and goes the first way in what is left.
    assert np.max(np.abs(moving)) == pytest.approx(1.2, rel=5e-3)
    assert seen[-1] == pytest.approx(WORK[-1], abs=1e-9)
    resting = np.all(moving == 0.0, axis=1) | (np.max(np.abs(moving), axis=1) < 1e-9)
    rests_s = (0.5 - 2.0 * LAG_S) * len(WORK)  # the drives take a part of each to come to rest
    assert resting.mean() == pytest.approx(rests_s / time[-1], rel=0.05)


def test_the_line_laser_sees_its_target_at_each_of_its_poses():
    """A ball's section is a circle about where the ball is; the rest are stem and table."""
    cell = SimulatedCell(kr150_cell(NOMINAL, profile=True, points=0))
    came = went(cell, np.vstack([poses("profile"), HOME]))
    assert len(came.profiles) == len(poses("profile"))
    robot, cold = cell.plan.robot, Warmth.cold(6)
    for shot, q in zip(came.profiles, poses("profile"), strict=True):
        T = robot.flange(q, cold)[0] @ T_FLANGE_LASER @ ProfileSensor().T_light_sensor
        x, y, z = np.linalg.inv(T)[:3] @ np.append(TARGET, 1.0)
        reach = np.sqrt(TARGET_RADIUS_M**2 - y**2)
        away = np.hypot(shot.points[:, 0] - x, shot.points[:, 1] - z) - reach
        assert np.sum(np.abs(away) < 2e-4) > 50
    assert went(cell, [CYCLE[0]]).profiles == []
    assert went(cell_of(), np.vstack([poses("profile")[:1], HOME])).profiles == []


CROSSING = T_BASE_LASER[:3, 3]
T_BASE_SENSOR = np.linalg.inv(kr150.T_SENSOR_BASE)
SEEN_FLOOR = T_BASE_SENSOR[:3, :3] @ FLOOR + T_BASE_SENSOR[:3, 3]
ALONG = np.linspace(0.0, 1.0, 15)[None, :, None]
ON_THE_WAY = np.linspace(0.0, 1.0, 60)[:, None]

# What stands in the cell: start, end, radius, base, m.
STANDING = {
    "post": ([1.70, -1.00, 0.0], [1.70, -1.00, 1.20], 0.07),
    "sensor": ([1.70, -0.95, 1.23], [1.70, -0.90, 1.20], 0.10),
    "floor sphere": (SEEN_FLOOR * [1.0, 1.0, 0.0], SEEN_FLOOR, 0.025),
    "target": (TARGET * [1.0, 1.0, 0.0], TARGET - [0.0, 0.0, 0.02], 0.015),
    "station": (CROSSING * [1.0, 1.0, 0.0], CROSSING - [0.0, 0.0, 0.07], 0.10),
}


def joints_of(q: np.ndarray) -> list[np.ndarray]:
    """Places (m, 3) of the root and of the frame after each joint."""
    T, places = np.tile(np.eye(4), (len(q), 1, 1)), [np.zeros((len(q), 3))]
    for i, (d, theta, a, alpha, _) in enumerate(ARM.mdh):
        T = T @ shift(2, np.full(len(q), d)) @ turn(2, theta + ARM.sign[i] * q[:, i])
        T = T @ shift(0, np.array([a])) @ turn(0, np.array([alpha]))
        places.append(T[:, :3, 3])
    return places


def robot_at(q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """The moving parts as capsules: ends (m, 3) and radius."""
    _, shoulder, elbow, _, wrist, _, flange = joints_of(q)
    tip, ball = ((ARM.fk(q) @ np.append(p, 1.0))[:, :3] for p in (TAUGHT[:3, 3], kr150.BALL))
    return {
        "upper arm": (shoulder, elbow, 0.20),
        "forearm": (elbow, wrist, 0.17),
        "wrist": (wrist, flange, 0.12),
        "pin": (flange, tip, 0.02),
        "stem": (flange, ball, 0.02),
    }


def from_segment(p: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = end - start
    share = np.clip(np.sum((p - start) * way, -1) / np.sum(way * way, -1), 0.0, 1.0)
    return np.linalg.norm(p - (start + share[..., None] * way), axis=-1)


def room(q: np.ndarray) -> tuple[float, str]:
    """Least distance over poses (m, n) to what stands around, the ground, and the robot itself."""
    parts, least = robot_at(q), []
    upper = parts["upper arm"]
    for name, (start, end, radius) in parts.items():
        points = start[:, None] + ALONG * (end - start)[:, None]
        for other, (a, b, thick) in STANDING.items():
            away = from_segment(points, np.array(a), np.array(b))
            least.append((float(np.min(away)) - radius - thick, f"{name}, {other}"))
        least.append((float(np.min(points[..., 2])) - radius, f"{name}, ground"))
        if name in ("pin", "stem"):
            away = from_segment(points, upper[0][:, None], upper[1][:, None])
            least.append((float(np.min(away)) - upper[2] - radius, f"{name}, upper arm"))
            low = points[points[..., 2] < 1.1]
            if len(low):
                away = np.hypot(low[:, 0], low[:, 1]) - 0.45
                least.append((float(np.min(away)) - radius, f"{name}, base"))
    return min(least)


def straight(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a + ON_THE_WAY * (b - a)


def test_the_skeleton_is_the_robots():
    q = np.vstack([HOME, WORK])
    assert joints_of(q)[-1] == pytest.approx(ARM.fk(q)[:, :3, 3], abs=1e-9)


@pytest.mark.parametrize("kind", ["cycle", "work", "tool", "profile"])
def test_ways_are_clear(kind):
    """From home to each pose, and from each to the next, straight in the joints."""
    way = poses(kind)
    ways = [straight(HOME, q) for q in way]
    ways += [straight(a, b) for a, b in pairwise(way)]
    for q in ways:
        away, what = room(q)
        assert away > 0.05, what


def test_a_way_into_the_sensor_is_seen():
    """The check itself: a pose beside the sensor is not clear."""
    beside = HOME + np.array([np.radians(30.0), 0.5, -0.3, 0.0, 0.0, 0.0])
    assert room(straight(HOME, beside))[0] < 0.05


def test_poses_are_within_limits():
    for q in (HOME, ABOVE, *CYCLE, *WORK, *poses("profile")):
        assert np.all(q > ARM.lower + np.radians(2.0))
        assert np.all(q < ARM.upper - np.radians(2.0))


def test_the_sensor_sees_the_ball_in_the_cycle_alone():
    cell = cell_of()
    sphere, robot, cold = cell.plan.sphere, cell.plan.robot, Warmth.cold(6)
    assert all(sphere.sees(T) for T in robot.flange(CYCLE, cold))
    assert not any(sphere.sees(T) for T in robot.flange(np.vstack([HOME, ABOVE]), cold))
    assert sphere.field.holds(FLOOR[None])[0]


def test_work_is_spread_over_the_volume():
    tips = (ARM.fk(WORK) @ TAUGHT[:, 3])[:, :3]
    assert len(WORK) >= 20
    assert np.all(np.ptp(tips, axis=0) > [1.4, 2.0, 1.4])


def test_a_whole_tool_measurement_can_be_driven_from_above_the_station():
    """With what tcf_node is given: none of its motions is refused for limits or housing."""
    cell = cell_of()
    body = ToolBody(TAUGHT, 0.10, 0.01, 0.06)
    laser = true_laser(cell)
    motion = MotionCell(ARM, body, laser.T_base_laser, Housing(0.06, 0.03, -0.12, 0.10))
    plan, q, after = MeasuringPlan("full", laser, TAUGHT, spin_rad=SPIN_RAD), ABOVE, False
    for number in range(1, len(plan.names) + 1):
        step = plan.step(number, TAUGHT if plan.needs_tool(number) else None)
        q = approach(motion, step, q, after_circle=after).q[-1]
        driven = measuring(motion, step, q)
        q, after = driven.q[-1], step.kind == "circle"
        assert np.max(driven.peaks()[0]) < 1.0
