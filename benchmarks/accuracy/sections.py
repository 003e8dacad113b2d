"""Sections of the report: tables of what was measured, a line of explanation before each."""

from typing import Any

from benchmarks.accuracy.requirements import TRIVIAL
from giorom.evaluation.comparison import REPORT_FRAMES

Models = dict[str, dict[str, Any]]
"""Contents of ``metrics.json`` by name of the model."""


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows), ""])


def number(value: float | None, *, spread: float | None = None) -> str:
    """Three digits, with a spread; a dash where there is no number."""
    if value is None:
        return "-"
    return f"{value:.3g}" if spread is None else f"{value:.3g} ± {spread:.2g}"


def against_paper(models: Models) -> str:
    """Errors, sizes and cost, ours and the paper's."""
    rows = []
    for name, metrics in models.items():
        paper = metrics.get("paper") or {}
        sparse, full = metrics["sparse"] or {}, metrics["full"] or {}
        rows.append(
            [
                name,
                f"{metrics['frames']} / {paper.get('frames', '-')}",
                f"{metrics['points']} / {paper.get('points', '-')}",
                f"{metrics['sparse_points']} / {paper.get('sparse_points', '-')}",
                number(sparse.get("one_step_mse"), spread=sparse.get("one_step_mse_std")),
                number(full.get("one_step_mse"), spread=full.get("one_step_mse_std")),
                number(paper.get("one_step_mse")),
                number(full.get("rollout_mse"), spread=full.get("rollout_mse_std")),
                number(paper.get("rollout_mse")),
                number(sparse.get("rollout_mse"), spread=sparse.get("rollout_mse_std")),
                number(paper.get("sparse_rollout_mse")),
                number(full.get("projection_floor_mse")),
                f"{metrics['diverged']} of {metrics['trajectories']}",
                _cost(metrics.get("training") or {}),
            ]
        )
    header = [
        "model",
        "frames, ours / paper's",
        "particles",
        "samples",
        "one step, samples",
        "one step, all",
        "paper (Table 1)",
        "rollout, all",
        "paper (Table 1)",
        "rollout, samples",
        "paper (Table 3)",
        "field alone",
        "diverged",
        "training",
    ]
    text = (
        "## Beside the paper\n\n*field alone*: all particles recovered from true samples, an "
        "error that every number on all particles contains. "
        "The frames are those predicted; the given ones come on top.\n\n"
    )
    return text + table(header, rows)


def _cost(training: dict[str, Any]) -> str:
    if "seconds" not in training:
        return "-"
    device = training.get("device", "cpu")
    threads = f", {training['threads']} thread(s)" if "threads" in training else ""
    minutes = training["seconds"] / 60.0
    return f"{minutes:.1f} min, {training.get('steps', '?')} steps, {device}{threads}"


def against_paper_preset(models: Models) -> str:
    """Errors beside those of the paper's own network and training, on the same scenes."""
    rows = []
    for name, metrics in models.items():
        peer = metrics.get("paper_preset")
        if peer is None:
            continue
        seconds, steps = peer["training_seconds"], peer.get("training_steps")
        rows.append([name, "ours", *_as_long(metrics, metrics["training"])])
        rows.append([name, "paper", *_as_long(peer, {"seconds": seconds, "steps": steps})])
    text = (
        "## Beside the paper's own network and training\n\nThe recipe `NAME+paper` for as long on "
        "one core of the same machine, scored on the same scenes; diverged rollouts are left out "
        "of its means, which flatters it. It is made for 5e6 steps and gets some tens here: an "
        "equal time, and no judgement of what it learns in days.\n\n"
    )
    header = ["model", "recipe", "training", "diverged", "one step, samples"]
    return text + table([*header, "rollout, samples", "rollout, all"], rows) if rows else ""


def _as_long(found: dict[str, Any], training: dict[str, Any]) -> list[str]:
    """Training, divergence and errors of one side of an equal training time."""
    sparse, full = found["sparse"] or {}, found["full"] or {}
    seconds, steps = training.get("seconds"), training.get("steps")
    return [
        f"{number(seconds)} s, {steps or '?'} steps",
        f"{found['diverged']} of {found['trajectories']}",
        number(sparse.get("one_step_mse")),
        *(
            number(score.get("rollout_mse"), spread=score.get("rollout_mse_std"))
            for score in (sparse, full)
        ),
    ]


def against_trivial(models: Models) -> str:
    """Errors until some frames beside predictions without a model."""
    rows = []
    for name, metrics in models.items():
        for where, label in (("sparse", "samples"), ("full", "all")):
            scores = metrics[where] or {}
            for frame in [*(str(f) for f in REPORT_FRAMES), "end"]:
                own = _until(scores, "rollout", frame)
                if own is None:
                    continue
                cells = [_with_ratio(_until(scores, key, frame), own) for key in TRIVIAL]
                rows.append([name, label, frame, number(own), *cells])
    text = (
        "## Beside what needs no model\n\nMean error until a frame, and in brackets how many "
        "times the model is below it. The oracle knows the true centroid of each body at every "
        "frame and keeps the shape of the start: nothing of the deformation, all of the way.\n\n"
    )
    return text + table(["model", "points", "until", "model MSE", *TRIVIAL.values()], rows)


def _until(scores: dict[str, Any], key: str, frame: str) -> float | None:
    if frame == "end":
        return scores.get(f"{key}_mse")
    return scores.get(f"{key}_mse_at", {}).get(frame)


def _with_ratio(value: float | None, own: float) -> str:
    if value is None:
        return "-"
    return f"{value:.3g} ({value / own:.3g})" if own else f"{value:.3g}"


def distributions(models: Models) -> str:
    """Distances between clouds, and where the last frame is."""
    rows = []
    for name, metrics in models.items():
        scores = metrics["full"] or {}
        for key, label in (
            ("chamfer", "Chamfer [m^2]"),
            ("density_difference", "density difference"),
            ("sliced_wasserstein", "sliced Wasserstein [m^2]"),
        ):
            others = [
                scores.get(f"{base}_{key}") for base in ("static", "free_fall", "frozen_shape")
            ]
            if scores.get(key) is not None:
                last = scores[f"final_{key}"]
                rows.append([name, label, number(scores[key]), number(last), *map(number, others)])
        for key, label in (
            ("final_centroid_error", "centroid [m]"),
            ("final_bounding_box_error", "bounding box [m]"),
        ):
            if scores.get(key) is not None:
                rows.append([name, label, "-", number(scores[key]), "-", "-", "-"])
    text = (
        "## Where the material is\n\nDistances between the clouds of all particles, whichever "
        "particle is where: means over every 25th frame, and the last one. *Chamfer*: squared "
        "distance to the nearest, both ways added. *Density difference*: share of the material in "
        "another cell of a grid of 16^2 or 8^3 cells. *Sliced Wasserstein*: squared, mean over "
        "16 directions.\n\n"
    )
    header = ["model", "measure", "model, mean", "at the end", "still", "free fall", "oracle"]
    return text + table(header, rows) if rows else ""


def swings(models: Models) -> str:
    """Period and amplitude of clamped bodies."""
    rows = []
    for name, metrics in models.items():
        scores = metrics["full"] or {}
        if scores.get("swing_period") is not None:
            keys = ("period", "period_ratio", "period_deviation", "amplitude_ratio")
            values = [number(scores[f"swing_{key}"]) for key in (*keys, "amplitude_deviation")]
            rows.append([name, number(scores.get("swing_seen")), *values])
    text = (
        "## Swinging bodies\n\nThe first principal component of the true displacements of all "
        "particles, and the part of the predicted ones in it; period of the sine that explains "
        "most of it. Ratios are predicted over true; deviations are means of |ratio - 1| over "
        "bodies of which a period is seen, whose share is given.\n\n"
    )
    header = [
        "model",
        "bodies of which a period is seen",
        "true period [frames]",
        "period ratio",
        "deviation",
        "amplitude ratio",
        "deviation",
    ]
    return text + table(header, rows) if rows else ""


def stability(models: Models) -> str:
    """What became of long rollouts."""
    rows = []
    for name, metrics in models.items():
        found = metrics.get("stability")
        if found is None:
            rows.append([name, *["not measured"] * 7])
            continue
        rows.append(
            [
                name,
                str(found["scenes"]),
                f"{found['frames']} ({found['horizons']:g} horizons)",
                str(found["lost"]),
                str(found["not_finite"]),
                str(found["beyond_walls"]),
                "-" if found["first_loss"] is None else str(found["first_loss"]),
                f"{number(found['largest_excursion'])} of {number(found['tolerance'])}",
            ]
        )
    text = (
        "## Long rollouts\n\nRandom scenes rolled out on the samples. Lost is what is not finite "
        "or farther beyond a wall than the solver itself may press a particle (0.6 of its grid "
        "cells).\n\n"
    )
    header = ["model", "scenes", "frames", "lost", "not finite", "beyond a wall", "first loss"]
    return text + table([*header, "farthest beyond a wall [m]"], rows)


def discretisation(models: Models) -> str:
    """Other numbers of samples, other shapes."""
    rows = []
    for name, metrics in models.items():
        for row in (metrics.get("discretisation") or {}).get("rows", []):
            rows.append(
                [
                    name,
                    row["setting"],
                    f"{row['sparse_points']} of {row['points']}",
                    f"{row['trajectories']} ({row['diverged']} diverged)",
                    number(row["full_one_step_mse"], spread=row["full_one_step_mse_std"]),
                    number(row["sparse_rollout_mse"], spread=row["sparse_rollout_mse_std"]),
                    number(row["full_rollout_mse"], spread=row["full_rollout_mse_std"]),
                    number(row["ratio"]),
                    number(row["full_static_mse"]),
                ]
            )
    text = (
        "## Other discretisations and shapes\n\nOne model, the same scenes for every number of "
        "samples, and shapes that no training scene has. Fewer samples: graph radius and its "
        "unit, or grid, grow with the distance between samples; more samples: all as trained. "
        "The ratio is the rollout error on all particles over that of the first row (the paper's "
        "Table 2: 4.5 at 4 x the samples).\n\n"
    )
    header = ["model", "setting", "samples", "trajectories", "one step, all", "rollout, samples"]
    header += ["rollout, all", "ratio", "holding still"]
    return text + table(header, rows) if rows else ""


def floors(noise_floors: dict[str, Any]) -> str:
    """How far the solver is from its own motion after a small change."""
    rows = []
    for name, found in noise_floors.items():
        for row in found["rows"]:
            frames = [str(frame) for frame in REPORT_FRAMES[1:]]
            until = [number(row["mse_until"].get(frame)) for frame in frames]
            at = [number(row["mse_at"].get(frame)) for frame in frames]
            last = frames[-1] if frames[-1] in row["mse_at_largest"] else None
            worst = number(row["mse_at_largest"][last]) if last else "-"
            rows.append([name, row["change"], str(row["scenes"]), *until, *at, worst])
    text = (
        "## What the solver itself does not repeat\n\nThe same scene simulated twice, the second "
        "time with a small change: independent normal noise on every velocity component, twice "
        "the substeps, or a finer grid (with walls and clamps where that grid has them). Mean "
        "squared distance of the same particles: mean until a frame, comparable with a rollout's, "
        "and at that frame. Below the change of resolution an error says as much about the "
        "solver as about the surrogate.\n\n"
    )
    header = ["preset", "change", "scenes", "until 100", "until 200", "until 400"]
    header += ["at 100", "at 200", "at 400", "at 400, largest"]
    return text + table(header, rows) if rows else ""
