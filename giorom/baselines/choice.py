"""Which baseline accelerates the samples: the kinds by name, and the settings of each.

A kind joins with its name in ``BaselineKind``, a field of ``BaselineConfig`` and a line in
``KINDS``. Its record holds the settings alone; what follows from the features and the data is the
``NetworkShape`` that every kind gets. Packages of the extra ``baselines`` are imported where a
network is made, not here.
"""

import dataclasses
import typing
from dataclasses import dataclass
from dataclasses import field as default
from typing import Any, Literal

from torch import nn

from giorom.baselines.gat import GAT, GATConfig
from giorom.baselines.gino import GINO, GINOConfig
from giorom.baselines.gnot import GNOT, GNOTConfig
from giorom.baselines.gns import GNS, GNSConfig
from giorom.baselines.ipot import IPOT, IPOTConfig
from giorom.baselines.linear import Linear, LinearConfig
from giorom.baselines.operator import OperatorConfig, OperatorStepper
from giorom.baselines.shape import NetworkShape
from giorom.baselines.transolver import Transolver, TransolverConfig
from giorom.baselines.unet import UNet, UNetConfig
from giorom.features import FeatureConfig
from giorom.records import parse_fields

BaselineKind = Literal[
    "linear", "gns", "gat", "gino", "gnot", "ipot", "transolver", "operator", "unet"
]
"""Names of the kinds."""


@dataclass(frozen=True, kw_only=True)
class BaselineConfig:
    """Everything about a baseline but its weights; the records of the other kinds are null."""

    kind: BaselineKind
    """The kind that is used."""

    shape: NetworkShape
    """What follows from the features and the data."""

    linear: LinearConfig | None = None
    """A linear map of the features."""

    gns: GNSConfig | None = None
    """Message passing with sums."""

    gat: GATConfig | None = None
    """Graph attention."""

    gnot: GNOTConfig | None = None
    """Cross-attention from the particles to the particles, with gated experts."""

    ipot: IPOTConfig | None = None
    """Latent vectors that read all particles."""

    transolver: TransolverConfig | None = None
    """Attention among learned slices of the particles."""

    operator: OperatorConfig | None = None
    """The paper's operator transformer on the particles."""

    gino: GINOConfig | None = None
    """Kernel integrals to a grid with Fourier blocks and back."""

    unet: UNetConfig | None = None
    """A U-Net on a grid that the particles are spread on."""

    def __post_init__(self) -> None:
        """Reject a record that is missing or belongs to another kind."""
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if given != [self.kind]:
            raise ValueError(
                f"BaselineConfig.kind is {self.kind!r}, but the records given are {given}. Give "
                f"that of the kind and no other."
            )

    @property
    def settings(self) -> Any:
        """The record of the kind."""
        return getattr(self, self.kind)


KINDS: dict[str, type[nn.Module]] = {
    "linear": Linear,
    "gns": GNS,
    "gat": GAT,
    "gino": GINO,
    "gnot": GNOT,
    "ipot": IPOT,
    "transolver": Transolver,
    "operator": OperatorStepper,
    "unet": UNet,
}
"""The network of each kind, made from its record and a ``NetworkShape``."""

WITHOUT_EDGES: frozenset[str] = frozenset(
    {"gino", "gnot", "ipot", "transolver", "operator", "unet"}
)
"""Kinds that read no edges: their graph is never built."""


def build_baseline(config: BaselineConfig) -> nn.Module:
    """The untrained network that a configuration describes."""
    return KINDS[config.kind](config.settings, config.shape)


def reads_edges(config: BaselineConfig) -> bool:
    """Whether the network looks at the graph of the samples."""
    return config.kind not in WITHOUT_EDGES


def settings_type(kind: str) -> type:
    """The record that holds the settings of a kind."""
    annotation = typing.get_type_hints(BaselineConfig)[kind]
    return next(a for a in typing.get_args(annotation) if dataclasses.is_dataclass(a))


@dataclass(frozen=True, kw_only=True)
class BaselineChoice:
    """Which baseline is trained in the place of the time-stepper's network."""

    kind: BaselineKind
    """The kind."""

    preset: Literal["matched", "published"] = "matched"
    """About as many parameters as the others (1.6 million in space), or the size its authors
    chose."""

    overrides: dict[str, Any] = default(default_factory=dict)
    """Settings of the kind to change."""

    def __post_init__(self) -> None:
        """Reject settings the kind does not have."""
        self._settings()

    def build(
        self, *, dimension: int, features: FeatureConfig, bounds: list[list[float]]
    ) -> BaselineConfig:
        """The full configuration.

        Args:
            dimension: Space dimension.
            features: Which features it sees.
            bounds: Padded bounds of the training data [m].
        """
        shape = NetworkShape(
            dimension=dimension,
            node_width=features.node_width(dimension),
            edge_width=features.edge_width(dimension),
            bounds=bounds,
        )
        return BaselineConfig(kind=self.kind, shape=shape, **{self.kind: self._settings()})

    def _settings(self) -> Any:
        """The record of the kind with the overrides, their types checked."""
        record = settings_type(self.kind)
        values = parse_fields(record, self.overrides, where="baseline.overrides")
        chosen = record.published() if self.preset == "published" else record()
        return dataclasses.replace(chosen, **values)
