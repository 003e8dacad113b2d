"""Baselines as parts of an experiment: chosen by recipe, trained, stored and resumed like ours."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from giorom.baselines import BaselineChoice, BaselineConfig, NetworkShape, build_baseline
from giorom.baselines.choice import KINDS, settings_type
from giorom.baselines.linear import LinearConfig
from giorom.config import PRESETS, load_experiment, merged, preset_names, recipe_names
from giorom.simulator import Simulator
from giorom.time_stepper import TimeStepperConfig

SHAPE = NetworkShape(dimension=2, node_width=14, edge_width=3, bounds=[[0.0, 1.0]] * 2)


@pytest.fixture
def linear(tiny):
    """The tiny experiment with the linear model in the place of the network."""
    training = replace(tiny.training, turn=False)
    return replace(tiny, baseline=BaselineChoice(kind="linear"), training=training)


def stored_positions(folder: Path, experiment) -> torch.Tensor:
    """A short rollout of the simulator of a run."""
    from giorom.mpm import draw_scene

    scene = draw_scene(experiment.scene, seed=7)
    simulator = Simulator.from_pretrained(folder)
    body = (scene.position, scene.velocity, scene.particle_type)
    return simulator.rollout(*body, frames=3).position


@pytest.mark.parametrize("preset", preset_names())
def test_every_kind_can_be_chosen_for_every_preset(preset):
    """Widths follow from the features of the common training: five velocities and the walls."""
    common = load_experiment(f"{preset}+equal")
    for kind in KINDS:
        experiment = replace(common, baseline=BaselineChoice(kind=kind))
        dimension = experiment.scene.dimension
        bounds = [[0.0, 1.0]] * dimension
        network = experiment.network(bounds)["baseline"]
        shape = NetworkShape(
            dimension=dimension, node_width=7 * dimension, edge_width=dimension + 1, bounds=bounds
        )
        assert experiment.uses_network
        assert network == BaselineConfig(kind=kind, shape=shape, **{kind: settings_type(kind)()})


@pytest.mark.parametrize("recipe", recipe_names())
def test_every_recipe_can_follow_the_common_training(recipe):
    """In the plane and in space; a kind of baseline has a recipe of its own name or a synonym."""
    for preset in ("water2d-small", "water3d-small"):
        assert load_experiment(f"{preset}+equal+{recipe}").uses_network


def test_every_kind_has_a_recipe():
    """What no recipe names nobody would find."""
    chosen = [load_experiment(f"water2d-small+equal+{name}").baseline for name in recipe_names()]
    assert {choice.kind for choice in chosen if choice is not None} == set(KINDS)


def test_recipes_follow_each_other_and_later_ones_win():
    """``equal`` clears the grid stepper of the preset; the paper's recipe has its own network."""
    assert load_experiment("water2d-small").grid_stepper is not None
    chosen = load_experiment("water2d-small+equal+linear", {"training": {"noise_std": 1e-4}})
    assert (chosen.grid_stepper, chosen.body_stepper) == (None, None)
    assert chosen.baseline == BaselineChoice(kind="linear")
    assert chosen.training.noise_std == 1e-4
    assert chosen.training.objective == "acceleration"
    assert load_experiment("water2d-small+equal+linear+paper").baseline is None
    paper = load_experiment("water2d-small+linear+paper+linear")
    assert paper.training == load_experiment("water2d-small+paper").training
    assert paper.baseline == BaselineChoice(kind="linear")


def test_the_common_training_alone_is_our_network_in_it():
    """Nothing of the preset's small network is left."""
    experiment = load_experiment("jelly3d-small+equal")
    network = experiment.network([[0.0, 1.0]] * 3)
    assert set(network) == {"time_stepper"}
    assert network["time_stepper"].hidden == TimeStepperConfig.hidden


def test_a_recipe_for_any_system_yields_to_the_one_for_a_system(tmp_path, monkeypatch):
    """``SYSTEM.yaml`` before ``any.yaml``."""
    import giorom.config

    (tmp_path / "noisy").mkdir()
    for name, noise in (("any", 1e-3), ("water2d", 1e-4)):
        text = f"training: {{noise_std: {noise}, objective: motion}}\n"
        (tmp_path / "noisy" / f"{name}.yaml").write_text(text)
    for name in ("water2d-small", "sand2d-small"):
        (tmp_path / f"{name}.yaml").write_text((PRESETS / f"{name}.yaml").read_text())
    monkeypatch.setattr(giorom.config, "PRESETS", tmp_path)
    assert load_experiment("water2d-small+noisy").training.noise_std == 1e-4
    assert load_experiment("sand2d-small+noisy").training.noise_std == 1e-3


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("water2d-small+linear", {}, "both grid_stepper and baseline are given.*recipe 'equal'"),
        ("water2d-small+equal+linea", {}, "no recipe 'linea'. Did you mean 'linear'"),
        ("water2d-small+equal+", {}, "no recipe ''"),
        ("water2d-small+equal", {"baseline": {"kind": "perceptron"}}, "kind"),
        ("water2d-small+equal", {"baseline": {}}, "kind"),
        (
            "water2d-small+equal+linear",
            {"baseline": {"overrides": {"embed": 3}}},
            "baseline.overrides: LinearConfig has no field 'embed'. Did you mean 'embedding'",
        ),
        (
            "water2d-small+equal+linear",
            {"baseline": {"overrides": {"embedding": 0}}},
            "LinearConfig.embedding must be >= 1, got 0",
        ),
    ],
)
def test_a_choice_that_cannot_be_built_is_refused_in_one_line(name, changes, message):
    """Before any data are read."""
    with pytest.raises(ValueError, match=message) as caught:
        load_experiment(name, changes)
    assert "\n" not in str(caught.value)


def test_a_run_with_a_baseline_trains_stores_and_loads(
    linear, data_folder, run_training, tmp_path, succeed
):
    """The stored form names the kind, its record and its shape; the others are null."""
    result = run_training(linear, data_folder, tmp_path / "run", steps=6)
    record = json.loads((tmp_path / "run" / "simulator" / "config.json").read_text())
    assert record["time_stepper"] is None
    assert record["baseline"]["kind"] == "linear"
    assert record["baseline"]["linear"] == {"embedding": 16}
    others = set(record["baseline"]) - {"kind", "linear", "shape"}
    assert all(record["baseline"][name] is None for name in others)
    node, edge = (
        record["baseline"]["shape"]["node_width"],
        record["baseline"]["shape"]["edge_width"],
    )
    assert (node, edge) == (linear.features.node_width(3), linear.features.edge_width(3))
    assert result["parameters"] == 9 * 16 + (16 + node + edge) * 3 + 3
    assert torch.isfinite(stored_positions(tmp_path / "run", linear)).all()
    scores = succeed("evaluate", tmp_path / "run", "--data", data_folder, "--frames", "4")
    assert scores["diverged"] == 0


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(
    linear, data_folder, run_training, tmp_path
):
    """Bit for bit."""
    schedule = replace(linear.training, decay_steps=100.0, validations=3)
    linear = replace(linear, training=schedule)
    run_training(linear, data_folder, tmp_path / "whole", steps=8)
    run_training(linear, data_folder, tmp_path / "parts", steps=4)
    run_training(linear, data_folder, tmp_path / "parts", steps=8, resume=True)
    last = [
        json.loads((tmp_path / name / "log.jsonl").read_text().splitlines()[-1])
        for name in ("whole", "parts")
    ]
    assert last[0]["step"] == last[1]["step"] == 8
    assert last[0]["rollout_mse"] == last[1]["rollout_mse"]


def test_simulators_stored_before_there_were_baselines_still_load(run_folder, tmp_path):
    """Their configuration has no such key."""
    import shutil

    stored = shutil.copytree(run_folder / "simulator", tmp_path / "simulator")
    record = json.loads((stored / "config.json").read_text())
    assert record["format_version"] == 2
    assert record.pop("baseline") is None
    (stored / "config.json").write_text(json.dumps(record))
    assert Simulator.from_pretrained(stored).config == Simulator.from_pretrained(run_folder).config


def test_exactly_one_part_moves_the_samples(simulator):
    """A simulator with a network and a baseline would not know which to ask."""
    shape = replace(SHAPE, dimension=3, bounds=[[0.0, 1.0]] * 3, edge_width=4)
    baseline = BaselineConfig(kind="linear", shape=shape, linear=LinearConfig())
    config = simulator.config
    with pytest.raises(ValueError, match="exactly one of"):
        replace(config, baseline=baseline)
    with pytest.raises(ValueError, match="exactly one of"):
        replace(config, time_stepper=None)
    with pytest.raises(ValueError, match=r"SimulatorConfig\.baseline\.shape takes \(14, 4\)"):
        replace(config, time_stepper=None, baseline=baseline)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"linear": None}, r"kind is 'linear', but the records given are \[\]"),
        ({"shape": {"dimension": 4}}, "dimension must be 2 or 3"),
        ({"shape": {"node_width": 0}}, "node_width must be >= 1"),
        ({"shape": {"edge_width": 2}}, "edge_width=2 has no room"),
        ({"shape": {"bounds": [[0.0, 1.0]]}}, "2 pairs"),
        ({"shape": {"bounds": [[0.0, 1.0], [1.0, 1.0]]}}, "low < high"),
    ],
)
def test_a_configuration_that_fits_nothing_is_refused(change, message):
    """A stored file may say anything."""
    from dataclasses import asdict

    from giorom.records import parse_record

    good = asdict(BaselineConfig(kind="linear", shape=SHAPE, linear=LinearConfig()))
    assert parse_record(BaselineConfig, good, where="x").shape == SHAPE
    with pytest.raises(ValueError, match=message):
        parse_record(BaselineConfig, merged(good, change), where="x")


def test_the_linear_model_is_linear_and_sees_its_surroundings(random_scenes):
    """Superposition, f(a + b) + f(0) = f(a) + f(b), and a plain loop of its formula."""
    torch.manual_seed(0)
    model = build_baseline(BaselineConfig(kind="linear", shape=SHAPE, linear=LinearConfig()))
    model = model.double()
    features = random_scenes
    other = replace(features, node=features.node.flip(0), edge=features.edge.flip(0))
    both = replace(features, node=features.node + other.node, edge=features.edge + other.edge)
    none = replace(features, node=0.0 * features.node, edge=0.0 * features.edge)
    left = model(both) + model(none)
    torch.testing.assert_close(left, model(features) + model(other), rtol=0, atol=1e-12)
    edges = features.edges
    for particle in (0, 17, len(features.node) - 1):
        own = [features.edge[e] for e in range(len(features.edge)) if edges.receiver[e] == particle]
        kind = model.type_embedding.weight[features.particle_type[particle]]
        seen = torch.cat([kind, features.node[particle], sum(own) / len(own)])
        expected = model.map.weight @ seen + model.map.bias
        torch.testing.assert_close(model(features)[particle], expected, rtol=0, atol=1e-12)


@pytest.fixture
def random_scenes():
    """Two random scenes in the plane, in float64."""
    from giorom.features import Features
    from giorom.graph import radius_edges

    generator = torch.Generator().manual_seed(0)
    position = torch.rand(50, 2, generator=generator, dtype=torch.float64)
    batch = torch.arange(2).repeat_interleave(25)
    edges = radius_edges(position, batch, 0.3)
    vector = (position[edges.sender] - position[edges.receiver]) / 0.3
    return Features(
        node=torch.randn(50, 14, generator=generator, dtype=torch.float64),
        particle_type=torch.randint(9, (50,), generator=generator),
        edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
        edges=edges,
        position=position,
        batch=batch,
        batch_size=2,
    )
