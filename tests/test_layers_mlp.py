"""Pointwise networks against their definition."""

import pytest
import torch
from torch.nn import functional

from giorom.layers.mlp import MLP, ResidualMLP, relu


def test_mlp_is_linear_activation_linear_and_layer_norm():
    """LN(W2 relu(W1 x + b1) + b2), written out."""
    net = MLP([3, 5, 4], activation=relu, layer_norm=True).double()
    x = torch.randn(7, 3, dtype=torch.float64)
    first, last = net.layers
    hidden = functional.relu(x @ first.weight.T + first.bias)
    expected = functional.layer_norm(hidden @ last.weight.T + last.bias, (4,))
    torch.testing.assert_close(net(x), expected)


def test_mlp_gradient_agrees_with_finite_differences():
    """The rectifier overwrites its input; autograd must not notice."""
    net = MLP([3, 5, 5, 2], activation=relu).double()
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (x,))


def test_unit_variance_weights_have_variance_one_over_fan_in():
    """N(0, 1 / fan_in): the sample standard deviation of 65536 draws is good to 0.3 %."""
    torch.manual_seed(0)
    layer = MLP([256, 256], activation=relu, unit_variance=True).layers[0]
    assert float(layer.weight.detach().std()) == pytest.approx(1 / 16, rel=0.02)
    assert not layer.bias.any()


def test_one_width_is_refused():
    """There is no network from one width."""
    with pytest.raises(ValueError, match="input and an output width"):
        MLP([3], activation=relu)


def test_residual_mlp_adds_each_hidden_layer():
    """Linear, GELU, h + GELU(Linear h), Linear, written out."""
    net = ResidualMLP(3, 5, 2, depth=2).double()
    x = torch.randn(7, 3, dtype=torch.float64)
    h = functional.gelu(net.first(x))
    for layer in net.residuals:
        h = h + functional.gelu(layer(h))
    torch.testing.assert_close(net(x), net.last(h))
