"""``giorom benchmark pareto``: runs against oracles, verdicts from made-up rows, the command."""

import csv
import math

import pytest
import torch

from giorom.data.trajectory_file import read_trajectory
from giorom.evaluation.comparison import trivial_predictions
from giorom.pipeline import integrated, start_from_trajectory
from giorom.reproduce import SCALES, Study, pareto
from giorom.reproduce.pareto import _against, _mark_front, _without_copies, point_shares
from giorom.reproduce.pareto_runs import (
    full_order_seconds,
    noise_floor,
    run_model,
    truths,
    without_model,
)
from giorom.reproduce.pareto_words import notes_of

pytest.importorskip("warp")
pytest.importorskip("matplotlib")

METHODS = ("linear",)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder and JSON of the command at the smallest scale, with fewer runs."""
    import json

    from giorom.cli import main

    folder = tmp_path_factory.mktemp("pareto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pareto, "SHARES", (0.5, 1.0))
        patch.setattr(pareto, "COARSENINGS", (1.0, 2.0))
        words = f"benchmark pareto --system elastic3d --scale tiny --out {folder / 'out'}"
        words += f" --methods {','.join(METHODS)} --json {folder / 'result.json'} --quiet"
        assert main(words.split()) == 0
    return folder / "out", json.loads((folder / "result.json").read_text())


def test_the_command_writes_a_table_a_page_and_a_picture(made):
    """Ours at every number of samples, every method, the solver on every grid, what needs none."""
    out, result = made
    names = [f"pareto-elastic3d.{ending}" for ending in ("csv", "md", "png", "json")]
    assert sorted(result["files"]) == sorted(str(out / name) for name in names)
    assert all((out / name).stat().st_size > 500 for name in names)
    rows = result["rows"]
    kinds = [row["kind"] for row in rows]
    assert kinds.count("model") == 3
    assert kinds.count("truth") == 1
    assert kinds.count("trivial") == 3
    assert {row["coarsening"] for row in rows if row["kind"] == "solver"} == {1.0, 2.0}
    with (out / "pareto-elastic3d.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    page = (out / "pareto-elastic3d.md").read_text()
    assert "Noise floor: " in page
    assert "On the front" in page


def test_every_number_of_the_command_follows_from_the_others(made):
    """N* by its definition, totals by addition, the front by comparing all pairs."""
    rows = made[1]["rows"]
    models = [row for row in rows if row["kind"] == "model"]
    timed = [row for row in rows if row.get("seconds_per_frame") is not None]
    for row in models:
        spent = row["data_seconds"] + row["training_seconds"] + row["tuning_seconds"]
        assert row["upfront_seconds"] == pytest.approx(spent)
        own = row["seconds_per_frame"] * row["rollout_frames"]
        assert row["seconds_of_100_rollouts"] == pytest.approx(spent + 100 * own)
        saved = row["solver_seconds_per_frame"] * row["rollout_frames"] - own
        if saved > 0.0:
            assert row["pays_back_after"] == pytest.approx(spent / saved)
        else:
            assert row["pays_back_after"] == "never"
    for row in timed:
        better = [
            other
            for other in timed
            if other["full_rollout_mse"] <= row["full_rollout_mse"]
            and other["seconds_per_frame"] <= row["seconds_per_frame"]
            and other is not row
        ]
        assert row["on_front"] is (not better)


def test_scenes_of_a_data_set_are_drawn_again_and_its_solver_repeats_it(made):
    """The scene of a trajectory begins as it does; the floor is small, and no time is zero."""
    study = Study(scale=SCALES["tiny"], out=made[0])
    tests = truths(study, "elastic3d", "test")
    assert tests[0].solver.substeps == tests[0].trajectory.attributes["substeps"]
    floor = noise_floor(tests, device="cpu")
    found = without_model(tests, history=2)
    assert 0.0 < floor < 0.1 * found["static"]
    assert full_order_seconds(tests, device="cpu") > 0.0
    truth = tests[0].trajectory
    state = start_from_trajectory(truth, torch.arange(truth.position.shape[1]), history=2)
    gravity = torch.tensor([0.0, -float(truth.attributes["gravity"]), 0.0])
    own = trivial_predictions(state, truth.position[2:], gravity=gravity)["static"]
    error = (own - truth.position[2:]).square().sum(dim=2).mean(dim=1).sum() / truth.frame_count
    assert found["static"] == pytest.approx(float(error), rel=1e-5)


def test_a_model_that_holds_still_has_the_error_of_holding_still(simulator, data_folder):
    """Samples that stop carry the particles nowhere; one that flies off counts as diverged."""
    trajectory = read_trajectory(data_folder, "test", 0)
    simulator.dynamics.step = integrated(lambda state, _: -state.velocity / state.frame_dt)
    found = run_model(simulator, simulator, [trajectory], share=0.5)
    assert (found["points"], found["diverged"], found["trajectories"]) == (20, 0, 1)
    samples = simulator.sample(trajectory.position[0], count=20)
    moved = trajectory.position[2:, samples] - trajectory.position[1, samples]
    free = ~trajectory.kinematic[samples]
    expected = float((moved * free[:, None]).square().sum(dim=2).mean(dim=1).sum())
    assert found["sparse_rollout_mse"] == pytest.approx(expected / trajectory.frame_count, rel=1e-4)
    simulator.dynamics.step = integrated(lambda state, _: torch.full_like(state.position, 1e6))
    lost = run_model(simulator, simulator, [trajectory], share=1.0)
    assert (lost["diverged"], lost["full_rollout_mse"]) == (1, None)


def test_coarse_runs_have_as_many_points_to_a_cell_or_as_many_as_ours():
    """Two counts that hardly differ are one."""
    assert point_shares(1.0, dimension=3, ours=0.1) == [1.0]
    assert point_shares(2.0, dimension=3, ours=0.05) == [0.125, 0.05]
    assert point_shares(2.0, dimension=3, ours=0.12) == [0.125]
    assert point_shares(2.0, dimension=2, ours=0.3) == [0.25]


def model(name: str, error: float | None, seconds: float | None, **more) -> dict:
    """A row of a model that cost a thousand seconds, rollouts of a hundred frames."""
    cost = {"upfront_seconds": 1000.0, "rollout_frames": 100}
    row = {"kind": "model", "name": name, "method": name, "points": 10, "diverged": 0}
    row |= {"full_rollout_mse": error, "seconds_per_frame": seconds, **more}
    return row | cost | _against(row, [(1e-6, 1.0), (1e-4, 0.1)], cost)


def test_a_model_is_compared_with_the_solver_at_its_own_error():
    """Halfway between 1 s and 0.1 s on logarithms: 0.316 s; 1000 s are saved in N (21.6 s)."""
    row = model("default", 1e-5, 0.1)
    assert row["solver_seconds_per_frame"] == pytest.approx(math.sqrt(0.1))
    assert row["pays_back_after"] == pytest.approx(1000.0 / (100 * (math.sqrt(0.1) - 0.1)))
    assert model("gns", 1e-3, 0.2)["pays_back_after"] == "never"
    assert model("gat", None, None)["pays_back_after"] is None


def test_the_page_says_who_wins():
    """Nobody pays; one pays; all diverged."""
    slow, fast = model("gns", 1e-5, 2.0), model("default", 1e-5, 0.1)
    lost = model("gat", None, None) | {"diverged": 2, "trajectories": 3}

    def told(*rows):
        _mark_front(list(rows))
        return " ".join(notes_of(list(rows), floor=2e-5, rollout_frames=100))

    assert "The solver wins: coarser runs" in told(slow)
    text = told(slow, fast, lost)
    assert "Cheaper than the solver at equal error: default after 46.2 rollouts." in text
    assert "the others (1) the solver is at least as fast" in text
    assert "gat (2 of 3)" in text
    assert "Below it: gns; default." in text
    assert "Every rollout of every model diverged: the solver wins." in told(lost)
    assert "could not be measured" in " ".join(notes_of([fast], floor=None, rollout_frames=1))


def test_a_largest_step_that_is_that_of_the_rules_is_one_row():
    rows = [
        {"coarsening": 2.0, "points": 9, "substeps": count, "method": f"n/2 {name}"}
        for name, count in (("rules", 4), ("largest", 4), ("other", 3))
    ]
    assert [row["method"] for row in _without_copies(rows)] == [
        "n/2 rules, the largest stable",
        "n/2 other",
    ]


def test_what_cannot_be_compared_is_refused(refuse, tmp_path):
    """Unknown systems, methods and scales, before anything is written."""
    out = tmp_path / "out"
    words = ("benchmark", "pareto", "--out", out, "--scale", "tiny")
    assert "'elastic3d'" in refuse(*words, "--system", "elastic")
    assert "'gns'" in refuse(*words, "--system", "elastic3d", "--methods", "gnss")
    assert "no scale 'big'" in refuse(*words, "--system", "elastic3d", "--scale", "big")
    assert not out.exists()
