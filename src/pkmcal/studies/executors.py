"""Executors of a study's batches: the processes of this machine, or a Dask cluster.

Both are executors of :mod:`concurrent.futures`, so tasks, numbers and errors are the same. Threads
would block each other: half of the time is spent in small steps between NumPy's calls, under the
interpreter's lock.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from types import ModuleType
from typing import TypeVar

from pkmcal.errors import ResultError
from pkmcal.studies.tasks import Finished, Job, SolvedBatch, work

Task = TypeVar("Task")
MOST_PROCESSES = 61 if sys.platform == "win32" else 1024
"""Most processes of a pool; Windows waits for no more."""
MOST_FRUITLESS_POOLS = 3
"""Number of pools in succession that may break without a finished batch before the study stops."""


def cores() -> int:
    """Number of processors that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return min(os.cpu_count() or 1, len(usable(0))) if usable else os.cpu_count() or 1


def on_cores(tasks: Sequence[Job], finished: Finished, count: int | None = None) -> int:
    """Run all tasks on ``count`` processes, by default one for each core; return their number.

    An interruption kills the processes. Raises the first error of a task, and ResultError where
    processes die at the same batches again and again.
    """
    count = min(count or cores(), len(tasks), MOST_PROCESSES)
    if count <= 1:
        for number, task in enumerate(tasks):
            finished(number, work(task))
        return 1
    pending, fruitless = {number: number for number in range(len(tasks))}, 0
    while pending:
        before = len(pending)
        try:
            with _process_pool(count, tasks) as pool:
                run_on(pool, _work_on, pending, finished)
        except BrokenProcessPool:
            # one dead process ends the pool: a new one takes the batches that were not finished
            fruitless = 0 if len(pending) < before else fruitless + 1
            if fruitless == MOST_FRUITLESS_POOLS:
                raise ResultError(
                    "processes that work on the study are killed again and again",
                    found=f"{fruitless} times at the same batches",
                    next_step="Look whether there is enough memory; what is finished is kept",
                    code="study.workers_killed",
                ) from None
    return count


def run_on(
    executor: Executor,
    function: Callable[[Task], SolvedBatch],
    pending: dict[int, Task],
    finished: Finished,
) -> None:
    """Run pending tasks, and remove each from ``pending`` when ``finished`` has its result.

    Raises the first error of a task; tasks that have not begun are then cancelled.
    """
    futures = {executor.submit(function, task): number for number, task in pending.items()}
    try:
        for future in as_completed(list(futures)):
            number = futures.pop(future)
            finished(number, future.result())
            del pending[number]
    finally:
        for future in futures:
            future.cancel()


@contextmanager
def _process_pool(count: int, tasks: Sequence[Job]) -> Generator[ProcessPoolExecutor]:
    """Pool of new processes, which hold all tasks and are killed where the block raises.

    The tasks are no items of the pool's queue: where processes are killed while a long item is
    written, the shutdown of the pool hangs before Python 3.11.5.

    A new process runs the main module of its parent again, unless that module has no file. Batches
    use nothing defined in the main module, so its file is hidden, and a user's script needs no ``if
    __name__ == "__main__"``.
    """
    main, others = sys.modules["__main__"], set(active_children())
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        pool = ProcessPoolExecutor(count, get_context("spawn"), _start_process, (tasks,))
        try:
            yield pool
        except BaseException:
            for process in set(active_children()) - others:
                process.kill()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
    finally:
        sys.modules["__main__"] = main


_TASKS: list[Job] = []
"""Tasks of a process of a pool."""


def _work_on(number: int) -> SolvedBatch:
    """Work on one of the tasks of this process."""
    return work(_TASKS[number])


def _start_process(tasks: Sequence[Job]) -> None:
    """Keep the tasks, ignore Ctrl-C, which the study's main process handles, and end with that
    process.
    """
    _TASKS.extend(tasks)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def end() -> None:
        if parent is not None:
            parent.join()  # a parent that is killed ends no pool
            os._exit(1)

    Thread(target=end, daemon=True).start()
