"""Choose Q of P particles to simulate.

Stage 2 of the pipeline. The choice is made once per scene, on the undeformed body, and kept:
particles are Lagrangian. Farthest point sampling spreads the samples evenly
(arXiv:2407.03925v2, section 5.2); random and stride sampling are its controls.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """How many particles are simulated, and which."""

    method: Literal["farthest", "random", "stride"] = "farthest"
    """Farthest point, uniformly random, or every n-th particle."""

    reduction: float | None = None
    """Particles of the full body per sample; exactly one of ``reduction`` and ``count`` is set."""

    count: int | None = None
    """Number of samples."""

    def __post_init__(self) -> None:
        """Reject contradictory sizes."""
        if (self.reduction is None) == (self.count is None):
            raise ValueError(
                f"SamplingConfig needs exactly one of reduction and count, got reduction="
                f"{self.reduction!r} and count={self.count!r}."
            )
        if self.reduction is not None and not self.reduction >= 1.0:
            raise ValueError(f"SamplingConfig.reduction must be >= 1, got {self.reduction!r}.")
        if self.count is not None and self.count < 1:
            raise ValueError(f"SamplingConfig.count must be >= 1, got {self.count!r}.")

    def sample_count(self, particle_count: int) -> int:
        """Number of samples of a body of ``particle_count`` particles."""
        if self.count is not None:
            return min(self.count, particle_count)
        return max(1, round(particle_count / self.reduction))


def sample(
    position: Float[Tensor, "p d"], config: SamplingConfig, *, seed: int | None = None
) -> Int[Tensor, " q"]:
    """Indices of the particles to simulate, as ``config`` says.

    Args:
        position: Positions of all particles [m].
        config: Method and number.
        seed: Start of farthest point sampling and draw of random sampling; without one,
            farthest point sampling starts at the particle nearest to the centroid.

    Raises:
        ValueError: If there is no particle, or a position is not finite.
    """
    if position.shape[0] == 0:
        raise ValueError("there is no particle to sample from; the body must hold at least one.")
    if not bool(torch.isfinite(position).all()):
        raise ValueError("positions must be finite to be sampled, found NaN or infinity.")
    count = config.sample_count(position.shape[0])
    generator = torch.Generator().manual_seed(0 if seed is None else seed)
    if config.method == "farthest":
        start = None
        if seed is not None:
            start = int(torch.randint(position.shape[0], (), generator=generator))
        return sample_farthest(position, count, start=start)
    if config.method == "random":
        return sample_random(position, count, generator=generator)
    return sample_stride(position, count)


def represented_particles(
    position: Float[Tensor, "p d"], samples: Int[Tensor, " q"]
) -> Float[Tensor, " q"]:
    """How many particles are nearest to each sample, itself included: its share of the mass.

    Args:
        position: Undeformed positions of all particles [m].
        samples: Which of them are samples.

    Returns:
        Counts that add up to p.
    """
    if len(samples) == len(position):
        return position.new_ones(len(samples))
    tree = cKDTree(position[samples].detach().cpu().numpy())
    owner = tree.query(position.detach().cpu().numpy())[1]
    count = torch.bincount(torch.as_tensor(owner), minlength=len(samples))
    return count.to(position)


def sample_farthest(
    position: Float[Tensor, "p d"], count: int, *, start: int | None = None
) -> Int[Tensor, " q"]:
    """Pick points greedily, each the farthest from those already picked.

    Args:
        position: Positions [m].
        count: Number of points to pick, at most p.
        start: First point; by default the one nearest to the centroid.

    Returns:
        Distinct indices in the order of picking: a prefix is the sample of that size.

    Source:
        Eldar et al., "The farthest point strategy for progressive image sampling", IEEE
        Transactions on Image Processing 6(9), 1997.
    """
    _check_count(count, position.shape[0])
    if start is None:
        start = int((position - position.mean(dim=0)).square().sum(dim=1).argmin())
    chosen = torch.empty(count, dtype=torch.long, device=position.device)
    nearest = torch.full_like(position[:, 0], torch.inf)
    current = torch.tensor(start, device=position.device)
    for rank in range(count):
        chosen[rank] = current
        nearest = torch.minimum(nearest, (position - position[current]).square().sum(dim=1))
        nearest[current] = -1.0  # never again, not even among coincident points
        current = nearest.argmax()
    return chosen


def sample_random(
    position: Float[Tensor, "p d"], count: int, *, generator: torch.Generator
) -> Int[Tensor, " q"]:
    """Pick ``count`` distinct points uniformly at random."""
    _check_count(count, position.shape[0])
    order = torch.randperm(position.shape[0], generator=generator)
    return order[:count].to(position.device)


def sample_stride(position: Float[Tensor, "p d"], count: int) -> Int[Tensor, " q"]:
    """Pick ``count`` points at equal steps of the particle index."""
    _check_count(count, position.shape[0])
    return torch.arange(count, device=position.device) * position.shape[0] // count


def _check_count(count: int, available: int) -> None:
    if not 1 <= count <= available:
        raise ValueError(
            f"cannot pick {count} of {available} particles; the number of samples must be between "
            f"1 and {available}."
        )
