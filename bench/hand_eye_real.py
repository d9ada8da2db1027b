# SPDX-License-Identifier: Apache-2.0
"""Real profiles of line lasers on FANUC robots: spread, shots left out, halves, wrong radii.

Sets of others below $ROBOCAL_DATA/line_laser_fanuc, where they are there; the command reads the
same tables (`robocal hand-eye sphere --poses SET/poses.csv --radius-mm 40 --z-grows towards`).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.real_data import data_folder
from bench.tables import Goal, Table
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.files import read_pose_table, read_profiles
from robocal_ros.hand_eye.mount_fit import MountFit, fit_mount, leave_one_out, solved_again
from robocal_ros.hand_eye.mount_problem import MountProblem, SphereModel, in_plane
from robocal_ros.hand_eye.result import HandEyeResult, HandEyeSettings, apart
from robocal_ros.hand_eye.solve import field_of, look, solve_task
from robocal_ros.hand_eye.stairs import task_of
from robocal_ros.hand_eye.targets import SphereTarget
from robocal_ros.hand_eye.tasks import HandEyeData, Task

Array = NDArray[np.float64]

RADIUS_M = 0.04
HALVES = 20
MANY_HALVES = {"experiments_edge": 200}
SPREAD_MM = {  # goals, of all shots
    "experiments_sphere": 0.245,
    "leichi_cam0_sphere": 0.54,
    "experiments_edge": 0.10,
    "leichi_0425_camera0_edge": 0.175,
    "leichi_0425_camera1_edge": 0.48,
}
OTHER_MM = (25.0, 39.0, 41.0, 42.0)


def folder() -> Path:
    """Of the sets."""
    return data_folder() / "line_laser_fanuc"


def read_set(name: str) -> HandEyeData:
    """A set as it was delivered."""
    table = read_pose_table(folder() / name / "poses.csv")
    return HandEyeData(table.names, table.T_base_flange, read_profiles(folder() / name, table))


def part_of(data: HandEyeData, rows: NDArray[np.int64]) -> HandEyeData:
    """The shots at these rows."""
    return replace(
        data,
        names=tuple(data.names[i] for i in rows),
        T_base_flange=data.T_base_flange[rows],
        profiles=[data.profiles[i] for i in rows],
    )


def task_for(name: str, radius_m: float = RADIUS_M) -> Task:
    """The target of a set; heights grow towards the sensor."""
    return task_of(SphereTarget(radius_m) if "sphere" in name else None, "edge", towards=True)


def solved(task: Task, data: HandEyeData) -> HandEyeResult:
    """By the defaults."""
    return solve_task(task, data, "best", HandEyeSettings())


def left_out_m(fit: MountFit) -> tuple[float, float]:
    """Rms distance of shots from the solution without each, m, and what is predicted of it."""
    (view,), state = fit.views, fit.state
    found = leave_one_out(fit.views, partial(solved_again, fit))
    if found is None:
        raise ValueError("a set of too few shots")
    T, place, s = view.sightings.T_base_flange @ state.T_flange_sensor, state.places[0], view
    expected = []
    for i in range(len(s.sightings.names)):
        rest = (view.take(np.arange(len(s.sightings.names)) != i),)
        problem = MountProblem(rest, fit.noise, state)
        J = problem.linearise(state)[1].reshape(-1, len(problem.names))
        C = np.linalg.inv(J.T @ J)
        own = MountProblem((view.take(np.array([i])),), fit.noise, state, pivot=problem.pivot)
        linear = own.linear(state)
        G, J, n = linear.common[0], linear.jacobian[0], view.model.components
        total = linear.covariance[0] + G @ fit.noise.covariance() @ G.T + J @ C @ J.T
        value, step = view.sightings.value[i : i + 1], 1e-7
        off = [  # how the distance's vector changes with the feature
            _miss(view.model, T[i : i + 1], place, value + step * np.eye(3)[k]) for k in range(n)
        ]
        A = (np.array(off) - _miss(view.model, T[i : i + 1], place, value)).T / step
        expected.append(float(np.trace(A @ total[:n, :n] @ A.T)))
    return float(np.sqrt(np.mean(found**2))), float(np.sqrt(np.mean(expected)))


def _miss(model: object, T: Array, place: Array, value: Array) -> Array:
    """Vector (3,) from the target to one feature, base, m."""
    x, z, r = value[0]
    if isinstance(model, SphereModel):
        side = np.sign((T[0, :3, 1]) @ (place - T[0, :3, 3]))
        y = side * np.sqrt(max(model.radius_m**2 - r**2, 0.0))
        return np.asarray(T[0, :3, :3] @ [x, y, z] + T[0, :3, 3] - place)
    away = T[0, :3, :3] @ in_plane(value)[0] + T[0, :3, 3] - place[0]
    return np.asarray(away - (away @ place[1]) * place[1])


def sets_table() -> Table:
    """Each set as a whole, and halves of it."""
    table = Table(
        "hand_eye_real_sets",
        "Real profiles: distance of all shots from the target, mm",
        ("set", "shots", "used", "rms", "goal", "largest", "without itself, rms", "over predicted",
         "verdict", "error told in the field", "halves", "accepted", "not informative", "refused",
         "accepted, off by more than 4 sigma", "goal"),
        "FANUC robots, others' line lasers, sphere of 40 mm radius or an edge. Random halves of "
        "each: off is the rms distance in the field from the mount of all shots, "
        "sigma what both told.",
    )  # fmt: skip
    for name, goal in SPREAD_MM.items():
        task, data = task_for(name), read_set(name)
        result = solved(task, data)
        read = task.read(data)
        fit = fit_mount((read.view,), look(task, read.view)[0])
        without, predicted = left_out_m(fit)
        spread = result.more["spread"]
        halves = MANY_HALVES.get(name, HALVES)
        codes, far = _halves(task, data, result, halves)
        table.add(
            name, len(data.names), len(result.samples), spread["rms_mm"],
            Goal(spread["rms_mm"], goal), spread["max_mm"], 1e3 * without, without / predicted,
            result.verdict.code.name, 1e3 * float(result.working_error_m or np.nan),
            halves, *codes, far, Goal(far, 0),
        )  # fmt: skip
    return table


def _halves(
    task: Task, data: HandEyeData, whole: HandEyeResult, draws: int
) -> tuple[tuple[int, ...], int]:
    """How many halves are accepted, called not informative, refused; and accepted far off."""
    rng, count = np.random.default_rng(17), len(data.names)
    codes, far = [], 0
    for _ in range(draws):
        rows = np.sort(rng.permutation(count)[: count // 2])
        try:
            half = solved(task, part_of(data, rows))
        except RobocalError:
            codes.append("refused")
            continue
        codes.append("accepted" if half.verdict.accept else "not informative")
        told = np.hypot(half.working_error_m or 0.0, whole.working_error_m or 0.0)
        off = apart(half.T_flange_sensor, whole.T_flange_sensor, field_of(data))
        far += int(half.verdict.accept and off > 4.0 * told)
    return tuple(codes.count(code) for code in ("accepted", "not informative", "refused")), far


def radius_table() -> Table:
    """The sphere sets with another radius than theirs."""
    table = Table(
        "hand_eye_real_radius",
        "Real profiles of a sphere of 40 mm, told another radius",
        ("set", "told, mm", "verdict", "off in the field, mm", "told, mm"),
        "Off: from the mount with 40 mm. Goal: refused, or the error told holds what it is off by.",
    )
    for name in list(SPREAD_MM)[:2]:
        data = read_set(name)
        whole = solved(task_for(name), data)
        for radius_mm in OTHER_MM:
            try:
                found = solved(task_for(name, radius_mm * 1e-3), data)
            except RobocalError as error:
                table.add(name, radius_mm, f"refused: {error}", None, None)
                continue
            off = apart(found.T_flange_sensor, whole.T_flange_sensor, field_of(data))
            told = float(found.working_error_m or np.nan)
            table.add(name, radius_mm, found.verdict.code.name, 1e3 * off, 1e3 * told)
    return table


def tables() -> Sequence[Table]:
    """Both; none where the sets are not there."""
    return [sets_table(), radius_table()] if folder().is_dir() else []
