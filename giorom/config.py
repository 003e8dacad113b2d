"""An experiment: one YAML file, one frozen record.

A preset is such a file inside the package. A recipe is one that replaces some groups of another
by its own: ``water2d-small+paper`` is the preset ``water2d-small`` with the graph, the features,
the network and the training of the paper. Recipes follow each other, and later ones win:
``water2d-small+equal+gns`` is the network of GNS in the training that all networks share. Values
that follow from others (widths of the features, bounds of the latent grid, the graph radius) are
not written down but derived.
"""

from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any, Literal

import yaml

from giorom.baselines import BaselineChoice, BaselineConfig
from giorom.body_stepper import BodyStepperConfig
from giorom.features import FeatureConfig
from giorom.fields import FieldConfig
from giorom.graph import GraphConfig
from giorom.grid_stepper import GridStepperConfig
from giorom.mpm.scene_config import SceneConfig
from giorom.mpm.simulate import SolverConfig
from giorom.records import nearest, one_line, parse_fields, parse_record
from giorom.sampling import SamplingConfig
from giorom.time_stepper import TimeStepperConfig
from giorom.training.field_loop import FieldTrainingConfig
from giorom.training.training_config import TrainingConfig

PRESETS = Path(__file__).parent / "presets"

MOST_BYTES = 1 << 16
"""Longest YAML file; a preset takes about 2 KB, and checking a record takes long."""

DERIVED = ("dimension", "node_width", "edge_width", "gate_width")
"""Fields of ``TimeStepperConfig`` that follow from features and data."""


@dataclass(frozen=True, kw_only=True)
class StepperChoice:
    """Which network is trained."""

    preset: Literal["default", "paper"] = "default"
    """Published model, or the recommended one."""

    overrides: dict[str, Any] = default(default_factory=dict)
    """Fields of ``TimeStepperConfig`` to change; ``latent_bounds`` is the domain of the grid."""

    def __post_init__(self) -> None:
        """Reject names the time-stepper does not have."""
        derived = sorted(set(self.overrides) & set(DERIVED))
        if derived:
            raise ValueError(
                f"time_stepper.overrides: {derived[0]} follows from the features and the data and "
                f"cannot be set. Remove it."
            )
        self._fields()

    def build(
        self, *, dimension: int, features: FeatureConfig, latent_bounds: list[list[float]]
    ) -> TimeStepperConfig:
        """The full configuration of the network.

        Args:
            dimension: Space dimension.
            features: Which features it sees.
            latent_bounds: Padded bounds of the training data [m], over which the grid of the
                recommended network extends where ``overrides`` says nothing else.
        """
        values = self._fields() | {
            "node_width": features.node_width(dimension),
            "edge_width": features.edge_width(dimension),
            "gate_width": features.shape_width(dimension),
        }
        if self.preset == "paper":
            return TimeStepperConfig.paper(dimension, **values)
        return TimeStepperConfig.default(dimension, **({"latent_bounds": latent_bounds} | values))

    def _fields(self) -> dict[str, Any]:
        """The overrides with the types of the fields."""
        return parse_fields(TimeStepperConfig, self.overrides, where="time_stepper.overrides")


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Everything that makes data, a model and its score."""

    system: str
    """Physical system."""

    scene: SceneConfig
    """Scenes it is trained on."""

    solver: SolverConfig
    """Simulation of a scene."""

    sampling: SamplingConfig
    """Which particles are simulated by the surrogate."""

    graph: GraphConfig = default(default_factory=GraphConfig)
    """How they are connected."""

    features: FeatureConfig = default(default_factory=FeatureConfig)
    """What the network sees."""

    time_stepper: StepperChoice = default(default_factory=StepperChoice)
    """The network that predicts accelerations."""

    grid_stepper: GridStepperConfig | None = None
    """The coarse grid that moves the samples instead of the network; null: the network does."""

    body_stepper: BodyStepperConfig | None = None
    """The grid fixed to the undeformed body that does, for soft bodies; null: the others do."""

    baseline: BaselineChoice | None = None
    """Another method's network in the place of ``time_stepper``; null: the latter."""

    field: FieldConfig = default(default_factory=FieldConfig)
    """What recovers all particles."""

    training: TrainingConfig = default(default_factory=TrainingConfig)
    """How the time-stepper is trained."""

    field_training: FieldTrainingConfig = default(default_factory=FieldTrainingConfig)
    """How the field is trained, if it learns."""

    def __post_init__(self) -> None:
        """Reject what cannot be built or trained, before any data are read for it."""
        steppers = ("grid_stepper", "body_stepper", "baseline")
        given = [name for name in steppers if getattr(self, name) is not None]
        if len(given) > 1:
            hint = "" if self.baseline is None else "; the recipe 'equal' does so for a baseline"
            raise ValueError(
                f"an experiment has one time-stepper, but both {' and '.join(given)} are given. "
                f"Set one of them to null{hint}."
            )
        if not self.uses_network and self.training.objective != "motion":
            raise ValueError(
                f"a grid_stepper or body_stepper is trained on whole motions: training.objective "
                f"must be 'motion', got {self.training.objective!r}. Change it, or set the stepper "
                f"to null to train the network."
            )
        if self.body_stepper is not None and self.training.turn:
            raise ValueError(
                "training.turn is true, but the law of body_stepper is the same in every "
                "direction: turned scenes teach it nothing. Set training.turn to false."
            )
        if self.uses_network:
            self.network([[0.0, 1.0]] * self.scene.dimension)

    @property
    def uses_network(self) -> bool:
        """Whether a network moves the samples, ours or a baseline, and no grid does."""
        return self.grid_stepper is None and self.body_stepper is None

    def network(self, bounds: list[list[float]]) -> dict[str, TimeStepperConfig | BaselineConfig]:
        """The full configuration of the network under its name in ``SimulatorConfig``, if any.

        Args:
            bounds: Padded bounds of the training data [m].
        """
        if not self.uses_network:
            return {}
        dimension, features = self.scene.dimension, self.features
        if self.baseline is not None:
            built = self.baseline.build(dimension=dimension, features=features, bounds=bounds)
            return {"baseline": built}
        ours = self.time_stepper.build(dimension=dimension, features=features, latent_bounds=bounds)
        return {"time_stepper": ours}


def preset_names() -> list[str]:
    """Names of the presets of the package."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def recipe_names() -> list[str]:
    """Names of the recipes of the package."""
    return sorted(path.name for path in PRESETS.iterdir() if path.is_dir())


def load_experiment(name: str, overrides: dict[str, Any] | None = None) -> Experiment:
    """Read a preset or a YAML file, with some values changed.

    Args:
        name: Name of a preset, or path of a YAML file; each behind a plus, names of recipes, of
            which later ones win.
        overrides: Nested values that replace those of the file and of the recipes.

    Raises:
        ValueError: If there is no such preset, file or recipe, or a value is refused; one line.
    """
    preset, recipes = name, []
    while not (path := _preset_path(preset)).is_file() and "+" in preset:
        preset, _, recipe = preset.rpartition("+")
        recipes.insert(0, recipe)
    if not path.is_file():
        raise ValueError(f"there is no preset {name!r}. {nearest(name, preset_names())}")
    values = _read_values(path)
    for recipe in recipes:
        values |= _read_values(_recipe_path(recipe, values.get("system")))
    return parse_record(Experiment, merged(values, overrides or {}), where=name)


def _preset_path(name: str) -> Path:
    """File of a preset of the package, or a path."""
    path = PRESETS / f"{name}.yaml"
    return path if path.is_file() else Path(name)


def _recipe_path(recipe: str, system: Any) -> Path:
    """File of a recipe for a system: its own, or the one for any."""
    if recipe not in recipe_names():
        raise ValueError(f"there is no recipe {recipe!r}. {nearest(recipe, recipe_names())}")
    known = sorted(path.stem for path in (PRESETS / recipe).glob("*.yaml"))
    if system not in known and "any" in known:
        return PRESETS / recipe / "any.yaml"
    if system not in known:
        raise ValueError(
            f"the recipe {recipe!r} says nothing about the system {system!r}. "
            f"{nearest(system, known)}"
        )
    return PRESETS / recipe / f"{system}.yaml"


def _read_values(path: Path) -> dict[Any, Any]:
    """The mapping a YAML file holds."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(
            f"{path} has {path.stat().st_size} bytes, more than the {MOST_BYTES} that an "
            f"experiment may take. Check that it is the right file."
        )
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"{path} is not readable YAML: {one_line(error)}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} must hold a mapping of names to values, not {values!r}.")
    return values


def merged(values: dict[Any, Any], changes: dict[Any, Any]) -> dict[Any, Any]:
    """Nested mapping with some entries replaced; an empty mapping replaces a whole group."""
    result = dict(values)
    for key, value in changes.items():
        inner = result.get(key)
        if isinstance(value, dict) and value and isinstance(inner, dict):
            result[key] = merged(inner, value)
        else:
            result[key] = value
    return result
