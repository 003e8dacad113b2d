"""What can be told from a few frames of somebody's motion: small judgements on plain arrays.

Each function answers one question (how far apart are the particles, is row i still particle i, on
what grid do the numbers lie, does everything fall alike) from positions or their differences, and
says nothing where the data do not answer it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from giorom.graph import nearest_points

MOST_POINTS = 200_000
"""Points a search for neighbours takes in; of more, the ones around the middle."""

MOST_DRAWN = 4096
"""Particles that medians are taken over."""

FEW_VALUES = 100
"""Below so many numbers no grid is recognised."""

FLIGHT_SPREAD = 0.05
"""Largest spread of accelerations, relative to their median, that counts as flying freely."""

SHUFFLED_STEP, SHUFFLED_RATIO = 1.5, 0.4
"""How far typical neighbours part in one frame, in spacings and in parts of what strangers do,
where rows are shuffled."""


@dataclass(frozen=True, kw_only=True)
class Neighbors:
    """Each particle (of some) and the one nearest to it."""

    particle: Int[np.ndarray, " n"]
    """Row of the particle."""

    nearest: Int[np.ndarray, " n"]
    """Row of its nearest neighbour."""

    spacing: float
    """Median distance between the two [m]; zero where most coincide."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """The grid that stored numbers lie on."""

    step: float
    """Distance of neighbouring grid points at the typical position [m]."""

    name: str
    """What made it: ``float32``, ``float16``, ``3 decimals`` ..."""

    typical: float
    """Root mean square of the coordinates [m]."""

    @property
    def acceleration_noise(self) -> float:
        """Deviation that rounding gives a second difference [m/frame^2].

        Three independent errors of variance step^2 / 12 with weights 1, -2, 1 add to step^2 / 2.
        """
        return self.step / np.sqrt(2.0)


def nearest_neighbors(position: Float[np.ndarray, "p d"]) -> Neighbors | None:
    """Nearest neighbours of the particles; none if there are fewer than two.

    Args:
        position: Finite positions [m].
    """
    rows = np.arange(len(position))
    if len(rows) > MOST_POINTS:
        distance = np.square(position - np.median(position, axis=0)).sum(axis=1)
        rows = np.argpartition(distance, MOST_POINTS)[:MOST_POINTS]
    if len(rows) < 2:
        return None
    drawn = np.arange(0, len(rows), max(1, len(rows) // MOST_DRAWN))
    distance, nearest = nearest_points(position[rows], drawn)
    return Neighbors(
        particle=rows[drawn], nearest=rows[nearest], spacing=float(np.median(distance))
    )


def rows_are_shuffled(step: Float[np.ndarray, "p d"], neighbors: Neighbors) -> bool | None:
    """Whether rows changed their particle between two frames; None: nothing moved.

    In a motion neighbours move alike. Where rows are shuffled, the step of a row is the way to
    another particle, and unlike its neighbour's by many spacings, nearly as much as a stranger's.

    Args:
        step: Displacement of every row from one frame to the next [m].
        neighbors: Neighbours in the former frame.
    """
    own, near = step[neighbors.particle], step[neighbors.nearest]
    if not np.abs(own).max(initial=0.0) > 0.0:
        return None
    strangers = float(np.median(np.linalg.norm(own - np.roll(own, len(own) // 2, axis=0), axis=1)))
    relative = float(np.median(np.linalg.norm(own - near, axis=1)))
    far = relative > SHUFFLED_STEP * neighbors.spacing
    return bool(len(own) > 3 and far and relative > SHUFFLED_RATIO * strangers)


def jumping_rows(
    before: Float[np.ndarray, " p"],
    step: Float[np.ndarray, " p"],
    after: Float[np.ndarray, " p"],
    *,
    spacing: float,
) -> Bool[np.ndarray, " p"]:
    """Rows that jump in one frame and move quietly before and after it.

    Args:
        before: Lengths of the steps to the frame before [m].
        step: Lengths of the steps in question [m].
        after: Lengths of the steps after it [m].
        spacing: Distance between neighbouring particles [m].
    """
    return step > 5.0 * np.maximum(np.maximum(before, after), spacing)


def common_acceleration(
    acceleration: Float[np.ndarray, "p d"], *, noise: float
) -> Float[np.ndarray, " d"] | None:
    """The acceleration nearly all particles share, if they do: gravity in free flight.

    Args:
        acceleration: Second differences of free particles [m/frame^2].
        noise: What rounding alone does [m/frame^2].
    """
    if len(acceleration) == 0:
        return None
    rows = acceleration[:: max(1, len(acceleration) // MOST_DRAWN)]
    median = np.median(rows, axis=0)
    size = float(np.linalg.norm(median))
    spread = float(np.median(np.linalg.norm(rows - median, axis=1)))
    return median if size > 20.0 * noise and spread < FLIGHT_SPREAD * size else None


def grid_of(values: Float[np.ndarray, " n"]) -> Grid | None:
    """The coarsest known grid that all ``values`` lie on; None for too few of them.

    Args:
        values: Finite coordinates, in the precision they came in [any unit].
    """
    values = values[:: max(1, len(values) // 20_000)]
    if len(values) < FEW_VALUES or not np.any(values):
        return None
    single = np.abs(values).astype(np.float32)
    typical = np.float32(np.sqrt(np.mean(np.square(single.astype(np.float64)))))
    fine = float(np.spacing(typical))
    for decimals in range(8):
        step = 10.0**-decimals
        if step > 8.0 * fine and np.all(np.abs(values - np.round(values, decimals)) <= fine):
            return Grid(step=step, name=f"{decimals} decimals", typical=float(typical))
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    if np.all(np.isfinite(half)) and np.all(half == values):
        return Grid(
            step=float(np.spacing(np.float16(typical))), name="float16", typical=float(typical)
        )
    if np.all(values.astype(np.float32) == values):
        return Grid(step=fine, name="float32", typical=float(typical))
    step = float(np.spacing(np.float64(typical)))
    return Grid(step=step, name="float64", typical=float(typical))
