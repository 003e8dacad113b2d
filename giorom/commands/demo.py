"""``giorom demo``: one body through the whole method, judged by MPM, with film and picture."""

import argparse
from pathlib import Path
from typing import Any

from giorom.commands.shared import check_output, print_table, say
from giorom.evaluation.referee import Verdict, judge, scene_with_points
from giorom.export import write_trajectory
from giorom.mpm import Scene, draw_scene
from giorom.simulator import Simulator

DEFAULT_MODEL = "elastic3d-small"
DEFAULT_SHAPE = "capsule"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--pretrained", metavar="NAME", default=DEFAULT_MODEL)
    parser.add_argument(
        "--shape", default=DEFAULT_SHAPE, help="shape name or closed mesh file (OBJ, STL, PLY ...)"
    )
    parser.add_argument("--points", type=int, help="about how many particles the body gets")
    parser.add_argument("--sparse", type=int, help="number of samples; by default as trained")
    parser.add_argument("--frames", type=int, default=100, help="frames to simulate")
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder of the results")


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Simulate, compare, draw, write."""
    if arguments.frames < 1:
        raise ValueError(f"--frames must be >= 1, got {arguments.frames}.")
    check_output(arguments.out, folder=True)
    simulator = Simulator.from_pretrained(arguments.pretrained).to(arguments.device)
    scene, trained_count = _scene(arguments, simulator)
    sparse = trained_count if arguments.sparse is None else arguments.sparse
    if not 1 <= sparse <= len(scene.position):
        raise ValueError(
            f"--sparse must lie between 1 and the {len(scene.position)} particles of the body, got "
            f"{sparse}."
        )
    verdict = judge(simulator, scene, frames=arguments.frames, sparse_points=sparse)
    _print(arguments, verdict.scores)
    files = _write(arguments, verdict)
    return verdict.scores | {"files": [str(path) for path in files]}


def _scene(arguments: argparse.Namespace, simulator: Simulator) -> tuple[Scene, int]:
    """The scene, and how many samples the model would take of the body at the trained spacing.

    A model is at home at one distance between samples; more particles do not change it.
    """
    config = simulator.config.scene
    scene = draw_scene(config, seed=arguments.seed, shape=arguments.shape)
    count = simulator.config.sampling.sample_count(len(scene.position))
    if arguments.points is None:
        return scene, count
    finer = scene_with_points(config, points=arguments.points, found=len(scene.position))
    scene = draw_scene(finer, seed=arguments.seed, shape=arguments.shape)
    return scene, min(count, len(scene.position))


def _write(arguments: argparse.Namespace, verdict: Verdict) -> list[Path]:
    """Film, picture and trajectory files."""
    stem = Path(arguments.shape).stem
    files = [arguments.out / f"{stem}{suffix}" for suffix in (".mp4", ".png", ".vtkhdf", ".h5")]
    for path in files:
        truth = None if path.suffix == ".h5" else verdict.truth
        write_trajectory(verdict.predicted, path, truth=truth)
        say(arguments, f"wrote {path}")
    return files


def _print(arguments: argparse.Namespace, scores: dict[str, Any]) -> None:
    """The table of the demonstration."""
    error, still = scores["rollout_mse"], scores["static_mse"]
    seconds = scores["seconds_per_frame"]
    rows = [
        ("particles", f"{scores['points']}"),
        ("sparse points", f"{scores['sparse_points']} ({scores['reduction']:.1f} times fewer)"),
        ("frames", f"{scores['frames']} of {1e3 * scores['frame_dt']:g} ms"),
        ("rollout MSE against MPM", f"{error:.3g} m^2"),
        ("  of the field alone (projection floor)", f"{scores['projection_floor_mse']:.3g} m^2"),
        ("  of holding still", f"{still:.3g} m^2 ({still / error:.1f} times ours)"),
        (
            "  of constant velocity",
            f"{scores['constant_velocity_mse']:.3g} m^2 "
            f"({scores['constant_velocity_mse'] / error:.0f} times ours)",
        ),
        ("relative displacement error", f"{scores['relative_displacement_error']:.3f}"),
        ("predicted / true amplitude", f"{scores['amplitude_ratio']:.3f}"),
        ("displacement correlation", f"{scores['displacement_correlation']:.3f}"),
        *((f"  {stage}", f"{1e3 * seconds[stage]:.2f} ms per frame") for stage in seconds),
        ("MPM, one thread", f"{1e3 * scores['solver_seconds_per_frame']:.2f} ms per frame"),
        (f"MPM / surrogate ({scores['threads']} threads)", f"{scores['speedup']:.2f}"),
    ]
    print_table(arguments, f"{arguments.pretrained} on {scores['shape']}", rows, ("", ""))
