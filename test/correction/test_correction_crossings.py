# SPDX-License-Identifier: Apache-2.0
"""Near singular postures: a drift's correction is slow, a bent tool never much further off."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from correction_robot import FASTEST, LARGEST_A, ROUNDING
from long_form import amount
from test_correction_solution import TOOL, bent, robot, staged
from test_correction_solution import scaled_jacobian as jacobian

from robocal_ros.correction.bounds import CorrectionConfig, DesiredOffset
from robocal_ros.correction.damping import LENGTH
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.correction.limiter import OFFSET, OUT, SLIDING, TAUGHT, TURNING, OffsetLimiter
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm

DT = 0.004
CROSSED = {"wrist": 4, "elbow": 2, "shoulder": 1}  # the joint that crosses it
SHIFT_M, TURN_DEG = 2e-3, 0.5

pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")


def place(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    return np.asarray((arm.fk(q) @ arm.T_flange_tool)[:, :3, 3])


def ways(
    arm: SerialArm, joint: int, speed: float, rng: np.random.Generator
) -> Iterator[np.ndarray]:
    """Random ones of all joints, ``joint`` the fastest, through a singularity in their middle."""
    t = np.arange(-round(np.pi / 8.0 / speed / DT), round(np.pi / 4.0 / speed / DT)) * DT
    while True:
        q = np.tile(rng.uniform(-2.0, 2.0, arm.n), (2001, 1))
        q[:, 4] = np.where(joint == 4, 0.0, np.pi / 3.0)
        if joint != 4:
            q[:, joint] = np.linspace(-2.0, 2.0, len(q))
            sign = np.sign(np.linalg.det(jacobian(arm, q)))
            q = q[:-1][sign[1:] != sign[:-1]]
        if len(q) and np.linalg.svd(jacobian(arm, q[:1]), compute_uv=False)[0, 4] > 0.25:
            way = rng.uniform(-1.0, 1.0, arm.n)
            way[joint] = rng.choice([-1.0, 1.0])
            yield q[0] + speed * t[:, None] * way


@pytest.mark.parametrize(
    ("shift_m", "turn_deg", "speed_deg_s", "most_m"),
    [
        (SHIFT_M, TURN_DEG, 60.0, 7e-3),
        (SHIFT_M, TURN_DEG, 150.0, 7e-3),
        (9e-3, 3.5, 60.0, 14e-3),
        (9e-3, 3.5, 150.0, 27e-3),  # nearly as much as may be corrected, and as fast as it can
    ],
)
@pytest.mark.parametrize("crossed", CROSSED)
def test_no_crossing_takes_a_bent_tool_much_further_off_than_it_is_bent(
    crossed: str, shift_m: float, turn_deg: float, speed_deg_s: float, most_m: float
) -> None:
    rng, taught = np.random.default_rng(1), robot("kr150_r3100")
    paths, worst, weak = ways(taught, CROSSED[crossed], np.radians(speed_deg_s), rng), 0.0, False
    for _ in range(25):
        q, actual = next(paths), bent(taught, rng, shift_m, turn_deg)
        found = staged(taught, actual).correct(q)
        assert found.tool is not None
        assert found.tool.converged.all()
        weak |= bool(found.weak.any())
        wanted = found.q - q
        limiter = OffsetLimiter(np.zeros(6, dtype=np.bool_), TURNING, SLIDING)
        limiter.state[OFFSET] = wanted[0]
        speed = np.full(len(q), np.radians(speed_deg_s))
        offset, _ = limiter.follow(wanted, np.arange(len(q)) * DT, speed, np.ones(6))
        rate = np.diff(offset, axis=0) / DT
        assert np.abs(rate).max() <= FASTEST + ROUNDING
        assert np.abs(np.diff(rate[1:], axis=0)).max() <= LARGEST_A * DT + ROUNDING
        off = np.linalg.norm(place(actual, q + offset) - place(taught, q), axis=1)
        worst = max(worst, float(off.max()))
    assert weak
    assert worst <= most_m


@pytest.mark.parametrize("name", ["kr150_r3100", "ur10", "bx200l"])
def test_a_drift_crosses_a_wrist_singularity_at_less_than_2_deg_s(name: str) -> None:
    """Many ways, shoulder or elbow near or not, drifts of 4 to 120 um: as paths and as streams."""
    rng, taught = np.random.default_rng(4), robot(name)
    taught = replace(taught, lower=np.full(6, -np.inf), upper=np.full(6, np.inf))
    chosen, paths = taught.parameters, ways(taught, 4, np.radians(60.0), rng)
    change = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 3e-4, 2e-4)
    q = rng.uniform(-2.0, 2.0, (2000, 6))
    moved = taught.with_mdh(chosen.add(taught.mdh, change)).fk(q) - taught.fk(q)
    change /= np.linalg.norm(moved[:, :3, 3], axis=1).max()
    found: list[tuple[float, SerialArm, np.ndarray, np.ndarray]] = []
    for _ in range(amount(120, 400)):
        size = 10.0 ** rng.uniform(np.log10(4e-6), np.log10(1.2e-4))
        actual, q = taught.with_mdh(chosen.add(taught.mdh, size * change)), next(paths)
        wanted = staged(taught, actual).correct(q).q - q
        limiter = OffsetLimiter(np.zeros(6, dtype=np.bool_), TURNING, SLIDING)
        limiter.state[OFFSET] = wanted[0]
        speed, t = np.full(len(q), np.radians(60.0)), np.arange(len(q)) * DT
        offset, _ = limiter.follow(wanted, t, speed, np.ones(6))
        found.append((asked(taught, actual, q, offset)[0], actual, q, offset))
    for _, actual, q, offset in found:
        rate, off = asked(taught, actual, q, offset)
        assert rate <= 2.0
        # where joints cannot move the tool's position in one direction, nothing can be done there
        U, s, _ = np.linalg.svd(jacobian(taught, q)[:, :3], full_matrices=False)
        left = np.einsum("mij,mi->mj", U, place(actual, q + offset) - place(taught, q))
        assert np.linalg.norm(left * (s > 0.1), axis=1).max() <= 0.04e-3
        uncorrected = np.linalg.norm(place(actual, q) - place(taught, q), axis=1).max()
        assert off <= 0.04e-3 or (s[:, 2].min() < 0.1 and off <= uncorrected)
    for _, actual, q, _ in sorted(found, key=lambda one: -one[0])[:3]:
        assert asked(taught, actual, q, streamed(taught, actual, q))[0] <= 2.0


def asked(
    taught: SerialArm, actual: SerialArm, q: np.ndarray, offset: np.ndarray
) -> tuple[float, float]:
    """Fastest change of a joint's offset, deg/s, and how far the tool is off at most, m."""
    off = np.linalg.norm(place(actual, q + offset) - place(taught, q), axis=1).max()
    return float(np.degrees(np.abs(np.diff(offset, axis=0)).max() / DT)), float(off)


def streamed(taught: SerialArm, actual: SerialArm, q: np.ndarray) -> np.ndarray:
    """Offsets of targets (m, 6) that come one by one, `DT` apart."""
    desired = DesiredOffset(taught, CorrectionConfig())
    desired.want(actual, on=True)
    limiter = desired.limiter
    begin = desired.at(q[:1])[0][0]
    limiter.begin(np.arange(6), begin, begin)
    limiter.memory[TAUGHT], limiter.memory[OUT] = q[0], q[0] + begin
    offsets, given = [begin], (np.ones(6), np.full((2, 6), 10.0))
    for at in q[1:]:
        assert 0.0 <= desired.put_out(at.copy(), np.zeros(6), DT, DT, *given) <= 1.0
        offsets.append(limiter.memory[OUT] - at)
    return np.array(offsets)


def test_in_ordinary_postures_a_bent_tool_is_where_it_was_taught() -> None:
    """Some 12 deg from a wrist singularity, and where the position alone is not singular."""
    rng, taught = np.random.default_rng(2), robot("kr150_r3100")
    q = rng.uniform(-2.0, 2.0, (4000, 6))
    J = jacobian(taught, q)
    least, of_position = (np.linalg.svd(x, compute_uv=False)[:, -1] for x in (J, J[:, :3]))
    q = q[(least > 0.2) & (of_position > 0.5)]
    assert len(q) > 2000
    for _ in range(5):
        actual = bent(taught, rng, SHIFT_M, TURN_DEG)
        found = staged(taught, actual).correct(q)
        off = np.linalg.norm(place(actual, found.q) - place(taught, q), axis=1)
        assert off.max() < 1e-9
        assert found.tool is not None
        assert np.median(found.tool.rotation_error_rad) < 0.01 * np.radians(TURN_DEG)


def test_another_model_in_motion_takes_nothing_back_of_what_is_corrected() -> None:
    """What the desired offset does in one step is no motion that is too fast to follow."""
    limiter, small = OffsetLimiter(np.zeros(1, dtype=np.bool_), TURNING, SLIDING), np.radians(0.05)
    t = np.arange(0.0, 1.0, DT)
    wanted = np.radians(0.2) * (1.0 + 0.2 * np.sin(2.0 * t))
    wanted[100:] += small
    limiter.state[OFFSET] = wanted[0]
    offset, _ = limiter.follow(wanted[:, None], t, np.ones(len(t)), np.ones(1))
    assert np.abs(offset[:100, 0] - wanted[:100]).max() < 1e-3 * small
    assert np.all(wanted[100:] - offset[100:, 0] <= small * 1.001)
    assert np.all(np.diff((wanted - offset[:, 0])[100:]) <= ROUNDING)
    assert offset[-1, 0] == wanted[-1]


def damping(M: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Of symmetric matrices (m, 3, 3): equation 2 of `joint_correction`."""
    s, U = np.linalg.eigh(M)
    rest = np.clip(1.0 - s / (3.0 * square[:, None]), 0.0, None)
    return np.asarray((U * (square[:, None] * rest**3)[:, None, :]) @ np.swapaxes(U, 1, 2))


def test_many_weak_points_are_solved_at_once_by_the_equations() -> None:
    """All take the same steps, sixteen at a time; e(q') = D y holds to rounding."""
    rng, taught = np.random.default_rng(3), robot("kr150_r3100")
    change = rng.standard_normal(taught.mdh.shape) * 3e-5 * (taught.mdh != 0.0)
    actual, b, slope = taught.with_mdh(taught.mdh + change), np.radians(0.24), 1.0 / 60.0
    q = rng.uniform(-2.0, 2.0, (3000, 6))
    q[:300, 4] = rng.uniform(-0.02, 0.02, 300)
    found = JointCorrection.between(taught, actual, b, slope=slope).correct(q)
    assert found.converged.all()
    assert 600 < np.count_nonzero(found.weak) < 2400
    assert np.all(found.iterations == 3)  # all of them by `six_axis`

    def miss(at: np.ndarray) -> np.ndarray:
        goal, T = taught.fk(q) @ TOOL, actual.fk(at) @ TOOL
        turn = frames.log_rotation(goal[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
        return np.concatenate([(goal - T)[:, :3, 3] / LENGTH, turn], axis=1)

    def square(e: np.ndarray) -> np.ndarray:
        size = np.sqrt(np.sum(e**2, axis=1) + 1e-12)
        return np.asarray(size * np.hypot(1.0 / slope, 0.3 * size / b**2))

    e, J = miss(q), jacobian(actual, q)
    M, D = J @ np.swapaxes(J, 1, 2), np.zeros((len(q), 6, 6))
    D[:, :3, :3] = damping(M[:, :3, :3], square(e[:, :3]))
    turns = np.linalg.solve(M[:, :3, :3] + D[:, :3, :3], M[:, :3, 3:])
    L = np.linalg.cholesky(np.eye(3) + np.swapaxes(turns, 1, 2) @ turns)
    inverse = np.linalg.inv(L)
    alone = inverse @ (M[:, 3:, 3:] - M[:, 3:, :3] @ turns) @ np.swapaxes(inverse, 1, 2)
    D[:, 3:, 3:] = L @ damping(alone, square(e)) @ np.swapaxes(L, 1, 2)
    assert np.array_equal(found.weak, np.abs(D).max(axis=(1, 2)) > 0.0)
    regular = np.linalg.cond(J) < 1e4
    y = np.linalg.solve(np.swapaxes(J, 1, 2), found.joint_shift[..., None])
    left = (D @ y)[..., 0] - miss(found.q)
    assert np.count_nonzero(regular & found.weak) > 600
    assert np.abs(left[regular]).max() < 1e-9 * np.abs(e).max()
