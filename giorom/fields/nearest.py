"""Every point moves as the nearest sample does; nothing to train, and the least a field must beat.

phi(X) = X + u_k with k the sample that is nearest in the undeformed body.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from giorom.fields.contract import Field, FieldDecoder
from giorom.fields.local import WeightDecoder
from giorom.fields.neighbors import body_labels, nearest_samples


@dataclass(frozen=True, kw_only=True)
class NearestConfig:
    """Who can be nearest."""

    same_body: bool = True
    """Whether only samples of the same body count, as in the other fields."""


class NearestField(Field):
    """Displacement of the nearest sample.

    Args:
        config: Who can be nearest.
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, config: NearestConfig, *, dimension: int) -> None:
        super().__init__(dimension=dimension)
        self.config = config

    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,  # noqa: ARG002
    ) -> FieldDecoder:
        """The decoder of one body; see ``Field.bind``."""
        if self.config.same_body:
            labels = body_labels(reference, query, least=self.dimension + 1)
        else:
            labels = tuple(torch.zeros(len(part)).to(part).long() for part in (reference, query))
        index, _ = nearest_samples(reference, query, count=1, labels=labels)
        weights = torch.ones_like(index, dtype=query.dtype)
        return WeightDecoder(reference, query, held=held, index=index, weights=weights)
