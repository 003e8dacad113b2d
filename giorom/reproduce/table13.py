"""Table 13: how the samples are chosen and joined, water in two dimensions.

The paper's Delaunay graphs end at 7 and 8 square metres in a box of one metre. Its code keeps of a
triangulation the edges of the first three corners of each simplex (in 2-D all), in one direction
and without self-loops; that graph and the whole one are trained on here, and a model of the radius
graph is run on both as well.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from giorom.data.trajectory_file import iterate_trajectories
from giorom.evaluation.discretisation import rebuilt
from giorom.graph import Edges
from giorom.pipeline import start_from_trajectory
from giorom.reproduce.ablation import (
    ERRORS,
    Variant,
    together,
    train_variants,
    trials_of,
)
from giorom.reproduce.changed_model import (
    changed_row,
    score_simulator,
    with_graph,
)
from giorom.reproduce.charts import OTHER, OURS, draw_paper, draw_rows, finish, name_places
from giorom.reproduce.compare import over_seeds, with_ratio
from giorom.reproduce.report import Result
from giorom.reproduce.rollouts import joined_components, trained_model
from giorom.reproduce.study import Study
from giorom.reproduce.trial import Trial
from giorom.simulator import Simulator
from giorom.state import Trajectory

TITLE = "Table 13: how samples are chosen and joined, water in 2-D"

SYSTEM = "water2d"
"""System of the table."""

SAMPLINGS = ("random", "farthest")
"""How samples are chosen."""

GRAPHS = {
    "radius": "radius",
    "delaunay": "Delaunay",
    "delaunay_official": "Delaunay, official code",
}
"""Kinds of ``GraphConfig`` and their names."""

PAPER = {
    ("random", "radius"): 9.8e-3,
    ("random", "delaunay_official"): 7.017,
    ("farthest", "radius"): 9.7e-3,
    ("farthest", "delaunay_official"): 8.04,
}
"""Rollout error [m^2]; Table 13 of arXiv:2407.03925v2. Its Delaunay graphs are those of the
official code."""

FRAMES = 8
"""Frames of each test trajectory at which graphs are looked at."""


def variants() -> list[Variant]:
    """One variant for each choice of samples and each graph."""
    return [
        Variant(
            system=SYSTEM,
            labels={"sampling": sampling, "graph": name, "trained_on": name},
            changes=_changes(sampling, kind),
            paper=PAPER.get((sampling, kind)),
        )
        for sampling in SAMPLINGS
        for kind, name in GRAPHS.items()
    ]


def _changes(sampling: str, kind: str) -> dict[str, Any]:
    """Nothing for what the preset is anyway, so that other tables share its trainings."""
    chosen = {} if sampling == "farthest" else {"sampling": {"method": sampling}}
    return together(chosen, {} if kind == "radius" else {"graph": {"kind": kind}})


def run(study: Study) -> Result:
    """Train with every graph, and run the model of the radius graph on the others."""
    made = variants()
    rows = train_variants(study, made)
    trained = trials_of(study, made)
    for trials, row in zip(trained, rows, strict=True):
        row.update(_graph_columns(study, trials, kind=None))
    rows += [_changed(study, trained[-len(GRAPHS)], kind) for kind in list(GRAPHS)[1:]]
    return Result(
        id="table13",
        title=TITLE,
        columns=[
            "sampling",
            "graph",
            "trained_on",
            "neighbors",
            "components",
            "longest_edge",
            "rollout_mse",
            "diverged",
            "paper",
            "ratio",
        ],
        rows=rows,
        notes=[
            "Neighbors: messages a sample receives from others; components: connected parts of "
            "the graph, directions aside; longest edge [m]: all three are means over frames of the "
            "test trajectories. A Delaunay graph joins what is far apart when the water splashes.",
            "Delaunay: all edges of all triangles, both directions, self-loops. Official code: "
            "from the lower to the higher number alone, no self-loops; the paper's numbers are "
            "taken to be of that one.",
            "The last two rows run the model that was trained on the radius graph on another one.",
            "Rollouts that leave the box by its width or are not finite are counted as diverged "
            "and left out of the mean; the paper averages them. Errors of the samples [m²].",
        ],
        draw=lambda figure: draw(figure, rows),
    )


def _changed(study: Study, trials: list[Trial], kind: str) -> dict[str, Any]:
    """The row of a model of the radius graph that is run on another one."""
    keys = [{"trial": study.folder(trial).name, "graph": kind} for trial in trials]
    scores = study.kept_all("another graph", keys, score_with_graph)
    labels = {"sampling": "farthest", "graph": GRAPHS[kind], "trained_on": GRAPHS["radius"]}
    row = labels | changed_row(study, trials, scores, ERRORS) | {"seeds": len(trials)}
    row |= _graph_columns(study, trials, kind=kind)
    return row | with_ratio(row["rollout_mse"], None)


def score_with_graph(study: Study, key: dict[str, Any]) -> dict[str, Any] | None:
    """Scores of a trained model on another kind of graph; none if there is no model.

    Args:
        study: Where the model is.
        key: ``trial`` and kind of ``graph``.
    """
    trained = trained_model(study, key["trial"])
    if trained is None:
        return None
    return score_simulator(
        study, rebuilt(trained, with_graph(trained.config, kind=key["graph"])), SYSTEM
    )


@dataclass(frozen=True, kw_only=True)
class GraphFacts:
    """What a graph of some samples is like."""

    neighbors: float
    """Edges that end at a sample and begin at another, on average."""

    components: int
    """Connected parts, directions aside."""

    longest_edge: float
    """Length of the longest edge [m]."""


def describe_graph(edges: Edges, position: np.ndarray) -> GraphFacts:
    """Degree, components and longest edge of a graph.

    Args:
        edges: The graph.
        position: Positions of its samples [m].
    """
    count, between = len(position), (edges.sender != edges.receiver).cpu().numpy()
    sender, receiver = edges.sender.cpu().numpy()[between], edges.receiver.cpu().numpy()[between]
    length = np.linalg.norm(position[sender] - position[receiver], axis=1)
    return GraphFacts(
        neighbors=len(sender) / count,
        components=joined_components(edges),
        longest_edge=float(length.max(initial=0.0)),
    )


def _graph_columns(study: Study, trials: list[Trial], *, kind: str | None) -> dict[str, Any]:
    """Graphs of the test trajectories with each of the models, as columns."""
    keys = [{"trial": study.folder(trial).name, "graph": kind} for trial in trials]
    found = study.kept_all("graphs of the test", keys, look_at_graphs)
    names = ("neighbors", "components", "longest_edge")
    row: dict[str, Any] = {}
    for name in names:
        row |= over_seeds(name, [None if one is None else one[name] for one in found])
    return row


def look_at_graphs(study: Study, key: dict[str, Any]) -> dict[str, float] | None:
    """Means over some frames of the test trajectories of what their graphs are like.

    Args:
        study: Where the model is.
        key: ``trial``, and the kind of ``graph`` or none for its own.
    """
    simulator = trained_model(study, key["trial"])
    if simulator is None:
        return None
    if key["graph"] is not None:
        simulator = rebuilt(simulator, with_graph(simulator.config, kind=key["graph"]))
    facts = [
        fact
        for trajectory in iterate_trajectories(study.dataset(SYSTEM), "test")
        for fact in _facts_of(simulator, trajectory.to(study.device))
    ]
    return {
        name: float(np.mean([getattr(fact, name) for fact in facts]))
        for name in ("neighbors", "components", "longest_edge")
    }


def _facts_of(simulator: Simulator, trajectory: Trajectory) -> list[GraphFacts]:
    """Graphs at some frames of a trajectory."""
    history = simulator.config.features.history
    samples = simulator.sample(trajectory.position[0])
    frames = np.linspace(history - 1, trajectory.frame_count - 1, FRAMES).astype(int)
    found = []
    for frame in frames.tolist():
        state = start_from_trajectory(trajectory, samples, history=history, frame=frame)
        found.append(describe_graph(simulator.connect(state), state.position.cpu().numpy()))
    return found


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Errors of all rows; those of models on a graph they were not trained on in another colour."""
    axes = figure.add_subplot()
    names = [
        f"{row['sampling']}\n{row['graph']}".replace(", ", ",\n")
        + ("" if row["graph"] == row["trained_on"] else "\n(trained on radius)")
        for row in rows
    ]
    places = name_places(axes, names)
    axes.tick_params(axis="x", labelsize="x-small")
    own = [row["graph"] == row["trained_on"] for row in rows]
    for chosen, color, label in (
        (True, OURS, "trained on it"),
        (False, OTHER, "not trained on it"),
    ):
        some = [number for number, mine in enumerate(own) if mine is chosen]
        draw_rows(
            axes,
            [rows[number] for number in some],
            [places[number] for number in some],
            label=label,
            color=color,
            line=False,
        )
    draw_paper(axes, places, [row["paper"] for row in rows], line=False)
    finish(axes, x="samples and graph")
