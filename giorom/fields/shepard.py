"""Inverse distance weighting over the nearest samples; nothing to train.

phi(X) = X + sum_k N_k(X) u_k with N_k proportional to |X - X_k|^-p over the nearest samples of the
same body in the undeformed body. A sample keeps its own displacement.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from giorom.fields.contract import Field, FieldDecoder
from giorom.fields.local import WeightDecoder
from giorom.fields.neighbors import body_labels, nearest_samples


@dataclass(frozen=True, kw_only=True)
class ShepardConfig:
    """Size of the neighbourhoods."""

    neighbors: int = 8
    """Samples in a neighbourhood."""

    power: float = 2.0
    """Power p of the distance."""

    def __post_init__(self) -> None:
        """Reject neighbourhoods that hold nothing and weights that do not fall."""
        if self.neighbors < 1:
            raise ValueError(f"ShepardConfig.neighbors must be >= 1, got {self.neighbors!r}.")
        if not self.power > 0.0:
            raise ValueError(f"ShepardConfig.power must be > 0, got {self.power!r}.")


class ShepardField(Field):
    """Inverse distance weighting.

    Args:
        config: Size of the neighbourhoods.
        dimension: Space dimension, 2 or 3.

    Source:
        Shepard, "A two-dimensional interpolation function for irregularly-spaced data", Proc.
        23rd ACM National Conference, 1968.
    """

    def __init__(self, config: ShepardConfig, *, dimension: int) -> None:
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
        labels = body_labels(reference, query, least=self.dimension + 1)
        index, same = nearest_samples(reference, query, count=self.config.neighbors, labels=labels)
        distance = (reference.double()[index] - query[:, None].double()).norm(dim=2)
        weights = inverse_distance_weights(distance, same, power=self.config.power)
        return WeightDecoder(reference, query, held=held, index=index, weights=weights)


def inverse_distance_weights(
    distance: Float[Tensor, "p k"], valid: Bool[Tensor, "p k"], *, power: float
) -> Float[Tensor, "p k"]:
    """Normalised d^-p; all of it on the samples at distance zero where there are any.

    Args:
        distance: Distances to the samples, the nearest first [m].
        valid: Which of them count.
        power: Power p.
    """
    nearest = distance[:, :1]
    # In units of the nearest distance, so that no power overflows.
    ratio = torch.where(distance <= nearest, 1.0, nearest / distance.clamp_min(1e-300))
    weight = ratio.pow(power) * valid
    return weight / weight.sum(dim=1, keepdim=True)
