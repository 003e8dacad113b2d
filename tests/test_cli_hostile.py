"""Whole commands on hostile and careless input: one line, exit code 2, nothing left, nothing hung.

Each case was found by trying; the reference is the rule of the command line (``giorom.cli``).
"""

import os

import numpy as np
import pytest

from giorom.cli import main


@pytest.fixture
def refused(capsys):
    """Run a command that must refuse its input with one line, and return the line."""

    def call(*words):
        assert main([*map(str, words), "--quiet"]) == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.count("\n") == 1
        return output.err

    return call


@pytest.fixture
def frames(tmp_path):
    """Five PLY frames of six particles."""
    folder = tmp_path / "frames"
    folder.mkdir()
    start = np.random.default_rng(0).random((6, 3))
    header = "ply\nformat ascii 1.0\nelement vertex 6\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    for frame in range(5):
        rows = "".join("{} {} {}\n".format(*row) for row in start + 0.01 * frame)
        (folder / f"f{frame}.ply").write_text(header + rows)
    return folder


def test_metadata_that_are_a_pipe_are_left_alone(frames, tmp_path):
    """Reading a pipe that nobody writes to waits for ever."""
    os.mkfifo(frames / "metadata.json")
    words = ["import", frames, "--out", tmp_path / "set", "--frame-dt", "0.01", "--quiet"]
    assert main(list(map(str, words))) == 0
    assert (tmp_path / "set" / "metadata.json").is_file()


def test_pipe_of_the_name_of_a_data_file_is_not_opened(refused, tmp_path):
    """The HDF5 library waits at it for ever."""
    os.mkfifo(tmp_path / "train.h5")
    assert "of no known format" in refused("export", tmp_path, tmp_path / "out.npz")
    assert "a pipe" in refused("export", tmp_path / "train.h5", tmp_path / "out.npz")


def test_walls_beyond_float32_are_refused(frames, refused, tmp_path):
    """They would be stored as infinite."""
    walls = ["-1e308", "1e308"] * 3
    words = [frames, "--out", tmp_path / "set", "--frame-dt", "0.01", "--bounds", *walls]
    # -1e308 is a value; argparse alone would take it for an option.
    assert "which are no places. Give the right ones with --bounds" in refused("import", *words)
    assert not (tmp_path / "set").exists()
