"""Make trajectories in several processes of this machine.

Each process has one job at a time and its own pipe, so that when one is killed (by hand, or by
the system for want of memory) it is known which trajectory was lost: a fresh process takes its
place and tries that one once more, and the others go on undisturbed.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from giorom.config import Experiment
from giorom.generate.trajectory import Job, Outcome, Tick, make_part
from giorom.mpm import SimulationError

POLL = 0.2
"""Time between two looks at the progress of the processes [s]."""

MOST_DEATHS = 4
"""Deaths per process after which the work is given up, if none has finished a trajectory."""

Make = Callable[..., Outcome]
"""``make_part`` with all but the job and ``tick`` given."""


def run_jobs(
    todo: list[Job], experiment: Experiment, *, folder: Path, jobs: int, device: str, tick: Tick
) -> Iterator[Outcome]:
    """Work off the jobs, in this process if one is enough.

    Args:
        todo: The trajectories to make.
        experiment: Scenes and solver.
        folder: The work folder.
        jobs: Number of processes.
        device: ``cpu`` or ``cuda``.
        tick: Called with the frames done of the trajectories in work.

    Yields:
        What became of each, in the order in which they end.

    Raises:
        OSError: If a part cannot be written; the processes are ended.
    """
    make = partial(make_part, experiment, folder=folder, device=device)
    if jobs == 1 or len(todo) <= 1:
        for job in todo:
            yield make(job, tick=tick)
        return
    pool = _Pool(make, count=min(jobs, len(todo)))
    try:
        yield from pool.work_off(todo, tick)
    finally:
        pool.end()


class _Worker:
    """One process and the job it has."""

    def __init__(self, make: Make) -> None:
        context = multiprocessing.get_context("spawn")
        self.frames = context.Value("q", 0, lock=False)
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, make, self.frames), daemon=True)
        self.process.start()
        theirs.close()
        self.job: Job | None = None

    def give(self, job: Job) -> None:
        """Start a job; a process that is gone is noticed when its answer is awaited."""
        self.job, self.frames.value = job, 0
        with suppress(OSError):
            self.connection.send(job)

    def end(self) -> None:
        """End the process at once."""
        self.process.terminate()
        self.process.join()
        self.connection.close()


class _Pool:
    """Some processes; one that dies is replaced."""

    def __init__(self, make: Make, *, count: int) -> None:
        self._make = make
        self._workers = [_Worker(make) for _ in range(count)]
        self._lost: set[int] = set()
        self._deaths = self._answers = 0

    def work_off(self, todo: list[Job], tick: Tick) -> Iterator[Outcome]:
        """Give every process a job until there is none left."""
        waiting = deque(todo)
        for worker in self._workers:
            worker.give(waiting.popleft())
        while busy := [worker for worker in self._workers if worker.job is not None]:
            ready = wait([worker.connection for worker in busy], timeout=POLL)
            for worker in [worker for worker in busy if worker.connection in ready]:
                outcome = self._answer(worker, waiting)
                if outcome is not None:
                    yield outcome
                if waiting:
                    self._alive(worker).give(waiting.popleft())
            tick(sum(worker.frames.value for worker in self._workers if worker.job is not None))

    def end(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.end()

    def _answer(self, worker: _Worker, waiting: deque[Job]) -> Outcome | None:
        """The outcome a process has sent; none if it died and its job is to be tried again."""
        job, worker.job = worker.job, None
        try:
            answer = worker.connection.recv()
        except (EOFError, OSError):
            return self._bury(worker, job, waiting)
        if isinstance(answer, BaseException):
            raise answer
        self._answers += 1
        return answer

    def _bury(self, worker: _Worker, job: Any, waiting: deque[Job]) -> Outcome | None:
        worker.process.join()
        code = worker.process.exitcode
        end = f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"
        self._deaths += 1
        if self._answers == 0 and self._deaths >= MOST_DEATHS * len(self._workers):
            raise SimulationError(
                f"{self._deaths} processes ended, the last {end}, and none finished a trajectory. "
                f"Try --jobs 1 to see why."
            )
        if job.index not in self._lost:
            self._lost.add(job.index)
            waiting.appendleft(job)
            return None
        return Outcome(
            index=job.index,
            problem=f"its process ended twice, the second time {end} (killed, or out of memory). "
            f"Use fewer --jobs or a smaller scene.",
        )

    def _alive(self, worker: _Worker) -> _Worker:
        """The worker, or a fresh one in its place."""
        if worker.process.is_alive():
            return worker
        fresh = _Worker(self._make)
        self._workers[self._workers.index(worker)] = fresh
        worker.end()
        return fresh


def _serve(connection: Connection, make: Make, frames: Any) -> None:
    """Body of a process: make what is asked for until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's affair
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)

    def tick(count: int) -> None:
        frames.value = count

    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        try:
            connection.send(make(job, tick=tick))
        except Exception as error:
            connection.send(_portable(error))


def _portable(error: Exception) -> Exception:
    """An exception that survives the pipe."""
    if isinstance(error, OSError):
        return OSError(error.errno, error.strerror or str(error))
    return RuntimeError(f"{type(error).__name__}: {error}")


def _end_with_parent() -> None:
    """End this process when its parent is gone, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
