"""Figure 7: what the radius of the graph at inference does to falling water.

The model is the same everywhere; below the radius at which the samples hold together they fly
apart or collapse, and above it the water grows stiff.
"""

from collections.abc import Callable
from typing import Any

from giorom.evaluation.mechanics import smallest_distance
from giorom.evaluation.stage_speed import connect_at
from giorom.reproduce.pictures import PREDICTED, TRUE, draw_cloud
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import (
    first_test_trajectory,
    joined_components,
    plain,
    roll,
    train_tuned,
    trained_model,
)
from giorom.reproduce.study import Study, Trial

TITLE = "Figure 7: water at five radii of the graph at inference"

RADII = (0.010, 0.015, 0.025, 0.040, 0.055)
"""Radii [m] (arXiv:2407.03925v2, Figure 7)."""

SYSTEM, METHOD, FRAMES = "water2d", "io-not-io", 200
"""What is rolled out, and for how long."""

SHARES = (0.25, 0.5, 1.0)
"""Frames that are shown, as shares of the rollout."""

COLUMNS = [
    "radius",
    "trained_radius",
    "degree",
    "components",
    "rollout_mse",
    "smallest_distance",
    "true_smallest_distance",
    "height",
    "true_height",
    "diverged_at",
]


def run(study: Study) -> Result:
    """Roll one trained model out at every radius."""
    (name,) = train_tuned(study, [Trial(system=SYSTEM, method=METHOD, seed=study.seed)])
    shown = [_shown(study, name, radius) for radius in RADII]
    return Result(
        id="figure7",
        title=TITLE,
        columns=COLUMNS,
        rows=[one["row"] for one in shown if one["row"]],
        notes=[
            "The first trajectory of the test split, one training. The graph alone changes; the "
            "features are measured in the trained radius (Table 11 has both).",
            "`smallest distance` and `height` (of the mean particle above the floor) are those of "
            "the last frame [m].",
        ],
        draw=_drawing(shown),
    )


def _shown(study: Study, name: str, radius: float) -> dict[str, Any]:
    """Snapshots and numbers at one radius."""

    def make() -> dict[str, Any]:
        trajectory = first_test_trajectory(study, SYSTEM)
        simulator = trained_model(study, name)
        if simulator is None:
            return {"row": {"radius": radius, "diverged_at": 0}, "clouds": [], "truth": []}
        connect = connect_at(simulator, radius, rescaled=False)
        samples = simulator.sample(trajectory.position[0])
        case = roll(simulator, trajectory, samples=samples, frames=FRAMES, connect=connect)
        count, length = len(samples), len(case.truth)
        chosen = [max(0, round(share * length) - 1) for share in SHARES]
        floor = float(trajectory.bounds[1, 0])
        ends = {"": case.rollout.position[-1], "true_": case.truth[-1]}
        row: dict[str, Any] = {
            "radius": radius,
            "trained_radius": simulator.config.graph.radius,
            "degree": (len(case.edges.sender) - count) / count,
            "components": joined_components(case.edges),
            "rollout_mse": case.mse,
            "diverged_at": case.rollout.diverged_at,
        }
        for prefix, end in ends.items():
            row[f"{prefix}smallest_distance"] = smallest_distance(end)
            row[f"{prefix}height"] = float(end[:, 1].mean()) - floor
        return {
            "row": row,
            "clouds": [plain(case.rollout.position[frame]) for frame in chosen],
            "truth": [plain(case.truth[frame]) for frame in chosen],
            "frames": [len(case.given) + frame for frame in chosen],
            "bounds": trajectory.bounds.tolist(),
        }

    key = {"trial": name, "radius": radius, "frames": FRAMES}
    return study.kept("figure7", key, make)


def _drawing(shown: list[dict[str, Any]]) -> Callable[[Any], None]:
    def draw(figure: Any) -> None:
        known = [one for one in shown if one["clouds"]]
        columns = len(known) + 1
        figure.set_size_inches(2.2 * columns, 2.3 * len(SHARES))
        panels = figure.subplots(len(SHARES), columns, squeeze=False)
        for number, line in enumerate(panels):
            for axes, one in zip(line, known, strict=False):
                row, frame = one["row"], one["frames"][number]
                title = f"radius {row['radius']:g} m, frame {frame}"
                if row["diverged_at"] is not None:
                    title += f"\ndiverged at step {row['diverged_at']}"
                options = {"bounds": one["bounds"], "color": PREDICTED}
                draw_cloud(axes, one["clouds"][number], title=title, **options)
            if known:
                one = known[0]
                title = f"the solver, frame {one['frames'][number]}"
                draw_cloud(
                    line[-1], one["truth"][number], bounds=one["bounds"], title=title, color=TRUE
                )
        figure.suptitle(TITLE)

    return draw
