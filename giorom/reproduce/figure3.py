"""Figure 3: ways to connect the samples, and where a rollout on each of them ends.

The claim behind it: a graph with more components than the body falls apart or collapses, and
neither random samples nor a triangulation replace the radius.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from giorom.evaluation.mechanics import number_density, smallest_distance, volume_ratio
from giorom.evaluation.stage_speed import connect_at
from giorom.graph import choose_radius, nearest_distances, radius_edges
from giorom.reproduce.pictures import PREDICTED, TRUE, draw_cloud
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import (
    Case,
    edges_between,
    first_test_trajectory,
    joined_components,
    plain,
    roll,
    train_tuned,
    trained_model,
)
from giorom.reproduce.study import Study, Trial
from giorom.state import Trajectory

TITLE = "Figure 3: graphs of a drop of water, and the last frame of a rollout on each"

SYSTEM, METHOD, FRAMES = "water2d", "io-not-io", 200
"""What is rolled out, and for how long."""

SPLIT = 0.6
"""Radius of the graph that falls apart, in units of the smallest that does not."""


@dataclass(frozen=True, kw_only=True)
class Graph:
    """A way to sample and to connect."""

    name: str
    """Name of the row."""

    title: str
    """What a panel says."""

    changes: dict[str, Any] = field(default_factory=dict)
    """How its model was trained otherwise than the others."""

    is_split: bool = False
    """Whether the rollout has a radius below that of the training, at which the graph splits."""


GRAPHS = (
    Graph(name="split", title="farthest points, radius too small", is_split=True),
    Graph(name="random", title="random points, radius", changes={"sampling": {"method": "random"}}),
    Graph(name="farthest", title="farthest points, radius"),
    Graph(
        name="delaunay",
        title="farthest points, Delaunay",
        changes={"graph": {"kind": "delaunay"}},
    ),
    Graph(
        name="delaunay_official",
        title="farthest points, official Delaunay",
        changes={"graph": {"kind": "delaunay_official"}},
    ),
)
"""Beside the full-order graph, which the solver moves."""

COLUMNS = [
    "graph",
    "points",
    "radius",
    "edges",
    "degree",
    "components",
    "rollout_mse",
    "volume_ratio",
    "smallest_distance",
    "true_smallest_distance",
    "diverged_at",
]


def run(study: Study) -> Result:
    """Train a model for each graph and roll it out."""
    trials = [
        Trial(system=SYSTEM, method=METHOD, seed=study.seed, changes=graph.changes)
        for graph in GRAPHS
    ]
    names = train_tuned(study, trials)
    pairs = zip(GRAPHS, names, strict=True)
    panels = [_full(study), *(_panel(study, graph, name) for graph, name in pairs)]
    return Result(
        id="figure3",
        title=TITLE,
        columns=COLUMNS,
        rows=[panel["row"] for panel in panels],
        notes=[
            f"The first trajectory of the test split, {FRAMES} frames or as many as there are. "
            f"Edges are pairs of different particles, each once, of the graph of the first step; "
            f"`degree` is the mean number of other particles that send to a particle.",
            "Each model was trained with the graph and the sampling it is shown with, except for "
            "the radius that is too small: there the model of the third row is rolled out at "
            f"{SPLIT:g} of the smallest radius that keeps the body in one piece.",
            "The official Delaunay graph keeps three edges of each simplex, in one direction, "
            "without self-loops; in two dimensions, those are all its edges. The other one has "
            "both directions and self-loops.",
            "`volume ratio` is the area of the predicted points at the last frame over that of "
            "the true ones (sum of inverse densities): below one, the drop has collapsed.",
        ],
        draw=_drawing(panels),
    )


def _full(study: Study) -> dict[str, Any]:
    """The full-order body: its graph at the first frame, and the solver's last one."""

    def make() -> dict[str, Any]:
        trajectory = first_test_trajectory(study, SYSTEM)
        start = trajectory.position[0]
        radius = choose_radius(start, start, margin=1.0).full_radius
        edges = radius_edges(start, torch.zeros(len(start), dtype=torch.long), radius)
        last = min(FRAMES, trajectory.frame_count - 1)
        numbers = _counts(edges) | {"radius": radius, "graph": "full order, the solver"}
        nearest = smallest_distance(trajectory.position[last])
        return {
            "title": "all particles, the solver",
            "row": numbers | {"smallest_distance": nearest, "true_smallest_distance": nearest},
            "start": plain(start),
            "pairs": edges_between(edges).tolist(),
            "end": plain(trajectory.position[last]),
            "bounds": trajectory.bounds.tolist(),
            "frame": last,
        }

    return study.kept("figure3-full", {"data": study.dataset(SYSTEM).name, "frames": FRAMES}, make)


def _panel(study: Study, graph: Graph, name: str) -> dict[str, Any]:
    """A graph and the rollout on it."""

    def make() -> dict[str, Any]:
        trajectory = first_test_trajectory(study, SYSTEM)
        simulator = trained_model(study, name)
        if simulator is None:
            return _empty(graph, trajectory)
        samples = simulator.sample(trajectory.position[0])
        radius = simulator.config.graph.radius
        if graph.is_split:
            start = trajectory.position[0]
            radius = SPLIT * choose_radius(start[samples], start, margin=1.0).smallest
        connect = connect_at(simulator, radius, rescaled=False)
        case = roll(simulator, trajectory, samples=samples, frames=FRAMES, connect=connect)
        return _shown(graph, case, trajectory, radius=radius)

    key = {"trial": name, "graph": graph.name, "frames": FRAMES}
    return study.kept("figure3", key, make)


def _shown(graph: Graph, case: Case, trajectory: Trajectory, *, radius: float) -> dict[str, Any]:
    """What the figure shows of a rollout, as JSON values."""
    last, true = case.rollout.position[-1], case.truth[-1]
    row = {"graph": graph.name} | _counts(case.edges) | {"rollout_mse": case.mse}
    row |= {
        "radius": radius if graph.changes.get("graph") is None else None,
        "diverged_at": case.rollout.diverged_at,
        "smallest_distance": smallest_distance(last),
        "true_smallest_distance": smallest_distance(true),
        "volume_ratio": _volume_ratio(case),
    }
    return {
        "title": graph.title,
        "row": row,
        "start": plain(case.given[-1]),
        "pairs": edges_between(case.edges).tolist(),
        "end": plain(last),
        "bounds": trajectory.bounds.tolist(),
        "frame": len(case.given) - 1 + len(case.truth),
    }


def _volume_ratio(case: Case) -> float:
    """Area of the predicted points at the last frame over that of the true ones."""
    spacing = float(nearest_distances(case.given[0].cpu().double().numpy()).mean())
    ends = (case.rollout.position[-1], case.truth[-1])
    return volume_ratio(*(number_density(end, spacing=spacing) for end in ends))


def _counts(edges: Any) -> dict[str, Any]:
    """Sizes of a graph."""
    count = len(edges.offset) - 1
    others = int((edges.sender != edges.receiver).sum())
    return {
        "points": count,
        "edges": len(edges_between(edges)),
        "degree": others / count,
        "components": joined_components(edges),
    }


def _empty(graph: Graph, trajectory: Trajectory) -> dict[str, Any]:
    """What is shown of a training that left no model."""
    return {
        "title": f"{graph.title}: every validation rollout diverged",
        "row": {"graph": graph.name, "rollout_mse": None, "diverged_at": 0},
        "start": [],
        "pairs": [],
        "end": [],
        "bounds": trajectory.bounds.tolist(),
        "frame": 0,
    }


def _drawing(panels: list[dict[str, Any]]) -> Callable[[Any], None]:
    def draw(figure: Any) -> None:
        figure.set_size_inches(2.4 * len(panels), 5.6)
        above, below = figure.subplots(2, len(panels))
        for number, (panel, first, last) in enumerate(zip(panels, above, below, strict=True)):
            row, color = panel["row"], PREDICTED if number else TRUE
            size = 6.0 if number else 1.5
            count = row.get("components")
            text = "" if count is None else f"\n{row['edges']} edges, {count} component(s)"
            options = {"bounds": panel["bounds"], "color": color, "size": size}
            start, end = (panel[name] or [[0.0, 0.0]][:0] for name in ("start", "end"))
            title = f"{panel['title']}{text}"
            draw_cloud(first, _cloud(start), pairs=panel["pairs"], title=title, **options)
            mse = row.get("rollout_mse")
            ending = f"frame {panel['frame']}"
            if row.get("diverged_at") is not None:
                ending = f"diverged at step {row['diverged_at']}"
            elif mse is not None:
                ending += f", rollout MSE {mse:.2g} m$^2$"
            draw_cloud(last, _cloud(end), title=ending, **options)
        figure.suptitle(TITLE)

    return draw


def _cloud(points: list) -> Any:
    """Points as an array of two columns, even if there are none."""
    return torch.tensor(points, dtype=torch.float64).reshape(-1, 2).numpy()
