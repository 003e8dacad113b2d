"""NCLaw's state folders, written by PyTorch."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from giorom.data.readers import DataError, detect_format
from giorom.data.readers.nclaw import NCLAW


def state(x: torch.Tensor) -> dict[str, Any]:
    """What a step of NCLaw's simulator leaves behind."""
    count = len(x)
    matrices = torch.eye(3).repeat(count, 1, 1)
    return {
        "x": x,
        "v": torch.zeros(count, 3),
        "C": torch.zeros(count, 3, 3),
        "F": matrices,
        "stress": matrices.clone(),
        "sections": [count],
        "types": ["jelly"],
    }


def write_run(folder: Path, seed: int, *, is_zip: bool = True, frames: int = 3) -> torch.Tensor:
    folder.mkdir(parents=True)
    positions = torch.rand(frames, 9, 3, generator=torch.Generator().manual_seed(seed))
    for number, x in enumerate(positions):
        torch.save(
            state(x.clone()),
            folder / f"{number:04d}.pt",
            _use_new_zipfile_serialization=is_zip,
        )
    return positions


@pytest.mark.parametrize("is_zip", [True, False])
@pytest.mark.parametrize("depth", ["", "state", "run/state"])
def test_states_come_back_bit_by_bit(is_zip: bool, depth: str, tmp_path: Path):
    """The folder of the states, the folder around it, or one of several runs."""
    positions = write_run(tmp_path / "data" / depth, 0, is_zip=is_zip)
    assert detect_format(tmp_path / "data") is NCLAW
    (trajectory,) = NCLAW.read(tmp_path / "data")
    assert np.array_equal(np.stack(list(trajectory.frames())), positions.numpy())
    assert trajectory.frame_count == 3
    assert trajectory.frame_dt is None
    assert any("5e-4" in note for note in trajectory.notes)


def test_each_run_of_a_folder_is_a_trajectory(tmp_path: Path):
    """In the order of their names."""
    expected = [write_run(tmp_path / name / "state", seed) for seed, name in enumerate("abc")]
    found = list(NCLAW.read(tmp_path))
    assert [t.name.split("/")[-2] for t in found] == ["a", "b", "c"]
    for trajectory, positions in zip(found, expected, strict=True):
        assert np.array_equal(np.stack(list(trajectory.frames())), positions.numpy())


def test_states_are_in_the_order_of_their_numbers(tmp_path: Path):
    """10000 comes after 9999, and a gap is said."""
    folder = tmp_path / "state"
    folder.mkdir()
    for number in (10_000, 9_999, 0):
        torch.save(state(torch.full((4, 3), float(number))), folder / f"{number:04d}.pt")
    (trajectory,) = NCLAW.read(tmp_path)
    assert [frame[0, 0] for frame in trajectory.frames()] == [0.0, 9_999.0, 10_000.0]
    assert any("gaps" in note for note in trajectory.notes)


class Reducing:
    """An object whose pickle calls something."""

    def __reduce__(self) -> Any:
        """What the unpickler is told to call."""
        return os.system, ("true",)


@pytest.mark.parametrize(
    ("value", "finding"),
    [
        ({"v": torch.zeros(4, 3)}, "no NCLaw state"),
        ({"x": torch.zeros(4)}, "no NCLaw state"),
        ({"x": torch.zeros(4, 3, dtype=torch.int32)}, "no NCLaw state"),
        ({"x": torch.zeros(5, 3)}, "must not change"),
        ({"x": Reducing()}, "system"),
        ([], "no NCLaw state"),
    ],
)
def test_a_later_state_that_differs_is_refused(value: Any, finding: str, tmp_path: Path):
    """The damage is found when the frame is asked for, and named."""
    folder = tmp_path / "state"
    folder.mkdir()
    torch.save(state(torch.zeros(4, 3)), folder / "0000.pt")
    torch.save(value, folder / "0001.pt")
    (trajectory,) = NCLAW.read(tmp_path)
    frames = trajectory.frames()
    assert next(frames).shape == (4, 3)
    with pytest.raises(DataError, match=finding) as refusal:
        next(frames)
    assert "\n" not in str(refusal.value)


def test_a_state_whose_storage_is_cut_off_is_refused(tmp_path: Path):
    """The storages of the older layout stand at the end of the file."""
    folder = tmp_path / "state"
    write_run(folder, 0, is_zip=False, frames=1)
    data = (folder / "0000.pt").read_bytes()
    (folder / "0000.pt").write_bytes(data[:-200])
    with pytest.raises(DataError, match="cut off"):
        list(NCLAW.read(tmp_path))


def test_a_folder_of_something_else_is_no_state_folder(tmp_path: Path):
    """Numbered files of other contents."""
    torch.save({"weights": torch.zeros(3)}, tmp_path / "0000.pt")
    assert not NCLAW.detect(tmp_path)
    with pytest.raises(DataError, match="no NCLaw state"):
        list(NCLAW.read(tmp_path))
