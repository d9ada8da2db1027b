"""Choose the poses of the demo's shift, once: ``python bags/plan_demo_poses.py``.

Writes ``demo_poses.csv``: measuring poses whose sphere lies in the sensor's field and that together
tell most about the drift (D-optimal with the default prior, greedy then exchange), and check poses
spread over the working volume.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.thermal.priors import drift_prior
from robocal_ros.sim import kr150
from robocal_ros.storage.robots import load_robot

Array = NDArray[np.float64]

FILE = Path(__file__).with_name("demo_poses.csv")
CYCLE, REFERENCE, CHECK = 8, 12, 34
SIGMA_M = 4e-5  # of the difference of two visits, per axis
FIELD_M = ((-0.25, 0.25), (-0.18, 0.18), (0.60, 0.80))  # of the sphere's centre, sensor axes
NEAREST_TURN = np.cos(np.radians(60.0))  # the stem leads away from the sensor, at least so far


def candidates(arm: SerialArm, rng: np.random.Generator, count: int) -> Array:
    """Joint vectors within a bit less than the limits, elbow above the table."""
    reach = 0.45 * np.minimum(arm.upper - arm.lower, np.radians(300.0))
    middle = 0.5 * (arm.upper + arm.lower)
    q = rng.uniform(middle - reach, middle + reach, (count, arm.n))
    # without the lengths of joints 4 to 6 the model ends at the elbow
    to_elbow = arm.with_mdh(arm.mdh * np.array([[1.0, 1, 1, 1, 1]] * 3 + [[0.0, 1, 0, 1, 1]] * 3))
    elbow = to_elbow.fk(q)[:, 2, 3]
    flange = arm.fk(q)[:, :3, 3]
    clear = (elbow > 0.8) & (flange[:, 2] > 0.3) & (np.hypot(flange[:, 0], flange[:, 1]) > 0.8)
    usual = (np.abs(q[:, 0]) < np.radians(90.0)) & (q[:, 2] > np.radians(20.0))
    return q[clear & usual & (np.abs(q[:, 4]) > np.radians(10.0))]


def seen(arm: SerialArm, q: Array) -> NDArray[np.bool_]:
    """Whether the sphere lies in the sensor's field, in front of its stem."""
    T = kr150.T_SENSOR_BASE @ arm.fk(q)
    ball = (T @ np.append(kr150.BALL, 1.0))[:, :3]
    stem = T[:, :3, 3] - ball
    low, high = np.array(FIELD_M).T
    toward = np.sum(stem * -ball, axis=1)
    toward /= np.linalg.norm(stem, axis=1) * np.linalg.norm(ball, axis=1)
    return np.asarray(np.all((ball > low) & (ball < high), axis=1) & (toward < NEAREST_TURN))


def d_optimal(arm: SerialArm, q: Array, count: int) -> list[int]:
    """Poses that maximise the determinant of the information about the drift."""
    J = arm.parameter_jacobian(q, kr150.BALL)[:, :3] / SIGMA_M
    scale = np.sqrt(np.diag(drift_prior(arm)))
    gain = np.einsum("mci,mcj->mij", J * scale, J * scale)

    def best(information: Array, taken: list[int]) -> int:
        value = np.linalg.slogdet(information + gain)[1]
        value[taken] = -np.inf
        return int(np.argmax(value))

    chosen: list[int] = []
    for _ in range(count):
        chosen.append(best(np.eye(len(scale)) + gain[chosen].sum(axis=0), chosen))
    for _ in range(5):
        before = list(chosen)
        for place in range(count):
            others = chosen[:place] + chosen[place + 1 :]
            chosen[place] = best(np.eye(len(scale)) + gain[others].sum(axis=0), others)
        if chosen == before:
            break
    return chosen


def check_poses(arm: SerialArm, q: Array) -> Array:
    """Poses whose tool is over the table and points down or forward, as they come."""
    T = arm.fk(q)
    tool = (T @ np.append(kr150.TOOL, 1.0))[:, :3]
    low, high = np.array([0.9, -1.4, 0.4]), np.array([2.6, 1.4, 2.0])
    axis = T[:, :3, 2]
    useful = np.maximum(axis[:, 0], -axis[:, 2]) > np.cos(np.radians(40.0))
    return np.asarray(q[np.all((tool > low) & (tool < high), axis=1) & useful][:CHECK])


def main() -> None:
    """Write the file."""
    arm = load_robot("kr150_r3100")
    rng = np.random.default_rng(150)
    q = candidates(arm, rng, 3_000_000)
    visible = q[seen(arm, q)]
    cycle = d_optimal(arm, visible, CYCLE)
    rest = [i for i in d_optimal(arm, visible, REFERENCE + CYCLE) if i not in cycle]
    reference = cycle + rest[: REFERENCE - CYCLE]
    print(f"{len(visible)} poses see the sphere; chosen {reference}")
    lines = ["kind," + ",".join(f"q{i + 1}_deg" for i in range(arm.n))]
    kinds = ["cycle"] * CYCLE + ["reference"] * (REFERENCE - CYCLE)
    rows = [*zip(kinds, visible[reference], strict=True)]
    rows += [("check", pose) for pose in check_poses(arm, q)]
    lines += [f"{kind}," + ",".join(f"{x:.2f}" for x in np.degrees(pose)) for kind, pose in rows]
    FILE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
