"""Read configuration records from plain values, and say clearly what is wrong with them.

A configuration is a frozen dataclass beside the code it steers. This module turns nested JSON or
YAML values into one, checking every type; the records check their own values.
"""

import copy
import dataclasses
import difflib
import typing
from collections.abc import Iterable
from typing import Any, TypeVar

Record = TypeVar("Record")


def nearest(word: Any, known: Iterable[str]) -> str:
    """A hint for a misspelt name: the nearest known one, or all of them."""
    known = list(known)
    found = difflib.get_close_matches(str(word), known, n=1, cutoff=0.5)
    hint = f"Did you mean {found[0]!r}? " if found else ""
    return f"{hint}Known: {', '.join(known)}."


def parse_record(kind: type[Record], values: Any, *, where: str) -> Record:
    """Build a configuration record from plain values.

    Args:
        kind: A frozen dataclass.
        values: Nested mapping, as JSON or YAML gives it.
        where: What the values are, for messages.

    Raises:
        ValueError: If a key is unknown or missing, or a value has the wrong type or is refused.
    """
    from jsonargparse import ArgumentError, ArgumentParser

    check_keys(kind, values, where=where)
    for name, annotation in typing.get_type_hints(kind).items():
        # What may be null is one of several types to the parser, whose message names them all.
        inner = record_type(annotation)
        if inner is not None and _takes_none(annotation) and isinstance(values.get(name), dict):
            parse_record(inner, values[name], where=f"{where}[{name}]")
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(kind)
    try:
        parsed = parser.instantiate(parser.parse_object(copy.deepcopy(values)))
        return kind(**{field.name: parsed[field.name] for field in dataclasses.fields(kind)})
    except (ArgumentError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: {one_line(error)}") from None


def parse_fields(kind: type, values: Any, *, where: str) -> dict[str, Any]:
    """Check the types of some fields of a record that is built later.

    Args:
        kind: A frozen dataclass without records in it.
        values: Some of its fields, as JSON or YAML gives them.
        where: What the values are, for messages.

    Returns:
        The values with the types of the fields.

    Raises:
        ValueError: If a key is unknown or a value has the wrong type.
    """
    from jsonargparse import ArgumentError, ArgumentParser

    check_keys(kind, values, where=where)
    parser = ArgumentParser(exit_on_error=False)
    for field in dataclasses.fields(kind):
        if field.name in values:
            parser.add_argument(f"--{field.name}", type=typing.get_type_hints(kind)[field.name])
    try:
        parsed = parser.parse_object(copy.deepcopy(values))
    except (ArgumentError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: {one_line(error)}") from None
    return {name: parsed[name] for name in values}


def check_keys(kind: type, values: Any, *, where: str) -> None:
    """Reject keys that ``kind`` or a record inside it does not have.

    Raises:
        ValueError: Names the key and the nearest known one.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be a mapping of names to values, got {values!r}.")
    fields = typing.get_type_hints(kind)
    for key, value in values.items():
        if key not in fields:
            raise ValueError(
                f"{where}: {kind.__name__} has no field {key!r}. {nearest(key, fields)}"
            )
        if value is None and not _takes_none(fields[key]):
            raise ValueError(
                f"{where}: {kind.__name__}.{key} must not be null. Give it a value, or leave the "
                f"line out for its default."
            )
        inner = record_type(fields[key])
        if inner is None or value is None:
            continue
        if typing.get_origin(fields[key]) is list and isinstance(value, list):
            for number, entry in enumerate(value):
                check_keys(inner, entry, where=f"{where}[{key}][{number}]")
        else:
            check_keys(inner, value, where=f"{where}[{key}]")


def _takes_none(annotation: Any) -> bool:
    """Whether null is a value of a field."""
    return annotation is Any or type(None) in typing.get_args(annotation)


def record_type(annotation: Any) -> type | None:
    """The dataclass an annotation names, alone, in ``X | None`` or in ``list[X]``."""
    for option in (annotation, *typing.get_args(annotation)):
        if dataclasses.is_dataclass(option):
            return option
    return None


def one_line(error: BaseException) -> str:
    """The text of an error on one line."""
    return " ".join(str(error).split()) or type(error).__name__
