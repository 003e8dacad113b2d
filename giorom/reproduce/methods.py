"""The time-steppers that are compared: their names, their titles for people, their recipes.

A name is the recipe of a network; ``equal`` is the one training that all networks get.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Method:
    """One time-stepper of the comparison."""

    name: str
    """Name in commands, tables and files."""

    title: str
    """What it is, for a person."""

    recipes: tuple[str, ...]
    """Recipes laid over the preset of the system."""

    origin: Literal["ours", "paper", "newer", "check"]
    """Whose row it is: ours, one of the paper's, a peer the paper lacks, a check."""

    @property
    def is_network(self) -> bool:
        """Whether a network moves the samples at every scale; a preset may choose otherwise."""
        return bool(self.recipes)

    @property
    def is_tuned(self) -> bool:
        """Whether its learning rate and noise are chosen on the validation trajectories."""
        return "equal" in self.recipes


def _network(name: str, title: str, origin: Literal["ours", "paper", "newer", "check"]) -> Method:
    return Method(name=name, title=title, recipes=("equal", name), origin=origin)


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(name="default", title="ours: the preset as it is", recipes=(), origin="ours"),
        Method(
            name="paper",
            title="the paper's network in the paper's training",
            recipes=("paper",),
            origin="paper",
        ),
        _network("io-not-io", "IO + NOT + IO, the paper's network", "paper"),
        _network("gns", "GNS", "paper"),
        _network("gat", "GAT (GATv2)", "paper"),
        _network("gino", "GINO", "paper"),
        _network("gnot", "GNOT", "paper"),
        _network("ipot", "IPOT", "paper"),
        _network("ipot-query", "IPOT, features in the query", "newer"),
        _network("not", "NOT without IO", "paper"),
        _network("io-fno-io", "IO + FNO + IO", "paper"),
        _network("gno-fno-gno", "GNO + FNO + GNO", "paper"),
        _network("2gno-fno-2gno", "2 GNO + FNO + 2 GNO", "paper"),
        _network("transolver", "Transolver", "newer"),
        _network("io-transolver-io", "IO + Transolver + IO", "newer"),
        _network("io-cnn-io", "IO + CNN + IO (CoRGI-like)", "newer"),
        _network("unet", "grid U-Net (NeuralMPM-like)", "newer"),
        _network("linear", "linear model of the same features", "check"),
    )
}
"""By name."""

PAPER_ROWS = ("gns", "gat", "gino", "gnot", "ipot", "io-not-io")
"""Rows of Table 3, in the order of the paper."""

NEWER_ROWS = (
    "transolver",
    "io-transolver-io",
    "io-cnn-io",
    "unet",
    "ipot-query",
    "not",
    "linear",
)
"""What Table 3 lacks."""
