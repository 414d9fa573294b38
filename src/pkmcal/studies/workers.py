"""A study's batches on all cores of this machine: this process, and others beside it.

Threads would wait for one another: half of the time goes into small steps between NumPy's calls,
which one thread of a process does at a time. The other processes are started as programs of their
own (``python -m pkmcal.studies.workers``), so that a user's script needs no guard, read pickled
tasks from their input and write what came of them to their output. One that dies has its batch
done again.
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
"""Workers that one batch may cost before the study gives up."""
MESSAGE_SIZE_FORMAT = struct.Struct("<Q")
INTERRUPT_POLL_INTERVAL = 0.5
"""Seconds between looks for Ctrl-C, which some systems do not let through to a waiting thread."""


def cores() -> int:
    """Processors that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return min(os.cpu_count() or 1, len(usable(0))) if usable else os.cpu_count() or 1


def on_cores(tasks: Sequence[Job], finished: Finished) -> int:
    """All tasks, on every core; returns the number of workers.

    An interruption ends the other processes, lets this one finish its batch, and keeps it.
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
    """Tasks that wait, and what has come of the others."""

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
        """No further task; other processes end at once."""
        self.stopped.set()
        with self.lock:
            for process in self.processes:
                process.kill()

    def next(self) -> int | None:
        """The number of a task that waits."""
        if self.stopped.is_set():
            return None
        try:
            return self.waiting.get_nowait()
        except queue.Empty:
            return None

    def failed(self, error: BaseException) -> None:
        """The first error ends the study."""
        with self.lock:
            self.failure = self.failure or error
        self.stop()

    def done(self, number: int, result: SolvedBatch) -> None:
        """Hand on what came of a task."""
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
        """Work in another process, and in a new one where it dies."""
        try:
            number = self.next()
            while number is not None:
                with self._process() as process:
                    while number is not None and (answer := _answer(process, self.tasks[number])):
                        self._answered(number, answer)
                        number = self.next()
                if number is not None:  # the process has ended with a task in hand
                    number = self._again(number)
        except BaseException as error:  # noqa: BLE001 - raised again where the study was begun
            self.failed(error)

    def _answered(self, number: int, answer: bytes) -> None:
        result = pickle.loads(answer)
        if isinstance(result, BaseException):
            raise result
        self.done(number, result)

    def _again(self, number: int) -> int | None:
        """The task once more, unless the study has ended or it kills every process."""
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
    """Another process; it ends with the block, or with this process."""

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
                _closed(stream)
        self.process.wait()


def _closed(stream: IO[bytes]) -> None:
    with suppress(OSError):  # what was still to be written has nobody to read it
        stream.close()


def _answer(process: subprocess.Popen[bytes], task: Job) -> bytes | None:
    """What a process answers to a task; None where it has died."""
    if process.stdin is None or process.stdout is None:
        return None
    try:
        _send(process.stdin, task)
    except OSError:
        return None
    return _received(process.stdout)


def _send(stream: IO[bytes], message: Any) -> None:
    content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    stream.write(MESSAGE_SIZE_FORMAT.pack(len(content)) + content)
    stream.flush()


def _received(stream: IO[bytes]) -> bytes | None:
    """The next message; None at the end, and where one breaks off."""
    head = stream.read(MESSAGE_SIZE_FORMAT.size)
    if len(head) < MESSAGE_SIZE_FORMAT.size:
        return None
    (size,) = MESSAGE_SIZE_FORMAT.unpack(head)
    content = stream.read(size)
    return content if len(content) == size else None


def answer_tasks(source: IO[bytes], target: IO[bytes]) -> None:
    """Do tasks until their source ends; an error is an answer, too."""
    while (message := _received(source)) is not None:
        try:
            answer: Any = work(pickle.loads(message))
        except Exception as error:  # noqa: BLE001 - the study's own process tells it
            answer = error
        _send(target, answer)


def run_worker() -> None:
    """A worker's whole life. Ctrl-C is for the study's own process, which then ends this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as target:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what is printed is no answer
        answer_tasks(sys.stdin.buffer, target)


if __name__ == "__main__":
    run_worker()
