"""From the tables and images of ``robocal hand-eye camera`` to its result."""

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.hand_eye_shots import arm_of, require_unused, robot_sigma_of
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from robocal_ros.hand_eye.board import Chessboard, Intrinsics, SeenBoards
    from robocal_ros.hand_eye.camera import CameraSettings
    from robocal_ros.hand_eye.camera_model import PosePairs
    from robocal_ros.hand_eye.result import HandEyeResult
    from robocal_ros.hand_eye.streams import PoseStream
    from robocal_ros.hand_eye.tables import PoseTable


def calibrate(args: argparse.Namespace) -> "HandEyeResult":
    """Read what the options name and place the camera.

    Raises
    ------
    InputError
        When files or options are wrong.
    TooFewSamplesError, RankDeficientError, ResidualError
        As `robocal_ros.hand_eye.camera.calibrate_camera`.
    """
    settings = _settings(args)
    if args.measured is not None:
        for option in ("profiles", "board", "square_mm", "intrinsics"):
            if getattr(args, option) is not None:
                raise InputError(
                    f"--{option.replace('_', '-')} belongs to images, --measured to poses: give "
                    "one of both"
                )
        return _from_poses(args, settings)
    if args.profiles is None or args.board is None or args.square_mm is None:
        raise InputError(
            "give --profiles, --board and --square-mm for images, or --measured for board poses"
        )
    return _from_images(args, settings)


def _settings(args: argparse.Namespace) -> "CameraSettings":
    from robocal_ros.hand_eye.camera import CameraSettings
    from robocal_ros.hand_eye.camera_fit import GivenNoise

    return CameraSettings(args.method, GivenNoise(*robot_sigma_of(args)), args.limit_mm * 1e-3)


def _tables(
    args: argparse.Namespace, file_column: str | None
) -> "tuple[PoseTable, PoseTable | None]":
    """The robot's poses that solve, and those that judge."""
    from robocal_ros.hand_eye.tables import read_pose_table

    arm = arm_of(args)
    used = read_pose_table(args.poses, arm, file_column)
    if args.check is None:
        return used, None
    judges = read_pose_table(args.check, arm, file_column)
    require_unused(judges, used)
    return used, judges


def _from_images(args: argparse.Namespace, settings: "CameraSettings") -> "HandEyeResult":
    from robocal_ros.hand_eye.board import Chessboard, intrinsics_document, read_intrinsics
    from robocal_ros.hand_eye.camera import CheckPairs, calibrate_camera

    columns, rows = args.board
    board = Chessboard(columns, rows, args.square_mm * 1e-3)
    intrinsics = None if args.intrinsics is None else read_intrinsics(args.intrinsics)
    used, judges = _tables(args, "image")
    pairs, seen = _pairs_of_images(used, args, board, intrinsics)
    check = None
    if judges is not None:
        held, shown = _pairs_of_images(judges, args, board, seen.intrinsics)
        check = CheckPairs(held, shown.rejected)
    return calibrate_camera(
        pairs,
        settings,
        check=check,
        rejected=seen.rejected,
        more={"intrinsics": intrinsics_document(seen, intrinsics is None)},
    )


def _pairs_of_images(
    table: "PoseTable", args: argparse.Namespace, board: "Chessboard",
    intrinsics: "Intrinsics | None",
) -> "tuple[PosePairs, SeenBoards]":  # fmt: skip
    from robocal_ros.hand_eye.board import board_pairs, read_images, see_boards

    images, unread = read_images(args.profiles, table)
    seen = see_boards(images, board, intrinsics)
    pairs = board_pairs(seen, table.names, table.T_base_flange, args.mount)
    return pairs, replace(seen, rejected=unread | seen.rejected)


def _from_poses(args: argparse.Namespace, settings: "CameraSettings") -> "HandEyeResult":
    from robocal_ros.hand_eye.camera import CheckPairs, calibrate_camera
    from robocal_ros.hand_eye.streams import calibrate_streams
    from robocal_ros.hand_eye.tables import read_pose_table

    robot, check = _tables(args, None)
    camera = read_pose_table(args.measured, None, None)
    tables = [robot, camera] if check is None else [robot, camera, check]
    stamped = all(table.stamp_ns is not None for table in tables)
    if stamped and not all(table.named for table in tables):
        origin_ns = int(min(_stamps(table)[0] for table in tables))
        streams = [_stream(table, origin_ns) for table in tables]
        judge = None if check is None else streams[2]
        return calibrate_streams(streams[0], streams[1], args.mount, settings, judge)
    if check is not None and not check.named:
        raise InputError("needs a column sample, as the measured poses", file=check.path, row=1)
    pairs, alone = _paired(robot, camera, args.mount)
    judges = None
    if check is not None:
        _require_other_samples(check, robot)
        held, absent = _paired(check, camera, args.mount)
        judges = CheckPairs(held, {name: absent[name] for name in check.names if name in absent})
        alone = {name: why for name, why in alone.items() if name not in held.names}
    return calibrate_camera(pairs, settings, check=judges, rejected=alone)


def _require_other_samples(judges: "PoseTable", used: "PoseTable") -> None:
    known = set(used.names)
    for name, row in zip(judges.names, judges.rows, strict=True):
        if name in known:
            raise InputError(
                f"{quoted(name)} is in --poses too: other samples must judge",
                file=judges.path, row=row, column="sample",
            )  # fmt: skip


def _stamps(table: "PoseTable") -> Any:
    if table.stamp_ns is None:
        raise ValueError("a table without stamps is no stream")
    return table.stamp_ns


def _stream(table: "PoseTable", origin_ns: int) -> "PoseStream":
    from robocal_ros.hand_eye.streams import stream_of

    return stream_of(_stamps(table), table.T_base_flange, table.names, origin_ns, table.path)


def _paired(
    robot: "PoseTable", camera: "PoseTable", mount: Any
) -> "tuple[PosePairs, dict[str, str]]":
    """Pairs of the same sample, or row; and the samples that only one table has."""
    from robocal_ros.hand_eye.camera_model import PosePairs

    if not robot.named and not camera.named and len(robot) != len(camera):
        raise InputError(
            f"has {len(camera)} rows, {robot.path} has {len(robot)}: name them in a column sample "
            "in both tables, or give stamp_s in both",
            file=camera.path,
        )
    place = {name: index for index, name in enumerate(camera.names)}
    rows = [index for index, name in enumerate(robot.names) if name in place]
    names = tuple(robot.names[index] for index in rows)
    if not names:
        raise InputError(f"has no sample of {robot.path}", file=camera.path, column="sample")
    pairs = PosePairs(
        robot.T_base_flange[rows],
        camera.T_base_flange[[place[name] for name in names]],
        names,
        mount,
    )
    alone = {name: f"not in {camera.path}" for name in robot.names if name not in place}
    known = set(robot.names)
    alone |= {name: f"not in {robot.path}" for name in camera.names if name not in known}
    return pairs, alone
