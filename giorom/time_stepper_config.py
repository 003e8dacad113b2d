"""Size and variant of the network: what the paper and its ablations switch on and off."""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from giorom.state import PARTICLE_TYPE_COUNT


@dataclass(frozen=True, kw_only=True)
class TimeStepperConfig:
    """Size and variant of the network. ``paper`` and ``default`` give complete ones."""

    dimension: int
    """Space dimension, 2 or 3."""

    node_width: int
    """Channels of ``Features.node``."""

    edge_width: int
    """Channels of ``Features.edge``; the first dimension + 1 are the relative position."""

    particle_types: int = PARTICLE_TYPE_COUNT
    """Number of particle types."""

    embedding: int = 16
    """Channels of the particle-type embedding."""

    hidden: int = 128
    """Channels of node and edge features."""

    mlp_depth: int = 3
    """Linear layers of each network on nodes and edges."""

    layers_before: int = 2
    """Message-passing layers before the latent grid."""

    layers_after: int = 2
    """Message-passing layers after the latent grid."""

    distance_weight: bool = True
    """Weigh messages with 1 / (1 + length / radius) (official code; not in the paper)."""

    node_skip: Literal["none", "linear"] = "none"
    """Extra linear map beside each node update (what the official graph convolution does)."""

    latent: bool = True
    """Use the latent grid; without it the network is message passing alone."""

    processor: Literal[
        "transformer", "fourier", "fourier_plane", "transolver", "convolution", "none"
    ] = "transformer"
    """What works on the grid: the operator transformer (NOT), a Fourier operator (FNO) in as many
    dimensions as the body or, for 3-D bodies, on a plane they are mapped to (the paper's first
    version), a transformer of slices (Transolver), convolutions, or a linear map of each node
    alone."""

    latent_skip: bool = True
    """Add what the grid says to the node features (official 3-D code), or let it replace them
    (official 2-D code and first version)."""

    gno_input: Literal["features", "acceleration"] = "features"
    """What goes to the grid: the node features, or accelerations decoded from them (official 2-D
    code and first version)."""

    latent_bounds: list[list[float]] = field(default_factory=list)
    """First and last grid node on each axis [m]; should contain every particle. A plane of nodes
    lies on [-1, 1]; what is mapped to it are places in units of these bounds."""

    latent_padding: float = 0.0
    """How far the grid goes beyond ``latent_bounds`` on each side, as a share of their width. A
    Fourier operator takes the grid for periodic: without some room opposite walls are neighbours.
    """

    latent_side: int = 16
    """Grid nodes along each axis."""

    latent_radius: float | None = None
    """Reach of a grid node [m], on a plane in units of its own; None means 1.5 times half the
    diagonal of a cell."""

    occupied_tokens: bool = True
    """Process only the grid nodes some particle reaches; all of them otherwise (paper)."""

    gno_layers: Literal[1, 2] = 1
    """Kernel integrals on each way. The one that is always there leads from the particles to the
    grid, or back. A second stands beside it on the side of the particles and integrates over those
    joined by an edge of the interaction graph, so that kernel integrals do what message passing
    does in an interaction operator (our reading of "2GNO", which the paper does not explain)."""

    gno_kernel: Literal["relative", "official"] = "relative"
    """What the kernels see: offset and query place, or the source place alone."""

    gno_in_hidden: list[int] = field(default_factory=lambda: [32, 64])
    """Hidden widths of the kernel from particles to grid."""

    gno_out_hidden: list[int] = field(default_factory=lambda: [32, 64])
    """Hidden widths of the kernel from grid to particles."""

    latent_width: int = 64
    """Channels on the grid before the processor."""

    transformer_width: int = 256
    """Channels inside the transformer."""

    transformer_layers: int = 1
    """Blocks of the transformer."""

    transformer_mlp_depth: int = 1
    """Residual layers of the transformer's embedding networks."""

    heads: int = 4
    """Attention heads."""

    experts: int = 2
    """Networks in each gated mixture."""

    expert_hidden: int | None = None
    """Hidden channels of an expert; None means ``transformer_width``."""

    gate_input: Literal["coords", "features"] = "coords"
    """What gates the experts: place (GNOT) or grid features (official code)."""

    dropout: float = 0.0
    """Dropout in the attention, before and after its last map (the official code uses 0.3)."""

    fourier_width: int = 32
    """Channels inside the Fourier operator."""

    fourier_layers: int = 2
    """Layers of the Fourier operator."""

    fourier_modes: int = 8
    """Frequencies kept along each axis; those a grid of ``latent_side`` nodes cannot hold are
    never used."""

    fourier_hidden: int = 32
    """Hidden channels where the Fourier operator lifts and projects."""

    slices: int = 64
    """Slices of each head of a transformer of slices, which has the width, the layers and the
    heads of the operator transformer."""

    convolution_width: int = 64
    """Channels inside the convolutions."""

    convolution_layers: int = 6
    """Convolutional layers; they see one, two and four nodes far in turn."""

    input_skip: Literal["none", "linear", "gated"] = "none"
    """Add accelerations from each particle's own features: a linear map, or one that the rest
    shape of the body chooses as well (``PointwiseSkip``)."""

    gate_width: int = 0
    """Last channels of ``Features.node``, the rest shape, that choose the gated map."""

    projection_layers: int = 1
    """Linear layers between grid and particle features."""

    projection_width: int = 256
    """Hidden channels of the projection, if it has more than one layer."""

    def __post_init__(self) -> None:
        """Reject what no network can be built from."""
        self._check_choices()
        self._check_counts()
        if self.latent:
            self._check_latent()

    @classmethod
    def paper(
        cls, dimension: int = 3, *, node_skip: bool | str = True, **overrides: Any
    ) -> "TimeStepperConfig":
        """The published model, 2,387,669 parameters in three dimensions, 3,493,686 in two.

        In three dimensions that of the checkpoints, in two that of the official configuration,
        whose grid reads decoded accelerations, replaces the node features and, being on
        [-1, 1]^2, reaches 43 % of the unit square.

        Args:
            dimension: Space dimension.
            node_skip: With the linear skip of the official code (2,321,621 parameters without),
                or the value of the field.
            **overrides: Fields to change.

        Returns:
            The configuration.
        """
        three = dimension == 3
        if isinstance(node_skip, bool):
            node_skip = "linear" if node_skip else "none"
        values: dict[str, Any] = {
            "dimension": dimension,
            "node_width": 7 * dimension,
            "edge_width": dimension + 1,
            "node_skip": node_skip,
            "latent_bounds": [[0.0, 1.0]] * 3 if three else [[-1.0, 1.0]] * 2,
            "latent_side": 16 if three else 32,
            "latent_radius": 0.065 if three else 0.024,
            "occupied_tokens": False,
            "gno_kernel": "official",
            "gate_input": "features",
            "dropout": 0.3,
        }
        if not three:
            values |= {
                "latent_width": 32,
                "transformer_layers": 2,
                "gno_input": "acceleration",
                "latent_skip": False,
            }
        return cls(**(values | overrides))

    @classmethod
    def default(
        cls, dimension: int = 3, *, latent_bounds: list[list[float]], **overrides: Any
    ) -> "TimeStepperConfig":
        """The recommended model: kernels that see offsets, a grid that reaches every particle.

        Args:
            dimension: Space dimension.
            latent_bounds: First and last grid node on each axis [m]: the padded domain.
            **overrides: Fields to change.

        Returns:
            The configuration.
        """
        values: dict[str, Any] = {
            "dimension": dimension,
            "node_width": 7 * dimension,
            "edge_width": dimension + 1,
            "latent_bounds": latent_bounds,
            "latent_side": 16 if dimension == 3 else 32,
        }
        return cls(**(values | overrides))

    def _check_choices(self) -> None:
        choices = {
            "dimension": (2, 3),
            "node_skip": ("none", "linear"),
            "processor": get_args(type(self).__annotations__["processor"]),
            "gno_layers": (1, 2),
            "gno_input": ("features", "acceleration"),
            "gno_kernel": ("relative", "official"),
            "gate_input": ("coords", "features"),
            "input_skip": ("none", "linear", "gated"),
        }
        for name, allowed in choices.items():
            value = getattr(self, name)
            if value not in allowed:
                raise ValueError(
                    f"TimeStepperConfig.{name} must be one of {allowed}, got {value!r}."
                )
        if self.input_skip == "gated" and not 0 < self.gate_width < self.node_width:
            raise ValueError(
                f"TimeStepperConfig.gate_width must be between 0 and node_width="
                f"{self.node_width} for a gated skip, got {self.gate_width!r}. Switch "
                f"features.rest_shape on."
            )
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(
                f"TimeStepperConfig.dropout is a share and must be in [0, 1), got "
                f"{self.dropout!r}. 0 switches it off."
            )

    def _check_counts(self) -> None:
        positive = (
            "node_width edge_width particle_types embedding hidden mlp_depth latent_width "
            "transformer_width heads experts projection_layers projection_width fourier_width "
            "fourier_layers fourier_modes fourier_hidden slices convolution_width "
            "convolution_layers"
        ).split()
        natural = "layers_before layers_after transformer_layers transformer_mlp_depth".split()
        for least, names in ((1, positive), (0, natural)):
            for name in names:
                if getattr(self, name) < least:
                    raise ValueError(
                        f"TimeStepperConfig.{name} must be >= {least}, got {getattr(self, name)!r}."
                    )
        if self.edge_width < self.dimension + 1:
            raise ValueError(
                f"TimeStepperConfig.edge_width={self.edge_width} has no room for the relative "
                f"position and its length; it must be >= dimension + 1 = {self.dimension + 1}."
            )

    def _check_processor(self) -> None:
        whole = self.processor.startswith("fourier") or self.processor == "convolution"
        if whole and self.occupied_tokens:
            raise ValueError(
                f"TimeStepperConfig.processor={self.processor!r} needs every node of the grid, but "
                f"occupied_tokens=True leaves out those no particle reaches. Set "
                f"occupied_tokens to False."
            )
        if self.processor == "fourier_plane" and self.dimension != 3:
            raise ValueError(
                f"TimeStepperConfig.processor='fourier_plane' maps 3-D bodies to a plane, but "
                f"dimension={self.dimension}. Use processor 'fourier'."
            )
        plain = self.gno_input == "features" and self.processor != "fourier_plane"
        if self.gno_layers == 2 and not plain:
            raise ValueError(
                f"TimeStepperConfig.gno_layers=2 integrates node features over the graph before "
                f"they go to a grid in space, but gno_input is {self.gno_input!r} and processor "
                f"{self.processor!r}. Set gno_input to 'features' and the processor to another, "
                f"or gno_layers to 1."
            )

    def _check_latent(self) -> None:
        self._check_processor()
        if self.transformer_width % self.heads:
            raise ValueError(
                f"TimeStepperConfig.heads={self.heads} must divide "
                f"transformer_width={self.transformer_width}."
            )
        if self.latent_side < 2:
            raise ValueError(
                f"TimeStepperConfig.latent_side must be >= 2 nodes, got {self.latent_side!r}. "
                f"latent=False switches the grid off."
            )
        if not 0.0 <= self.latent_padding <= 1.0:
            raise ValueError(
                f"TimeStepperConfig.latent_padding is a share of the width of latent_bounds and "
                f"must be in [0, 1], got {self.latent_padding!r}. 0.125 is enough for a Fourier "
                f"operator."
            )
        ordered = all(len(pair) == 2 and pair[0] < pair[1] for pair in self.latent_bounds)
        if len(self.latent_bounds) != self.dimension or not ordered:
            raise ValueError(
                f"TimeStepperConfig.latent_bounds must be {self.dimension} pairs [low, high] in "
                f"metres with low < high, got {self.latent_bounds!r}. Give the padded bounds of "
                f"the data."
            )
        if self.latent_radius is not None and not self.latent_radius > 0.0:
            raise ValueError(
                f"TimeStepperConfig.latent_radius must be > 0 m, got {self.latent_radius!r}. "
                f"None chooses one that reaches every particle."
            )
