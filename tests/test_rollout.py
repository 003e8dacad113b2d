"""A recorded rollout keeps what the loop did, and says when it went wrong."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import free_fall
from giorom.graph import Edges
from giorom.pipeline import connect_within, integrated
from giorom.state import SAND, SparseState

CONNECT = connect_within(0.5, configuration="current")


def state() -> SparseState:
    """Eight samples at rest in the unit box."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(8, 2, generator=generator, dtype=torch.float64)
    return SparseState(
        history=position[:, None].expand(-1, 3, -1),
        reference=position,
        particle_type=torch.full((8,), SAND),
        batch=torch.zeros(8, dtype=torch.long),
        batch_size=1,
        bounds=torch.tensor([[0.0, 1.0]] * 2, dtype=torch.float64),
        frame_dt=0.1,
    )


def pushing(*push: float):
    """Constant acceleration."""

    def acceleration(given: SparseState, edges: Edges) -> Tensor:
        return given.position.new_tensor(push).expand_as(given.position)

    return acceleration


def test_a_rollout_that_ends_well_is_kept_frame_by_frame():
    """Free fall in closed form (walls out of reach)."""
    given = replace(state(), bounds=torch.tensor([[-50.0, 50.0]] * 2, dtype=torch.float64))
    gravity = torch.tensor([0.0, -9.81], dtype=torch.float64)
    found = roll_out(given, 10, connect=CONNECT, step=integrated(pushing(0.0, -9.81)))
    expected = free_fall(given, 10, gravity=gravity)
    torch.testing.assert_close(found.position, expected, rtol=0, atol=1e-12)
    assert found.diverged_at is None


@pytest.mark.parametrize("bad", [1, 4])
def test_a_divergence_is_dated_and_the_last_finite_frame_repeated(bad):
    """From the first bad frame on; before the first frame that is the given one."""
    calls = []

    def explode(given: SparseState, edges: Edges) -> Tensor:
        calls.append(given)
        value = torch.nan if len(calls) == bad else 0.5
        return torch.full_like(given.position, value)

    found = roll_out(state(), 6, connect=CONNECT, step=integrated(explode))
    assert found.diverged_at == bad
    assert found.position.shape == (6, 8, 2)
    assert found.position.isfinite().all()
    last = found.position[bad - 2] if bad > 1 else state().position
    assert torch.equal(found.position[bad - 1 :], last.expand(7 - bad, -1, -1))


def test_a_sample_one_domain_outside_the_walls_has_diverged():
    """At 1 m/frame^2 from rest: x grows by 1, 3, 6, 10; the limit is 2, passed at frame 2."""
    found = roll_out(state(), 5, connect=CONNECT, step=integrated(pushing(100.0, 0.0)))
    assert found.diverged_at == 2
    expected = state().position + torch.tensor([1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.position, expected.expand(5, -1, -1), rtol=0, atol=1e-12)
