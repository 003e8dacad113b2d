"""How fast the material point method is: particle-substeps per second.

A case is a scene on a grid. Its run is warmed up (kernels compiled, substeps recorded) and then
timed in blocks of frames, guards and the copy of the positions included: what a user waits for.
With several processes, each has its own run of the case and all begin every block together.
"""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, fields, replace
from itertools import islice
from statistics import median
from typing import Any

import torch

from giorom.evaluation.referee import scene_with_points
from giorom.mpm import SceneConfig, SolverConfig, draw_scene
from giorom.mpm.materials import MATERIALS
from giorom.mpm.simulate import Run, chosen_substeps, largest_substep

BLOCK_WORK = 3_000_000
"""Fewest particle-substeps of a timed block; about a second on one core."""

FEWEST = 1000
"""Particles below which the grid takes the time, and a block need not be longer."""

SUBSTEPS = 25
"""Substeps of a frame of the standard cases."""

PATIENCE = 600.0
"""Longest that the processes wait for each other [s]."""

TYPICAL: dict[str, float] = {
    "density": 1000.0,
    "youngs_modulus": 1e5,
    "poissons_ratio": 0.2,
    "bulk_modulus": 4e5,
    "yield_stress": 2e3,
    "viscosity": 50.0,
    "friction_angle": 30.0,
}
"""Parameters of the standard cases, SI and degrees: soft, so that every body deforms and yields."""

STANDARD_POINTS = {3: 29_000, 2: 1_000}
"""Particles of the standard cases by dimension."""

STANDARD_CELLS = {3: 32, 2: 128}
"""Grid cells per axis of the standard cases by dimension."""


@dataclass(frozen=True, kw_only=True)
class SpeedCase:
    """What is timed."""

    name: str
    """Name of the law or preset."""

    scene: SceneConfig
    """Scene family; the seed draws one."""

    grid_cells: int
    """Grid cells per axis."""

    frame_dt: float | None = None
    """Time between frames [s]; none makes it ``SUBSTEPS`` of the largest substeps allowed."""

    substeps: int | None = None
    """Substeps of a frame; none leaves them to the rules."""


def standard_case(law: str, *, dimension: int, points: int) -> SpeedCase:
    """A block of a material that is thrown and spins, eight (four in 2-D) particles to a cell.

    Args:
        law: A key of ``MATERIALS``.
        dimension: 2 or 3.
        points: About how many particles.

    Raises:
        ValueError: If the law has a parameter without a typical value.
    """
    needed = [field.name for field in fields(MATERIALS[law]) if field.default is MISSING]
    unknown = sorted(set(needed) - set(TYPICAL))
    if unknown:
        raise ValueError(
            f"law {law} has the parameter {unknown[0]}, which has no entry in "
            f"giorom.evaluation.solver_speed.TYPICAL. Add one."
        )
    cells = STANDARD_CELLS[dimension]
    along = points ** (1.0 / dimension)
    spacing = min(0.5 / cells, 0.8 / along)
    scene = SceneConfig(
        family="thrown",
        dimension=dimension,
        material=law,
        material_parameters={name: TYPICAL[name] for name in needed},
        shapes=["box"],
        height_range=[along * spacing] * 2,
        slenderness=[1.0, 1.0],
        spacing=spacing,
        speed_range=[1.0, 1.0],
        spin_range=[2.0, 2.0],
        gravity=9.8,
    )
    return SpeedCase(name=law, scene=scene, grid_cells=cells)


def with_points(case: SpeedCase, points: int, *, seed: int) -> SpeedCase:
    """The case with a spacing that gives about ``points`` particles."""
    found = len(draw_scene(case.scene, seed=seed).position)
    return replace(case, scene=scene_with_points(case.scene, points=points, found=found))


def measure_speed(
    case: SpeedCase, *, processes: int, repeats: int, seed: int, device: str
) -> dict[str, Any]:
    """Time a case.

    Args:
        case: What to time.
        processes: How many runs side by side; one runs in this process.
        repeats: Timed blocks.
        seed: Seed of the scene.
        device: ``cpu`` or ``cuda``.

    Returns:
        A row: what ran, and the rate of all processes together.

    Raises:
        RuntimeError: If a process fails.
    """
    options = {"repeats": repeats, "seed": seed, "device": device}
    if processes == 1:
        measured = [_time_blocks(case, meet=lambda: None, **options)]
    else:
        measured = _side_by_side(case, processes=processes, **options)
    work = measured[0]["block_work"]
    seconds = [result["seconds"] for result in measured]
    rates = [sum(work / own[block] for own in seconds) for block in range(repeats)]
    all_blocks = [value for own in seconds for value in own]
    substeps = measured[0]["substeps"]
    frame = median(all_blocks) / measured[0]["block_frames"]
    return {
        "case": case.name,
        "law": measured[0]["law"],
        "dimension": case.scene.dimension,
        "points": measured[0]["points"],
        "grid_cells": case.grid_cells,
        "substeps": substeps,
        "particle_substeps_per_second": median(rates),
        "particle_substeps_per_second_min": min(rates),
        "particle_substeps_per_second_max": max(rates),
        "microseconds_per_substep": 1e6 * frame / substeps,
        "seconds_per_frame": frame,
        "particle_substeps_per_cpu_second": _per_cpu_second(measured) if device == "cpu" else None,
        "threads": 1 if device == "cpu" else None,
        "processes": processes,
        "device": device,
    }


def _per_cpu_second(measured: list[dict[str, Any]]) -> float:
    """Rate by the clock of the processes, which stands still while others have the core."""
    return median(
        result["block_work"] / seconds for result in measured for seconds in result["cpu_seconds"]
    )


def _time_blocks(
    case: SpeedCase, *, repeats: int, seed: int, device: str, meet: Callable[[], None]
) -> dict[str, Any]:
    """Wall time of each block of frames, after a block of warm-up."""
    scene = draw_scene(case.scene, seed=seed)
    frame_dt = case.frame_dt
    if frame_dt is None:
        frame_dt = SUBSTEPS * largest_substep(scene, case.grid_cells)[0]
    solver = SolverConfig(
        grid_cells=case.grid_cells, frame_dt=frame_dt, frames=1, substeps=case.substeps
    )
    substeps = chosen_substeps(scene, solver)
    block = max(1, -(-BLOCK_WORK // (max(len(scene.position), FEWEST) * substeps)))
    run = Run(scene, replace(solver, frames=1 + block * (repeats + 1)), device=device)
    frames = run.frames()
    _exhaust(frames, 1 + block)
    seconds, cpu_seconds = [], []
    for _ in range(repeats):
        meet()
        start, cpu_start = time.perf_counter(), time.process_time()
        _exhaust(frames, block)
        seconds.append(time.perf_counter() - start)
        cpu_seconds.append(time.process_time() - cpu_start)
    return {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "block_frames": block,
        "block_work": run.work(block),
        "law": " + ".join(sorted({material.name for material in scene.materials})),
        "points": len(scene.position),
        "substeps": substeps,
    }


def _exhaust(frames: Iterator[Any], count: int) -> None:
    for _ in islice(frames, count):
        pass


def _side_by_side(case: SpeedCase, *, processes: int, **options: Any) -> list[dict[str, Any]]:
    """The same case in several processes at a time."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(processes)
    pipes = [context.Pipe() for _ in range(processes)]
    workers = [
        context.Process(target=_serve, args=(theirs, barrier, case, options), daemon=True)
        for _, theirs in pipes
    ]
    try:
        for worker, (_, theirs) in zip(workers, pipes, strict=True):
            worker.start()
            theirs.close()
        answers = [_answer(ours) for ours, _ in pipes]
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()
        for ours, _ in pipes:
            ours.close()
    failed = [answer for answer in answers if isinstance(answer, str)]
    if failed:
        raise RuntimeError(f"a process of the benchmark failed: {failed[0]}")
    return answers


def _answer(connection: Any) -> Any:
    try:
        return connection.recv()
    except EOFError:
        return "it was ended from outside"


def _serve(connection: Any, barrier: Any, case: SpeedCase, options: dict[str, Any]) -> None:
    """Body of a process: time the case in step with the others."""
    torch.set_num_threads(1)
    try:
        answer = _time_blocks(case, meet=lambda: barrier.wait(PATIENCE), **options)
    except Exception as error:
        barrier.abort()
        answer = f"{type(error).__name__}: {error}"
    connection.send(answer)
