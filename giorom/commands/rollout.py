"""``giorom rollout``: simulate a body with a trained model, to a file."""

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from giorom.commands.evaluate import check_trajectory, chosen_model
from giorom.commands.shared import check_output, say
from giorom.data.trajectory_file import SPLITS, read_trajectory
from giorom.export import check_extension, write_trajectory
from giorom.mpm import draw_scene
from giorom.simulator import Simulator
from giorom.state import Trajectory


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("model", nargs="?", help="folder of a training run or of a simulator")
    parser.add_argument("--pretrained", metavar="NAME", help="a model of the package instead")
    parser.add_argument("--shape", help="shape name or closed mesh file")
    parser.add_argument("--data", type=Path, help="data set that holds the initial state")
    parser.add_argument("--split", choices=SPLITS, default="test")
    parser.add_argument("--trajectory", type=int, default=0, help="its number in the data set")
    parser.add_argument("--frames", type=int, required=True, help="frames to simulate")
    parser.add_argument("--sparse", type=int, help="number of samples; by default as trained")
    parser.add_argument(
        "--out", type=Path, required=True, help="file; its extension says the format"
    )


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Roll out and write the file."""
    extension = check_extension(arguments.out)
    folder = extension == ".ply"
    check_output(arguments.out.with_suffix("") if folder else arguments.out, folder=folder)
    if arguments.frames < 1:
        raise ValueError(f"--frames must be >= 1, got {arguments.frames}.")
    if (arguments.shape is None) == (arguments.data is None):
        raise ValueError("give either --shape or --data: the body to start from.")
    simulator = Simulator.from_pretrained(chosen_model(arguments)).to(arguments.device)
    position, velocity, particle_type, prescribed = _start(arguments, simulator)
    start = time.perf_counter()
    motion = simulator.rollout(
        position.to(arguments.device),
        velocity.to(arguments.device),
        particle_type.to(arguments.device),
        frames=arguments.frames,
        sparse_points=arguments.sparse,
        prescribed=None if prescribed is None else prescribed.to(arguments.device),
    ).to("cpu")
    seconds = time.perf_counter() - start
    written = write_trajectory(motion, arguments.out)
    samples = motion.attributes["sparse_points"]
    say(
        arguments,
        f"{written}: {motion.position.shape[1]} particles from {samples} samples, "
        f"{motion.frame_count} frames in {seconds:.2f} s",
    )
    return {
        "points": motion.position.shape[1],
        "sparse_points": samples,
        "frames": arguments.frames,
        "seconds": seconds,
        "files": [str(written)],
    }


def _start(
    arguments: argparse.Namespace, simulator: Simulator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Positions, velocities and types of all particles at the start, and the prescribed motion."""
    if arguments.shape is not None:
        scene = draw_scene(simulator.config.scene, seed=arguments.seed, shape=arguments.shape)
        return scene.position, scene.velocity, scene.particle_type, None
    trajectory: Trajectory = read_trajectory(arguments.data, arguments.split, arguments.trajectory)
    check_trajectory(simulator, trajectory)
    if trajectory.frame_count < 2:
        raise ValueError(
            f"trajectory {arguments.trajectory} of {arguments.data} has one frame; two are needed "
            f"for a velocity."
        )
    velocity = (trajectory.position[1] - trajectory.position[0]) / trajectory.frame_dt
    return trajectory.position[0], velocity, trajectory.particle_type, _prescribed(trajectory)


def _prescribed(trajectory: Trajectory) -> torch.Tensor | None:
    """Positions after the first frame, where some kinematic particle moves."""
    kinematic = trajectory.position[:, trajectory.kinematic]
    moves = bool((kinematic != kinematic[:1]).any())
    return trajectory.position[1:] if moves else None
