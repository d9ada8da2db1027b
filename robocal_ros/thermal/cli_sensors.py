# SPDX-License-Identifier: Apache-2.0
"""The command ``robocal correct-points``: what a sensor on the flange measured, in base."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.bags.bags import BagReader
from robocal_ros.cli.main import CliResult, Document, describe_robot, print_output, print_words
from robocal_ros.cli.programs import add_given_model, given_model, model_history
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.ground.samples import JOINTS, JointStream, joint_sample
from robocal_ros.history.history_records import REFERENCE
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_fields, read_pose
from robocal_ros.kinematics.tables import read_measurements, stamp_texts, texts, write_cells
from robocal_ros.thermal.measured_points import PlacedShot, PointQueue, shot_of

if TYPE_CHECKING:
    from rich.console import Console

GAP_NS = 250_000_000  # a longer pause of the joints is counted as one
JOINT_STATE = "sensor_msgs/msg/JointState"
CLOUD = "sensor_msgs/msg/PointCloud2"
POINT = "geometry_msgs/msg/PointStamped"


def add_correct_points(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``correct-points``."""
    add_given_model(parser)
    parser.add_argument(
        "--mount",
        type=Path,
        metavar="FILE",
        help="T_flange_sensor of a result or description; default: of the cold reference in the "
        "history of --robot-serial",
    )
    given = parser.add_mutually_exclusive_group(required=True)
    given.add_argument(
        "--data", type=Path, metavar="CSV", help="joints, and x, y, z in the sensor's frame"
    )
    given.add_argument(
        "--bag", type=Path, metavar="BAG", help="joint states, and points or clouds with stamps"
    )
    parser.add_argument("--points", default="point", metavar="TOPIC", help="of the bag's points")
    parser.add_argument("--joints", default=JOINTS, metavar="TOPIC", help="of its joint states")
    parser.add_argument("--output", type=Path, metavar="CSV", help="write the points in base")


def run_correct_points(args: argparse.Namespace) -> CliResult:
    """Do ``correct-points``. Raises `RobocalError` for what a user can mend."""
    robot, warnings = describe_robot(args.robot)
    arm, mount = given_model(args, robot.arm), _mount(args, robot.arm)
    lost: list[str] = []
    if args.data is not None:
        data = read_measurements(args.data, robot.arm)
        names, stamps = data.sample, data.stamp_ns
        points = frames.apply(arm.fk(data.q) @ mount, data.position)
    else:
        rows = list(_of_bag(args, arm, mount, lost))
        if not rows:
            why = f": {lost[0]}" if lost else ""
            raise InputError(f"no point of {args.points} could be placed{why}", file=str(args.bag))
        names = tuple(name for name, _, _ in rows)
        stamps = np.array([stamp for _, stamp, _ in rows], dtype=np.int64)
        points = np.array([point for _, _, point in rows])
    if args.output is not None:
        columns = {"sample": list(names)}
        if stamps is not None:
            columns["stamp_s"] = stamp_texts(stamps)
        columns |= {f"{axis}_mm": texts(1e3 * points[:, i]) for i, axis in enumerate("xyz")}
        write_cells(args.output, columns)
    document: Document = {
        "robot": robot.arm.name,
        "model_hash": robot.arm.model_hash,
        "T_flange_sensor": transform_document(mount),
        "points": [
            {"sample": name, "xyz_mm": (1e3 * point).tolist()}
            for name, point in zip(names, points, strict=True)
        ],
        "not_placed": lost,
        "output": None if args.output is None else str(args.output),
        "warnings": warnings,
    }
    return CliResult(document, _show_correct_points)


def _mount(args: argparse.Namespace, nominal: SerialArm) -> Array:
    if args.mount is not None:
        return read_pose(read_fields(args.mount, "mount").below("T_flange_sensor"))
    if args.robot_serial is None:
        raise InputError("--mount is missing: where the sensor sits on the flange")
    with model_history(args, nominal) as history:
        model = history.head(REFERENCE).model or {}
        if "T_flange_sensor" not in model:
            raise InputError(
                f"no cold reference of {args.robot_serial} was captured with a sensor on the "
                "flange: give --mount",
                file=str(history.path),
            )
        return np.array(model["T_flange_sensor"])


def _of_bag(
    args: argparse.Namespace, arm: SerialArm, mount: Array, lost: list[str]
) -> Iterator[tuple[str, int, Array]]:
    """Name, stamp and place (3,) in base of each point, in the order of the recording."""
    queue = PointQueue(JointStream(arm.joint_names))

    def ready() -> Iterator[tuple[str, int, Array]]:
        for shot, placed in queue.ready(arm, mount):
            if not isinstance(placed, PlacedShot):
                lost.append(f"{shot.name}: {placed}")
                continue
            for i, point in enumerate(placed.points):
                name = shot.name if len(placed.points) == 1 else f"{shot.name}/{i}"
                yield name, shot.stamp_ns, point

    with BagReader(args.bag) as reader:
        wanted = {topic.strip("/"): topic for topic in (args.joints, args.points)}
        known = {name.strip("/"): name for name in reader.info.topics}
        if missing := [topic for topic in wanted if topic not in known]:
            raise InputError(
                f"no topic {missing[0]}; it has {', '.join(reader.info.topics)}", file=str(args.bag)
            )
        for topic, kinds in ((args.joints, (JOINT_STATE,)), (args.points, (POINT, CLOUD))):
            kind = reader.info.topics[known[topic.strip("/")]].msgtype
            if kind not in kinds:
                raise InputError(
                    f"{topic} is of type {kind}, not {' or '.join(kinds)}", file=str(args.bag)
                )
        count = 0
        for recorded in reader.messages([known[topic] for topic in wanted]):
            message, name = recorded.message, recorded.topic
            try:
                if recorded.topic == known[args.joints.strip("/")]:
                    queue.stream.add(joint_sample(message), GAP_NS)
                else:
                    count += 1
                    name = f"{args.points.strip('/')}/{count}"
                    queue.add(shot_of(message, name))
            except RobocalError as error:
                lost.append(f"{name}: {error}")
            yield from ready()
        lost.extend(f"{shot.name}: {error}" for shot, error in queue.end())


def _show_correct_points(console: "Console", document: Document) -> None:
    print_words(console, f"{len(document['points'])} points in base")
    for words in document["not_placed"]:
        print_words(console, f"Not placed: {words}")
    print_output(console, document)
