"""What every field must satisfy, whatever it is made of.

A field joins with one line in ``FIELDS``: a factory that takes the space dimension and returns a
module from reference points (p d) to basis vectors (p d r).
"""

from collections.abc import Callable

import pytest
import safetensors.torch
import torch
from torch import Tensor, nn

from giorom.neural_field import FieldDecoder, NeuralField, NeuralFieldConfig, projection_loss


def elu(dimension: int) -> NeuralField:
    """The published activation."""
    return NeuralField(NeuralFieldConfig(modes=6, width=12, depth=2), dimension=dimension)


def sine(dimension: int) -> NeuralField:
    """Sine activation."""
    config = NeuralFieldConfig(modes=6, width=12, depth=2, activation="sine")
    return NeuralField(config, dimension=dimension)


def translating(dimension: int) -> NeuralField:
    """The first modes of this field are the axes, the others are free."""
    field = elu(dimension)
    weight = field.output.weight.data.unflatten(0, (dimension, 6))
    bias = field.output.bias.data.unflatten(0, (dimension, 6))
    weight[:, :dimension] = 0.0
    bias[:, :dimension] = torch.eye(dimension)
    return field


FIELDS: dict[str, Callable[[int], nn.Module]] = {
    "elu": elu,
    "sine": sine,
    "translating": translating,
}

TRANSLATING = {"translating"}
"""Fields whose basis holds the rigid translations."""


@pytest.fixture(params=[f"{name}-{d}d" for name in FIELDS for d in (2, 3)])
def case(request: pytest.FixtureRequest) -> tuple[str, int]:
    """Name of the field and space dimension."""
    name, dimension = request.param.split("-")
    return name, int(dimension[0])


@pytest.fixture
def dimension(case: tuple[str, int]) -> int:
    """Space dimension."""
    return case[1]


@pytest.fixture
def field(case: tuple[str, int]) -> nn.Module:
    """A field in float64."""
    torch.manual_seed(0)
    return FIELDS[case[0]](case[1]).double()


def cloud(count: int, dimension: int, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def test_basis_vectors_belong_to_points_one_by_one(field, dimension):
    """U of a permuted, split or single point is the same vector: points do not mix."""
    points = cloud(40, dimension)
    basis, order = field(points), torch.randperm(40, generator=torch.Generator().manual_seed(1))
    assert basis.shape[:2] == (40, dimension)
    torch.testing.assert_close(field(points[order]), basis[order], rtol=0, atol=1e-13)
    parts = torch.cat([field(part) for part in points.split(7)])
    torch.testing.assert_close(parts, basis, rtol=0, atol=1e-13)


def test_permuting_the_query_permutes_the_motion(field, dimension):
    """Each point is recovered on its own."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    moved = samples + 0.1 * cloud(30, dimension, seed=2)
    expected = FieldDecoder(field, samples, query)(moved)[order]
    found = FieldDecoder(field, samples, query[order])(moved)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_permuting_the_samples_changes_nothing(field, dimension):
    """The samples are a set; rounding over the ridge, 1e-16 / 1e-8, is what may differ."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    moved = samples + 0.1 * cloud(30, dimension, seed=2)
    expected = FieldDecoder(field, samples, query)(moved)
    found = FieldDecoder(field, samples[order], query)(moved[order])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


def test_evaluating_in_chunks_changes_nothing(field, dimension):
    """Chunks bound the memory and no more."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    moved = samples + 0.1 * cloud(30, dimension, seed=2)
    expected = FieldDecoder(field, samples, query)(moved)
    for chunk in (1, 7, 50):
        found = FieldDecoder(field, samples, query, chunk=chunk)(moved)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_a_body_at_rest_stays_at_rest(field, dimension):
    """No displacement of the samples, none of any point: phi(X) = X."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    assert torch.equal(FieldDecoder(field, samples, query)(samples), query)


def test_a_motion_in_the_span_is_recovered_at_samples_and_elsewhere(field, dimension):
    """U = U q at the samples gives U q everywhere, up to the ridge (1e-8)."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    generator = torch.Generator().manual_seed(3)
    basis, at_query = field(samples).detach(), field(query).detach()
    wanted = 0.1 * torch.randn(basis.shape[2], generator=generator, dtype=torch.float64)
    for points, expected in ((samples, basis), (query, at_query)):
        found = FieldDecoder(field, samples, points)(samples + basis @ wanted)
        torch.testing.assert_close(found, points + expected @ wanted, rtol=0, atol=1e-5)


def test_a_rigid_translation_is_reproduced_where_the_basis_can(case, field, dimension):
    """Every point moves as the samples do, up to the ridge (1e-8)."""
    if case[0] not in TRANSLATING:
        pytest.skip("the basis holds no translation")
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    shift = torch.arange(1.0, dimension + 1.0, dtype=torch.float64)
    found = FieldDecoder(field, samples, query)(samples + shift)
    torch.testing.assert_close(found, query + shift, rtol=0, atol=1e-5)


def test_gradients_are_finite_and_reach_every_parameter(field, dimension):
    """Through the least squares of the training loss."""
    motion = torch.stack([cloud(60, dimension, seed=seed) - 0.5 for seed in range(1, 4)])
    projection_loss(field, cloud(60, dimension), motion, solve_count=30).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_saved_and_loaded_weights_give_the_same_basis(case, field, dimension, tmp_path):
    """The state dict is the whole field, its domain included."""
    points = cloud(30, dimension)
    field.set_domain(3.0 * points)
    safetensors.torch.save_file(field.state_dict(), tmp_path / "field.safetensors")
    torch.manual_seed(1)
    other = FIELDS[case[0]](dimension).double()
    other.load_state_dict(safetensors.torch.load_file(tmp_path / "field.safetensors"))
    assert torch.equal(other(points), field(points))


def test_the_input_is_not_changed(field, dimension):
    """Neither the samples, nor the query, nor the positions."""
    samples, query, moved = (cloud(30, dimension, seed=seed) for seed in range(3))
    FieldDecoder(field, samples, query, held=torch.arange(30) < 5)(moved)
    for seed, used in enumerate((samples, query, moved)):
        assert torch.equal(used, cloud(30, dimension, seed=seed))


def test_the_output_has_the_precision_of_the_field(field, dimension):
    """Single precision differs from double by rounding over the conditioning of the basis."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    moved = samples + 0.1 * (cloud(30, dimension, seed=2) - 0.5)
    double = FieldDecoder(field, samples, query)(moved)
    single = FieldDecoder(field.float(), samples.float(), query.float())(moved.float())
    assert (double.dtype, single.dtype) == (torch.float64, torch.float32)
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-3)
