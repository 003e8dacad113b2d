"""How many of the training samples the latent grid reaches; a dead branch is refused.

A particle farther from every grid node than the nodes reach gets nothing from the latent grid, and
nothing in the loss says so: message passing learns alone.
"""

import math
from typing import Protocol, runtime_checkable

from torch import Tensor

from giorom.data.windows import Windows, step_generator, turn
from giorom.time_stepper import TimeStepper
from giorom.training.training_config import TrainingConfig

COVERAGE_WINDOWS = 64
"""Windows on which the coverage is measured."""


@runtime_checkable
class Network(Protocol):
    """What the coverage of a network, ours or a baseline, is measured with."""

    def coverage(self, position: Tensor) -> Tensor:
        """Share of the particles that its grid reaches; one without a grid."""


def check_coverage(time_stepper: Network, windows: Windows, config: TrainingConfig) -> float:
    """Refuse to train a network whose latent branch too many samples never see.

    Args:
        time_stepper: Network with its grid.
        windows: Training windows.
        config: Whether windows are turned, and the least coverage.

    Returns:
        Share of the samples that the grid reaches.

    Raises:
        ValueError: If it is below ``config.least_coverage``.
    """
    share = measure_coverage(time_stepper, windows, turned=config.turn)
    if share >= config.least_coverage:
        return share
    raise ValueError(
        f"the latent grid reaches {100.0 * share:.1f} % of the samples of the training windows, "
        f"less than training.least_coverage={config.least_coverage:g}: the others would learn "
        f"without it. {_remedy(time_stepper)}, and "
        f"training.least_coverage: {math.floor(100.0 * share) / 100.0:g} accepts this one."
    )


def _remedy(time_stepper: Network) -> str:
    """How a network gets a grid that reaches further."""
    if not isinstance(time_stepper, TimeStepper):
        return "In baseline.overrides, give its grid a longer reach or more nodes"
    grid = time_stepper.latent.grid
    return (
        f"Its nodes reach {grid.reach:g} m and need {grid.covering_radius:g} m to "
        f"leave no gap. In time_stepper.overrides, set latent_radius to null, so that it follows "
        f"from the grid, and latent_bounds to the bounds of the data, as the default network has "
        f"them, or raise latent_side; latent: false trains without a grid"
    )


def measure_coverage(time_stepper: Network, windows: Windows, *, turned: bool) -> float:
    """Share of the samples of some training windows that have a grid node within reach."""
    shares = []
    for number in range(0, len(windows), max(1, len(windows) // COVERAGE_WINDOWS)):
        window = windows[number]
        if turned:
            window = turn(window, generator=step_generator(0, number))
        shares.append(float(time_stepper.coverage(window.state.position)))
    return sum(shares) / len(shares)
