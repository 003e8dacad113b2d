"""Moving least squares that choose new neighbours where the material has come apart.

For fluids and sand. A point first moves with the samples around it in the undeformed body, as in
``local``. When its neighbourhood has spread by more than a given factor, the point, where it is
now, is tied anew to the samples that are near it now, and moves on with those:

    phi_t(X) = phi_a(X) + sum_k N_k [x_k(t) - x_k(a)],   a = the last frame at which it was tied.

Where a body only bends and turns nothing is ever tied anew and the result is that of ``local``;
tying every point anew in every frame would be advection with the interpolated velocity, whose
errors add up. Points do not leave the domain.

The decoder remembers: frames have to come in the order of time.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from giorom.fields.contract import Field, FieldDecoder
from giorom.fields.local import LocalConfig, polynomial_weights
from giorom.fields.neighbors import body_labels, nearest_samples


@dataclass(frozen=True, kw_only=True)
class TransportConfig:
    """When a neighbourhood is given up, and the size of the next one."""

    spread: float = 1.4
    """Growth of the distance to the farthest neighbour at which a point is tied anew."""

    degree: Literal[1, 2] = 1
    """Degree of the polynomial in a new neighbourhood: two where neighbours stay in order (goop),
    one where they do not (water, sand). The first one has degree two."""

    neighbors: int | None = None
    """Samples in a new neighbourhood; null: as many as ``local`` takes for that degree."""

    def __post_init__(self) -> None:
        """Reject neighbourhoods that hold nothing or never last."""
        if self.neighbors is not None and self.neighbors < 1:
            raise ValueError(f"TransportConfig.neighbors must be >= 1, got {self.neighbors!r}.")
        if not self.spread > 1.0:
            raise ValueError(
                f"TransportConfig.spread is a growth and must be > 1, got {self.spread!r}."
            )

    def count(self, dimension: int) -> int:
        """Samples in a new neighbourhood."""
        return LocalConfig(degree=self.degree, neighbors=self.neighbors).count(dimension)


class TransportField(Field):
    """Moving least squares in the configuration of the last tie.

    Args:
        config: When neighbourhoods are given up.
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, config: TransportConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``."""
        return TransportDecoder(reference, query, held=held, bounds=bounds, config=self.config)


@dataclass(frozen=True, kw_only=True)
class Ties:
    """What every point moves with, and since when."""

    index: Tensor
    """Samples around each point, (p k)."""

    weights: Tensor
    """Their weights, (p k)."""

    base: Tensor
    """Where the point was when it was tied, (p d) [m]."""

    anchor: Tensor
    """Where its samples were then, (p k d) [m]."""

    near: Tensor
    """Which of the first few tell that the neighbourhood has spread, (p c)."""

    radius: Tensor
    """Distance to the farthest of those then, (p) [m]."""

    def replaced(self, rows: Tensor, ties: "Ties") -> "Ties":
        """Ties of some points taken from another record of the same width."""
        names = self.__dataclass_fields__
        return Ties(**{n: getattr(self, n).index_copy(0, rows, getattr(ties, n)) for n in names})


class TransportDecoder(FieldDecoder):
    """A transport field bound to one body.

    Args:
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.
        bounds: Walls [m]; by default none.
        config: When neighbourhoods are given up.
    """

    remembers = True

    def __init__(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None,
        bounds: Float[Tensor, "d 2"] | None,
        config: TransportConfig,
    ) -> None:
        super().__init__(reference, query, held=held)
        dimension = reference.shape[1]
        first = LocalConfig()
        self.config, self.count = config, config.count(dimension)
        self.width = max(self.count, first.count(dimension))
        self.limits = None
        if bounds is not None:
            # A body that begins outside may stay there.
            low = torch.minimum(bounds[:, 0], query.amin(dim=0))
            self.limits = low, torch.maximum(bounds[:, 1], query.amax(dim=0))
        labels = body_labels(reference, query, least=dimension + 1)
        self.first = self._tie(
            reference, query, labels, count=first.count(dimension), degree=first.degree
        )
        self.ties = self.first

    def restart(self) -> None:
        """Go back to the undeformed body."""
        self.ties = self.first

    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """Move every point with its samples, then tie anew those whose samples have parted."""
        ties = self.ties
        place = position[ties.index]
        found = ties.base + torch.einsum("pk,pkd->pd", ties.weights, place - ties.anchor)
        if self.limits is not None:
            found = torch.minimum(torch.maximum(found, self.limits[0]), self.limits[1])
        radius = _farthest(place, found, ties.near)
        rows = (radius > self.config.spread * ties.radius).nonzero()[:, 0]
        if len(rows):
            labels = rows.new_zeros(len(position)), rows.new_zeros(len(rows))
            again = self._tie(
                position, found[rows], labels, count=self.count, degree=self.config.degree
            )
            self.ties = ties.replaced(rows, again)
        return found

    def _tie(
        self,
        sample: Tensor,
        point: Tensor,
        labels: tuple[Tensor, Tensor],
        *,
        count: int,
        degree: int,
    ) -> Ties:
        """Tie points to the samples near them."""
        index, same = nearest_samples(sample, point, count=self.width, labels=labels)
        same[:, count:] = False
        weights = polynomial_weights(sample, point, index, same=same, degree=degree)
        near = same[:, : self.count]
        anchor = sample[index]
        return Ties(
            index=index,
            weights=weights.to(point.dtype),
            base=point,
            anchor=anchor,
            near=near,
            radius=_farthest(anchor, point, near),
        )


def _farthest(
    sample: Float[Tensor, "p k d"], point: Float[Tensor, "p d"], near: Bool[Tensor, "p c"]
) -> Float[Tensor, " p"]:
    """Distance of each point to the farthest of the first few samples around it [m]."""
    offset = sample[:, : near.shape[1]] - point[:, None]
    return offset.norm(dim=2).masked_fill(~near, 0.0).amax(dim=1)
