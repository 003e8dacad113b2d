"""Rollouts of trained models that differ from the trained ones in one thing: graph or samples.

What a picture shows of a rollout is kept as JSON values, so that it is computed once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.rollout import SparseRollout, roll_out
from giorom.graph import Edges
from giorom.pipeline import Connect, start_from_trajectory
from giorom.reproduce.study import Study, Trial
from giorom.reproduce.tuning import tuned
from giorom.simulator import Simulator
from giorom.state import Trajectory

DECIMALS = 5
"""Digits behind the point of a kept position [m]: a hundredth of a millimetre."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A rollout from the first frames of a trajectory, and the truth beside it."""

    given: Float[Tensor, "w q d"]
    """Positions at the frames the model starts from [m]."""

    rollout: SparseRollout
    """What it predicts."""

    truth: Float[Tensor, "t q d"]
    """What the solver says of the same samples at the same frames [m]."""

    edges: Edges
    """Graph of the first step."""

    @property
    def mse(self) -> float | None:
        """Mean squared distance to the truth [m^2]; none for a rollout that diverged."""
        if self.rollout.diverged_at is not None:
            return None
        return float((self.rollout.position - self.truth).square().sum(dim=2).mean())


def first_test_trajectory(study: Study, system: str) -> Trajectory:
    """The trajectory of the test split that pictures show."""
    return next(iterate_trajectories(study.dataset(system), "test")).to(study.device)


def trained_model(study: Study, name: str) -> Simulator | None:
    """The model of a training that has been made; none where every validation rollout diverged.

    Args:
        study: Where it is kept.
        name: Name of the training's folder.
    """
    run = study.shared / "models" / name / "run"
    if not (run / "simulator").is_dir():
        return None
    return Simulator.from_pretrained(run).to(study.device)


def train_tuned(study: Study, trials: list[Trial]) -> list[str]:
    """Make trainings with the learning rate and noise chosen for their methods.

    Args:
        study: Where they are kept.
        trials: What is trained.

    Returns:
        Name of the folder of each.
    """
    chosen = tuned(study, trials)
    study.train_all(chosen, score=False)
    return [study.folder(trial).name for trial in chosen]


def roll(
    simulator: Simulator,
    trajectory: Trajectory,
    *,
    samples: Int[Tensor, " q"],
    frames: int,
    connect: Connect | None = None,
) -> Case:
    """Roll a model out from the first frames of a trajectory.

    Args:
        simulator: The model.
        trajectory: Truth of all particles.
        samples: Which are simulated.
        frames: Frames to predict; fewer where the trajectory is shorter.
        connect: Another graph than the trained one.
    """
    history = simulator.config.features.history
    frames = min(frames, trajectory.frame_count - history)
    state = start_from_trajectory(trajectory, samples, history=history)
    truth = trajectory.position[history : history + frames, samples]
    connect = simulator.connect if connect is None else connect
    rollout = roll_out(
        state, frames, connect=connect, step=simulator.dynamics.step, prescribed=truth
    )
    return Case(
        given=trajectory.position[:history, samples],
        rollout=rollout,
        truth=truth,
        edges=connect(state),
    )


def plain(position: Float[Tensor, "*n d"]) -> list:
    """Positions as JSON values [m]."""
    return position.detach().cpu().double().round(decimals=DECIMALS).tolist()


def joined_components(edges: Edges) -> int:
    """Connected components of a graph, the direction of its edges aside."""
    import numpy as np
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(edges.offset) - 1
    ends = (edges.sender.cpu().numpy(), edges.receiver.cpu().numpy())
    matrix = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count))
    return int(connected_components(matrix, directed=False)[0])


def edges_between(edges: Edges) -> Int[Tensor, "e 2"]:
    """The pairs of different particles that are joined, each once."""
    pairs = torch.stack([edges.sender, edges.receiver], dim=1).sort(dim=1).values
    return pairs[pairs[:, 0] < pairs[:, 1]].unique(dim=0)
