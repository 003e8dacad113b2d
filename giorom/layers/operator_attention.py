"""The neural operator transformer (NOT) that processes the latent grid.

Heterogeneous normalised attention, linear in the number of tokens, and pointwise experts mixed
by a gate that knows the place. The attention is a convex mean over the source tokens, hence a
quadrature of a global kernel integral that does not depend on how many tokens there are.
Tokens come in a dense array (b t c); a mask marks the ones that exist. Dimensionless.
"""

from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from giorom.layers.mlp import MLP, ResidualMLP

__all__ = ["GatedExperts", "NormalizedAttention", "OperatorBlock", "OperatorTransformer"]


class NormalizedAttention(nn.Module):
    r"""Linear attention between two token sets, one head per slice of the channels.

    .. math::
        \tilde q_t = \mathrm{softmax}(W_q x_t), \quad
        \tilde k_s = \mathrm{softmax}(W_k y_s), \quad
        z_t = \tilde q_t
            + \frac{\sum_s (\tilde q_t \cdot \tilde k_s)\, W_v y_s}
                   {\sum_s \tilde q_t \cdot \tilde k_s},

    with the softmax over the channels of the head (not over tokens), then a linear layer.

    Source:
        Hao et al., "GNOT", ICML 2023 (arXiv:2302.14376), heterogeneous normalised attention.
    """

    def __init__(self, width: int, *, heads: int, dropout: float = 0.0) -> None:
        """Make the four linear maps.

        Args:
            width: Channels of the tokens; a multiple of ``heads``.
            heads: Number of heads.
            dropout: Share of the mixed values set to zero in training.
        """
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        target: Float[Tensor, "b t c"],
        source: Float[Tensor, "#b s c"],
        mask: Bool[Tensor, "b s"] | None = None,
    ) -> Float[Tensor, "b t c"]:
        """Let each target token read from the source tokens of its sample.

        Args:
            target: Tokens that ask.
            source: Tokens that answer.
            mask: False for source tokens that do not exist.

        Returns:
            New features of the target tokens.
        """
        query = self._split(self.query(target)).softmax(dim=-1)
        key = self._split(self.key(source)).softmax(dim=-1)
        value = self._split(self.value(source))
        if mask is not None:
            key = key * mask[:, None, :, None]
        total = key.sum(dim=2, keepdim=True)
        weight = (query * total).sum(dim=-1, keepdim=True)
        weight = weight + (weight == 0)  # a sample without tokens reads zero
        content = query @ (key.transpose(-1, -2) @ value)
        mixed = self.dropout(query + content / weight)
        return self.out(mixed.transpose(1, 2).flatten(2))

    def _split(self, value: Tensor) -> Tensor:
        """Put the heads in front of the tokens: (b t c) to (b heads t c/heads)."""
        return value.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class GatedExperts(nn.Module):
    r"""Several pointwise networks mixed by a gate, :math:`\sum_e g_e\, \mathrm{FFN}_e(x)`."""

    def __init__(self, width: int, *, experts: int, hidden: int) -> None:
        """Make the networks.

        Args:
            width: Channels of the tokens.
            experts: Number of networks.
            hidden: Hidden channels of each network.
        """
        super().__init__()
        self.experts = nn.ModuleList(
            MLP([width, hidden, width], activation=functional.gelu) for _ in range(experts)
        )

    def forward(
        self, value: Float[Tensor, "b t c"], gate: Float[Tensor, "b t n"]
    ) -> Float[Tensor, "b t c"]:
        """Mix what the experts say.

        Args:
            value: Tokens.
            gate: Share of each expert.

        Returns:
            The mixture.
        """
        parts = zip(gate.split(1, dim=-1), self.experts, strict=True)
        return sum(share * expert(value) for share, expert in parts)


class OperatorBlock(nn.Module):
    """Cross-attention to the coordinates, experts, self-attention, experts.

    Source:
        arXiv:2407.03925v2, section 4.3 and appendix C.1, in the order of the official code:
        attention inputs are normalised, and so are the outputs (not the inputs) of the experts.
    """

    def __init__(
        self,
        width: int,
        gate_width: int,
        *,
        heads: int,
        experts: int,
        expert_hidden: int,
        dropout: float,
        gate_hidden: int | None = None,
    ) -> None:
        """Make the sub-layers.

        Args:
            width: Channels of the tokens.
            gate_width: Channels of what the gate sees.
            heads: Attention heads.
            experts: Networks of each mixture.
            expert_hidden: Hidden channels of each network.
            dropout: Share of what the attention mixes, and again of what it gives, that is set to
                zero in training.
            gate_hidden: Hidden channels of the gate; None means ``width``.
        """
        super().__init__()
        hidden = [gate_hidden or width] * 2
        self.gate = None  # one expert needs none
        if experts > 1:
            self.gate = MLP([gate_width, *hidden, experts], activation=functional.gelu)
        self.cross = NormalizedAttention(width, heads=heads, dropout=dropout)
        self.own = NormalizedAttention(width, heads=heads, dropout=dropout)
        self.cross_experts = GatedExperts(width, experts=experts, hidden=expert_hidden)
        self.own_experts = GatedExperts(width, experts=experts, hidden=expert_hidden)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(5))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        token: Float[Tensor, "b t c"],
        branch: Float[Tensor, "#b s c"],
        place: Float[Tensor, "#b t g"],
        mask: Bool[Tensor, "b t"] | None = None,
    ) -> Float[Tensor, "b t c"]:
        """Update the tokens.

        Args:
            token: Tokens.
            branch: Embedded coordinates of the tokens.
            place: What the gate sees of each token.
            mask: False for tokens that do not exist.

        Returns:
            The new tokens.
        """
        of_token, of_branch, of_cross, of_self, of_own = self.norms
        gate = self._shares(place).expand(token.shape[0], -1, -1)
        token = token + self.dropout(self.cross(of_token(token), of_branch(branch), mask))
        token = token + of_cross(self.cross_experts(token, gate))
        calm = of_self(token)
        token = token + self.dropout(self.own(calm, calm, mask))
        return token + of_own(self.own_experts(token, gate))

    def _shares(self, place: Tensor) -> Tensor:
        """Share of each expert."""
        if self.gate is None:
            return place.new_ones(*place.shape[:2], 1)
        return self.gate(place).softmax(dim=-1)


class OperatorTransformer(nn.Module):
    """Embed the tokens and their coordinates, run the blocks, project."""

    def __init__(
        self,
        width_in: int,
        width: int,
        width_out: int,
        *,
        dimension: int,
        layers: int,
        depth: int = 1,
        heads: int,
        experts: int,
        expert_hidden: int,
        gate_input: str,
        dropout: float = 0.0,
    ) -> None:
        """Make the networks.

        Args:
            width_in: Channels of the incoming tokens.
            width: Channels inside.
            width_out: Channels of the outgoing tokens.
            dimension: Space dimension of the coordinates.
            layers: Number of blocks.
            depth: Residual layers of each embedding.
            heads: Attention heads.
            experts: Networks of each mixture.
            expert_hidden: Hidden channels of each network.
            gate_input: ``coords`` (GNOT) or ``features`` (official code): what gates the experts.
            dropout: Share of what the attention mixes, and again of what it gives, that is set to
                zero in training.
        """
        super().__init__()
        self.gate_on_coordinates = gate_input == "coords"
        gate_width = dimension if self.gate_on_coordinates else width_in
        self.trunk = ResidualMLP(width_in, width, width, depth=depth)
        self.branch = ResidualMLP(dimension, width, width, depth=depth)
        self.blocks = nn.ModuleList(
            OperatorBlock(
                width,
                gate_width,
                heads=heads,
                experts=experts,
                expert_hidden=expert_hidden,
                dropout=dropout,
            )
            for _ in range(layers)
        )
        self.out = ResidualMLP(width, width, width_out, depth=depth)

    def forward(
        self,
        token: Float[Tensor, "b t c"],
        coordinate: Float[Tensor, "#b t d"],
        mask: Bool[Tensor, "b t"] | None = None,
    ) -> Float[Tensor, "b t o"]:
        """Process the tokens of each sample.

        Args:
            token: Features on the grid.
            coordinate: Coordinates of the tokens in units of the grid, 0 to 1.
            mask: False for tokens that do not exist; what is returned for them means nothing.

        Returns:
            New features on the grid.
        """
        place = coordinate if self.gate_on_coordinates else token
        state, branch = self.trunk(token), self.branch(coordinate)
        for block in self.blocks:
            state = block(state, branch, place, mask)
        return self.out(state)
