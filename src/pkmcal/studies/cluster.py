"""A study's batches on a Dask cluster: the same tasks, so the same numbers."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any
from urllib.parse import urlsplit

from pkmcal.errors import InputError, ResultError
from pkmcal.studies.tasks import Finished, Job, Runner, SolvedBatch, work
from pkmcal.wording import install_step

SCHEDULER_TIMEOUT = 20
"""Seconds for a scheduler to answer, and for its first worker to be there."""
SCHEDULER_SCHEMES = ("tcp", "tls", "ws", "wss")
EXPECTED_SCHEDULER_ADDRESS = "the address that dask scheduler prints, such as tcp://10.0.0.1:8786"


def _is_address(text: str) -> bool:
    """Whether a text names a host and a port, and how to speak with it."""
    try:
        parts = urlsplit(text if "://" in text else f"tcp://{text}")
        return parts.scheme in SCHEDULER_SCHEMES and bool(parts.hostname) and bool(parts.port)
    except ValueError:  # a port that is no number
        return False


def _version() -> str:
    """The program's version, here or on a worker."""
    return version("pkmcal")


def _worked(task: Job) -> SolvedBatch:
    """On a worker, which keeps to one thread in its linear algebra from then on: its tasks may
    overlap, and each would give the others' threads back when it ends.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, "blas")
    return work(task)


def on_cluster(address: str) -> Runner:
    """A runner on the cluster whose scheduler is at an address such as ``tcp://10.0.0.1:8786``.

    Raises InputError where dask.distributed is not installed; running it does where the cluster
    does not answer, has no worker, or other workers than this program's.
    """
    if find_spec("distributed") is None:
        raise InputError(
            "a study on a cluster needs dask.distributed, which is not installed",
            where="--scheduler",
            next_step=install_step("cluster"),
        )
    if not _is_address(address):  # which Dask's client only tells after it has begun, and late
        raise InputError(
            "this is no address of a Dask scheduler",
            where="--scheduler", found=f"'{address}'", expected=EXPECTED_SCHEDULER_ADDRESS,
        )  # fmt: skip

    def runner(tasks: Sequence[Job], finished: Finished) -> int:
        from distributed import Client

        try:
            client: Any = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "no Dask scheduler answers",
                where="--scheduler",
                found=f"{address}: {str(error) or type(error).__name__}",
                expected=EXPECTED_SCHEDULER_ADDRESS,
            ) from None
        log = logging.getLogger("distributed.client")
        level = log.level
        log.setLevel(logging.CRITICAL)  # what a lost scheduler means is told by the error here
        try:
            workers = _checked(client, address)
            _done(client, tasks, finished)
        finally:
            client.close()
            log.setLevel(level)
        return workers

    return runner


def _checked(client: Any, address: str) -> int:
    """The number of the cluster's workers, all of which have this program."""
    try:
        client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
    except TimeoutError:
        raise InputError(
            "the cluster has no worker",
            where="--scheduler",
            found=address,
            next_step=f"Start one with: dask worker {address}",
        ) from None
    try:
        versions = set(client.run(_version).values())
    except (ImportError, AttributeError) as error:
        versions = {str(error)}
    if versions != {_version()}:
        raise InputError(
            "the cluster's workers have another pkmcal, so they would not give the same numbers",
            where="--scheduler",
            found=", ".join(sorted(versions)),
            expected=_version(),
            next_step=f"Install pkmcal {_version()} where the workers run",
        )
    return sum(client.nthreads().values())


def _done(client: Any, tasks: Sequence[Job], finished: Finished) -> None:
    """All tasks; what a worker had in hand when it died is done again by another."""
    from distributed import CancelledError, KilledWorker, as_completed

    futures = {client.submit(_worked, task, pure=False): k for k, task in enumerate(tasks)}
    try:
        for future in as_completed(list(futures), loop=client.loop):
            number = futures.pop(future)
            finished(number, future.result())
            future.release()
    except KilledWorker as error:
        raise ResultError(
            "the cluster's workers die again and again at one batch",
            found=str(error),
            next_step="Look whether they have enough memory; what is finished is kept",
        ) from None
    except CancelledError:  # of all that waited, where the client lost its scheduler
        raise ResultError(
            "the scheduler of the cluster is gone",
            next_step="Start it again; what is finished is kept, and the same command goes on",
        ) from None
    finally:
        if client.status == "running":
            client.cancel(list(futures))
