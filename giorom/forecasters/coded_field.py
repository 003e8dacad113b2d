"""What a coded field is: a function of the place and of a short code that describes one frame."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

POINTS_AT_ONCE = 1 << 17
"""Points that are decoded together; bounds the memory."""


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

    def decode(
        self, point: Float[Tensor, "p d"], code: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n p s"]:
        """State at the same points for many codes, some frames at a time."""
        rows = max(1, POINTS_AT_ONCE // len(point))
        with torch.no_grad():
            parts = [self(point.expand(len(part), -1, -1), part) for part in code.split(rows)]
        return torch.cat(parts)
