"""Making a data set under bad luck: kills, Ctrl-C, a full disk, two writers, absurd requests.

The reference is always the set made in one go by one process: the same files, byte for byte.
"""

import errno
import hashlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest

from giorom.cli import main
from giorom.data.lock import LOCK_FILE, WITHOUT_LOCKS, only_writer
from giorom.data.metadata import DataError
from giorom.data.work_folder import finished_parts, part_path
from giorom.data.work_log import append_entry, keep_failures, read_entries
from giorom.generate import generate, pool, room
from giorom.generate import trajectory as module
from giorom.generate.trajectory import Job, Outcome
from giorom.mpm import SolverConfig, draw_scene
from giorom.mpm.scene_config import JELLY3D
from giorom.mpm.simulate import Run

COUNT = 5
"""Trajectories of each set."""


@pytest.fixture(scope="module")
def short(tiny):
    """Four frames and a coarse body: a scene takes milliseconds."""
    return replace(tiny, solver=replace(tiny.solver, frames=4))


def make(experiment, folder, *, jobs=1, trajectories=COUNT, report=lambda done, wanted: None):
    """Make a set."""
    return generate(
        experiment,
        folder=folder,
        trajectories=trajectories,
        seed=0,
        jobs=jobs,
        shape=None,
        device="cpu",
        report=report,
    )


def digests(folder):
    """SHA-256 of every file but the logs, which hold measurements."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.parent.name != "log"
    }


@pytest.fixture(scope="module")
def uninterrupted(short, tmp_path_factory):
    """Digests of the set made in one go."""
    folder = tmp_path_factory.mktemp("whole") / "data"
    make(short, folder)
    return digests(folder)


def test_set_consists_of_what_its_description_says(uninterrupted):
    """Parts, splits, metadata and claim; no lock, no temporary file, no list of failures."""
    parts = {f"parts/{index:05d}.h5" for index in range(COUNT)}
    files = {"work.json", "metadata.json", "train.h5", "valid.h5", "test.h5"}
    assert set(uninterrupted) == parts | files


def test_temporary_file_of_a_killed_worker_is_cleared_away(short, uninterrupted, tmp_path):
    """It appears while the work goes on, and nobody owns it when the work ends."""
    folder = tmp_path / "data"

    def report(done, wanted):
        if done == 9:
            (folder / "parts" / ".00001.4711.tmp.h5").write_bytes(b"half")

    make(short, folder, report=report)
    assert digests(folder) == uninterrupted


@pytest.mark.slow
def test_two_processes_one_of_them_killed_make_the_same_files(short, uninterrupted, tmp_path):
    """A killed process is replaced and its trajectory made again; the other one goes on."""
    killed, seen = [], []

    def report(done, wanted):
        seen.append((done, wanted))
        if done > 0 and not killed:
            victim = multiprocessing.active_children()[0]
            os.kill(victim.pid, signal.SIGKILL)
            killed.append(victim.pid)

    result = make(short, tmp_path / "data", jobs=2, report=report)
    assert len(killed) == 1
    assert result["failed"] == 0
    assert seen[-1] == (COUNT * 4, COUNT * 4)
    assert digests(tmp_path / "data") == uninterrupted
    assert multiprocessing.active_children() == []


def test_command_killed_and_started_again_makes_the_same_files(
    short, uninterrupted, tiny_yaml, tmp_path
):
    """SIGKILL of the whole command as soon as a part is there; what it left is cleared away."""
    folder = tmp_path / "data"
    words = ["simulate", str(tiny_yaml), "--out", str(folder), "--trajectories", str(COUNT)]
    words += ["--solver.frames", "4", "--jobs", "1", "--quiet"]
    command = subprocess.Popen([sys.executable, "-m", "giorom.cli", *words])  # noqa: S603
    while not finished_parts(folder) and command.poll() is None:
        time.sleep(1e-3)
    command.kill()
    command.wait()
    (folder / "parts" / ".00003.4711.tmp.h5").write_bytes(b"half")
    (folder / LOCK_FILE).write_text(json.dumps({"pid": command.pid, "host": "here"}))
    make(short, folder)
    assert digests(folder) == uninterrupted


@pytest.mark.parametrize("frames", [1, 9, COUNT * 4])
def test_interruption_keeps_what_is_finished_and_says_how_to_go_on(
    short, uninterrupted, tmp_path, frames
):
    """Ctrl-C during the first trajectory, the third, and before the assembly."""
    folder = tmp_path / "data"

    def report(done, wanted):
        if done >= frames:
            raise KeyboardInterrupt

    kept = (frames - 1) // 4 if frames < COUNT * 4 else COUNT - 1
    with pytest.raises(KeyboardInterrupt, match=rf"{kept} of {COUNT} .* same command again"):
        make(short, folder, report=report)
    assert finished_parts(folder) == list(range(kept))
    assert not (folder / LOCK_FILE).exists()
    make(short, folder)
    assert digests(folder) == uninterrupted


def test_full_disk_ends_the_work_in_one_line_and_keeps_the_parts(
    short, uninterrupted, tmp_path, monkeypatch
):
    """ENOSPC of the third part; with room again the set is completed."""
    folder, write = tmp_path / "data", module.open_trajectory_writer

    @contextmanager
    def full(path, **options):
        with write(path, **options) as writer:
            if path.name == "00002.h5":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            yield writer

    with monkeypatch.context() as patch:
        patch.setattr(module, "open_trajectory_writer", full)
        with pytest.raises(OSError, match=rf"no space is left .* 2 of {COUNT} trajectories"):
            make(short, folder)
    assert finished_parts(folder) == [0, 1]
    make(short, folder)
    assert digests(folder) == uninterrupted


def test_full_disk_while_the_splits_are_written_is_not_taken_for_a_damaged_part(
    short, tmp_path, monkeypatch
):
    """HDF5 words the system's answer itself, while the part that is copied is open too."""
    import h5py

    def full(*_, **__):
        raise OSError(
            "Unable to copy object (errno = 28, error message = 'No space left on device')"
        )

    monkeypatch.setattr(h5py.File, "copy", full)
    with pytest.raises(OSError, match=rf"no space is left .* {COUNT} of {COUNT} trajectories"):
        make(short, tmp_path / "data")
    assert not (tmp_path / "data" / "metadata.json").exists()


def test_second_writer_is_refused_and_a_lock_left_behind_is_not(short, tmp_path):
    """The lock belongs to the process, not to the file."""
    folder = tmp_path / "data"
    with only_writer(folder), pytest.raises(DataError, match=rf"written by process {os.getpid()}"):
        make(short, folder)
    assert list(folder.iterdir()) == []
    (folder / LOCK_FILE).write_text("{")
    assert make(short, folder, trajectories=3)["trajectories"] == 3
    assert not (folder / LOCK_FILE).exists()


@pytest.mark.parametrize("answer", WITHOUT_LOCKS)
def test_disk_without_locks_is_written_to_and_another_fault_is_said(tmp_path, monkeypatch, answer):
    """Clusters mount their disks without locks; that nobody else holds one is the truth there."""

    def answered(number):
        def lock(descriptor, operation):
            raise OSError(number, os.strerror(number))

        return lock

    monkeypatch.setattr("fcntl.flock", answered(answer))
    with only_writer(tmp_path):
        assert (tmp_path / LOCK_FILE).exists()
    monkeypatch.setattr("fcntl.flock", answered(errno.EIO))
    with pytest.raises(OSError, match=os.strerror(errno.EIO)), only_writer(tmp_path):
        pass


@pytest.mark.parametrize(
    ("change", "trajectories", "message"),
    [
        ({}, 10**12, "at most 1000000 trajectories"),
        ({"frames": 2}, 3, "three frames or more"),
        ({"frames": 10**12}, 2, r"take about .* TiB on the disk, but .* are free"),
        ({"frames": 10**12, "grid_cells": 64}, 10**6, r"take about .* TiB on the disk"),
    ],
)
def test_absurd_requests_are_refused_before_work(tiny, tmp_path, change, trajectories, message):
    """At once, with the numbers; no folder appears."""
    absurd = replace(tiny, solver=replace(tiny.solver, **change))
    with pytest.raises(ValueError, match=message):
        make(absurd, tmp_path / "data", trajectories=trajectories)
    assert not (tmp_path / "data").exists()


def test_runs_that_exceed_the_memory_are_refused(tiny, short, tmp_path, monkeypatch):
    """A thousand processes, or a grid of 1024 cells, on a machine with eight mebibytes left."""
    folder = tmp_path / "data"
    make(short, folder)
    monkeypatch.setattr("giorom.generate.room.free_memory", lambda: 8 << 20)
    make(short, folder)
    with pytest.raises(ValueError, match=r"1000 runs at a time .* but 8 MiB are free.*--jobs"):
        make(short, folder, trajectories=2000, jobs=1000)
    fine = replace(tiny, solver=replace(tiny.solver, grid_cells=1024))
    with pytest.raises(ValueError, match=r"1024 cells per axis.* take about 16 GiB of memory"):
        make(fine, tmp_path / "fine")
    assert not (tmp_path / "fine").exists()


def test_memory_of_a_particle_is_what_the_solver_holds_for_it():
    """Counted in the arrays of a body of sand in space, which carries the most."""
    sand = {"density": 1e3, "youngs_modulus": 1e5, "poissons_ratio": 0.2, "friction_angle": 30.0}
    config = replace(JELLY3D, material="drucker_prager_sand", material_parameters=sand)
    scene = draw_scene(replace(config, spacing=1.0 / 32.0), seed=0)
    engine = Run(scene, SolverConfig(grid_cells=32, frame_dt=1e-3, frames=1))._engine
    (group,) = engine._groups
    held = [engine._x, engine._v, engine._affine, engine._stress, engine._volume, engine._mass]
    held += [group.state, group.volume_correction]
    found = sum(array.capacity for array in held) / len(scene.position)
    assert found == room.BYTES_PER_PARTICLE


class FakeWorker(pool._Worker):
    """A worker that answers at once, or is gone when it is given a job it cannot bear."""

    deadly: frozenset[int] = frozenset()

    def __init__(self, make):
        self.frames = SimpleNamespace(value=0)
        self.connection, self.theirs = multiprocessing.Pipe()
        self.process = SimpleNamespace(exitcode=None, join=lambda: None)
        self.process.is_alive = lambda: self.process.exitcode is None
        self.job = None

    def give(self, job: Job) -> None:
        """Answer or die."""
        self.job = job
        if job.index in self.deadly:
            self.process.exitcode = -9
            self.theirs.close()
        else:
            self.theirs.send(Outcome(index=job.index))

    def end(self) -> None:
        """Close the pipe."""
        self.connection.close()
        self.theirs.close()


def test_trajectory_that_kills_two_processes_is_listed_and_the_rest_is_made(
    short, tmp_path, monkeypatch
):
    """The reason names the signal."""
    monkeypatch.setattr(pool, "_Worker", FakeWorker)
    monkeypatch.setattr(FakeWorker, "deadly", frozenset({3}))
    outcomes = list(_run_fakes(short, tmp_path, count=8))
    assert sorted(outcome.index for outcome in outcomes) == list(range(8))
    (failed,) = [outcome for outcome in outcomes if outcome.problem]
    assert failed.index == 3
    assert "signal 9" in failed.problem


def test_processes_that_only_die_are_not_started_for_ever(short, tmp_path, monkeypatch):
    """A thousand trajectories, none of which can be begun."""
    monkeypatch.setattr(pool, "_Worker", FakeWorker)
    monkeypatch.setattr(FakeWorker, "deadly", frozenset(range(1000)))
    with pytest.raises(RuntimeError, match="none finished a trajectory"):
        list(_run_fakes(short, tmp_path, count=1000))


def _run_fakes(experiment, folder, *, count):
    todo = [Job(index=index, seed=index, shape=None) for index in range(count)]
    return pool.run_jobs(
        todo, experiment, folder=folder, jobs=2, device="cpu", tick=lambda frames: None
    )


def test_log_holds_the_measurements_and_survives_a_torn_line(short, tmp_path):
    """One line for each trajectory, with the work of the solver: particles times substeps."""
    folder = tmp_path / "data"
    result = make(short, folder, trajectories=3)
    with (folder / "log" / "simulate.jsonl").open("a") as file:
        file.write('{"index": 7, "pro')
    append_entry(folder, "other", {"index": 1})
    entries = list(read_entries(folder, "simulate"))
    assert [entry["index"] for entry in entries] == [0, 1, 2]
    assert all(entry["seconds"] > 0.0 for entry in entries)
    work = sum(entry["particle_substeps"] for entry in entries)
    assert result["particle_substeps_per_second"] == pytest.approx(work / result["seconds"])
    assert b"seconds" not in part_path(folder, 0).read_bytes()


def test_list_of_failures_goes_with_the_failures(tmp_path):
    """Rising numbers; no failure, no file."""
    keep_failures(tmp_path, {4: "late", 2: "early"})
    listed = json.loads((tmp_path / "failures.json").read_text())["failures"]
    assert [entry["index"] for entry in listed] == [2, 4]
    keep_failures(tmp_path, {})
    assert not (tmp_path / "failures.json").exists()


def test_command_that_is_interrupted_ends_with_130_and_the_line(
    capsys, monkeypatch, tiny_yaml, tmp_path
):
    """What ``generate`` says about the parts that are kept is what the user reads."""
    from giorom.commands import simulate

    def interrupted(*_, **__):
        raise KeyboardInterrupt("interrupted; 3 of 9 trajectories are kept.")

    monkeypatch.setattr(simulate, "generate", interrupted)
    words = ["simulate", str(tiny_yaml), "--trajectories", "9", "--out", str(tmp_path / "data")]
    assert main([*words, "--quiet"]) == 130
    line = "giorom simulate: interrupted; 3 of 9 trajectories are kept.\n"
    assert capsys.readouterr().err == line
