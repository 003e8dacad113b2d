"""Networks of other methods behind the contract of the time-stepper's, one file per kind."""

from giorom.baselines.choice import (
    BaselineChoice,
    BaselineConfig,
    BaselineKind,
    build_baseline,
    reads_edges,
)
from giorom.baselines.contract import Baseline
from giorom.baselines.shape import NetworkShape

__all__ = [
    "Baseline",
    "BaselineChoice",
    "BaselineConfig",
    "BaselineKind",
    "NetworkShape",
    "build_baseline",
    "reads_edges",
]
