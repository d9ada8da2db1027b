# SPDX-License-Identifier: Apache-2.0
"""``robocal data``: published measurements that the commands can use, and their conversion.

Nothing is downloaded: the sets stand below the folder that ``ROBOCAL_DATA`` names, each under its
own name, as a clone of its repository or as a copy of the files that are named here.
"""

import argparse
import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.main import CliResult, Document, print_table, print_words
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest, quoted

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.documents import ConvertedDocument, DataDocument, DataSetDocument

Converted = tuple[str, list[Path]]  # how much a part holds, in words, and the files written
VARIABLE = "ROBOCAL_DATA"


@dataclass(frozen=True)
class PublishedSet:
    """A set of measurements.

    ``commit``: the state of the repository that was used here. ``size``: of the files that are
    needed. ``parts``: of a folder. ``convert``: a part of it, to a folder. ``commands``: what
    to do then; OUT stands for that folder, DATA for the set's own, PART for a part, ``example``
    where none is chosen.
    """

    title: str
    licence: str
    source: str
    commit: str
    size: str
    holds: tuple[str, ...]
    parts: Callable[[Path], list[str]]
    convert: Callable[[str, Path, Path], Converted]
    commands: tuple[str, ...]
    citation: str = ""
    example: str = ""


def _campaign(series: str, folder: Path, out: Path) -> Converted:
    from robocal_ros.bags.ur10_campaigns import convert_campaign
    from robocal_ros.hand_eye.published import convert_tmac

    words, files = convert_campaign(series, folder, out)
    if series not in ("B", "D"):  # C has the pairs of B again
        return words, files
    more, pairs = convert_tmac(series, folder, out)
    return f"{words}, {more}", [*files, *pairs]


def _panel_poses(part: str, folder: Path, out: Path) -> Converted:
    from robocal_ros.ground.files import read_text
    from robocal_ros.hand_eye.published import found
    from robocal_ros.kinematics.tables import write_measurements
    from robocal_ros.kinematics.universal_robots import (
        nominal_arm,
        parse_settings,
        read_panel_poses,
    )

    nominal, calibration = (
        found(folder, name) for name in ("urcontrol.conf.UR5", "calibration.conf")
    )
    settings = parse_settings(read_text(nominal, "configuration"), str(nominal))
    try:
        arm = nominal_arm(settings, "ur5e")
    except InputError as error:
        raise InputError(str(error), file=str(nominal)) from error
    data = read_panel_poses(found(folder, "joint-eef-data.csv"))
    files = [out / f"{part}.csv", out / nominal.name, out / calibration.name]
    out.mkdir(parents=True, exist_ok=True)
    write_measurements(files[0], data, arm)
    for path, copied in zip((nominal, calibration), files[1:], strict=True):
        shutil.copyfile(path, copied)
    return f"{len(data)} joint readings with the controller's poses", files


def _images(part: str, folder: Path, out: Path) -> Converted:
    from robocal_ros.hand_eye.published import convert_board

    return convert_board(folder, out)


def _streams(part: str, folder: Path, out: Path) -> Converted:
    from robocal_ros.hand_eye.published import convert_streams

    return convert_streams(folder, out)


def _profiles(part: str, folder: Path, out: Path) -> Converted:
    from robocal_ros.hand_eye.published import convert_laser

    return convert_laser(part, folder, out)


def _laser_parts(folder: Path) -> list[str]:
    from robocal_ros.hand_eye.published import laser_sets

    return list(laser_sets(folder))


SETS = {
    "ur10_tmac": PublishedSet(
        "UR10 before a Leica laser tracker with T-Mac, four campaigns in eight months",
        "MIT",
        "https://github.com/christianlandgraf/ipa-robot-accuracy",
        "507fba6",
        "3.7 MB",
        (
            "16811 poses of the T-Mac with the joint targets and the room's temperature: A, July "
            "2020, a grid, 11911 in 100 hours; B, 1495, 255 poses twice; C, 2773 at random; D, "
            "March 2021, 632",
            "25 and 26 pairs of flange and T-Mac poses (B, D) for a tracker's place",
        ),
        lambda folder: ["A", "B", "C", "D"],
        _campaign,
        (
            "robocal identify --robot ur10 --data OUT/PART_train.csv --check OUT/PART_check.csv",
            "robocal replay OUT/PART.mcap --robot ur10 --auto",
            "robocal hand-eye camera --poses OUT/PART_flange.csv --measured OUT/PART_tmac.csv "
            "--mount to-hand",
        ),
        "Landgraf, Ernst, Schleth, Fabritius, Huber, IEEE CASE 2021",
        "B",
    ),
    "ur5e_factory": PublishedSet(
        "the factory calibration of a UR5e, and what its controller makes of it",
        "MIT",
        "https://github.com/weijieyong/UR_kinematics_calib",
        "c4c579d",
        "5 kB",
        (
            "calibration.conf and urcontrol.conf.UR5 of one robot",
            "18 joint readings with the pose that the controller shows, to 0.01 mm and 0.01 deg",
        ),
        lambda folder: ["poses"],
        _panel_poses,
        (
            "robocal import-ur --calibration OUT/calibration.conf "
            "--nominal OUT/urcontrol.conf.UR5 --output OUT/ur5e.yaml",
            "robocal identify --robot OUT/ur5e.yaml --data OUT/poses.csv --fit base,tool "
            "--hold-out 0.5",
        ),
    ),
    "camera_hand_eye": PublishedSet(
        "a camera on the flange of a UR: images of a chessboard",
        "MIT",
        "https://github.com/wangrp1997/Hand-Eye-Calibration",
        "89ed177",
        "6.2 MB",
        ("20 images (640 x 480; 9 x 6 inner corners, 25 mm) with the flange's pose at each",),
        lambda folder: ["images"],
        _images,
        ("robocal hand-eye camera --poses OUT/poses.csv --images DATA --board 9x6 --square-mm 25",),
    ),
    "eth_hand_eye": PublishedSet(
        "a camera on a moving arm: both sides' poses with time stamps",
        "BSD-3-Clause",
        "https://github.com/ethz-asl/hand_eye_calibration",
        "966cd92",
        "0.7 MB",
        (
            "2817 poses of the arm and 1703 of a target before the camera, by one clock",
            "not converted: streams of a motion capture system, and simulated ones",
        ),
        lambda folder: ["real"],
        _streams,
        ("robocal hand-eye camera --poses OUT/arm.csv --measured OUT/board.csv",),
        "Furrer et al., FSR 2017",
    ),
    "line_laser_fanuc": PublishedSet(
        "line lasers on FANUC robots: profiles of a sphere and of an edge, from shop floors",
        "GPL-3.0-or-later, as a text in it says",
        "https://github.com/GilbertPan97/HandEyeSync",
        "70bc59e",
        "1.8 MB as tables",
        (
            "each set: the robot's program (.ls) and a profile (.yml) at each of its points; "
            "sphere of 40 mm radius, heights grow towards the sensor",
            "15 profiles of a sphere and 26 of an edge by one sensor, and sets of other cells",
        ),
        _laser_parts,
        _profiles,
        (
            "robocal hand-eye sphere --poses OUT/experiments_sphere/poses.csv --radius-mm 40 "
            "--z-grows towards",
            "robocal hand-eye line --poses OUT/experiments_edge/poses.csv --z-grows towards",
        ),
    ),
}


def add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", nargs="?", choices=list(SETS), metavar="NAME", help="a set; without it all are told"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="convert the set to tables and bags in this folder"
    )
    parser.add_argument(
        "--part",
        nargs="+",
        metavar="PART",
        help="with --out: these parts alone; default all (of ur10_tmac A B C D)",
    )


def run_data(args: argparse.Namespace) -> CliResult:
    given = os.environ.get(VARIABLE)
    root = Path(given) if given else None
    if args.out and not args.name:
        raise InputError("--out needs the name of the set to convert, see robocal data")
    if args.part and not args.out:
        raise InputError("--part needs --out, the folder to convert to")
    written = _convert(args.name, root, args.out, args.part) if args.out else []
    names = [args.name] if args.name else list(SETS)
    document: DataDocument = {
        "folder": given or None,
        "sets": [_told(name, root, args.out, args.part) for name in names],
        "written": written,
    }
    return CliResult(document, _show_written if written else _show_one if args.name else _show_all)


def _convert(
    name: str, root: Path | None, out: Path, chosen: list[str] | None
) -> "list[ConvertedDocument]":
    one = SETS[name]
    if root is None:
        raise InputError(f"set {VARIABLE} to the folder that holds {name}: robocal data {name}")
    folder = root / name
    if not folder.is_dir():
        raise InputError(
            f"no such folder: clone {one.source} there, see robocal data {name}", file=str(folder)
        )
    parts = one.parts(folder)
    if not parts:
        raise InputError(f"nothing of {name} is in this folder", file=str(folder))
    for part in chosen or []:
        if part not in parts:
            text = f"{quoted(part)} is no part of {name}{nearest(part, parts)}"
            raise InputError(f"{text}: {', '.join(parts)}")
    written: list[ConvertedDocument] = []
    for part in chosen or parts:
        words, files = one.convert(part, folder, out)
        written.append({"part": part, "holds": words, "files": [str(file) for file in files]})
    return written


def _told(
    name: str, root: Path | None, out: Path | None, chosen: list[str] | None
) -> "DataSetDocument":
    one = SETS[name]
    folder = None if root is None else root / name
    here = f"${VARIABLE}/{name}"
    commands = [command.replace("PART", (chosen or [one.example])[0]) for command in one.commands]
    if out is None:
        commands = [f"robocal data {name} --out OUT", *commands]
    elif chosen:  # what is of others is not there
        commands = [command for command in commands if _has_files(command, out)]
    data = shlex.quote(str(folder)) if folder and out else here
    return {
        "name": name,
        "title": one.title,
        "holds": list(one.holds),
        "licence": one.licence,
        "source": one.source,
        "commit": one.commit,
        "citation": one.citation or None,
        "size": one.size,
        "found": folder is not None and folder.is_dir(),
        "get": [f"git clone {one.source} {here}", f"git -C {here} checkout {one.commit}"],
        "commands": [_placed(command, out, data) for command in commands],
    }  # fmt: skip


def _placed(command: str, out: Path | None, data: str) -> str:
    """A command with its folders in place, as a shell takes them."""

    def place(word: str) -> str:
        if word == "DATA":
            return data
        own = out is not None and word.startswith("OUT/")
        return shlex.quote(f"{out}/{word.removeprefix('OUT/')}") if own else word

    return " ".join(map(place, command.split()))


def _has_files(command: str, out: Path) -> bool:
    """Whether the converted files that a command names are there."""
    files = [word.removeprefix("OUT/") for word in command.split() if word.startswith("OUT/")]
    return all((out / file).exists() for file in files)


def _show_all(console: "Console", document: Document) -> None:
    rows = [
        [one["name"], "yes" if one["found"] else "no", one["size"], one["licence"],
         one["title"]]
        for one in document["sets"]
    ]  # fmt: skip
    heads = ("set", "found", "size", "licence", "what")
    print_table(console, "Published measurements", heads, rows, words=(0, 1, 2, 3, 4))
    where = document["folder"] or f"nowhere: {VARIABLE} is not set"
    print_words(console, f"Looked for in {where}. Nothing is downloaded.")
    print_words(console, "More of one, and how to get it: robocal data NAME")


def _show_one(console: "Console", document: Document) -> None:
    (one,) = document["sets"]
    print_words(console, f"{one['name']}: {one['title']}", "bold")
    for words in one["holds"]:
        print_words(console, f"  {words}")
    print_words(console, f"Licence: {one['licence']}")
    by = f" ({one['citation']})" if one["citation"] else ""
    print_words(console, f"Source: {one['source']} at {one['commit']}{by}, {one['size']}")
    where = f"{document['folder'] or f'${VARIABLE}'}/{one['name']}"
    print_words(console, f"Found: {where}" if one["found"] else f"Not found in {where}; get it:")
    if not one["found"]:
        for command in one["get"]:
            print_words(console, f"  {command}")
    print_words(console, "What can be done with it:")
    for command in one["commands"]:
        print_words(console, f"  {command}")


def _show_written(console: "Console", document: Document) -> None:
    (one,) = document["sets"]
    for part in document["written"]:
        print_words(console, f"{part['part']}: {part['holds']}")
    print_words(console, f"Licence: {one['licence']}")
    print_words(console, "What can be done with it:")
    for command in one["commands"]:
        print_words(console, f"  {command}")
