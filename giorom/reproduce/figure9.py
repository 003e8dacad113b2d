"""Figure 9: values of the network, one at a time, water in two dimensions.

The paper's panels have no numbers in its text; what it says of each stands beside ours.
"""

from dataclasses import dataclass
from typing import Any

from giorom.reproduce.ablation import (
    NETWORK,
    Variant,
    network_changes,
    train_variants,
)
from giorom.reproduce.charts import ERROR, OURS, draw_rows, finish, name_places
from giorom.reproduce.report import Result
from giorom.reproduce.study import Study

TITLE = "Figure 9: values of the network, water in 2-D"

SYSTEM = "water2d"
"""System of the figure."""

SEEDS = 2
"""Most trainings of each variant."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One value of the network and what it is set to."""

    label: str
    """What it is, for a person; with its unit."""

    names: tuple[str, ...]
    """Fields of the network, set together; ``velocities`` is one of the features."""

    values: tuple[Any, ...]
    """What they are set to, as in the paper."""

    found: str
    """What the paper finds."""

    def changes(self, study: Study, value: Any) -> dict[str, Any]:
        """Changes of one value; none where the network has it anyway."""
        if self.names == ("velocities",):
            usual = study.experiment(SYSTEM, NETWORK).features.velocities
            return {} if usual == value else {"features": {"velocities": value}}
        return network_changes(study, SYSTEM, dict.fromkeys(self.names, value))

    def variants(self, study: Study) -> list[Variant]:
        """One variant a value."""
        return [
            Variant(
                system=SYSTEM,
                labels={"panel": self.label, "value": shown(value)},
                changes=self.changes(study, value),
            )
            for value in self.values
        ]


PANELS = (
    Panel(
        label="velocities given",
        names=("velocities",),
        values=(2, 3, 5, 6, 7),
        found="chooses 5",
    ),
    Panel(
        label="layers of the embeddings of NOT",
        names=("transformer_mlp_depth",),
        values=(1, 2, 4, 8, 10),
        found="more are slightly worse",
    ),
    Panel(
        label="hidden widths of the kernels (GNO)",
        names=("gno_in_hidden", "gno_out_hidden"),
        values=([32, 64], [512, 256], [64, 512, 1024, 256]),
        found="chooses 32, 64",
    ),
    Panel(
        label="blocks of NOT", names=("transformer_layers",), values=(1, 2, 4), found="1 is best"
    ),
    Panel(label="attention heads", names=("heads",), values=(1, 2, 4, 8), found="4 are best"),
    Panel(label="experts", names=("experts",), values=(1, 2, 4), found="2 are best"),
    Panel(
        label="reach of a latent node [m]",
        names=("latent_radius",),
        values=(0.0004, 0.0015, 0.015, 0.045, 0.1, None),
        found="no noticeable effect",
    ),
    Panel(
        label="layers of the projection",
        names=("projection_layers",),
        values=(1, 2, 5),
        found="chooses 1",
    ),
    Panel(
        label="latent nodes along an axis",
        names=("latent_side",),
        values=(8, 16, 32, 64, 128),
        found="128 best, 8 worst (Table 12)",
    ),
)
"""Panels of Figure 9 and of appendix G.3 of arXiv:2407.03925v2; it does not say which numbers of
heads and experts it tried."""


def shown(value: Any) -> str:
    """A value as text."""
    if value is None:
        return "1.5 x least"
    return "-".join(map(str, value)) if isinstance(value, list) else f"{value:g}"


def run(study: Study) -> Result:
    """Train every value of every panel; the network as it is counts once."""
    seeds = study.seeds[:SEEDS]
    made = [(panel, variant) for panel in PANELS for variant in panel.variants(study)]
    rows = train_variants(study, [variant for _, variant in made], seeds=seeds)
    for (panel, variant), row in zip(made, rows, strict=True):
        row |= {"usual": not variant.changes, "paper_finds": panel.found}
    usual = next(row for row in rows if row["usual"])
    for row in rows:
        row["times_usual"] = _over(row["rollout_mse"], usual["rollout_mse"])
    return Result(
        id="figure9",
        title=TITLE,
        columns=[
            "panel",
            "value",
            "usual",
            "rollout_mse",
            "times_usual",
            "diverged",
            "coverage",
            "parameters",
            "steps",
            "paper_finds",
        ],
        rows=rows,
        notes=[
            f"One value differs from {NETWORK} in each row; 'usual' rows are the same trainings. "
            f"{len(seeds)} seed(s) each, equal time: larger networks get fewer steps, which is "
            f"part of what is compared. Differences within the range of the seeds say nothing.",
            "Rollout error of the samples [m²]; coverage: share of the training samples that the "
            "latent grid reaches. '1.5 x least': 1.5 times the smallest reach that leaves no gap. "
            "Where the coverage is small the grid does nothing, and message passing is alone; on "
            "the paper's own grid, twice as coarse, its three smallest reaches cover 0, 0.1 and 17 "
            "% of evenly spread points, and it finds no effect.",
        ],
        draw=lambda figure: draw(figure, rows),
    )


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other


def draw(figure: Any, rows: list[dict[str, Any]]) -> None:
    """One panel a value, on one scale of errors."""
    figure.set_size_inches(10.5, 9.0)
    every = figure.subplots(3, 3, sharey=True)
    usual = next(row for row in rows if row["usual"])["rollout_mse"]
    for number, (axes, panel) in enumerate(zip(every.flat, PANELS, strict=True)):
        some = [row for row in rows if row["panel"] == panel.label]
        names = [row["value"].replace("512-1024", "512-\n1024") for row in some]
        places = name_places(axes, names, turned=len(some) > 5)
        draw_rows(axes, some, places, color=OURS)
        if usual is not None:
            axes.axhline(usual, color="0.5", linewidth=0.9, linestyle=":")
        label = ERROR if number % 3 == 0 else None
        finish(axes, x=panel.label, y=label, title=f"paper: {panel.found}", legend=False)
        axes.title.set_fontsize("small")
