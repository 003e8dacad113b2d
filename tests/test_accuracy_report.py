"""The report of the models: judged from numbers, and nothing that fails can be left out."""

import copy
import itertools
import json
import math
import shutil

import pytest

from benchmarks.accuracy.__main__ import main as measure
from benchmarks.accuracy.report import page, write_report
from benchmarks.accuracy.requirements import Verdict, verdicts
from giorom.evaluation.catalogue import catalogue
from giorom.evaluation.paper import paper_values
from giorom.generate.held_out import HELD_OUT_SEED

CLAMPED = {"family": "clamped", "material": "stable_neo_hookean", "mixture": []}
THROWN = {"family": "thrown", "material": "weakly_compressible_fluid", "mixture": []}
MIXED = {"family": "thrown", "material": "stable_neo_hookean", "mixture": [{}]}


def scores(own, *, others=1.0):
    """Scores of a model whose errors are ``own`` where all that needs no model has ``others``."""
    frames = ("50", "100", "200")
    names = ("static", "constant_velocity", "free_fall", "ballistic_clamped", "frozen_shape")
    return {
        "one_step_mse": own,
        "rollout_mse": own,
        "rollout_mse_at": dict.fromkeys(frames, own),
        "swing_seen": 1.0,
        "swing_period": 40.0,
        **dict.fromkeys(("swing_period_ratio", "swing_amplitude_ratio"), 1.0),
        **dict.fromkeys(("swing_period_deviation", "swing_amplitude_deviation"), 0.05),
        **{f"{name}_mse": others for name in names},
        **{f"{name}_mse_at": dict.fromkeys(frames, others) for name in names},
    }


@pytest.fixture
def metrics():
    """A model that meets everything: 1e-5 where nothing else is below 1."""
    return {
        "system": "elastic3d",
        "trajectories": 10,
        "frames": 200,
        "points": 100,
        "sparse_points": 20,
        "diverged": 0,
        "sparse": scores(1e-5),
        "full": scores(1e-5),
        "paper": paper_values("elastic3d"),
        "training": {"seconds": 100.0, "steps": 10},
        "stability": {
            "scenes": 50,
            "horizons": 5.0,
            "frames": 500,
            "lost": 0,
            "not_finite": 0,
            "beyond_walls": 0,
            "first_loss": None,
            "largest_excursion": 0.0,
            "tolerance": 0.02,
        },
        "discretisation": {"rows": [row("1 x", 1.0, 1.0), row("4 x", 4.0, 1.2)]},
        "paper_preset": {
            "trajectories": 10,
            "diverged": 0,
            "sparse": {"rollout_mse": 3e-5},
            "full": {"rollout_mse": 2e-5},
            "training_seconds": 105.0,
            "training_steps": 7,
        },
        "bytes": 1000,
    }


def row(setting, factor, ratio):
    """A row of other discretisations."""
    names = ("full_one_step_mse", "sparse_rollout_mse", "full_rollout_mse")
    return {
        "setting": setting,
        "factor": factor,
        "ratio": ratio,
        "trajectories": 10,
        "diverged": 0,
        "points": 100,
        "sparse_points": 20,
        "full_static_mse": 1.0,
        **dict.fromkeys(names, 1e-5),
        **{f"{name}_std": 1e-6 for name in names},
    }


def judge(metrics, scene=None, *, size=1000):
    """Verdicts by requirement."""
    found = verdicts(metrics, scene=CLAMPED if scene is None else scene, size=size)
    return {verdict.requirement: verdict for verdict in found}


def unmet(metrics, scene=None, **options):
    """Requirements that are not met."""
    return [name for name, v in judge(metrics, scene, **options).items() if not v.met]


def test_a_model_far_below_everything_meets_everything(metrics):
    """1e-5 against 1, five per cent of deviation, nothing lost."""
    assert unmet(metrics) == []
    assert len(judge(metrics)) == 11
    assert len(judge(metrics, THROWN)) == 9


def test_each_failing_number_fails_its_own_requirement(metrics):
    """One number changed at a time; the bound itself still counts as met."""
    changes = [
        (("sparse", "rollout_mse"), 4.1e-4, "Table 3"),
        (("full", "rollout_mse"), 2.1e-4, "Table 1"),
        (("full", "constant_velocity_mse"), 9e-5, "constant velocity"),
        (("sparse", "static_mse_at", "100"), 9e-5, "holding still, 100"),
        (("full", "swing_period_deviation"), 0.11, "period"),
        (("full", "swing_amplitude_deviation"), 0.11, "amplitude"),
        (("trajectories",), 9, "held-out trajectories"),
        (("stability", "lost"), 1, "rollouts lost"),
        (("stability", "scenes"), 49, "rollouts lost"),
        (("stability", "horizons"), 4.9, "rollouts lost"),
        (("discretisation", "rows", 1, "ratio"), 1.6, "4 times the samples"),
        (("discretisation", "rows", 1, "trajectories"), 9, "4 times the samples"),
        (("paper_preset", "full", "rollout_mse"), 9e-6, "paper-faithful"),
        (("paper_preset", "training_seconds"), 50.0, "paper-faithful"),
    ]
    for path, value, said in changes:
        changed = copy.deepcopy(metrics)
        place = changed
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        failing = unmet(changed)
        assert any(said in name for name in failing), path
    assert unmet(metrics, size=5_000_001) == ["bytes of the weights"]


def test_a_peer_may_train_longer_but_not_shorter(metrics):
    """Twice the time is to the peer's favour; 89 of 100 seconds are not equal."""
    metrics["paper_preset"]["training_seconds"] = 200.0
    assert unmet(metrics) == []
    metrics["paper_preset"]["training_seconds"] = 89.0
    assert any("paper-faithful" in name for name in unmet(metrics))


def test_what_flows_is_compared_at_200_frames_with_the_oracle_too(metrics):
    """Three times below the better of two; mixtures of solids flow as well."""
    for scene in (THROWN, MIXED):
        names = list(judge(metrics, scene))
        assert "holding still, 200 frames, at least 10 times below" in names
        assert not any("100 frames" in name or "swing" in name for name in names)
        for key in ("ballistic_clamped", "frozen_shape"):
            changed = copy.deepcopy(metrics)
            changed["full"][f"{key}_mse_at"]["200"] = 2.9e-5
            assert unmet(changed, scene) == [
                "the better of free fall and frozen shape, 200 frames, at least 3 times below"
            ]


def test_diverged_rollouts_meet_nothing_that_is_a_mean(metrics):
    """One of ten left out of the means: every requirement on a mean fails, with the reason."""
    metrics["diverged"] = 1
    failing = [verdict for verdict in judge(metrics).values() if not verdict.met]
    assert len(failing) == 6
    assert all(verdict.unsound == "1 of 10 rollouts diverged" for verdict in failing)
    metrics |= {"diverged": 10, "sparse": None, "full": None}
    assert {v.word for v in judge(metrics).values() if not v.met} == {"not met", "not measured"}


def test_what_is_not_measured_is_not_met(metrics):
    """Neither by absence nor by NaN."""
    for key in ("stability", "discretisation", "paper_preset"):
        del metrics[key]
    found = [verdict for verdict in judge(metrics).values() if not verdict.met]
    assert [verdict.word for verdict in found] == ["not measured"] * 3
    assert not Verdict(requirement="x", value=math.nan, bound=1.0).met
    metrics["full"]["rollout_mse_at"] = {}
    assert judge(metrics)["holding still, 100 frames, at least 10 times below"].value is None


def test_what_else_would_beat_the_paper_is_said(metrics):
    """A bound that holding still meets too says little."""
    metrics["full"]["static_mse"] = 1e-4
    remarks = [v.remark for v in judge(metrics).values() if "Table" in v.requirement]
    assert ["holding still would do" in remark for remark in remarks] == [False, True]
    assert all("paper's: 120, 2600 of 78000" in remark for remark in remarks)


def test_the_page_shows_every_verdict_and_every_shortfall(metrics):
    """All combinations of three failures: as many bold outcomes and as many items."""
    for broken in itertools.product((False, True), repeat=3):
        changed = copy.deepcopy(metrics)
        changed["stability"]["lost"] = 7 if broken[0] else 0
        changed["full"]["rollout_mse"] = 1.0 if broken[1] else 1e-5
        if broken[2]:
            del changed["discretisation"]
        found = verdicts(changed, scene=CLAMPED, size=1000)
        failing = [verdict for verdict in found if not verdict.met]
        text = page({"m": changed}, {"m": found}, {}, notes={"m": {"unrelated": "all is well"}})
        assert f"{len(found) + 1 - len(failing)} of {len(found) + 1} are met" in text
        for verdict in found:
            assert f"| m | {verdict.requirement} |" in text
        for verdict in failing:
            assert f"* **m**, {verdict.requirement}: {verdict.word}" in text
        assert text.count("No reason written down yet") == len(failing)
        assert "all is well" not in text


def test_the_page_of_a_model_whose_rollouts_all_diverged_is_written(metrics):
    """No mean at all; dashes and bold outcomes instead."""
    metrics |= {"diverged": 10, "sparse": None, "full": None}
    found = verdicts(metrics, scene=CLAMPED, size=1000)
    text = page({"m": metrics}, {"m": found}, {}, notes={})
    assert "10 of 10" in text
    assert "**not met** (10 of 10 rollouts diverged" in text


def test_the_report_reads_the_files_of_all_models(metrics, tmp_path):
    """One folder each; what is not met is returned, a line each."""
    for name, lost in (("a", 0), ("b", 3)):
        folder = tmp_path / "models" / name
        folder.mkdir(parents=True)
        metrics["stability"]["lost"] = lost
        (folder / "metrics.json").write_text(json.dumps(metrics))
        (folder / "config.json").write_text(json.dumps({"scene": CLAMPED}))
        (folder / "model.safetensors").write_bytes(b"0" * 1000)
    missed = write_report(tmp_path / "models", tmp_path / "accuracy.md", {})
    assert missed == ["b: rollouts lost of 50 over 5 training horizons: not met"]
    assert "23 of 24 are met" not in (tmp_path / "accuracy.md").read_text()
    assert "22 of 23 are met" in (tmp_path / "accuracy.md").read_text()


def test_the_command_measures_keeps_and_reports(run_folder, tmp_path, capsys):
    """Scores and long rollouts of a model in a folder of its own; new scores keep the rest."""
    models, out = tmp_path / "models", tmp_path / "results"
    directory = shutil.copytree(run_folder / "simulator", models / "tiny")
    words = ["--pretrained", models, "--out", out, "--model", "tiny", "--trajectories", 1]
    parts = ["--part", "scores", "--part", "stability", "--scenes", 2]
    assert measure([str(word) for word in [*words, *parts]]) == 1
    said = capsys.readouterr().out
    metrics = json.loads((directory / "metrics.json").read_text())
    assert metrics["held_out"]["seed"] == HELD_OUT_SEED
    assert metrics["stability"]["scenes"] == 2
    assert len(metrics["per_trajectory"]) == 1
    assert [entry["name"] for entry in catalogue(models)] == ["tiny"]
    text = (out / "accuracy.md").read_text()
    assert "only 2 scenes over 5 horizons" in text
    assert "tiny: held-out trajectories: not met" in said

    paper = shutil.copytree(directory, tmp_path / "paper" / "run")
    (paper / "train.json").write_text(json.dumps({"seconds": 12.0}))
    again = [*words, "--part", "scores", "--paper-run", "tiny", paper, paper / "train.json"]
    assert measure([str(word) for word in again]) == 1
    kept = json.loads((directory / "metrics.json").read_text())
    assert kept["sparse"] == metrics["sparse"]
    assert kept["stability"] == metrics["stability"]
    assert kept["paper_preset"]["full"]["rollout_mse"] == metrics["full"]["rollout_mse"]
    assert kept["paper_preset"]["training_seconds"] == 12.0
