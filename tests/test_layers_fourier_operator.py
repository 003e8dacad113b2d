"""The Fourier operator against plane waves, and against the neuraloperator library."""

import math

import pytest
import torch
from torch import Tensor

from giorom.layers.fourier_operator import FourierOperator, SpectralConvolution


def waves(side: int, *, order: int) -> Tensor:
    """A smooth periodic field in two dimensions with two channels (1 side side 2)."""
    x, y = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) / side] * 2, indexing="ij")
    turn = 2.0 * math.pi
    first = torch.cos(turn * (order * x + y)) + 0.5 * torch.sin(turn * (x - 2 * y)) + 0.3
    second = torch.sin(turn * order * x) - torch.cos(turn * 2 * y)
    return torch.stack([first, second], dim=-1)[None]


@pytest.mark.parametrize("frequency", [(0, 1), (1, 2), (-2, 1), (1, 0)])
def test_a_plane_wave_is_scaled_and_shifted_by_its_own_coefficient(frequency):
    """Li et al. (arXiv:2010.08895), equation 5: cos(t) becomes Re(R exp(i t)) at its frequency."""
    modes, side = 6, 10
    layer = SpectralConvolution(1, dimension=2, modes=modes).double()
    x, y = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) / side] * 2, indexing="ij")
    angle = 2.0 * math.pi * (frequency[0] * x + frequency[1] * y)
    real, imaginary = 0.7, -1.3
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.fill_(0.25)
        pairs = {frequency: imaginary}
        if frequency[1] == 0:  # a real field has its mirror image among the kept ones
            pairs[-frequency[0], 0] = -imaginary
        for (first, second), part in pairs.items():
            layer.weight[0, 0, first + modes // 2, second] = torch.tensor(
                [real, part], dtype=torch.float64
            )
    found = layer(torch.cos(angle)[None, ..., None])[0, ..., 0]
    expected = real * torch.cos(angle) - imaginary * torch.sin(angle) + 0.25
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_a_finer_grid_sees_the_same_operator():
    """A field without high frequencies, on 12 and on 24 nodes: equal at the common ones."""
    layer = SpectralConvolution(2, dimension=2, modes=6).double()
    coarse, fine = layer(waves(12, order=2)), layer(waves(24, order=2))
    torch.testing.assert_close(fine[:, ::2, ::2], coarse, rtol=0, atol=1e-12)


def test_frequencies_above_the_kept_ones_are_removed():
    """What is left of a wave of five periods with four modes kept is the bias."""
    layer = SpectralConvolution(1, dimension=2, modes=4).double()
    x = torch.arange(16, dtype=torch.float64) / 16
    wave = torch.cos(2.0 * math.pi * 5 * x)[None, :, None, None].expand(1, 16, 16, 1)
    assert float(layer(wave).abs().max().detach()) < 1e-12


@pytest.mark.parametrize(("dimension", "side", "modes"), [(2, 10, 4), (3, 6, 4), (2, 8, 12)])
def test_operator_equals_that_of_the_neuraloperator_library(dimension, side, modes):
    """Another implementation with the same weights, also with more modes than the grid holds."""
    from neuralop.models import FNO

    width_in, width, width_out, hidden = 3, 6, 5, 4
    ours = FourierOperator(
        width_in, width, width_out, dimension=dimension, layers=2, modes=modes, hidden=hidden
    )
    theirs = FNO(
        (modes,) * dimension,
        width_in,
        width_out,
        width,
        n_layers=2,
        lifting_channel_ratio=hidden / width,
        projection_channel_ratio=hidden / width,
        positional_embedding=None,
        channel_mlp_expansion=0.5,
        stabilizer="tanh",
        preactivation=True,
    )
    copy_weights(ours, theirs)
    token = torch.randn(2, side**dimension, width_in, generator=torch.Generator().manual_seed(0))
    expected = theirs(token.transpose(1, 2).unflatten(2, [side] * dimension))
    torch.testing.assert_close(
        ours(token), expected.flatten(2).transpose(1, 2), rtol=1e-4, atol=1e-5
    )
    count = sum(p.numel() * (2 if p.is_complex() else 1) for p in theirs.parameters())
    assert sum(p.numel() for p in ours.parameters()) == count


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("half", [False, True])
def test_the_device_gives_what_the_processor_gives(half):
    """Single precision to rounding; half precision outside the transform to a few per cent."""
    torch.manual_seed(0)
    operator = FourierOperator(3, 8, 4, dimension=3, layers=2, modes=4, hidden=8)
    token = torch.randn(2, 6**3, 3)
    expected = operator(token).detach()
    operator.cuda()
    with torch.autocast("cuda", torch.bfloat16, enabled=half):
        found = operator(token.cuda()).float().cpu().detach()
    error = (found - expected).square().mean().sqrt() / expected.square().mean().sqrt()
    assert float(error) < (0.05 if half else 1e-4)


@torch.no_grad()
def copy_weights(ours: FourierOperator, theirs: torch.nn.Module) -> None:
    """Give our operator the weights of the library's."""

    def copy(mlp: torch.nn.Module, other: torch.nn.Module) -> None:
        for layer, fc in zip(mlp.layers, other.fcs, strict=True):
            layer.weight.copy_(fc.weight.flatten(1))
            layer.bias.copy_(fc.bias)

    copy(ours.lifting, theirs.lifting)
    copy(ours.projection, theirs.projection)
    blocks = theirs.fno_blocks
    for number, layer in enumerate(ours.layers):
        theirs_weight = torch.as_tensor(blocks.convs[number].weight.tensor)
        layer.convolution.weight.copy_(torch.view_as_real(theirs_weight))
        layer.convolution.bias.copy_(blocks.convs[number].bias.flatten())
        layer.skip.weight.copy_(blocks.fno_skips[number].conv.weight.flatten(1))
        layer.scale.copy_(blocks.channel_mlp_skips[number].weight.flatten())
        copy(layer.channels, blocks.channel_mlp[number])
