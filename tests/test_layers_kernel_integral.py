"""Kernel integrals against the neuraloperator library and against what a mean must satisfy."""

import warnings

import pytest
import torch
from torch import Tensor

from giorom.layers.aggregation import Grouping
from giorom.layers.kernel_integral import KernelIntegral, PointPairs

RADIUS, DIMENSION, WIDTH = 0.4, 3, 5


@pytest.fixture
def points() -> tuple[Tensor, Tensor, Tensor]:
    """Query places, source places and source features; the last query has an empty ball."""
    generator = torch.Generator().manual_seed(0)
    query = torch.rand(9, DIMENSION, generator=generator)
    query[-1] = 5.0
    source = torch.rand(20, DIMENSION, generator=generator)
    return query, source, torch.randn(20, WIDTH, generator=generator)


def pairs_of(query: Tensor, source: Tensor) -> PointPairs:
    """All pairs within the radius, by a table of distances."""
    near = (query[:, None] - source[None]).norm(dim=-1) <= RADIUS
    at, of = near.nonzero(as_tuple=True)
    return PointPairs(
        query=Grouping.by(at, len(query)),
        source=Grouping.by(of, len(source)),
        relative=(source[of] - query[at]) / RADIUS,
        query_position=query,
        source_position=source,
    )


def make(transform: str, kernel: str = "relative") -> KernelIntegral:
    """A kernel integral of five channels."""
    torch.manual_seed(0)
    return KernelIntegral(
        [7, 6],
        dimension=DIMENSION,
        width_in=WIDTH,
        width_out=WIDTH,
        transform=transform,
        kernel=kernel,
    )


@pytest.mark.parametrize("transform", ["linear", "nonlinear_kernelonly"])
def test_agrees_with_neuraloperator_on_the_same_weights(points, transform):
    """Neuralop's kernel sees (y, x[, f(y)]); ((y - x)/r, x) W is (y, x) with W recombined."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from neuralop.layers.integral_transform import IntegralTransform

    query, source, value = points
    ours, pairs = make(transform), pairs_of(query, source)
    sizes = [layer.in_features for layer in ours.kernel.layers] + [WIDTH]
    theirs = IntegralTransform(
        channel_mlp_layers=sizes,
        transform_type=transform,
        reduction="mean",
        use_torch_scatter=False,
    )
    with torch.no_grad():
        for to, layer in zip(theirs.channel_mlp.fcs, ours.kernel.layers, strict=True):
            to.load_state_dict(layer.state_dict())
        relative, place, rest = ours.kernel.layers[0].weight.tensor_split(
            [DIMENSION, 2 * DIMENSION], dim=1
        )
        recombined = [relative / RADIUS, place - relative / RADIUS, rest]
        theirs.channel_mlp.fcs[0].weight.copy_(torch.cat(recombined, dim=1))
    neighbors = {
        "neighbors_index": pairs.source.point,
        "neighbors_row_splits": pairs.query.offset,
    }
    expected = theirs(y=source, neighbors=neighbors, x=query, f_y=value)
    torch.testing.assert_close(ours(value, pairs), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("transform", ["linear", "nonlinear_kernelonly"])
def test_the_official_kernel_sees_the_source_place_alone(points, transform):
    """Mean of kappa(y[, v(y)]), by a loop over the queries."""
    query, source, value = points
    layer, pairs = make(transform, "official"), pairs_of(query, source)
    seen = source if transform == "linear" else torch.cat([source, value], dim=1)
    kernel = layer.kernel(seen)
    if transform == "linear":
        kernel = kernel * value
    near = (query[:, None] - source[None]).norm(dim=-1) <= RADIUS
    expected = torch.stack(
        [kernel[row].mean(dim=0) if row.any() else torch.zeros(WIDTH) for row in near]
    )
    torch.testing.assert_close(layer(value, pairs), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kernel", ["relative", "official"])
@pytest.mark.parametrize("transform", ["linear", "nonlinear_kernelonly"])
def test_repeating_every_source_changes_nothing(points, transform, kernel):
    """Equation 7 with weights 1/n: the integral does not count points."""
    query, source, value = points
    layer = make(transform, kernel)
    once = layer(value, pairs_of(query, source))
    thrice = layer(value.repeat(3, 1), pairs_of(query, source.repeat(3, 1)))
    torch.testing.assert_close(thrice, once, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("transform", ["linear", "nonlinear_kernelonly"])
def test_a_sum_is_the_mean_times_the_number_of_sources(points, transform):
    """What the library does from grid to particles."""
    query, source, value = points
    pairs, options = pairs_of(query, source), {"dimension": DIMENSION, "width_in": WIDTH}
    summed = KernelIntegral(
        [7, 6], width_out=WIDTH, transform=transform, reduction="sum", **options
    )
    mean = make(transform)
    summed.load_state_dict(mean.state_dict())
    count = pairs.query.count[:, None]
    torch.testing.assert_close(summed(value, pairs), count * mean(value, pairs))


@pytest.mark.parametrize("transform", ["linear", "nonlinear_kernelonly"])
def test_an_empty_ball_gives_zero(points, transform):
    """The last query has no source in reach."""
    query, source, value = points
    result = make(transform)(value, pairs_of(query, source))
    assert not result[-1].any()
    assert result[:-1].any(dim=1).all()


def test_a_linear_transform_that_changes_the_width_is_refused():
    """The kernel multiplies channel by channel."""
    with pytest.raises(ValueError, match="width_out must equal width_in=4, got 6"):
        KernelIntegral([8], dimension=2, width_in=4, width_out=6, transform="linear")
