"""What a coded field is: a function of the place and of a short code that describes one frame."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

POINTS_AT_ONCE = 1 << 17
"""Points that are decoded together; bounds the memory."""


def check_sizes(record: Any, *, counts: Iterable[str], positive: Iterable[str]) -> None:
    """Reject sizes no network can be built with.

    Args:
        record: A configuration.
        counts: Fields that are at least one.
        positive: Fields that are larger than zero.
    """
    name = type(record).__name__
    for field in counts:
        if getattr(record, field) < 1:
            raise ValueError(f"{name}.{field} must be >= 1, got {getattr(record, field)!r}.")
    for field in positive:
        if not getattr(record, field) > 0.0:
            raise ValueError(f"{name}.{field} must be > 0, got {getattr(record, field)!r}.")


class CodedField(nn.Module, ABC):
    """State at a place, given the code of a frame.

    Args:
        code: Length of the code.
    """

    stores_codes = False
    """Whether training keeps a code for every frame; otherwise codes are functions of the frame."""

    def __init__(self, code: int) -> None:
        super().__init__()
        self.code = code

    @abstractmethod
    def forward(
        self, point: Float[Tensor, "n p d"], code: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n p s"]:
        """State at the points of some frames."""

    @abstractmethod
    def fit(
        self, point: Float[Tensor, "n p d"], state: Float[Tensor, "n p s"]
    ) -> Float[Tensor, "n c"]:
        """Codes that describe the state at some points of some frames; the field is not changed.

        Args:
            point: Places.
            state: State at these places.
        """

    @abstractmethod
    def loss(
        self,
        point: Float[Tensor, "n p d"],
        state: Float[Tensor, "n p s"],
        code: Float[Tensor, "n c"] | None,
    ) -> Float[Tensor, ""]:
        """What training minimises.

        Args:
            point: Places.
            state: State at these places.
            code: The stored codes of the frames, if any are.
        """

    def misfit(self, point: Tensor, state: Tensor, code: Tensor) -> Float[Tensor, ""]:
        """Mean squared error of each frame, summed: each is fitted as it would be alone."""
        return (self(point, code) - state).square().mean(dim=(1, 2)).sum()

    def decode(
        self, point: Float[Tensor, "p d"], code: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n p s"]:
        """State at the same points for many codes, some frames at a time."""
        rows = max(1, POINTS_AT_ONCE // len(point))
        with torch.no_grad():
            parts = [self(point.expand(len(part), -1, -1), part) for part in code.split(rows)]
        return torch.cat(parts)
