"""What simple linear predictors know of the samples' motion, and how far a stiffness goes.

    python tools/predictability.py DATA [--trajectories 24]

First table: share of the variance of the accelerations explained by one linear regression over all
training bodies. Second: rollouts of held-out bodies whose every sample is a spring, the stiffness
fitted to the body's own motion (an oracle), against holding still.
"""

import argparse
import sys
from pathlib import Path

import torch
from torch import Tensor

from giorom.data.trajectory_file import read_trajectory, trajectory_count
from giorom.graph import radius_edges
from giorom.sampling import SamplingConfig, sample

RADIUS = 0.067
"""Neighbourhood of the averages [m]."""

SAMPLING = SamplingConfig(reduction=20)
FRAMES = range(8, 140, 12)
ROLLOUT = 100


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--trajectories", type=int, default=24)
    arguments = parser.parse_args()
    count = min(arguments.trajectories, trajectory_count(arguments.data, "train"))
    pairs = [regressors(arguments.data, index) for index in range(count)]
    inputs, targets = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    rows = {
        "velocity, displacement": (0, 1),
        "last 1 acceleration": (2,),
        "last 2 accelerations": (2, 3),
        "last 3 accelerations": (2, 3, 4),
        "last 3 and their neighbour means": (2, 3, 4, 5, 6, 7),
    }
    for name, columns in rows.items():
        sys.stdout.write(f"{name:35s} {explained(inputs[..., list(columns)], targets):.3f}\n")
    held_out = min(8, trajectory_count(arguments.data, "valid"))
    for name, matrix in (("one stiffness per body", False), ("one matrix per body", True)):
        ratio = spring_ratio(arguments.data, held_out, matrix=matrix)
        sys.stdout.write(f"{name:35s} holding still / error = {ratio:.1f}\n")
    return 0


def regressors(folder: Path, index: int) -> tuple[Tensor, Tensor]:
    """Inputs (n, d, k) and accelerations (n, d) of the free samples of one training body."""
    body = read_trajectory(folder, "train", index)
    body = body.subset(sample(body.position[0], SAMPLING))
    x, free = body.position.double(), ~body.kinematic
    edges = radius_edges(body.position[0], torch.zeros(len(free), dtype=torch.long), RADIUS)
    degree = (edges.offset[1:] - edges.offset[:-1]).double()[:, None]

    def mean(value: Tensor) -> Tensor:
        total = torch.zeros_like(value).index_add(0, edges.receiver, value[edges.sender])
        return total / degree

    change = x[2:] - 2.0 * x[1:-1] + x[:-2]
    inputs, targets = [], []
    for frame in FRAMES:
        past = [change[frame - 1 - lag] for lag in (1, 2, 3)]
        columns = [x[frame] - x[frame - 1], x[frame] - x[0], *past, *map(mean, past)]
        inputs.append(torch.stack(columns, dim=2)[free])
        targets.append(change[frame - 1][free])
    return torch.cat(inputs), torch.cat(targets)


def explained(inputs: Tensor, targets: Tensor) -> float:
    """Share of the sum of squares that a linear map, the same for every axis, explains."""
    matrix, wanted = inputs.flatten(0, 1), targets.flatten()
    weight = torch.linalg.lstsq(matrix, wanted[:, None]).solution[:, 0]
    return 1.0 - float((matrix @ weight - wanted).square().sum() / wanted.square().sum())


def spring_ratio(folder: Path, bodies: int, *, matrix: bool) -> float:
    """Summed error of holding still over that of the fitted springs."""
    still = error = 0.0
    for index in range(bodies):
        body = read_trajectory(folder, "valid", index)
        body = body.subset(sample(body.position[0], SAMPLING))
        u = (body.position - body.position[0]).double()[:, ~body.kinematic]
        move = fit_spring(u, matrix=matrix)
        before, now = u[0] - (u[1] - u[0]), u[0]
        for frame in range(1, ROLLOUT + 1):
            before, now = now, 2.0 * now - before + move(now, now - before)
            error += float((now - u[frame]).square().sum(dim=1).mean())
            still += float(u[frame].square().sum(dim=1).mean())
    return still / error


def fit_spring(u: Tensor, *, matrix: bool):
    """Acceleration from displacement and velocity, fitted to the motion ``u`` itself."""
    shown, moved = u[1:-1], u[1:-1] - u[:-2]
    wanted = u[2:] - 2.0 * u[1:-1] + u[:-2]
    if matrix:
        inputs = torch.cat([shown, moved], dim=2).flatten(0, 1)
        weight = torch.linalg.lstsq(inputs, wanted.flatten(0, 1)).solution
        return lambda x, v: torch.cat([x, v], dim=1) @ weight
    inputs = torch.stack([shown.flatten(), moved.flatten()], dim=1)
    stiffness, damping = torch.linalg.lstsq(inputs, wanted.flatten()[:, None]).solution[:, 0]
    return lambda x, v: stiffness * x + damping * v


if __name__ == "__main__":
    sys.exit(main())
