"""The table of the fields: its numbers are those of the fields, its command writes what it says."""

import json

import pytest
import torch

from benchmarks.accuracy import fields as benchmark
from giorom.data.trajectory_file import read_trajectory
from giorom.fields.local import LocalConfig, LocalField
from giorom.sampling import sample


@pytest.fixture
def measured(tiny, data_folder, tmp_path, monkeypatch):
    """Run the command on the tiny data set; the result and the report."""
    monkeypatch.setattr(benchmark, "load_experiment", lambda name: tiny)

    def measure(*words):
        out = tmp_path / "fields.md"
        words = ["--data", str(data_folder), "--out", str(out), "--trajectories", "2", *words]
        assert benchmark.main([*words, "--seconds", "0.1"]) == 0
        return json.loads(out.with_suffix(".json").read_text()), out.read_text()

    return measure


def test_errors_are_those_of_the_field_on_held_out_motions(tiny, data_folder, measured):
    """Squared distance from the truth, summed over axes, over all particles, frame by frame."""
    known, _ = measured("--kind", "local")
    result = known["tiny"]["kinds"]["local"]["trajectories"][0]
    trajectory = read_trajectory(data_folder, "test", 0)
    body = trajectory.position[0]
    samples = sample(body, tiny.sampling)
    decode = LocalField(LocalConfig(), dimension=3).bind(
        body[samples], body, held=trajectory.kinematic
    )
    truth = trajectory.position[1:]
    found = torch.stack([decode(frame[samples]) for frame in truth])
    error = torch.where(trajectory.kinematic[:, None], 0.0, found - truth).square().sum(2).mean(1)
    assert result["mean"] == pytest.approx(float(error.mean()), rel=1e-4)
    assert result["error"]["last"] == pytest.approx(float(error[-1]), rel=1e-4)
    moved = (body - truth[-1]).square().sum(1).mean()
    relative = float((error[-1] / moved).sqrt())
    assert result["relative"]["last"] == pytest.approx(relative, rel=1e-3)


def test_systems_and_kinds_are_added_to_what_is_known(measured):
    """A run of one more kind keeps the others; the report names the best and every kind once."""
    measured("--kind", "local")
    known, report = measured("--kind", "kernel")
    assert set(known["tiny"]["kinds"]) == {"local", "kernel"}
    assert known["tiny"]["kinds"]["local"]["training"]["steps"] == 0
    assert "| tiny | `local` |" in report
    for kind in ("local", "kernel"):
        assert report.count(f"| `{kind}` | ") >= 2
