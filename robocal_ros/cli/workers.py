"""Many bags beside each other: in processes of this machine, or in a Dask cluster.

Jobs go out and results come back. A bag whose process dies is told, the others go on.
"""

import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.output import crash
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    from robocal_ros.cli.validating import Job, Validated

PATIENCE_S = 10  # with a cluster
_PRELOADED = [
    "robocal_ros.cli.validating",
    # what a bag needs in the course of things
    "robocal_ros.kinematics.kernels",
    "robocal_ros.ground.mcap_records",
    "robocal_ros.ground.serialized_joints",
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

    Parameters
    ----------
    workers : processes on this machine (see `warm_up`); with one all is done in this process.
    scheduler : address of a running Dask cluster, which is used instead; it must see the bags by
        the same paths, and have this software.

    Raises
    ------
    InputError
        When Dask is not there, or the cluster does not answer or has no worker.
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
    """A bag whose replay crashed, or whose worker was killed: the others go on."""
    from robocal_ros.cli.validating import Validated

    traceback.print_exception(error)
    return Validated({"bag": job.name, "path": job.path, "error": crash(error)["error"]})


class _Slots:
    """Places for one job each, with a process of its own: who dies takes no other's job along."""

    def __init__(self, count: int) -> None:
        self.context = multiprocessing.get_context("forkserver")
        self.pools = [self._pool() for _ in range(count)]

    def __enter__(self) -> "_Slots":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # nobody wants the other bags any more
            for child in multiprocessing.active_children():
                child.kill()
        for pool in self.pools:
            pool.shutdown(cancel_futures=True)

    def _pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self.context)

    def validated(self, jobs: "Sequence[Job]") -> "Iterator[Numbered]":
        from robocal_ros.cli.validating import validate_bag

        waiting = iter(enumerate(jobs))
        busy: dict[Future[Validated], tuple[int, int]] = {}
        free = list(range(len(self.pools)))
        while True:
            for slot, (number, job) in zip(tuple(free), waiting, strict=False):
                busy[self.pools[slot].submit(validate_bag, job)] = slot, number
                free.remove(slot)
            if not busy:
                return
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                slot, number = busy.pop(future)
                free.append(slot)
                try:
                    result = future.result()
                except Exception as error:
                    if isinstance(error, BrokenProcessPool):  # killed: for want of memory?
                        self.pools[slot].shutdown()
                        self.pools[slot] = self._pool()
                    result = _lost(jobs[number], error)
                yield number, result


@contextmanager
def _cluster(scheduler: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "--scheduler needs Dask: pip install distributed"
        ) from error
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
