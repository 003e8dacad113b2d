"""The numbers of the paper that our scores stand beside.

Source: arXiv:2407.03925v2, Tables 1 and 3. They were measured on other data (other bodies, more
particles, mostly more frames) and are a scale, not a like-for-like comparison; the two tables do
not agree with each other on every system either.
"""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """One system of Table 1, with its entry of Table 3 where there is one."""

    name: str
    """Name of the system in the paper."""

    frames: int
    """Frames of a rollout."""

    points: int
    """Particles of the full body."""

    sparse_points: int
    """Samples."""

    one_step_mse: float
    """Table 1: one-step error on all particles."""

    rollout_mse: float
    """Table 1: rollout error on all particles."""

    sparse_rollout_mse: float | None = None
    """Table 3: rollout error on the samples."""


PAPER: dict[str, PaperRow] = {
    "water3d": PaperRow(
        name="Water-3D",
        frames=1000,
        points=55_000,
        sparse_points=1_700,
        one_step_mse=5.23e-9,
        rollout_mse=3.86e-4,
        sparse_rollout_mse=1.06e-2,
    ),
    "water2d": PaperRow(
        name="Water-2D",
        frames=1000,
        points=1_000,
        sparse_points=120,
        one_step_mse=5.24e-10,
        rollout_mse=6.7e-3,
    ),
    "sand3d": PaperRow(
        name="Sand-3D",
        frames=400,
        points=32_000,
        sparse_points=1_000,
        one_step_mse=4.87e-9,
        rollout_mse=2.5e-6,
        sparse_rollout_mse=9e-4,
    ),
    "sand2d": PaperRow(
        name="Sand-2D",
        frames=320,
        points=2_000,
        sparse_points=300,
        one_step_mse=8.5e-9,
        rollout_mse=1.34e-3,
    ),
    "goop2d": PaperRow(
        name="Goop-2D",
        frames=400,
        points=1_900,
        sparse_points=200,
        one_step_mse=1.31e-9,
        rollout_mse=9.4e-4,
    ),
    "plasticine3d": PaperRow(
        name="Plasticine",
        frames=320,
        points=5_000,
        sparse_points=1_100,
        one_step_mse=9.74e-10,
        rollout_mse=5e-4,
        sparse_rollout_mse=8e-4,
    ),
    "elastic3d": PaperRow(
        name="Elasticity",
        frames=120,
        points=78_000,
        sparse_points=2_600,
        one_step_mse=5.07e-10,
        rollout_mse=2e-4,
        sparse_rollout_mse=4e-4,
    ),
    "multimaterial2d": PaperRow(
        name="MultiMaterial-2D",
        frames=1000,
        points=2_000,
        sparse_points=250,
        one_step_mse=2.3e-9,
        rollout_mse=9.43e-3,
    ),
}
"""By our name of the system."""


def paper_values(system: str) -> dict[str, Any] | None:
    """The row of a system as JSON values; none if the paper has no such system."""
    row = PAPER.get(system)
    return None if row is None else asdict(row)
