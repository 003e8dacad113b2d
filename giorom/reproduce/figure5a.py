"""Figure 5a: one scene of water, four random discretisations of it, and how far they part.

A surrogate that is independent of the discretisation moves the same body the same way whichever
particles are sampled. All points are recovered from each of the four, so that the difference is
that of the whole body and not of other points.
"""

from collections.abc import Callable
from itertools import combinations
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.reproduce.pictures import draw_space
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import (
    first_test_trajectory,
    plain,
    roll,
    train_tuned,
    trained_model,
)
from giorom.reproduce.study import Study, Trial
from giorom.sampling import sample_random
from giorom.simulator import Simulator
from giorom.state import Trajectory

TITLE = "Figure 5a: four random discretisations of one body of water"

SYSTEM, METHODS = "water3d", ("default", "io-not-io")
"""What is rolled out, by which models."""

DISCRETISATIONS, INSTANTS, FRAMES = 4, 3, 200
"""How many sets of samples, how many frames of each are shown, of how many."""

COLUMNS = [
    "method",
    "frame",
    "points",
    "sparse_points",
    "difference",
    "difference_over_displacement",
    "error",
    "error_over_displacement",
    "displacement",
    "diverged",
]


def run(study: Study) -> Result:
    """Roll both models out from every discretisation."""
    trials = [Trial(system=SYSTEM, method=method, seed=study.seed) for method in METHODS]
    names = train_tuned(study, trials)
    pairs = zip(METHODS, names, strict=True)
    shown = {method: _shown(study, method, name) for method, name in pairs}
    return Result(
        id="figure5a",
        title=TITLE,
        columns=COLUMNS,
        rows=[row for method in METHODS for row in shown[method]["rows"]],
        notes=[
            f"The first trajectory of the test split. {DISCRETISATIONS} random samples of the "
            f"same body, seeds 0 to {DISCRETISATIONS - 1}; each is rolled out and all points are "
            f"recovered from it by the field of the model.",
            "`difference`: root mean square over all points of the distance between the "
            "recovered positions of two discretisations, mean over the six pairs [m]; `error`: "
            "the same between a discretisation and the solver, mean over the four; both also "
            "over the root mean square displacement of the solver's points.",
            "A discretisation from which the model has diverged up to a frame is left out of the "
            "means of that frame and counted.",
        ],
        draw=_drawing(shown),
    )


def pairwise_difference(position: Float[Tensor, "n p d"]) -> float | None:
    """Mean over pairs of the root mean square distance of corresponding points [m].

    Args:
        position: The same points by several discretisations [m].
    """
    parts = [_distance(one, other) for one, other in combinations(position, 2)]
    return fmean(parts) if parts else None


def _distance(one: Float[Tensor, "p d"], other: Float[Tensor, "p d"]) -> float:
    """Root mean square distance of corresponding points [m]."""
    return float((one - other).square().sum(dim=1).mean().sqrt())


def _shown(study: Study, method: str, name: str) -> dict[str, Any]:
    """Samples at some frames, and the numbers of a method."""

    def make() -> dict[str, Any]:
        simulator = trained_model(study, name)
        trajectory = first_test_trajectory(study, SYSTEM)
        if simulator is None:
            return {"rows": [{"method": method, "diverged": "no model"}], "clouds": []}
        return _compared(simulator, trajectory, method=method)

    key = {"trial": name, "frames": FRAMES}
    return study.kept("figure5a", key, make)


def _compared(simulator: Simulator, trajectory: Trajectory, *, method: str) -> dict[str, Any]:
    """Roll a model out from every discretisation and compare what is recovered."""
    history = simulator.config.features.history
    last = min(FRAMES, trajectory.frame_count - 1)
    frames = last - history + 1
    shown = torch.linspace(last / INSTANTS, last, INSTANTS).round().long()
    instants = (shown - history).clamp(min=0)
    start = trajectory.position[0]
    count = len(simulator.sample(start))
    sparse, full, ends = [], [], []
    for seed in range(DISCRETISATIONS):
        samples = sample_random(start, count, generator=torch.Generator().manual_seed(seed))
        case = roll(simulator, trajectory, samples=samples, frames=frames)
        sparse.append(case.rollout.position[instants])
        decode = simulator.decoder(start, trajectory.kinematic, samples=samples)
        full.append(torch.stack([decode(frame) for frame in case.rollout.position])[instants])
        ends.append(case.rollout.diverged_at or frames + 1)
    same = {"method": method, "points": len(start), "sparse_points": count}
    rows = []
    for number, instant in enumerate(instants.tolist()):
        alive = [
            motion[number] for motion, end in zip(full, ends, strict=True) if instant + 1 < end
        ]
        row = same | {"diverged": f"{DISCRETISATIONS - len(alive)}/{DISCRETISATIONS}"}
        rows.append(row | _numbers(alive, trajectory, history + instant))
    return {
        "rows": rows,
        "clouds": [plain(position) for position in sparse],
        "bounds": trajectory.bounds.tolist(),
    }


def _numbers(found: list[Tensor], trajectory: Trajectory, frame: int) -> dict[str, Any]:
    """How far the recovered bodies are from each other and from the truth at a frame."""
    truth = trajectory.position[frame]
    scale = _distance(truth, trajectory.position[0])
    difference = pairwise_difference(torch.stack(found)) if found else None
    error = fmean(_distance(one, truth) for one in found) if found else None
    return {
        "frame": frame,
        "difference": difference,
        "difference_over_displacement": _share(difference, scale),
        "error": error,
        "error_over_displacement": _share(error, scale),
        "displacement": scale,
    }


def _share(value: float | None, whole: float) -> float | None:
    return None if value is None else value / whole


def _drawing(shown: dict[str, dict[str, Any]]) -> Callable[[Any], None]:
    def draw(figure: Any) -> None:
        known = {method: one for method, one in shown.items() if one["clouds"]}
        columns, rows = DISCRETISATIONS, INSTANTS * max(1, len(known))
        figure.set_size_inches(2.3 * columns, 2.2 * rows)
        for block, (method, one) in enumerate(known.items()):
            for number in range(INSTANTS):
                for seed, cloud in enumerate(one["clouds"]):
                    place = (block * INSTANTS + number) * columns + seed + 1
                    axes = figure.add_subplot(rows, columns, place, projection="3d")
                    frame = one["rows"][number]["frame"]
                    title = f"{method}, frame {frame}, sample {seed + 1}"
                    draw_space(axes, cloud[number], bounds=one["bounds"], title=title)
        figure.suptitle(TITLE)

    return draw
