# SPDX-License-Identifier: Apache-2.0
"""Reading tables, bags and histories beside the plain library call that does the same."""

import csv
import os
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bench.tables import Table
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.ground.samples import Measurements
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import read_measurements, write_measurements

ROUNDS = 5
ROWS = 12_000
MESSAGES = 20_000


def tables() -> Sequence[Table]:
    """All tables of this module."""
    return [file_times()]


def file_times() -> Table:
    """Medians of interleaved runs; ratio: ours over the peer."""
    table = Table(
        "files",
        "Reading files, s",
        ("what", "ours", "peer", "peer's", "ratio"),
        f"Medians of {ROUNDS} turns each. Ours checks every cell, and names the one that is wrong.",
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what, peer, ours, theirs in (
            _table(folder),
            _bag(folder),
            _history(folder),
            _command(),
        ):
            own, other = _medians(ours, theirs)
            table.add(what, own, peer, other, own / other)
    return table


def _medians(ours: Callable[[], object], theirs: Callable[[], object]) -> tuple[float, float]:
    took: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for times, call in zip(took, (ours, theirs), strict=True):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
    return statistics.median(took[0]), statistics.median(took[1])


Row = tuple[str, str, Callable[[], object], Callable[[], object]]


def _table(folder: Path) -> Row:
    arm, rng = load_robot("ur10"), np.random.default_rng(0)
    path = folder / "long.csv"
    data = Measurements(
        q=rng.uniform(-2, 2, (ROWS, arm.n)),
        position=rng.normal(size=(ROWS, 3)),
        target=("tool",) * ROWS,
        sample=tuple(map(str, range(ROWS))),
        sigma=np.full(ROWS, 1e-5),
    )
    write_measurements(path, data, arm)

    def plain() -> object:
        with path.open(newline="") as stream:
            return [[*map(str, row)] for row in csv.reader(stream)]

    return f"table of {ROWS} rows", "csv.reader", lambda: read_measurements(path, arm), plain


def _bag(folder: Path) -> Row:
    path, store = folder / "long.mcap", get_typestore(Stores.ROS2_JAZZY)
    names = [f"joint_{i}" for i in range(1, 7)]
    header = {"stamp": ros_time(0), "frame_id": ""}
    with BagWriter(path) as writer:
        for i in range(MESSAGES):
            message = {"header": header, "name": names, "position": np.full(6, float(i))}
            message |= {"velocity": np.zeros(0), "effort": np.zeros(0)}
            writer.write("/joint_states", "sensor_msgs/msg/JointState", message, i * 8_000_000)

    def read(raw: bool) -> list[object]:
        with BagReader(path) as bag:
            return [m.message for m in bag.messages(raw=raw)]

    def decoded_by_rosbags() -> list[object]:
        kind = "sensor_msgs/msg/JointState"
        return [store.deserialize_cdr(data, kind) for data in read(raw=True)]  # type: ignore[arg-type]

    what = f"bag of {MESSAGES} joint states, decoded"
    return what, "raw read, then rosbags' decoder", lambda: read(raw=False), decoded_by_rosbags


def _history(folder: Path) -> Row:
    with CalibrationHistory.open("bench", state_dir=folder) as history:
        path = history.path
    with sqlite3.connect(path) as raw:
        raw.execute("CREATE TABLE ballast (content BLOB)")
        raw.executemany("INSERT INTO ballast VALUES (?)", [(os.urandom(40_000),)] * 1000)
    raw.close()

    def opened() -> int:
        with CalibrationHistory.open("bench", state_dir=folder) as history:
            return history.head().revision

    def checked() -> object:
        with sqlite3.connect(path) as connection:
            return connection.execute("PRAGMA integrity_check").fetchone()

    return "history of 40 MB, opened and checked", "integrity_check", opened, checked


def _command() -> Row:
    def run(*words: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *words], capture_output=True, check=True)

    ours = run("-m", "robocal_ros.cli.main", "--help")
    return "robocal --help", "python -c pass", ours, run("-c", "pass")
