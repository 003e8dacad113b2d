"""Making a data set through submitit, with its executors that need no cluster."""

import json
from dataclasses import asdict, replace

import pytest

from giorom.cli import main
from giorom.data.work_folder import finished_parts, part_path
from giorom.data.work_log import append_entry, read_entries
from giorom.generate import Cluster, cluster, generate
from giorom.generate.trajectory import Outcome, jobs_of

submitit = pytest.importorskip("submitit")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # logs that submitit leaves open


@pytest.fixture
def short(tiny):
    """Four frames and a coarse body: a scene takes milliseconds."""
    return replace(tiny, solver=replace(tiny.solver, frames=4))


@pytest.fixture
def send(short):
    """Make a set of five through an executor of submitit."""

    def make(folder, *, kind="debug", said=None, **options):
        lines = [] if said is None else said
        return generate(
            short,
            folder=folder,
            trajectories=5,
            seed=0,
            jobs=1,
            shape=None,
            device="cpu",
            report=lambda done, wanted: None,
            cluster=Cluster(kind=kind, chunk=2, **options),
            announce=lines.append,
        )

    return make


def parts_and_splits(folder):
    """Content of the parts, the split files and the metadata."""
    files = [*folder.glob("parts/*.h5"), *folder.glob("*.h5"), folder / "metadata.json"]
    return {path.name: path.read_bytes() for path in files}


def test_tasks_make_the_same_files_as_this_process(short, make_data, send, tmp_path):
    """Three tasks of two, two and one trajectory; the reference is made without submitit."""
    said = []
    make_data(short, tmp_path / "here", trajectories=5)
    result = send(tmp_path / "there", said=said)
    assert (result["trajectories"], result["failed"]) == (5, 0)
    assert parts_and_splits(tmp_path / "there") == parts_and_splits(tmp_path / "here")
    assert len(said) == 1
    assert "sent 5 trajectories (0 are there) as 3 tasks" in said[0]
    assert result["particle_substeps_per_second"] > 0


@pytest.mark.slow
def test_tasks_in_processes_of_their_own_make_the_same_files(short, make_data, send, tmp_path):
    """As on Slurm: the task is started by submitit and knows the work folder alone."""
    make_data(short, tmp_path / "here", trajectories=5)
    assert send(tmp_path / "there", kind="local")["trajectories"] == 5
    assert parts_and_splits(tmp_path / "there") == parts_and_splits(tmp_path / "here")


def test_work_that_is_not_waited_for_is_collected_by_the_next_call(send, tmp_path, monkeypatch):
    """The first call sends and ends; the second finds the parts and assembles them."""
    folder, sent = tmp_path / "data", []
    submit = cluster._send

    def noted(*rest, **options):
        sent.extend(submit(*rest, **options))
        return sent

    monkeypatch.setattr(cluster, "_send", noted)
    said = []
    result = send(folder, wait=False, said=said)
    assert (result["trajectories"], result["splits"]) == (0, None)
    assert "run the same command again to collect" in said[0]
    assert not (folder / "metadata.json").exists()
    for item in sent:
        item.task.wait()
    assert finished_parts(folder) == list(range(5))
    assert send(folder, wait=False, said=said)["splits"] == {"train": 3, "valid": 1, "test": 1}
    assert len(said) == 1


def test_what_failed_in_the_meantime_is_collected_too(send, tmp_path, monkeypatch):
    """Nobody waited for trajectory 3, which cannot be made: it is listed and not sent again."""
    folder, sent, said = tmp_path / "data", [], []
    submit, make = cluster._send, cluster.make_part

    def noted(*rest, **options):
        sent.extend(submit(*rest, **options))
        return sent

    def made(experiment, job, **options):
        if job.index == 3:
            return Outcome(index=3, problem="guard 'speed' broken")
        return make(experiment, job, **options)

    monkeypatch.setattr(cluster, "_send", noted)
    monkeypatch.setattr(cluster, "make_part", made)
    send(folder, wait=False, said=said)
    for item in sent:
        item.task.wait()
    result = send(folder, wait=False, said=said)
    assert len(said) == 1
    assert result["splits"] == {"train": 2, "valid": 1, "test": 1}
    assert result["failures"] == [{"index": 3, "reason": "guard 'speed' broken"}]


def test_trajectories_of_a_lost_task_are_sent_again_and_then_listed(send, tmp_path, monkeypatch):
    """A task that ends without a word about trajectory 3, twice."""
    call = cluster.Chunk.__call__

    def forgetful(self):
        rest = tuple(job for job in self.jobs if job.index != 3)
        return call(replace(self, jobs=rest))

    monkeypatch.setattr(cluster.Chunk, "__call__", forgetful)
    said = []
    result = send(tmp_path / "data", said=said)
    assert ["sent 5" in said[0], "sent 1" in said[1], len(said)] == [True, True, 2]
    assert result["trajectories"] == 4
    (failure,) = result["failures"]
    assert failure["index"] == 3
    assert "without an answer" in failure["reason"]


def test_task_that_is_sent_again_goes_on_where_it_stopped(short, tmp_path):
    """What its log answers for, made or failed, is not tried again (preemption, time limit)."""
    jobs = tuple(jobs_of([0, 1, 2], seed=0, shape=None))
    chunk = cluster.Chunk(
        experiment=short, jobs=jobs, folder=str(tmp_path), device="cpu", log="chunk"
    )
    (tmp_path / "work.json").write_text("{}")
    append_entry(tmp_path, "chunk", asdict(Outcome(index=1, problem="guard")))
    again = chunk.checkpoint().function
    assert again() == 2
    assert again() == 0
    assert [entry["index"] for entry in read_entries(tmp_path, "chunk")] == [1, 0, 2]
    assert not part_path(tmp_path, 1).exists()


def test_parameters_reach_slurm(monkeypatch, short, tmp_path):
    """What sbatch is told; the names are those of its manual."""
    told = {}

    class Recorder:
        def __init__(self, folder, cluster):
            told.update(folder=folder, cluster=cluster)

        def update_parameters(self, **given):
            told.update(given)
            raise InterruptedError

    monkeypatch.setattr(submitit, "AutoExecutor", Recorder)
    options = Cluster(partition="gpu", account="physics", minutes=9, memory_gib=7, parallel=3)
    todo = jobs_of([0], seed=0, shape=None)
    with pytest.raises(InterruptedError):
        cluster._send(todo, short, folder=tmp_path, cluster=options, device="cuda")
    expected = {
        "cluster": "slurm",
        "slurm_partition": "gpu",
        "slurm_account": "physics",
        "timeout_min": 9,
        "mem_gb": 7,
        "gpus_per_node": 1,
        "slurm_array_parallelism": 3,
    }
    assert expected.items() <= told.items()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--executor", "slurm"), "no 'srun'"),
        (("--executor", "submitit-local", "--chunk", "0"), "Cluster.chunk must be >= 1"),
        (("--executor", "submitit-local", "--slurm-time", "0"), "Cluster.minutes must be >= 1"),
        (("--no-wait",), "--no-wait needs --executor slurm"),
        (("--executor", "ray"), "invalid choice: 'ray'"),
    ],
)
def test_work_that_cannot_be_sent_is_refused(  # noqa: PLR0917
    capsys, monkeypatch, tiny_yaml, tmp_path, words, text
):
    """One line, exit code 2, no folder."""
    monkeypatch.setenv("PATH", str(tmp_path))
    out = tmp_path / "data"
    given = ["simulate", str(tiny_yaml), "--trajectories", "2", "--out", str(out), *words]
    assert main([*given, "--quiet"]) == 2
    assert text in capsys.readouterr().err
    assert not out.exists()


def test_command_collects_what_its_tasks_made(capsys, monkeypatch, tiny_yaml, tmp_path):
    """Giorom simulate --executor: the line about what is sent, the keys of cli.md."""
    from giorom.commands import simulate

    monkeypatch.setitem(simulate.EXECUTORS, "submitit-local", "debug")
    out, file = tmp_path / "data", tmp_path / "result.json"
    words = ["simulate", str(tiny_yaml), "--trajectories", "3", "--out", str(out)]
    words += ["--executor", "submitit-local", "--solver.frames", "4", "--json", str(file)]
    assert main(words) == 0
    assert "sent 3 trajectories" in capsys.readouterr().out
    assert json.loads(file.read_text())["trajectories"] == 3
