"""What is published about the data sets of other people: a table to compare ours with.

Facts only: walls, frame time, sequence length, particle numbers and, where somebody printed
them, the four statistics. Velocities and accelerations are per frame (``x_{k+1} - x_k`` and the
second difference), as in ``metadata.json``; lengths are in units of the unit box.

Source:
    Sanchez-Gonzalez et al., "Learning to Simulate Complex Physics with Graph Networks", ICML
    2020 (arXiv:2002.09405), appendix B, for sizes and lengths; the places named in each row's
    ``source`` for the statistics. Where nobody printed a number it is None here.
"""

from dataclasses import dataclass

import torch

from giorom.data.statistics import Statistics

__all__ = ["PUBLISHED", "PublishedDataset", "published_for"]


@dataclass(frozen=True, kw_only=True)
class PublishedDataset:
    """One published data set."""

    name: str
    """Its name."""

    system: str | None = None
    """System of this package whose full-size preset imitates it; None: there is none."""

    dimension: int
    """2 or 3."""

    bounds: tuple[tuple[float, float], ...] | None = None
    """Lower and upper wall of each axis [m]; None: not printed."""

    frame_dt: float
    """Time between frames [s]."""

    frames: int
    """Frames of a trajectory, ``sequence_length`` of the metadata (the files hold one more)."""

    radius: float
    """Default radius of its graph [m]."""

    most_particles: int
    """Particles of the largest trajectory, rounded by its authors where above 1,200."""

    particle_counts: tuple[int, ...] = ()
    """Particles of the trajectories whose number is known."""

    trajectories: tuple[int, int | None, int]
    """Trajectories for training, validation (None: not known) and test."""

    particle_types: tuple[int, ...]
    """GNS particle types in use."""

    velocity_mean: tuple[float, ...] | None = None
    """Mean velocity [m/frame]."""

    velocity_std: tuple[float, ...] | None = None
    """Standard deviation of the velocity [m/frame]."""

    acceleration_mean: tuple[float, ...] | None = None
    """Mean acceleration [m/frame^2]."""

    acceleration_std: tuple[float, ...] | None = None
    """Standard deviation of the acceleration [m/frame^2]."""

    source: str
    """Where the statistics, or else the sizes, were printed."""

    @property
    def statistics(self) -> Statistics | None:
        """The four statistics per frame, if they are published."""
        if self.velocity_std is None:
            return None
        return Statistics(
            velocity_mean=torch.tensor(self.velocity_mean, dtype=torch.float64),
            velocity_std=torch.tensor(self.velocity_std, dtype=torch.float64),
            acceleration_mean=torch.tensor(self.acceleration_mean, dtype=torch.float64),
            acceleration_std=torch.tensor(self.acceleration_std, dtype=torch.float64),
        )


_UNIT_BOX = ((0.1, 0.9), (0.1, 0.9))
_PAPER = "arXiv:2002.09405, appendix B (statistics not printed)"

_ROWS = (
    PublishedDataset(
        name="WaterDrop",
        system="water2d",
        dimension=2,
        bounds=_UNIT_BOX,
        frame_dt=2.5e-3,
        frames=1000,
        radius=0.015,
        most_particles=1108,
        trajectories=(1000, 30, 30),
        particle_types=(5,),
        velocity_mean=(1.1927917091800243e-05, -2.563314637168018e-04),
        velocity_std=(1.3973410613251076e-03, 1.31291713199288e-03),
        acceleration_mean=(-1.10709094667326e-08, 8.749365512454699e-08),
        acceleration_std=(6.545267379756913e-05, 7.965494666766224e-05),
        source="default statistics in the data parsers of the GIOROM code",
    ),
    PublishedDataset(
        name="WaterDropSample",
        system="water2d",
        dimension=2,
        bounds=_UNIT_BOX,
        frame_dt=2.5e-3,
        frames=1000,
        radius=0.015,
        most_particles=803,
        particle_counts=(678, 355, 295, 803),
        trajectories=(2, None, 2),
        particle_types=(5,),
        velocity_mean=(-3.964619574176163e-05, -2.6272129664401046e-04),
        velocity_std=(1.3722809722366911e-03, 1.3119977252142715e-03),
        acceleration_mean=(2.602686518497945e-08, 1.0721623948191945e-07),
        acceleration_std=(6.742962470925277e-05, 8.700719180424815e-05),
        source="metadata.json of the sample data set, as copied into three public repositories",
    ),
    PublishedDataset(
        name="Sand",
        system="sand2d",
        dimension=2,
        bounds=_UNIT_BOX,
        frame_dt=2.5e-3,
        frames=320,
        radius=0.015,
        most_particles=2000,
        trajectories=(1000, 30, 30),
        particle_types=(6,),
        velocity_mean=(5.123277536458455e-06, -9.965205918140803e-04),
        velocity_std=(2.1978993231675805e-03, 2.6653552458701774e-03),
        acceleration_mean=(5.237611158734309e-07, 2.3633027988858656e-07),
        acceleration_std=(2.582944917306106e-04, 2.9554531667679154e-04),
        source="metadata.json printed in the documentation of geoelements/gns",
    ),
    PublishedDataset(
        name="Goop",
        system="goop2d",
        dimension=2,
        frame_dt=2.5e-3,
        frames=400,
        radius=0.015,
        most_particles=1900,
        trajectories=(1000, 30, 30),
        particle_types=(7,),
        source=_PAPER,
    ),
    PublishedDataset(
        name="MultiMaterial",
        system="multimaterial2d",
        dimension=2,
        frame_dt=2.5e-3,
        frames=1000,
        radius=0.015,
        most_particles=2000,
        trajectories=(1000, 100, 100),
        particle_types=(0, 5, 6, 7),
        source=_PAPER,
    ),
    PublishedDataset(
        name="Water",
        dimension=2,
        frame_dt=2.5e-3,
        frames=1000,
        radius=0.015,
        most_particles=1900,
        trajectories=(1000, 30, 30),
        particle_types=(5,),
        source=_PAPER,
    ),
    PublishedDataset(
        name="WaterRamps",
        dimension=2,
        frame_dt=2.5e-3,
        frames=600,
        radius=0.015,
        most_particles=2300,
        trajectories=(1000, 100, 100),
        particle_types=(3, 5),
        source=_PAPER,
    ),
    PublishedDataset(
        name="SandRamps",
        dimension=2,
        frame_dt=2.5e-3,
        frames=400,
        radius=0.015,
        most_particles=3300,
        trajectories=(1000, 100, 100),
        particle_types=(3, 6),
        source=_PAPER,
    ),
    PublishedDataset(
        name="Water-3D",
        dimension=3,
        frame_dt=5e-3,
        frames=800,
        radius=0.035,
        most_particles=14000,
        trajectories=(1000, 100, 100),
        particle_types=(5,),
        source=_PAPER,
    ),
    PublishedDataset(
        name="Sand-3D",
        dimension=3,
        frame_dt=2.5e-3,
        frames=350,
        radius=0.025,
        most_particles=20000,
        trajectories=(1000, 100, 100),
        particle_types=(6,),
        source=_PAPER,
    ),
    PublishedDataset(
        name="Goop-3D",
        dimension=3,
        frame_dt=2.5e-3,
        frames=300,
        radius=0.025,
        most_particles=14000,
        trajectories=(1000, 100, 100),
        particle_types=(7,),
        source=_PAPER,
    ),
)

PUBLISHED: dict[str, PublishedDataset] = {row.name: row for row in _ROWS}
"""Every published data set by its name."""


def published_for(system: str) -> list[PublishedDataset]:
    """The published data sets that a system of this package imitates.

    Args:
        system: ``Experiment.system``, also with ``-small`` appended.
    """
    base = system.removesuffix("-small")
    return [row for row in _ROWS if row.system == base]
