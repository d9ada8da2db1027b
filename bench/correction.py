# SPDX-License-Identifier: Apache-2.0
"""The joint correction: how fast, beside Newton loops of Pinocchio and KDL, and how exact.

All of it is simulated: an arm whose parameters have drifted and a tool that is bent, with the
postures drawn at random. Times are processor time of one thread (see `speed`), medians of runs
that take turns.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.speed import medians, pinocchio_model
from bench.tables import Cell, Goal, Table
from robocal_ros.cell_sim import kr150
from robocal_ros.correction import solution
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.damping import LENGTH
from robocal_ros.correction.interface import JointCommand, OfferedModel, TrajectoryCommand
from robocal_ros.correction.joint_correction import (
    CorrectionResult,
    JointCorrection,
    StagedCorrection,
    pack_model,
)
from robocal_ros.correction.limiter import OFFSET, SLIDING, TURNING, OffsetLimiter
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad, JointFunctions
from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.kinematics.universal_robots import link_transform

Array = NDArray[np.float64]

TOOL = frames.transform(frames.exp_rotation([0.3, 0.2, 0.1]), [0.05, 0.02, 0.25])
ROBOTS = ("kr150_r3100", "ur10", "bx200l")
POINTS, SINGLE = 10_000, 1000
RANGE = 2.0  # rad, of each joint either way
LARGEST_CONDITION = 1e3  # of the geometric Jacobian at the tool, m and rad
CLOSE = 1e-9  # m and rad
DRIFT_M = 1e-3
CASES = ((0.0, 0.0), (2e-3, 0.5), (20e-3, 7.0))  # the tool's change: m, deg
LARGEST_SHIFT = np.radians(10.0)  # of a joint: twice what the node allows for a changed tool


@dataclass(frozen=True)
class Case:
    """A drifted arm with a bent tool, and postures (m, n) with a condition below the limit."""

    reference: SerialArm
    actual: SerialArm
    q: Array


def make_case(name: str, shift_m: float, turn_deg: float) -> Case:
    """Drift that moves the flange by 1 mm at most, and a tool shifted and turned by so much."""
    rng = np.random.default_rng(1)
    reference = replace(load_robot(name), T_flange_tool=TOOL)
    chosen = reference.parameters
    change = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 3e-4, 2e-4)
    q = rng.uniform(-RANGE, RANGE, (POINTS, reference.n))

    def drifted(scale: float) -> SerialArm:
        return reference.with_mdh(chosen.add(reference.mdh, scale * change))

    moved = np.linalg.norm((drifted(1.0).fk(q) - reference.fk(q))[:, :3, 3], axis=1).max()
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn = frames.exp_rotation(axis * np.radians(turn_deg))
    bend = frames.transform(turn, direction * shift_m)
    actual = replace(drifted(DRIFT_M / moved), T_flange_tool=TOOL @ bend)
    J = actual.jacobian(q)
    lever = (actual.fk(q)[:, :3, :3] @ actual.T_flange_tool[:3, 3])[..., None]
    J[:, :3] += np.cross(J[:, 3:], lever, axis=1)
    return Case(reference, actual, q[np.linalg.cond(J) < LARGEST_CONDITION])


def in_full(found: CorrectionResult) -> NDArray[np.bool_]:
    """Which points were corrected in all directions."""
    return found.converged & ~found.weak


# ---- Speed


def pinocchio_loop(case: Case, q: Array) -> Callable[[], Array]:
    """Newton's method as fast as Pinocchio's Python interface lets it: until 1 nm and 1 nrad."""
    import pinocchio as pin
    from scipy.linalg.lapack import dgesv

    (taught, tool), (model, frame) = (pinocchio_model(a) for a in (case.reference, case.actual))
    goals, data = taught.createData(), model.createData()
    out, local = np.empty_like(q), pin.ReferenceFrame.LOCAL

    def run() -> Array:
        for i in range(len(q)):
            x = q[i]
            pin.forwardKinematics(taught, goals, x)
            goal = pin.updateFramePlacement(taught, goals, tool)
            for _ in range(10):
                pin.computeJointJacobians(model, data, x)
                e = pin.log6(pin.updateFramePlacement(model, data, frame).actInv(goal)).vector
                if abs(e).max() <= CLOSE:
                    break
                x = x + dgesv(pin.getFrameJacobian(model, data, frame, local), e)[2]
            out[i] = x
        return out

    return run


def kdl_loop(case: Case, q: Array) -> Callable[[], Array]:
    """KDL's compiled Newton-Raphson solver with its pseudo-inverse, until 1 nm and 1 nrad."""
    import PyKDL as kdl  # noqa: N813

    def frame(T: Array) -> object:
        return kdl.Frame(kdl.Rotation(*T[:3, :3].ravel().tolist()), kdl.Vector(*T[:3, 3].tolist()))

    def chain(arm: SerialArm) -> "kdl.Chain":
        made = kdl.Chain()
        made.addSegment(kdl.Segment(kdl.Joint(kdl.Joint.Fixed), frame(arm.T_base_root)))
        for i in range(arm.n):
            tip = link_transform(arm.mdh[i])
            if i == arm.n - 1:
                tip = tip @ arm.T_flange_tool
            joint = kdl.Joint(kdl.Joint.RotZ, float(arm.sign[i]))
            made.addSegment(kdl.Segment(joint, frame(tip)))
        return made

    taught, actual = chain(case.reference), chain(case.actual)
    forward, ahead = (kdl.ChainFkSolverPos_recursive(c) for c in (taught, actual))
    velocity = kdl.ChainIkSolverVel_pinv(actual)
    solver = kdl.ChainIkSolverPos_NR(actual, ahead, velocity, 10, CLOSE)
    joints, found, goal = kdl.JntArray(q.shape[1]), kdl.JntArray(q.shape[1]), kdl.Frame()
    out, n = np.empty_like(q), q.shape[1]
    kept = taught, actual, ahead, velocity  # KDL's solvers do not keep what they refer to

    def run() -> Array:
        assert kept
        for i, row in enumerate(q.tolist()):
            for j in range(n):
                joints[j] = row[j]
            forward.JntToCart(joints, goal)
            solver.CartToJnt(joints, goal, found)
            out[i] = [found[j] for j in range(n)]
        return out

    return run


def compiled_entry(correction: JointCorrection, q: Array) -> Callable[[], Array]:
    """The compiled code called from Python, once for each point, into arrays that are there."""
    n = q.shape[1]
    points, out = q[:, None].copy(), np.empty((len(q), 1, n + solution.REPORT))
    given = correction.largest, correction.free_axis, correction.work

    def run() -> Array:
        for point, into in zip(points, out, strict=True):
            solution.correct_batch(point, *given, into)
        return out

    return run


def with_functions(arm: SerialArm) -> SerialArm:
    """A KR 150 whose joints have functions as large as a real UR10's, and wind under its weight."""
    n, step = arm.n, float(np.radians(2.5))
    table = np.random.default_rng(2).uniform(-350e-6, 350e-6, (n, int(4.0 * np.pi / step)))
    functions = JointFunctions(
        np.full(n, -2.0 * np.pi), np.full(n, step), table, 1.0 / kr150.BODY.stiffness
    )
    return replace(arm, functions=functions, load=ArmLoad(kr150.BODY.mass, kr150.BODY.centre))


def speed_table() -> Table:
    """One point, and a batch, beside loops that solve the same."""
    case = make_case("kr150_r3100", 2e-3, 0.5)
    correction = JointCorrection.between(case.reference, case.actual)
    free = JointCorrection.between(case.reference, case.actual, free_axis=True)
    full = JointCorrection.between(case.reference, with_functions(case.actual))
    # where all of them find the solution that is near
    found = correction.correct(case.q)
    near = np.flatnonzero(in_full(found) & (np.abs(found.joint_shift).max(axis=1) < 0.1))
    q = case.q[near[:SINGLE]]
    rivals = {"Pinocchio": pinocchio_loop(case, q)}
    with contextlib.suppress(ImportError):
        rivals["KDL"] = kdl_loop(case, q)
    for name, run in rivals.items():
        np.testing.assert_allclose(run(), correction.correct(q).q, atol=1e-5, err_msg=name)
    batch = np.resize(case.q[near], (POINTS, 6))
    ours: dict[str, tuple[Callable[[], object], int, float | None]] = {
        "one point, compiled entry": (compiled_entry(correction, q), len(q), 0.2),
        "one point, full model": (compiled_entry(full, q), len(q), 0.25),
        "one point, free axis": (compiled_entry(free, q), len(q), None),
        "one point, with a whole report": (
            lambda: [correction.correct(row) for row in q], len(q), None,
        ),
        f"{POINTS} points": (lambda: correction.correct(batch), POINTS, 0.05),
        f"{POINTS} points, full model": (lambda: full.correct(batch), POINTS, 0.06),
        f"{POINTS} points, free axis": (lambda: free.correct(batch), POINTS, None),
    }  # fmt: skip
    t = medians({name: run for name, (run, _, _) in ours.items()} | rivals, rounds=5)
    table = Table(
        "correction_speed",
        "Joint correction of one point and of a batch (KR 150, 1 mm drift, tool 2 mm and 0.5 deg)",
        ("task", "ours, us/point", *(f"{r}, us/point" for r in rivals), "ratio", "goal")
        + (("ratio to KDL",) if "KDL" in rivals else ()),
        "From Python, one point at a time or all at once. Compiled entry: solution.correct_batch "
        "with arrays made before; with a whole report: JointCorrection.correct. Pinocchio: "
        "Newton's method in Python on its kinematics, Jacobian and logarithm, with LAPACK; KDL: "
        "its compiled solver. Both stop at 1 nm and 1 nrad, ours at the rounding floor. Same "
        "models and postures, and the same joints found to 10 urad. Pinocchio and KDL have no "
        "free axis: theirs is the time for six equations; and no functions: theirs is without. "
        "Full: corrected to a drifted arm with functions of 2.5 deg and compliances on all joints."
        + ("" if "KDL" in rivals else " PyKDL is not installed: it is left out."),
    )
    for name, (_, count, limit) in ours.items():
        mine, others = t[name] / count * 1e6, [t[r] / len(q) * 1e6 for r in rivals]
        ratio = mine / others[0]
        kdl = (mine / others[1],) if "KDL" in rivals else ()
        table.add(name, mine, *others, ratio, limit and Goal(ratio, limit), *kdl)
    return table


# ---- A trajectory of 10 000 points


class Settled:
    """A session that corrects with a drifted model, its blend ended."""

    def __init__(self, case: Case, home: Array) -> None:
        nominal = replace(case.reference, T_flange_tool=np.eye(4))
        arm = case.actual
        described = load_description("kr150_r3100")
        config = CorrectionConfig(
            velocity_limits=described.max_velocity, acceleration_limits=described.max_acceleration
        )
        self.session = CorrectionSession(nominal, nominal, "s1", config)
        self.names, self.now, self.at = nominal.joint_names, 100.0, home
        self.session.offer_model(
            OfferedModel(
                robot=nominal.name,
                serial="s1",
                model_hash=nominal.model_hash,
                revision=1,
                accepted=True,
                joint_names=self.names,
                mdh=arm.mdh,
            )
        )
        self.rest()
        self.session.enable(True)
        while not self.session.status().settled:
            self.read()
            self.at = self.session.target(JointCommand(self.names, home), self.now).position
        self.now += 1000.0
        self.rest()

    def read(self, later_s: float = 0.002) -> None:
        """Hear where the robot is, a little later."""
        self.now += later_s
        self.session.reading(JointCommand(self.names, self.at), self.now)

    def rest(self) -> None:
        """Nothing is commanded, and the robot stands."""
        for _ in range(20):
            self.read(0.02)
        self.session.look(self.now, 0)

    def run(self, trajectory: TrajectoryCommand) -> TrajectoryCommand:
        """Correct a trajectory that begins at home, where the robot stands."""
        return self.session.trajectory(trajectory, self.now)


def trajectory_table() -> Table:
    """Whole trajectories through the session."""
    case = make_case("kr150_r3100", 2e-3, 0.5)
    home, reach = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3]), np.array([1, 0.5, 0.4, 1, 0.5, 2])
    t = np.arange(POINTS) * 0.01
    speed = 2.0 * np.pi / np.array([40.0, 25.0, 20.0, 50.0, 20.0, 10.0])
    angle = t[:, None] * speed
    q, qd = home + reach * np.sin(angle), reach * speed * np.cos(angle)
    qdd = -reach * speed**2 * np.sin(angle)
    settled = Settled(case, home)
    little = case.reference.mdh + 0.12 * (case.actual.mdh - case.reference.mdh)
    less = Settled(replace(case, actual=case.reference.with_mdh(little)), home)
    plain = TrajectoryCommand(settled.names, q, t)
    rated = replace(plain, velocity=qd, acceleration=qdd)
    models = pack_model(case.reference), pack_model(case.actual)
    bounds = np.radians([[0.24] * 6, [5.0] * 6])

    def staged(free_axis: bool) -> Callable[[], object]:
        stage = StagedCorrection(*models, *bounds, free_axis=free_axis)
        return lambda: stage.rates(q, qd, qdd, stage.correct(q))

    tasks: dict[str, Callable[[], object]] = {
        "positions, drift of 0.12 mm": lambda: less.run(plain),
        "positions": lambda: settled.run(plain),
        "positions, velocities, accelerations": lambda: settled.run(rated),
        "the same with a changed tool, without the session": staged(free_axis=False),
        "that with a free axis, rates by differences": staged(free_axis=True),
    }
    found = medians(tasks, rounds=5)
    table = Table(
        "correction_trajectory",
        f"A trajectory of {POINTS} points and six joints (KR 150, drift below 1 mm)",
        ("task", "ms", "goal, ms"),
        "Arrays in, arrays out: messages are not part of it. With a session: the drifted arm, all "
        "its checks included. Without: arm and tool (2 mm, 0.5 deg), one after the other.",
    )
    for index, (name, seconds) in enumerate(found.items()):
        ms = seconds * 1e3
        table.add(name, ms, Goal(ms, 10.0) if index < 2 else None)
    return table


# ---- How exact


def reach_table() -> Table:
    """Newton iterations, and what is left at the tool."""
    table = Table(
        "correction_reach",
        "Where the joint correction gets, and after how many iterations",
        (
            "robot", "tool", "equations", "postures", "in full", "with 1", "2", "3", "4", "5",
            "more", "left, nm", "goal", "left, nrad", "goal ",
        ),
        f"Drift of {DRIFT_M * 1e3:g} mm; random postures with a condition below "
        f"{LARGEST_CONDITION:g} (Jacobian at the tool, m and rad). In full: no joint needs more "
        f"than {np.degrees(LARGEST_SHIFT):.0f} deg; the others are corrected in part. An iteration "
        "is one Jacobian and its factorisation, and each goes on to the rounding floor: more than "
        "three where a weak direction is damped, and often with a free axis. Left: by forward "
        "kinematics, with a free axis the angle of the axis.",
    )  # fmt: skip
    for name in ROBOTS:
        for shift_m, turn_deg in CASES:
            case = make_case(name, shift_m, turn_deg)
            tool = f"{shift_m * 1e3:g} mm, {turn_deg:g} deg"
            for free in (False, True):
                table.add(name, tool, 5 if free else 6, len(case.q), *_reach(case, free))
    return table


def _reach(case: Case, free: bool) -> Sequence[Cell | Goal]:
    correction = JointCorrection.between(case.reference, case.actual, LARGEST_SHIFT, free)
    found = correction.correct(case.q)
    whole = in_full(found)
    counts = np.bincount(found.iterations[whole], minlength=11)
    goal = case.reference.fk(case.q[whole]) @ case.reference.T_flange_tool
    T = case.actual.fk(found.q[whole]) @ case.actual.T_flange_tool
    left = float(np.linalg.norm((T - goal)[:, :3, 3], axis=1).max())
    turn = frames.log_rotation(goal[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
    if free:
        turn = np.cross(goal[:, :3, 2], T[:, :3, 2])
    angle = float(np.linalg.norm(turn, axis=1).max())
    return (
        int(np.sum(whole)), *(int(c) for c in counts[1:6]), int(counts[6:].sum()),
        left * 1e9, Goal(left * 1e9, 1.0), angle * 1e9, Goal(angle * 1e9, 1.0),
    )  # fmt: skip


def round_trip_table() -> Table:
    """From taught joints to corrected ones and back."""
    table = Table(
        "correction_round_trip",
        "From taught joints to corrected ones and back",
        ("robot", "tool", "equations", "postures", "median, rad", "beyond 1e-12 rad", "goal"),
        "Postures as above, of which the correction and the one with the models exchanged are "
        "made in full. Six equations: the exchanged correction undoes it. Five: refined as in the "
        "node; what is beyond lies near a singularity of the five: at most one in 200, for a tool "
        "within the node's bounds.",
    )
    for name in ROBOTS:
        for shift_m, turn_deg in CASES:
            case = make_case(name, shift_m, turn_deg)
            for free in (False, True):
                tool = f"{shift_m * 1e3:g} mm, {turn_deg:g} deg"
                error = _round_trip(case, free)
                beyond, allowed = int(np.sum(error > 1e-12)), len(error) // 200 if free else 0
                goal = None if free and shift_m > 10e-3 else Goal(beyond, allowed)
                median = float(np.median(error)) if len(error) else None
                table.add(
                    name, tool, 5 if free else 6, len(error), median, beyond, goal
                )  # fmt: skip
    return table


def _round_trip(case: Case, free: bool) -> Array:
    correction = JointCorrection.between(case.reference, case.actual, LARGEST_SHIFT, free)
    there = correction.correct(case.q)
    back = correction.inverse().correct(there.q)
    whole = in_full(there) & in_full(back)
    taught = back.q
    if free:
        models = pack_model(case.reference), pack_model(case.actual)
        largest = np.full((2, case.q.shape[1]), LARGEST_SHIFT)
        stage = StagedCorrection(*models, *largest, free_axis=True)
        staged = stage.correct(case.q)
        whole, taught = whole & staged.whole, stage.uncorrect(staged.q)
    return np.asarray(np.abs(taught - case.q)[whole].max(axis=1))


# ---- Singularities


CROSSED = {"wrist": 4, "elbow": 2, "shoulder": 1}  # the joint that crosses it
BENT = ((0.0, 0.0), (2e-3, 0.5), (9e-3, 3.5))  # m, deg
CROSSINGS, CROSSING_S, CROSSING_SPEED, PERIOD_S = 100, 0.6, np.radians(60.0), 0.002
DRIFT_CROSSINGS = 400  # of the wrist, with a drift alone
BOUNDS = np.radians([[0.24] * 6, [5.0] * 6])  # of a drift and of a tool, as in the node
OFF_MM = 5.0  # more than uncorrected


def crossing_table() -> Table:
    """What the correction does where a direction is weak, before the limiter and after it."""
    table = Table(
        "correction_crossings",
        "Singularities that are crossed at 60 deg/s",
        (
            "robot", "crossed", "tool", "crossings", "solved", "wanted, deg/s", "goal",
            "median, mm left", "most, mm left", "goal ", "off, mm", "goal  ",
            "out, deg/s", "goal   ",
        ),
        f"All joints move, the fastest at 60 deg/s for {CROSSING_S:g} s; {1 / PERIOD_S:g} Hz; "
        "drifts of 0.004 to 0.12 mm at the flange. Wanted: the fastest change of a joint's "
        "offset. Left: position error at the tool; of all crossings the worst instant of each. "
        "Off: the tool's distance from where it was taught, after the limiter, at most; "
        "uncorrected it is what the tool is bent by. Out: the fastest change after the limiter.",
    )  # fmt: skip
    for name in ROBOTS:
        for crossed, joint in CROSSED.items():
            for shift_m, turn_deg in BENT:
                tool = f"{shift_m * 1e3:g} mm, {turn_deg:g} deg"
                drift_alone = crossed == "wrist" and shift_m == 0.0
                table.add(name, crossed, tool, *_cross(name, joint, shift_m, turn_deg, drift_alone))
    return table


def _tool_jacobian(arm: SerialArm, q: Array) -> Array:
    J = arm.jacobian(q)
    lever = (arm.fk(q)[:, :3, :3] @ arm.T_flange_tool[:3, 3])[..., None]
    J[:, :3] = (J[:, :3] + np.cross(J[:, 3:], lever, axis=1)) / LENGTH
    return np.asarray(J)


def _middle(arm: SerialArm, joint: int, rng: np.random.Generator) -> Array:
    """A posture in which turning ``joint`` alone leads through a singularity, of one kind."""
    while True:
        q = np.tile(rng.uniform(-RANGE, RANGE, arm.n), (2001, 1))
        q[:, 4] = np.where(joint == 4, 0.0, np.pi / 3.0)
        if joint == 4:
            q = q[:1]
        else:
            q[:, joint] = np.linspace(-RANGE, RANGE, len(q))
            sign = np.sign(np.linalg.det(_tool_jacobian(arm, q)))
            q = q[:-1][sign[1:] != sign[:-1]][:1]
        if len(q) and np.linalg.svd(_tool_jacobian(arm, q), compute_uv=False)[0, 4] > 0.25:
            return np.asarray(q[0])


def _cross(
    name: str, joint: int, shift_m: float, turn_deg: float, drift_alone: bool
) -> Sequence[Cell | Goal]:
    rng = np.random.default_rng(2)
    case, wanted, out, left, off, solved = make_case(name, 0.0, 0.0), 0.0, 0.0, [], 0.0, 0
    taught, turning = case.reference, np.zeros(6, dtype=np.bool_)
    t = np.arange(-CROSSING_S / 2, CROSSING_S / 2, PERIOD_S)
    for _ in range(count := DRIFT_CROSSINGS if drift_alone else CROSSINGS):
        share = 10.0 ** rng.uniform(np.log10(4e-6), np.log10(1.2e-4)) / DRIFT_M
        direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        turn = frames.exp_rotation(axis * np.radians(turn_deg))
        actual = taught.with_mdh(taught.mdh + share * (case.actual.mdh - taught.mdh))
        actual = replace(actual, T_flange_tool=TOOL @ frames.transform(turn, shift_m * direction))
        way, middle = rng.uniform(-1.0, 1.0, 6), _middle(taught, joint, rng)
        way[joint] = rng.choice([-1.0, 1.0])
        q = middle + CROSSING_SPEED * t[:, None] * way
        stage = StagedCorrection(pack_model(taught), pack_model(actual), *BOUNDS)
        found = stage.correct(q)
        good = found.arm.converged if found.tool is None else found.tool.converged
        solved += int(good.all() and found.arm.converged.all())
        offset = found.q - q
        limiter = OffsetLimiter(turning, TURNING, SLIDING)
        limiter.state[OFFSET] = offset[0]
        made, _ = limiter.follow(offset, t - t[0], np.full(len(t), CROSSING_SPEED), np.ones(6))
        goal = (taught.fk(q) @ TOOL)[:, :3, 3]
        tip, limited = ((actual.fk(q + o) @ actual.T_flange_tool)[:, :3, 3] for o in (offset, made))
        left.append(float(np.linalg.norm(tip - goal, axis=1).max()))
        off = max(off, float(np.linalg.norm(limited - goal, axis=1).max()))
        rates = (float(np.abs(np.diff(o, axis=0)).max()) / PERIOD_S for o in (offset, made))
        wanted, out = (max(a, b) for a, b in zip((wanted, out), rates, strict=True))
    rate, most, fastest = np.degrees(wanted), max(left) * 1e3, np.degrees(out)
    return (
        count, solved, rate, Goal(rate, 2.0) if drift_alone else None,
        float(np.median(left)) * 1e3, most, Goal(most, 0.04) if drift_alone else None,
        off * 1e3, Goal(off * 1e3, 0.04 if drift_alone else shift_m * 1e3 + OFF_MM),
        fastest, Goal(fastest, 2.0 if drift_alone else 10.0 + 1e-6),
    )  # fmt: skip


def tables() -> Sequence[Table]:
    """All tables of this module."""
    return [
        speed_table(), trajectory_table(), reach_table(), round_trip_table(), crossing_table(),
    ]  # fmt: skip
