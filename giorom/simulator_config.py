"""Everything about a trained simulator except its weights.

One record of the parts, each beside the code it steers, and the rule that they fit together.
"""

import math
from dataclasses import dataclass

from giorom.baselines import BaselineConfig, NetworkShape, reads_edges
from giorom.body_stepper import BodyStepperConfig
from giorom.features import FeatureConfig
from giorom.fields import FieldConfig
from giorom.graph import GraphConfig
from giorom.grid_stepper import GridStepperConfig
from giorom.mpm.scene_config import SceneConfig
from giorom.mpm.simulate import SolverConfig
from giorom.normalization import Normalization
from giorom.sampling import SamplingConfig
from giorom.time_stepper import TimeStepperConfig


@dataclass(frozen=True, kw_only=True)
class SimulatorConfig:
    """Everything about a trained simulator except its weights."""

    system: str
    """Physical system it was trained on."""

    dimension: int
    """Space dimension."""

    frame_dt: float
    """Time between frames [s]."""

    bounds: list[list[float]]
    """Lower and upper wall on each axis [m]."""

    sampling: SamplingConfig
    """Stage 2."""

    graph: GraphConfig
    """Stage 3; the radius is set."""

    features: FeatureConfig
    """Stage 3b."""

    normalization: Normalization
    """Scales of the training data."""

    field: FieldConfig
    """Stage 6."""

    scene: SceneConfig
    """Scenes it was trained on; what a demonstration draws from."""

    solver: SolverConfig
    """Simulator that made its training data: the referee."""

    time_stepper: TimeStepperConfig | None = None
    """Stages 4 and 5, the network and semi-implicit Euler; or none."""

    grid_stepper: GridStepperConfig | None = None
    """Stages 4 and 5 by a coarse grid instead of a network; or none."""

    body_stepper: BodyStepperConfig | None = None
    """Stages 4 and 5 by a grid fixed to the undeformed body; or none."""

    baseline: BaselineConfig | None = None
    """Stages 4 and 5 by another method's network in the place of ``time_stepper``; or none."""

    def __post_init__(self) -> None:
        """Reject parts that do not fit together."""
        if not 0.0 < self.frame_dt < math.inf:
            raise ValueError(
                f"SimulatorConfig.frame_dt must be > 0 s and finite, got {self.frame_dt!r}. Copy "
                f"the model again."
            )
        if not all(len(b) == 2 and -math.inf < b[0] < b[1] < math.inf for b in self.bounds):
            raise ValueError(
                f"SimulatorConfig.bounds must be pairs [low, high] in metres with low < high, got "
                f"{self.bounds!r}. Copy the model again."
            )
        found = {
            "bounds": len(self.bounds),
            "normalization": len(self.normalization.velocity_std),
            "scene.dimension": self.scene.dimension,
        }
        for name, dimension in found.items():
            if dimension != self.dimension:
                raise ValueError(
                    f"SimulatorConfig.dimension is {self.dimension}, but {name} is made for "
                    f"{dimension}. All parts need the same one."
                )
        names = ("time_stepper", "grid_stepper", "body_stepper", "baseline")
        if sum(getattr(self, name) is not None for name in names) != 1:
            raise ValueError(
                "SimulatorConfig needs exactly one of time_stepper, grid_stepper, body_stepper and "
                "baseline: one of them moves the samples."
            )
        if self.time_stepper is not None:
            self._check_network(self.time_stepper, "time_stepper")
        if self.baseline is not None:
            self._check_network(self.baseline.shape, "baseline.shape")

    @property
    def reads_edges(self) -> bool:
        """Whether what moves the samples looks at their graph; a grid does not."""
        if self.baseline is not None:
            return reads_edges(self.baseline)
        return self.time_stepper is not None

    def _check_network(self, network: TimeStepperConfig | NetworkShape, name: str) -> None:
        if network.dimension != self.dimension:
            raise ValueError(
                f"SimulatorConfig.dimension is {self.dimension}, but {name}.dimension is "
                f"made for {network.dimension}. All parts need the same one."
            )
        widths = (network.node_width, network.edge_width)
        features = self.features
        wanted = (features.node_width(self.dimension), features.edge_width(self.dimension))
        if widths != wanted:
            raise ValueError(
                f"the features have {wanted} channels per node and edge, but "
                f"SimulatorConfig.{name} takes {widths}. Both come from the same training."
            )
