"""Means, paired differences and files of a reproduction, against values known by hand."""

import csv
import json
import math
from pathlib import Path

import pytest

from giorom.reproduce import SCALES, Result, Study
from giorom.reproduce.compare import bootstrap_interval, over_seeds, paired, score_columns
from giorom.reproduce.report import cell, write_result


def scores(*errors, diverged=()):
    """What ``Study.scores`` gives, as far as comparisons read it."""
    entries = [
        {"diverged_at": 3 if number in diverged else None, "sparse_rollout_mse": error}
        for number, error in enumerate(errors)
    ]
    return {"per_trajectory": entries}


@pytest.fixture
def study(tmp_path):
    """A study that trains nothing."""
    return Study(scale=SCALES["tiny"], out=tmp_path / "out")


def test_a_mean_over_seeds_keeps_its_range_and_leaves_out_what_is_unknown():
    """(1 + 3) / 2; none counts as no number, and no number at all stays none."""
    assert over_seeds("mse", [1.0, None, 3.0]) == {"mse": 2.0, "mse_min": 1.0, "mse_max": 3.0}
    assert over_seeds("mse", [None]) == {"mse": None, "mse_min": None, "mse_max": None}


def test_an_error_twice_as_large_everywhere_is_two_times_with_no_doubt():
    """The ratio is the same on every trajectory, so that its interval has no width."""
    found = paired([scores(2.0, 4.0, 8.0)], [scores(1.0, 2.0, 4.0)])
    assert found["pairs"] == 3
    assert found["times"] == pytest.approx(2.0)
    assert found["times_low"] == pytest.approx(2.0)
    assert found["times_high"] == pytest.approx(2.0)
    assert found["difference"] == pytest.approx(7.0 / 3.0)
    assert found["difference_low"] < found["difference"] < found["difference_high"]


def test_a_diverged_rollout_is_in_no_paired_difference():
    """A seed that diverged leaves the other one; where all diverged there is no pair."""
    those = [scores(1.0, 1.0)]
    one = paired([scores(2.0, 99.0, diverged=[1]), scores(4.0, 3.0)], those)
    assert (one["pairs"], one["difference"]) == (2, pytest.approx(2.0))
    other = paired([scores(2.0, 99.0, diverged=[1])], those)
    assert (other["pairs"], other["difference"]) == (1, pytest.approx(1.0))
    assert paired([scores(1.0, diverged=[0])], those)["times"] is None


def test_how_long_rollouts_lasted_counts_those_that_diverged_and_those_that_did_not():
    """Diverged at frame 3: two frames were good; sound: all ten; (2 + 10) / 2."""
    entries = [{"diverged_at": 3, "frames": 10}, {"diverged_at": None, "frames": 10}]
    score = dict.fromkeys(("steps", "parameters", "edges", "seconds", "sparse"))
    score |= {"diverged": 1, "trajectories": 2, "per_trajectory": entries, "trial": "a"}
    row = score_columns([score], {"rollout_mse": ("sparse", "rollout_mse")})
    assert (row["lasted"], row["diverged"], row["rollout_mse"]) == (6.0, "1/2", None)
    assert score_columns([score | {"per_trajectory": []}], {})["lasted"] is None


def test_the_bootstrap_interval_of_a_mean_is_that_of_the_normal_law():
    """For many values the mean is normal: 1.96 standard errors on either side.

    2000 samples leave 0.06 standard errors open, of which three times as much is allowed.
    """
    values = [math.sin(1000.0 * number) for number in range(1, 2001)]
    mean = sum(values) / len(values)
    error = math.sqrt(sum((v - mean) ** 2 for v in values) / len(values) / len(values))
    low, high = bootstrap_interval(values)
    assert low == pytest.approx(mean - 1.96 * error, abs=0.2 * error)
    assert high == pytest.approx(mean + 1.96 * error, abs=0.2 * error)


def test_a_cell_has_three_digits_and_the_range_where_there_is_one():
    """A whole number stays whole, none is a dash, a bar would break the table."""
    row = {"a": 0.012345, "a_min": 0.01, "a_max": 0.02, "b": 3, "c": None, "d": 1600000.0}
    assert cell(row, "a") == "0.0123 (0.01 to 0.02)"
    assert [cell(row, name) for name in "bcd"] == ["3", "-", "1600000"]
    assert cell({"e": "a|b", "f": True}, "e") == "a/b"
    assert cell({"e": "a|b", "f": True}, "f") == "yes"


def test_a_result_leaves_a_table_in_three_formats_and_a_picture(study):
    """All keys reach CSV and JSON, the columns the Markdown; no number is lost on the way."""

    def draw(figure):
        figure.subplots().plot([1.0, 2.0])

    rows = [{"system": "water", "mse": 1 / 3, "paper": None, "ratio": math.inf, "extra": [1, 2]}]
    result = Result(
        id="table0", title="Nothing", columns=["system", "mse", "paper"], rows=rows, draw=draw
    )
    study.used["key"] = {"seconds": 2.5, "problem": None}
    files = write_result(result, study)
    assert [path.suffix for path in files] == [".csv", ".md", ".png", ".json"]
    assert sorted(path.name for path in study.out.iterdir()) == sorted(p.name for p in files)
    with files[0].open() as file:
        (line,) = list(csv.DictReader(file))
    assert float(line["mse"]) == 1 / 3
    assert (line["paper"], line["extra"], line["scale"], line["seeds"]) == ("", "1 2", "tiny", "0")
    text = files[1].read_text()
    assert "| water | 0.333 | - |" in text
    assert "docs/protocol.md" in text
    assert "torch" in text
    assert "1 trainings, 2 s together" in text
    assert files[2].read_bytes().startswith(b"\x89PNG")
    record = json.loads(files[3].read_text())
    assert (record["rows"][0]["ratio"], record["seeds"], record["scale"]) == (None, [0], "tiny")


def test_a_result_that_cannot_be_drawn_leaves_the_earlier_one(study):
    """Every file is replaced whole; the JSON, which says that all is there, comes last."""

    def fail(figure):
        raise RuntimeError("no ink")

    result = Result(id="table0", title="Nothing", columns=["a"], rows=[{"a": 1}])
    write_result(result, study)
    before = (study.out / "table0.json").read_bytes()
    broken = Result(id="table0", title="Other", columns=["a"], rows=[{"a": 2}], draw=fail)
    with pytest.raises(RuntimeError, match="no ink"):
        write_result(broken, study)
    assert (study.out / "table0.json").read_bytes() == before
    assert not [path for path in Path(study.out).iterdir() if path.name.startswith(".")]
