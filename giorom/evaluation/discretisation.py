"""One trained model at other numbers of samples.

Fewer samples than in training: the graph radius and its unit, or the spacing of the grid, grow
with the distance between samples, because what connects them would fall apart otherwise. More
samples: all stays as trained, so that each sample sees the same neighbourhood, more densely filled.
"""

from dataclasses import replace
from typing import Any

from giorom.evaluation.evaluate import evaluate_trajectory
from giorom.simulator import Simulator, SimulatorConfig
from giorom.state import Trajectory


def rebuilt(simulator: Simulator, config: SimulatorConfig) -> Simulator:
    """The weights of a simulator under another configuration.

    Raises:
        RuntimeError: If the weights do not fit it.
    """
    result = Simulator(config)
    result.load_state_dict(simulator.state_dict())
    return result.eval().requires_grad_(False)


def widened(simulator: Simulator, factor: float) -> Simulator:
    """The same weights with a graph radius, which is the unit of the features, or a grid wider.

    Args:
        simulator: The model.
        factor: New over trained length.
    """
    config = simulator.config
    graph = replace(config.graph, radius=factor * config.graph.radius)
    grid = config.grid_stepper
    if grid is not None:
        grid = replace(grid, spacing=factor * grid.spacing)
    # The grid of a body has nothing to do with the number of samples.
    return rebuilt(simulator, replace(config, graph=graph, grid_stepper=grid))


def at_density(simulator: Simulator, factor: float) -> Simulator:
    """The model for ``factor`` times as many samples of a body as in training."""
    if factor >= 1.0:
        return simulator
    return widened(simulator, factor ** (-1.0 / simulator.config.dimension))


def evaluate_at_density(
    simulator: Simulator, trajectory: Trajectory, factor: float, *, frames: int | None = None
) -> dict[str, Any]:
    """Scores of ``evaluate_trajectory`` with other samples, and the ``radius`` used [m].

    Args:
        simulator: The model of ``at_density``, with the same factor.
        trajectory: Full-order truth.
        factor: Number of samples over the trained one; all particles at most.
        frames: Frames to predict; by default all there are.
    """
    points = trajectory.position.shape[1]
    wanted = round(factor * simulator.config.sampling.sample_count(points))
    scores = evaluate_trajectory(
        simulator, trajectory, frames=frames, sparse_points=max(1, min(points, wanted))
    )
    return scores | {"radius": simulator.config.graph.radius}
