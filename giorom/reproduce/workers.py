"""Work off independent tasks in several processes of one thread each.

What a task makes it leaves in files; nothing but failures comes back. A process ends with its
parent, even where that is killed, so that the same command can be given again at once.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any

import torch

Task = tuple[Callable[..., Any], tuple[Any, ...]]
"""A function of a module and its arguments, which have to survive a pipe."""


def run_tasks(tasks: list[Task], *, jobs: int, done: Callable[[int], None]) -> None:
    """Work off all tasks.

    Args:
        tasks: What to do.
        jobs: Number of processes; one works in this process.
        done: Called with the number of each task that has ended.

    Raises:
        RuntimeError: If a process is killed.
    """
    if jobs == 1 or len(tasks) <= 1:
        for number, (function, arguments) in enumerate(tasks):
            with one_thread():
                function(*arguments)
            done(number)
        return
    workers = [_Worker() for _ in range(min(jobs, len(tasks)))]
    try:
        _work_off(workers, tasks, done)
    finally:
        for worker in workers:
            worker.end()


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on a single thread, as every process of a pool has it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Worker:
    """One process and the number of its task."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()
        self.number: int | None = None

    def give(self, number: int, task: Task) -> None:
        """Start a task."""
        self.number = number
        self.connection.send(task)

    def answer(self) -> int:
        """Number of the task that has ended.

        Raises:
            RuntimeError: If the process was killed.
            Exception: What the task raised.
        """
        number, self.number = self.number, None
        try:
            failure = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            raise RuntimeError(
                f"a process was ended (code {self.process.exitcode}): killed, or out of memory. "
                f"What is finished is kept; run the same command again, with fewer --jobs."
            ) from None
        if failure is not None:
            raise failure
        return -1 if number is None else number

    def end(self) -> None:
        """End the process at once."""
        self.process.terminate()
        self.process.join()
        self.connection.close()


def _work_off(workers: list[_Worker], tasks: list[Task], done: Callable[[int], None]) -> None:
    waiting = deque(enumerate(tasks))
    for worker in workers:
        worker.give(*waiting.popleft())
    while busy := [worker for worker in workers if worker.number is not None]:
        ready = wait([worker.connection for worker in busy])
        for worker in [worker for worker in busy if worker.connection in ready]:
            done(worker.answer())
            if waiting:
                worker.give(*waiting.popleft())


def _serve(connection: Connection) -> None:
    """Body of a process: do what is asked for until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's affair
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            return
        try:
            function(*arguments)
            connection.send(None)
        except Exception as error:
            connection.send(_portable(error))


def _portable(error: Exception) -> Exception:
    """An exception that survives the pipe and keeps its exit code."""
    if isinstance(error, OSError):
        return OSError(error.errno, error.strerror or str(error))
    kind = ValueError if isinstance(error, ValueError) else RuntimeError
    name = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind(f"{name}{error}")


def _end_with_parent() -> None:
    """End this process when its parent is gone, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
