"""``giorom reproduce``: what it writes, what it refuses, how it ends when it is stopped."""

import csv
import importlib
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from giorom.reproduce import IDS, SCALES, Result, Study, Trial, table1, table3

pytest.importorskip("h5py")
pytest.importorskip("warp")
pytest.importorskip("matplotlib")


def fake(rows=1):
    """A result that trains nothing."""

    def run(study):
        content = [
            {"system": f"s{number}", "mse": 0.5, "device": study.device} for number in range(rows)
        ]
        return Result(id="table1", title="Nothing", columns=["system", "mse"], rows=content)

    return run


@pytest.fixture
def out(tmp_path):
    """A folder that must not appear when the input is refused."""
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("tabel3",), "Did you mean 'table3'"),
        (("table3", "--scale", "huge"), "there is no scale 'huge'"),
        (("table3", "--scale", "tiny", "--jobs", 0), "--jobs must be >= 1"),
        ((), "required: id"),
    ],
)
def test_a_request_that_cannot_be_met_is_one_line(refuse, out, words, text):
    """Exit code 2, what is there instead, nothing written."""
    assert text in refuse("reproduce", *words, "--out", out)
    assert not out.exists()


def test_a_folder_of_other_things_is_left_alone(refuse, tmp_path):
    """A file, a folder with strangers' files, a folder that cannot be made: all stay."""
    file = tmp_path / "file"
    file.write_text("mine")
    words = ("reproduce", "table1", "--scale", "tiny", "--out")
    assert "is to be a folder" in refuse(*words, file)
    assert "holds files that are no results" in refuse(*words, tmp_path)
    assert "is a file, not a folder" in refuse(*words, file / "below")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert file.read_text() == "mine"


def test_results_of_two_sizes_do_not_share_a_folder(succeed, refuse, monkeypatch, out):
    """The same settings go on; another scale or seed, or a damaged mark, is refused."""
    monkeypatch.setattr(table1, "run", fake())
    words = ("reproduce", "table1", "--out", out)
    succeed(*words, "--scale", "tiny")
    succeed(*words, "--scale", "tiny")
    assert "holds results of" in refuse(*words, "--scale", "cpu")
    assert "holds results of" in refuse(*words, "--scale", "tiny", "--seed", 1)
    (out / "reproduce.json").write_text("{")
    assert "is not readable" in refuse(*words, "--scale", "tiny")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_the_scale_of_the_paper_asks_for_a_gpu_unless_told_otherwise(
    succeed, refuse, monkeypatch, out
):
    """One line without a CUDA device; --device cpu is taken at its word."""
    monkeypatch.setattr(table1, "run", fake())
    words = ("reproduce", "table1", "--scale", "paper", "--out", out)
    assert "needs a CUDA device" in refuse(*words)
    assert not out.exists()
    result = succeed(*words, "--device", "cpu")
    assert result["rows"][0]["device"] == "cpu"


def test_a_result_is_written_in_four_formats_and_told_as_json(succeed, monkeypatch, out):
    """Keys of cli.md: id, scale, rows, files; every file it names exists."""
    monkeypatch.setattr(table1, "run", fake(rows=2))
    result = succeed("reproduce", "table1", "--scale", "tiny", "--out", out)
    assert {"id", "scale", "rows", "files"} <= set(result)
    assert (result["id"], result["scale"], len(result["rows"])) == ("table1", "tiny", 2)
    assert [path.rsplit(".", 1)[1] for path in result["files"]] == ["csv", "md", "json"]
    assert all(os.path.isfile(path) for path in result["files"])


def test_one_that_fails_does_not_stop_the_others(refuse, monkeypatch, out):
    """All others are written; the failure is named and the exit code is 3."""

    def fail(study):
        raise RuntimeError("no such luck")

    monkeypatch.setattr("giorom.commands.reproduce.IDS", ("table3", "table1"))
    monkeypatch.setattr(table1, "run", fake())
    monkeypatch.setattr(table3, "run", fail)
    line = refuse("reproduce", "all", "--scale", "tiny", "--out", out, code=3)
    assert "1 of 2 failed" in line
    assert "table3: no such luck" in line
    assert (out / "table1.json").is_file()


def test_when_it_is_interrupted_it_says_how_to_go_on(refuse, monkeypatch, out):
    """Exit code 130, what is kept and where."""

    def stop(study):
        raise KeyboardInterrupt

    monkeypatch.setattr(table1, "run", stop)
    line = refuse("reproduce", "table1", "--scale", "tiny", "--out", out, code=130)
    assert f"what is finished is kept in {out}. Run the same command again" in line


@pytest.mark.slow
def test_interrupted_between_two_trainings_it_ends_at_once_and_keeps_them(monkeypatch, out):
    """Ctrl-C reaches all processes of the terminal; two of them are training."""
    words = ["reproduce", "table1", "--scale", "tiny", "--out", str(out), "--jobs", "2", "--quiet"]
    keyboard = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
    process = subprocess.Popen(  # noqa: S603
        [sys.executable, "-m", "giorom.cli", *words],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
    )
    signal.signal(signal.SIGINT, keyboard)
    deadline = time.monotonic() + 200.0
    models = out / "shared" / "models"
    while not list(models.glob("*/trained.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, line = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert "Run the same command again" in line.splitlines()[-1]
    study = Study(scale=SCALES["tiny"], out=out)
    kept = {name: study.shared / "models" / name for name in os.listdir(models)}
    finished = [name for name, folder in kept.items() if (folder / "trained.json").is_file()]
    trials = [Trial(system=system, method="default") for system in study.scale.systems]
    names = {study.folder(trial).name: trial for trial in trials}
    monkeypatch.setattr("giorom.reproduce.study.train_trial", None)
    assert all(study.run_of(names[name]) is not None for name in finished)


@pytest.mark.slow
def test_every_table_and_figure_is_made_at_the_tiny_scale(succeed, monkeypatch, tmp_path):
    """Each writes table and picture, with protocol and numbers; a second call trains nothing."""
    words = ("reproduce", "all", "--scale", "tiny", "--out", tmp_path / "out", "--jobs", 2)
    result = succeed(*words)
    assert [entry["id"] for entry in result["rows"]] == list(IDS)
    for name in IDS:
        record = json.loads((tmp_path / "out" / f"{name}.json").read_text())
        assert record["rows"], name
        assert record["title"] == importlib.import_module(f"giorom.reproduce.{name}").TITLE
        assert any(isinstance(value, float) for row in record["rows"] for value in row.values())
        text = (tmp_path / "out" / f"{name}.md").read_text()
        assert "Scale tiny" in text
        assert record["machine"]["processor"] in text
        with (tmp_path / "out" / f"{name}.csv").open() as file:
            assert len(list(csv.DictReader(file))) == len(record["rows"])
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr("giorom.reproduce.study.train_trial", None)
    again = succeed("reproduce", "table3", *words[2:-2])
    assert again["rows"] == json.loads((tmp_path / "out" / "table3.json").read_text())["rows"]


def test_a_trial_of_the_paper_s_size_can_be_named_without_being_made(out):
    """Experiment, folder and budget of every row of Table 3 follow from the records alone."""
    study = Study(scale=SCALES["paper"], out=out, device="cuda")
    trials = [Trial(system="water3d", method=method) for method in ("default", "gns", "gat")]
    assert len({study.folder(trial) for trial in trials}) == len(trials)
    assert study.experiment("water3d").scene.points == 55_000
    assert not out.exists()
