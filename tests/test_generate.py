"""Making a data set: continued where it stopped, failures counted, nothing mixed."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

from giorom.data.metadata import DataError
from giorom.data.trajectory_file import iterate_trajectories, read_metadata, read_trajectory_file
from giorom.data.work_folder import finished_parts, part_path, split_parts
from giorom.generate import trajectory as module
from giorom.mpm import SimulationError
from giorom.mpm import draw_scene as draw
from giorom.mpm.simulate import chosen_substeps


@pytest.fixture
def short(tiny):
    """Four frames and a coarse body: a scene takes milliseconds."""
    return replace(tiny, solver=replace(tiny.solver, frames=4))


def test_result_says_what_is_in_the_folder(short, make_data, tmp_path):
    """Counts of the result, the metadata and the files agree (cli.md lists the keys)."""
    result = make_data(short, tmp_path / "data", trajectories=4)
    for key in "trajectories points frames frame_dt particle_substeps_per_second seconds".split():
        assert result[key] > 0
    motions = {
        name: list(iterate_trajectories(tmp_path / "data", name))
        for name in ("train", "valid", "test")
    }
    assert {name: len(found) for name, found in motions.items()} == result["splits"]
    assert sum(result["splits"].values()) == result["trajectories"] == 4
    every = [motion for found in motions.values() for motion in found]
    assert result["points"] == max(motion.position.shape[1] for motion in every)
    assert {motion.frame_count for motion in every} == {result["frames"]} == {4}
    assert {motion.frame_dt for motion in every} == {result["frame_dt"]} == {5e-3}
    assert result["failed"] == 0
    assert result["failures"] == []


def test_only_the_missing_trajectory_is_made_and_it_is_the_same(
    short, make_data, tmp_path, monkeypatch
):
    """Reference: the part that was removed; the solver on one thread repeats bit for bit."""
    folder = tmp_path / "data"
    make_data(short, folder, trajectories=3)
    before = read_trajectory_file(part_path(folder, 1)).position
    part_path(folder, 1).unlink()
    made = []
    monkeypatch.setattr(
        module,
        "draw_scene",
        lambda *rest, **given: made.append(given["seed"]) or draw(*rest, **given),
    )
    make_data(short, folder, trajectories=3)
    assert made == [1]
    assert torch.equal(read_trajectory_file(part_path(folder, 1)).position, before)


def test_finished_set_is_made_again_from_its_parts(short, make_data, tmp_path, monkeypatch):
    """No scene is simulated; the metadata are those of before but for the clock."""
    make_data(short, tmp_path / "data", trajectories=3)
    before = read_metadata(tmp_path / "data")
    monkeypatch.setattr(module, "Run", None)
    result = make_data(short, tmp_path / "data", trajectories=3)
    assert read_metadata(tmp_path / "data") == before
    assert result["particle_substeps_per_second"] is None


@pytest.fixture
def guards(monkeypatch):
    """Let the guard of chosen scenes break: {seed: how many runs break}."""
    breaking, run = {}, module.Run

    class Fragile(run):
        def frames(self):
            yield from ()
            seed = self.scene.attributes["seed"]
            if breaking.get(seed, 0) > 0:
                breaking[seed] -= 1
                raise SimulationError("frame 2: guard 'speed'\n broken.")
            yield from super().frames()

    monkeypatch.setattr(module, "Run", Fragile)
    return breaking


def test_scene_that_breaks_a_guard_three_times_is_listed_and_left_out(
    short, make_data, tmp_path, guards
):
    """Trajectory 1 fails; the others keep their numbers and their splits."""
    guards[1] = 3
    result = make_data(short, tmp_path / "data", trajectories=4)
    reason = "frame 2: guard 'speed' broken. It broke a guard with 4 times the substeps too."
    assert result["trajectories"] == 3
    assert result["failed"] == 1
    assert result["failures"] == [{"index": 1, "reason": reason}]
    listed = json.loads((tmp_path / "data" / "failures.json").read_text())
    assert listed == {"failures": result["failures"]}
    assert finished_parts(tmp_path / "data") == [0, 2, 3]
    seeds = [
        motion.attributes["seed"]
        for name in ("train", "valid", "test")
        for motion in iterate_trajectories(tmp_path / "data", name)
    ]
    assert sorted(seeds) == [0, 2, 3]
    assert make_data(short, tmp_path / "data", trajectories=4)["failed"] == 0
    assert not (tmp_path / "data" / "failures.json").exists()


def test_scene_that_breaks_a_guard_is_repeated_with_more_substeps(
    short, make_data, tmp_path, guards
):
    """Twice, then four times as many as the rules ask for; the trajectory says so."""
    guards |= {1: 1, 2: 2}
    make_data(short, tmp_path / "data", trajectories=3)
    kept = [read_trajectory_file(part_path(tmp_path / "data", i)).attributes for i in range(3)]
    for index, factor in enumerate((1, 2, 4)):
        scene = draw(short.scene, seed=index)
        assert kept[index]["substeps"] == factor * chosen_substeps(scene, short.solver)
        assert kept[index].get("substep_factor", 1) == factor
    assert kept[2]["guard_broken"] == "frame 2: guard 'speed' broken."


def test_set_whose_every_scene_fails_is_an_error(short, make_data, tmp_path, guards):
    """The reason of the first failure is the message."""
    guards |= {0: 3, 1: 3}
    with pytest.raises(SimulationError, match=r"no trajectory could be simulated.*guard 'speed'"):
        make_data(short, tmp_path / "data", trajectories=2)
    assert not (tmp_path / "data" / "metadata.json").exists()


@pytest.mark.parametrize("change", ["seed", "scene", "solver", "system"])
def test_folder_of_another_data_set_is_refused(tiny, data_folder, make_data, tmp_path, change):
    """Whatever decides what the trajectories are must agree; the folder stays as it was."""
    folder = shutil.copytree(data_folder, tmp_path / "data")
    before = sorted(path.name for path in folder.rglob("*"))
    experiment = {
        "seed": tiny,
        "scene": replace(tiny, scene=replace(tiny.scene, spacing=0.05)),
        "solver": replace(tiny, solver=replace(tiny.solver, frames=5)),
        "system": replace(tiny, system="other"),
    }[change]
    with pytest.raises(DataError, match=rf"holds another data set: its {change}(\.\w+)? is"):
        make_data(experiment, folder, seed=1 if change == "seed" else 0)
    assert sorted(path.name for path in folder.rglob("*")) == before


def test_scene_that_cannot_be_drawn_leaves_nothing_behind(tiny, make_data, tmp_path):
    """A body taller than the box is refused before the folder is made."""
    tall = replace(tiny, scene=replace(tiny.scene, height_range=[2.0, 3.0]))
    with pytest.raises(ValueError, match="beyond the upper wall"):
        make_data(tall, tmp_path / "data")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        ({"frame_dt": 1e30}, r"would take .* substeps .*more than 1000000"),
        ({"substeps": 1}, r"breaks the time-step rule.*Set SolverConfig\.substeps to"),
        ({"grid_cells": 8}, r"are nearer than 2 cells .* to a side of the unit box"),
    ],
)
def test_solver_that_cannot_run_the_scene_leaves_nothing_behind(
    tiny, make_data, tmp_path, solver, message
):
    """So that the corrected command is not refused for the sake of the folder it left."""
    wrong = replace(tiny, solver=replace(tiny.solver, **solver))
    with pytest.raises(ValueError, match=message):
        make_data(wrong, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_no_trajectory_is_in_two_splits_and_shares_hold():
    """A partition with a tenth each held out; growing a set moves no trajectory."""
    for count in (3, 6, 20, 100):
        splits = split_parts(list(range(count)))
        every = [part for parts in splits.values() for part in parts]
        assert sorted(every) == list(range(count))
        assert len(splits["valid"]) == len(splits["test"]) == max(1, count // 10)
    small, large = (split_parts(list(range(count))) for count in (20, 50))
    for name in small:
        assert set(small[name]) <= set(large[name])


def test_scene_of_a_trajectory_depends_on_its_number_alone(short, make_data, tmp_path):
    """A set of five begins with the set of three."""
    for name, count in (("three", 3), ("five", 5)):
        make_data(short, tmp_path / name, trajectories=count)
    for part in range(3):
        first, second = (
            read_trajectory_file(part_path(tmp_path / name, part)) for name in ("three", "five")
        )
        assert torch.equal(first.position, second.position)
