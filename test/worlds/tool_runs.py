# SPDX-License-Identifier: Apache-2.0
"""Tables of a simulated UR10 that measures a bent tool, and of sweeps through parallel beams."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tool_tables import write

from bench.measured_runs import MeasuredRun, ToolCell, point_sigma
from robocal_ros.cell_sim.beams import (
    CYLINDER_M,
    BeamStation,
    RoundTool,
    Sweep,
    TrueBeam,
    TrueInput,
    TrueNoise,
    beams_of,
    bent,
    crossings,
    laser_points,
)
from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.crossed_model import BeamStep, RobotNoise
from robocal_ros.tool.laser_frame import LaserFile, LaserFrame, calibrate_laser, write_laser

Q_NEAR = np.array([0.047, -2.208, -1.248, 1.885, -1.571, 1.618])
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.04, 0.01]), [0.7994, -0.1263, 0.1945])
TAUGHT_MM = (0.0, 0.0, 150.0)
TAUGHT = frames.transform(np.eye(3), 1e-3 * np.array(TAUGHT_MM))
TRUTH = bent(TAUGHT, [0.003, -0.002, 0.001], [0.03, -0.02, 0.0])
RADIUS_MM = 2.5
SAMPLE_S, LATENCY_S = 2e-3, 4e-3
STARTED_S = 1_790_000_000  # stamps count from 1970
EVENT_COLUMNS = "stamp_s,beam,blocked,step"
JOINT_COLUMNS = "stamp_s,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"


@dataclass(frozen=True)
class RunTables:
    """Rows of a run: ``events``, ``joints``, ``beams`` of the calibration before it, and the
    ``laser`` frame that follows from them."""

    beams: list
    events: list
    joints: list
    laser: LaserFrame

    def written(self, folder: Path, events: list | None = None, joints: list | None = None) -> list:
        """The options that name the written tables."""
        rows = self.events if events is None else events
        readings = self.joints if joints is None else joints
        return [
            "--events", write(folder / "events.csv", EVENT_COLUMNS, rows),
            "--joints", write(folder / "joints.csv", JOINT_COLUMNS, readings),
        ]  # fmt: skip


def simulated_run(seed: int = 11) -> RunTables:
    """Beams placed by the same robot, then two circles, one upright, two plunges; 2 ms input."""
    rng = np.random.default_rng(seed)
    source = TrueInput(latency_s=LATENCY_S, sample_period_s=SAMPLE_S)
    station = BeamStation(beams_of(T_BASE_LASER, np.radians(92.2), 5.8e-5), source, TrueNoise())
    places = laser_points(station, T_BASE_LASER, rng)
    laser = calibrate_laser(places, point_sigma(station), CYLINDER_M)
    noise = RobotNoise(station.noise.step_m, station.noise.edge_m)
    cell = ToolCell(load_robot("ur10"), station, laser, Q_NEAR, robot=noise)
    run = cell.full_run(RoundTool.cylinder(TRUTH, 1e-3 * RADIUS_MM), TAUGHT, rng)
    beams = [(name, *(1e3 * place)) for name, place in places.items()]
    return RunTables(beams, event_rows(run.steps), joint_rows(run), laser)


def run_tables(folder: Path) -> None:
    """A run with its laser file, and sweeps through parallel beams."""
    tables = simulated_run()
    arm = load_robot("ur10")
    write_laser(folder / "laser.yaml", LaserFile(tables.laser, "cell_1", arm.name, arm.model_hash))
    write(folder / "run.csv", EVENT_COLUMNS, tables.events)
    write(folder / "joints.csv", JOINT_COLUMNS, tables.joints)
    write(folder / "sweeps.csv", SWEEP_COLUMNS, sweep_rows())
    write(folder / "half_sweeps.csv", SWEEP_COLUMNS, swept("straight", R_STRAIGHT))


def stamp(time_s: float) -> str:
    """A time of the run, to the nanosecond."""
    seconds, rest = divmod(STARTED_S * 10**9 + round(time_s * 1e9), 10**9)
    return f"{seconds}.{rest:09d}"


def event_rows(steps: list[BeamStep]) -> list:
    return [(stamp(e.time_s), e.beam, int(e.blocked), step.name) for step in steps
            for e in step.edges]  # fmt: skip


def joint_rows(run: MeasuredRun) -> list:
    path = run.path
    degrees = np.degrees(path.q).tolist()
    return [(stamp(t), *q) for t, q in zip(path.time_s.tolist(), degrees, strict=True)]


UP_MM, DOWN_MM, X_MM = 400.0, 360.0, 800.0
SWEEP_COLUMNS = "sweep,beam,x_mm,y_mm,z_mm,qx,qy,qz,qw"
LEANING = bent(frames.transform(np.eye(3), [0.0, 0.0, 0.2]), [4e-3, -3e-3, 1e-3], [0.06, 0.04, 0.0])
R_STRAIGHT = np.diag([-1.0, 1.0, -1.0])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def sweep_rows(whole: bool = True) -> list:
    """Sweeps of a leaning cylinder, and of it set upright, along x at two heights of beams."""
    R_turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    rows = swept("straight", R_STRAIGHT) + swept("turned", R_turned)
    if whole:
        v = R_STRAIGHT @ LEANING[:3, 2]
        upright = frames.exp_rotation(_smallest_turn(v, np.array([0.0, 0.0, -1.0]))) @ R_STRAIGHT
        rows += swept("upright", upright) + swept("upright_turned", QUARTER @ upright)
        rows += swept("plunge", upright)[:1]
        height = 1e-3 * UP_MM - (upright @ LEANING[:3, 3])[2]  # the tip is at the upper beam
        rows[-1][4] = 1e3 * height
    return rows


def swept(name: str, R: np.ndarray) -> list:
    tool = RoundTool.cylinder(LEANING, 0.003)
    start = frames.transform(R, [1e-3 * X_MM - 0.03, 0.0, 0.53])
    move = Sweep(start, np.array([0.06, 0.0, 0.0]), 1.0)
    rows = []
    for beam, height in (("up", UP_MM), ("down", DOWN_MM)):
        place = np.array([X_MM, 0.0, height]) * 1e-3
        half = np.array([0.0, 0.1, 0.0])
        light = TrueBeam(place - half, place + half)
        time, _ = crossings(light, tool, move, move.window, 0.0, np.random.default_rng(0))
        T = move(time)
        quat = frames.quat_xyzw(T)
        for i in range(len(T)):
            rows.append([name, beam, *(1e3 * T[i, :3, 3]), *quat[i]])
    return rows


def _smallest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    axis = np.cross(start, end)
    return axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), start @ end)
