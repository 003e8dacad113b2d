"""How large a reproduction is: which presets, how many trajectories, how long each training.

``tiny`` shows that the commands work, ``cpu`` is made for two cores, ``paper`` has the sizes of the
paper and needs a GPU.
"""

from dataclasses import dataclass, field
from typing import Any

from giorom.training.training_config import Budget


@dataclass(frozen=True, kw_only=True)
class SystemScale:
    """One physical system at a scale."""

    preset: str
    """Preset that is changed."""

    trajectories: int
    """Trajectories of the data set; a tenth, or one at least, is for validation, one for the
    test."""

    changes: dict[str, Any] = field(default_factory=dict)
    """Values of the experiment for every method."""

    own: dict[str, Any] = field(default_factory=dict)
    """Values for the method ``default`` alone, whose grid has no place in a network's training."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The size of everything that is made."""

    name: str
    """Name of the scale."""

    systems: dict[str, SystemScale]
    """By physical system."""

    seeds: int
    """Trainings of each method on each system, of different seeds."""

    budget: Budget
    """Of one training."""

    tuning_budget: Budget
    """Of one of the short trainings that choose learning rate and noise."""

    candidates: tuple[tuple[float, float], ...]
    """Learning rates and training noises [m] among which the validation trajectories choose, the
    same for every network."""

    networks: dict[str, Any] = field(default_factory=dict)
    """Values of the experiment for every network."""

    alone: bool = True
    """Whether each measurement of time and memory has a process of its own."""

    needs_gpu: bool = False
    """Whether it is hopeless on a CPU."""

    @property
    def presets(self) -> dict[str, str]:
        """Preset of every system."""
        return {system: made.preset for system, made in self.systems.items()}

    def describe(self) -> str:
        """What every table says about the size of its trainings."""
        tuned = "learning rate and noise as the recipes say"
        if len(self.candidates) > 1:
            tuned = (
                f"learning rate and noise of every network chosen for each system among the same "
                f"{len(self.candidates)} pairs on the validation trajectories, "
                f"{_words(self.tuning_budget)} each"
            )
        return (
            f"Scale {self.name}: {_words(self.budget)} for each training, {self.seeds} seed(s); "
            f"{tuned}."
        )


def _words(budget: Budget) -> str:
    """A budget in words."""
    if budget.minutes is None:
        return f"{budget.steps} steps"
    return f"{60.0 * budget.minutes:g} s"


THROWN = ("water3d", "sand3d", "plasticine3d")
"""Systems of bodies thrown into a box in three dimensions."""

SYSTEMS_2D = ("sand2d", "water2d", "goop2d", "multimaterial2d")
"""Systems in two dimensions."""

SYSTEMS_3D = ("water3d", "plasticine3d", "elastic3d", "sand3d")
"""Columns of Table 3, in the order of the paper."""

SYSTEMS = (
    "water3d",
    "water2d",
    "sand3d",
    "sand2d",
    "goop2d",
    "plasticine3d",
    "elastic3d",
    "multimaterial2d",
)
"""Rows of Table 1, in the order of the paper."""


def _tiny() -> Scale:
    """A few steps on three trajectories of some hundred particles and a dozen frames."""
    common: dict[str, Any] = {
        "solver": {"frames": 14, "grid_cells": 16},
        "sampling": {"count": 30, "reduction": None},
        "training": {"validations": 1, "validation_frames": 4, "subsets": 1, "batch_size": 1},
    }
    body = {"shapes": ["box", "ellipsoid"], "held_out_shapes": ["capsule"]}
    own = {"training": {"unroll": [[0.0, 6]]}}
    systems: dict[str, SystemScale] = {}
    for system in THROWN:
        systems[system] = SystemScale(
            preset=f"{system}-small",
            trajectories=3,
            changes=common | {"scene": body | {"points": 150, "wall": 0.125}},
            own=own | {"grid_stepper": {"spacing": 0.1}},
        )
    systems["elastic3d"] = SystemScale(
        preset="elastic3d-small",
        trajectories=3,
        changes=common | {"scene": body | {"spacing": 0.045, "wall": 0.125}},
        own=own | {"body_stepper": {"spacing": 0.125, "height_spacing": 0.125}},
    )
    flat: dict[str, Any] = {
        "scene": {"spacing": 0.02, "speed_range": [0.5, 0.6], "spin_range": [3.0, 4.0]},
        "solver": {"frames": 14, "grid_cells": 30},
    }
    for system in SYSTEMS_2D:
        systems[system] = SystemScale(
            preset=f"{system}-small",
            trajectories=3,
            changes=common | flat,
            own=own | {"grid_stepper": {"spacing": 0.06}},
        )
    return Scale(
        name="tiny",
        systems=systems,
        alone=False,
        seeds=1,
        budget=Budget(steps=2),
        tuning_budget=Budget(steps=1),
        candidates=((1e-3, 1e-4),),
    )


def _cpu() -> Scale:
    """Made for two cores: some 200 samples in three dimensions, half a minute for each training."""
    # Of the samples some 18 lie within the radius of another, so that a step is affordable.
    common: dict[str, Any] = {
        "solver": {"frames": 120},
        "sampling": {"count": 200, "reduction": None},
        "graph": {"margin": 1.4},
    }
    unroll: dict[str, Any] = {
        "training": {"unroll": [[0.0, 80], [0.4, 110]], "validation_frames": 110}
    }
    systems = {
        # Where fewer particles are sampled than in the preset, the grid gets coarser in proportion.
        "water3d": _thrown("water3d", common, own=unroll, spacing=0.0635),
        "sand3d": _thrown("sand3d", common, own=unroll, spacing=0.0587),
        "plasticine3d": _thrown("plasticine3d", common, own=unroll, spacing=0.043),
        "elastic3d": SystemScale(preset="elastic3d-small", trajectories=30, changes=common),
    }
    for system in SYSTEMS_2D:
        systems[system] = SystemScale(preset=f"{system}-small", trajectories=60)
    return Scale(
        name="cpu",
        systems=systems,
        seeds=3,
        budget=Budget(minutes=0.5),
        tuning_budget=Budget(minutes=0.1),
        candidates=((1e-3, 3e-4), (5e-4, 3e-5)),
        networks={
            # A slow network does some hundred steps: the average must not remember the first ones,
            # and a validation must not take more than a few of them.
            "training": {
                "validations": 1,
                "validation_frames": 20,
                "validation_trajectories": 2,
                "subsets": 2,
                "average_decay": 0.9,
                "warmup": 5,
            }
        },
    )


def _thrown(
    system: str, changes: dict[str, Any], *, own: dict[str, Any], spacing: float
) -> SystemScale:
    """A body thrown into a box, with a grid of another spacing [m]."""
    return SystemScale(
        preset=f"{system}-small",
        trajectories=30,
        changes=changes,
        own=own | {"grid_stepper": {"spacing": spacing}},
    )


PAPER_TRAJECTORIES = {
    "water3d": 100,
    "water2d": 1000,
    "sand3d": 100,
    "sand2d": 1000,
    "goop2d": 1000,
    "plasticine3d": 100,
    "elastic3d": 24,
    "multimaterial2d": 1000,
}
"""Trajectories that stand for the paper's data sets."""


def _paper() -> Scale:
    """The sizes of the paper; twelve hours of a GPU for each training."""
    return Scale(
        name="paper",
        systems={
            system: SystemScale(preset=system, trajectories=count)
            for system, count in PAPER_TRAJECTORIES.items()
        },
        seeds=3,
        budget=Budget(minutes=720.0),
        tuning_budget=Budget(minutes=30.0),
        candidates=tuple((rate, noise) for rate in (1e-3, 1e-4) for noise in (3e-6, 3e-5, 3e-4)),
        needs_gpu=True,
    )


SCALES: dict[str, Scale] = {scale.name: scale for scale in (_tiny(), _cpu(), _paper())}
"""By name."""
