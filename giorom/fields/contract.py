"""What every field is: stage 6, from the motion of the samples to that of every particle.

A *field* knows how material moves between samples; ``bind`` ties it to one body and gives a
*decoder*, which takes the positions of the samples frame by frame, in the order of time, and
returns those of all query points. A body at rest stays at rest, and held points never move.

Fields that learn have parameters and a ``loss``; what follows from the training motions in closed
form is set by ``prepare``. A field without parameters is not trained.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from giorom.state import Trajectory


class FieldDecoder(ABC):
    """A field bound to one set of samples and one set of query points.

    A decoder may remember what it was given: the frames come in the order of time, beginning with
    the undeformed body, which need not be given. ``copy.copy`` branches off a decoder with a
    memory of its own, ``restart`` takes it back to the undeformed body.

    Args:
        reference: Undeformed positions of the samples [m].
        query: Undeformed positions of the points to recover [m].
        held: Query points that never move; by default none.

    Raises:
        ValueError: If there are too few samples to determine an affine motion.
    """

    remembers = False
    """Whether the result depends on the frames before."""

    def __init__(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
    ) -> None:
        count, least = len(reference), reference.shape[1] + 1
        if count < least:
            raise ValueError(
                f"a field needs at least {least} samples, which determine an affine motion, got "
                f"{count}. Sample more points."
            )
        self.reference, self.query, self.held = reference, query, held

    def __call__(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """Positions of all query points from those of the samples [m]."""
        recovered = self.recover(position)
        if self.held is None:
            return recovered
        return torch.where(self.held[:, None], self.query, recovered)

    def restart(self) -> None:
        """Forget all frames."""
        return

    @abstractmethod
    def recover(self, position: Float[Tensor, "q d"]) -> Float[Tensor, "p d"]:
        """Positions of the query points as if none of them were held [m]."""


class Field(nn.Module, ABC):
    """How material moves between samples.

    Args:
        dimension: Space dimension, 2 or 3.
    """

    def __init__(self, *, dimension: int) -> None:
        super().__init__()
        self.dimension = dimension

    @property
    def learns(self) -> bool:
        """Whether there are parameters to train by gradient descent on ``loss``."""
        return any(parameter.requires_grad for parameter in self.parameters())

    def prepare(self, trajectories: list[Trajectory]) -> None:  # noqa: ARG002
        """Set what follows from the training motions without an optimiser; by default nothing.

        Args:
            trajectories: Some particles and frames of every training motion; the first frame is
                the undeformed body.
        """
        return

    def loss(
        self,
        reference: Float[Tensor, "p d"],
        displacement: Float[Tensor, "t p d"],
        *,
        solve_count: int,
    ) -> Float[Tensor, ""]:
        """Relative error at some points when only the first ``solve_count`` are known.

        Args:
            reference: Undeformed positions of one body in random order [m].
            displacement: Displacements of the same points at some frames [m].
            solve_count: Number of points that play the part of the samples.
        """
        raise NotImplementedError(f"{type(self).__name__} has nothing to train.")

    @abstractmethod
    def bind(
        self,
        reference: Float[Tensor, "q d"],
        query: Float[Tensor, "p d"],
        *,
        held: Bool[Tensor, " p"] | None = None,
        bounds: Float[Tensor, "d 2"] | None = None,
    ) -> FieldDecoder:
        """The decoder of one body.

        Args:
            reference: Undeformed positions of the samples [m].
            query: Undeformed positions of the points to recover [m].
            held: Query points that never move; by default none.
            bounds: Walls that no point passes [m]; by default none. Only fields that can break
                them look.

        Raises:
            ValueError: If there are too few samples.
        """


def relative_error(
    found: Float[Tensor, "t p d"], displacement: Float[Tensor, "t p d"]
) -> Float[Tensor, ""]:
    """Mean squared error over mean squared displacement, averaged over frames."""
    energy = displacement.double().square().mean(dim=(1, 2)) + 1e-12
    error = (found.double() - displacement.double()).square().mean(dim=(1, 2))
    return (error / energy).mean().to(displacement.dtype)
