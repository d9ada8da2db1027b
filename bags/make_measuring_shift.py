# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag of a measuring robot: ``python bags/make_measuring_shift.py``.

Simulated: the KR 150 of ``make_thermal_shift``, with its sensor on the flange. It works for two
hours; every half hour it looks at three spheres of the cell from twelve poses, and then measures
twelve points of a part that stands still. ``measuring_shift.mcap`` holds

- ``joint_states``, ``sphere_center`` (frame ``scanner``, target: the sphere's name);
- ``point``: points of the part as the sensor sees them, at poses that show no sphere;
- ``/thermal_node/session_events``: what a session was told and what came of it;
- ``/truth/part``: for judging only: where the points are in base.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from make_demo_shift import AROUND_S, ROBOT, SPARSE_S, Record, header, stamp
from make_thermal_shift import DUTY, SEED
from numpy.typing import NDArray
from session_events import EventLog

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.measured_shifts import Shift, ShiftPlan, simulate
from robocal_ros import __version__
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import readings
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import (
    JOINTS,
    SPHERE_CENTER,
    JointSample,
    PointSample,
    StandstillRule,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.drift_following import FLANGE, ThermalConfig
from robocal_ros.thermal.session import ThermalSession, configuration

Array = NDArray[np.float64]

BAG = Path(__file__).with_name("measuring_shift.mcap")
SERIAL, FRAME = "SIM-KR150-3", "scanner"
EVENT_TOPIC = "/thermal_node/session_events"
PHASES = ((2.0, 1.0),)
PERIOD_S, ROUNDS, VIEWS = 1800.0, 3, 4
T_FLANGE_SENSOR = frames.transform(
    frames.exp_rotation([0.02, -0.03, 0.4]), [0.06, -0.03, 0.12]
)  # it looks along the flange's z
FIELD_M = 0.5  # from the sensor to the middle of its field
SPREAD_M = np.array([0.08, 0.06, 0.05])  # of what it looks at, about that
NOISE_M = 2e-5
SPHERES = {
    "a": np.array([1.75, -0.75, 0.30]),
    "b": np.array([1.75, 0.90, 0.35]),
    "c": np.array([1.30, 0.05, 0.45]),
}
PART = np.array([1.85, 0.1, 0.35]) + 0.5 * np.array(
    [[x, y, z] for z in (0.0, 0.5) for y in (-0.9, 0.0, 0.9) for x in (-0.4, 0.4)]
)  # twelve points of it, m


def views(arm: SerialArm, point: Array, count: int, rng: np.random.Generator) -> Array:
    """Postures (count, n) from which the sensor sees a point (3,), base, m: from above, turned."""
    found: list[Array] = []
    while len(found) < count:
        tilt = frames.exp_rotation([*rng.uniform(-0.6, 0.6, 2), 0.0])
        R = tilt @ np.diag([1.0, -1.0, -1.0]) @ frames.exp_rotation([0, 0, rng.uniform(-2.5, 2.5)])
        seen = np.array([0.0, 0.0, FIELD_M]) + SPREAD_M * rng.uniform(-1.0, 1.0, 3)
        T = frames.transform(R, point - R @ seen) @ frames.invert(T_FLANGE_SENSOR)
        start = np.radians([np.degrees(np.arctan2(-point[1], point[0])), -70.0, 110.0, 0, 50.0, 0])
        q = reached(arm, T, start)
        if q is not None:
            found.append(q)
    return np.array(found)


def reached(arm: SerialArm, T: Array, q: Array) -> Array | None:
    """Joints (n,) of a flange pose, by Newton steps from a start; None where there are none."""
    for _ in range(50):
        here = arm.fk(q)
        turn = frames.log_rotation(T[:3, :3] @ here[:3, :3].T)
        miss = np.concatenate([T[:3, 3] - here[:3, 3], turn])
        if np.linalg.norm(miss) < 1e-9:
            inside = np.all((q > arm.lower) & (q < arm.upper)) and abs(np.sin(q[4])) > 0.3
            return np.asarray(q) if inside else None
        step = np.linalg.lstsq(arm.jacobian(q), miss, rcond=1e-3)[0]
        q = q + step * min(1.0, 0.3 / np.abs(step).max())
    return None


class FlangeSensor:
    """Measures what lies nearest to the middle of its field; told poses decide which that is."""

    def measure(
        self, T_base_flange: Array, rise: float, time_s: float, rng: np.random.Generator
    ) -> Array:
        """Its place (3,) in the sensor, m: the mount grows with the flange's warmth."""
        X = T_FLANGE_SENSOR.copy()
        X[:3, 3] *= 1.0 + kr150.EXPANSION_PER_K * rise
        points = np.vstack([*SPHERES.values(), PART])
        seen = frames.apply(frames.invert(T_base_flange @ X), points)
        nearest = int(np.argmin(np.linalg.norm(seen - [0.0, 0.0, FIELD_M], axis=1)))
        return np.asarray(np.round(seen[nearest] + NOISE_M * rng.standard_normal(3), 6))


def build() -> tuple[Shift, list[str], int]:
    """The shift, what is seen at each pose of a cycle, and how many of these show spheres."""
    body, course, looks = np.random.default_rng(SEED).spawn(3)
    nominal = load_robot(ROBOT)
    robot = kr150.true_robot(nominal, body, None)
    names = [name for name in SPHERES for _ in range(VIEWS)]
    measuring = np.vstack([views(nominal, c, VIEWS, looks) for c in SPHERES.values()])
    part = np.vstack([views(nominal, c, 1, looks) for c in PART])
    plan = ShiftPlan(
        reference=np.vstack([np.tile(measuring, (ROUNDS, 1)), part]),
        cycle=np.vstack([measuring, part]),
        check=part,
        phases=PHASES,
        duty=DUTY,
        period_s=PERIOD_S,
    )
    shift = simulate(robot, FlangeSensor(), kr150.WARM_UP, plan, kr150.TOOL, course)
    return shift, names, len(part)


def records(shift: Shift, names: list[str], points: int, rng: np.random.Generator) -> list[Record]:
    """All that was recorded, in order of time."""
    times = np.concatenate([visit.time_s + AROUND_S for visit in shift.visits])
    sparse = np.arange(0.0, shift.path.depart[-1], SPARSE_S) + 0.007
    apart = np.abs(sparse[:, None] - [v.time_s for v in shift.visits]).min(axis=1) > 2.0
    times = np.sort(np.concatenate([times, sparse[apart]]))
    times = times[times > 0.0]
    joint_names = list(load_robot(ROBOT).joint_names)
    found: list[Record] = [
        (t, JOINTS, "sensor_msgs/msg/JointState",
         {"header": header(t), "name": joint_names, "position": row})
        for t, row in zip(times.tolist(), readings(shift.path, times, rng), strict=True)
    ]  # fmt: skip
    for cycle in shift.cycles:
        visits = [v for v in shift.visits if v.cycle == cycle.name]
        for i, visit in enumerate(visits):
            sphere = i < len(visits) - points
            topic = SPHERE_CENTER if sphere else "point"
            frame = f"{FRAME}/{names[i % len(names)]}" if sphere else FRAME
            x, y, z = visit.position
            message = {"header": header(visit.time_s, frame), "point": {"x": x, "y": y, "z": z}}
            found.append((visit.time_s + 0.15, topic, "geometry_msgs/msg/PointStamped", message))
    truth = {
        "simulated": True,
        "part_m": PART.tolist(),
        "T_flange_sensor": T_FLANGE_SENSOR.tolist(),
    }
    found.append((0.5, "/truth/part", "std_msgs/msg/String", {"data": json.dumps(truth)}))
    return sorted(found, key=lambda record: record[0])


class Recorder:
    """A thermal session that is fed with what is recorded, and the bag with its events."""

    def __init__(self, bag: BagWriter, history: CalibrationHistory, arm: SerialArm) -> None:
        config = ThermalConfig(arrangement=FLANGE, sigma_m=3e-5, standstill=StandstillRule())
        self.session = ThermalSession(arm, history, config, __version__)
        self._bag, self._events, self._now_ns = bag, EventLog(bag, EVENT_TOPIC), stamp(0.0)
        self._shown: tuple[object, ...] = ()
        self._show_in_force()

    def take(self, record: Record) -> None:
        """Write a record and give it to the session."""
        time_s, topic, kind, message = record
        self._now_ns = stamp(time_s)
        self._bag.write(topic, kind, message, self._now_ns)
        told = message.get("header", {})
        at = told.get("stamp", {})
        stamp_ns = at.get("sec", 0) * 1_000_000_000 + at.get("nanosec", 0)
        if topic == JOINTS:
            self.session.add(JointSample(stamp_ns, tuple(message["name"]), message["position"]))
        elif topic == SPHERE_CENTER:
            frame, _, sphere = told["frame_id"].partition("/")
            place = np.array([message["point"][axis] for axis in "xyz"])
            self.session.add(PointSample(stamp_ns, frame, sphere, place, SPHERE_CENTER))

    def command(self, name: str, **arguments: object) -> Outcome:
        """Give a command; record what came of it."""
        self.session.submit(Command(name, {"by": "cell controller", **arguments}, self._now_ns))
        (outcome,) = self.session.advance(wall_ns=self._now_ns, force=True)
        self._events.write(outcome.command, outcome, self._now_ns)
        self._show_in_force()
        print(f"{name}: {outcome.status.name} {outcome.message}")
        return outcome

    def _show_in_force(self) -> None:
        session = self.session
        shown = session.in_force.revision, session.current.reference_id
        if session.follower is not None:
            shown = (*shown, session.follower.state.cycles)
        if shown != self._shown:
            self._shown = shown
            topics = {kind: kind for kind in (JOINTS, SPHERE_CENTER)}
            self._events.write(configuration(session, topics), None, self._now_ns)


def record(path: Path) -> None:
    """Make the bag."""
    shift, names, points = build()
    waiting = records(shift, names, points, np.random.default_rng([SEED, 1]))
    arm = load_robot(ROBOT)
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open(
            SERIAL, model_hash=arm.model_hash, state_dir=Path(folder)
        ) as history,
        BagWriter(path, latched=[EVENT_TOPIC]) as bag,
    ):
        cell = Recorder(bag, history, arm)
        for cycle in shift.cycles:
            # A cycle is decided before the part is measured: its points have the newest model.
            seen = [v.time_s for v in shift.visits if v.cycle == cycle.name]
            end_s = seen[-points - 1] + 1.0
            while waiting and waiting[0][0] <= end_s:
                cell.take(waiting.pop(0))
            if cycle is shift.cycles[0]:
                cell.command(events.CAPTURE_REFERENCE)
                continue
            outcome = cell.command(events.IDENTIFY, cycle_id=cycle.name)
            if outcome.status is Code.ACCEPT:
                cell.command(events.ACCEPT, id=outcome.calibration_id, reason="its verdict")
        for left in waiting:
            cell.take(left)


def main() -> None:
    """Write the bag beside this script."""
    record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
