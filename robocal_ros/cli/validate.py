# SPDX-License-Identifier: Apache-2.0
"""``robocal validate``: any number of bags replayed and judged, with one report of them all.

Jobs go out and results come back. A bag whose process dies is told, the others go on.
"""

import argparse
import multiprocessing
import os
import pickle
import platform
import signal
import sys
import tempfile
import threading
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from multiprocessing import forkserver
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros import __version__
from robocal_ros.cli.main import (
    DONE,
    NO_ANSWER,
    ROBOT_HELP,
    CliResult,
    Document,
    count,
    crash,
    input_topic,
    print_table,
    print_words,
    progress_console,
    refusal,
)
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.files import write_text

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.cli.validating import Job, Validated
    from robocal_ros.report.figures import Drawn


# ---- many bags beside each other: in processes of this machine, or in a Dask cluster ------------


PATIENCE_S = 10  # with a cluster
KILLED = "the process that replayed it was killed, for want of memory? Try --jobs 1"
_PRELOADED = [
    "robocal_ros.cli.validating",
    # what a bag needs in the course of things
    "robocal_ros.kinematics.kernels",
    "robocal_ros.ground.serialized",
    "matplotlib.backends.backend_agg",
    "matplotlib.backends.backend_svg",
    "scipy.special",
]
Numbered = tuple[int, "Validated"]


def warm_up() -> None:
    """Let the server of worker processes read the code, beside what this process does meanwhile.

    Workers are its forks, from a process of one thread: they begin at once, where each would
    otherwise import everything anew. They inherit that Ctrl-C is not for them.
    """
    forkserver.set_forkserver_preload(_PRELOADED)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)


def validated(jobs: "Sequence[Job]", workers: int, scheduler: str | None) -> "Iterator[Numbered]":
    """Each job's number and result, as they become ready.

    ``workers``: processes on this machine (see `warm_up`); with one all is done in this process.
    ``scheduler``: address of a running Dask cluster, which is used instead; it must see the bags by
    the same paths, and have this software.
    """
    if scheduler is not None:
        with _cluster(scheduler) as client:
            yield from _from_cluster(client, jobs)
    elif workers > 1:
        with _Slots(workers) as slots:
            yield from slots.validated(jobs)
    else:
        from robocal_ros.cli.validating import validate_bag

        for number, job in enumerate(jobs):
            try:
                yield number, validate_bag(job)
            except Exception as error:
                yield number, _lost(job, error)


def _lost(job: "Job", error: BaseException) -> "Validated":
    """A bag whose replay crashed, or that a cluster took with it: the others go on."""
    traceback.print_exception(error)
    return _not_validated(job, crash(error))


def _not_validated(job: "Job", answer: Mapping[str, Any]) -> "Validated":
    from robocal_ros.cli.validating import Validated

    return Validated({"bag": job.name, "path": job.path, "error": answer["error"]})


class _Slots:
    """Places for one job each, with a process of its own: who dies takes no other's job along.

    Results come by file: of one that is killed while it sends a pipe would hold a part, and who
    reads that waits for ever.
    """

    def __init__(self, count: int) -> None:
        self._results = tempfile.TemporaryDirectory()
        self._context = multiprocessing.get_context("forkserver")
        self._others = set(multiprocessing.active_children())
        self._pools = [self._pool() for _ in range(count)]
        self._busy: dict[Future[None], tuple[int, int]] = {}  # slot and number of a job

    def __enter__(self) -> "_Slots":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # nobody wants the other bags any more
            for child in set(multiprocessing.active_children()) - self._others:
                child.kill()
        for pool in self._pools:
            pool.shutdown(cancel_futures=True)
        self._results.cleanup()

    def validated(self, jobs: "Sequence[Job]") -> "Iterator[Numbered]":
        waiting = iter(enumerate(jobs))
        for slot in range(len(self._pools)):
            self._begin_next(slot, waiting)
        while self._busy:
            for future in wait(self._busy, return_when=FIRST_COMPLETED).done:
                slot, number = self._busy.pop(future)
                try:
                    future.result()
                    result = pickle.loads(self._file(number).read_bytes())
                    self._file(number).unlink()
                except BrokenProcessPool:
                    self._renew(slot)
                    result = _not_validated(jobs[number], refusal(Code.NONE, KILLED))
                except Exception as error:
                    result = _lost(jobs[number], error)
                self._begin_next(slot, waiting)
                yield number, result

    def _begin_next(self, slot: int, waiting: "Iterator[tuple[int, Job]]") -> None:
        for number, job in waiting:
            try:
                future = self._pools[slot].submit(_validate_to, self._file(number), job)
            except BrokenProcessPool:  # its process died while it had nothing to do
                self._renew(slot)
                future = self._pools[slot].submit(_validate_to, self._file(number), job)
            self._busy[future] = slot, number
            return

    def _file(self, number: int) -> Path:
        return Path(self._results.name) / str(number)

    def _pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, _end_with_parent)

    def _renew(self, slot: int) -> None:
        self._pools[slot].shutdown()
        self._pools[slot] = self._pool()


def _validate_to(file: Path, job: "Job") -> None:
    from robocal_ros.cli.validating import validate_bag

    file.write_bytes(pickle.dumps(validate_bag(job)))


def _end_with_parent() -> None:
    """A worker holds its own queue open, and would wait for jobs for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _cluster(scheduler: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install distributed") from error
    try:
        client = Client(scheduler, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler} does not answer: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except TimeoutError as error:
            words = f"no worker within {PATIENCE_S} s: start some, dask worker {scheduler}"
            raise InputError(f"--scheduler {scheduler} has {words}") from error
        yield client


def _from_cluster(client: Any, jobs: "Sequence[Job]") -> "Iterator[Numbered]":
    from distributed import as_completed

    from robocal_ros.cli.validating import validate_bag

    # A bag is read once: two jobs are never the same one to Dask.
    number = {client.submit(validate_bag, job, pure=False): i for i, job in enumerate(jobs)}
    for future in as_completed(list(number)):
        i = number.pop(future)  # and with it, when it was read, its result in the cluster
        try:
            result = future.result()
        except Exception as error:  # cancelled too: the cluster is gone
            result = _lost(jobs[i], error)
        yield i, result
        future.release()


# ---- robocal validate ---------------------------------------------------------------------------


TITLE = "Validation of recorded bags"
LIBRARIES = ("numpy", "scipy", "numba", "rosbags", "mcap")


def add_validate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "bags",
        type=Path,
        nargs="+",
        metavar="BAG",
        help=".mcap, .db3 or .bag (ROS 1) files, or folders of bags",
    )
    parser.add_argument(
        "--report", required=True, type=Path, metavar="DIR", help="folder of the report"
    )
    parser.add_argument(
        "--robot", metavar="R.yaml", help=f"{ROBOT_HELP}; of bags that do not say which it is"
    )
    parser.add_argument(
        "--topic",
        type=input_topic,
        action="append",
        default=[],
        metavar="INPUT:=TOPIC",
        help="topic of an input as in 'robocal replay', for bags without session_events",
    )
    parser.add_argument(
        "--jobs",
        type=count,
        metavar="N",
        help="bags at the same time; default: this machine's cores",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask cluster to use instead, tcp://HOST:8786"
    )


def run_validate(args: argparse.Namespace) -> CliResult:
    workers = min(args.jobs or len(os.sched_getaffinity(0)), len(args.bags))
    if workers > 1 and args.scheduler is None:
        warm_up()
    from robocal_ros.report.page import page, summary_rows

    args.report.mkdir(parents=True, exist_ok=True)
    jobs = _jobs(args.bags, args.robot, dict(args.topic))
    results: dict[int, Document] = {}
    figures: dict[str, Sequence[Sequence[Drawn]]] = {}
    with _progress(len(jobs)) as one_more:
        for number, result in validated(jobs, workers, args.scheduler):
            results[number] = result.document
            figures[jobs[number].name] = (result.cells, *result.figures)
            _keep_figures(args.report, jobs[number].name, result)
            one_more()
    bags = [results[number] for number in range(len(jobs))]
    report = _report(bags)
    _write(args.report, report, page(report, figures))
    told = {name: report[name] for name in ("created", "software", "versions", "tolerance_mm")}
    document = _failure(bags) | told
    document |= {"report": str(args.report / "report.html"), "bags": summary_rows(bags)}
    return CliResult(document, _show_validate, NO_ANSWER if "error" in document else DONE)


def _jobs(paths: Sequence[Path], robot: str | None, topics: dict[str, str]) -> "list[Job]":
    """A job for each bag, under a name that no other has."""
    from robocal_ros.cli.validating import Job

    jobs: list[Job] = []
    for path in paths:
        place = path.resolve()
        stems = {Path(job.name).stem for job in jobs}
        numbered = (f"{place.stem}-{number}" for number in range(2, len(paths) + 1))
        stem = next(name for name in (place.stem, *numbered) if name not in stems)
        name = f"{stem}{place.suffix}"
        jobs.append(Job(str(path.absolute()), name, robot, topics))
    return jobs


def _report(bags: Sequence[Document]) -> Document:
    from robocal_ros.report.figures import TOLERANCE_MM

    return {
        "title": TITLE,
        "created": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "software": f"robocal_ros {__version__}",
        "versions": {"python": platform.python_version()}
        | {name: found for name in LIBRARIES if (found := _version(name)) is not None},
        "tolerance_mm": TOLERANCE_MM,
        "bags": list(bags),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _failure(bags: Sequence[Document]) -> Document:
    """``error`` and ``verdict`` when bags could not be validated; empty when all could."""
    failed = [bag for bag in bags if "error" in bag]
    if not failed:
        return {}
    words = "; ".join(f"{bag['bag']}: {bag['error']['message']}" for bag in failed)
    message = f"{len(failed)} of {len(bags)} bags could not be validated: {words}"
    return {**refusal(Code[failed[0]["error"]["code"]], message)}


def _keep_figures(folder: Path, name: str, result: "Validated") -> None:
    """``BAG-FIGURE.png``, from the second of a bag on ``BAG-FIGURE-2.png``.

    No figure's name is a number or has a hyphen: two bags never meet in one file.
    """
    met: Counter[str] = Counter()
    for drawn in chain(result.cells, *result.figures):
        met[drawn.name] += 1
        which = f"-{met[drawn.name]}" if met[drawn.name] > 1 else ""
        (folder / f"{Path(name).stem}-{drawn.name}{which}.png").write_bytes(drawn.png)


def _write(folder: Path, report: Document, html: str) -> None:
    import json

    from robocal_ros.report.page import bags_table, cycles_table, decisions_table, hours_table

    bags = report["bags"]
    texts = {
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "bags.csv": bags_table(bags),
        "cycles.csv": cycles_table(bags),
        "decisions.csv": decisions_table(bags),
        "hours.csv": hours_table(bags),
        "report.html": html,  # the last: where it is, all is
    }
    for name, text in texts.items():
        write_text(folder / name, text)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[], None]]:
    """Bags done, on a terminal; what is yielded counts one more."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = ("validating", BarColumn(), MofNCompleteColumn(), "bags", TimeElapsedColumn())
    with Progress(*columns, console=progress_console(), transient=True) as progress:
        task = progress.add_task("validating", total=total)
        yield lambda: progress.advance(task)


def _show_validate(console: "Console", document: Document) -> None:
    head = ("bag", "what", "without", "in force", "after", "candidate", "below bound", "refused")
    kinds = {
        "thermal": "{cycles} cycles, {accepted} accepted",
        "tool": "{runs} tool runs",
        "hand_eye": "{calibrations} hand-eye",
    }
    rows = []
    for row in document["bags"]:
        if "error" in row:
            cells = [f"not validated: {row['error']['code']}"]
        elif "skipped" in row:
            cells = [f"not replayed: {row['node']}"]
        else:
            names = ("without", "in_force", "after", "candidate")
            errors = [row.get(f"rms_{name}_mm") for name in names]
            if row["kind"] == "hand_eye":
                errors[-1] = row["predicted_rms_mm"]
            share = row.get("share_below_bound")
            cells = [kinds[row["kind"]].format(**row)]
            cells += ["" if error is None else f"{error:.3f}" for error in errors]
            cells += ["" if share is None else f"{share:.1%}", str(row["refused"])]
        rows.append([row["bag"], *cells])
    print_table(console, "Rms errors in mm", head, rows, words=(0, 1))
    print_words(console, document["report"])
