"""``giorom rollout``: simulate a body with a trained model, to a file."""

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from giorom.commands.evaluate import check_trajectory, chosen_model
from giorom.commands.export import check_motion_output
from giorom.commands.shared import progress_bar, say
from giorom.data.trajectory_file import SPLITS, read_trajectory
from giorom.export import MotionHeader, check_room, open_writer
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
    """Roll out and write the file, frame by frame."""
    written = check_motion_output(arguments.out)
    if arguments.frames < 1:
        raise ValueError(f"--frames must be >= 1, got {arguments.frames}.")
    if (arguments.shape is None) == (arguments.data is None):
        raise ValueError("give either --shape or --data: the body to start from.")
    simulator = Simulator.from_pretrained(chosen_model(arguments)).to(arguments.device)
    position, velocity, particle_type, prescribed = _start(arguments, simulator)
    samples = simulator.sample(position.to(arguments.device), count=arguments.sparse)
    header = _header(simulator, position, particle_type, len(samples))
    check_room(arguments.out, header, frames=arguments.frames + 1)
    motion = simulator.frames(
        position.to(arguments.device),
        velocity.to(arguments.device),
        particle_type.to(arguments.device),
        frames=arguments.frames,
        samples=samples,
        prescribed=None if prescribed is None else prescribed.to(arguments.device),
    )
    start = time.perf_counter()
    bar = progress_bar(arguments, total=arguments.frames, unit="frame", text="rollout")
    with bar, open_writer(arguments.out, header) as writer:
        writer.append(position)
        for frame in motion:
            writer.append(frame)
            bar.update()
    seconds = time.perf_counter() - start
    say(
        arguments,
        f"{written}: {len(position)} particles from {len(samples)} samples, "
        f"{writer.frame_count} frames in {seconds:.2f} s",
    )
    return {
        "points": len(position),
        "sparse_points": len(samples),
        "frames": arguments.frames,
        "seconds": seconds,
        "files": [str(written)],
    }


def _header(
    simulator: Simulator, position: torch.Tensor, particle_type: torch.Tensor, samples: int
) -> MotionHeader:
    """What is known of the motion before it is simulated."""
    return MotionHeader(
        particle_type=particle_type,
        frame_dt=simulator.config.frame_dt,
        bounds=position.new_tensor(simulator.config.bounds),
        attributes={"system": simulator.config.system, "sparse_points": samples},
    )


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
    first = trajectory.position[0].clone()  # a view would keep the whole motion in memory
    return first, velocity, trajectory.particle_type, _prescribed(trajectory)


def _prescribed(trajectory: Trajectory) -> torch.Tensor | None:
    """Positions after the first frame, where some kinematic particle moves."""
    kinematic = trajectory.position[:, trajectory.kinematic]
    moves = bool((kinematic != kinematic[:1]).any())
    return trajectory.position[1:] if moves else None
