"""Transport: what it shares with the fixed neighbourhood, and what it gains by giving it up."""

import copy
import math

import pytest
import torch
from torch import Tensor

from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.transport import TransportConfig, TransportField
from giorom.sampling import sample_farthest


def grid(side: int) -> Tensor:
    """A square body of ``side`` x ``side`` points in the unit box."""
    axis = torch.linspace(0.0, 1.0, side, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis)


def field(**values: object) -> TransportField:
    """A field in the plane."""
    return TransportField(TransportConfig(**values), dimension=2)


def vortex(points: Tensor, angle: float) -> Tensor:
    """Steady shear flow on circles, faster inside: exact at any time, and it mixes."""
    offset = points - 0.5
    radius = offset.norm(dim=1)
    turn = angle / (0.1 + radius.square())
    cosine, sine = turn.cos(), turn.sin()
    x, y = offset[:, 0], offset[:, 1]
    return 0.5 + torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=1)


def test_a_body_that_keeps_its_shape_moves_as_with_fixed_neighbors():
    """A rotation spreads no neighbourhood: bit for bit the field ``local``."""
    body = grid(15)
    samples = body[::7]
    decode = field().bind(samples, body)
    fixed = LocalField(LocalConfig(), dimension=2).bind(samples, body)
    for step in range(1, 20):
        angle = 0.3 * step
        matrix = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        ).double()
        moved = samples @ matrix.T + 0.1 * step
        assert torch.equal(decode(moved), fixed(moved))


def test_affine_motions_are_exact_through_many_ties():
    """A shear of 300 % in steps: linear fits of affine motions are exact wherever they start."""
    body = torch.rand(300, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    samples, shear = body[::6], torch.eye(2, dtype=torch.float64)
    decode = field().bind(samples, body)
    first = decode.ties
    for step in range(1, 31):
        shear[0, 1] = 0.1 * step
        found = decode(samples @ shear.T)
    assert decode.ties is not first
    torch.testing.assert_close(found, body @ shear.T, rtol=0, atol=1e-8)


def test_a_flow_that_mixes_is_followed_better_than_with_fixed_neighbors():
    """A vortex that has torn every neighbourhood apart; the truth is in closed form."""
    body = grid(25)
    samples = body[sample_farthest(body, 80)]
    decode = field().bind(samples, body)
    fixed = LocalField(LocalConfig(), dimension=2).bind(samples, body)
    for step in range(1, 101):
        found = decode(vortex(samples, 0.02 * step))
    truth = vortex(body, 2.0)
    error, other = (
        float((p - truth).square().sum(1).mean().sqrt())
        for p in (found, fixed(vortex(samples, 2.0)))
    )
    assert error < 0.6 * other


def test_samples_keep_their_own_motion_through_many_ties():
    """The weights interpolate at every tie."""
    body = grid(21)
    decode = field().bind(body[::5], body[::5])
    for step in range(1, 51):
        moved = vortex(body[::5], 0.04 * step)
        found = decode(moved)
    torch.testing.assert_close(found, moved, rtol=0, atol=1e-5)


def test_no_point_leaves_the_domain():
    """Samples pressed against a wall by a shear that would carry others past it."""
    body = grid(15)
    bounds = torch.tensor([[0.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
    samples = body[::7]
    free, walled = field().bind(samples, body), field().bind(samples, body, bounds=bounds)
    gone = False
    for step in range(1, 30):
        moved = vortex(samples, 0.1 * step).clamp(0.0, 1.0)
        gone |= bool(((free(moved) < 0.0) | (free(moved) > 1.0)).any())
        found = walled(moved)
        assert bool(((found >= 0.0) & (found <= 1.0)).all())
    assert gone


def test_a_branch_does_not_disturb_the_decoder_it_came_from():
    """One frame on a copy, then on: the same as without."""
    body = grid(15)
    samples = body[::7]
    one, other = (field().bind(samples, body) for _ in range(2))
    for step in range(1, 20):
        copy.copy(one)(vortex(samples, -0.05 * step))
        moved = vortex(samples, 0.05 * step)
        assert torch.equal(one(moved), other(moved))


@pytest.mark.parametrize(
    ("values", "message"),
    [({"spread": 1.0}, "must be > 1, got 1.0"), ({"neighbors": 0}, "must be >= 1, got 0")],
)
def test_ties_that_cannot_last_are_refused(values, message):
    """The message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        TransportConfig(**values)
