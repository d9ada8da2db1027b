# SPDX-License-Identifier: Apache-2.0
"""How fast a bag is replayed, beside the library that decodes it. The shift is simulated."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rosbags.highlevel import AnyReader

from bench.long_shift import JOINTS, ROBOT, LongShift, write_shift
from bench.tables import Goal, Table
from robocal_ros.bags.bags import BagReader, bag_info
from robocal_ros.bags.replay import one_by_one
from robocal_ros.ground.samples import JointBlock, StandstillRule, joint_sample
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.observations import ObservationDesk

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = ROOT / "out" / "golden_shift.mcap"  # of bags/make_golden_shift.py
HOURS = (2.0, 8.0)
TURNS = 3
BAGS = 8  # of the longer length, validated one after the other, then beside each other
COUNTS = 100_000_000  # of a process that only counts
CORES = 2
LEAST_RATIO = 5.0  # to the decoded rate
LEAST_TIMES = 500.0  # real time
MOST_GROWTH = 1.1  # of memory and of cost per hour, from the shorter bag to the longer
LEAST_GAIN = 1.7  # of two cores over one


def tables() -> list[Table]:
    """Ingestion, whole replays of two lengths, many bags beside each other, and a whole cell's."""
    with tempfile.TemporaryDirectory() as name:
        shifts = [write_shift(Path(name) / f"{hours:g}h.mcap", hours) for hours in HOURS]
        whole = [_whole_cell(GOLDEN, Path(name) / "golden")] if GOLDEN.exists() else []
        return [_ingestion(shifts[0]), _replays(shifts), _many(shifts[-1]), *whole]


def _ingestion(shift: LongShift) -> Table:
    ways = {"rosbags, decoded": _decoded, "rosbags, raw": _raw, "ours, as far as the desk": _ours}
    took: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(TURNS):
        for name, way in ways.items():
            took[name].append(_cpu_s(way, shift))
    rates = {name: shift.joint_states / statistics.median(times) for name, times in took.items()}
    decoded = rates["rosbags, decoded"]
    table = Table(
        "joint_ingestion",
        f"Joint states read from a bag of {shift.joint_states}, per second of one core",
        ("what", "per second", "over decoded", "goal"),
        f"Medians of {TURNS} turns each, in turn. Ours are then in order of time in the session's "
        "stream, clock jumps and pauses looked after.",
    )
    for name, rate in rates.items():
        ratio = rate / decoded
        goal = Goal(ratio, LEAST_RATIO, at_least=True) if name.startswith("ours") else None
        table.add(name, rate, ratio, goal)
    return table


def _cpu_s(way: Callable[[LongShift], int], shift: LongShift) -> float:
    start = time.process_time()
    count = way(shift)
    took = time.process_time() - start
    if count != shift.joint_states:
        raise RuntimeError(f"{count} of {shift.joint_states} joint states were read")
    return took


def _raw(shift: LongShift) -> int:
    with AnyReader([shift.path]) as bag:
        return sum(1 for _ in bag.messages([c for c in bag.connections if c.topic == JOINTS]))


def _decoded(shift: LongShift) -> int:
    count = 0
    with AnyReader([shift.path]) as bag:
        connections = [c for c in bag.connections if c.topic == JOINTS]
        for connection, _, data in bag.messages(connections):
            bag.deserialize(data, connection.msgtype)
            count += 1
    return count


class _Desk:
    """A desk that no command waits for, as a replay gives readings to it."""

    def __init__(self) -> None:
        self.desk = ObservationDesk(load_robot(ROBOT).joint_names, StandstillRule())

    def take_plain(self, block: JointBlock, start: int) -> int:
        return self.desk.take_plain(block, start, None)


def _ours(shift: LongShift) -> int:
    session = _Desk()
    with BagReader(shift.path) as bag:
        for one in one_by_one(session, bag.messages([JOINTS], blocks=[JOINTS])):
            session.desk.add_joints(joint_sample(one.message))
    return session.desk.received[JOINTS]


# What the parent had counts as the peak of its child in os.wait4; this does not.
_RUN = """
import sys
from pathlib import Path
from robocal_ros.cli.main import main
status = main(sys.argv[1:])
lines = Path("/proc/self/status").read_text().splitlines()
print(next(line for line in lines if line.startswith("VmHWM")).split()[1], file=sys.stderr)
sys.exit(status)
"""


class _Cost(NamedTuple):
    wall_s: float
    cpu_s: float
    peak_mb: float


def _replays(shifts: list[LongShift]) -> Table:
    table = Table(
        "replay_speed",
        "robocal replay of a shift: 125 Hz joint states, temperatures, a measuring cycle in five "
        "minutes",
        ("bag, h", "joint states", "cycles", "bag, MB", "took, s", "of a core, s",
         "times real time", "goal", "core s per h", "goal ", "memory, MB", "goal  "),
        "One process from its start to its answer. Cost per hour and memory must not grow with the "
        "length.",
    )  # fmt: skip
    first: _Cost | None = None
    for shift in shifts:
        cost, hours = _replayed(shift), shift.duration_s / 3600.0
        times, per_hour = shift.duration_s / cost.wall_s, cost.cpu_s / hours
        goals: list[Goal | None] = [None, None]
        if first is not None:
            most_per_hour = MOST_GROWTH * first.cpu_s / (shifts[0].duration_s / 3600.0)
            most_mb = MOST_GROWTH * first.peak_mb
            goals = [Goal(per_hour, most_per_hour), Goal(cost.peak_mb, most_mb)]
        first = first or cost
        table.add(
            hours, shift.joint_states, len(shift.windows) - 1, shift.path.stat().st_size / 1e6,
            cost.wall_s, cost.cpu_s, times, Goal(times, LEAST_TIMES, at_least=True),
            per_hour, goals[0], cost.peak_mb, goals[1],
        )  # fmt: skip
    return table


def _replayed(shift: LongShift) -> _Cost:
    """Cost of the command with the shift's windows."""
    cold, *warm = (f"{start:.3f}:{end:.3f}" for start, end in shift.windows)
    windows = [word for window in warm for word in ("--warm", window)]
    return _cost(["replay", str(shift.path), "--robot", ROBOT, "--json", "--cold", cold, *windows])


def _cost(words: list[str]) -> _Cost:
    """Cost of a command in a process of its own."""
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *words], capture_output=True, text=True, check=True
    )
    wall_s, after = time.perf_counter() - start, os.times()
    cpu_s = sum(after[2:4]) - sum(before[2:4])  # of children that have ended
    return _Cost(wall_s, cpu_s, float(done.stderr.split()[-1]) / 1024.0)


def _whole_cell(bag: Path, report: Path) -> Table:
    """Two nodes' sessions, thousands of truths, the course of the cell: all that validate does."""
    info = bag_info(bag)
    duration_s = ((info.end_ns or 0) - (info.start_ns or 0)) * 1e-9
    cost = _cost(["validate", str(bag), "--report", str(report)])
    table = Table(
        "whole_cell",
        f"robocal validate of {bag.name}: {duration_s / 3600.0:.2f} h of a whole cell, its thermal "
        "and its tool's session as recorded, its truth",
        ("messages", "bag, MB", "took, s", "of a core, s", "times real time", "memory, MB"),
        "One process from its start to its report.",
    )
    table.add(
        info.messages, bag.stat().st_size / 1e6, cost.wall_s, cost.cpu_s,
        duration_s / cost.wall_s, cost.peak_mb,
    )  # fmt: skip
    return table


def _many(shift: LongShift) -> Table:
    hours = shift.duration_s / 3600.0
    table = Table(
        "many_bags",
        f"robocal validate of {BAGS} bags of {hours:.2f} h each",
        ("what", "processes", "took, s", "times real time", "gain", "goal"),
        "From the start of the command to its report, the start of the processes included. What "
        "this machine's cores give at the most: as many processes that only count.",
    )
    bags = [shift.path.with_name(f"bag-{number}.mcap") for number in range(1, BAGS + 1)]
    for bag in bags:
        os.link(shift.path, bag)
    alone_s = _validated(bags, 1)
    for jobs, took_s in ((1, alone_s), (CORES, _validated(bags, CORES))):
        gain = alone_s / took_s
        goal = Goal(gain, LEAST_GAIN, at_least=True) if jobs > 1 else None
        table.add("validate", jobs, took_s, BAGS * shift.duration_s / took_s, gain, goal)
    alone_s = _counted(1)
    for jobs, took_s in ((1, alone_s), (CORES, _counted(CORES))):
        table.add("counting", jobs, took_s, None, alone_s / took_s, None)
    return table


def _counted(jobs: int) -> float:
    """Time, s, in which as many processes as there are cores count, so many of them at once."""
    command = [sys.executable, "-c", f"for _ in range({COUNTS}): pass"]
    start = time.perf_counter()
    for _ in range(CORES // jobs):
        beside = [subprocess.Popen(command) for _ in range(jobs)]
        for process in beside:
            process.wait()
    return time.perf_counter() - start


def _validated(bags: list[Path], jobs: int) -> float:
    """Time, s, of the command in a process of its own."""
    command = [sys.executable, "-m", "robocal_ros.cli.main", "validate", *map(str, bags)]
    report = bags[0].with_name(f"report-{jobs}")
    command += ["--robot", ROBOT, "--jobs", str(jobs), "--report", str(report)]
    start = time.perf_counter()
    subprocess.run(command, capture_output=True, text=True, check=True)
    return time.perf_counter() - start
