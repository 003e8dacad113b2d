"""The transformer against its equations written as loops."""

import pytest
import torch
from torch import Tensor

from giorom.layers.operator_attention import (
    GatedExperts,
    NormalizedAttention,
    OperatorTransformer,
)

WIDTH, HEADS = 8, 2


@pytest.fixture
def attention() -> NormalizedAttention:
    """Two heads of four channels in float64."""
    torch.manual_seed(0)
    return NormalizedAttention(WIDTH, heads=HEADS).double()


def tokens(*shape: int, seed: int = 0) -> Tensor:
    """Random tokens."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def transformer(**options: object) -> OperatorTransformer:
    """A small transformer in float64."""
    torch.manual_seed(0)
    values = {
        "dimension": 3,
        "layers": 2,
        "heads": HEADS,
        "experts": 2,
        "expert_hidden": 8,
        "gate_input": "coords",
    }
    return OperatorTransformer(6, WIDTH, 5, **(values | options)).double().eval()


def by_loop(attention: NormalizedAttention, target: Tensor, source: Tensor) -> Tensor:
    """Softmax over the channels of a head, then sums token by token (GNOT's attention)."""
    size = WIDTH // HEADS
    rows = []
    for x in target:
        heads = []
        for head in range(HEADS):
            part = slice(head * size, (head + 1) * size)
            q = attention.query(x)[part].softmax(dim=0)
            keys = [attention.key(y)[part].softmax(dim=0) for y in source]
            shares = torch.stack([q @ k for k in keys])
            values = torch.stack([attention.value(y)[part] for y in source])
            heads.append(q + (shares[:, None] * values).sum(dim=0) / shares.sum())
        rows.append(attention.out(torch.cat(heads)))
    return torch.stack(rows)


def test_attention_agrees_with_the_loop(attention):
    """Cross-attention of 5 tokens to 7, in each of 3 samples."""
    target, source = tokens(3, 5, WIDTH), tokens(3, 7, WIDTH, seed=1)
    expected = torch.stack([by_loop(attention, t, s) for t, s in zip(target, source, strict=True)])
    torch.testing.assert_close(attention(target, source), expected)


def test_masked_sources_do_not_exist(attention):
    """Masking equals leaving out."""
    target, source = tokens(1, 5, WIDTH), tokens(1, 7, WIDTH, seed=1)
    mask = torch.tensor([[True, False, True, True, False, False, True]])
    expected = attention(target, source[:, mask[0]])
    torch.testing.assert_close(attention(target, source, mask), expected)


def test_a_sample_without_sources_reads_zero(attention):
    """0 / 0 is taken as 0: what remains is out(softmax(q)), with finite gradients."""
    target = tokens(1, 2, WIDTH).requires_grad_()
    result = attention(target, target, torch.zeros(1, 2, dtype=torch.bool))
    query = attention.query(target).unflatten(-1, (HEADS, -1)).softmax(dim=-1).flatten(2)
    torch.testing.assert_close(result, attention.out(query))
    result.sum().backward()
    assert target.grad.isfinite().all()


def test_repeating_every_source_changes_nothing(attention):
    """A convex mean over the sources does not count them (discretisation invariance)."""
    target, source = tokens(1, 5, WIDTH), tokens(1, 7, WIDTH, seed=1)
    torch.testing.assert_close(attention(target, source.repeat(1, 3, 1)), attention(target, source))


def test_experts_are_mixed_by_the_gate():
    """sum_e g_e FFN_e(x); a gate of one leaves one expert."""
    experts = GatedExperts(WIDTH, experts=3, hidden=4).double()
    x, gate = tokens(2, 5, WIDTH), tokens(2, 5, 3, seed=1).softmax(dim=-1)
    expected = sum(gate[..., e : e + 1] * experts.experts[e](x) for e in range(3))
    torch.testing.assert_close(experts(x, gate), expected)
    only = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(2, 5, 3)
    torch.testing.assert_close(experts(x, only), experts.experts[1](x))


@pytest.mark.parametrize("gate_input", ["coords", "features"])
def test_transformer_with_a_mask_equals_each_sample_alone(gate_input):
    """Padding to a common length leaves the tokens that exist as they were."""
    net = transformer(gate_input=gate_input)
    x, place = tokens(2, 7, 6), tokens(2, 7, 3, seed=1)
    mask = torch.ones(2, 7, dtype=torch.bool)
    mask[1, 4:] = False
    together = net(x, place, mask)
    torch.testing.assert_close(together[:1], net(x[:1], place[:1]))
    torch.testing.assert_close(together[1:, :4], net(x[1:, :4], place[1:, :4]))


def test_shared_coordinates_equal_repeated_ones():
    """Coordinates given once serve every sample."""
    net = transformer()
    x, place = tokens(2, 7, 6), tokens(1, 7, 3, seed=1)
    torch.testing.assert_close(net(x, place), net(x, place.expand(2, -1, -1)))


def test_block_follows_its_order():
    """Cross-attention, experts, self-attention, experts, with the five norms in their places."""
    net = transformer(layers=1)
    x, place = tokens(1, 4, 6), tokens(1, 4, 3, seed=1)
    block, ln = net.blocks[0], net.blocks[0].norms
    gate = block.gate(place).softmax(dim=-1)
    h, z = net.trunk(x), net.branch(place)
    h = h + by_loop(block.cross, ln[0](h)[0], ln[1](z)[0])
    h = h + ln[2](block.cross_experts(h, gate))
    h = h + by_loop(block.own, ln[3](h)[0], ln[3](h)[0])
    h = h + ln[4](block.own_experts(h, gate))
    torch.testing.assert_close(net(x, place), net.out(h))


def test_dropout_acts_in_training_alone():
    """Two training passes differ, two evaluation passes do not."""
    net = transformer(dropout=0.3)
    x, place = tokens(1, 4, 6), tokens(1, 4, 3, seed=1)
    assert torch.equal(net(x, place), net(x, place))
    net.train()
    assert not torch.equal(net(x, place), net(x, place))
