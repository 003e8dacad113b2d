"""The trained surrogate as one object: everything a rollout needs, and how it is stored.

A stored simulator is a directory with ``config.json`` and ``model.safetensors``. Nothing in it is
executable: safetensors holds tensors, JSON holds values, and every key is checked.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from giorom.baselines import build_baseline
from giorom.body_stepper import BodyStepper
from giorom.fields import FieldDecoder, build_field
from giorom.grid_stepper import GridStepper
from giorom.pipeline import (
    Connect,
    Dynamics,
    connect_within,
    full_order_rollout,
    start_from_velocity,
    unconnected,
)
from giorom.records import nearest, one_line, parse_record
from giorom.sampling import represented_particles, sample
from giorom.simulator_config import SimulatorConfig
from giorom.state import KINEMATIC, Body, SparseState, Trajectory
from giorom.time_stepper import TimeStepper
from giorom.version import __version__

__all__ = [
    "PRETRAINED",
    "Simulator",
    "SimulatorConfig",
    "check_frames",
    "pretrained_directory",
    "pretrained_names",
]

PRETRAINED = Path(__file__).parent / "pretrained"
"""Models that are part of the package."""

MOST_RESULT_BYTES = 64 << 30
"""Largest result kept in memory [bytes]; refused before the first frame."""

FORMAT_VERSION = 2
"""Version of the stored form; version 1 knew the neural basis alone."""


class Simulator(nn.Module):
    """Time-stepper and field with all they need to run.

    Args:
        config: Everything but the weights.
    """

    def __init__(self, config: SimulatorConfig) -> None:
        super().__init__()
        if config.graph.radius is None:
            raise ValueError("SimulatorConfig.graph.radius must be set; choose_radius finds one.")
        self.config = config
        self.dynamics = _stepper(config)
        self.field = build_field(config.field, dimension=config.dimension)

    @property
    def connect(self) -> Connect:
        """Stage 3 with this simulator's radius, where what moves the samples reads edges."""
        if not self.config.reads_edges:
            return unconnected
        graph = self.config.graph
        return connect_within(graph.radius, configuration=graph.configuration, kind=graph.kind)

    def sample(
        self, position: Float[Tensor, "p d"], *, count: int | None = None
    ) -> Int[Tensor, " q"]:
        """Stage 2: which particles are simulated; ``count`` overrides the trained reduction.

        Raises:
            ValueError: If ``count`` is below one or above the number of particles.
        """
        config = self.config.sampling
        if count is not None:
            if not 1 <= count <= len(position):
                raise ValueError(
                    f"the number of samples must lie between 1 and the {len(position)} particles "
                    f"of the body, got {count}."
                )
            config = dataclasses.replace(config, reduction=None, count=count)
        return sample(position, config)

    def start(
        self,
        position: Float[Tensor, "p d"],
        velocity: Float[Tensor, "p d"],
        particle_type: Int[Tensor, " p"],
        *,
        samples: Int[Tensor, " q"],
    ) -> SparseState:
        """The sparse state of a body at rest shape with a given velocity."""
        self._check_dimension(position)
        state = start_from_velocity(
            position[samples],
            velocity[samples],
            particle_type=particle_type[samples],
            bounds=position.new_tensor(self.config.bounds),
            frame_dt=self.config.frame_dt,
            history=self.config.features.history,
            weight=represented_particles(position, samples),
            body=Body(position=position, particle_type=particle_type),
        )
        return self.dynamics.start(state, velocity[samples])

    def decoder(
        self,
        position: Float[Tensor, "p d"],
        held: Bool[Tensor, " p"],
        *,
        samples: Int[Tensor, " q"],
    ) -> FieldDecoder:
        """Stage 6 bound to a body and its samples; ``held`` points never move."""
        return self.field.bind(
            position[samples],
            position,
            held=held,
            bounds=position.new_tensor(self.config.bounds),
        )

    def frames(
        self,
        position: Float[Tensor, "p d"],
        velocity: Float[Tensor, "p d"],
        particle_type: Int[Tensor, " p"],
        *,
        frames: int,
        samples: Int[Tensor, " q"] | None = None,
        prescribed: Float[Tensor, "t p d"] | None = None,
    ) -> Iterator[Float[Tensor, "p d"]]:
        """Simulate a body frame by frame (Algorithm 1), in the memory of a few frames.

        Args:
            position: Undeformed positions of all particles [m].
            velocity: Initial velocities [m/s].
            particle_type: GNS types.
            frames: Number of frames to add.
            samples: Which particles are simulated; by default the trained reduction.
            prescribed: As in ``rollout``.

        Yields:
            Positions of all particles after each frame [m]; ``position`` itself is not repeated.
        """
        samples = self.sample(position) if samples is None else samples
        state = self.start(position, velocity, particle_type, samples=samples)
        kinematic = particle_type == KINEMATIC
        motion = full_order_rollout(
            state,
            frames,
            connect=self.connect,
            step=self.dynamics.step,
            decode=self.decoder(position, kinematic, samples=samples),
            prescribed=None if prescribed is None else prescribed[:, samples],
        )
        if prescribed is None:
            yield from motion
            return
        for frame, decoded in enumerate(motion):
            yield torch.where(kinematic[:, None], prescribed[frame], decoded)

    def rollout(
        self,
        position: Float[Tensor, "p d"],
        velocity: Float[Tensor, "p d"],
        particle_type: Int[Tensor, " p"],
        *,
        frames: int,
        sparse_points: int | None = None,
        prescribed: Float[Tensor, "t p d"] | None = None,
    ) -> Trajectory:
        """Simulate a body: sample it, step the samples, recover every particle.

        Args:
            position: Undeformed positions of all particles [m].
            velocity: Initial velocities [m/s].
            particle_type: GNS types.
            frames: Number of frames to add.
            sparse_points: Number of samples; by default the trained reduction.
            prescribed: Positions of all particles at each of those frames, of which the kinematic
                ones are used [m]; by default kinematic particles stay where they are.

        Returns:
            ``frames + 1`` frames, the first of which is ``position``.
        """
        check_frames(frames, position)
        samples = self.sample(position, count=sparse_points)
        motion = self.frames(
            position,
            velocity,
            particle_type,
            frames=frames,
            samples=samples,
            prescribed=prescribed,
        )
        return Trajectory(
            position=torch.stack([position, *motion]),
            particle_type=particle_type,
            frame_dt=self.config.frame_dt,
            bounds=position.new_tensor(self.config.bounds),
            attributes={"system": self.config.system, "sparse_points": len(samples)},
        )

    def save_pretrained(self, directory: Path | str) -> None:
        """Write ``config.json`` and ``model.safetensors`` into an existing directory."""
        directory = Path(directory)
        record = {"format_version": FORMAT_VERSION, "giorom": __version__}
        record |= dataclasses.asdict(self.config)
        tensors = {name: value.detach().cpu() for name, value in self.state_dict().items()}
        save_file(tensors, directory / "model.safetensors")
        (directory / "config.json").write_text(json.dumps(record, indent=1) + "\n")

    @classmethod
    def from_pretrained(cls, name: Path | str) -> "Simulator":
        """Load a simulator from a directory, or a model of the package by its name.

        Raises:
            ValueError: If there is no such model, or its files are damaged or foreign.
        """
        directory = pretrained_directory(name)
        config = _read_config(directory / "config.json")
        simulator = cls(config)
        try:
            tensors = load_file(directory / "model.safetensors")
            simulator.load_state_dict(tensors)
        except (OSError, SafetensorError, RuntimeError) as error:
            raise ValueError(
                f"{directory / 'model.safetensors'} does not hold the weights that config.json "
                f"describes ({one_line(error)[:200]}). Train again or copy the directory whole."
            ) from None
        for key, value in simulator.state_dict().items():
            if not bool(value.isfinite().all()):
                raise ValueError(
                    f"{directory / 'model.safetensors'}: {key} holds values that are not finite. "
                    f"Train again or copy the directory whole."
                )
        return simulator.eval().requires_grad_(False)

    def _check_dimension(self, position: Tensor) -> None:
        if position.shape[1] != self.config.dimension:
            raise ValueError(
                f"the body is {position.shape[1]}-dimensional, but this simulator "
                f"({self.config.system}) was trained in {self.config.dimension} dimensions. Use a "
                f"model of that dimension."
            )


def _stepper(config: SimulatorConfig) -> Dynamics | GridStepper | BodyStepper:
    """What moves the samples, untrained."""
    if config.body_stepper is not None:
        return BodyStepper(config.body_stepper, dimension=config.dimension)
    if config.grid_stepper is not None:
        return GridStepper(config.grid_stepper, dimension=config.dimension)
    network = config.baseline
    return Dynamics(
        TimeStepper(config.time_stepper) if network is None else build_baseline(network),
        features=config.features,
        normalization=config.normalization,
        radius=config.graph.radius,
    )


def check_frames(frames: int, position: Float[Tensor, "p d"]) -> None:
    """Refuse a rollout whose frames would not fit into memory.

    Raises:
        ValueError: If the result would take more than ``MOST_RESULT_BYTES``.
    """
    size = (frames + 1) * position.numel() * position.element_size()
    if size > MOST_RESULT_BYTES:
        raise ValueError(
            f"{frames} frames of {len(position)} particles would take {size >> 30} GiB, more "
            f"than {MOST_RESULT_BYTES >> 30}. Ask for fewer frames."
        )


def pretrained_directory(name: Path | str) -> Path:
    """Directory of a stored simulator: a path, a training run, or a model of the package.

    Raises:
        ValueError: If there is none.
    """
    for candidate in (Path(name), Path(name) / "simulator", PRETRAINED / str(name)):
        if (candidate / "config.json").is_file():
            return candidate
    known = pretrained_names()
    raise ValueError(
        f"there is no simulator {str(name)!r}: neither a directory with config.json nor a "
        f"pretrained model. {nearest(str(name), known)}"
    )


def pretrained_names() -> list[str]:
    """Names of the models that are part of the package."""
    return sorted(path.parent.name for path in PRETRAINED.glob("*/config.json"))


def _read_config(path: Path) -> SimulatorConfig:
    try:
        record: Any = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not readable JSON ({error}). Copy the model again.") from None
    if not isinstance(record, dict):
        raise ValueError(f"{path} must hold a JSON object. Copy the model again.")
    found = record.pop("format_version", None)
    if type(found) is not int or not 1 <= found <= FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {found!r}, this program reads 1 to {FORMAT_VERSION}. "
            f"Install a newer giorom."
        )
    if found == 1 and isinstance(record.get("field"), dict):
        record["field"] = {"kind": "neural_basis", "neural_basis": record["field"]}
    record.pop("giorom", None)
    return parse_record(SimulatorConfig, record, where=str(path))
