# SPDX-License-Identifier: Apache-2.0
"""The long form of what the tests show briefly: ``make soak``, or ``python -m bench.soak --short``.

Kills at random moments, other random examples in each round, hours of a live graph, more simulated
robots, shifts and faults of the whole cell. Writes out/soak/soak.md, with ``--keep``
docs/figures/soak.md too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench import monte_carlo
from bench.closed_loop import tables as closed_loop
from bench.tables import Goal, Table, about, show

ROOT = Path(__file__).resolve().parent.parent
OUT, KEPT = ROOT / "out" / "soak", ROOT / "docs" / "figures"

MOST_GROWTH_MB = 10.0
HOSTILE = 2000  # requests


@dataclass(frozen=True)
class Amount:
    """How much of each."""

    history_kills: int
    history_runs: int
    seeds: int
    live_s: float
    robots: int
    shift_s: float


LONG = Amount(2000, 1000, 40, 3600.0, 6000, 3600.0)
SHORT = Amount(300, 50, 2, 120.0, 600, 900.0)


# Tests whose long form is told by itself; of which the others are, each file tells.
LONG_FORM = {"ROBOCAL_LONG": "1"}
AGAIN = ("--reruns", "2", "--rerun-except", "^JumpError: ")  # node tests, as the Makefile says
LONG_FORMS = (
    ("thermal_node killed during ~/accept, kill -9", 60, "test/nodes/test_thermal_node.py"),
    ("all nodes of a correction killed together, in each order", 6,
     "test/nodes/test_joint_correction_restarts.py"),
    ("the nineteen faults of a cell's tool side over DDS, each with its code", 1,
     "test/nodes/test_fault_matrix.py"),
    ("real measurements through live nodes and their replay, bit for bit", 2,
     "test/nodes/test_real_replay.py"),
)  # fmt: skip


def _other_long_forms() -> list[tuple[str, list[str]]]:
    """Each room of ``test/``, and its files that take more cases and draws in the long form."""
    told = {file for *_, file in LONG_FORMS}
    rooms: dict[str, list[str]] = {}
    for path in sorted((ROOT / "test").rglob("test_*.py")):
        file = str(path.relative_to(ROOT))
        text = path.read_text()
        if file not in told and ("from long_form import" in text or "pytest.mark.long" in text):
            rooms.setdefault(path.parent.name, []).append(file)
    return list(rooms.items())


def _pytest(*words: str, **variables: str) -> bool:
    """Whether these tests pass; what they say goes to the terminal."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | variables, check=False)
    return done.returncode == 0


def endurance(amount: Amount) -> Table:
    """Kills, random work on a history, properties with other examples."""
    table = Table(
        "endurance",
        "Endurance",
        ("what", "how often", "failed", "goal", "took, s"),
        "After a kill the old or the new state is in force, whole; properties hold for other "
        "random examples in each round.",
    )

    def add(what: str, count: int, work: Callable[[], int]) -> None:
        start = time.monotonic()
        failed = work()
        table.add(what, count, int(failed), Goal(failed, 0), round(time.monotonic() - start))

    add("history killed while it accepts, kill -9", amount.history_kills,
        lambda: _history_kills(amount.history_kills))  # fmt: skip
    for what, count, file in LONG_FORMS:
        add(what, count, lambda file=file: not _pytest(file, **LONG_FORM))
    add("whole gaps of a live cell at the limits as they are set, and its calls' times", 1,
        lambda: not _pytest("test/nodes/soak_maintenance.py"))  # fmt: skip
    add("sensor, sphere or robot knocked in a live cell, each told in the next gap", 1,
        lambda: not _pytest("test/nodes/soak_knocks.py"))  # fmt: skip
    add("a beam station found again in a live gap, and knocked; replayed as live", 1,
        lambda: not _pytest("test/nodes/soak_laser_frame.py"))  # fmt: skip
    add("hostile requests to a live bridge and a live page", HOSTILE, lambda: not _hostile())
    for room, files in _other_long_forms():
        add(f"tests of {room} with all their cases and draws: files", len(files),
            lambda room=room, files=files: not _pytest(
                *files, *(AGAIN if room == "nodes" else ()), **LONG_FORM))  # fmt: skip
    add("random work of several users on one history, 100 steps each", amount.history_runs,
        lambda: _history_runs(amount.history_runs))  # fmt: skip
    properties = ("-m", "hypothesis and not ros", "test", "--ignore=test/nodes")
    add("all property tests, each time with other examples", amount.seeds,
        lambda: sum(not _pytest(*properties, f"--hypothesis-seed={seed}", **LONG_FORM)
                    for seed in range(amount.seeds)))  # fmt: skip
    return table


def _hostile() -> bool:
    from bench.soak_hostile import soak

    return soak(HOSTILE).met


def _history_kills(count: int) -> int:
    """How many kills left neither the old nor the new state."""
    worker = ROOT / "test" / "worlds" / "history_workers.py"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, worker, "kill_while_accepting", folder, count, time.time_ns()]
        done = subprocess.run([str(w) for w in command], stdout=subprocess.PIPE, check=True)
    failed = before = 0
    for killed, told, found in json.loads(done.stdout):
        old = before if told < 0 else told
        failed += not (killed and found in (old, old + 1))
        before = found
    return failed


def _history_runs(count: int) -> int:
    from hypothesis import settings
    from hypothesis.stateful import run_state_machine_as_test

    sys.path[:0] = [str(ROOT / "test" / folder) for folder in ("history", "worlds")]
    from test_history_rules import History

    plan = settings(max_examples=count, stateful_step_count=100, deadline=None, database=None)
    try:
        run_state_machine_as_test(History, settings=plan)
    except AssertionError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def live(seconds: float) -> Table:
    """thermal_node and joint_correction_node under load: latency, loss and memory."""
    from bench.soak_graph import LoadedGraph

    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    with tempfile.TemporaryDirectory() as folder, closing(LoadedGraph(Path(folder))) as graph:
        graph.run(min(60.0, seconds / 2))  # until caches are full
        begin = graph.memory_mb()
        graph.forget()
        graph.run(seconds)
        end, lost = graph.memory_mb(), graph.lost()
    table = Table(
        "live",
        f"Live graph under load for {seconds:.0f} s",
        (
            "node",
            "answer",
            "n",
            "median, ms",
            "99 %, ms",
            "longest, ms",
            "memory, MB",
            "grew, MB",
            "goal",
        ),
        f"{graph.RATE_HZ} joint states and {graph.RATE_HZ} joint targets per second, a correction "
        f"in force; {lost} of them had no answer. Latency from one Python process to the node and "
        "back. Memory: resident; growth after the first minute.",
    )
    for name, what, times in graph.latencies():
        ms = np.array(times) * 1e3
        grew = end[name] - begin[name]
        table.add(
            name, what, len(ms), float(np.median(ms)), float(np.quantile(ms, 0.99)),
            float(ms.max()), end[name], grew, Goal(grew, MOST_GROWTH_MB),
        )  # fmt: skip
    return table


def correction(seconds: float) -> Table:
    """joint_correction_node at 250 Hz while its models change."""
    from bench.soak_correction import soak

    return soak(seconds)


def stalls() -> Table:
    """joint_correction_node stopped in a fast stream."""
    from bench.soak_stalls import DIRECT_RUNS, soak

    return soak(DIRECT_RUNS)


def shift(seconds: float) -> Table:
    """A whole cell at real time, driven by a PLC."""
    from bench.soak_shift import soak

    return soak(seconds)


def simulated(robots: int) -> Sequence[Table]:
    """The simulated truth of ``make bench``, with more robots and so with narrower bounds."""
    monte_carlo.RUNS = robots
    return [monte_carlo.efficiency_table(), monte_carlo.sigma_table()]


def _write(folder: Path, tables: Sequence[Table], words: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    body = "\n".join(table.markdown() for table in tables)
    (folder / "soak.md").write_text(f"Made by {words}.\n\n{body}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Do all of it; 1 when something failed or a goal is missed."""
    parser = argparse.ArgumentParser(prog="python -m bench.soak", description=__doc__)
    parser.add_argument("--short", action="store_true", help="fewer rounds, to see that it works")
    parser.add_argument("--keep", action="store_true", help="write docs/figures too")
    given = parser.parse_args(arguments)
    amount = SHORT if given.short else LONG
    start = time.monotonic()
    streams = (live(amount.live_s), correction(amount.live_s), stalls())
    tables = [*streams, shift(amount.shift_s), *simulated(amount.robots)]
    if not given.short:
        tables += closed_loop.tables(closed_loop.LONG)
    tables.append(endurance(amount))
    show(tables)
    facts = about(time.monotonic() - start) | {"cpus": str(os.cpu_count())}
    command = "make soak SOAK=--short" if given.short else "make soak"
    words = f"`{command}`: " + ", ".join(f"{name} {value}" for name, value in facts.items())
    for folder in (OUT, KEPT) if given.keep else (OUT,):
        _write(folder, tables, words)
        print(f"written: {folder / 'soak.md'}")
    return 0 if all(table.met for table in tables) else 1


if __name__ == "__main__":
    sys.exit(main())
