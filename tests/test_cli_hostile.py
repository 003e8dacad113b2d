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


@pytest.mark.parametrize("target", ["nowhere", "link"])
def test_output_that_is_a_link_to_nowhere_is_refused(frames, refused, tmp_path, target):
    """Renaming a finished folder onto it would fail at the very end."""
    link = tmp_path / "link"
    link.symlink_to(target)
    for words in (["import", frames], ["inspect", frames], ["simulate", "sand2d-small"]):
        more = ["--trajectories", "1"] if words[0] == "simulate" else []
        assert "is a link that leads nowhere" in refused(*words, "--out", link, *more)
    assert os.readlink(link) == target


def test_name_without_room_for_a_temporary_one_is_refused(frames, refused, tmp_path):
    """A file system takes names of 255 bytes; ours are longer than the final one while written."""
    line = refused("import", frames, "--frame-dt", "0.01", "--out", tmp_path / ("x" * 240))
    assert "has 240 bytes; temporary names need room" in line


def test_source_of_which_no_frame_is_kept_is_refused(frames, refused, tmp_path):
    """There is nothing to measure then."""
    for command in ("inspect", "import"):
        words = ["--out", tmp_path / "out", "--frame-dt", "0.01", "--skip", "1000"]
        assert "has no frame to keep. Lower --skip" in refused(command, frames, *words)
    assert not (tmp_path / "out").exists()


def test_line_about_a_long_or_unprintable_value_stays_one_readable_line(frames, refused, tmp_path):
    """A name with an escape sequence would otherwise steer the terminal."""
    words = ["import", frames, "--out", tmp_path / "set"]
    line = refused(*words, "--axes", "x" * 100_000)
    assert line.startswith("giorom import: --axes must name 2 or 3 different axes")
    assert len(line) < 1300
    assert "\\x1b[31m" in refused("export", frames, tmp_path / "a\x1b[31m")


def test_experiment_file_longer_than_any_experiment_is_refused(refused, tmp_path):
    """Checking a list of a million shapes takes minutes."""
    path = tmp_path / "long.yaml"
    path.write_text("scene: {shapes: [" + "box, " * 100_000 + "box]}\n")
    words = ["--config", path, "--trajectories", "1", "--out", tmp_path / "set"]
    assert "more than the 65536 that an experiment may take" in refused("simulate", *words)


def test_body_of_one_particle_leaves_nothing_behind(refused, tmp_path):
    """It has no neighbour that would tell a radius; that is known before the simulation."""
    words = ["sand2d-small", "--scene.spacing", "null", "--scene.points", "1"]
    words += ["--scene.bodies", "[1, 1]", "--solver.frames", "3", "--jobs", "1"]
    line = refused("simulate", *words, "--trajectories", "1", "--out", tmp_path / "set")
    assert "one particle has no neighbour" in line
    assert not (tmp_path / "set").exists()
