"""The poses of the whole cell: within the joints' limits, seen where they shall be, and clear."""

from itertools import pairwise

import numpy as np
import pytest
from kr150_shift import ABOVE, ARM, CYCLE, HOME, WORK, cell_of, true_laser

from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.cell import FLOOR, SPIN_RAD, T_BASE_LASER, TARGET, TAUGHT, poses
from robocal_ros.cell_sim.robot import Warmth, shift, turn
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody
from robocal_ros.tool.driving import approach, measuring
from robocal_ros.tool.run import MeasuringPlan

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
