"""Damaged files are still recognised, so that the message says what is wrong with them."""

import argparse
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from giorom.commands import data_source
from giorom.data.readers import DataError, detect_format
from giorom.export import source as export_source


def read_all(path: Path) -> None:
    """Every frame of every trajectory."""
    for trajectory in detect_format(path).read(path):
        list(trajectory.frames())


def write_state(path: Path) -> None:
    torch.save({key: torch.zeros(40, 3) for key in ("x", "v", "C", "F")}, path)


def write_windows(path: Path) -> None:
    windows = {"particle_type": [], "position": [np.zeros((50, 6, 2))]}
    path.write_bytes(pickle.dumps(windows))


def write_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["00000/position"] = np.zeros((9, 50, 2), np.float32)


FILES = {
    "train.npz": ("gns-npz", lambda path: np.savez(path, a=np.zeros((9, 50, 2)))),
    "train.obj": ("mpm-verse", write_windows),
    "rollout.pt": ("mpm-verse", lambda path: torch.save({"position": torch.zeros(999)}, path)),
    "state/0000.pt": ("nclaw", write_state),
    "train.h5": ("lagrangebench", write_hdf5),
    "train.tfrecord": ("gns-tfrecord", lambda path: path.write_bytes(bytes(200))),
}


@pytest.mark.parametrize("name", [*FILES])
@pytest.mark.parametrize("is_folder", [True, False])
def test_a_file_cut_in_half_is_recognised_and_refused(name: str, is_folder: bool, tmp_path: Path):
    """By its name where its content is gone."""
    format_name, write = FILES[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    write(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = tmp_path if is_folder or "/" in name else path
    assert detect_format(source).name == format_name
    with pytest.raises(DataError) as refusal:
        read_all(source)
    assert "\n" not in str(refusal.value)
    assert path.name in str(refusal.value)


@pytest.mark.parametrize("content", [b"", b"\x00", b"PK\x03\x04", b"\x80", b"text", b"v 0 0"])
def test_anything_else_is_of_no_known_format_or_refused(content: bytes, tmp_path: Path):
    """Detection never raises."""
    path = tmp_path / "thing"
    path.write_bytes(content)
    with pytest.raises(DataError):
        read_all(path)


def test_an_empty_folder_is_of_no_known_format(tmp_path: Path):
    """There is nothing to tell by."""
    with pytest.raises(DataError, match="no known format"):
        detect_format(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", ["pipe", "pipe.h5", "pipe.npz"])
def test_a_pipe_is_refused_and_not_waited_for(name: str, tmp_path: Path):
    """Nobody ever writes into it: opening it would take for ever."""
    path = tmp_path / name
    os.mkfifo(path)
    arguments = argparse.Namespace(source=path, format="gns-npz")
    openings = (
        lambda: detect_format(path),
        lambda: data_source.open_source(arguments),
        lambda: export_source.open_source(path, split="test", index=0),
    )
    for start in openings:
        with pytest.raises(DataError, match="device or a pipe"):
            start()
