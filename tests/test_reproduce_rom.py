"""Scores of recovered motions and the rows made of them, against values known by hand."""

import pytest
import torch

from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.nearest import NearestConfig, NearestField
from giorom.fields.transport import TransportConfig, TransportField
from giorom.reproduce import SCALES, rom
from giorom.reproduce.reconstruction import field_budget, score_trajectory
from giorom.sampling import SamplingConfig, sample
from giorom.state import Trajectory
from giorom.training.training_config import Budget

SAMPLING = SamplingConfig(count=30)


def motion(*, bend: float = 0.0) -> Trajectory:
    """A square that is sheared more and more, and bent."""
    generator = torch.Generator().manual_seed(0)
    body = torch.rand(400, 2, generator=generator, dtype=torch.float64)
    frames = [body]
    for amount in (0.1, 0.2, 0.3, 0.4):
        height = body[:, 1:]
        shift = torch.cat([height + bend * height.square(), 0.5 * height], dim=1)
        frames.append(body + amount * shift)
    return Trajectory(
        position=torch.stack(frames),
        particle_type=torch.full((400,), 8),
        frame_dt=0.01,
        bounds=torch.tensor([[-9.0, 9.0]] * 2, dtype=torch.float64),
    )


@pytest.mark.parametrize("kind", [LocalField, TransportField])
def test_an_affine_motion_is_scored_as_without_error(kind):
    """Moving least squares reproduce it, with and without a memory."""
    config = {LocalField: LocalConfig(), TransportField: TransportConfig()}[kind]
    found = score_trajectory(kind(config, dimension=2), motion(), SAMPLING, frame_count=3)
    assert found["relative"] < 1e-10
    assert found["mse"] < 1e-20
    assert found["chamfer"] < 1e-20


@pytest.mark.parametrize("method", ["farthest", "random"])
def test_scores_are_those_of_a_loop_over_frames_and_points(method):
    """Nearest sample: squared distances, and their sum over that of the displacements."""
    trajectory, sampling = motion(bend=2.0), SamplingConfig(count=30, method=method)
    field = NearestField(NearestConfig(same_body=False), dimension=2)
    found = score_trajectory(field, trajectory, sampling, frame_count=2)
    body = trajectory.position[0]
    chosen = sample(body, sampling, seed=1 if method == "random" else None)
    wrong = moved = 0.0
    for frame in (1, 4):
        truth = trajectory.position[frame]
        for k, point in enumerate(body):
            near = chosen[(body[chosen] - point).norm(dim=1).argmin()]
            guess = point + truth[near] - body[near]
            wrong += float((guess - truth[k]).square().sum())
            moved += float((truth[k] - point).square().sum())
    assert found["mse"] == pytest.approx(wrong / 800, rel=1e-9)
    assert found["relative"] == pytest.approx((wrong / moved) ** 0.5, rel=1e-9)
    assert 0.0 < found["chamfer"] < 2 * found["mse"]


def score(error: float, **more) -> dict:
    """What one field left behind."""
    one = {"relative": error, "mse": error**2, "chamfer": error, "seconds_per_frame": 0.002}
    values = {"problem": None, "parameters": 7, "steps": 10, "seconds": 1.0}
    return values | {w: one | {"per_trajectory": [error]} for w in ("own", "random")} | more


def test_a_row_has_the_mean_over_seeds_and_the_paper_beside_it():
    """Mean squared error over that of the paper, on its own system alone."""
    candidate = rom.candidates(rom.RANKS, rom.GRID)["pod-32"]
    row = rom._row("elastic3d", candidate, [score(0.1), score(0.3)])
    assert row["relative_error"] == pytest.approx(0.2)
    assert (row["relative_error_min"], row["relative_error_max"]) == (0.1, 0.3)
    assert row["ratio"] == pytest.approx(0.05 / 6.00e-4)
    assert row["ms_per_frame"] == pytest.approx(2.0)
    assert rom._row("water3d", candidate, [score(0.1)])["paper"] is None


def test_a_field_that_could_not_be_made_has_no_numbers_and_a_note():
    """A seed that failed leaves the others; the reason is printed."""
    candidate = rom.candidates(rom.RANKS, rom.GRID)["pod-64"]
    failed = {"problem": "3 training frames cannot give 64 modes."}
    none = rom._row("elastic3d", candidate, [failed])
    assert (none["relative_error"], none["ratio"], none["parameters"]) == (None, None, None)
    some = rom._row("elastic3d", candidate, [failed, score(0.5)])
    assert (some["relative_error"], some["runs"]) == (0.5, 1)
    assert some["problem"] == failed["problem"]


def test_every_learned_field_is_trained_with_every_seed_and_none_twice_by_one():
    """Ranks and sizes beside the first are trained once; what learns nothing is made once."""
    known = rom.candidates(rom.RANKS, rom.GRID)
    first = [name for names in rom._shares(known, first=True) for name in names]
    (again,) = rom._shares(known, first=False)
    assert sorted(first) == sorted(known)
    kinds = {known[name].kind for name in again}
    assert kinds == {
        "neural_basis",
        "pod_autoencoder",
        "autoencoder",
        "crom",
        "kernel",
        "kernel_rom",
    }


def test_fields_have_a_share_of_the_time_of_a_training_and_a_limit():
    """Three eighths of it, ten minutes at most; steps stay steps."""
    assert field_budget(SCALES["tiny"]) == Budget(steps=SCALES["tiny"].budget.steps)
    cpu = SCALES["cpu"]
    assert field_budget(cpu).minutes == pytest.approx(0.375 * cpu.budget.minutes)
    assert field_budget(SCALES["paper"]).minutes == 10.0
