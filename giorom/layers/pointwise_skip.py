"""Accelerations from each particle's own features: a linear map, and one chosen by the rest shape.

For an elastic body the main part of the answer is a displacement times a stiffness, and the
stiffness depends on the proportions of the body alone. A network that sees both only as inputs
has to learn the product; here it is built in, and the rest of the time-stepper corrects it.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.mlp import MLP


class PointwiseSkip(nn.Module):
    """a = (L + G(s)) n, with node features n and their last channels s, the rest shape.

    Args:
        node_width: Channels of the node features.
        dimension: Space dimension.
        gate_width: How many of the last channels describe the undeformed body; 0: no gate.
        hidden: Width of the two hidden layers of the gate.
    """

    def __init__(
        self, node_width: int, dimension: int, *, gate_width: int, hidden: int = 64
    ) -> None:
        super().__init__()
        self.gate_width, self.dimension = gate_width, dimension
        self.linear = nn.Linear(node_width, dimension, bias=False)
        nn.init.zeros_(self.linear.weight)
        self.gate = None
        if gate_width > 0:
            outputs = dimension * (node_width - gate_width)
            self.gate = MLP([gate_width, hidden, hidden, outputs], activation=functional.gelu)
            nn.init.zeros_(self.gate.layers[-1].weight)
            nn.init.zeros_(self.gate.layers[-1].bias)

    def forward(self, node: Float[Tensor, "q c"]) -> Float[Tensor, "q d"]:
        """Normalised accelerations, never in less than the precision of the features."""
        # Sums of terms that nearly cancel: half precision would spoil them.
        with torch.autocast(node.device.type, enabled=False):
            acceleration = self.linear(node)
            if self.gate is None:
                return acceleration
            moving, shape = node[:, : -self.gate_width], node[:, -self.gate_width :]
            gate = self.gate(shape).unflatten(1, (self.dimension, -1))
            return acceleration + torch.einsum("qdc,qc->qd", gate, moving)
