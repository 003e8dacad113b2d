"""The reduced-order models of section 5.4, as a task of their own: true samples in, all points out.

The paper recovers an elastic body of 78 thousand points from random sub-samples and compares POD,
an autoencoder and its neural field. Here the same on every three-dimensional system and on water in
the plane, with what the paper leaves out: interpolation that learns nothing.
"""

from functools import partial
from typing import Any

from giorom.reproduce.compare import over_seeds
from giorom.reproduce.reconstruction import Candidate, field_budget, score_fields
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study

TITLE = "Reduced-order models: all particles from true samples (section 5.4)"

SYSTEMS = ("elastic3d", "plasticine3d", "sand3d", "water3d", "water2d")
"""Physical systems; the paper's is the first."""

RANKS = (8, 16, 32, 64)
"""Coefficients of the linear bases."""

TINY_RANKS = (2, 4)
"""The same where a dozen frames are all there is to learn from."""

PAPER = {"pod": 6.00e-4, "autoencoder": 2.10e-4, "neural_basis": 7.59e-7}
"""Mean squared errors on elasticity; arXiv:2407.03925v2, section 5.4."""

GRID = {"snapshots": 256, "nodes": 4096}
"""Frames and places of which modes are made; half as many frames as by default."""

SWEEPS = 10
"""How often the gaps are filled; half as often as by default."""

TINY_GRID = {"snapshots": 16, "nodes": 125}
"""The same where it shall only be shown that all works."""

UNTRAINED = ("nearest", "shepard", "local", "local-linear", "transport")
"""Candidates that have no seed."""

COLUMNS = [
    "system",
    "field",
    "rank",
    "parameters",
    "relative_error",
    "relative_error_random_samples",
    "mse",
    "chamfer",
    "steps",
    "seconds",
    "ms_per_frame",
    "paper",
    "ratio",
]


def candidates(ranks: tuple[int, ...], grid: dict[str, int]) -> dict[str, Candidate]:
    """All rows by name.

    Args:
        ranks: Coefficients of the linear bases; the largest but one is that of the others.
        grid: Frames and places of which modes are made.
    """
    latent = ranks[-2]
    crom = {"latent": latent}
    found = [
        Candidate(name="nearest", title="nearest sample", kind="nearest"),
        Candidate(name="shepard", title="Shepard, 8 neighbours", kind="shepard"),
        Candidate(
            name="local-linear",
            title="moving least squares, linear",
            kind="local",
            settings={"degree": 1},
        ),
        Candidate(
            name="local",
            title="moving least squares, quadratic (ours for solids)",
            kind="local",
            settings={"degree": 2},
        ),
        Candidate(
            name="transport",
            title="moving least squares, tied anew (ours for the rest)",
            kind="transport",
        ),
        *_linear(ranks, grid),
        Candidate(
            name="pod-uncentred",
            title="POD, no mean subtracted",
            kind="pod",
            settings={"modes": latent, "sweeps": SWEEPS, **grid},
            rank=latent,
            group="pod",
        ),
        Candidate(
            name="pod-autoencoder",
            title="autoencoder of POD coefficients (after Lee and Carlberg)",
            kind="pod_autoencoder",
            settings={"modes": ranks[-1], "latent": latent, **grid},
            rank=latent,
            group="autoencoder",
            repeated=True,
        ),
        Candidate(
            name="autoencoder",
            title="set encoder, coordinate decoder",
            kind="autoencoder",
            settings=crom,
            rank=latent,
            group="autoencoder",
            repeated=True,
        ),
        Candidate(
            name="crom",
            title="CROM, width 128, ELU",
            kind="crom",
            settings=crom,
            rank=latent,
            repeated=True,
        ),
        Candidate(
            name="crom-sine",
            title="CROM, width 128, sine of frequency 1",
            kind="crom",
            settings=crom | {"activation": "sine"},
            rank=latent,
            repeated=True,
        ),
        Candidate(
            name="crom-published",
            title="CROM, published size",
            kind="crom",
            settings={"latent": 6, "width": 30},
            rank=6,
        ),
        Candidate(
            name="kernel",
            title="kernel of learned width (after v3)",
            kind="kernel",
            repeated=True,
        ),
        Candidate(
            name="kernel-rom",
            title="kernel ROM, published size (v3)",
            kind="kernel_rom",
            repeated=True,
        ),
    ]
    return {candidate.name: candidate for candidate in found}


def _linear(ranks: tuple[int, ...], grid: dict[str, int]) -> list[Candidate]:
    """Linear bases of every rank."""
    pod = [
        Candidate(
            name=f"pod-{rank}",
            title="POD, gappy, mean-centred",
            kind="pod",
            settings={"modes": rank, "center": True, "sweeps": SWEEPS, **grid},
            rank=rank,
            group="pod",
        )
        for rank in ranks
    ]
    neural = [
        Candidate(
            name=f"neural-basis-{rank}",
            title="neural basis (the paper's; LiCROM)",
            kind="neural_basis",
            settings={"modes": rank},
            rank=rank,
            group="neural_basis",
            repeated=rank == ranks[-2],
        )
        for rank in ranks
    ]
    return pod + neural


def run(study: Study) -> Result:
    """Train and score every field on every system."""
    tiny = study.scale.name == "tiny"
    known = candidates(TINY_RANKS, TINY_GRID) if tiny else candidates(RANKS, GRID)
    keys = [
        {
            "system": system,
            "data": study.dataset(system).name,
            "seed": seed,
            "fields": {name: [known[name].kind, known[name].settings] for name in names},
        }
        for system in SYSTEMS
        for number, seed in enumerate(study.seeds)
        for names in _shares(known, first=number == 0)
    ]
    scores: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for key, found in zip(keys, study.kept_all("fields", keys, score_fields), strict=True):
        for name, score in found.items():
            scores.setdefault((key["system"], name), []).append(score)
    rows = [
        _row(system, candidate, scores[system, candidate.name])
        for system in SYSTEMS
        for candidate in known.values()
    ]
    return Result(
        id="rom",
        title=TITLE,
        columns=COLUMNS,
        rows=rows,
        notes=_notes(study, rows),
        draw=partial(_draw, rows=rows),
    )


def _shares(known: dict[str, Candidate], *, first: bool) -> list[list[str]]:
    """Names of what one process does in one go.

    POD and what learns nothing know no seed; the other ranks and sizes are trained once.
    """
    again = [name for name, candidate in known.items() if candidate.repeated]
    if not first:
        return [again]
    fixed = [n for n, c in known.items() if n in UNTRAINED or c.kind == "pod"]
    return [again, [n for n in known if n not in again + fixed], fixed]


def _row(system: str, candidate: Candidate, scores: list[dict[str, Any]]) -> dict[str, Any]:
    """One row; a field that could not be made has no numbers and says why in the note."""
    sound = [score for score in scores if score["problem"] is None]
    row: dict[str, Any] = {
        "system": system,
        "field": candidate.title,
        "name": candidate.name,
        "rank": candidate.rank,
        "parameters": sound[0]["parameters"] if sound else None,
        "problem": next((s["problem"] for s in scores if s["problem"] is not None), None),
        "runs": len(sound),
    }
    columns = {
        "relative_error": ("own", "relative"),
        "relative_error_random_samples": ("random", "relative"),
        "mse": ("own", "mse"),
        "mse_random_samples": ("random", "mse"),
        "chamfer": ("own", "chamfer"),
        "chamfer_random_samples": ("random", "chamfer"),
    }
    for column, (where, name) in columns.items():
        row |= over_seeds(column, [score[where][name] for score in sound])
    for column in ("steps", "seconds"):
        row[column] = over_seeds(column, [float(score[column]) for score in sound])[column]
    times = [1e3 * score["own"]["seconds_per_frame"] for score in sound]
    row["ms_per_frame"] = over_seeds("ms", times)["ms"]
    row["per_trajectory"] = [value for s in sound for value in s["own"]["per_trajectory"]]
    row["paper"] = PAPER.get(candidate.group) if system == SYSTEMS[0] else None
    ratio = row["paper"] is not None and row["mse_random_samples"] is not None
    row["ratio"] = row["mse_random_samples"] / row["paper"] if ratio else None
    return row


def _notes(study: Study, rows: list[dict[str, Any]]) -> list[str]:
    """What has to be known to read the table."""
    budget = field_budget(study.scale)
    time = f"{budget.steps} steps" if budget.minutes is None else f"{60.0 * budget.minutes:.0f} s"
    notes = [
        f"True samples in, all particles out; no time-stepper. Every field that learns had {time}, "
        f"of gradient descent; seconds count what is set in closed form too. No setting was tuned; "
        f"ranks and sizes beside the first of a kind were trained with one seed. In every step a "
        f"field is trained with as many samples as it is asked with.",
        "relative error: root of summed squared errors over summed squared displacements of all "
        "particles at evenly spaced frames; mse: mean squared distance [m^2]; chamfer: mean "
        "squared distance to the nearest point, both ways added, full sets [m^2]. Samples of the "
        "preset (farthest points) unless it says random.",
        "paper: mean squared error on elasticity, 78 thousand points, random sub-samples, rank and "
        "training not stated; ratio: our mse on random samples over it. Bodies, loads and units "
        "differ, so that only the order of the three rows can be compared.",
        "POD is the best linear basis on its own points: on these a neural basis of the same rank "
        "cannot be better. Here bodies have different points, and both are asked at new ones.",
    ]
    notes += [_verdict(system, rows) for system in SYSTEMS]
    failed = [row for row in rows if row["problem"] is not None]
    notes += [f"{row['system']}, {row['field']}: {row['problem']}" for row in failed]
    return notes


def _verdict(system: str, rows: list[dict[str, Any]]) -> str:
    """Which field is best on a system, and the best of those that learn."""
    known = [r for r in rows if r["system"] == system and r["relative_error"] is not None]
    best = min(known, key=lambda row: row["relative_error"])
    learned = [row for row in known if row["name"] not in UNTRAINED]
    text = f"{system}: best is {best['field']} ({best['relative_error']:.2g})"
    if not learned:
        return f"{text}."
    other = min(learned, key=lambda row: row["relative_error"])
    rank = "" if other["rank"] is None else f", rank {other['rank']}"
    return (
        f"{text}; of what learns from motions, {other['field']}{rank} "
        f"({other['relative_error']:.2g})."
    )


def _draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """Relative error of every field, one mark for each system; of several ranks the best."""
    figure.set_size_inches(8.0, 5.5)
    axes = figure.subplots()
    titles = list(dict.fromkeys(row["field"] for row in rows))
    for number, system in enumerate(SYSTEMS):
        best = [_least(rows, system, title) for title in titles]
        places = [k + 0.12 * (number - 2) for k in range(len(titles))]
        axes.plot(best, places, "osD^v"[number], markersize=5, label=system)
    axes.set_xscale("log")
    axes.set_yticks(range(len(titles)), titles, fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis="x", which="major", alpha=0.4)
    axes.set_xlabel("relative error of the displacement, samples of the preset")
    axes.legend(fontsize=8)


def _least(rows: list[dict[str, Any]], system: str, title: str) -> float:
    """Smallest error of a field on a system; not a number where there is none."""
    errors = [r["relative_error"] for r in rows if (r["system"], r["field"]) == (system, title)]
    return min((error for error in errors if error is not None), default=float("nan"))
