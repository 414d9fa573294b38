"""Runner of a study's batches on a Dask cluster; the tasks, and so the numbers, are the same."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import CancelledError
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any
from urllib.parse import urlsplit

from pkmcal.errors import InputError, ResultError
from pkmcal.studies.executors import run_on
from pkmcal.studies.tasks import Finished, Job, Runner, SolvedBatch, work
from pkmcal.wording import install_step

SCHEDULER_TIMEOUT = 20
"""Seconds to wait for the scheduler's answer, and for its first worker."""
SCHEDULER_SCHEMES = ("tcp", "tls", "ws", "wss")
EXPECTED_SCHEDULER_ADDRESS = "the address that dask scheduler prints, such as tcp://10.0.0.1:8786"


def _is_address(text: str) -> bool:
    """Whether a text is an address with a known scheme, a host and a port."""
    try:
        parts = urlsplit(text if "://" in text else f"tcp://{text}")
        return parts.scheme in SCHEDULER_SCHEMES and bool(parts.hostname) and bool(parts.port)
    except ValueError:  # the port is not a number
        return False


def _pkmcal_version() -> str:
    """Version of pkmcal, here or on a worker."""
    return version("pkmcal")


def _work_on_one_thread(task: Job) -> SolvedBatch:
    """Result of a task, computed on a worker.

    The worker's linear algebra is limited to one thread for good: tasks may overlap, and a limit
    for each task would restore the other's threads when the task ends.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, "blas")
    return work(task)


def on_cluster(address: str, timeout: float = SCHEDULER_TIMEOUT) -> Runner:
    """Runner on the cluster with the scheduler's address, such as ``tcp://10.0.0.1:8786``.

    timeout : seconds until the scheduler and a first worker have to answer.

    Raises InputError if dask.distributed is not installed or the address is malformed; the runner
    raises InputError if the cluster does not answer, has no worker, or has workers with another
    version of pkmcal.
    """
    if find_spec("distributed") is None:
        raise InputError(
            "a study on a cluster needs dask.distributed, which is not installed",
            where="--scheduler",
            next_step=install_step("cluster"),
            code="package.missing",
        )
    if not _is_address(address):  # Dask's client reports a malformed address only late
        raise InputError(
            "this is no address of a Dask scheduler",
            where="--scheduler", found=f"'{address}'", expected=EXPECTED_SCHEDULER_ADDRESS,
        )  # fmt: skip

    def runner(tasks: Sequence[Job], finished: Finished) -> int:
        from distributed import Client

        try:
            client: Any = Client(address, timeout=timeout, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "no Dask scheduler answers",
                where="--scheduler",
                found=f"{address}: {str(error) or type(error).__name__}",
                expected=EXPECTED_SCHEDULER_ADDRESS,
            ) from None
        log = logging.getLogger("distributed.client")
        level = log.level
        log.setLevel(logging.CRITICAL)  # _run_tasks reports a lost scheduler
        try:
            workers = _count_threads(client, address, timeout)
            _run_tasks(client, tasks, finished)
        finally:
            client.close()
            log.setLevel(level)
        return workers

    return runner


def _count_threads(client: Any, address: str, timeout: float) -> int:
    """Number of the cluster's threads; raises InputError if any worker has another version."""
    try:
        client.wait_for_workers(1, timeout=timeout)
    except TimeoutError:
        raise InputError(
            "the cluster has no worker",
            where="--scheduler",
            found=address,
            next_step=f"Start one with: dask worker {address}",
        ) from None
    try:
        versions = set(client.run(_pkmcal_version).values())
    except (ImportError, AttributeError) as error:
        versions = {str(error)}
    if versions != {_pkmcal_version()}:
        raise InputError(
            "the cluster's workers have another pkmcal, so they would not give the same numbers",
            where="--scheduler",
            found=", ".join(sorted(versions)),
            expected=_pkmcal_version(),
            next_step=f"Install pkmcal {_pkmcal_version()} where the workers run",
        )
    return sum(client.nthreads().values())


def _run_tasks(client: Any, tasks: Sequence[Job], finished: Finished) -> None:
    """Run all tasks; Dask repeats the tasks of a worker that has died on another one."""
    from distributed import KilledWorker

    try:
        with client.get_executor(pure=False) as executor:
            run_on(executor, _work_on_one_thread, dict(enumerate(tasks)), finished)
    except KilledWorker as error:
        raise ResultError(
            "the cluster's workers die again and again at one batch",
            found=str(error),
            next_step="Look whether they have enough memory; what is finished is kept",
            code="study.workers_killed",
        ) from None
    except CancelledError:  # the client has lost its scheduler, which cancels all pending tasks
        raise ResultError(
            "the scheduler of the cluster is gone",
            next_step="Start it again; what is finished is kept, and the same command goes on",
            code="study.scheduler_gone",
        ) from None
