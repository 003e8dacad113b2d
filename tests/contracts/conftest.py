"""Random batches of features, as the pipeline would make them."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from giorom.features import Features
from giorom.graph import radius_edges

RADIUS = 0.35


def build(position: Tensor, node: Tensor, particle_type: Tensor, batch: Tensor) -> Features:
    """Features of given particles with the radius graph of their positions."""
    edges = radius_edges(position, batch, RADIUS)
    vector = (position[edges.sender] - position[edges.receiver]) / RADIUS
    return Features(
        node=node,
        particle_type=particle_type,
        edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
        edges=edges,
        position=position,
        batch=batch,
        batch_size=int(batch.max()) + 1,
    )


@pytest.fixture
def make_features() -> Callable[..., Features]:
    """Build features from tensors."""
    return build


@pytest.fixture
def random_features() -> Callable[..., Features]:
    """Build random features of scenes with the given numbers of particles."""

    def make(
        counts: list[int], *, dimension: int, dtype: torch.dtype = torch.float64, seed: int = 0
    ) -> Features:
        generator = torch.Generator().manual_seed(seed)
        total = sum(counts)
        position = torch.rand(total, dimension, generator=generator, dtype=torch.float64)
        node = torch.randn(total, 7 * dimension, generator=generator, dtype=torch.float64)
        kind = torch.randint(5, 8, (total,), generator=generator)
        batch = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        return build(position.to(dtype), node.to(dtype), kind, batch)

    return make
