"""What a study keeps: made once under a name of all it depends on; killed, it goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from giorom.reproduce import SCALES, Study, Trial, trial, tuned
from giorom.reproduce.methods import METHODS
from giorom.reproduce.workers import run_tasks
from giorom.simulator import Simulator
from giorom.training.training_config import Budget

pytest.importorskip("h5py")
pytest.importorskip("warp")

LINEAR = Trial(system="elastic3d", method="linear")


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A study whose data set is made; tests add to it."""
    study = Study(scale=SCALES["tiny"], out=tmp_path_factory.mktemp("study"))
    study.dataset("elastic3d")
    return study


@pytest.fixture
def study(shared):
    """The same, with nothing trained."""
    import shutil

    for name in ("models", "kept"):
        shutil.rmtree(shared.shared / name, ignore_errors=True)
    return replace(shared, used={})


def forbid(*arguments, **options):
    """What must not be called."""
    raise AssertionError("made again")


def test_a_result_knows_what_its_trainings_cost_where_others_made_them(study):
    """A task of another process, or of this one in its stead, has a study of its own."""
    study.train_all([LINEAR], score=False)
    (record,) = study.used.values()
    assert record["method"] == "linear"
    assert record["seconds"] > 0.0


def test_what_is_finished_is_never_made_again(study, monkeypatch):
    """A second study in the same folder reads data set, model and score."""
    first = study.scores(LINEAR)
    again = Study(scale=study.scale, out=study.out)
    monkeypatch.setattr("giorom.reproduce.study.train_trial", forbid)
    monkeypatch.setattr("giorom.reproduce.study.score_run", forbid)
    monkeypatch.setattr("giorom.reproduce.study.generate", forbid)
    assert again.scores(LINEAR) == first
    again.train_all([LINEAR, LINEAR])
    run = again.trained("elastic3d", "linear")
    assert (
        sum(p.numel() for p in Simulator.from_pretrained(run).dynamics.parameters())
        == (first["parameters"])
    )
    (record,) = again.used.values()
    assert (record["method"], record["steps"]) == ("linear", study.scale.budget.steps)


def test_a_training_is_kept_under_a_name_of_all_it_depends_on(study):
    """Whatever differs leads to another folder, the same to the same."""
    changes = (
        {},
        {"seed": 1},
        {"changes": {"training": {"learning_rate": 0.5}}},
        {"budget": Budget(steps=7)},
        {"method": "default"},
        {"system": "sand2d"},
    )
    folders = [study.folder(replace(LINEAR, **change)) for change in changes]
    assert len(set(folders)) == len(changes)
    assert study.folder(Trial(system="elastic3d", method="linear")) == folders[0]


def test_a_data_set_of_other_scenes_is_another_one(study):
    """The number of samples does not touch the data; the number of trajectories does."""
    small = study.scale.systems["elastic3d"]
    fewer = replace(study.scale, systems={"elastic3d": replace(small, trajectories=2)})
    sparser = replace(small, changes=small.changes | {"sampling": {"count": 10, "reduction": None}})
    other = replace(study.scale, systems={"elastic3d": sparser})
    experiment = study.experiment("elastic3d")
    asked = ((study.scale, 3), (fewer, 2), (other, 3))
    names = [
        replace(study, scale=scale)._data_key(experiment, trajectories=count)
        for scale, count in asked
    ]
    assert names[0] == names[2] != names[1]


def test_a_training_stopped_before_its_first_checkpoint_begins_again(study, monkeypatch):
    """The folder of a run without a checkpoint is taken over; the result is that of one go."""
    whole = study.training(replace(LINEAR, seed=5))
    original = trial.train

    def stopped(*arguments, **options):
        def report(stage, numbers):
            if stage == "time_stepper":
                raise KeyboardInterrupt

        return original(*arguments, **(options | {"report": report}))

    monkeypatch.setattr(trial, "train", stopped)
    with pytest.raises(KeyboardInterrupt):
        study.training(LINEAR)
    assert (study.folder(LINEAR) / "run" / "run.json").is_file()
    assert not (study.folder(LINEAR) / "trained.json").exists()
    monkeypatch.setattr(trial, "train", original)
    assert study.training(LINEAR)["steps"] == whole["steps"]
    assert study.scores(LINEAR)["diverged"] == 0


def test_a_training_stopped_at_its_end_is_not_repeated(study, monkeypatch):
    """Killed between the last checkpoint and its record: no further step is done."""
    original = trial.write_json

    def stopped(path, content):
        if path.name == "trained.json":
            raise KeyboardInterrupt
        original(path, content)

    monkeypatch.setattr(trial, "write_json", stopped)
    with pytest.raises(KeyboardInterrupt):
        study.training(LINEAR)
    monkeypatch.setattr(trial, "write_json", original)
    monkeypatch.setattr("giorom.training.loop.StepperTraining.train_step", forbid)
    assert study.training(LINEAR)["steps"] == study.scale.budget.steps


def test_a_damaged_checkpoint_costs_a_training_and_no_more(study, monkeypatch):
    """What cannot be read is thrown away, and the training begins again."""
    with monkeypatch.context() as patch:
        patch.setattr(trial, "write_json", lambda path, content: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            study.training(LINEAR)
    (state,) = (study.folder(LINEAR) / "run" / "checkpoints").glob("*/state.safetensors")
    state.write_bytes(b"torn")
    assert study.training(LINEAR)["problem"] is None


def test_a_training_without_a_model_is_counted_as_diverged(study, monkeypatch):
    """Every rollout counts, nothing is averaged, and the reason is kept."""

    def diverge(*arguments, **options):
        raise FloatingPointError("every validation rollout diverged")

    monkeypatch.setattr(trial, "train", diverge)
    assert study.trained("elastic3d", "linear") is None
    scores = study.scores(LINEAR)
    assert scores["diverged"] == scores["trajectories"] == 1
    assert scores["sparse"] is None
    assert "diverged" in scores["problem"]


def test_the_best_pair_on_validation_is_chosen_and_a_trial_keeps_its_own(study, monkeypatch):
    """The smallest error wins, none (diverged) never does; a training of its own is not tuned."""
    errors = {1e-3: 0.5, 3e-4: 0.25, 1e-4: None}
    pairs = tuple((rate, 1e-5) for rate in errors)
    scale = replace(study.scale, candidates=pairs)
    study = replace(study, scale=scale)
    asked = []

    def training(self, trial):
        asked.append(trial)
        return {"best_rollout_mse": errors[trial.changes["training"]["learning_rate"]]}

    monkeypatch.setattr(Study, "training", training)
    monkeypatch.setattr(Study, "train_all", lambda self, trials, **_: None)
    own = replace(LINEAR, changes={"training": {"noise_std": 7.0}})
    default = Trial(system="elastic3d", method="default")
    found = tuned(study, [LINEAR, own, default])
    assert found[0].changes["training"] == {"learning_rate": 3e-4, "noise_std": 1e-5}
    assert found[1].changes["training"] == {"learning_rate": 3e-4, "noise_std": 7.0}
    assert found[2] == default
    assert len(asked) == len(pairs)
    assert {short.budget for short in asked} == {scale.tuning_budget}


@pytest.mark.parametrize("scale", sorted(SCALES))
def test_every_scale_can_build_every_method_on_every_system(scale, tmp_path):
    """The sizes of the paper too, of which no test trains any."""
    study = Study(scale=SCALES[scale], out=tmp_path)
    for system in study.scale.systems:
        for name, method in METHODS.items():
            experiment = study.experiment(system, name)
            assert experiment.uses_network or not method.is_network
            assert experiment.system == system
    assert not list(tmp_path.iterdir())


def test_tasks_run_in_two_processes_and_a_refusal_comes_back(tmp_path):
    """Each task leaves its file; an exception of one keeps its kind and its words."""
    names = [tmp_path / f"{number}.txt" for number in range(3)]
    ended = []
    tasks = [(Path.write_text, (name, "done")) for name in names]
    run_tasks(tasks, jobs=2, done=ended.append)
    assert sorted(ended) == [0, 1, 2]
    assert [name.read_text() for name in names] == ["done"] * 3
    with pytest.raises(OSError, match="No such file"):
        run_tasks([(Path.write_text, (tmp_path / "no" / "a", ""))] * 2, jobs=2, done=ended.append)


SCRIPT = """
import sys
from pathlib import Path
from giorom.reproduce import SCALES, Study, Trial
if __name__ == "__main__":
    study = Study(scale=SCALES["tiny"], out=Path(sys.argv[1]), jobs=2)
    study.train_all([Trial(system="elastic3d", method="linear", seed=s) for s in range(40)])
"""


@pytest.mark.slow
def test_killed_without_warning_it_goes_on_where_it_was(study, tmp_path):
    """SIGKILL leaves no process behind and nothing half-made that would be taken for whole."""
    script = tmp_path / "run.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script), str(study.out)]
    process = subprocess.Popen(command, env=environment)  # noqa: S603
    models = study.shared / "models"
    deadline = time.monotonic() + 120.0
    while len(list(models.glob("*/trained.json"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(1.0)
    finished = {path: path.stat().st_mtime_ns for path in models.glob("*/trained.json")}
    begun = {path.name for path in models.iterdir()}
    assert 2 <= len(finished) < 40
    time.sleep(1.0)
    assert set(finished) == set(models.glob("*/trained.json"))
    trials = [replace(LINEAR, seed=seed) for seed in range(4)]
    study.train_all(trials)
    assert begun & {study.folder(t).name for t in trials}
    assert all(path.stat().st_mtime_ns == when for path, when in finished.items())
    for one in trials:
        record = json.loads((study.folder(one) / "trained.json").read_text())
        assert record["steps"] == study.scale.budget.steps
        assert study.scores(one)["diverged"] == 0
