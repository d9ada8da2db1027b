# SPDX-License-Identifier: Apache-2.0
"""Measurements that others published for the hand-eye, as pairs, streams and tables of commands.

A UR10 with a T-Mac (Landgraf et al. 2021, MIT), a UR with a camera (wangrp1997, MIT), an arm with
a camera and time stamps (Furrer et al. 2017, BSD-3-Clause), line lasers on FANUC robots
(HandEyeSync). Files are found by name anywhere below the folder of a set, so that a clone of its
repository serves as it is. All of it raises `InputError`, with file and row, for what is not there
or is not the published form; a ``convert_…`` reads a part whole before it writes, and returns in
words how much it holds, and the files.
"""

import re
import shutil
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted, read_text
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.files import PROFILE, read_pose_table, read_profiles, write_pose_table
from robocal_ros.kinematics.tables import (
    FANUC,
    POSITION,
    read_published,
    texts,
    write_cells,
)
from robocal_ros.programs.fanuc import FanucDialect

Array = NDArray[np.float64]
Converted = tuple[str, list[Path]]

FLANGE = ("flange_x", "flange_y", "flange_z", "flange_qx", "flange_qy", "flange_qz", "flange_qw")
TMAC = tuple(f"measurement_{name}" for name in ("x", "y", "z", "rx", "ry", "rz"))
TCP_POSES = "tcp_pose_Fri_Nov_25_17-19-40_2022.txt"
STREAM = "robot_arm_complete_bag_color_and_ir_{}.csv"
ARM, CAMERA = "base_link_sr300_hinge", "target_ir"


def found(folder: Path, name: str) -> Path:
    """The one file of this name below ``folder``."""
    paths = sorted(folder.rglob(name))
    if not paths:
        raise InputError(f"there is no {name} in this folder", file=str(folder))
    if len(paths) > 1:
        raise InputError(f"two files are called {name}: {paths[0]}, {paths[1]}", file=str(folder))
    return paths[0]


def tmac_pairs(series: str, folder: Path) -> PosePairs:
    """Flange poses and T-Mac poses of series B or D: the tracker stands still."""
    table = read_published(
        folder / f"Series_{series}" / "calibration_handeye.csv", (*FLANGE, *TMAC), ";"
    )
    flange, measured = (
        np.stack([table.numbers(name) for name in names], axis=1) for names in (FLANGE, TMAC)
    )
    turn = Rotation.from_euler("XYZ", measured[:, 3:], degrees=True).as_matrix()
    return PosePairs(
        frames.transform_from_quat(flange[:, :3], flange[:, 3:]),
        frames.transform(turn, measured[:, :3] * 1e-3),
        tuple(map(str, table.rows)),
        "to-hand",
    )


def convert_tmac(series: str, folder: Path, out: Path) -> Converted:
    """Write both sides of `tmac_pairs`."""
    pairs = tmac_pairs(series, folder)
    sides = {"flange": pairs.T_base_flange, "tmac": pairs.T_camera_board}
    files = [out / f"{series}_{side}.csv" for side in sides]
    out.mkdir(parents=True, exist_ok=True)
    for path, T in zip(files, sides.values(), strict=True):
        write_pose_table(path, T)
    return f"{len(pairs)} pairs of flange and T-Mac", files


def board_shots(folder: Path) -> tuple[Array, list[Path]]:
    """Flange poses (n, 4, 4), m, and the images of a chessboard taken there."""
    path = found(folder, TCP_POSES)
    rows = []
    for row, line in enumerate(read_text(path, "table").splitlines(), start=1):
        cells = line.strip(" []").split()
        if cells:
            rows.append(_numbers(cells, 6, "x y z (m) and a rotation vector (rad)", path, row))
    values = _some(rows, path)
    images = [found(folder, f"image{index:02d}.bmp") for index in range(1, len(rows) + 1)]
    T = frames.transform(Rotation.from_rotvec(values[:, 3:]).as_matrix(), values[:, :3])
    return T, images


def convert_board(folder: Path, out: Path) -> Converted:
    """Write the poses of `board_shots`; images stay where they are."""
    T, images = board_shots(folder)
    path = out / "poses.csv"
    out.mkdir(parents=True, exist_ok=True)
    names = [str(image.relative_to(folder)) for image in images]
    write_pose_table(path, T, names, file_column="image")
    return f"{len(names)} images of a chessboard", [path]


def _numbers(cells: Sequence[str], count: int, what: str, path: Path, row: int) -> list[float]:
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise InputError(f"{quoted(' '.join(cells))} is not {what}", file=str(path), row=row)
    return numbers


def _some(rows: list[list[float]], path: Path) -> Array:
    if not rows:
        raise InputError("holds no poses", file=str(path))
    return np.array(rows)


def stream_rows(which: str, folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (n,), ns, and poses (n, 4, 4), m, of one side: the flange's, or T_camera_board."""
    path = found(folder, STREAM.format(which))
    stamps, rows = [], []
    for row, line in enumerate(read_text(path, "stream").splitlines(), start=1):
        time, *cells = line.split(",")
        if not time.strip():
            continue
        try:
            stamps.append(int(Decimal(time.strip()).scaleb(9)))
        except (InvalidOperation, ValueError, OverflowError) as error:
            text = f"{quoted(time)} is not seconds since 1970"
            raise InputError(text, file=str(path), row=row) from error
        rows.append(_numbers(cells, 7, "x, y, z (m) and a quaternion", path, row))
    values = _some(rows, path)
    T = frames.transform_from_quat(values[:, :3], values[:, 3:])
    if which == CAMERA:
        T = frames.invert(T)  # the file has the camera in the target's frame
    return np.array(stamps, dtype=np.int64), T


def convert_streams(folder: Path, out: Path) -> Converted:
    """Write the stream of the arm, and that of the camera."""
    sides = {name: stream_rows(which, folder) for name, which in (("arm", ARM), ("board", CAMERA))}
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"{name}.csv" for name in sides]
    for path, (stamps, T) in zip(files, sides.values(), strict=True):
        write_pose_table(path, T, stamp_ns=stamps)
    (arm, _), (camera, _) = sides.values()
    return f"{len(arm)} poses of the arm, {len(camera)} of the board", files


# ---- line lasers on FANUC robots: a program .ls whose P[1] … are where p1.yml … were taken ------


def laser_sets(folder: Path) -> dict[str, Path]:
    """Folders of the sets, by a name of small letters: as they are published, or as tables.

    ``data/Experiments/Sphere`` of the repository is ``experiments_sphere``.
    """
    places = {path.parent for name in ("*.ls", "poses.csv") for path in folder.rglob(name)}
    sets = {}
    for place in sorted(places):
        parts = place.relative_to(folder).parts
        words = "_".join(parts[1:] if parts[:1] == ("data",) else parts).lower()
        if words and (list(place.glob("p[0-9]*.yml")) or (place / "poses.csv").is_file()):
            sets[re.sub(r"[^a-z0-9_-]", "", words)] = place
    return sets


def convert_laser(name: str, folder: Path, out: Path) -> Converted:
    """Write ``poses.csv`` and a table for each profile of one of `laser_sets`, values unchanged."""
    sets = laser_sets(folder)
    if name not in sets:
        raise InputError(f"there is no set {name} in this folder", file=str(folder))
    place, out = sets[name], out / name
    poses = place / "poses.csv"
    if poses.is_file():
        table = read_pose_table(poses)
        read_profiles(place, table)  # each of them, so that damage is told here
        files = [out / "poses.csv", *(out / file for file in table.files)]
        for path in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(place / path.relative_to(out), path)
        return f"{len(table)} profiles", files
    programs = sorted(place.glob("*.ls"))
    if len(programs) > 1:
        raise InputError(
            f"two programs, {programs[0].name} and {programs[1].name}: keep the one whose points "
            "the profiles were taken at", file=str(place),
        )  # fmt: skip
    shown = _program_points(programs[0])
    shots: dict[int, Array] = {}
    for path in sorted(place.glob("p[0-9]*.yml")):
        number = re.fullmatch(r"p(\d+)\.yml", path.name)
        if number is None:
            raise InputError("a profile is called p1.yml, p2.yml …", file=str(path))
        if int(number[1]) not in shown:
            text = f"{programs[0].name} has no point P[{number[1]}] with a pose of the flange"
            raise InputError(text, file=str(path))
        shots[int(number[1])] = _published_profile(path)
    numbers = sorted(shots)
    columns = {
        "sample": [str(number) for number in numbers],
        "profile": [f"p{number}.csv" for number in numbers],
    }
    values = np.array([shown[number] for number in numbers])
    columns |= dict(zip((*POSITION["mm"], *FANUC), map(texts, values.T), strict=True))
    out.mkdir(parents=True, exist_ok=True)
    for file, index in zip(columns["profile"], numbers, strict=True):
        write_cells(out / file, dict(zip(PROFILE, map(texts, shots[index].T), strict=True)))
    write_cells(out / "poses.csv", columns)
    return f"{len(numbers)} profiles", [
        out / "poses.csv", *(out / f"p{number}.csv" for number in numbers)
    ]  # fmt: skip


def _program_points(path: Path) -> dict[int, list[float]]:
    """X, Y, Z (mm), W, P, R (deg) of the points that tell where the flange was, by number."""
    shown = {}
    for point in FanucDialect().read(read_text(path, "program")).points:
        number = re.match(r"P\[(\d+)\]", point.name)
        flange = (point.frame, point.tool) == ("UF0", "UT0")
        if number and flange and not (point.joints or point.problem):
            shown[int(number[1])] = point.numbers
    return shown


def _published_profile(path: Path) -> Array:
    """Profile (n, 2), mm: x and z of triples x, 0, z, in a list that OpenCV's FileStorage wrote.

    Its first line, ``%YAML:1.0``, is none that YAML knows.
    """
    text = read_text(path, "profile")
    listed = re.search(r"^profile:\s*\[([^\]]*)\]", text, re.MULTILINE)
    cells = listed[1].split(",") if listed else []
    try:
        values = np.array([float(cell) for cell in cells])
    except ValueError:
        values = np.empty(0)
    if not values.size or values.size % 3 or np.any(values[1::3]):
        raise InputError(
            "has no whole list 'profile' of triples x, 0, z, as HandEyeSync writes it",
            file=str(path),
        )
    return values.reshape(-1, 3)[:, ::2]
