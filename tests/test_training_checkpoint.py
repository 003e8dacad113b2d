"""Checkpoints are complete or absent, and give back every number."""

import os

import pytest
import torch

from giorom.data.atomic import replacing_folder
from giorom.training.checkpoint import (
    CheckpointError,
    load_checkpoint,
    load_optimizer_tensors,
    optimizer_tensors,
    save_checkpoint,
)


def write_directory(path, fill):
    """Replace a directory whole."""
    with replacing_folder(path) as temporary:
        fill(temporary)


def test_failing_fill_leaves_the_old_directory_and_nothing_else(tmp_path):
    """Atomicity: the state before or the state after, never a mixture."""
    path = tmp_path / "kept"
    write_directory(path, lambda folder: (folder / "value").write_text("old"))

    def fail(folder):
        (folder / "value").write_text("new")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_directory(path, fail)
    assert (path / "value").read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["kept"]


def test_directory_is_replaced_whole(tmp_path):
    """Files of the old directory do not survive in the new one."""
    path = tmp_path / "kept"
    write_directory(path, lambda folder: (folder / "first").write_text("1"))
    write_directory(path, lambda folder: (folder / "second").write_text("2"))
    assert [entry.name for entry in path.iterdir()] == ["second"]


def test_interruption_between_the_two_renames_leaves_the_old_directory(tmp_path, monkeypatch):
    """Atomicity at the worst moment: the old one is aside, the new one not yet in place."""
    path = tmp_path / "kept"
    write_directory(path, lambda folder: (folder / "value").write_text("old"))
    replace = os.replace

    def interrupted(source, target):
        if str(source).endswith(".tmp"):
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_directory(path, lambda folder: (folder / "value").write_text("new"))
    assert (path / "value").read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize("kind", [torch.optim.AdamW, torch.optim.Adamax])
def test_restored_optimiser_takes_the_same_next_step(tmp_path, kind):
    """Reference: the optimiser that was never stored; compared bit for bit."""

    def make():
        torch.manual_seed(0)
        model = torch.nn.Linear(3, 2)
        return model, kind(model.parameters(), lr=1e-2, weight_decay=1e-3)

    def step(model, optimizer, number):
        optimizer.zero_grad()
        model(torch.full((4, 3), float(number))).square().sum().backward()
        optimizer.step()

    model, optimizer = make()
    names = [name for name, _ in model.named_parameters()]
    for number in range(3):
        step(model, optimizer, number)
    tensors = {f"model.{k}": v for k, v in model.state_dict().items()}
    tensors |= optimizer_tensors(optimizer, names)
    save_checkpoint(tmp_path, step=3, tensors=tensors, record={"note": "x"})

    loaded, record = load_checkpoint(tmp_path)
    assert record == {"step": 3, "note": "x"}
    other, other_optimizer = make()
    other.load_state_dict({k: loaded[f"model.{k}"] for k in other.state_dict()})
    load_optimizer_tensors(other_optimizer, names, loaded)
    step(model, optimizer, 3)
    step(other, other_optimizer, 3)
    for ours, theirs in zip(other.parameters(), model.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_only_the_newest_checkpoint_is_kept_and_read(tmp_path):
    """Step 10 comes after step 9, in numbers and in names."""
    for step in (9, 10):
        save_checkpoint(tmp_path, step=step, tensors={"a": torch.tensor(step)}, record={})
    assert [entry.name for entry in tmp_path.iterdir()] == ["step-000000010"]
    tensors, record = load_checkpoint(tmp_path)
    assert record["step"] == int(tensors["a"]) == 10


@pytest.mark.parametrize("name", ["state.safetensors", "state.json"])
@pytest.mark.parametrize("damage", ["truncate", "remove", "scribble"])
def test_damaged_checkpoint_is_refused_in_one_line(tmp_path, name, damage):
    """One CheckpointError that names the folder, whatever happened to the file."""
    path = save_checkpoint(tmp_path, step=1, tensors={"a": torch.ones(50)}, record={})
    file = path / name
    if damage == "remove":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:8] if damage == "truncate" else b"\xff\x00 nothing")
    with pytest.raises(CheckpointError, match="step-000000001 is damaged") as caught:
        load_checkpoint(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_checkpoint_says_what_to_do(tmp_path):
    """The message names the option that led here."""
    with pytest.raises(CheckpointError, match="without --resume"):
        load_checkpoint(tmp_path)
