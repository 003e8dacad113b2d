"""The part of a data set that a name tells is the same for every reader."""

from pathlib import Path

import pytest

from giorom.data.readers.frame_files import series_of
from giorom.data.readers.split_names import SPLIT_NAMES, split_files, split_of


@pytest.mark.parametrize(("name", "part"), [*SPLIT_NAMES.items(), ("Training", "train")])
def test_file_and_folder_of_one_name_tell_the_same_part(tmp_path: Path, name: str, part: str):
    """A file of that name, a file in such a folder, and a series of frames in one."""
    (tmp_path / name).mkdir()
    (tmp_path / name / "frame_0.ply").touch()
    assert split_of(tmp_path / f"{name}.npz") == part
    assert split_of(tmp_path / name / "a.npz") == part
    assert [series.split for series in series_of(tmp_path, (".ply",))] == [part]


def test_files_come_by_part_and_then_as_people_count(tmp_path: Path):
    """Training, validation, test, the rest; 2 before 10."""
    for name in ("run10.h5", "run2.h5", "test.h5", "val.h5", "training.h5", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "sim.h5").touch()
    named = ["training.h5", "val.h5", "test.h5", "run2.h5", "run10.h5"]
    assert [file.name for file in split_files(tmp_path, ".h5")] == named
    found = split_files(tmp_path, ".h5", in_folders=True)
    assert [file.name for file in found] == ["sim.h5", *named]
    assert split_files(tmp_path / "val.h5", ".h5") == [tmp_path / "val.h5"]
