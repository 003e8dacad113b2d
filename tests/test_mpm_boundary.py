"""Walls: what they take from a moving body, and what they leave."""

from dataclasses import replace

import torch

from giorom.mpm import Scene, SolverConfig, StableNeoHookean, draw_scene, simulate
from giorom.mpm.boundary import walls_of
from giorom.mpm.engine import Engine
from giorom.mpm.scene_config import JELLY3D
from giorom.mpm.shapes import lattice

CELLS = 32
RUBBER = StableNeoHookean(density=1000.0, youngs_modulus=1e5, poissons_ratio=0.3)


def slab(contact: str, *, velocity: tuple[float, float], bottom: float = 4.0 / CELLS) -> Scene:
    """A rubber slab on (or above) the floor at 4 cells, every particle at one velocity."""
    spacing = 0.5 / CELLS
    points = torch.from_numpy(lattice((0.25, 0.125), spacing)).float()
    points += torch.tensor([0.5, bottom + 0.0625])
    count = len(points)
    return Scene(
        position=points,
        velocity=torch.tensor(velocity).repeat(count, 1),
        affine_velocity=torch.zeros(count, 2, 2),
        volume=torch.full((count,), spacing**2),
        particle_type=torch.full((count,), RUBBER.particle_type),
        materials=(RUBBER,),
        material_index=torch.zeros(count, dtype=torch.long),
        bounds=torch.tensor([[0.125, 0.875]] * 2),
        wall_contact=contact,
        gravity=9.8,
    )


def run(scene: Scene, substeps: int) -> Engine:
    engine = Engine(scene, walls_of(scene, CELLS), substep_dt=2.5e-4, device="cpu")
    engine.advance(substeps)
    return engine


def test_slip_floor_takes_no_horizontal_momentum():
    """No friction, no force along the floor: P_x is constant to float32 rounding."""
    engine = run(slab("slip", velocity=(0.5, 0.0)), 400)
    assert abs(float(engine.velocity()[:, 0].mean()) / 0.5 - 1.0) < 1e-5


def test_stick_floor_stops_a_sliding_slab():
    """No slip: after 0.4 s of sliding and shaking the slab is where the floor caught it.

    Sticking from the start, its foot moves no further than the sway of the slab lets it: the
    shear wave needs h / sqrt(mu / rho) = 20 ms to bring the whole slab to rest.
    """
    scene = slab("stick", velocity=(0.2, 0.0))
    foot = scene.position[:, 1] < 4.5 / CELLS
    engine = run(scene, 1600)
    way = (engine.position() - scene.position)[:, 0]
    assert float(way[foot].abs().max()) < 0.1 / CELLS
    assert float(way.mean()) < 0.2 * 0.020


def test_stick_floor_lets_a_bouncing_slab_go():
    """Separating: once its lowest particle is 1.5 cells up, the slab falls freely: dv = -g t."""
    scene = slab("stick", velocity=(0.0, -1.0), bottom=6.0 / CELLS)
    engine = run(scene, 510)
    before = float(engine.velocity()[:, 1].mean())
    assert before > 0.0
    engine.advance(100)
    assert float(engine.position()[:, 1].min()) > 5.5 / CELLS
    change = float(engine.velocity()[:, 1].mean()) - before
    assert abs(change / (-9.8 * 100 * 2.5e-4) - 1.0) < 1e-4


def test_contact_of_the_config_reaches_scene_walls_and_attributes():
    """One word from YAML to the trajectory file."""
    config = replace(JELLY3D, spacing=1.0 / 40.0, wall=0.1, wall_contact="stick")
    scene = draw_scene(config, seed=0)
    assert walls_of(scene, 24).sticking
    assert not walls_of(replace(scene, wall_contact="slip"), 24).sticking
    motion = simulate(scene, SolverConfig(grid_cells=24, frame_dt=5e-3, frames=2))
    assert motion.attributes["wall_contact"] == "stick"
