"""Training windows: (trajectory, frame) becomes a sparse state and the positions that follow.

Trajectories are sampled when they are read, several times each with different starts, and only
the samples are kept in memory: positions of a few hundred particles at every frame.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from giorom.graph import Edges, concatenate_edges, connect_points
from giorom.sampling import SamplingConfig, represented_particles, sample
from giorom.state import Body, SparseState, Trajectory, concatenate_states


@dataclass(frozen=True, kw_only=True)
class SampledTrajectory:
    """The samples of one trajectory."""

    motion: Trajectory
    """Motion of the samples alone, an extrapolated past included."""

    reference: Float[Tensor, "q d"]
    """Positions in the undeformed body [m]."""

    edges: Edges | None
    """Graph of the undeformed body, where the graph is fixed."""

    weight: Float[Tensor, " q"] | None = None
    """Full-order particles each sample stands for; ``None``: unknown."""

    body: Body | None = None
    """All particles of the undeformed body; ``None``: unknown."""


@dataclass(frozen=True, kw_only=True)
class WindowBatch:
    """Some windows side by side."""

    state: SparseState
    """History up to the current frame."""

    target: Float[Tensor, "q k d"]
    """Positions at the next k frames [m]."""

    edges: Edges | None
    """Graph of the undeformed bodies, where the graph is fixed."""

    def to(self, device: torch.device | str) -> "WindowBatch":
        """The same batch on ``device``."""
        edges = None if self.edges is None else self.edges.to(device)
        return replace(
            self, state=self.state.to(device), target=self.target.to(device), edges=edges
        )


def sample_trajectories(
    trajectories: Iterable[Trajectory],
    config: SamplingConfig,
    *,
    subsets: int,
    reference_radius: float | None,
    kind: str = "radius",
    past: int = 0,
) -> list[SampledTrajectory]:
    """Sample each trajectory ``subsets`` times.

    Args:
        trajectories: Full-order motion.
        config: How to sample.
        subsets: Different samples per trajectory; the first is the one that use would take.
        reference_radius: Radius of a graph that is fixed in the undeformed body [m]; none where
            the graph follows the current positions.
        kind: Of that graph, as in ``GraphConfig``.
        past: Frames to put before the first one, extrapolated straight from the first two: how a
            scene starts from a shape and a velocity.
    """
    result = []
    for trajectory in trajectories:
        for subset in range(subsets):
            seed = None if subset == 0 else subset
            samples = sample(trajectory.position[0], config, seed=seed)
            weight = represented_particles(trajectory.position[0], samples)
            motion = trajectory.subset(samples)
            reference = motion.position[0].clone()
            edges = None
            if reference_radius is not None:
                batch = torch.zeros(len(reference), dtype=torch.long)
                edges = connect_points(reference, batch, radius=reference_radius, kind=kind)
            motion = replace(motion, position=with_straight_past(motion.position, past))
            result.append(
                SampledTrajectory(
                    motion=motion,
                    reference=reference,
                    edges=edges,
                    weight=weight,
                    body=trajectory.body,
                )
            )
    return result


def with_straight_past(position: Float[Tensor, "t q d"], frames: int) -> Float[Tensor, "s q d"]:
    """Positions with ``frames`` frames of uniform motion put before the first [m]."""
    steps = torch.arange(-frames, 0, dtype=position.dtype)[:, None, None]
    return torch.cat([position[0] + steps * (position[1] - position[0]), position])


class Windows(torch.utils.data.Dataset):
    """All windows of sampled trajectories, addressed by a running number.

    Args:
        trajectories: The sampled trajectories.
        history: Frames before and including the current one.
        future: Frames after it.
        starts: Only the window at the beginning of each trajectory.
    """

    def __init__(
        self,
        trajectories: list[SampledTrajectory],
        *,
        history: int,
        future: int,
        starts: bool = False,
    ) -> None:
        counts = [t.motion.frame_count - history - future + 1 for t in trajectories]
        if not counts or min(counts) < 1:
            shortest = min((t.motion.frame_count for t in trajectories), default=0)
            raise ValueError(
                f"a window needs {history} + {future} frames, but the shortest trajectory has "
                f"{shortest}. Simulate more frames or unroll fewer."
            )
        self.trajectories, self.history, self.future = trajectories, history, future
        self.end = torch.tensor([1] * len(counts) if starts else counts).cumsum(0)

    def __len__(self) -> int:
        """Number of windows."""
        return int(self.end[-1])

    def __getitem__(self, number: int) -> WindowBatch:
        """One window."""
        if not 0 <= number < len(self):
            raise IndexError(f"there is no window {number}; there are {len(self)}.")
        which = int(torch.searchsorted(self.end, number, right=True))
        start = number - (int(self.end[which - 1]) if which else 0)
        sampled = self.trajectories[which]
        return window_at(sampled, start, history=self.history, future=self.future)


def concatenate_windows(windows: list[WindowBatch]) -> WindowBatch:
    """Put windows side by side; the collate function of a data loader."""
    edges = [window.edges for window in windows]
    return WindowBatch(
        state=concatenate_states([window.state for window in windows]),
        target=torch.cat([window.target for window in windows]),
        edges=None if edges[0] is None else concatenate_edges(edges),
    )


def turn(batch: WindowBatch, *, generator: torch.Generator) -> WindowBatch:
    """Turn every scene by a random angle about the vertical and mirror half of them.

    The axis passes through the middle of the domain. This is a symmetry of an isotropic body
    wherever the side walls are out of reach; use it only there. The full-order bodies are dropped,
    as nothing that needs them gains from turning.

    Args:
        batch: Windows in 2-D (mirrored only) or 3-D.
        generator: Source of the angles.
    """
    state = batch.state
    count, dimension = state.batch_size, state.history.shape[-1]
    matrix = torch.eye(dimension).repeat(count, 1, 1)
    if dimension == 3:
        matrix = random_turn(count, generator=generator)
    matrix[:, 0] *= 1.0 - 2.0 * torch.randint(2, (count, 1), generator=generator)
    matrix = matrix.to(state.history)[state.batch]
    center = state.bounds.mean(dim=1)

    def turned(points: Tensor) -> Tensor:
        return torch.einsum("q...d,qed->q...e", points - center, matrix) + center

    state = replace(
        state,
        history=turned(state.history),
        reference=turned(state.reference[:, None])[:, 0],
        bodies=None,
    )
    return replace(batch, state=state, target=turned(batch.target))


def random_turn(count: int, *, generator: torch.Generator) -> Float[Tensor, "b 3 3"]:
    """Rotations about the vertical axis 1 by angles that are equally likely.

    Args:
        count: Number of rotations.
        generator: Source of the angles.
    """
    angle = 2.0 * math.pi * torch.rand(count, generator=generator)
    matrix = torch.eye(3).repeat(count, 1, 1)
    matrix[:, 0, 0] = matrix[:, 2, 2] = angle.cos()
    matrix[:, 0, 2], matrix[:, 2, 0] = angle.sin(), -angle.sin()
    return matrix


class StepSampler(torch.utils.data.Sampler[list[int]]):
    """Batches of window numbers that depend on the seed and the step alone.

    Resuming at a step gives the batches an uninterrupted run would have drawn there.

    Args:
        window_count: Number of windows.
        batch_size: Windows per batch.
        seed: Seed of the run.
        first_step: Step to begin with.
    """

    def __init__(
        self, window_count: int, *, batch_size: int, seed: int, first_step: int = 0
    ) -> None:
        self.window_count, self.batch_size = window_count, batch_size
        self.seed, self.first_step = seed, first_step

    def __iter__(self):
        """Endless batches."""
        step = self.first_step
        while True:
            generator = step_generator(self.seed, step)
            yield torch.randint(self.window_count, (self.batch_size,), generator=generator).tolist()
            step += 1


def step_generator(seed: int, step: int) -> torch.Generator:
    """The random numbers of one training step.

    Torch reads the low 32 bits of a seed alone. Steps of a golden section of that range keep the
    steps of a thousand consecutive seeds apart for a million steps each.
    """
    return torch.Generator().manual_seed((seed * 0x9E3779B1 + step) % 2**32)


def window_at(sampled: SampledTrajectory, start: int, *, history: int, future: int) -> WindowBatch:
    """The window whose oldest frame is ``start``."""
    motion = sampled.motion
    positions = motion.position[start : start + history + future].transpose(0, 1).contiguous()
    state = SparseState(
        history=positions[:, :history],
        reference=sampled.reference,
        particle_type=motion.particle_type,
        batch=torch.zeros(len(positions), dtype=torch.long),
        batch_size=1,
        bounds=motion.bounds,
        frame_dt=motion.frame_dt,
        weight=sampled.weight,
        bodies=None if sampled.body is None else (sampled.body,),
    )
    return WindowBatch(state=state, target=positions[:, history:], edges=sampled.edges)


def free_particles(state: SparseState) -> Int[Tensor, " f"]:
    """Indices of the samples that are not kinematic: those a loss or a metric counts."""
    return (~state.kinematic).nonzero()[:, 0]
