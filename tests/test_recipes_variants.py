"""The variants of the paper's network that are compared: what they are, and that all are alike."""

import pytest
import torch

from giorom.config import load_experiment
from giorom.features import Features
from giorom.graph import radius_edges
from giorom.time_stepper import TimeStepper

VARIANTS = {
    "io-not-io": ("transformer", 2, 1),
    "io-fno-io": ("fourier", 2, 1),
    "gno-fno-gno": ("fourier", 0, 1),
    "2gno-fno-2gno": ("fourier", 0, 2),
    "io-transolver-io": ("transolver", 2, 1),
    "io-cnn-io": ("convolution", 2, 1),
}
"""Processor, message-passing layers on each side, kernel integrals on each way."""


@pytest.fixture(params=VARIANTS)
def variant(request):
    """Name of a variant and its network for water in space in the common training."""
    experiment = load_experiment(f"water3d-small+equal+{request.param}")
    torch.manual_seed(0)
    config = experiment.network([[0.0, 1.0]] * 3)["time_stepper"]
    return request.param, TimeStepper(config)


def all_types(count: int = 45) -> Features:
    """Random particles of every type, a length of 0.35 m connected."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(count, 3, generator=generator)
    batch = torch.zeros(count, dtype=torch.long)
    edges = radius_edges(position, batch, 0.35)
    vector = (position[edges.sender] - position[edges.receiver]) / 0.35
    return Features(
        node=torch.randn(count, 21, generator=generator),
        particle_type=torch.arange(count) % 9,
        edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
        edges=edges,
        position=position,
        batch=batch,
    )


def dead_numbers(network: TimeStepper) -> int:
    """Imaginary parts of Fourier weights at frequency zero: the mean of a real field is real."""
    if network.latent.fourier is None:
        return 0
    return sum(
        layer.convolution.weight.shape[:2].numel() for layer in network.latent.fourier.layers
    )


def test_variant_is_what_its_name_says(variant):
    """Around the same ends: everything but the named parts is that of the others."""
    name, network = variant
    config = network.config
    found = (config.processor, config.layers_before, config.gno_layers)
    assert found == VARIANTS[name]
    assert config.layers_after == config.layers_before
    assert (config.gno_kernel, config.latent_skip, config.gno_input) == (
        *("relative", True),
        "features",
    )
    assert (config.hidden, config.latent_side, config.latent_width) == (128, 16, 64)
    assert config.fourier_modes <= config.latent_side // 2  # Nyquist


def test_variant_has_as_many_live_numbers_as_the_others(variant):
    """1.6 million within a tenth, and a gradient reaches every parameter."""
    _, network = variant
    count = sum(parameter.numel() for parameter in network.parameters()) - dead_numbers(network)
    assert count == pytest.approx(1.6e6, rel=0.1)
    network(all_types()).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
