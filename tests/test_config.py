"""Configurations: every preset loads, and what is wrong is named in one line."""

from dataclasses import dataclass

import pytest
import yaml

from giorom.config import StepperChoice, load_experiment, merged, preset_names
from giorom.records import nearest, parse_record


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A record."""

    width: int = 1
    """A value."""


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A record that may hold another."""

    inner: Inner | None = None
    """The other."""


def refused(values, tmp_path, overrides=None):
    """The message with which a file of these values is refused."""
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ValueError, match=r".") as caught:
        load_experiment(str(path), overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", preset_names())
def test_preset_of_the_package_loads_and_builds_its_network(name):
    """A preset's time-stepper accepts the features the preset computes."""
    experiment = load_experiment(name)
    dimension = experiment.scene.dimension
    network = experiment.time_stepper.build(
        dimension=dimension,
        features=experiment.features,
        latent_bounds=[[0.0, 1.0]] * dimension,
    )
    assert network.node_width == experiment.features.node_width(dimension)


def test_unknown_preset_offers_the_nearest_name():
    """A typing error costs one line."""
    with pytest.raises(ValueError, match=r"Did you mean 'elastic3d-small'\?"):
        load_experiment("elastic3dsmall")


@pytest.mark.parametrize(
    ("place", "near"),
    [
        (("traiming",), "training"),
        (("training", "learning_rat"), "learning_rate"),
        (("scene", "spaceing"), "spacing"),
        (("time_stepper", "override"), "overrides"),
        (("time_stepper", "overrides", "hiddn"), "hidden"),
    ],
)
def test_unknown_key_names_the_nearest_at_every_depth(tiny_values, tmp_path, place, near):
    """In the file and in an override alike."""
    change = 1.0
    for name in reversed(place):
        change = {name: change}
    assert f"Did you mean '{near}'?" in refused(merged(tiny_values, change), tmp_path)
    assert f"Did you mean '{near}'?" in refused(tiny_values, tmp_path, change)


@pytest.mark.parametrize(
    "change",
    [
        {"training": {"batch_size": "many"}},
        {"training": {"batch_size": 1.5}},
        {"training": {"turn": "perhaps"}},
        {"training": {"optimizer": "sgd"}},
        {"training": []},
        {"training": {"noise_std": None}},
        {"solver": {"frames": -1}},
        {"scene": {"shapes": []}},
        {"scene": {"height_range": [0.4, 0.3]}},
        {"system": {"name": "x"}},
        {"sampling": {"count": 3, "reduction": 3}},
        {"graph": {"radius": 0.0}},
    ],
)
def test_value_of_the_wrong_type_or_size_is_refused(tiny_values, tmp_path, change):
    """One line that names the group."""
    assert next(iter(change)) in refused(merged(tiny_values, change), tmp_path).lower()


@pytest.mark.parametrize("name", ["dimension", "node_width", "edge_width", "gate_width"])
def test_derived_fields_of_the_network_cannot_be_set(tiny_values, tmp_path, name):
    """They follow from features and data, so a second value could only contradict."""
    change = {"time_stepper": {"overrides": {name: 3}}}
    assert f"{name} follows from" in refused(merged(tiny_values, change), tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden", "many"),
        ("gno_in_hidden", 3),
        ("latent_bounds", [0.0, 1.0]),
        ("latent", 0.5),
        ("dropout", 2.0),
        ("processor", "fft"),
        ("processor", "fourier"),
        ("latent_bounds", [[0.0, 1.0]]),
    ],
)
def test_network_that_cannot_be_built_is_refused_with_the_file(tiny_values, tmp_path, name, value):
    """Wrong types and values alike, before any data are read."""
    change = {"time_stepper": {"overrides": {name: value}}}
    assert name in refused(merged(tiny_values, change), tmp_path)


def test_whole_numbers_are_taken_where_the_network_wants_any(tiny):
    """YAML writes 1 for 1.0; the stored configuration has numbers of one kind."""
    choice = StepperChoice(overrides={"latent_bounds": [[0, 1], [0, 2], [0, 1]], "dropout": 0})
    config = choice.build(dimension=3, features=tiny.features, latent_bounds=[[0.0, 1.0]] * 3)
    assert config.latent_bounds == [[0.0, 1.0], [0.0, 2.0], [0.0, 1.0]]
    assert {type(bound) for pair in config.latent_bounds for bound in pair} == {float}
    assert type(config.dropout) is float


def test_missing_group_is_named(tiny_values, tmp_path):
    """There is no good default for a scene."""
    del tiny_values["scene"]
    assert "scene" in refused(tiny_values, tmp_path)


@pytest.mark.parametrize("text", ["a: [", "just text", "", "- 1\n- 2"])
def test_file_that_is_no_mapping_is_refused_in_one_line(tmp_path, text):
    """Broken YAML and other YAML."""
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(
        ValueError, match=r"x\.yaml (is not readable YAML|must hold a map)"
    ) as caught:
        load_experiment(str(path))
    assert "\n" not in str(caught.value)


def test_merged_replaces_leaves_and_keeps_the_rest():
    """The inputs stay as they were; lists are leaves."""
    values, changes = {"a": {"b": 1, "c": [1, 2]}, "d": 2}, {"a": {"c": [3]}, "e": {"f": 4}}
    assert merged(values, changes) == {"a": {"b": 1, "c": [3]}, "d": 2, "e": {"f": 4}}
    assert values == {"a": {"b": 1, "c": [1, 2]}, "d": 2}
    assert merged({"a": 1}, {"a": {"b": 2}}) == {"a": {"b": 2}}


def test_overrides_change_what_they_name_alone(tiny, tiny_yaml):
    """Reference: the same experiment without."""
    changed = load_experiment(str(tiny_yaml), {"training": {"noise_std": 1e-4}})
    assert changed.training.noise_std == 1e-4
    assert changed.scene == tiny.scene
    assert changed.time_stepper == tiny.time_stepper


def test_nearest_lists_all_names_when_none_is_near():
    """No guess is better than a wild one."""
    assert nearest("xyz", ["alpha", "beta"]) == "Known: alpha, beta."


def test_record_inside_an_optional_is_checked_too():
    """``X | None`` hides no misspelling."""
    assert parse_record(Outer, {"inner": {"width": 3}}, where="x").inner == Inner(width=3)
    assert parse_record(Outer, {"inner": None}, where="x").inner is None
    with pytest.raises(ValueError, match=r"x\[inner\]: Inner has no field 'wdth'.*'width'"):
        parse_record(Outer, {"inner": {"wdth": 3}}, where="x")


def test_an_empty_mapping_clears_a_group():
    """How the published network is chosen in a preset that changes the recommended one."""
    changes = {"time_stepper": {"preset": "paper", "overrides": {}}}
    chosen = load_experiment("elastic3d-small", changes).time_stepper
    assert (chosen.preset, chosen.overrides) == ("paper", {})


def test_a_grid_stepper_is_trained_on_motions_alone():
    with pytest.raises(ValueError, match="must be 'motion'"):
        load_experiment("water2d-small", {"training": {"objective": "acceleration"}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grid_stepper": {"spacing": 0.1}}, "one time-stepper"),
        ({"training": {"objective": "acceleration"}}, "must be 'motion'"),
        ({"training": {"turn": True}}, r"training\.turn is true"),
    ],
)
def test_a_body_stepper_stands_alone_and_learns_from_motions(changes, message):
    with pytest.raises(ValueError, match=message):
        load_experiment("elastic3d-small", changes)
