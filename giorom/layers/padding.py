"""Scenes of a batch side by side, padded to one length, so that attention keeps them apart.

Particles come as one list with the scene of each (ascending); layers on tokens want a dense array
(b t c) and a mask of the tokens that exist. ``pack`` and ``unpack`` go there and back; they are
inverses of each other on the particles. Where all scenes are equally large nothing is padded, and
there is no mask.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["ScenePadding"]


@dataclass(frozen=True, kw_only=True)
class ScenePadding:
    """Where the particles of each scene stand in the dense array."""

    scenes: int
    """Number of scenes."""

    length: int
    """Particles of the largest scene."""

    slot: Int[Tensor, " q"] | None
    """Place of each particle in the flattened array; the order of the list where None."""

    mask: Bool[Tensor, "b t"] | None
    """False for tokens that do not exist; all exist where None."""

    @classmethod
    def of(cls, batch: Int[Tensor, " q"], batch_size: int) -> "ScenePadding":
        """The padding of a batch.

        Args:
            batch: Scene of each particle, ascending.
            batch_size: Number of scenes.

        Returns:
            The padding.
        """
        if batch_size == 1:
            return cls(scenes=1, length=len(batch), slot=None, mask=None)
        count = torch.bincount(batch, minlength=batch_size)
        length = int(count.max())
        if length * batch_size == len(batch):
            return cls(scenes=batch_size, length=length, slot=None, mask=None)
        place = torch.arange(length, device=batch.device)
        first = count.cumsum(dim=0) - count
        rank = torch.arange(len(batch), device=batch.device) - first[batch]
        return cls(
            scenes=batch_size,
            length=length,
            slot=batch * length + rank,
            mask=place < count[:, None],
        )

    def pack(self, value: Float[Tensor, "q c"]) -> Float[Tensor, "b t c"]:
        """Put each scene in a row of its own; tokens that do not exist are zero."""
        if self.slot is not None:
            rows = value.new_zeros(self.scenes * self.length, value.shape[1])
            value = rows.index_copy(0, self.slot, value)
        return value.unflatten(0, (self.scenes, self.length))

    def unpack(self, token: Float[Tensor, "b t c"]) -> Float[Tensor, "q c"]:
        """Put the tokens that exist back into one list."""
        flat = token.flatten(0, 1)
        return flat if self.slot is None else flat.index_select(0, self.slot)
