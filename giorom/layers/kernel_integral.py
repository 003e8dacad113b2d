"""Graph neural operator (GNO): a learned integral from one point set to another.

Equations 6 and 7: at a query point x, integrate a learned kernel over the source points y in a
ball around x. The integration weights are 1 / (number of sources in the ball), so the integral
is a mean, and repeating every source point changes nothing; a query with an empty ball gets
zero. Used twice, from the particles to the latent grid and back. Dimensionless.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.aggregation import Grouping, take, weighted_sum
from giorom.layers.mlp import MLP

__all__ = ["KernelIntegral", "PointPairs"]


@dataclass(frozen=True, kw_only=True)
class PointPairs:
    """Query and source points within reach of each other."""

    query: Grouping
    """Pairs of each query point."""

    source: Grouping
    """Pairs of each source point."""

    relative: Float[Tensor, "m d"]
    """(source - query) / radius of each pair."""

    query_position: Float[Tensor, "n d"]
    """Position of each query point, in any fixed unit of order one."""

    source_position: Float[Tensor, "s d"]
    """Position of each source point in the same unit."""

    def reversed(self) -> "PointPairs":
        """The same pairs with sources as queries."""
        return PointPairs(
            query=self.source,
            source=self.query,
            relative=-self.relative,
            query_position=self.source_position,
            source_position=self.query_position,
        )


class KernelIntegral(nn.Module):
    r"""Integral transform with a learned kernel.

    ``linear``: :math:`u(x) = \frac{1}{|B(x)|} \sum_{y \in B(x)} \kappa(x, y) \odot v(y)`;
    ``nonlinear_kernelonly``:
    :math:`u(x) = \frac{1}{|B(x)|} \sum_{y \in B(x)} \kappa(x, y, v(y))`.

    What the kernel sees of the two places is, with ``relative``, ((y - x) / radius, x); with
    ``official`` it is y alone, as in the official code, which drops the query point. With
    ``reduction="sum"`` the mean over the ball becomes a sum, for sources on a regular grid, of
    which every ball holds about as many.

    Source:
        Equations 6 and 7 of arXiv:2407.03925v2; the names of the transforms are those of the
        neuraloperator library.
    """

    def __init__(
        self,
        hidden: Sequence[int],
        *,
        dimension: int,
        width_in: int,
        width_out: int,
        transform: str,
        kernel: str = "relative",
        reduction: str = "mean",
    ) -> None:
        """Make the kernel network.

        Args:
            hidden: Hidden widths of the kernel network.
            dimension: Space dimension.
            width_in: Channels of the source features.
            width_out: Channels of the result; ``width_in`` for the linear transform.
            transform: ``linear`` or ``nonlinear_kernelonly``.
            kernel: ``relative`` or ``official``.
            reduction: ``mean`` or ``sum`` over the sources in reach.

        Raises:
            ValueError: If the linear transform is to change the number of channels.
        """
        super().__init__()
        self.linear = transform == "linear"
        self.relative = kernel == "relative"
        self.summed = reduction == "sum"
        if self.linear and width_in != width_out:
            raise ValueError(
                f"the linear transform multiplies the features by the kernel channel by channel, "
                f"so width_out must equal width_in={width_in}, got {width_out}. Give both the "
                f"same value or use nonlinear_kernelonly."
            )
        places = (2 if self.relative else 1) * dimension
        seen = places + (0 if self.linear else width_in)
        self.places = places
        self.kernel = MLP([seen, *hidden, width_out], activation=functional.gelu)

    def forward(self, value: Float[Tensor, "s c"], pairs: PointPairs) -> Float[Tensor, "n o"]:
        """Integrate the features of the sources around each query.

        Args:
            value: Features of the source points.
            pairs: Who is near whom.

        Returns:
            Features of the query points.
        """
        weight = pairs.query.mean_weight(dtype=pairs.relative.dtype)
        if self.summed:
            weight = torch.ones_like(weight)
        kernel = self.kernel.finish(self._first_layer(value, pairs))
        if self.linear:
            kernel = kernel * take(value, pairs.source)
        return weighted_sum(kernel, pairs.query, weight)

    def _first_layer(self, value: Tensor, pairs: PointPairs) -> Tensor:
        """First linear layer of the kernel at every pair (m h), its point parts done per point."""
        first = self.kernel.layers[0]
        of_place, of_value = first.weight.tensor_split([self.places], dim=1)
        if self.relative:
            of_relative, of_query = of_place.chunk(2, dim=1)
            hidden = functional.linear(pairs.relative, of_relative, first.bias)
            hidden = hidden + take(functional.linear(pairs.query_position, of_query), pairs.query)
            if self.linear:
                return hidden
            return hidden + take(functional.linear(value, of_value), pairs.source)
        source = pairs.source_position
        if not self.linear:
            source = torch.cat([source, value], dim=-1)
        return take(functional.linear(source, first.weight, first.bias), pairs.source)
