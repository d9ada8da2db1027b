# SPDX-License-Identifier: Apache-2.0
"""A simulated shift of three hours: ``python bags/make_demo_shift.py`` writes ``demo_shift.mcap``.

A KR 150 works for three hours with a break. Cold, it shows its sphere to the sensor in twelve
poses; then, every twelve minutes, in eight of them. The bag holds what a cell would record:

- ``joint_states``: 50 Hz from 0.6 s before to 0.2 s after each measurement; before that 10 Hz, from
  a little before the robot arrives, to show from which side each joint came; one reading in ten
  seconds in between (to keep the file small; a cell records them all);
- ``measured_point``: sphere centre in the frame ``sensor``, target ``ball``;
- ``motor_temperatures``: one per joint and minute, named by ``frame_id``;
- ``cycle_done``: the cell controller's mark after the reference and after each cycle;
- ``/truth/check_points``: for judging only: where the tool truly is at poses that the measuring
  poses do not contain, when they are commanded without correction.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.measured_shifts import Shift, ShiftPlan, simulate
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import read_poses, readings
from robocal_ros.cell_sim.robot import Effects, TrueRobot
from robocal_ros.cell_sim.sensors import SphereSensor
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

BAG = Path(__file__).with_name("demo_shift.mcap")
POSES = Path(__file__).with_name("demo_poses.csv")
ROBOT = "kr150_r3100"
SERIAL = "SIM-KR150-1"
SEED = 1
START_NS = 1_767_592_800_000_000_000  # 2026-01-05 06:00 UTC
AMBIENT_C = 22.0
PHASES = ((1.6, 1.0), (0.4, 0.0), (1.0, 0.7))  # hours and level: work, break, lighter work
DUTY = np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])
PERIOD_S = 720.0
AROUND_S = np.concatenate([np.arange(-1.2, -0.6, 0.1), np.arange(-0.6, 0.2, 0.02)])
SPARSE_S = 10.0
MICROMETRE = 1e-6


@dataclass(frozen=True, eq=False)
class DemoCell:
    """The simulated cell after its shift."""

    robot: TrueRobot
    sensor: SphereSensor
    plan: ShiftPlan
    shift: Shift


def build(effects: Effects | None = None, seed: int = SEED) -> DemoCell:
    """Simulate the shift; the same seed gives the same robot and the same noise."""
    body, course = np.random.default_rng(seed).spawn(2)
    robot = kr150.true_robot(load_robot(ROBOT), body, effects)
    sensor = kr150.sphere_sensor(effects)
    plan = ShiftPlan(
        reference=read_poses(POSES, "cycle", "reference"),
        cycle=read_poses(POSES, "cycle"),
        check=read_poses(POSES, "check"),
        phases=PHASES,
        duty=DUTY,
        period_s=PERIOD_S,
    )
    return DemoCell(
        robot,
        sensor,
        plan,
        simulate(robot, sensor, kr150.WARM_UP, plan, kr150.TOOL, course),
    )


def stamp(time_s: float) -> int:
    """Time stamp, ns, to the microsecond."""
    return START_NS + round(time_s * 1e6) * 1000


def header(time_s: float, frame: str = "") -> dict[str, Any]:
    """Fields of a ``std_msgs/Header``."""
    sec, nanosec = divmod(stamp(time_s), 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def reading_times(cell: DemoCell) -> Array:
    """When the joints are recorded: densely around the visits, sparsely between them."""
    shift = cell.shift
    dense = np.concatenate([visit.time_s + AROUND_S for visit in shift.visits])
    sparse = np.arange(0.0, shift.path.depart[-1], SPARSE_S) + 0.007
    apart = np.abs(sparse[:, None] - [visit.time_s for visit in shift.visits]).min(axis=1) > 2.0
    times = np.sort(np.concatenate([dense, sparse[apart]]))
    return times[times > 0.0]


Record = tuple[float, str, str, dict[str, Any]]


def joint_records(cell: DemoCell, rng: np.random.Generator) -> list[Record]:
    """Joint readings, with stamps that jitter by a third of a millisecond."""
    names = list(cell.robot.nominal.joint_names)
    times = reading_times(cell)
    times = times + 3e-4 * np.clip(rng.standard_normal(len(times)), -3.0, 3.0)
    rows = readings(cell.shift.path, times, rng)
    return [
        (t, "joint_states", "sensor_msgs/msg/JointState",
         {"header": header(t), "name": names, "position": row})
        for t, row in zip(times.tolist(), rows, strict=True)
    ]  # fmt: skip


def point_records(cell: DemoCell) -> list[Record]:
    """Measured sphere centres, as a sensor sends them: some time after their stamp."""
    records: list[Record] = []
    for visit in cell.shift.visits:
        x, y, z = np.round(visit.position / MICROMETRE) * MICROMETRE
        message = {"header": header(visit.time_s, "sensor/ball"), "point": {"x": x, "y": y, "z": z}}
        records.append(
            (visit.time_s + 0.15, "measured_point", "geometry_msgs/msg/PointStamped", message)
        )
    return records


def temperature_records(cell: DemoCell, rng: np.random.Generator) -> list[Record]:
    """Motor temperatures to 0.1 K."""
    shift, records = cell.shift, []
    for minute in np.arange(30.0, shift.path.depart[-1], 60.0):
        for joint, name in enumerate(cell.robot.nominal.joint_names):
            rise = np.interp(minute, shift.temperature_time_s, shift.temperatures[:, joint])
            value = round(AMBIENT_C + rise + 0.1 * rng.standard_normal(), 1)
            message = {"header": header(minute, name), "temperature": value, "variance": 0.01}
            records.append((minute, "motor_temperatures", "sensor_msgs/msg/Temperature", message))
    return records


def cycle_records(cell: DemoCell) -> list[Record]:
    """The cell controller's marks, and the truth at the same time."""
    records: list[Record] = []
    for cycle in cell.shift.cycles:
        truth = {
            "simulated": True,
            "cycle": cycle.name,
            "tool_in_flange_m": kr150.TOOL.tolist(),
            "q_rad": cell.plan.check.round(9).tolist(),
            "position_m": cycle.check.round(9).tolist(),
        }
        at = cycle.time_s + 2.0
        records.append((at, "cycle_done", "std_msgs/msg/String", {"data": cycle.name}))
        records.append(
            (at, "/truth/check_points", "std_msgs/msg/String", {"data": json.dumps(truth)})
        )
    return records


def write(cell: DemoCell, path: Path) -> None:
    """Write the bag in order of time."""
    rng = np.random.default_rng([SEED, 1])
    records = joint_records(cell, rng) + point_records(cell)
    records += temperature_records(cell, rng) + cycle_records(cell)
    with BagWriter(path) as bag:
        for time_s, topic, kind, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, kind, message, stamp(time_s))


def main() -> None:
    """Write the bag beside this script."""
    write(build(), BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
