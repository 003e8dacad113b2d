"""Scoring without a data set, and the catalogue: fresh scenes, numbers copied from their files."""

import json
import shutil

import pytest
import torch

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.card import write_card
from giorom.evaluation.catalogue import catalogue, update_catalogue
from giorom.evaluation.paper import PAPER, paper_values
from giorom.generate.held_out import (
    HELD_OUT_SEED,
    held_out_trajectories,
    make_held_out,
    require_unseen,
)
from giorom.simulator import PRETRAINED


@pytest.fixture
def published(run_folder, succeed, tmp_path):
    """A folder of pretrained models that holds the tiny one, scored and with its training."""
    directory = shutil.copytree(run_folder / "simulator", tmp_path / "models" / "tiny")
    scores = succeed("evaluate", directory, "--trajectories", 3, "--jobs", 1, "--frames", 5)
    (directory / "metrics.json").write_text(json.dumps(scores))
    (directory / "training.json").write_text(json.dumps({"steps": 20, "seconds": 3.5, "x": 1}))
    return directory


def test_a_held_out_set_is_what_simulate_makes_with_its_seed(
    simulator, tiny, make_data, data_folder, tmp_path
):
    """The same trajectories, bit by bit, and none of the training set's."""
    made = make_held_out(simulator.config, folder=tmp_path / "fresh", trajectories=3, seed=2)
    assert made["seed"] == HELD_OUT_SEED + 2
    make_data(tiny, tmp_path / "same", trajectories=3, seed=HELD_OUT_SEED + 2)
    found = [t.position for t in held_out_trajectories(tmp_path / "fresh")]
    expected = [t.position for t in held_out_trajectories(tmp_path / "same")]
    assert len(found) == 3
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    for known in iterate_trajectories(data_folder, "train"):
        assert not any(torch.equal(known.position[0], fresh[0]) for fresh in found)


def test_evaluate_without_data_gives_the_same_score_again(succeed, run_folder):
    """Made afresh twice, from the same seed: equal; with another seed: other scenes."""
    words = ("evaluate", run_folder, "--trajectories", 3, "--jobs", 1, "--frames", 6)
    first, second = succeed(*words), succeed(*words)
    assert first == second
    assert first["held_out"]["seed"] == HELD_OUT_SEED
    assert (first["trajectories"], first["frames"]) == (3, 6)
    other = succeed(*words, "--seed", 1)
    assert other["sparse"]["static_mse"] != first["sparse"]["static_mse"]


def test_evaluate_without_data_takes_longer_runs_shapes_and_samples(succeed, run_folder):
    """More frames than the training has, a shape that it kept out, half the samples."""
    words = ("evaluate", run_folder, "--trajectories", 1, "--jobs", 1, "--shape", "capsule")
    result = succeed(*words, "--frames", 20, "--sparse", 20)
    assert (result["frames"], result["sparse_points"]) == (20, 20)
    assert result["held_out"]["shape"] == "capsule"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--split", "test"), "--split needs --data"),
        (("--trajectories", 0), "must be >= 1"),
        (("--shape", "no-such-shape"), "no-such-shape"),
    ],
)
def test_evaluate_refuses_options_that_cannot_hold(refuse, run_folder, words, said):
    """One line each."""
    assert said in refuse("evaluate", run_folder, *words)


def test_evaluate_refuses_options_of_fresh_data_beside_data(refuse, run_folder, data_folder):
    """How many there are is known."""
    words = ("evaluate", run_folder, "--data", data_folder, "--trajectories", 3)
    assert "--trajectories is for runs without --data" in refuse(*words)


def test_scenes_a_model_was_trained_on_are_no_test(tmp_path):
    """The seed of the training data is refused; another, or an unknown one, is not."""
    require_unseen(tmp_path, 1000)
    (tmp_path / "training.json").write_text(json.dumps({"data_seed": 1000}))
    require_unseen(tmp_path, 1001)
    with pytest.raises(ValueError, match="are no test"):
        require_unseen(tmp_path, 1000)


@pytest.mark.parametrize("text", ["[]", "{", "[" * 100_000])
def test_a_damaged_record_of_the_training_is_refused_in_one_line(tmp_path, text):
    """Names the file."""
    (tmp_path / "training.json").write_text(text)
    with pytest.raises(ValueError, match=r"training\.json .*Copy it again") as caught:
        require_unseen(tmp_path, 1000)
    assert "\n" not in str(caught.value)


def test_the_catalogue_repeats_what_the_files_of_a_model_say(published):
    """Every number of an entry is that of the file; others are left alone."""
    scores = json.loads((published / "metrics.json").read_text())
    update_catalogue(published.parent, "tiny", ["first"])
    update_catalogue(published.parent, "tiny", ["second"])
    (entry,) = catalogue(published.parent)
    assert entry["commands"] == ["second"]
    assert entry["rollout_mse"] == scores["sparse"]["rollout_mse"]
    assert entry["frozen_shape_mse"] == scores["full"]["frozen_shape_mse"]
    assert entry["training"] == {"steps": 20, "seconds": 3.5}
    assert entry["bytes"] == (published / "model.safetensors").stat().st_size
    assert entry["paper"] is None


def test_the_card_of_a_model_repeats_its_files(published, simulator):
    """Cost, seed and scores; a field that nothing measured has no row."""
    record = {"parameters": 5, "field_parameters": 7, "steps": 20, "seconds": 90.0, "seed": 3}
    record |= {"threads": 1, "history": [{"step": 4, "rollout_mse": 1.0}, {"rollout_mse": None}]}
    (published / "training.json").write_text(json.dumps(record))
    write_card(published, simulator.config, ["giorom train x"])
    text = (published / "README.md").read_text()
    scores = json.loads((published / "metrics.json").read_text())
    assert text.startswith("# tiny\n")
    assert "5 + 7 parameters" in text
    assert "20 steps in 2 minutes, the weights kept are those of step 4 on 1 CPU thread(s)" in text
    assert f"made afresh with the seed {HELD_OUT_SEED}" in text
    assert "    giorom train x\n" in text
    full, sparse = (scores[where]["rollout_mse"] for where in ("full", "sparse"))
    assert f"| rollout MSE | {sparse:.3g} | {full:.3g} |" in text
    assert "predicted over true period" not in text


def test_every_shipped_model_has_an_entry_and_the_papers_numbers(succeed):
    """Keys of cli.md; sizes of the paper stand beside its errors."""
    models = succeed("models")["models"]
    names = sorted(path.parent.name for path in PRETRAINED.glob("*/config.json"))
    assert [model["name"] for model in models] == names
    wanted = {"points", "sparse_points", "bytes", "one_step_mse", "rollout_mse", "commands"}
    wanted |= {"full_rollout_mse", "constant_velocity_mse", "static_mse", "paper_rollout_mse"}
    wanted |= {"training", "frozen_shape_mse", "free_fall_mse", "frames"}
    for model in models:
        assert wanted <= set(model)
        assert model["paper"] == paper_values(model["system"])


def test_the_papers_tables_hold_together():
    """Eight systems; reductions of 4.5 to 33 as printed; Table 3 has four of them."""
    assert len(PAPER) == 8
    assert all(4.5 <= row.points / row.sparse_points < 33 for row in PAPER.values())
    assert sum(row.sparse_rollout_mse is not None for row in PAPER.values()) == 4
