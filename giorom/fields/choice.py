"""Which field a simulator uses: the kinds by name, and the settings of each."""

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as default
from typing import Literal

from giorom.fields.autoencoder import AutoencoderConfig, AutoencoderField
from giorom.fields.contract import Field
from giorom.fields.crom import CromConfig, CromField
from giorom.fields.kernel import KernelConfig, KernelField
from giorom.fields.kernel_rom import KernelRomConfig, KernelRomField
from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.nearest import NearestConfig, NearestField
from giorom.fields.neural_basis import NeuralField, NeuralFieldConfig
from giorom.fields.pod import PodConfig, PodField
from giorom.fields.pod_autoencoder import PodAutoencoderConfig, PodAutoencoderField
from giorom.fields.shepard import ShepardConfig, ShepardField
from giorom.fields.transport import TransportConfig, TransportField

FieldKind = Literal[
    "neural_basis",
    "pod",
    "pod_autoencoder",
    "autoencoder",
    "crom",
    "kernel",
    "kernel_rom",
    "nearest",
    "shepard",
    "local",
    "transport",
]
"""Names of the kinds."""


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """Which field recovers all particles; the settings of the other kinds are not looked at."""

    kind: FieldKind = "neural_basis"
    """The kind that is used."""

    neural_basis: NeuralFieldConfig = default(default_factory=NeuralFieldConfig)
    """Linear basis as a neural field (the paper's)."""

    pod: PodConfig = default(default_factory=PodConfig)
    """Linear basis from the singular vectors of the training motions."""

    pod_autoencoder: PodAutoencoderConfig = default(default_factory=PodAutoencoderConfig)
    """Autoencoder of the coefficients of such a basis."""

    autoencoder: AutoencoderConfig = default(default_factory=AutoencoderConfig)
    """Set encoder and coordinate decoder."""

    crom: CromConfig = default(default_factory=CromConfig)
    """Coordinate decoder whose code is solved for."""

    kernel: KernelConfig = default(default_factory=KernelConfig)
    """Learned kernel over the nearest samples."""

    kernel_rom: KernelRomConfig = default(default_factory=KernelRomConfig)
    """The kernel of the paper's third version, as published."""

    nearest: NearestConfig = default(default_factory=NearestConfig)
    """The nearest sample; not trained."""

    shepard: ShepardConfig = default(default_factory=ShepardConfig)
    """Inverse distance weighting; not trained."""

    local: LocalConfig = default(default_factory=LocalConfig)
    """Moving least squares in the undeformed body; not trained."""

    transport: TransportConfig = default(default_factory=TransportConfig)
    """Moving least squares that choose new neighbours as the body flows; not trained."""


KINDS: dict[str, Callable[..., Field]] = {
    "neural_basis": NeuralField,
    "pod": PodField,
    "pod_autoencoder": PodAutoencoderField,
    "autoencoder": AutoencoderField,
    "crom": CromField,
    "kernel": KernelField,
    "kernel_rom": KernelRomField,
    "nearest": NearestField,
    "shepard": ShepardField,
    "local": LocalField,
    "transport": TransportField,
}


def build_field(config: FieldConfig, *, dimension: int) -> Field:
    """The untrained field that a configuration names.

    Args:
        config: Which, and its settings.
        dimension: Space dimension, 2 or 3.
    """
    return KINDS[config.kind](getattr(config, config.kind), dimension=dimension)
