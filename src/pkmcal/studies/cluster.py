"""A study's batches on a Dask cluster: the same tasks, so the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from pkmcal import __version__
from pkmcal.errors import InputError, ResultError
from pkmcal.studies.tasks import Done, Finished, Job, Runner, work

TIMEOUT = 20
"""Seconds for a scheduler to answer, and for its first worker to be there."""


def _version() -> str:
    """On a worker: the program's version there."""
    return __version__


def _worked(task: Job) -> Done:
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
            next_step="Install it with: pip install 'pkmcal[cluster]'",
        )

    def runner(tasks: Sequence[Job], finished: Finished) -> int:
        from distributed import Client

        try:
            client: Any = Client(address, timeout=TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                "no Dask scheduler answers",
                where="--scheduler",
                found=f"{address}: {str(error) or type(error).__name__}",
                expected="the address that dask scheduler prints, such as tcp://10.0.0.1:8786",
            ) from None
        try:
            workers = _checked(client, address)
            _done(client, tasks, finished)
        finally:
            client.close()
        return workers

    return runner


def _checked(client: Any, address: str) -> int:
    """The number of the cluster's workers, all of which have this program."""
    try:
        client.wait_for_workers(1, timeout=TIMEOUT)
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
    if versions != {__version__}:
        raise InputError(
            "the cluster's workers have another pkmcal, so they would not give the same numbers",
            where="--scheduler",
            found=", ".join(sorted(versions)),
            expected=__version__,
            next_step=f"Install pkmcal {__version__} where the workers run",
        )
    return sum(client.nthreads().values())


def _done(client: Any, tasks: Sequence[Job], finished: Finished) -> None:
    """All tasks; what a worker had in hand when it died is done again by another."""
    from distributed import KilledWorker, as_completed

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
    finally:
        client.cancel(list(futures))
