"""Which field a simulator uses: the kinds by name, and the settings of each."""

from dataclasses import dataclass
from dataclasses import field as default
from typing import Literal

from giorom.fields.contract import Field
from giorom.fields.local import LocalConfig, LocalField
from giorom.fields.neural_basis import NeuralField, NeuralFieldConfig

FieldKind = Literal["neural_basis", "local"]
"""Names of the kinds."""


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """Which field recovers all particles; the settings of the other kinds are not looked at."""

    kind: FieldKind = "neural_basis"
    """The kind that is used."""

    neural_basis: NeuralFieldConfig = default(default_factory=NeuralFieldConfig)
    """Linear basis as a neural field (the paper's)."""

    local: LocalConfig = default(default_factory=LocalConfig)
    """Moving least squares in the undeformed body."""


def build_field(config: FieldConfig, *, dimension: int) -> Field:
    """The untrained field that a configuration names.

    Args:
        config: Which, and its settings.
        dimension: Space dimension, 2 or 3.
    """
    kinds = {"neural_basis": NeuralField, "local": LocalField}
    return kinds[config.kind](getattr(config, config.kind), dimension=dimension)
