"""What every network that accelerates the samples has to offer, whoever invented it.

``pipeline.Dynamics`` wraps a baseline exactly as it wraps ``TimeStepper``: features in, normalised
accelerations out, in training, rollouts and stored simulators alike. Several scenes come in one
``Features`` and must not see each other; the order of the particles must not matter.
"""

from abc import abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from giorom.features import Features


class Baseline(nn.Module):
    """A network from features to normalised accelerations."""

    @abstractmethod
    def forward(self, features: Features) -> Float[Tensor, "q d"]:
        """Predict accelerations.

        Args:
            features: Everything the network sees of a batch.

        Returns:
            Normalised accelerations (dimensionless).
        """

    def coverage(self, position: Float[Tensor, "q d"]) -> Float[Tensor, ""]:
        """Share of the particles that the network's grid reaches; one without a grid.

        Args:
            position: Positions of a batch [m].

        Returns:
            A share between 0 and 1.
        """
        return torch.ones((), device=position.device)
