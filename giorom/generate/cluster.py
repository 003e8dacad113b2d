"""Make trajectories on a cluster: chunks of them are sent as one job array through submitit.

Every chunk is a task of the array and writes into the work folder, which all machines must
share: the parts, and ``log/chunk-ARRAY-NUMBER.jsonl`` with what became of each trajectory.
What comes back is read from there, by a later call too if this one does not wait. A task that is
preempted or reaches its time limit goes on where it stopped; what no task has answered for when
all have ended is sent once more.
"""

import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from giorom.config import Experiment
from giorom.data.work_folder import finished_parts
from giorom.data.work_log import append_entry, read_entries
from giorom.generate.trajectory import Job, Outcome, Tick, make_part

POLL = {"slurm": 5.0, "local": 0.3, "debug": 0.0}
"""Time between two looks at the work [s]."""

ROUNDS = 2
"""How often a trajectory is sent before it is listed as failed."""


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Where the work is sent and what it may use."""

    kind: Literal["slurm", "local", "debug"] = "slurm"
    """Executor of submitit; ``local`` starts processes here, ``debug`` runs in this one."""

    chunk: int = 8
    """Trajectories of one task."""

    minutes: int = 240
    """Time limit of a task."""

    memory_gib: int = 4
    """Memory of a task [GiB]."""

    partition: str | None = None
    """Slurm partition; none leaves it to the cluster."""

    account: str | None = None
    """Slurm account; none leaves it to the cluster."""

    parallel: int = 256
    """Most tasks that run at a time."""

    wait: bool = True
    """Whether to wait for the results."""

    def __post_init__(self) -> None:
        """Reject what no cluster can run."""
        for name in ("chunk", "minutes", "memory_gib", "parallel"):
            if getattr(self, name) < 1:
                raise ValueError(f"Cluster.{name} must be >= 1, got {getattr(self, name)!r}.")


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """A task of the array: some trajectories, one after the other."""

    experiment: Experiment
    """Scenes and solver."""

    jobs: tuple[Job, ...]
    """The trajectories."""

    folder: str
    """The work folder."""

    device: str
    """``cpu`` or ``cuda``."""

    log: str
    """Name of the log this task writes."""

    def __call__(self) -> int:
        """Make what is missing; the number of trajectories made or given up."""
        folder = Path(self.folder)
        ended = {entry["index"] for entry in read_entries(folder, self.log)}
        todo = [job for job in self.jobs if job.index not in ended]
        for job in todo:
            outcome = make_part(
                self.experiment, job, folder=folder, device=self.device, tick=lambda _: None
            )
            append_entry(folder, self.log, asdict(outcome))
        return len(todo)

    def checkpoint(self) -> Any:
        """What submitit sends again when a task is preempted or out of time: the same chunk."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def require_cluster(cluster: Cluster) -> None:
    """Refuse work that cannot be sent from this machine.

    Args:
        cluster: Where it is to be sent.

    Raises:
        ValueError: If Slurm is asked for and is not here.
        ModuleNotFoundError: If submitit is not installed.
    """
    import submitit  # noqa: F401

    if cluster.kind == "slurm" and shutil.which("srun") is None:
        raise ValueError(
            "this machine has no 'srun', so it is not part of a Slurm cluster. Call from a login "
            "node, or use --executor local (processes here)."
        )


def run_on_cluster(
    todo: list[Job],
    experiment: Experiment,
    *,
    folder: Path,
    cluster: Cluster,
    device: str,
    tick: Tick,
    announce: Callable[[str], None],
) -> Iterator[Outcome]:
    """Send the jobs and read what becomes of them.

    Args:
        todo: The trajectories to make.
        experiment: Scenes and solver.
        folder: The work folder, on a disk that all machines share.
        cluster: Where to send them.
        device: ``cpu`` or ``cuda``.
        tick: Progress; parts that are there count with all their frames.
        announce: Called with a line about each array.

    Yields:
        What became of each; if ``cluster.wait`` is false only what earlier calls have given up.
    """
    if not cluster.wait:
        given_up = _earlier_failures(folder)
        yield from (given_up[job.index] for job in todo if job.index in given_up)
        todo = [job for job in todo if job.index not in given_up]
    for round_number in range(1, ROUNDS + 1):
        if not todo:
            return
        sent = _send(todo, experiment, folder=folder, cluster=cluster, device=device)
        announce(_description(sent, todo, cluster, folder))
        if not cluster.wait:
            return
        answered = set()
        for outcome in _collect(sent, folder, cluster=cluster):
            answered.add(outcome.index)
            yield outcome
            tick(0)
        todo = [job for job in todo if job.index not in answered]
        if round_number == ROUNDS:
            yield from _given_up(sent, todo)


@dataclass(frozen=True, kw_only=True)
class _Sent:
    """A task that was sent."""

    chunk: Chunk
    task: Any


def _send(
    todo: list[Job], experiment: Experiment, *, folder: Path, cluster: Cluster, device: str
) -> list[_Sent]:
    """Send one array."""
    import submitit

    shared = folder.resolve()
    executor = submitit.AutoExecutor(folder=shared / "log" / "submitit", cluster=cluster.kind)
    executor.update_parameters(
        name="giorom-simulate",
        timeout_min=cluster.minutes,
        mem_gb=cluster.memory_gib,
        cpus_per_task=1,
        gpus_per_node=1 if device == "cuda" else 0,
        slurm_array_parallelism=cluster.parallel,
        **_slurm_options(cluster),
    )
    array = uuid.uuid4().hex[:8]
    chunks = [
        Chunk(
            experiment=experiment,
            jobs=tuple(todo[start : start + cluster.chunk]),
            folder=str(shared),
            device=device,
            log=f"chunk-{array}-{start // cluster.chunk:05d}",
        )
        for start in range(0, len(todo), cluster.chunk)
    ]
    with executor.batch():
        tasks = [executor.submit(chunk) for chunk in chunks]
    return [_Sent(chunk=chunk, task=task) for chunk, task in zip(chunks, tasks, strict=True)]


def _slurm_options(cluster: Cluster) -> dict[str, Any]:
    given = {"slurm_partition": cluster.partition, "slurm_account": cluster.account}
    return {name: value for name, value in given.items() if value is not None}


def _collect(sent: list[_Sent], folder: Path, *, cluster: Cluster) -> Iterator[Outcome]:
    """Every outcome as it is written, until all tasks have ended."""
    known: set[int] = set()
    running = True
    while running:
        running = any([not item.task.done() for item in sent])  # a list: each is to be asked
        for item in sent:
            for entry in read_entries(folder, item.chunk.log):
                if entry["index"] not in known:
                    known.add(entry["index"])
                    yield Outcome(**entry)
        if running:
            time.sleep(POLL[cluster.kind])


def _earlier_failures(folder: Path) -> dict[int, Outcome]:
    """Trajectories that the tasks of earlier calls could not make, by number."""
    names = sorted(path.stem for path in (folder / "log").glob("chunk-*.jsonl"))
    entries = (entry for name in names for entry in read_entries(folder, name))
    return {e["index"]: Outcome(**e) for e in entries if e["problem"] is not None}


def _given_up(sent: list[_Sent], todo: list[Job]) -> Iterator[Outcome]:
    """Trajectories no task has answered for, with the state of the task."""
    for item in sent:
        for job in item.chunk.jobs:
            if job in todo:
                yield Outcome(
                    index=job.index,
                    problem=f"job {item.task.job_id} ended as {item.task.state} without an answer "
                    f"for it, the second time; its messages are in {item.task.paths.stderr}.",
                )


def _description(sent: list[_Sent], todo: list[Job], cluster: Cluster, folder: Path) -> str:
    identifier = str(sent[0].task.job_id).split("_")[0]
    present = len(finished_parts(folder))
    line = (
        f"sent {len(todo)} trajectories ({present} are there) as {len(sent)} tasks of up to "
        f"{cluster.chunk} to {cluster.kind}, job {identifier}, {cluster.minutes} min and "
        f"{cluster.memory_gib} GiB each"
    )
    if not cluster.wait:
        line += "; when they have ended, run the same command again to collect"
    return line
