"""``giorom benchmark TARGET``: speeds of the parts of the package.

Each target is a module of its own, ``benchmark_TARGET``, with options of its own.
"""

import importlib
from types import ModuleType

from giorom.records import nearest

TARGETS = {
    "solver": "particle-substeps per second of the material point method",
    "pareto": "error against time: the models, their peers and the solver on one system",
}
"""What can be timed."""


def choose(arguments: list[str]) -> tuple[str, ModuleType, list[str], str] | None:
    """The target that the arguments name.

    Args:
        arguments: What was typed after ``giorom benchmark``.

    Returns:
        Name, module, remaining arguments and description; None if help was asked for.

    Raises:
        ValueError: If there is no such target.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        listing = "\n".join(f"  {name:10s} {text}" for name, text in TARGETS.items())
        print(f"usage: giorom benchmark <target> [options]\n\ntargets:\n{listing}")
        return None
    name = arguments[0]
    if name not in TARGETS:
        raise ValueError(f"there is no target {name!r}. {nearest(name, TARGETS)}")
    module = importlib.import_module(f"giorom.commands.benchmark_{name}")
    return f"benchmark {name}", module, arguments[1:], TARGETS[name]
