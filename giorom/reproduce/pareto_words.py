"""What the chart of error against time says, in sentences made from its rows."""

from typing import Any


def notes_of(rows: list[dict[str, Any]], *, floor: float | None, rollout_frames: int) -> list[str]:
    """The findings first, then how the columns are counted.

    Args:
        rows: The rows of the chart.
        floor: Noise floor [m^2]; none if it could not be measured.
        rollout_frames: Frames of a rollout.
    """
    return [
        *_front(rows),
        *_verdict(rows),
        *_ours(rows),
        *_unsound(rows),
        _floor(rows, floor),
        *_definitions(rollout_frames),
    ]


def _front(rows: list[dict[str, Any]]) -> list[str]:
    best = sorted(
        (row for row in rows if row.get("on_front")), key=lambda row: row["seconds_per_frame"]
    )
    listed = "; ".join(f"{row['method']} ({_points(row)})" for row in best)
    return [f"On the front, from the fastest to the most exact: {listed}."]


def _verdict(rows: list[dict[str, Any]]) -> list[str]:
    """Whether any model pays, in one sentence."""
    models = _scored(rows)
    paying = [row for row in models if row["pays_back_after"] != "never"]
    if not models:
        return ["Every rollout of every model diverged: the solver wins."]
    if not paying:
        return [
            "The solver wins: coarser runs of it are at least as fast as every model at the error "
            "of that model, so that no number of rollouts pays for data and training."
        ]
    losing = len(models) - len(paying)
    listed = "; ".join(
        f"{row['method']} after {row['pays_back_after']:.3g} rollouts"
        for row in sorted(paying, key=lambda row: row["pays_back_after"])
    )
    others = (
        f" At the error of the others ({losing}) the solver is at least as fast, so that they "
        f"never pay back."
    )
    return [f"Cheaper than the solver at equal error: {listed}.{others if losing else ''}"]


def _ours(rows: list[dict[str, Any]]) -> list[str]:
    """Ours beside the solver, sample count by sample count."""
    lines = []
    for row in _scored(rows):
        if row["name"] != "default":
            continue
        own, solver = row["seconds_per_frame"], row["solver_seconds_per_frame"]
        factor = solver / own
        relation = f"{factor:.3g} x ours" if factor >= 1.0 else f"{1.0 / factor:.3g} x less"
        lines.append(
            f"Ours with {row['points']} samples: {1e3 * own:.3g} ms a frame; the solver takes "
            f"{1e3 * solver:.3g} ms at the same error, {relation}."
        )
    return lines


def _unsound(rows: list[dict[str, Any]]) -> list[str]:
    lost = [
        f"{row['method']} ({row['diverged']} of {row['trajectories']})"
        for row in rows
        if row.get("diverged") and row.get("trajectories")
    ]
    if not lost:
        return []
    return [
        f"Rollouts that diverged or broke a guard are counted, in no mean, and their rows are not "
        f"on the front: {'; '.join(lost)}."
    ]


def _floor(rows: list[dict[str, Any]], floor: float | None) -> str:
    if floor is None:
        return "The noise floor could not be measured: the re-seeded runs broke a guard."
    below = [row["method"] for row in _known(rows) if row["full_rollout_mse"] < floor]
    told = f"Below it: {'; '.join(below)}." if below else "No row lies below it."
    return (
        f"Noise floor: {floor:.3g} m², the error of the full-order solver against itself when its "
        f"particles are seeded up to a quarter of their spacing elsewhere. Smaller errors say "
        f"nothing about the body. {told}"
    )


def _definitions(rollout_frames: int) -> list[str]:
    return [
        "`full_rollout_mse`: mean squared distance of all particles over all frames in m², the "
        "given frames counted as zero, as in the paper; the solver is given one frame, ours as "
        "many as its history, a network more.",
        "`seconds_per_frame`: median over frames and test trajectories after one frame of warm-up, "
        "one thread or the GPU, graph, network, integration and recovery of all particles "
        "included; the solver by the same clock, with the same field.",
        "The solver's material points are farthest point samples with the volume of what they "
        "stand for, either as many to a cell as in the full-order run or as many as ours has. "
        "The largest stable step is found on a validation trajectory: no guard broken and an error "
        "at most a tenth above that of the step its rules allow (or above the noise floor).",
        f"`upfront_seconds`: simulating the data, training and tuning; values of our preset were "
        f"chosen while it was developed, which is not counted. A rollout has {rollout_frames} "
        f"frames.",
        "`pays_back_after`: N* = (data + training + tuning) / (solver - model), rollouts until a "
        "model has cost less than the solver at the error of the model "
        "(`solver_seconds_per_frame`, interpolated between logarithms on the front of the solver).",
        "One training of each model, of the first seed; Table 3 has the range over seeds.",
    ]


def _scored(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Models that have an error and a time."""
    return [row for row in rows if row["kind"] == "model" and row["pays_back_after"] is not None]


def _known(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["full_rollout_mse"] is not None]


def _points(row: dict[str, Any]) -> str:
    return f"{row['points']} points, {1e3 * row['seconds_per_frame']:.3g} ms"
