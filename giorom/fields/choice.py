"""Which field a simulator uses: the kinds by name, and the settings of each."""

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as default
from typing import Literal

from giorom.fields.autoencoder import AutoencoderConfig, AutoencoderField
from giorom.fields.contract import Field
from giorom.fields.kernel import KernelConfig, KernelField
from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.neural_basis import NeuralField, NeuralFieldConfig
from giorom.fields.pod import PodConfig, PodField
from giorom.fields.transport import TransportConfig, TransportField

FieldKind = Literal["neural_basis", "pod", "autoencoder", "kernel", "local", "transport"]
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

    autoencoder: AutoencoderConfig = default(default_factory=AutoencoderConfig)
    """Set encoder and coordinate decoder."""

    kernel: KernelConfig = default(default_factory=KernelConfig)
    """Learned kernel over the nearest samples."""

    local: LocalConfig = default(default_factory=LocalConfig)
    """Moving least squares in the undeformed body; not trained."""

    transport: TransportConfig = default(default_factory=TransportConfig)
    """Moving least squares that choose new neighbours as the body flows; not trained."""


KINDS: dict[str, Callable[..., Field]] = {
    "neural_basis": NeuralField,
    "pod": PodField,
    "autoencoder": AutoencoderField,
    "kernel": KernelField,
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
