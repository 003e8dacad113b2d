"""Scenes side by side: every particle in the row of its scene, and back."""

import pytest
import torch

from giorom.layers.padding import ScenePadding


def batch_of(counts: list[int]) -> torch.Tensor:
    """Scene of each particle of scenes with the given numbers of particles."""
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))


@pytest.mark.parametrize("counts", [[5], [3, 3], [4, 1, 6], [2, 0, 3], [0, 2]])
def test_packing_agrees_with_splitting(counts):
    """Row s holds the particles of scene s in their order, then zeros; the mask says which."""
    padding = ScenePadding.of(batch_of(counts), len(counts))
    value = torch.randn(sum(counts), 2, generator=torch.Generator().manual_seed(0))
    dense = padding.pack(value)
    assert dense.shape == (len(counts), max(counts), 2)
    for scene, own in enumerate(value.split(counts)):
        assert torch.equal(dense[scene, : len(own)], own)
        assert not dense[scene, len(own) :].any()
        if padding.mask is not None:
            exists = torch.arange(max(counts)) < len(own)
            assert torch.equal(padding.mask[scene], exists)
    assert (padding.mask is None) == (len(set(counts)) == 1)


@pytest.mark.parametrize("counts", [[5], [3, 3], [4, 1, 6], [2, 0, 3]])
def test_unpacking_undoes_packing(counts):
    """An inverse on the particles; its gradient leaves padded tokens alone."""
    padding = ScenePadding.of(batch_of(counts), len(counts))
    value = torch.randn(sum(counts), 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(padding.unpack(padding.pack(value)), value)
    dense = torch.zeros(len(counts), max(counts), 2, requires_grad=True)
    padding.unpack(dense).sum().backward()
    assert torch.equal(dense.grad, padding.pack(torch.ones(sum(counts), 2)))
