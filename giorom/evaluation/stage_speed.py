"""Seconds of each stage of a frame: graph, network, integration, recovery of all points.

The steps that are timed start from the frames of a given motion, so that the graph is that of the
motion and not of what an untrained network makes of it; a time does not depend on the values of
the weights. Before each step that counts the clock waits for the device, and one step in advance
does what is done once (kernels, caches). Everything is on the scale of one frame; a rollout takes
``frames`` times the sum of the medians.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from giorom.data.trajectory_file import read_trajectory_file
from giorom.evaluation.memory import peak_memory
from giorom.evaluation.stopwatch import synchronize
from giorom.graph import Edges
from giorom.integrate import advance
from giorom.pipeline import Connect, Dynamics, connect_within, start_from_trajectory, unconnected
from giorom.simulator import Simulator
from giorom.state import SparseState, Trajectory

FEWEST_STEPS = 3
"""Steps that are timed however long they take."""


@dataclass(frozen=True, kw_only=True)
class StepCase:
    """A step that is timed."""

    simulator: Path
    """Folder of a stored simulator, trained or not."""

    motion: Path
    """Trajectory file of the samples."""

    radius: float | None
    """Radius of the graph, and unit of length of the features [m]; none: those of the simulator."""

    steps: int
    """Most steps that are timed."""

    seconds: float
    """Time after which no further step is begun, once ``FEWEST_STEPS`` are done [s]."""

    threads: int
    """Threads of PyTorch."""

    device: str
    """``cpu`` or ``cuda``."""


@dataclass(frozen=True, kw_only=True)
class DecodeCase:
    """A recovery of all points that is timed."""

    simulator: Path
    """Folder of a stored simulator, whose field is used."""

    body: Path
    """Tensors ``reference`` (q d), ``query`` (p d), ``position`` (t q d), ``bounds`` (d 2) [m]."""

    threads: int
    """Threads of PyTorch."""

    device: str
    """``cpu`` or ``cuda``."""


def measure_step(case: StepCase) -> dict[str, Any]:
    """Time the stages of a step.

    Args:
        case: What is timed.

    Returns:
        Sizes, medians of the seconds of each stage, range of their sum, memory of a step. A
        stepper without a network has ``integration_seconds`` none: it is part of the step.
    """
    torch.set_num_threads(case.threads)
    simulator = Simulator.from_pretrained(case.simulator).to(case.device)
    motion = read_trajectory_file(case.motion).to(case.device)
    connect = connect_at(simulator, case.radius, rescaled=True)
    states = states_of(motion, history=simulator.config.features.history, count=case.steps)
    with torch.no_grad():
        (_, memory), peak = peak_memory(
            lambda: _timed_step(simulator, states[0], connect), device=case.device
        )
        timed: list[dict[str, Any]] = []
        start = time.perf_counter()
        for state in states:
            is_late = time.perf_counter() - start > case.seconds
            if is_late and len(timed) >= FEWEST_STEPS:
                break
            numbers, memory = _timed_step(simulator, replace(state, memory=memory), connect)
            timed.append(numbers)
    return _summary(timed) | {
        "parameters": sum(p.numel() for p in simulator.dynamics.parameters()),
        "points": motion.position.shape[1],
        "radius": case.radius,
        "peak_bytes": peak,
        "threads": case.threads,
        "device": case.device,
    }


def connect_at(
    simulator: Simulator, radius: float | None, *, rescaled: bool, kind: str | None = None
) -> Connect:
    """The graph of a simulator at another radius.

    Args:
        simulator: The simulator; its unit of length changes if ``rescaled``.
        radius: Radius of the graph [m]; none: as trained.
        rescaled: Whether the features are measured in the new radius, as the official code does.
        kind: Another kind of graph; none: as trained.
    """
    dynamics, graph = simulator.dynamics, simulator.config.graph
    if not isinstance(dynamics, Dynamics):
        return unconnected
    radius = graph.radius if radius is None else radius
    dynamics.radius = radius if rescaled else graph.radius
    return connect_within(radius, configuration=graph.configuration, kind=kind or graph.kind)


def states_of(motion: Trajectory, *, history: int, count: int) -> list[SparseState]:
    """States of a motion at some frames, evenly spread over those that have a past and a next."""
    everything = torch.arange(motion.position.shape[1], device=motion.position.device)
    last = motion.frame_count - 2
    frames = torch.linspace(history - 1, last, min(count, last - history + 2)).round().long()
    return [
        start_from_trajectory(motion, everything, history=history, frame=frame)
        for frame in frames.tolist()
    ]


def _timed_step(
    simulator: Simulator, state: SparseState, connect: Connect
) -> tuple[dict[str, Any], Tensor | tuple[Tensor, ...] | None]:
    """Seconds of the stages of one step, and what the stepper remembers."""
    dynamics = simulator.dynamics
    edges, graph = clocked(connect, state)
    numbers = {"edges": _edge_count(edges), "graph_seconds": graph, "integration_seconds": None}
    if isinstance(dynamics, Dynamics):
        acceleration, numbers["network_seconds"] = clocked(dynamics, state, edges)
        later, numbers["integration_seconds"] = clocked(advance, state, acceleration)
    else:
        later, numbers["network_seconds"] = clocked(dynamics.step, state, edges)
    return numbers, later.memory


def clocked(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """A result and the seconds it took, those of the device included."""
    synchronize()
    start = time.perf_counter()
    result = function(*arguments)
    synchronize()
    return result, time.perf_counter() - start


def _edge_count(edges: Edges) -> int:
    """Edges that are not from a particle to itself."""
    return int((edges.sender != edges.receiver).sum())


def _summary(timed: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the steps."""
    stages = ("graph_seconds", "network_seconds", "integration_seconds")
    totals = [sum(numbers[stage] or 0.0 for stage in stages) for numbers in timed]
    is_split = timed[0]["integration_seconds"] is not None
    return {
        "steps_timed": len(timed),
        "edges": round(median(numbers["edges"] for numbers in timed)),
        **{
            stage: median(numbers[stage] for numbers in timed)
            if is_split or stage != "integration_seconds"
            else None
            for stage in stages
        },
        "step_seconds": median(totals),
        "step_seconds_min": min(totals),
        "step_seconds_max": max(totals),
    }


def measure_decode(case: DecodeCase) -> dict[str, Any]:
    """Time the recovery of all points from a motion of the samples, in the order of its frames.

    Args:
        case: What is timed.

    Returns:
        Sizes, seconds that binding takes and those of all frames together, bytes of the peak.
    """
    torch.set_num_threads(case.threads)
    field = Simulator.from_pretrained(case.simulator).to(case.device).field
    body = {name: value.to(case.device) for name, value in load_file(case.body).items()}

    def bound() -> Any:
        decoder = field.bind(body["reference"], body["query"], bounds=body["bounds"])
        decoder(body["position"][0])
        decoder.restart()
        return decoder

    def decoded() -> tuple[float, list[float]]:
        decoder, binding = clocked(bound)
        return binding, [clocked(decoder, position)[1] for position in body["position"]]

    with torch.no_grad():
        (binding, seconds), peak = peak_memory(decoded, device=case.device)
    return {
        "points": len(body["query"]),
        "sparse_points": len(body["reference"]),
        "frames": len(seconds),
        "bind_seconds": binding,
        "decode_seconds": sum(seconds),
        "frame_seconds": median(seconds),
        "peak_bytes": peak,
        "threads": case.threads,
        "device": case.device,
    }
