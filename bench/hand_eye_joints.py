# SPDX-License-Identifier: Apache-2.0
"""What a camera's and a tracker's verdict say of joints that err, beside what these errors do.

The truth is a UR10 whose joints turn as its gears make them, each run set elsewhere on them; what
is solved from knows the nominal arm alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bench.hand_eye_cell import IN_HAND, TO_HAND, BoardCell, TruePose, reached
from bench.laser_tracker import six_axis_cell
from bench.measured_runs import Q_NEAR
from bench.tables import Goal, Table
from robocal_ros.cell_sim.gears import GearErrors, ur10_gears
from robocal_ros.ground.errors import LimitError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye import camera, tracker
from robocal_ros.hand_eye.camera_data import Mount, PosePairs
from robocal_ros.hand_eye.camera_fit import GivenNoise, fit_pairs
from robocal_ros.hand_eye.result import increment
from robocal_ros.hand_eye.tracker_scan import solve_classic
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import HONEST, SIZE_URAD, JointErrors, ShotJoints
from robocal_ros.kinematics.robots import load_robot

RUNS = 200
POSES = 15
AWAY_RAD = 0.15  # how far the joints of two runs stand apart, each way
REPEAT_RAD = 1e-5  # of joints that come back
WIDE_RAD, NARROW_RAD = 0.5, 0.15  # by which boards are tilted, each way
SIZE_RAD = 1e-6 * SIZE_URAD


@dataclass(frozen=True, eq=False)
class GearedArm:
    """A nominal arm, the joints of which turn besides as gears make them."""

    nominal: SerialArm
    gears: GearErrors

    def fk(self, q: Array) -> Array:
        """True flange poses (m, 4, 4) at readings (m, n)."""
        return self.nominal.fk(q + self.gears.at(q))


def ur10(rng: np.random.Generator, erring: bool = True) -> GearedArm:
    """A UR10 with its gears, set anywhere on them; or without."""
    gears = ur10_gears()
    phase = rng.uniform(-np.pi, np.pi, gears.phase.shape)
    amplitude = gears.amplitude if erring else np.zeros_like(gears.amplitude)
    return GearedArm(load_robot("ur10"), replace(gears, phase=phase, amplitude=amplitude))


@dataclass(frozen=True)
class Said:
    """Squared error over what is told, of one of six numbers: as it came, and as was foretold.

    ``both``: as it came over what is told with what joints add. ``size_rad``: of a joint, as said.
    """

    came: float
    foretold: float
    both: float
    size_rad: float

    @classmethod
    def of(cls, step: Array, told: Array, said: JointErrors | None) -> "Said":
        """From the way (6,) to the truth. Raises `ValueError` where nothing was said."""
        if said is None:
            raise ValueError("the joints are known, and the model holds nothing of what they err")
        came, both = (
            float(step @ np.linalg.solve(C, step)) / 6.0 for C in (told, told + said.covariance)
        )
        return cls(came, said.factor**2, both, said.size_rad)


Run = Callable[[GearedArm, np.random.Generator], Said]


def camera_cell(mount: Mount) -> BoardCell:
    """A camera before a board; to hand they change places."""
    cell = BoardCell()
    return cell if mount == IN_HAND else BoardCell(TO_HAND, camera=cell.board, board=cell.camera)


def camera_pairs(
    cell: BoardCell, arm: GearedArm, tilt_rad: float, rng: np.random.Generator
) -> PosePairs:
    """From random views in reach: poses by the nominal arm, and what the camera sees there."""
    stood: list[Array] = []
    while len(stood) < POSES:
        wanted = cell.flange(cell.views(rng, 1, tilt_rad)).matrices()[0]
        try:
            stood.append(reached(arm.nominal, Q_NEAR, wanted))
        except LimitError:
            continue
    q = np.array(stood)
    T = arm.fk(q + REPEAT_RAD * rng.standard_normal(q.shape))
    views = cell.seen_from(TruePose(Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3]))
    names, mount = tuple(map(str, range(POSES))), "in-hand" if cell.mount == IN_HAND else "to-hand"
    joints, seen = ShotJoints(arm.nominal, q), cell.read_board(views, rng)
    return PosePairs(arm.nominal.fk(q), seen, names, mount, joints=joints)


def camera_run(mount: Mount, tilt_rad: float) -> Run:
    """All noise is found from the pairs."""
    cell = camera_cell(mount)

    def run(arm: GearedArm, rng: np.random.Generator) -> Said:
        fit = fit_pairs(camera_pairs(cell, arm, tilt_rad, rng))
        said = camera.joint_errors(fit, SIZE_RAD, GivenNoise())
        step = increment(fit.at.X, cell.camera.matrices()[0], np.zeros(3))
        return Said.of(step, fit.covariance[:6, :6], said)

    return run


def tracker_run(arm: GearedArm, rng: np.random.Generator) -> Said:
    """A line laser and a laser tracker, in another posture each time.

    Raises `RobocalError` where the scan is bent so far that cube and sphere are not recognised.
    """
    q = Q_NEAR + AWAY_RAD * rng.uniform(-1.0, 1.0, 6)
    cell = replace(six_axis_cell(arm.nominal, q), true=arm)
    noise, data, target = cell.sizes.noise, cell.measure(rng), cell.told(rng)
    first = solve_classic(data, target, noise)
    problem, found = tracker.solve_best(first)
    said = tracker.joint_errors(problem, found, SIZE_RAD)
    step = increment(found.state.T_flange_sensor, cell.T_flange_sensor, np.zeros(3))
    return Said.of(step, found.covariance[tracker.SENSOR, tracker.SENSOR], said)


def repeated(run: Run, runs: int, erring: bool = True) -> tuple[Said, int]:
    """Means of runs, each with other gears and poses; and how many were refused."""
    rows = []
    for seed in range(runs):
        rng = np.random.default_rng([59, seed])
        try:
            one = run(ur10(rng, erring), rng)
        except RobocalError:
            continue
        rows.append([one.came, one.foretold, one.both, one.size_rad])
    return Said(*np.mean(rows, axis=0).tolist()), runs - len(rows)


COLUMNS = (
    "what is seen from", "joints err", "refused", "came", "foretold", "with it", "off by a factor",
    "said of a joint, urad",
)  # fmt: skip
REMARK = (
    "Simulated, each run with other gears and poses: a UR10's gears as identified, each set "
    "elsewhere on them, or none; all joints scatter by 10 urad. Squared error of the six numbers "
    "of a mount over the covariance that is told, 1 expected: as it came, as the verdict foretells "
    "it, and over the covariance with what joints add; by what factor that is off. What is said of "
    "a joint is 300 urad, or what makes all that residuals show. "
)


def _add(table: Table, words: str, run: Run, runs: int) -> None:
    for erring in (True, False):
        found, refused = repeated(run, runs, erring)
        off = max(found.both, 1.0 / found.both)
        table.add(
            words, "yes" if erring else "no", refused, found.came, found.foretold, found.both,
            Goal(off, HONEST) if erring else off, 1e6 * found.size_rad,
        )  # fmt: skip


def camera_table() -> Table:
    """Of a camera."""
    remark = f"{REMARK}{RUNS} runs of {POSES} poses; all noise from the residuals."
    table = Table(
        "hand_eye_camera_joints", "A camera on joints that err: what is told of it", COLUMNS, remark
    )
    for mount, words in ((IN_HAND, "in hand"), (TO_HAND, "to hand")):
        for tilt_rad in (WIDE_RAD, NARROW_RAD):
            degrees = f"{np.degrees(tilt_rad):.0f} deg"
            _add(table, f"{words}, tilts to {degrees}", camera_run(mount, tilt_rad), RUNS)
    return table


def tracker_table() -> Table:
    """Of a line laser by laser tracker."""
    remark = f"{REMARK}{RUNS} runs; refused: cube or sphere are not what the tracker saw."
    table = Table(
        "hand_eye_tracker_joints",
        "Hand-eye by laser tracker on joints that err: what is told of it",
        COLUMNS,
        remark,
    )
    _add(table, "arcs of joints 5 and 6, a straight scan", tracker_run, RUNS)
    return table
