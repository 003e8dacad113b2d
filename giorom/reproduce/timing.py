"""What the tables of times share: one plasticine body, its motion, and networks that step it.

The body is a rabbit, as in the paper's set, thrown as in the preset and moved by the solver. Its
points are farthest point samples of that body; of more points than the solver had, positions come
from its motion by moving least squares. The networks have random weights, which no time depends on.

A GPU measures the paper's graphs. Two cores cannot, and take fewer points: ``shrink`` times fewer,
with radii that are larger by its cube root, so that a point has as many neighbours as in the
paper's graph of the same body.
"""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from giorom.data.trajectory_file import write_trajectory_file
from giorom.evaluation.referee import scene_with_points
from giorom.evaluation.stage_speed import DecodeCase, StepCase, measure_decode, measure_step
from giorom.experiment import build_simulator
from giorom.fields import FieldConfig, build_field
from giorom.generate import generate
from giorom.mpm import draw_scene, simulate
from giorom.reproduce.study import Study
from giorom.sampling import sample_farthest
from giorom.state import Trajectory
from giorom.training.field_loop import train_field
from giorom.training_data import load_training_data

SYSTEM = "plasticine3d"
"""What the body is made of."""

SHAPE, SEED = "rabbit", 1
"""Which body, and how it is thrown."""

ROLLOUT = 200
"""Frames of the rollout whose time is printed, as in the paper."""

METHODS = ("paper", "gns", "gat", "default")
"""Time-steppers of the tables of times."""

LOADED = 3
"""Trajectories of the data set from which the scales of the networks come: one for each split."""


@dataclass(frozen=True, kw_only=True)
class TimingSize:
    """How much is measured at a scale."""

    body_points: int
    """Points of the body that the solver moves."""

    frames: int
    """Frames of its motion over which the timed steps are spread."""

    shrink_radii: float
    """How many times fewer points than the paper's there are where the radius varies."""

    shrink_points: float
    """The same where the number of points varies."""

    cells: int | None
    """Most radii, or sizes, that are measured; none: all of the paper's."""

    steps: int
    """Most steps that are timed."""

    seconds: float
    """Time after which no more steps are begun [s]."""

    most_edges: int
    """Edges beyond which a dense graph is not measured but estimated."""

    modes: int = 32
    """Modes of the linear bases."""


SIZES: dict[str, TimingSize] = {
    "tiny": TimingSize(
        body_points=300,
        frames=6,
        shrink_radii=64.0,
        shrink_points=32.0,
        cells=2,
        steps=2,
        seconds=1.0,
        most_edges=20_000,
        modes=4,
    ),
    "cpu": TimingSize(
        body_points=5000,
        frames=ROLLOUT,
        shrink_radii=8.0,
        shrink_points=4.0,
        cells=None,
        steps=20,
        seconds=10.0,
        most_edges=500_000,
    ),
    "paper": TimingSize(
        body_points=8000,
        frames=ROLLOUT,
        shrink_radii=1.0,
        shrink_points=1.0,
        cells=None,
        steps=ROLLOUT,
        seconds=1e6,
        most_edges=20_000_000,
    ),
}
"""By scale."""


def equal_degree_radius(radius: float, *, points: int | float, instead_of: int | float) -> float:
    """The radius at which fewer points of the same body have as many neighbours each [m].

    In the interior of a body of volume V and n points a point has (4 pi / 3) r^3 n / V neighbours.

    Args:
        radius: The radius of the other graph [m].
        points: Number of points.
        instead_of: Number of points of the other graph.
    """
    return radius * (instead_of / points) ** (1.0 / 3.0)


class TimedBody:
    """A body in motion and untrained simulators, in files that a fresh process can read.

    Nothing is made before it is asked for: where all measurements are kept already, nothing is.

    Args:
        study: Scale, folder and device.
        folder: Where the files go.
    """

    def __init__(self, study: Study, folder: Path) -> None:
        self.study, self.folder = study, folder
        self.size = SIZES[study.scale.name]

    @cached_property
    def motion(self) -> Trajectory:
        """The motion of all points that the solver moves."""
        experiment = self.study.experiment(SYSTEM)
        found = len(draw_scene(experiment.scene, seed=SEED, shape=SHAPE).position)
        scene = scene_with_points(experiment.scene, points=self.size.body_points, found=found)
        solver = replace(experiment.solver, frames=self._history + self.size.frames)
        return simulate(draw_scene(scene, seed=SEED, shape=SHAPE), solver)

    def uses_graph(self, method: str) -> bool:
        """Whether a method needs edges."""
        return self.study.experiment(SYSTEM, method).uses_network

    @property
    def _history(self) -> int:
        """Frames that every network looks back on, and no more."""
        return max(self.study.experiment(SYSTEM, name).features.history for name in METHODS)

    @cached_property
    def order(self) -> Tensor:
        """The points from first to last farthest sample: the first n are a sample of n."""
        return sample_farthest(self.motion.position[0], self.motion.position.shape[1])

    def dense_points(self, points: int) -> Tensor:
        """Undeformed positions of about so many points of the same body [m]."""
        experiment = self.study.experiment(SYSTEM)
        found = len(draw_scene(experiment.scene, seed=SEED, shape=SHAPE).position)
        scene = scene_with_points(experiment.scene, points=points, found=found)
        return draw_scene(scene, seed=SEED, shape=SHAPE).position

    def motion_of(self, points: int) -> Trajectory:
        """The motion of so many points; of more than the solver has about so many."""
        motion = self.motion
        if points <= motion.position.shape[1]:
            return motion.subset(self.order[:points])
        query = self.dense_points(points)
        decode = build_field(FieldConfig(kind="local"), dimension=3).bind(motion.position[0], query)
        return replace(
            motion,
            position=torch.stack([decode(frame) for frame in motion.position]),
            particle_type=motion.particle_type[:1].expand(len(query)).contiguous(),
        )

    def simulator(self, method: str, *, field: str | None = None) -> Path:
        """Folder of the untrained simulator of a method, with another field if asked for."""
        folder = self.folder / f"{method}-{field or 'own'}"
        if folder.is_dir():
            return folder
        basis = {"modes": self.size.modes}
        changes = {"field": {"kind": field, "pod": basis, "neural_basis": basis}}
        changes = {} if field is None else changes
        experiment = self.study.experiment(SYSTEM, method, changes)
        data = load_training_data(experiment, self._data)
        torch.manual_seed(SEED)
        simulator = build_simulator(experiment, data)
        if field is not None:
            short = replace(experiment.field_training, steps=1)
            train_field(
                simulator.field, data.thinned, short, seed=0, minutes=1.0, report=lambda _: None
            )
        folder.mkdir()
        simulator.save_pretrained(folder)
        return folder

    @cached_property
    def _data(self) -> Path:
        folder = self.folder / "data"
        generate(
            self.study.experiment(SYSTEM),
            folder=folder,
            trajectories=LOADED,
            seed=0,
            jobs=1,
            shape=None,
            device="cpu",
            report=lambda *_: None,
        )
        return folder

    def step(self, method: str, *, points: int, radius: float | None) -> dict[str, Any]:
        """Times of a step of a method on so many points; measured once, then kept.

        Args:
            method: Which stepper.
            points: Number of points.
            radius: Radius of the graph [m]; none for a stepper that has no graph.
        """

        def make() -> dict[str, Any]:
            case = StepCase(
                simulator=self.simulator(method),
                motion=self._motion_file(points),
                radius=radius,
                steps=self.size.steps,
                seconds=self.size.seconds,
                threads=self.study.jobs,
                device=self.study.device,
            )
            return self.study.alone(measure_step, case)

        return self._kept("step", {"method": method, "points": points, "radius": radius}, make)

    def decode(self, field: str, *, points: int, sparse_points: int) -> dict[str, Any]:
        """Times of the recovery of about so many points by a field; measured once, then kept."""

        def make() -> dict[str, Any]:
            case = DecodeCase(
                simulator=self.simulator("default", field=field),
                body=self._body_file(points, sparse_points),
                threads=self.study.jobs,
                device=self.study.device,
            )
            return self.study.alone(measure_decode, case)

        key = {"field": field, "points": points, "sparse_points": sparse_points}
        return self._kept("decode", key, make)

    def _kept(self, name: str, key: dict[str, Any], make: Callable[[], Any]) -> dict[str, Any]:
        size = {"steps": self.size.steps, "body": self.size.body_points, "seed": SEED}
        where = {"threads": self.study.jobs, "device": self.study.device}
        self.study.report(f"{name} {' '.join(map(str, key.values()))}", 0, 0)
        return self.study.kept(f"time-{name}", key | size | where, make)

    def _motion_file(self, points: int) -> Path:
        path = self.folder / f"motion-{points}.h5"
        if not path.is_file():
            write_trajectory_file(self.motion_of(points), path)
        return path

    def _body_file(self, points: int, sparse_points: int) -> Path:
        path = self.folder / f"body-{points}-{sparse_points}.safetensors"
        if not path.is_file():
            motion = self.motion_of(sparse_points)
            tensors = {
                "reference": motion.position[0],
                "query": self.dense_points(points),
                "position": motion.position[1 : self.size.frames + 1],
                "bounds": motion.bounds,
            }
            save_file({name: value.contiguous() for name, value in tensors.items()}, path)
        return path


@contextmanager
def timed_body(study: Study) -> Iterator[TimedBody]:
    """A body whose files are thrown away at the end of the block."""
    with tempfile.TemporaryDirectory(prefix="giorom-timing-") as folder:
        yield TimedBody(study, Path(folder))
