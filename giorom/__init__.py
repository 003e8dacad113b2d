"""GIOROM: simulate a sparse sample of the particles, then recover every point.

The public names follow the order in which data flow through the method (arXiv:2407.03925). They are
imported when they are first used, so that ``giorom --help`` need not wait for PyTorch.
"""

import importlib
from typing import TYPE_CHECKING, Any

from giorom.version import __version__

if TYPE_CHECKING:
    from giorom.config import Experiment, load_experiment
    from giorom.fields import Field
    from giorom.graph import choose_radius, radius_edges
    from giorom.mpm import Scene, SceneConfig, SolverConfig, draw_scene, simulate
    from giorom.sampling import sample
    from giorom.simulator import Simulator
    from giorom.state import SparseState, Trajectory
    from giorom.time_stepper import TimeStepper

_PLACES = {
    "Trajectory": "giorom.state",
    "SparseState": "giorom.state",
    "SceneConfig": "giorom.mpm",
    "Scene": "giorom.mpm",
    "draw_scene": "giorom.mpm",
    "SolverConfig": "giorom.mpm",
    "simulate": "giorom.mpm",
    "sample": "giorom.sampling",
    "radius_edges": "giorom.graph",
    "choose_radius": "giorom.graph",
    "TimeStepper": "giorom.time_stepper",
    "Field": "giorom.fields",
    "Simulator": "giorom.simulator",
    "Experiment": "giorom.config",
    "load_experiment": "giorom.config",
}

__all__ = [
    "Experiment",
    "Field",
    "Scene",
    "SceneConfig",
    "Simulator",
    "SolverConfig",
    "SparseState",
    "TimeStepper",
    "Trajectory",
    "__version__",
    "choose_radius",
    "draw_scene",
    "load_experiment",
    "radius_edges",
    "sample",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _PLACES:
        raise AttributeError(f"module 'giorom' has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    """Public names, imported or not."""
    return sorted(__all__)
