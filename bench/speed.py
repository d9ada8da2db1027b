# SPDX-License-Identifier: Apache-2.0
"""Speed beside Pinocchio, pybotics and scipy: the same task, the same start, in one run.

Times are processor time of one thread (what else runs on the machine does not count), medians of
runs that take turns.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.real_data import campaign, data_folder
from bench.tables import Cell, Goal, Table
from robocal_ros.bags.ur10_campaigns import halves
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.gears import gear_errors
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel, identify
from robocal_ros.identification.cell_model import CellProblem, make_layout
from robocal_ros.identification.full_model import FullIdentification, identify_full
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad, JointFunctions
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.universal_robots import link_transform

Array = NDArray[np.float64]

POSES = 10_000
SAMPLES = 1000
NOISE_M = 5e-5
TARGETS = np.array([[0.10, -0.05, 0.20], [-0.15, 0.10, 0.05], [0.05, 0.20, 0.30]])
HUBER_M = 2.0 * NOISE_M


def medians(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median duration of each task, s; one untimed call before, then they take turns."""
    for task in tasks.values():
        task()
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, task in tasks.items():
            start = time.thread_time()
            task()
            times[name].append(time.thread_time() - start)
    return {name: float(np.median(found)) for name, found in times.items()}


# ---- Forward kinematics and Jacobian


def kinematics_table() -> Table:
    """Forward kinematics and geometric Jacobian of 10 000 poses."""
    arm = load_robot("kr150_r3100")
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (POSES, arm.n))
    pin_fk, pin_jacobian = _pinocchio(arm, q)
    py_fk, py_jacobian = _pybotics_kinematics(arm, q)
    np.testing.assert_allclose(pin_fk(), arm.fk(q), atol=1e-12)
    np.testing.assert_allclose(pin_jacobian(), arm.jacobian(q), atol=1e-12)
    np.testing.assert_allclose(py_fk(), arm.fk(q[: POSES // 10]), atol=1e-12)
    table = Table(
        "kinematics",
        f"Forward kinematics and Jacobian of {POSES} poses (KR 150)",
        ("task", "ours, ms", "Pinocchio loop, ms", "ratio", "goal", "pybotics loop, ms", "ratio "),
        "Loops call the library once per pose and keep each result, as a Python program does.",
    )
    for name, mine, pin, py in (
        ("forward kinematics", lambda: arm.fk(q), pin_fk, py_fk),
        ("Jacobian", lambda: arm.jacobian(q), pin_jacobian, py_jacobian),
    ):
        t = medians({"ours": mine, "pin": pin}, rounds=7)
        slow = 10.0 * medians({"py": py}, rounds=1)["py"]
        ratio = t["pin"] / t["ours"]
        goal = Goal(ratio, 5.0, at_least=True)
        table.add(name, t["ours"] * 1e3, t["pin"] * 1e3, ratio, goal, slow * 1e3, slow / t["ours"])
    return table


def pinocchio_model(arm: SerialArm) -> tuple[Any, int]:
    """Pinocchio's model of the same parameters, and its frame of the tool."""
    import pinocchio as pin

    model, before = pin.Model(), arm.T_base_root
    for i, name in enumerate(arm.joint_names):
        T = before @ link_transform(np.array([arm.mdh[i, 0], arm.mdh[i, 1], 0.0, 0.0, 0.0]))
        axis = np.array([0.0, 0.0, arm.sign[i]])
        joint = pin.JointModelRevoluteUnaligned(axis)
        model.addJoint(i, joint, pin.SE3(T[:3, :3], T[:3, 3]), name)
        before = link_transform(np.array([0.0, 0.0, *arm.mdh[i, 2:]]))
    last = before @ arm.T_flange_tool
    placement = pin.SE3(last[:3, :3], last[:3, 3])
    return model, model.addFrame(pin.Frame("tool", arm.n, placement, pin.FrameType.OP_FRAME))


def _pinocchio(arm: SerialArm, q: Array) -> tuple[Callable[[], Array], Callable[[], Array]]:
    """Loops over Pinocchio's model."""
    import pinocchio as pin

    model, frame = pinocchio_model(arm)
    data = model.createData()
    poses, jacobians = np.empty((len(q), 4, 4)), np.empty((len(q), 6, arm.n))

    def fk() -> Array:
        for k in range(len(q)):
            pin.forwardKinematics(model, data, q[k])
            poses[k] = pin.updateFramePlacement(model, data, frame).homogeneous
        return poses

    def jacobian() -> Array:
        axes = pin.LOCAL_WORLD_ALIGNED
        for k in range(len(q)):
            jacobians[k] = pin.computeFrameJacobian(model, data, q[k], frame, axes)
        return jacobians

    return fk, jacobian


def _pybotics_kinematics(
    arm: SerialArm, q: Array
) -> tuple[Callable[[], Array], Callable[[], Array]]:
    """Loops over pybotics' model; a tenth of the poses, which is slow enough."""
    robot, stretched = _pybotics_robot(arm), _with_still_joint(arm, q[: POSES // 10])

    def fk() -> Array:
        return np.array([robot.fk(row) for row in stretched])

    def jacobian() -> Array:
        return np.array([robot.jacobian_world(row) for row in stretched])

    return fk, jacobian


def _pybotics_robot(arm: SerialArm, target: Array | None = None) -> "object":
    """The same model as a pybotics robot.

    Its links are Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d): ours with each a, alpha
    moved to the next link, the last ones to the tool. beta2 becomes a joint that stands still
    between the second and the third: Rot(y, beta) = Rot(x, -90) Rot(z, beta) Rot(x, 90).
    """
    from pybotics.kinematic_chain import MDHKinematicChain
    from pybotics.robot import Robot
    from pybotics.tool import Tool

    d, theta, a, alpha, beta = arm.mdh.T
    quarter = np.pi / 2.0
    links = [[0.0, 0.0, theta[0], d[0]], [alpha[0], a[0], theta[1], d[1]]]
    links += [[alpha[1] - quarter, a[1], beta[1], 0.0], [quarter, 0.0, theta[2], d[2]]]
    links += [[alpha[i - 1], a[i - 1], theta[i], d[i]] for i in range(3, arm.n)]
    tool = link_transform(np.array([0.0, 0.0, a[-1], alpha[-1], 0.0]))
    if target is not None:
        tool = tool @ frames.transform(np.eye(3), target)
    return Robot(MDHKinematicChain.from_parameters(np.array(links)), Tool(tool))


def _with_still_joint(arm: SerialArm, q: Array) -> Array:
    """Joint vectors for ``_pybotics_robot``."""
    turned = q * arm.sign
    return np.hstack([turned[:, :2], np.zeros((len(q), 1)), turned[:, 2:]])


# ---- Identification


@dataclass(frozen=True)
class Task:
    """24 parameters of a KR 150 from 1000 points of three targets; base and targets known."""

    nominal: SerialArm
    start: CellModel
    data: Measurements
    fresh: Array
    expected: Array

    def error(self, mdh: Array) -> float:
        """Largest difference, m, from the least-squares solution at fresh poses."""
        return float(np.abs(self._points(mdh) - self.expected).max())

    def _points(self, mdh: Array) -> Array:
        T = self.nominal.with_mdh(mdh).fk(self.fresh)
        return np.asarray(T[:, :3, 3] + T[:, :3, :3] @ TARGETS[0])


def make_task() -> Task:
    """Simulate the measurements (seeded); what they fit best is found by a long scipy run."""
    rng = np.random.default_rng(1)
    nominal = load_robot("kr150_r3100")
    chosen = nominal.parameters
    size = np.where(chosen.is_length, 5e-4, np.radians(0.05))
    truth = nominal.with_mdh(chosen.add(nominal.mdh, size * rng.normal(size=len(chosen))))
    q = rng.uniform(nominal.lower, nominal.upper, (SAMPLES, nominal.n))
    which = np.arange(SAMPLES) % len(TARGETS)
    tools = frames.transform(np.broadcast_to(np.eye(3), (len(TARGETS), 3, 3)), TARGETS)
    names = tuple("pqr"[: len(TARGETS)])
    position = (truth.fk(q) @ tools[which])[:, :3, 3]
    data = Measurements(
        q=q,
        position=position + NOISE_M * rng.normal(size=position.shape),
        target=tuple(names[i] for i in which),
        sample=tuple(str(i) for i in range(SAMPLES)),
        sigma=np.full(SAMPLES, NOISE_M),
    )
    start = CellModel(nominal, np.eye(4), names, tools)
    task = Task(
        nominal, start, data, rng.uniform(nominal.lower, nominal.upper, (50, 6)), np.empty(0)
    )
    best = _by_scipy(task, compiled=True, tolerance=1e-15)()
    return replace(task, expected=task._points(best))


def _ours(task: Task, robust: bool) -> Callable[[], Array]:
    def run() -> Array:
        found = identify(
            task.nominal,
            task.data,
            fit=("geometry",),
            method="lsq",
            start=task.start,
            robust=robust,
        )
        return found.cell.arm.mdh

    return run


def _by_scipy(
    task: Task, *, compiled: bool, tolerance: float = 1e-8, loss: str = "linear"
) -> Callable[[], Array]:
    """``least_squares`` with its defaults and an analytic Jacobian: ours, or the one in NumPy."""
    from scipy.optimize import least_squares

    arm, names, data = task.nominal, task.start.targets, task.data
    layout = make_layout(
        arm, names, geometry=arm.parameters.names, base=False, tool=False, orientation=False
    )
    problem = CellProblem(layout, data, names, np.ones(SAMPLES), 0.0, arm)
    index = data.target_index(names)

    def our_residual(x: Array) -> Array:
        moved = layout.retract(task.start, x)
        return np.asarray(moved.predict(data.q, index)[:, :3, 3] - data.position).ravel()

    def our_jacobian(x: Array) -> Array:
        return problem.linearise(layout.retract(task.start, x))[1].reshape(-1, len(x))

    def residual(x: Array) -> Array:
        moved = arm.with_mdh(arm.parameters.add(arm.mdh, x))
        return (numpy_points(moved, data.q, TARGETS[index]) - data.position).ravel()

    def jacobian(x: Array) -> Array:
        moved = arm.with_mdh(arm.parameters.add(arm.mdh, x))
        return numpy_jacobian(moved, data.q, TARGETS[index]).reshape(-1, len(x))

    functions = (our_residual, our_jacobian) if compiled else (residual, jacobian)
    options = {"xtol": tolerance, "ftol": tolerance, "gtol": tolerance, "loss": loss}

    def run() -> Array:
        found = least_squares(functions[0], np.zeros(24), functions[1], f_scale=HUBER_M, **options)
        return arm.parameters.add(arm.mdh, found.x)

    return run


def _motion(kind: int, value: Array) -> Array:
    """Elementary transforms (..., 4, 4) for d, theta, a, alpha, beta of these values."""
    axis = np.eye(3)[(2, 2, 0, 0, 1)[kind]] * value[..., None]
    if kind in (0, 2):
        return frames.transform(np.eye(3), axis)
    return frames.transform(frames.exp_rotation(axis), np.zeros(3))


def _links(arm: SerialArm, q: Array) -> list[Array]:
    """Transforms (m, 4, 4) of each link of an arm that turns."""
    links = []
    for i, row in enumerate(arm.mdh):
        fixed = _motion(2, row[2]) @ _motion(3, row[3]) @ _motion(4, row[4])
        turned = _motion(1, row[1] + arm.sign[i] * q[:, i])
        links.append(_motion(0, row[0]) @ turned @ fixed)
    return links


def _chained(links: list[Array], target: Array) -> list[Array]:
    """Points (m, 4) seen from the end of each link, the base first."""
    points = [np.hstack([target, np.ones((len(target), 1))])]
    for link in reversed(links):
        points.insert(0, (link @ points[0][..., None])[..., 0])
    return points


def numpy_points(arm: SerialArm, q: Array, target: Array) -> Array:
    """Target positions (m, 3) in NumPy, vectorised over the poses."""
    return _chained(_links(arm, q), target)[0][:, :3]


def numpy_jacobian(arm: SerialArm, q: Array, target: Array) -> Array:
    """Their derivatives (m, 3, k): T_{0,i} A T_{i,n} p with A = T_{i-1,i}^-1 dT_{i-1,i}."""
    links = _links(arm, q)
    points, T, before = _chained(links, target), np.eye(4), []
    for link in links:
        T = T @ link
        before.append(T)
    columns = []
    for joint, kind in arm.parameters.index:
        after = np.eye(4)
        for later in range(kind + 1, 5):
            after = after @ _motion(later, arm.mdh[joint, later])
        A = np.linalg.solve(after, _generator(kind) @ after)
        columns.append((before[joint] @ (points[joint + 1] @ A.T)[..., None])[:, :3, 0])
    return np.stack(columns, axis=2)


def _generator(kind: int) -> Array:
    """Derivative (4, 4) of an elementary transform at zero."""
    axis, G = np.eye(3)[(2, 2, 0, 0, 1)[kind]], np.zeros((4, 4))
    if kind in (0, 2):
        G[:3, 3] = axis
    else:
        G[:3, :3] = frames.skew(axis)
    return G


def _by_pybotics(task: Task) -> Callable[[], Array]:
    """The documented route of pybotics: ``least_squares`` over ``optimize_accuracy``, per target.

    Only its first twelve of some forty evaluations: a lower bound of its time.
    """
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from scipy.optimize import least_squares

    arm, index = task.nominal, task.data.target_index(task.start.targets)
    free = np.ones((arm.n + 1, 4), dtype=bool)  # columns alpha, a, theta, d
    free[0, :2] = free[1, 3] = free[2, 3] = free[3, :2] = False
    handlers = []
    for target in TARGETS:
        handler = OptimizationHandler(_pybotics_robot(arm, target))
        handler.kinematic_chain_mask = free.ravel()
        handlers.append(handler)
    rows = [index == t for t in range(len(TARGETS))]
    joints = [_with_still_joint(arm, task.data.q[r]) for r in rows]
    position = [task.data.position[r] for r in rows]

    def last_link(a: float, alpha: float, target: Array) -> Array:
        link = link_transform(np.array([0.0, 0.0, a, alpha, 0.0]))
        return link @ frames.transform(np.eye(3), target)

    def residual(x: Array) -> Array:
        errors = []
        for handler, target, q, p in zip(handlers, TARGETS, joints, position, strict=True):
            handler.robot.tool.matrix = last_link(x[-2], x[-1], target)
            errors += optimize_accuracy(x[:-2], handler, q, p)
        return np.array(errors)

    def run() -> Array:
        start = np.append(handlers[0].generate_optimization_vector(), arm.mdh[-1, 2:4])
        return _from_pybotics(arm, free, least_squares(residual, start, max_nfev=12).x)

    return run


def _from_pybotics(arm: SerialArm, free: NDArray[np.bool_], x: Array) -> Array:
    links = np.zeros(free.shape)
    links[free] = x[:-2]
    mdh = arm.mdh.copy()
    mdh[:2, 1], mdh[0, 0] = links[:2, 2], links[0, 3]
    mdh[0, 2:4] = links[1, 1], links[1, 0]
    mdh[1, 2:] = links[2, 1], links[2, 0] + np.pi / 2.0, links[2, 2]
    mdh[2:, 1], mdh[2:, 0] = links[3:, 2], links[3:, 3]
    mdh[2:5, 2], mdh[2:5, 3] = links[4:, 1], links[4:, 0]
    mdh[-1, 2:4] = x[-2:]
    return mdh


def identification_table() -> Table:
    """24 parameters from 1000 poses."""
    task = make_task()
    tasks = {
        "ours": _ours(task, robust=False),
        "ours, robust (the default)": _ours(task, robust=True),
        "scipy, Jacobian in NumPy": _by_scipy(task, compiled=False),
        "scipy, the same with Huber's loss": _by_scipy(task, compiled=False, loss="huber"),
        "scipy, our compiled Jacobian": _by_scipy(task, compiled=True),
    }
    t = medians(tasks, rounds=9)
    by_pybotics, start = _by_pybotics(task), time.thread_time()
    models = {"pybotics": by_pybotics()}
    t["pybotics"] = time.thread_time() - start
    models |= {name: run() for name, run in tasks.items()}
    table = Table(
        "identification",
        "Identification of 24 parameters of a KR 150 from 1000 poses",
        ("method", "ms", "share of scipy", "goal", "share of pybotics", "goal ", "off, mm"),
        "Base and three targets on the flange known, all 24 parameters free, no prior, start at "
        "the nominal model, noise 0.05 mm. Ours includes rank, condition and covariance. scipy: "
        "least_squares with its defaults and the analytic Jacobian; least squares is compared "
        "with least squares, robust with robust. pybotics: its documented route, least_squares "
        "over optimize_accuracy, stopped after twelve of some forty evaluations, so that its time "
        "is a lower bound. Last column: largest distance from the exact least-"
        "squares solution at fresh poses.",
    )
    rivals = dict(zip(list(tasks)[:2], list(tasks)[2:4], strict=True))
    for name, model in sorted(models.items(), key=lambda item: t[item[0]]):
        row: list[Cell | Goal] = [name, t[name] * 1e3, None, None, None, None]
        if name in rivals:
            to_scipy, to_pybotics = t[name] / t[rivals[name]], t[name] / t["pybotics"]
            row[2:] = to_scipy, Goal(to_scipy, 0.15), to_pybotics, Goal(to_pybotics, 1.0 / 500.0)
        table.add(*row, task.error(model) * 1e3)
    return table


def simulated(name: str, count: int) -> tuple[SerialArm, Measurements]:
    """Poses of an arm whose joints err as gears do and wind under load, where loads are known."""
    rng, nominal = np.random.default_rng(3), load_robot(name)
    error = rng.standard_normal(len(nominal.parameters))
    error *= np.where(nominal.parameters.is_length, 4e-4, np.radians(0.02))
    truth = nominal.with_mdh(nominal.parameters.add(nominal.mdh, error))
    if name == "kr150_r3100":
        nominal = replace(nominal, load=ArmLoad(kr150.BODY.mass, kr150.BODY.centre))
        soft = JointFunctions(np.zeros(6), np.ones(6), np.zeros((6, 1)), 1.0 / kr150.BODY.stiffness)
        truth = replace(truth, load=nominal.load, functions=soft)
    lower, upper = np.maximum(nominal.lower, -np.pi), np.minimum(nominal.upper, np.pi)
    q = rng.uniform(lower, upper, (count, nominal.n))
    flange = truth.fk(q + gear_errors(nominal.n, rng).at(q))
    position = flange[:, :3, 3] + flange[:, :3, :3] @ TARGETS[0]
    position += NOISE_M * rng.standard_normal(position.shape)
    names = tuple(str(i) for i in range(count))
    return nominal, Measurements(q=q, position=position, target=("ball",) * count, sample=names)


def full_model_table() -> Table:
    """The full model of a real robot and of simulated ones, from few and from many poses."""
    table = Table(
        "full_model_speed",
        "The full model (geometry, joint functions, compliances)",
        ("robot", "poses", "s", "goal", "first call in a process, s", "functions found"),
        "UR10: poses of campaigns C and A of its training halves. Simulated: joints err as gears "
        "do, those of the KR 150 wind under its weight. The first call also imports Numba and "
        "SciPy's linear algebra and loads the compiled kernels. Goal of 20000 poses: less than ten "
        "seconds.",
    )
    tasks: list[tuple[str, SerialArm, Measurements, float]] = []
    if data_folder().is_dir():
        for series, count, limit in (("C", 250, 0.3), ("A", None, 5.0)):
            data, _ = halves(campaign(series))
            chosen = np.random.default_rng(0).permutation(len(data))[:count]
            tasks.append(("UR10", load_robot("ur10"), data.take(chosen), limit))
    for title, name in (("KR 150, simulated", "kr150_r3100"), ("UR10, simulated", "ur10")):
        for many, limit in ((250, 0.3), (6000, 5.0), (20_000, 10.0)):
            tasks.append((title, *simulated(name, many), limit))
    for k, (title, arm, data, limit) in enumerate(tasks):
        durations, terms = [], 0
        for _ in range(6 if len(data) == 250 else 2):
            start = time.process_time()
            found = identify_full(arm, data)
            durations.append(time.process_time() - start)
        if isinstance(found, FullIdentification):
            terms = int(np.count_nonzero(found.known.terms.count))
        median = float(np.median(durations[1:]))
        first = durations[0] if k == 0 else None
        table.add(title, len(data), median, Goal(median, limit), first, terms)
    return table


def tables() -> Sequence[Table]:
    """All tables of this module; the full model's first, since it tells a process's first call."""
    return [full_model_table(), kinematics_table(), identification_table()]
