"""The training loop: budget, learning rate, and resuming as if nothing had happened."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from safetensors.torch import load_file

from giorom.experiment import build_simulator
from giorom.training import loop
from giorom.training.checkpoint import CheckpointError
from giorom.training.loop import StepperTraining, train_stepper
from giorom.training.training_config import Budget, TrainingConfig, learning_rate
from giorom.training_data import load_training_data


def stop_at(step):
    """A report that interrupts the time-stepper's training after some steps."""

    def report(stage, numbers):
        if stage == "time_stepper" and numbers["step"] == step:
            raise KeyboardInterrupt

    return report


def log_of(folder):
    """Log entries without the clock."""
    entries = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in entry.items() if k != "seconds"} for entry in entries]


def test_learning_rate_is_the_gns_rule_after_the_warm_up():
    """arXiv:2002.09405: lr = end + (start - end) 0.1^(t / horizon), two horizons per budget."""
    config = TrainingConfig(learning_rate=1e-3, final_learning_rate=1e-5, decades=2.0, warmup=10)
    for progress in (0.0, 0.25, 0.5, 1.0):
        expected = 1e-5 + (1e-3 - 1e-5) * 0.1 ** (2.0 * progress)
        assert learning_rate(config, step=10, progress=progress) == pytest.approx(expected)
    warm = [learning_rate(config, step=step, progress=0.0) / 1e-3 for step in range(11)]
    assert warm == pytest.approx([*((step + 1) / 10 for step in range(10)), 1.0])


def test_learning_rate_of_the_paper_falls_by_a_constant_factor_per_step():
    """Gamma = 0.1^(1 / 5e6) at every step, whatever the budget; no warm-up."""
    config = TrainingConfig(
        learning_rate=1e-4, final_learning_rate=0.0, decay_steps=5e6, warmup=0, decades=7.0
    )
    gamma = 0.1 ** (1.0 / 5e6)
    for step in (0, 1, 1000, 5_000_000):
        expected = 1e-4 * gamma**step
        found = [learning_rate(config, step=step, progress=share) for share in (0.0, 1.0)]
        assert found == pytest.approx([expected] * 2, rel=1e-9)


@pytest.fixture
def train_briefly(tiny, data_folder, tmp_path):
    """Two steps of the tiny experiment with other training values; returns the training."""
    scene = replace(tiny.scene, gravity=9.8)
    plain = replace(tiny.training, unroll=[[0.0, 2.0]], isotropic=False, warmup=0)

    def run(**changes):
        experiment = replace(tiny, scene=scene, training=replace(plain, **changes))
        data = load_training_data(experiment, data_folder)
        torch.manual_seed(0)
        simulator = build_simulator(experiment, data)
        training = StepperTraining(
            simulator.dynamics,
            experiment.training,
            windows=data.windows,
            connect=simulator.connect,
            seed=0,
            folder=tmp_path,
        )
        for step in range(2):
            training.run.step = step
            training.train_step([0, 1], progress=0.0)
        return training

    return run


def test_the_precision_is_that_of_one_training_and_of_its_steps_alone(train_briefly):
    """Two precisions in one process; what is validated and kept computes as the stored one does.

    Reference: the same weights in a simulator that was never trained.
    """
    for precision in ("bfloat16", "float32"):
        training = train_briefly(precision=precision, average_decay=0.0)
        fresh = train_briefly(precision="float32").plain
        fresh.load_state_dict(training.plain.state_dict())
        state = training.windows[0].state
        edges = training.connect(state)
        with torch.no_grad():
            expected = fresh(state, edges)
            assert torch.equal(training.chosen()(state, edges), expected)
            assert torch.equal(training.plain(state, edges), expected)


def test_half_precision_changes_what_is_learnt_by_little(train_briefly):
    """bfloat16 keeps 8 bits; the same seed and windows."""
    name = "time_stepper.node_out.layers.0.weight"
    half, single = (
        train_briefly(precision=precision).plain.state_dict()[name]
        for precision in ("bfloat16", "float32")
    )
    assert not torch.equal(half, single)
    torch.testing.assert_close(half, single, rtol=0, atol=0.02 * float(single.abs().max()))


def test_without_average_the_newest_weights_are_validated_and_kept(train_briefly):
    """average_decay 0: the averaged model is the model; with an average it lags behind."""
    for decay, equal in ((0.0, True), (0.5, False)):
        training = train_briefly(average_decay=decay)
        pairs = zip(training.model.parameters(), training.average.module.parameters(), strict=True)
        assert all(torch.equal(new, averaged) for new, averaged in pairs) == equal


@pytest.mark.parametrize(
    "change",
    [
        {"pushforward": True},
        {"huber": 0.1},
        {"gradient_clip": None},
        {"explicit_gravity": True},
        {"position_weight": 1e9},
        {"noise_std": 0.0},
    ],
)
def test_a_switch_of_the_recipe_changes_what_is_learnt(train_briefly, change):
    """The same seed and windows: other weights than without it, and the same without it again."""
    name = "time_stepper.node_out.layers.0.weight"
    plain, again, other = (
        train_briefly(**values).model.state_dict()[name] for values in ({}, {}, change)
    )
    assert torch.equal(plain, again)
    assert not torch.equal(plain, other)


@pytest.mark.parametrize(("cost", "expected"), [(1.0, 12), (10.0, 6)])
def test_validations_take_a_fifth_of_the_minutes_at_most(
    train_briefly, monkeypatch, cost, expected
):
    """Of 300 s, a step takes 1 s: cheap validations come every 25 s, dear ones every 50 s."""
    now, scored = [0.0], []
    monkeypatch.setattr(loop.time, "perf_counter", lambda: now[0])
    training = train_briefly(validations=12)
    training.run.step = 0
    monkeypatch.setattr(training, "save", lambda: None)

    def step(numbers, *, progress):
        now[0] += 1.0
        return 1.0

    def validate(model):
        scored.append(now[0])
        now[0] += cost
        return {"rollout_mse": 1.0, "static_mse": 1.0}

    monkeypatch.setattr(training, "train_step", step)
    run = train_stepper(
        training,
        Budget(minutes=5.0),
        validate=validate,
        keep=lambda model: None,
        report=lambda numbers: None,
    )
    during = scored[:-1]  # the last one ends the run
    assert len(during) == expected
    gaps = [later - earlier for earlier, later in pairwise(during)]
    assert min(gaps) >= 5.0 * cost
    assert scored[-1] >= 300.0
    assert run.seconds == scored[-1]


def test_budget_is_used_by_whichever_runs_out_first():
    """Shares of steps and of minutes, the larger counts, never above one."""
    budget = Budget(steps=100, minutes=1.0)
    assert budget.progress(50, 6.0) == pytest.approx(0.5)
    assert budget.progress(10, 45.0) == pytest.approx(0.75)
    assert budget.progress(1000, 0.0) == 1.0
    assert Budget(minutes=2.0).progress(10**9, 60.0) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "give a budget"),
        ({"steps": 0}, "steps must be > 0"),
        ({"minutes": -1.0}, "minutes must be > 0"),
        ({"minutes": math.nan}, "minutes must be > 0"),
    ],
)
def test_endless_or_empty_budget_is_refused(values, text):
    """A training that never ends or never begins is a mistake."""
    with pytest.raises(ValueError, match=text):
        Budget(**values)


def test_unroll_stages_begin_at_their_share_of_the_budget():
    """The last stage that has begun counts; before the first, one frame."""
    config = TrainingConfig(unroll=[[0.25, 2.0], [0.5, 4.0]])
    found = [config.unrolled_frames(share) for share in (0.0, 0.24, 0.25, 0.49, 0.5, 1.0)]
    assert found == [1, 1, 2, 2, 4, 4]
    assert config.longest_unroll == 4
    assert TrainingConfig().longest_unroll == TrainingConfig().unrolled_frames(1.0) == 1


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"batch_size": 0}, "batch_size"),
        ({"noise_std": -1.0}, "noise_std"),
        ({"learning_rate": math.nan}, "learning_rate"),
        ({"average_decay": 1.0}, "average_decay"),
        ({"gradient_clip": 0.0}, "gradient_clip"),
        ({"huber": 0.0}, "huber"),
        ({"objective": "motion", "pushforward": True}, "pushforward"),
        ({"decay_steps": -1.0}, "decay_steps"),
        ({"unroll": [[0.5]]}, "unroll"),
        ({"unroll": [[1.0, 2.0]]}, "unroll"),
        ({"unroll": [[0.0, 0.0]]}, "unroll"),
        ({"unroll": [[0.0, math.inf]]}, "unroll"),
        ({"unroll": [[0.0, math.nan]]}, "unroll"),
        ({"unroll": [[0.0, 2.5]]}, "unroll"),
        ({"unroll": [[0.5, 3.0], [0.0, 2.0]]}, "unroll"),
        ({"learning_rate": math.inf}, "learning_rate"),
        ({"batch_size": 10**6}, "batch_size"),
        ({"subsets": 10**9}, "subsets"),
    ],
)
def test_useless_training_values_are_refused_by_name(values, name):
    """The message names the field."""
    with pytest.raises(ValueError, match=rf"TrainingConfig\.{name}"):
        TrainingConfig(**values)


@pytest.mark.parametrize("optimizer", ["adamax", "adamw", "nadam"])
def test_resumed_run_equals_one_never_interrupted(
    tiny, data_folder, run_training, tmp_path, optimizer
):
    """Twelve steps against eight and, from the checkpoint at six, the rest; bit for bit.

    Two frames are unrolled in the second half, so the stage has to be found again too.
    """
    training = replace(
        tiny.training, optimizer=optimizer, unroll=[[0.5, 2.0]], validations=2, warmup=8
    )
    experiment = replace(tiny, training=training)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    first = run_training(experiment, data_folder, whole)
    with pytest.raises(KeyboardInterrupt):
        run_training(experiment, data_folder, parts, report=stop_at(8))
    assert [path.name for path in (parts / "checkpoints").iterdir()] == ["step-000000006"]
    second = run_training(experiment, data_folder, parts, resume=True)

    for name in ("checkpoints/step-000000012/state", "simulator/model"):
        ours, theirs = (load_file(run / f"{name}.safetensors") for run in (parts, whole))
        assert ours.keys() == theirs.keys()
        for key in ours:
            assert torch.equal(ours[key], theirs[key]), key
    assert log_of(parts) == log_of(whole)
    assert [entry["stage"] for entry in log_of(parts)][:2] == ["coverage", "field"]
    assert second["best_rollout_mse"] == first["best_rollout_mse"]
    assert len(second["history"]) == len(first["history"]) == 3


def test_resuming_a_finished_run_changes_nothing(tiny, data_folder, run_training, tmp_path):
    """No step is left, so log and weights stay."""
    run_training(tiny, data_folder, tmp_path / "run", steps=3)
    before = log_of(tmp_path / "run")
    result = run_training(tiny, data_folder, tmp_path / "run", steps=3, resume=True)
    assert log_of(tmp_path / "run") == before
    assert result["steps"] == 3


def test_checkpoint_that_lacks_an_entry_is_refused(tiny, data_folder, run_training, tmp_path):
    """One CheckpointError, not a KeyError from inside."""
    run_training(tiny, data_folder, tmp_path / "run", steps=2)
    record = next((tmp_path / "run" / "checkpoints").iterdir()) / "state.json"
    record.write_text('{"step": 2}')
    with pytest.raises(CheckpointError, match="does not fit"):
        run_training(tiny, data_folder, tmp_path / "run", steps=4, resume=True)


def test_loss_that_is_not_finite_ends_the_run_and_names_the_step(
    tiny, data_folder, run_training, tmp_path, monkeypatch
):
    """The checkpoint before it stays, so that nothing learnt is lost."""
    loss = loop.unrolled_loss
    calls = []

    def spoilt(*arguments, **options):
        calls.append(None)
        return loss(*arguments, **options) * (math.nan if len(calls) == 5 else 1.0)

    monkeypatch.setattr(loop, "unrolled_loss", spoilt)
    with pytest.raises(FloatingPointError, match=r"loss is nan at step 4.*learning_rate"):
        run_training(tiny, data_folder, tmp_path / "run", steps=6)
    tensors = load_file(tmp_path / "run" / "checkpoints" / "step-000000003" / "state.safetensors")
    assert all(bool(torch.isfinite(value).all()) for value in tensors.values())


def test_only_a_better_model_replaces_the_kept_one(
    tiny, data_folder, run_training, tmp_path, monkeypatch
):
    """Scores 5, 3, infinity, 4: kept at the first two; infinity is null in the log."""
    import giorom.experiment as module

    scores, kept = iter([5.0, 3.0, math.inf, 4.0]), []
    monkeypatch.setattr(
        module,
        "_validation",
        lambda *_, **__: lambda model: {"rollout_mse": next(scores), "static_mse": 1.0},
    )
    monkeypatch.setattr(module, "_keep", lambda simulator, best, out: kept.append(len(kept)))
    experiment = replace(tiny, training=replace(tiny.training, validations=3))
    result = run_training(experiment, data_folder, tmp_path / "run", steps=6)
    assert len(kept) == 2
    assert result["best_rollout_mse"] == 3.0
    assert [entry["rollout_mse"] for entry in result["history"]] == [5.0, 3.0, None, 4.0]
    json.dumps(result, allow_nan=False)


def test_run_whose_every_validation_diverged_fails_in_words(
    tiny, data_folder, run_training, tmp_path, monkeypatch
):
    """No simulator is stored, and the message says so."""
    import giorom.experiment as module

    monkeypatch.setattr(
        module,
        "_validation",
        lambda *_, **__: lambda model: {"rollout_mse": math.inf, "static_mse": 1.0},
    )
    with pytest.raises(FloatingPointError, match="holds no simulator"):
        run_training(tiny, data_folder, tmp_path / "run", steps=2)
    assert not (tmp_path / "run" / "simulator").exists()
