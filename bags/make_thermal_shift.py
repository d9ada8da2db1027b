# SPDX-License-Identifier: Apache-2.0
"""Make the golden thermal bag: ``python bags/make_thermal_shift.py``, ``thermal_shift.mcap``.

Simulated: a KR 150 works for four hours with a break; every twenty minutes it shows its sphere in
six poses, as point clouds with the stem and the background in them. After three hours somebody
knocks the sensor. A second sphere stands on the floor. Beside what ``make_demo_shift`` says, but
without ``measured_point``, the bag holds:

- ``sphere_cloud``: the sphere on the flange, in the frame ``sensor``, target ``ball``;
- ``reference_sphere_center``: the sphere on the floor, once in each cycle;
- ``/truth/events``: for judging only: what happened, and when.
"""

import json
import sys
from pathlib import Path

import make_demo_shift as demo
import numpy as np
from make_demo_shift import DemoCell, Record, header
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.measured_shifts import MEASURING, Shift, ShiftPlan, poses, simulate
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.sensors import sphere_cloud
from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

BAG = Path(__file__).with_name("thermal_shift.mcap")
SEED = 5
PHASES = ((2.2, 1.0), (0.5, 0.0), (1.3, 0.8))
DUTY = np.array([0.6, 0.9, 1.0, 0.7, 0.8, 0.5])
PERIOD_S = 1200.0
POINTS = 400
ROUNDS = 3  # of the cold robot
KNOCKED_S = 3.1 * 3600.0
T_KNOCK = frames.transform(frames.exp_rotation([4e-4, -6e-4, 0.0]), [5e-4, 2e-4, -3e-4])
FLOOR = np.array([0.06, 0.11, 0.74])  # in the sensor's frame before the knock, m
FLOOR_SIGMA_M = 1e-5  # mean of some readings
CLOUD_FIELDS = [
    {"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")
]


def build() -> DemoCell:
    """Simulate the shift."""
    body, course = np.random.default_rng(SEED).spawn(2)
    robot = kr150.true_robot(load_robot(demo.ROBOT), body, None)
    sensor = kr150.sphere_sensor(None)
    measuring = poses("sphere")[list(MEASURING)]
    plan = ShiftPlan(
        reference=np.tile(measuring, (ROUNDS, 1)),
        cycle=measuring,
        check=poses("check"),
        phases=PHASES,
        duty=DUTY,
        period_s=PERIOD_S,
    )
    shift = simulate(robot, sensor, kr150.WARM_UP, plan, kr150.TOOL, course)
    return DemoCell(robot, sensor, plan, shift)


def as_seen(points: Array, time_s: float) -> Array:
    """Points (m, 3) in the sensor's frame, which moved with it when it was knocked."""
    if time_s < KNOCKED_S:
        return points
    return np.asarray(points @ T_KNOCK[:3, :3].T + T_KNOCK[:3, 3])


def cloud_records(shift: Shift, rng: np.random.Generator) -> list[Record]:
    """What the sensor sees of the sphere on the flange, to a micrometre."""
    records: list[Record] = []
    for visit in shift.visits:
        points = as_seen(sphere_cloud(visit.position, POINTS, rng), visit.time_s)
        data = np.round(points, 6).astype("<f4")
        message = {
            "header": header(visit.time_s, "sensor/ball"),
            "height": 1,
            "width": POINTS,
            "fields": CLOUD_FIELDS,
            "is_bigendian": False,
            "point_step": 12,
            "row_step": 12 * POINTS,
            "data": np.frombuffer(data.tobytes(), dtype=np.uint8),
            "is_dense": True,
        }
        records.append(
            (visit.time_s + 0.15, "sphere_cloud", "sensor_msgs/msg/PointCloud2", message)
        )
    return records


def floor_records(cell: DemoCell, rng: np.random.Generator) -> list[Record]:
    """The sphere on the floor, measured at the last pose of each round."""
    records: list[Record] = []
    for visit in cell.shift.visits[len(cell.plan.cycle) - 1 :: len(cell.plan.cycle)]:
        at = visit.time_s + 0.05
        seen = as_seen(FLOOR[None] + FLOOR_SIGMA_M * rng.standard_normal((1, 3)), at)[0]
        x, y, z = np.round(seen, 7)
        message = {"header": header(at, "sensor/floor"), "point": {"x": x, "y": y, "z": z}}
        records.append(
            (at + 0.1, "reference_sphere_center", "geometry_msgs/msg/PointStamped", message)
        )
    return records


def event_record() -> Record:
    """The knock, for judging."""
    event = {"simulated": True, "event": "sensor knocked", "time_s": KNOCKED_S}
    told = {"data": json.dumps(event | {"T_after_before": T_KNOCK.tolist()})}
    return KNOCKED_S, "/truth/events", "std_msgs/msg/String", told


def write(cell: DemoCell, path: Path) -> None:
    """Write the bag in order of time."""
    joints, clouds, floor, warmth = np.random.default_rng([SEED, 1]).spawn(4)
    records = demo.joint_records(cell, joints) + cloud_records(cell.shift, clouds)
    records += [*floor_records(cell, floor), event_record()]
    records += demo.temperature_records(cell, warmth) + demo.cycle_records(cell)
    with BagWriter(path) as bag:
        for time_s, topic, kind, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, kind, message, demo.stamp(time_s))


def main() -> None:
    """Write the bag beside this script."""
    write(build(), BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
