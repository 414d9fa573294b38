"""Process pool that runs a study's batches on all cores of this machine.

Threads alone would block each other: half of the time is spent in small steps between NumPy's
calls, under the interpreter's lock. The other processes are started as programs (``python -m
pkmcal.studies.workers``), so that a user's script needs no guard; they read pickled tasks from
standard input and write pickled results to standard output. The batch of a process that dies is run
again.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import IO, Any

from pkmcal.errors import ResultError
from pkmcal.studies.tasks import Finished, Job, SolvedBatch, work

MOST_DEATHS_A_BATCH = 3
"""Number of workers that may die at one batch before the study stops with an error."""
MESSAGE_SIZE_FORMAT = struct.Struct("<Q")
INTERRUPT_POLL_INTERVAL = 0.5
"""Seconds between checks for Ctrl-C, which some systems do not deliver to a waiting thread."""


def cores() -> int:
    """Number of processors that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return min(os.cpu_count() or 1, len(usable(0))) if usable else os.cpu_count() or 1


def on_cores(tasks: Sequence[Job], finished: Finished) -> int:
    """Run all tasks on every core; return the number of workers.

    An interruption kills the other processes, lets this process finish its batch, and keeps that
    batch. Raises the first error of a task.
    """
    pool = _Pool(tasks, finished)
    count = max(1, min(cores(), len(tasks)))
    threads = [threading.Thread(target=pool.here)]
    threads += [threading.Thread(target=pool.elsewhere) for _ in range(count - 1)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            while thread.is_alive():
                thread.join(INTERRUPT_POLL_INTERVAL)
    finally:
        pool.stop()
        for thread in threads:
            thread.join()
    if pool.failure is not None:
        raise pool.failure
    return count


class _Pool:
    """Queue of pending tasks, with the state shared by all workers."""

    def __init__(self, tasks: Sequence[Job], finished: Finished) -> None:
        self.tasks, self.finished = tasks, finished
        self.waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(len(tasks)):
            self.waiting.put(number)
        self.lock, self.stopped = threading.Lock(), threading.Event()
        self.failure: BaseException | None = None
        self.deaths = [0] * len(tasks)
        self.processes: list[subprocess.Popen[bytes]] = []

    def stop(self) -> None:
        """Start no further task and kill the other processes."""
        self.stopped.set()
        with self.lock:
            for process in self.processes:
                process.kill()

    def next(self) -> int | None:
        """Number of the next pending task; None if there is none or the pool is stopped."""
        if self.stopped.is_set():
            return None
        try:
            return self.waiting.get_nowait()
        except queue.Empty:
            return None

    def failed(self, error: BaseException) -> None:
        """Record the first error and stop the study."""
        with self.lock:
            self.failure = self.failure or error
        self.stop()

    def done(self, number: int, result: SolvedBatch) -> None:
        """Pass a task's result to the callback, under the lock."""
        with self.lock:
            self.finished(number, result)

    def here(self) -> None:
        """Work in this process, on copies: work fills the caches of a task's machine, and tasks
        share it with those that other threads are pickling.
        """
        try:
            while (number := self.next()) is not None:
                self.done(number, work(pickle.loads(pickle.dumps(self.tasks[number]))))
        except BaseException as error:  # noqa: BLE001 - raised again where the study was begun
            self.failed(error)

    def elsewhere(self) -> None:
        """Work in another process; start a new one if it dies."""
        try:
            number = self.next()
            while number is not None:
                with self._process() as process:
                    while number is not None and (
                        answer := _result_of(process, self.tasks[number])
                    ):
                        self._handle_result(number, answer)
                        number = self.next()
                if number is not None:  # the process has died at this task
                    number = self._retry(number)
        except BaseException as error:  # noqa: BLE001 - raised again where the study was begun
            self.failed(error)

    def _handle_result(self, number: int, answer: bytes) -> None:
        result = pickle.loads(answer)
        if isinstance(result, BaseException):
            raise result
        self.done(number, result)

    def _retry(self, number: int) -> int | None:
        """Number of the task of a dead process, to be run again; None if the pool is stopped.

        Raises ResultError if the task has cost MOST_DEATHS_A_BATCH processes.
        """
        if self.stopped.is_set():
            return None
        self.deaths[number] += 1
        if self.deaths[number] < MOST_DEATHS_A_BATCH:
            return number
        raise ResultError(
            "processes that work on the study are killed again and again",
            found=f"{MOST_DEATHS_A_BATCH} of them, at one batch",
            next_step="Look whether there is enough memory; what is finished is kept",
        )

    def _process(self) -> _Worker:
        worker = _Worker()
        with self.lock:
            self.processes.append(worker.process)
        if self.stopped.is_set():
            worker.process.kill()
        return worker


class _Worker:
    """Another process, killed at the end of the ``with`` block."""

    def __init__(self) -> None:
        environment = dict(os.environ)
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            environment[name] = "1"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "pkmcal.studies.workers"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
        )  # fmt: skip

    def __enter__(self) -> subprocess.Popen[bytes]:
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with suppress(OSError):  # nobody reads what was still to be written
                    stream.close()
        self.process.wait()


def _result_of(process: subprocess.Popen[bytes], task: Job) -> bytes | None:
    """Pickled result of a task from a process; None if the process has died."""
    if process.stdin is None or process.stdout is None:
        return None
    try:
        _write_message(process.stdin, task)
    except OSError:
        return None
    return _read_message(process.stdout)


def _write_message(stream: IO[bytes], message: Any) -> None:
    content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    stream.write(MESSAGE_SIZE_FORMAT.pack(len(content)) + content)
    stream.flush()


def _read_message(stream: IO[bytes]) -> bytes | None:
    """Next message of a stream; None at its end or if the message is truncated."""
    head = stream.read(MESSAGE_SIZE_FORMAT.size)
    if len(head) < MESSAGE_SIZE_FORMAT.size:
        return None
    (size,) = MESSAGE_SIZE_FORMAT.unpack(head)
    content = stream.read(size)
    return content if len(content) == size else None


def answer_tasks(source: IO[bytes], target: IO[bytes]) -> None:
    """Run tasks until their source ends; exceptions are returned as results."""
    while (message := _read_message(source)) is not None:
        try:
            answer: Any = work(pickle.loads(message))
        except Exception as error:  # noqa: BLE001 - raised again by the study's own process
            answer = error
        _write_message(target, answer)


def run_worker() -> None:
    """Main function of a worker process.

    A worker ignores Ctrl-C: the study's main process handles it and kills the workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as target:
        # printed text must not enter the stream of results
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        answer_tasks(sys.stdin.buffer, target)


if __name__ == "__main__":
    run_worker()
