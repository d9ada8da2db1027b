# SPDX-License-Identifier: Apache-2.0
"""Make the golden hand-eye bags: ``python bags/make_hand_eye.py`` writes ``hand_eye_*.mcap``.

Simulated: a UR10 whose lengths err by 0.1 mm, with gears as a real one's and backlash, shows a line
laser a sphere, stairs and the edge of a block, each in a bag of its own with a target file
(``.yaml``) beside it:

- ``joint_states``: before, during and after each standstill;
- ``profile``: one shot at each, 1280 columns, not-a-number where nothing returned;
- ``/hand_eye_node/session_events``: what a hand-eye session made of it, for ``robocal replay``. A
  capture is asked for before the robot stands, another one meets a profile in which nothing
  returned; both fail and are asked for again. One sample is removed. The rest is calibrated and
  accepted;
- ``/truth/hand_eye``: for judging only: where the sensor and the target truly are.

``--csv DIR`` writes the same shots as tables for ``robocal hand-eye``, into a folder for each
target: ``poses.csv``, ``profiles/``, ``target.yaml``; and ``check.csv`` with further shots.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hand_eye_program import (
    BLIND,
    BLIND_S,
    EARLY,
    EARLY_S,
    REST_S,
    SHOTS,
    TIMEOUT_S,
    arrivals,
    asked,
    shot_times,
    waits,
    way,
)
from hand_eye_recorder import record_session
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.hand_eye_cell import (
    ArmRobot,
    HandEyeCell,
    SimulatedShots,
    TrueStairs,
    edge_block,
    edge_shots,
    sphere_shots,
    step_shots,
    taught,
)
from bench.hand_eye_files import write_shots, write_target
from bench.measured_runs import Q_NEAR
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.beams import SmoothPath, readings
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.gears import ur10_gears
from robocal_ros.cell_sim.robot import TrueRobot, Warmth
from robocal_ros.cell_sim.sensors import ProfileSensor, Scene, ball_on_table
from robocal_ros.ground import frames
from robocal_ros.hand_eye.profiles import sensor_of
from robocal_ros.hand_eye.session import HandEyeConfig
from robocal_ros.hand_eye.targets import (
    LaserTarget,
    LineTarget,
    SphereTarget,
    Staircase,
    read_target,
)
from robocal_ros.kinematics.joint_errors import SIZE_URAD
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session.events import Outcome

Array = NDArray[np.float64]
Record = tuple[float, str, str, dict[str, Any]]

FOLDER = Path(__file__).parent
SEEDS = {"sphere": 21, "step": 22, "line": 24}
JITTER_SEED = 31  # of the readings of resting joints
START_NS = 1_790_000_000_000_000_000
CHECKS = 5
SENSOR = ProfileSensor(gaps=1)
GEOMETRY_M, REPEATABILITY_RAD = 1e-4, 1e-5
RADIUS_M = 0.02
CENTRE = np.array([0.837, -0.059, 0.045])
T_BASE_USER = frames.transform(frames.exp_rotation([0.01, -0.02, -2.1]), [0.84, -0.02, 0.03])
TAUGHT_M, TAUGHT_RAD = 5e-5, 5e-4  # one sigma, of a frame that is touched with the robot's tip
RATE_HZ = 125.0
SHOWN_S = 0.5  # of each motion is recorded, before the standstill and after it
DELAY_S = 0.04  # of a profile's message behind its stamp
MICROMETRE = 1e-6
TRUTH, FRAME = "/truth/hand_eye", "laser"
CONFIG = HandEyeConfig(
    sensor_frame=FRAME,
    sensor=sensor_of("", "towards"),
    capture_timeout_s=TIMEOUT_S,
    joint_error_rad=1e-6 * SIZE_URAD,
)
CLOUD_FIELDS = [
    {"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")
]


@dataclass(frozen=True, eq=False)
class Recording:
    """Shots of a target, what the operator knows of it, and what is true."""

    cell: HandEyeCell
    scene: Scene
    robot: TrueRobot
    shots: SimulatedShots
    target: LaserTarget
    truth: dict[str, Any]


def build(kind: str) -> Recording:
    """Simulate the shots of a target: ``sphere``, ``step`` or ``line``."""
    rng = np.random.default_rng(SEEDS[kind])
    arm = load_robot("ur10")
    true = rigid_robot(arm, GEOMETRY_M, rng)
    true.static_error[-1] = 0.0  # nobody can tell it from a shift of the sensor
    effects = replace(true.effects, noise=True, gears=True)
    true = replace(true, repeatability=REPEATABILITY_RAD, effects=effects, gears=ur10_gears())
    cell = HandEyeCell(sensor=SENSOR, robot=ArmRobot(true, Q_NEAR))
    there = true.flange(Q_NEAR, Warmth.cold(arm.n))[0]
    # the robot takes what truly is at T for something at this times T
    T_known_true = arm.fk(Q_NEAR) @ frames.invert(there)
    shots, target, truth = _shown(kind, cell, T_known_true, rng)
    told = {"simulated": True, "T_flange_sensor": cell.T_flange_sensor.tolist(), **truth}
    return Recording(cell, _scene(kind), true, shots, target, told)


def _scene(kind: str) -> Scene:
    if kind == "sphere":
        return ball_on_table(CENTRE, RADIUS_M)
    return Scene((TrueStairs(T_BASE_USER).body if kind == "step" else edge_block(T_BASE_USER),))


def _shown(
    kind: str, cell: HandEyeCell, T_known_true: Array, rng: np.random.Generator
) -> tuple[SimulatedShots, LaserTarget, dict[str, Any]]:
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
    target = same.target(known, user_sigma_m=TAUGHT_M, user_sigma_rad=TAUGHT_RAD)
    return shots, target, truth


def _way(recording: Recording) -> SmoothPath:
    q = recording.shots.q
    if q is None:
        raise ValueError("a robot without joints")
    return way(Q_NEAR, q[:SHOTS])


def joint_records(recording: Recording, rng: np.random.Generator) -> Iterator[Record]:
    """Readings around the standstills."""
    spans = zip(arrivals() - SHOWN_S, REST_S + waits() + 2.0 * SHOWN_S, strict=True)
    times = np.concatenate(
        [start + np.arange(round(span * RATE_HZ)) / RATE_HZ for start, span in spans]
    )
    names = list(load_robot("ur10").joint_names)
    q = readings(_way(recording), times, rng)
    for time_s, row in zip(times.tolist(), q, strict=True):
        message = {"header": _header(time_s), "name": names, "position": row}
        yield time_s, "/joint_states", "sensor_msgs/msg/JointState", message


def profile_records(recording: Recording, rng: np.random.Generator) -> Iterator[Record]:
    """One shot at each standstill, and those in vain."""
    profiles = recording.shots.profiles
    for time_s, points in zip(shot_times().tolist(), profiles, strict=False):
        yield _cloud(time_s, points)
    early_s, blind_s = arrivals()[[EARLY, BLIND]] + [EARLY_S, BLIND_S]
    q = _way(recording).at(np.array([early_s]))[0]
    T_base_flange = recording.robot.flange(q, Warmth.cold(len(q)))[0]
    T_base_light = T_base_flange @ recording.cell.T_flange_light
    yield _cloud(early_s, SENSOR.shoot(T_base_light, recording.scene, rng))
    yield _cloud(blind_s, np.full_like(profiles[0], np.nan))


def _cloud(time_s: float, points: Array) -> Record:
    """A profile (n, 2), to a micrometre."""
    xyz = np.insert(points, 1, 0.0, axis=1)
    data = np.round(xyz / MICROMETRE) * MICROMETRE
    message = {
        "header": _header(time_s, FRAME),
        "height": 1,
        "width": len(xyz),
        "fields": CLOUD_FIELDS,
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(xyz),
        "data": np.frombuffer(data.astype("<f4").tobytes(), dtype=np.uint8),
        "is_dense": False,
    }
    return time_s + DELAY_S, "/profile", "sensor_msgs/msg/PointCloud2", message


def write_bag(recording: Recording, path: Path) -> Outcome:
    """Write the bag in order of time, and the target file beside it; what was calibrated."""
    file = path.with_suffix(".yaml")
    write_target(file, recording.target)
    rng = np.random.default_rng(JITTER_SEED)
    told = {"data": json.dumps(recording.truth)}
    records = [(0.0, TRUTH, "std_msgs/msg/String", told)]
    records += [*joint_records(recording, rng), *profile_records(recording, rng)]
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs.mcap"
        with BagWriter(inputs) as bag:
            for time_s, topic, kind, message in sorted(records, key=lambda record: record[0]):
                bag.write(topic, kind, message, _stamp(time_s))
        program = asked(recording.shots.marks, read_target(file))
        commands = [(_stamp(time_s), command) for time_s, command in program]
        return record_session(inputs, path, CONFIG, commands, TRUTH)


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
        found = write_bag(recording, path)
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, simulated; {found.message}")


if __name__ == "__main__":
    main()
