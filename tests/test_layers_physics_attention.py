"""Physics attention against its equations written as loops."""

import math

import pytest
import torch
from torch import Tensor

from giorom.layers.physics_attention import EMPTY_SLICE, PhysicsAttention, PhysicsTransformer

WIDTH, HEADS, SLICES = 8, 2, 3


@pytest.fixture
def attention() -> PhysicsAttention:
    """Two heads of four channels and three slices, with weights of order one, in float64."""
    torch.manual_seed(0)
    layer = PhysicsAttention(WIDTH, heads=HEADS, slices=SLICES).double()
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.copy_(torch.randn_like(parameter))
        layer.temperature.uniform_(0.4, 0.8)
    return layer


@pytest.fixture
def transformer() -> PhysicsTransformer:
    """Two blocks in float64."""
    torch.manual_seed(0)
    net = PhysicsTransformer(
        6, WIDTH, 5, dimension=3, layers=2, heads=HEADS, slices=SLICES, ratio=2
    )
    return net.double().eval()


def tokens(*shape: int, seed: int = 0) -> Tensor:
    """Random tokens."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def by_loop(attention: PhysicsAttention, token: Tensor) -> Tensor:
    """Slice, attend, read back: one head, one slice and one token at a time."""
    size = WIDTH // HEADS
    read = torch.zeros_like(token)
    for head in range(HEADS):
        part = slice(head * size, (head + 1) * size)
        shares = []
        for x in token:
            score = attention.slice.weight @ attention.place(x)[part] + attention.slice.bias
            score = (score / attention.temperature[head]).flatten().exp()
            shares.append(score / score.sum())
        means = []
        for g in range(SLICES):
            moment = sum(
                w[g] * attention.content(x)[part] for w, x in zip(shares, token, strict=True)
            )
            means.append(moment / (sum(w[g] for w in shares) + EMPTY_SLICE))
        for g in range(SLICES):
            asked = attention.query.weight @ means[g]
            logits = [asked @ (attention.key.weight @ z) / math.sqrt(size) for z in means]
            part_of = torch.stack(logits).exp() / sum(value.exp() for value in logits)
            told = sum(
                p * (attention.value.weight @ z) for p, z in zip(part_of, means, strict=True)
            )
            for n, w in enumerate(shares):
                read[n, part] += w[g] * told
    return attention.out(read)


def test_attention_agrees_with_the_loop(attention):
    """Five tokens in each of three samples."""
    token = tokens(3, 5, WIDTH)
    with torch.no_grad():
        expected = torch.stack([by_loop(attention, sample) for sample in token])
        torch.testing.assert_close(attention(token), expected)


def test_attention_is_one_matrix_between_the_tokens(attention):
    """With A between the slices, x' = W A (W^T / (W^T 1 + eps)) f, a dense T x T matrix."""
    token, size = tokens(7, WIDTH), WIDTH // HEADS
    heads = []
    for head in range(HEADS):
        part = slice(head * size, (head + 1) * size)
        logits = attention.slice(attention.place(token)[:, part]) / attention.temperature[head]
        share = logits.softmax(dim=1)
        average = (share / (share.sum(dim=0) + EMPTY_SLICE)).T
        mean = average @ attention.content(token)[:, part]
        between = (attention.query(mean) @ attention.key(mean).T / math.sqrt(size)).softmax(dim=1)
        matrix = share @ between @ average
        heads.append(matrix @ attention.content(token)[:, part] @ attention.value.weight.T)
    expected = attention.out(torch.cat(heads, dim=1))
    torch.testing.assert_close(attention(token[None])[0], expected)


def test_tokens_of_a_mask_do_not_exist(attention):
    """Masking equals leaving out."""
    token = tokens(1, 7, WIDTH)
    mask = torch.tensor([[True, False, True, True, False, False, True]])
    torch.testing.assert_close(attention(token, mask)[:, mask[0]], attention(token[:, mask[0]]))


def test_a_sample_without_tokens_is_finite(attention):
    """The slices are zero, not 0 / 0, and so are the gradients."""
    token = tokens(1, 2, WIDTH).requires_grad_()
    attention(token, torch.zeros(1, 2, dtype=torch.bool)).sum().backward()
    assert token.grad.isfinite().all()


def test_repeating_every_token_changes_little(attention):
    """Slices are means: only the constant beside their weight sees how many tokens there are."""
    token = tokens(1, 9, WIDTH)
    once, thrice = attention(token), attention(token.repeat(1, 3, 1))[:, :9]
    torch.testing.assert_close(thrice, once, rtol=1e-3, atol=1e-3)


def test_heads_have_to_divide_the_width():
    """A head of two and a half channels is refused with both numbers."""
    with pytest.raises(ValueError, match=r"heads=4 does not divide width=10"):
        PhysicsAttention(10, heads=4, slices=3)


def test_transformer_follows_its_order(transformer):
    """Embedding of place and token; twice attention and network, pre-normed; norm; projection."""
    token, place = tokens(1, 5, 6), tokens(1, 5, 3, seed=1)
    h = transformer.embed(torch.cat([place, token], dim=-1))
    with torch.no_grad():
        for block in transformer.blocks:
            before, after = block.norms
            h = h + by_loop(block.attention, before(h)[0])
            first, last = block.pointwise.layers
            h = h + last(torch.nn.functional.gelu(first(after(h))))
        expected = transformer.out(transformer.norm(h))
        torch.testing.assert_close(transformer(token, place), expected)


def test_transformer_with_a_mask_equals_each_sample_alone(transformer):
    """Padding to a common length leaves the tokens that exist as they were."""
    token, place = tokens(2, 7, 6), tokens(2, 7, 3, seed=1)
    mask = torch.ones(2, 7, dtype=torch.bool)
    mask[1, 4:] = False
    together = transformer(token, place, mask)
    torch.testing.assert_close(together[:1], transformer(token[:1], place[:1]))
    torch.testing.assert_close(together[1:, :4], transformer(token[1:, :4], place[1:, :4]))


def test_shared_coordinates_equal_repeated_ones(transformer):
    """Coordinates given once serve every sample."""
    token, place = tokens(2, 7, 6), tokens(1, 7, 3, seed=1)
    torch.testing.assert_close(
        transformer(token, place), transformer(token, place.expand(2, -1, -1))
    )


def test_gradients_reach_every_parameter(transformer):
    """No parameter is dead."""
    transformer(tokens(2, 7, 6), tokens(1, 7, 3, seed=1)).square().sum().backward()
    for name, parameter in transformer.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
