"""``giorom import`` and ``giorom inspect``: what they write, print, and refuse.

The keys are those other programs rely on.
"""

import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from giorom.cli import main
from giorom.config import load_experiment
from giorom.data.trajectory_file import SPLITS, read_trajectory, trajectory_count
from giorom.data.work_folder import assemble_dataset, open_work_folder, write_part
from giorom.evaluation.evaluate import evaluate_trajectory
from giorom.simulator import Simulator
from giorom.state import KINEMATIC
from giorom.training_data import load_training_data

h5py = pytest.importorskip("h5py")

KEYS = {
    "format",
    "trajectories",
    "frames",
    "points",
    "frame_dt",
    "bounds",
    "splits",
    "statistics",
    "suggested",
    "suspicious",
    "notes",
    "files",
}


@pytest.fixture
def succeed(tmp_path, capsys):
    """Run a command that must succeed; its JSON result, and what it printed."""

    def call(*words, quiet=True):
        file = tmp_path / "result.json"
        line = [*map(str, words), "--json", str(file), *(["--quiet"] if quiet else [])]
        assert main(line) == 0
        output = capsys.readouterr()
        if quiet:
            assert output.out == output.err == ""
        return json.loads(file.read_text()), output.out

    return call


@pytest.fixture(scope="session")
def source(data_folder, tmp_path_factory):
    """The tiny data set as somebody else's: LagrangeBench's layout, without our marks."""
    folder = tmp_path_factory.mktemp("foreign") / "source"
    shutil.copytree(data_folder, folder, ignore=shutil.ignore_patterns("parts", "work.json"))
    for name in SPLITS:
        with h5py.File(folder / f"{name}.h5", "r+") as file:
            file.attrs.clear()
            for group in file.values():
                group.attrs.clear()
    return folder


def test_an_import_gives_the_keys_and_the_data(source, data_folder, succeed, tmp_path):
    result, _ = succeed("import", source, "--format", "giorom", "--out", tmp_path / "set")
    assert set(result) >= KEYS
    assert set(result["suggested"]) >= {"sparse_points", "radius"}
    assert set(result["statistics"]) >= {"vel_mean", "vel_std", "acc_mean", "acc_std"}
    assert result["splits"] == {"train": 4, "valid": 1, "test": 1}
    for name in SPLITS:
        for index in range(trajectory_count(data_folder, name)):
            ours = read_trajectory(tmp_path / "set", name, index)
            assert torch.equal(ours.position, read_trajectory(data_folder, name, index).position)
    names = {path.rsplit("/", 1)[1] for path in result["files"]}
    assert {"train.h5", "valid.h5", "test.h5", "metadata.json", "report.json"} <= names


def test_the_screen_shows_the_report_and_the_next_commands(source, succeed, tmp_path):
    words = ("import", source, "--format", "giorom", "--out", tmp_path / "set")
    _, text = succeed(*words, quiet=False)
    for part in ("time between frames", "suggested samples", "suspicious:", "giorom train PRESET"):
        assert part in text
    assert "bounds [m]" in text  # not swallowed as markup
    assert "PRESET is one of 3 dimensions, such as water3d-small" in text


def test_every_option_reaches_the_conversion(source, succeed, tmp_path):
    """Every second frame from the third, in cm, turned, of another type, with new walls."""
    options = "--stride 2 --skip 2 --unit cm --axes x,z,-y --particle-type 6 --frame-dt 0.25"
    walls = ["--bounds", *map(str, (-1, 1, -2, 2, -3, 3))]
    words = (*options.split(), *walls, "--limit", 3, "--splits", 0.34, 0)
    result, _ = succeed("import", source, "--format", "giorom", "--out", tmp_path / "set", *words)
    assert (result["trajectories"], result["frames"], result["frame_dt"]) == (3, 7, 0.5)
    assert result["bounds"] == [[-1.0, 1.0], [-2.0, 2.0], [-3.0, 3.0]]
    assert result["types"].keys() == {"6"}
    assert result["splits"] == {"train": 2, "valid": 1, "test": 0}
    found = {
        t.attributes["source"]: t.position
        for t in (read_trajectory(tmp_path / "set", "train", i) for i in range(2))
    }
    original = read_trajectory(source, "train", 0).position[2::2].double()
    expected = 0.01 * torch.stack([original[..., 0], original[..., 2], -original[..., 1]], dim=2)
    torch.testing.assert_close(found["train.h5[00000]"], expected.float(), rtol=1e-6, atol=0)


def test_inspect_reports_the_same_as_import(source, succeed, tmp_path):
    """The report of the foreign source, of the import and of the imported set."""
    imported, _ = succeed("import", source, "--format", "giorom", "--out", tmp_path / "set")
    foreign, _ = succeed(
        "inspect", source, "--format", "giorom", "--out", tmp_path / "a", "--no-pictures"
    )
    ours, _ = succeed("inspect", tmp_path / "set", "--out", tmp_path / "b", "--no-pictures")
    assert set(ours) >= KEYS
    same = KEYS - {"files", "notes", "statistics"} | {"extent", "spacing", "types", "gravity"}
    for key in same:
        assert ours[key] == foreign[key] == imported[key], key
    for key in ("vel_std", "acc_std"):
        np.testing.assert_allclose(ours["statistics"][key], foreign["statistics"][key], rtol=1e-9)


def test_inspect_draws_without_a_display(source, succeed, tmp_path, monkeypatch):
    """A contact sheet and histograms, not blank, beside the report; the data stay as they are."""
    import imageio.v3

    monkeypatch.delenv("DISPLAY", raising=False)
    folder = shutil.copytree(source, tmp_path / "data")
    result, _ = succeed("inspect", folder, "--format", "giorom", "--limit", 2)
    names = [path.rsplit("/", 2)[1:] for path in result["files"]]
    expected = ["report.json", "report.md", "motions.png", "histograms.png"]
    assert names == [["inspect", name] for name in expected]
    for path in result["files"][2:]:
        picture = imageio.v3.imread(path)[..., :3]
        assert min(picture.shape[:2]) > 400
        assert len(np.unique(picture @ np.array([65536, 256, 1]))) > 20
    again, _ = succeed("inspect", folder, "--format", "giorom", "--no-pictures")
    assert (result["trajectories"], again["trajectories"]) == (2, 6)


@pytest.fixture
def arrays(tmp_path):
    """Twelve motions of somebody's solver as NumPy files, in folders that say the split."""
    rng = np.random.default_rng(0)
    for number in range(12):
        folder = tmp_path / "arrays" / ("test" if number > 9 else "train")
        folder.mkdir(parents=True, exist_ok=True)
        time = 0.01 * np.arange(15)[:, None, None]
        start, velocity = rng.random((40, 2)), 0.2 * rng.standard_normal((40, 2))
        position = start + velocity * time + 0.5 * np.array([0.0, -9.81]) * time**2
        np.save(folder / f"run{number}_0.npy", position)
    return tmp_path / "arrays"


def test_a_foreign_source_needs_what_it_does_not_say(arrays, succeed, refuse, tmp_path):
    """Without --frame-dt one line that names it; with it a data set with all three parts."""
    assert "--frame-dt SECONDS" in refuse("import", arrays, "--out", tmp_path / "set")
    assert not (tmp_path / "set").exists()
    words = ("import", arrays, "--frame-dt", 0.01, "--out", tmp_path / "set")
    result, _ = succeed(*words)
    assert result["format"] == "npy"
    assert result["splits"] == {"train": 9, "valid": 1, "test": 2}
    np.testing.assert_allclose(result["gravity"], [0.0, -9.81], rtol=1e-3)
    position = read_trajectory(tmp_path / "set", "test", 0).position
    expected = np.load(arrays / "test" / "run10_0.npy").astype(np.float32)
    assert np.array_equal(position.numpy(), expected)


def test_inspecting_a_foreign_folder_does_not_change_what_it_is(arrays, succeed):
    """The results lie inside it, and the next look sees the same motions."""
    first, _ = succeed("inspect", arrays, "--limit", 3)
    assert "is not known" in first["suspicious"][0]
    again, _ = succeed("inspect", arrays, "--limit", 3, "--frame-dt", 0.01, "--no-pictures")
    assert (first["format"], first["extent"]) == (again["format"], again["extent"])
    assert (arrays / "inspect" / "motions.png").is_file()


def test_inspect_takes_a_single_file(source, succeed, data_folder, tmp_path):
    shutil.copy(data_folder / "test.h5", tmp_path / "one.h5")
    result, _ = succeed("inspect", tmp_path / "one.h5", "--no-pictures")
    assert result["trajectories"] == 1
    assert (tmp_path / "one-inspect" / "report.md").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{tmp}/nothing"], "does not exist"),
        (["{tmp}"], "no known format"),
        (["{own}", "--format", "giorum"], "Did you mean 'giorom'"),
        (["{own}", "--stride", "0"], "--stride must be >= 1"),
        (["{own}", "--limit", "0"], "--limit must be >= 1"),
        (["{own}", "--unit", "cm", "--scale", "2"], "not allowed with"),
        (["{own}", "--bounds", "0", "1"], "LOW HIGH for each of 2 or 3 axes"),
        (["{own}", "--bounds", "0", "1", "0", "1"], "3 axes, but bounds for 2"),
        (["{own}", "--axes", "x,y,w"], "--axes must name"),
        (["{own}", "--skip", "100"], "no frame to keep"),
        (["{own}", "--stride", "8"], "no acceleration can be measured"),
        (["{own}", "--splits", "0.5", "0.5"], "add to less than 1"),
        (["{own}", "--fromat", "x"], "Did you mean '--format'"),
    ],
)
def test_bad_input_of_import_is_one_line_and_leaves_nothing(
    words, message, data_folder, refuse, tmp_path
):
    names = {"tmp": tmp_path, "own": data_folder}
    line = refuse("import", *(w.format(**names) for w in words), "--out", tmp_path / "set")
    assert message in line
    assert not (tmp_path / "set").exists()


def test_an_existing_data_set_is_refused(data_folder, refuse):
    before = sorted(path.name for path in data_folder.iterdir())
    assert "already exists" in refuse("import", data_folder, "--out", data_folder)
    assert sorted(path.name for path in data_folder.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{tmp}/nothing"], "does not exist"),
        (["{own}", "--limit", "0"], "--limit must be >= 1"),
        (["{own}", "--out", "{own}/train.h5"], "is to be a folder"),
    ],
)
def test_bad_input_of_inspect_is_one_line(words, message, data_folder, refuse, tmp_path):
    names = {"tmp": tmp_path, "own": data_folder}
    assert message in refuse("inspect", *(word.format(**names) for word in words))


def test_a_truncated_data_set_is_refused(data_folder, refuse, tmp_path):
    folder = shutil.copytree(data_folder, tmp_path / "copy")
    path = folder / "train.h5"
    path.write_bytes(path.read_bytes()[:4000])
    assert "truncated" in refuse("inspect", folder, "--no-pictures")
    assert "truncated" in refuse("import", folder, "--out", tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.fixture
def heard_keyboard():
    """Ctrl-C is heard: a shell starts background jobs with it ignored, and Python keeps that."""
    keyboard = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, keyboard)


@pytest.mark.usefixtures("heard_keyboard")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_import_leaves_with_130_and_says_that_nothing_is_left(
    number, data_folder, tmp_path, capsys, monkeypatch
):
    """By the keyboard and by a batch system; afterwards the signal is handled as before."""
    from giorom.data import importing

    def interrupted(*_, **__):
        os.kill(os.getpid(), number)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(importing, "assemble_dataset", interrupted)
    words = ["import", str(data_folder), "--out", str(tmp_path / "set"), "--quiet"]
    assert main(words) == 130
    assert "nothing was left" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


# Training on imported data.


def test_imported_data_train_evaluate_and_roll_out(source, tiny_yaml, succeed, tmp_path):
    """Five steps through a preset of matching dimension and time; then score and simulate."""
    succeed("import", source, "--format", "giorom", "--out", tmp_path / "set")
    data = ("--data", tmp_path / "set")
    words = ("--config", tiny_yaml, *data, "--out", tmp_path / "run", "--max-steps", 5)
    result, _ = succeed("train", *words)
    assert result["steps"] == 5
    scores, _ = succeed("evaluate", tmp_path / "run", *data)
    assert scores["trajectories"] == 1
    out = ("--frames", 3, "--out", tmp_path / "motion.h5")
    rolled, _ = succeed("rollout", tmp_path / "run", *data, *out)
    assert rolled["frames"] == 3


def test_a_preset_of_another_time_or_dimension_names_the_remedy(
    source, tiny_yaml, succeed, refuse, tmp_path
):
    """The advised option makes the preset take the data."""
    words = ("--format", "giorom", "--frame-dt", "0.01", "--out", tmp_path / "set")
    succeed("import", source, *words)
    training = ("--config", tiny_yaml, "--data", tmp_path / "set", "--max-steps", 1)
    line = refuse("train", *training, "--out", tmp_path / "run")
    assert "--solver.frame_dt 0.01" in line
    changed = replace(load_experiment(str(tiny_yaml)).solver, frame_dt=0.01)
    experiment = replace(load_experiment(str(tiny_yaml)), solver=changed)
    assert len(load_training_data(experiment, tmp_path / "set").windows) > 0
    flat = ("--format", "giorom", "--axes", "x,y", "--out", tmp_path / "flat")
    succeed("import", source, *flat)
    training = ("--config", tiny_yaml, "--data", tmp_path / "flat", "--max-steps", 1)
    assert "one of 2 dimensions" in refuse("train", *training, "--out", tmp_path / "run")


def test_a_shaken_body_is_rolled_out_and_scored_with_its_base(
    data_folder, run_folder, succeed, refuse, tmp_path
):
    """Kinematic particles that move follow the data, and no further than the data go."""
    motion = read_trajectory(data_folder, "test", 0)
    shake = 0.01 * torch.sin(torch.arange(motion.frame_count))[:, None]
    position = motion.position.clone()
    position[:, motion.kinematic, 0] += shake
    shaken = replace(motion, position=position)
    open_work_folder(tmp_path / "set", identity={"system": "shaken"})
    for index in range(3):
        write_part(tmp_path / "set", index, shaken)
    splits = {"train": [0], "valid": [1], "test": [2]}
    assemble_dataset(tmp_path / "set", radius=0.1, splits=splits)
    words = ("rollout", run_folder, "--data", tmp_path / "set", "--out", tmp_path / "motion.h5")
    succeed(*words, "--frames", 6)
    with h5py.File(tmp_path / "motion.h5") as file:
        found = file["00000/position"][:]
    held = motion.particle_type.numpy() == KINEMATIC
    assert np.array_equal(found[:, held], position[:7].numpy()[:, held])
    assert "known for 15 frames, but 40" in refuse(*words, "--frames", 40)
    simulator = Simulator.from_pretrained(run_folder)
    report, _ = succeed("inspect", tmp_path / "set", "--no-pictures")
    assert report["moving_kinematic"] == 3 * int(held.sum())
    assert evaluate_trajectory(simulator, shaken)["diverged_at"] is None
