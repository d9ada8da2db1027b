"""Make the golden hand-eye bags: ``python bags/make_hand_eye.py`` writes ``hand_eye_*.mcap``.

Simulated: a UR10 whose lengths err by 0.05 mm shows a line laser a sphere,
stairs and the edge of a block, each in a bag of its own with a target file (``.yaml``) beside it:

- ``joint_states``: before, during and after each standstill;
- ``profile``: one shot at each, 1280 columns, not-a-number where nothing returned; the frame is
  ``laser``, at the stairs ``laser/near`` or ``laser/far`` after the mark that the light lies on;
- ``/truth/hand_eye``: for judging only: where the sensor and the target truly are.

``--csv DIR`` writes the same shots as tables for ``robocal hand-eye``, into a folder for each
target: ``poses.csv``, ``profiles/``, ``target.yaml``; and ``check.csv`` with further shots.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.hand_eye.targets import LineTarget, SphereTarget, Staircase, StepTarget
from robocal_ros.sim.cell import rigid_robot
from robocal_ros.sim.hand_eye_cell import ArmRobot, HandEyeCell, Shots
from robocal_ros.sim.hand_eye_sets import (
    TrueStairs,
    edge_shots,
    sphere_shots,
    step_shots,
    taught,
)
from robocal_ros.sim.motion import Path as JointPath
from robocal_ros.sim.motion import readings
from robocal_ros.sim.profile_sensor import ProfileSensor
from robocal_ros.sim.thermal import Warmth
from robocal_ros.sim.ur10_station import Q_NEAR
from robocal_ros.storage.bag_writer import ros_time
from robocal_ros.storage.bags import BagWriter
from robocal_ros.storage.hand_eye_tables import write_shots
from robocal_ros.storage.hand_eye_targets import Target, write_target
from robocal_ros.storage.robots import load_robot

Array = NDArray[np.float64]
Record = tuple[float, str, str, dict[str, Any]]

FOLDER = Path(__file__).parent
SEEDS = {"sphere": 21, "step": 22, "line": 23}
JITTER_SEED = 31  # of the readings of resting joints
START_NS = 1_790_000_000_000_000_000
SHOTS, CHECKS = 15, 5
SENSOR = ProfileSensor(spikes=0.003, dropouts=0.01, gaps=1)
GEOMETRY_M, REPEATABILITY_RAD = 5e-5, 1e-5
RADIUS_M = 0.02
CENTRE = np.array([0.837, -0.059, 0.045])
T_BASE_USER = frames.transform(frames.exp_rotation([0.01, -0.02, -2.1]), [0.84, -0.02, 0.03])
TAUGHT_M, TAUGHT_RAD = 5e-5, 5e-4  # one sigma, of a frame that is touched with the robot's tip
RATE_HZ = 125.0
MOVE_S, REST_S, SHOT_S = 1.5, 1.0, 0.6  # a shot is taken so long after the arrival
SHOWN_S = 0.3  # of each motion is recorded, before the standstill and after it
DELAY_S = 0.04  # of a profile's message behind its stamp
MICROMETRE = 1e-6
CLOUD_FIELDS = [
    {"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")
]


@dataclass(frozen=True, eq=False)
class Recording:
    """Shots of a target, what the operator knows of it, and what is true."""

    cell: HandEyeCell
    shots: Shots
    target: Target
    truth: dict[str, Any]


def build(kind: str) -> Recording:
    """Simulate the shots of a target: ``sphere``, ``step`` or ``line``."""
    rng = np.random.default_rng(SEEDS[kind])
    arm = load_robot("ur10")
    true = rigid_robot(arm, GEOMETRY_M, rng)
    true.static_error[-1] = 0.0  # nobody can tell it from a shift of the sensor
    effects = replace(true.effects, noise=True)
    true = replace(true, repeatability=REPEATABILITY_RAD, effects=effects)
    cell = HandEyeCell(sensor=SENSOR, robot=ArmRobot(true, Q_NEAR))
    there = true.flange(Q_NEAR, Warmth.cold(arm.n))[0]
    # the robot takes what truly is at T for something at this times T
    T_known_true = arm.fk(Q_NEAR) @ frames.invert(there)
    shots, target, truth = _shown(kind, cell, T_known_true, rng)
    told = {"simulated": True, "T_flange_sensor": cell.T_flange_sensor.tolist(), **truth}
    return Recording(cell, shots, target, told)


def _shown(
    kind: str, cell: HandEyeCell, T_known_true: Array, rng: np.random.Generator
) -> tuple[Shots, Target, dict[str, Any]]:
    count = SHOTS + CHECKS
    if kind == "sphere":
        shots = sphere_shots(cell, CENTRE, RADIUS_M, count, rng)
        return shots, SphereTarget(RADIUS_M), {"center_base": CENTRE.tolist()}
    known = taught(T_known_true @ T_BASE_USER, TAUGHT_M, TAUGHT_RAD, rng)
    truth = {"T_base_user": T_BASE_USER.tolist()}
    if kind == "line":
        shots = edge_shots(cell, T_BASE_USER, count, rng)
        return shots, LineTarget(known[:3, 3], known[:3, 0]), truth
    stairs = TrueStairs(T_BASE_USER)
    shots = step_shots(cell, stairs, count, rng)
    same = Staircase(stairs.steps, stairs.length_m, stairs.height_m, stairs.depth_m)
    target = StepTarget(
        known,
        same.marked_corners(),
        same.edge_user,
        user_sigma_m=TAUGHT_M,
        user_sigma_rad=TAUGHT_RAD,
    )
    return shots, target, truth


def arrivals() -> Array:
    """When (m,) the robot arrives at each standstill, s."""
    return np.asarray(MOVE_S + (MOVE_S + REST_S) * np.arange(SHOTS))


def joints(recording: Recording) -> Array:
    """Joint readings (SHOTS, n) at the standstills."""
    q = recording.shots.q
    if q is None:
        raise ValueError("a robot without joints")
    return q[:SHOTS]


def joint_records(recording: Recording, rng: np.random.Generator) -> Iterator[Record]:
    """Readings around the standstills."""
    q = joints(recording)
    rests = np.concatenate([[0.0], arrivals()])
    path = JointPath(rests, np.append(0.0, arrivals() + REST_S), np.vstack([Q_NEAR, q]))
    steps = np.arange(round((REST_S + 2.0 * SHOWN_S) * RATE_HZ)) / RATE_HZ
    times = (arrivals()[:, None] - SHOWN_S + steps).ravel()
    names = list(load_robot("ur10").joint_names)
    for time_s, row in zip(times.tolist(), readings(path, times, rng), strict=True):
        message = {"header": _header(time_s), "name": names, "position": row}
        yield time_s, "/joint_states", "sensor_msgs/msg/JointState", message


def profile_records(recording: Recording) -> Iterator[Record]:
    """One shot at each standstill, to a micrometre."""
    shots = recording.shots
    for arrival, points, mark in zip(
        arrivals().tolist(), shots.profiles, shots.marks, strict=False
    ):
        xyz = np.insert(points, 1, 0.0, axis=1)
        data = np.round(xyz / MICROMETRE) * MICROMETRE
        message = {
            "header": _header(arrival + SHOT_S, f"laser/{mark}" if mark else "laser"),
            "height": 1,
            "width": len(xyz),
            "fields": CLOUD_FIELDS,
            "is_bigendian": False,
            "point_step": 12,
            "row_step": 12 * len(xyz),
            "data": np.frombuffer(data.astype("<f4").tobytes(), dtype=np.uint8),
            "is_dense": False,
        }
        yield arrival + SHOT_S + DELAY_S, "/profile", "sensor_msgs/msg/PointCloud2", message


def write_bag(recording: Recording, path: Path) -> None:
    """Write the bag in order of time, and the target file beside it."""
    rng = np.random.default_rng(JITTER_SEED)
    told = {"data": json.dumps(recording.truth)}
    records = [(0.0, "/truth/hand_eye", "std_msgs/msg/String", told)]
    records += [*joint_records(recording, rng), *profile_records(recording)]
    with BagWriter(path, latched=["/truth/hand_eye"]) as bag:
        for time_s, topic, kind, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, kind, message, _stamp(time_s))
    write_target(path.with_suffix(".yaml"), recording.target)


def write_csv(recording: Recording, folder: Path) -> None:
    """Write the shots as tables."""
    (folder / "profiles").mkdir(parents=True, exist_ok=True)
    shots, q = recording.shots, recording.shots.q
    arm = load_robot("ur10")
    tables = {"poses": range(SHOTS), "check": range(SHOTS, SHOTS + CHECKS)}
    for name, rows in tables.items():
        index = list(rows)
        write_shots(
            folder / f"{name}.csv",
            folder / "profiles",
            shots.T_base_flange[index],
            {f"shot_{i + 1:02d}": shots.profiles[i] for i in index},
            joints=None if q is None else (arm, q[index]),
            mark=[shots.marks[i] for i in index] if any(shots.marks) else None,
        )
    write_target(folder / "target.yaml", recording.target)
    (folder / "truth.json").write_text(json.dumps(recording.truth, indent=2) + "\n")


def _stamp(time_s: float) -> int:
    return START_NS + round(time_s * 1e6) * 1000


def _header(time_s: float, frame: str = "") -> dict[str, Any]:
    return {"stamp": ros_time(_stamp(time_s)), "frame_id": frame}


def main() -> None:
    """Write the bags beside this script, or the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write tables there, no bags")
    folder = parser.parse_args().csv
    for kind in SEEDS:
        recording = build(kind)
        if folder is not None:
            write_csv(recording, folder / kind)
            continue
        path = FOLDER / f"hand_eye_{kind}.mcap"
        write_bag(recording, path)
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
