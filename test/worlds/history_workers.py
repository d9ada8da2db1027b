# SPDX-License-Identifier: Apache-2.0
"""Processes of their own for the history tests: one that gets killed, two that race, a writer.

Run as ``python history_workers.py NAME ARGUMENTS``. They fork from a process that has everything
imported and holds no connection, so that a round takes milliseconds.
"""

import contextlib
import json
import os
import random
import resource
import signal
import sqlite3
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Proposal

SERIAL = "KR-7"
_BEGUN = b"begun"


def proposal(**changes: Any) -> Proposal:
    """A proposal that can be accepted on the nominal model."""
    plain: dict[str, Any] = {
        "model_hash": "nominal-a",
        "based_on": 0,
        "cycle_id": "morning",
        "stamp_ns": 1_700_000_000_000_000_000,
        "created_ns": 1_700_000_001_000_000_000,
        "software": "0.1.0",
        "method": "map",
        "code": Code.ACCEPT,
        "reason": "better by 0.2 mm",
        "candidate_rms_mm": 0.11,
        "document": {"verdict": {"accept": True}},
        "model": {"d": [0.1, 0.2 + 1e-17, 1 / 3]},
        "inputs": {"q": np.linspace(0.0, 1.0, 12).reshape(2, 6)},
    }
    return Proposal(**(plain | changes))


def accept_forever(folder: Path, said: int) -> None:
    """Propose and accept in a loop; each revision is told on ``said`` once it is in force."""
    with CalibrationHistory.open(SERIAL, state_dir=folder) as history:
        revision = history.head().revision
        os.write(said, f"{revision}\n".encode())
        while True:
            new = history.propose(proposal(based_on=revision))
            head = history.accept(new, by="child", reason="", wall_ns=1, expected_head=revision)
            revision = head.revision
            os.write(said, f"{revision}\n".encode())


def kill_while_accepting(folder: Path, rounds: int, seed: int) -> list[tuple[int, int, int]]:
    """Kill such a child at random moments; (killed, last revision told, revision found) each.

    In every second round it has accepted twice before, so that the kill meets it at work.
    """
    rng = random.Random(seed)
    seen = []
    for number in range(rounds):
        listen, said = os.pipe()
        child = os.fork()
        if child == 0:
            _leave_after(accept_forever, folder, said)
        os.close(said)
        with os.fdopen(listen, encoding="utf-8") as pipe:
            told = [pipe.readline().strip() for _ in range(3 * (number % 2))]
            time.sleep(rng.uniform(0.0, 0.04))
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            told += pipe.read().split()
        with CalibrationHistory.open(SERIAL, state_dir=folder) as history:
            found = history.head()
            entries = history.list(10**6)
        in_force = [entry.id for entry in entries if entry.revision == found.revision]
        consistent = found.calibration_id is None or in_force == [found.calibration_id]
        if not consistent or history.damaged is not None:
            raise RuntimeError(f"inconsistent: {found} {in_force} {history.damaged}")
        killed = int(os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL)
        seen.append((killed, int(told[-1]) if told else -1, found.revision))
    return seen


def race(folder: Path, rounds: int) -> list[list[str]]:
    """Two processes accept at the same time; the outcome of each, by round.

    Even rounds: the same calibration; odd rounds: two of them with the expected revision.
    The write lock is held until both have begun, so that neither can be through before the other.
    """
    ways = []
    for _ in range(2):
        (orders, ask), (tell, answer) = os.pipe(), os.pipe()
        child = os.fork()
        if child == 0:
            _leave_after(_answer, folder, orders, answer)
        os.close(orders)
        os.close(answer)
        ways.append((child, ask, tell))
    outcomes = []
    with (
        CalibrationHistory.open(SERIAL, state_dir=folder) as history,
        contextlib.closing(sqlite3.connect(history.path, isolation_level=None)) as gate,
    ):
        for number in range(rounds):
            head = history.head().revision
            ids = [history.propose(proposal(based_on=head)) for _ in range(2)]
            gate.execute("BEGIN IMMEDIATE")
            for place, (_, ask, tell) in enumerate(ways):
                chosen = ids[place if number % 2 else 0]
                os.write(ask, f"{chosen} {head}\n".encode())
                os.read(tell, len(_BEGUN))
            gate.execute("ROLLBACK")
            outcomes.append([os.read(tell, 100).decode() for _, _, tell in ways])
            if history.head().revision != head + 1:
                raise RuntimeError(f"round {number}: {history.head()} after {head}")
    for child, ask, _ in ways:
        os.write(ask, b"stop\n")
        os.waitpid(child, 0)
    return outcomes


def _answer(folder: Path, ask: int, tell: int) -> None:
    with (
        CalibrationHistory.open(SERIAL, state_dir=folder) as history,
        os.fdopen(ask, encoding="utf-8") as orders,
    ):
        while (line := orders.readline()) != "stop\n":
            chosen, head = (int(word) for word in line.split())
            os.write(tell, _BEGUN)
            try:
                history.accept(chosen, by="racer", reason="", wall_ns=1, expected_head=head)
                said = "done"
            except RobocalError as error:
                said = error.code.name
            os.write(tell, said.encode())


def open_at_once(folder: Path, rounds: int, processes: int) -> list[int]:
    """Processes that open the same new file at the same time; how many of each round failed."""
    failures = []
    for number in range(rounds):
        children = []
        start = time.monotonic() + 0.01
        for _ in range(processes):
            child = os.fork()
            if child == 0:
                _leave_after(_open_at, folder, f"new {number}", start)
            children.append(child)
        failures.append(sum(os.waitpid(child, 0)[1] != 0 for child in children))
    return failures


def _open_at(folder: Path, serial: str, start: float) -> None:
    time.sleep(max(0.0, start - time.monotonic()))
    with CalibrationHistory.open(serial, state_dir=folder) as history:
        history.propose(proposal())


def _leave_after(work: Callable[..., None], *arguments: Any) -> None:
    """End a forked child here, whatever happens in it."""
    try:
        work(*arguments)
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)


def write_beyond_limit(folder: Path, limit_bytes: int) -> list[str]:
    """Propose until the system refuses to write; then what the errors were."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
    said = []
    rng = np.random.default_rng(0)
    with CalibrationHistory.open(SERIAL, state_dir=folder) as history:
        for _ in range(100):
            try:
                history.propose(proposal(inputs={"q": rng.random(2_000)}))
            except RobocalError as error:
                said.append(f"{error.code.name} {error}")
    return said


if __name__ == "__main__":
    name, folder_name, *numbers = sys.argv[1:]
    works = {
        work.__name__: work
        for work in (kill_while_accepting, race, open_at_once, write_beyond_limit)
    }
    print(json.dumps(works[name](Path(folder_name), *(int(n) for n in numbers))))
