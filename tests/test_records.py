"""Plain values become records, or the message says which value does not and why."""

import copy
from dataclasses import asdict, dataclass, field
from typing import Literal

import pytest

from giorom.features import FeatureConfig
from giorom.fields.neural_basis import NeuralFieldConfig
from giorom.graph import GraphConfig
from giorom.normalization import Normalization
from giorom.records import nearest, parse_record, record_type
from giorom.sampling import SamplingConfig


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A record inside another."""

    radius: float
    """A number."""

    kind: Literal["a", "b"] = "a"
    """A choice."""

    def __post_init__(self) -> None:
        """Reject negative radii."""
        if self.radius < 0.0:
            raise ValueError(f"Inner.radius must be >= 0, got {self.radius!r}.")


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A record that holds records."""

    count: int
    """A whole number."""

    inner: Inner
    """A record."""

    other: Inner | None = None
    """A record or nothing."""

    axes: list[tuple[float, float]] = field(default_factory=list)
    """Pairs."""


GOOD = {"count": 3, "inner": {"radius": 0.5}}


def test_nested_values_become_nested_records():
    """Defaults fill what is missing; whole numbers are numbers."""
    found = parse_record(Outer, GOOD | {"axes": [[0, 1.5]], "other": {"radius": 2}}, where="x")
    assert found == Outer(
        count=3, inner=Inner(radius=0.5), other=Inner(radius=2.0), axes=[(0.0, 1.5)]
    )


@pytest.mark.parametrize(
    "record",
    [
        FeatureConfig(velocities=3, rest_edges=True),
        GraphConfig(radius=0.25, configuration="reference"),
        GraphConfig(),
        NeuralFieldConfig(activation="sine"),
        SamplingConfig(reduction=8.0),
        Normalization(
            velocity_mean=(0.0, 1.0),
            velocity_std=(1.0, 2.0),
            acceleration_mean=(0.0, -9.81),
            acceleration_std=(3.0, 4.0),
        ),
    ],
    ids=lambda record: type(record).__name__,
)
def test_the_records_of_the_package_come_back_from_their_values(record):
    """parse_record is the inverse of asdict."""
    assert parse_record(type(record), asdict(record), where="x") == record


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"coutn": 3}, r"run\.yaml: Outer has no field 'coutn'. Did you mean 'count'\?"),
        (
            GOOD | {"other": {"raduis": 1.0}},
            r"run\.yaml\[other\]: Inner has no field 'raduis'. Did you mean 'radius'\?",
        ),
        (GOOD | {"inner": 5}, r"run\.yaml\[inner\] must be a mapping"),
        ({"count": 3}, r"run\.yaml: .*inner"),
        (GOOD | {"count": "many"}, r"run\.yaml: .*count"),
        (GOOD | {"inner": {"radius": 1.0, "kind": "c"}}, r"run\.yaml: .*kind"),
        (GOOD | {"inner": {"radius": -1.0}}, r"run\.yaml: .*radius must be >= 0, got -1.0"),
        (
            GOOD | {"other": {"radius": -1.0}},
            r"^run\.yaml\[other\]: Inner.radius must be >= 0, got -1.0.$",
        ),
        (GOOD | {"inner": None}, r"run\.yaml: Outer.inner must not be null"),
        ([1, 2], r"run\.yaml must be a mapping of names to values, got \[1, 2\]"),
    ],
)
def test_each_wrong_value_is_named_with_its_place(values, message):
    """What was found, where, and the way out, on one line."""
    with pytest.raises(ValueError, match=message) as caught:
        parse_record(Outer, values, where="run.yaml")
    assert "\n" not in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class Several:
    """A record that holds a list of records."""

    parts: list[Inner] = field(default_factory=list)


def test_records_in_a_list_are_built_and_checked_and_the_values_stay_as_they_were():
    """Equal to the record built by hand; a misspelling is named with its place in the list."""
    values = {"parts": [{"radius": 1.0}, {"radius": 2.0}]}
    kept = copy.deepcopy(values)
    assert parse_record(Several, values, where="x").parts == [Inner(radius=1.0), Inner(radius=2.0)]
    assert values == kept
    with pytest.raises(ValueError, match=r"x\[parts\]\[1\]: Inner has no field 'raduis'"):
        parse_record(Several, {"parts": [{"radius": 1.0}, {"raduis": 2.0}]}, where="x")


def test_a_hint_names_the_nearest_word_and_all_known_ones():
    """Without a near one it lists them."""
    assert nearest("raduis", ["radius", "count"]) == "Did you mean 'radius'? Known: radius, count."
    assert nearest("xyz", ["radius"]) == "Known: radius."


def test_the_record_of_an_annotation_is_found_alone_or_with_none():
    """And there is none in plain types."""
    assert record_type(Inner) is record_type(Inner | None) is Inner
    assert record_type(int) is record_type(list[int]) is None
