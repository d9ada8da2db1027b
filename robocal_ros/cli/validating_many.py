"""Many bags beside each other: Dask runs `validate_bag`, jobs go out and results come back."""

import logging
import os
import signal
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from robocal_ros.cli.output import crash
from robocal_ros.cli.validating import Job, Validated, validate_bag
from robocal_ros.cli.warm_workers import METHOD
from robocal_ros.ground.errors import InputError

PATIENCE_S = 10  # with a cluster
Numbered = tuple[int, Validated]


def validated(jobs: Sequence[Job], workers: int, scheduler: str | None) -> Iterator[Numbered]:
    """Each job's number and result, as they become ready.

    Parameters
    ----------
    workers : processes on this machine (see `warm_up`); with one all is done in this process.
    scheduler : address of a running cluster, which is used instead; it must see the bags by the
        same paths, and have this software.

    Raises
    ------
    InputError
        When Dask is not there, or the cluster does not answer or has no worker.
    """
    if scheduler is None and workers <= 1:
        yield from ((number, _alone(job)) for number, job in enumerate(jobs))
        return
    with _client(workers, scheduler) as client:
        yield from _gathered(client, jobs)


def _gathered(client: Any, jobs: Sequence[Job]) -> Iterator[Numbered]:
    from distributed import as_completed

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


def _alone(job: Job) -> Validated:
    try:
        return validate_bag(job)
    except Exception as error:
        return _lost(job, error)


def _lost(job: Job, error: BaseException) -> Validated:
    """A bag whose replay crashed, or whose worker was killed: the others go on."""
    traceback.print_exception(error)
    return Validated({"bag": job.name, "path": job.path, "error": crash(error)["error"]})


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    try:
        import dask.config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError(
            "several bags at once need Dask: install 'distributed' (docs/install.md), or say "
            "--jobs 1"
        ) from error
    if scheduler is not None:
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
        return
    # One thread each, for linear algebra too (Dask sets it): the same bits as in one process.
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": METHOD}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,
            dashboard_address=None,
            silence_logs=logging.ERROR,
        ) as cluster,
        Client(cluster) as client,
    ):
        try:
            yield client
        except (KeyboardInterrupt, GeneratorExit):  # nobody wants the other bags any more
            for handler in logging.getLogger("distributed").handlers:
                handler.setLevel(logging.CRITICAL)  # its threads miss the workers, with tracebacks
            for worker in cluster.workers.values():  # the cluster would wait for theirs
                os.kill(worker.pid, signal.SIGKILL)
            raise
