"""Too large a time step is refused before a run, and caught during one."""

import math

import pytest
import torch

from giorom.mpm import Scene, SimulationError, SolverConfig, simulate
from giorom.mpm import simulate as simulate_function
from giorom.mpm.materials import MATERIALS, Material, make_material
from giorom.mpm.shapes import lattice

CELLS = 32
SOLID = {"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
PARAMETERS = {
    "stable_neo_hookean": SOLID,
    "fixed_corotated": SOLID,
    "weakly_compressible_fluid": {"density": 1000.0, "bulk_modulus": 1e5},
    "drucker_prager_sand": SOLID | {"friction_angle": 30.0},
    "von_mises_plasticine": SOLID | {"yield_stress": 1e4},
    "viscoplastic_goop": SOLID | {"yield_stress": 1e4, "viscosity": 10.0},
}


def standing(material: Material, gravity: float) -> Scene:
    """A block at rest on the floor; what moves it fast is not its own motion."""
    points = torch.from_numpy(lattice((0.25, 0.25), 0.5 / CELLS)).float()
    points += torch.tensor([0.5, 0.25])
    count = len(points)
    return Scene(
        position=points,
        velocity=torch.zeros(count, 2),
        affine_velocity=torch.zeros(count, 2, 2),
        volume=torch.full((count,), 0.25 / CELLS**2),
        particle_type=torch.full((count,), material.particle_type),
        materials=(material,),
        material_index=torch.zeros(count, dtype=torch.int64),
        bounds=torch.tensor([[0.125, 0.875]] * 2),
        gravity=gravity,
    )


def config_at(material: Material, courant: float, frames: int = 81) -> SolverConfig:
    """A configuration whose substep has a Courant number of ``c dt / dx``."""
    frame_dt = 4.0 * courant / (CELLS * material.sound_speed)
    return SolverConfig(grid_cells=CELLS, frame_dt=frame_dt, frames=frames, substeps=4)


def test_every_law_is_tried():
    """The table above names each material there is."""
    assert set(PARAMETERS) == set(MATERIALS)


@pytest.mark.parametrize("name", PARAMETERS)
def test_courant_number_above_one_is_refused_before_the_run(name: str):
    """Cn = 1.5 breaks the rule of every law; the message says how many substeps it takes."""
    material = make_material(name, PARAMETERS[name])
    needed = math.ceil(4.0 * 1.5 / material.cfl_limit * (1.0 - 1e-6))
    with pytest.raises(ValueError, match=rf"time-step rule sound speed .* to {needed} or more"):
        simulate(standing(material, 0.0), config_at(material, 1.5))


@pytest.mark.parametrize("name", PARAMETERS)
def test_run_that_escapes_the_rule_raises_and_gives_no_nan(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    """With the check before the run out of the way, a guard of the frames stops Cn = 3."""
    module = __import__(simulate_function.__module__, fromlist=["chosen_substeps"])
    monkeypatch.setattr(module, "chosen_substeps", lambda scene, solver: solver.substeps)
    material = make_material(name, PARAMETERS[name])
    with pytest.raises(SimulationError, match=r"guard '(finite|speed|box)' broken"):
        simulate(standing(material, 9.8), config_at(material, 3.0))
