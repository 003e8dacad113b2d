"""Figure 6: how sparse the samples may be, a clamped elastic body.

Each share of the particles is trained anew; at the sparsest one, the radius of the graph as well.
The paper has one body of 78,000 particles, so that its smallest share is of 546 samples.
"""

from itertools import islice
from typing import Any

from giorom.data.metadata import read_metadata
from giorom.data.trajectory_file import iterate_trajectories
from giorom.reproduce.ablation import (
    NETWORK,
    TIMED_FRAMES,
    Variant,
    frame_cost,
    train_variants,
    trials_of,
)
from giorom.reproduce.charts import OTHER, OURS, draw_paper, draw_rows, finish
from giorom.reproduce.methods import METHODS
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study
from giorom.reproduce.trial import Trial
from giorom.training_data import RADIUS_BODIES, choose_common_radius

TITLE = "Figure 6: sparser samples, elastic body"

SYSTEM = "elastic3d"
"""System of the figure."""

PAPER = {
    1.0: (0.010, 7.00, 108.5, 7.0e-3),
    0.5: (0.020, 4.10, 74.7, 3.0e-3),
    0.25: (0.050, 5.50, 83.9, 1.4e-3),
    0.125: (0.060, 4.03, 55.0, 1e-4),
    0.062: (0.060, 1.10, 15.2, 3e-4),
    0.031: (0.060, 0.37, 5.5, 1e-4),
    0.015: (0.060, 0.13, 2.8, 1.1e-3),
    0.007: (0.060, 0.11, 2.2, 2.19e-2),
}
"""Radius [m], memory [GB], seconds of a rollout and its error [m^2] by share of the particles; read
off Figure 6 of arXiv:2407.03925v2."""

PAPER_RADII = {0.02: 0.297, 0.04: 0.129, 0.06: 0.022, 0.15: 9.8e-3, 0.45: 0.025}
"""Rollout error [m^2] by radius [m] at the share 0.007; read off the same figure."""

USUAL_RADIUS = 0.06
"""Radius of the paper at that share [m], of which the others are multiples."""

STEPS = 120
"""Frames of the paper's rollout."""

FEWEST = 12
"""Fewest samples that say anything of a body."""

NETWORK_SAMPLES = 3000
"""Most samples on which the network is trained without a GPU."""

SEEDS = 2
"""Most trainings of each variant."""

COLORS = {NETWORK: OURS, "default": OTHER}
"""Methods that are trained, and their colours."""


def ratio_variants(points: int, *, large: bool) -> list[Variant]:
    """Every method at every share that leaves enough samples and, for the network, not too many.

    Args:
        points: Particles of the largest body.
        large: Whether the network is trained on any number of samples.
    """
    return [
        Variant(
            system=SYSTEM,
            method=method,
            labels={"method": METHODS[method].title, "share": share, "radius_times": 1.0},
            changes=_sampled(share),
            paper=PAPER[share][3] if method == NETWORK else None,
        )
        for method in COLORS
        for share in PAPER
        if points * share >= FEWEST
        and (large or method != NETWORK or points * share <= NETWORK_SAMPLES)
    ]


def radius_variants(share: float, radius: float) -> list[Variant]:
    """The network at the sparsest share with multiples of the radius that the rule gives it [m]."""
    return [
        Variant(
            system=SYSTEM,
            labels={
                "method": METHODS[NETWORK].title,
                "share": share,
                "radius_times": paper_radius / USUAL_RADIUS,
            },
            changes=_sampled(share) | {"graph": {"radius": radius * paper_radius / USUAL_RADIUS}},
            paper=error,
        )
        for paper_radius, error in PAPER_RADII.items()
        if paper_radius != USUAL_RADIUS
    ]


def _sampled(share: float) -> dict[str, Any]:
    return {"sampling": {"count": None, "reduction": 1.0 / share}}


def run(study: Study) -> Result:
    """Train at every share, then with every radius at the sparsest."""
    points = read_metadata(study.dataset(SYSTEM))["num_particles_max"]
    seeds = study.seeds[:SEEDS]
    made = ratio_variants(points, large=study.scale.needs_gpu)
    shares = [variant.labels["share"] for variant in made if variant.method == NETWORK]
    rows = train_variants(study, made, seeds=seeds, full=True)
    others = radius_variants(shares[-1], usual_radius(study, shares[-1]))
    rows += train_variants(study, others, seeds=seeds, full=True)
    every = [*made, *others]
    for variant, trials, row in zip(every, trials_of(study, every, seeds=seeds), rows, strict=True):
        row.update(_costs(study, variant, trials))
    return Result(
        id="figure6",
        title=TITLE,
        columns=[
            "method",
            "share",
            "samples",
            "radius_times",
            "edges",
            "rollout_mse",
            "full_rollout_mse",
            "diverged",
            "paper",
            "ratio",
            "rollout_seconds",
            "upscale_seconds",
            "gigabytes",
            "paper_seconds",
            "paper_gigabytes",
        ],
        rows=rows,
        notes=_notes(seeds, study),
        draw=lambda figure: draw(figure, rows, sparsest=shares[-1]),
    )


def usual_radius(study: Study, share: float) -> float:
    """Graph radius that the rule of the package gives at a share of the particles [m]."""
    trajectories = iterate_trajectories(study.dataset(SYSTEM), "train")
    experiment = study.experiment(SYSTEM, NETWORK, _sampled(share))
    return choose_common_radius(list(islice(trajectories, RADIUS_BODIES)), experiment).radius


def _costs(study: Study, variant: Variant, trials: list[Trial]) -> dict[str, Any]:
    """Samples, seconds of a rollout and memory, and what the paper has for them."""
    share, row = variant.labels["share"], {}
    if variant.method == NETWORK and variant.labels["radius_times"] == 1.0:
        _, gigabytes, seconds, _ = PAPER[share]
        row = {"paper_seconds": seconds, "paper_gigabytes": gigabytes}
    cost = frame_cost(study, trials, upscale=True)
    if cost is None:
        return row
    return row | {
        "samples": cost["points"],
        "points": cost["body_points"],
        "edges": cost["edges"],
        "rollout_seconds": STEPS * cost["step_seconds"],
        "upscale_seconds": STEPS * cost["upscale_seconds"],
        "gigabytes": cost["peak_bytes"] / 1e9 or None,
    }


def _notes(seeds: list[int], study: Study) -> list[str]:
    notes = [
        f"Each row is trained anew, {len(seeds)} seed(s), equal time. The rollout error is that of "
        f"the samples, the full one that of all particles, recovered from them [m²].",
        f"Radius: as many times what the rule of the package gives at that share; the paper's "
        f"{USUAL_RADIUS:g} m is taken for 1. Our grid fixed to the body has no graph.",
        f"Seconds of {STEPS} frames: median of {TIMED_FRAMES} on one thread ({study.device}), "
        f"graph and stepper, and apart from them the recovery of all particles. Gigabytes that "
        f"a frame takes beyond program and weights, none where that cannot be seen; the "
        f"paper: of a GPU.",
        "The paper's body has 78,000 particles: its smallest share is of 546 samples.",
    ]
    if not study.scale.needs_gpu:
        notes.append(
            f"At this scale the network is not trained on more than {NETWORK_SAMPLES} samples, and "
            f"nothing on fewer than {FEWEST}."
        )
    return notes


def draw(figure: Any, rows: list[dict[str, Any]], *, sparsest: float) -> None:
    """Error, time and memory by share, and error by radius at the sparsest."""
    figure.set_size_inches(9.0, 7.0)
    error, seconds, memory, radius = figure.subplots(2, 2).flat
    shares = list(PAPER)
    panels = (
        (error, "rollout_mse", 3, "rollout MSE [m²]"),
        (seconds, "rollout_seconds", 2, f"time of {STEPS} frames [s]"),
        (memory, "gigabytes", 1, "memory [GB]"),
    )
    for axes, key, place, label in panels:
        for method, color in COLORS.items():
            title = METHODS[method].title
            some = [r for r in rows if r["method"] == title and r["radius_times"] == 1.0]
            draw_rows(axes, some, [r["share"] for r in some], key=key, label=title, color=color)
        draw_paper(axes, shares, [PAPER[share][place] for share in shares])
        finish(axes, x="samples / particles", y=label, legend=axes is error)
        axes.set_xscale("log")
        axes.invert_xaxis()
    title = METHODS[NETWORK].title
    some = [r for r in rows if r["method"] == title and r["share"] == sparsest]
    some.sort(key=lambda row: row["radius_times"])
    draw_rows(radius, some, [row["radius_times"] for row in some], label=title)
    times = [value / USUAL_RADIUS for value in PAPER_RADII]
    draw_paper(radius, times, list(PAPER_RADII.values()))
    finish(
        radius,
        x=f"radius / that of the rule, at {sparsest:g} of the particles",
        legend=False,
    )
    radius.set_xscale("log")
    radius.set_xticks(times, [f"{value:.2g}" for value in times])
    radius.minorticks_off()
