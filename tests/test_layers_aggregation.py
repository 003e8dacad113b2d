"""Copies to pairs and sums over pairs against loops."""

import pytest
import torch

from giorom.layers.aggregation import Grouping, take, weighted_sum

POINT = torch.tensor([3, 0, 3, 1, 0, 3])
"""Point of each pair; point 2 has none."""


@pytest.fixture
def grouping() -> Grouping:
    """Six pairs of four points, in no order."""
    return Grouping.by(POINT, 4)


def test_grouping_lists_the_pairs_of_each_point(grouping):
    """Written out by hand."""
    assert grouping.order.tolist() == [1, 4, 3, 0, 2, 5]
    assert grouping.offset.tolist() == [0, 2, 3, 3, 6]
    assert grouping.count.tolist() == [2, 1, 0, 3]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_weighted_sum_agrees_with_a_loop(grouping, dtype):
    """sum_k w_k u_k, pair by pair; small integers are exact in every type."""
    value = torch.arange(12.0).reshape(6, 2).to(dtype)
    weight = torch.tensor([1.0, 2.0, 0.5, 1.0, 4.0, 2.0]).to(dtype)
    expected = torch.zeros(4, 2, dtype=dtype)
    for pair, point in enumerate(POINT):
        expected[point] += weight[pair] * value[pair]
    torch.testing.assert_close(weighted_sum(value, grouping, weight), expected, rtol=0, atol=0)


def test_mean_weight_gives_the_mean(grouping):
    """Weights of one point add up to one."""
    weight = grouping.mean_weight(dtype=torch.float64)
    ones = torch.ones(6, 1, dtype=torch.float64)
    assert weighted_sum(ones, grouping, weight).flatten().tolist() == pytest.approx([1, 1, 0, 1])


def test_take_agrees_with_indexing(grouping):
    """u[point]."""
    value = torch.randn(4, 3, dtype=torch.float64)
    torch.testing.assert_close(take(value, grouping), value[POINT], rtol=0, atol=0)


def test_gradients_agree_with_finite_differences(grouping):
    """Both maps are linear; each is the other's transpose."""
    value = torch.randn(4, 2, dtype=torch.float64, requires_grad=True)
    pair_value = torch.randn(6, 2, dtype=torch.float64, requires_grad=True)
    weight = torch.rand(6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda v: take(v, grouping), (value,))
    assert torch.autograd.gradcheck(lambda v: weighted_sum(v, grouping, weight), (pair_value,))


def test_no_pairs_sum_to_zero():
    """Four points, none with a pair."""
    empty = Grouping.by(torch.zeros(0, dtype=torch.int64), 4)
    assert not weighted_sum(torch.zeros(0, 2), empty, torch.zeros(0)).any()
    value = torch.randn(4, 2, requires_grad=True)
    take(value, empty).sum().backward()
    assert not value.grad.any()
