"""The simulator's contract: frames, attributes and the guards that raise."""

import importlib
import json
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from giorom.mpm import Scene, SimulationError, SolverConfig, draw_scene, make_material, simulate
from giorom.mpm.boundary import walls_of
from giorom.mpm.engine import Engine
from giorom.mpm.scene_config import ELASTIC3D, JELLY3D, WATER2D
from giorom.state import SAND

# ``giorom.mpm.simulate`` names the function; its module is reached like this.
simulate_module = importlib.import_module("giorom.mpm.simulate")

SOLVER = SolverConfig(grid_cells=24, frame_dt=5e-3, frames=11)
COARSE = replace(JELLY3D, spacing=1.0 / 40.0, wall=0.1)


def test_trajectory_starts_with_the_scene_and_has_exactly_the_frames_asked_for():
    """Frame 0 is the scene; bounds are the wall nodes; attributes are JSON values."""
    scene = draw_scene(COARSE, seed=0)
    done = []
    run = simulate(scene, SOLVER, progress=lambda frame, frames: done.append((frame, frames)))
    assert run.position.shape == (11, *scene.position.shape)
    assert torch.equal(run.position[0], scene.position)
    assert run.bounds.tolist() == [[pytest.approx(2 / 24), pytest.approx(22 / 24)]] * 3
    assert done == [(frame, 11) for frame in range(2, 12)]
    kept = json.loads(json.dumps(run.attributes))
    for key in ("materials", "seed", "shape", "gravity", "grid_cells"):
        assert key in kept
    assert kept["substep_dt"] * kept["substeps"] == pytest.approx(SOLVER.frame_dt)
    assert kept["warp_version"]
    assert kept["seconds"] > 0.0


def test_body_thrown_at_the_walls_stays_inside_and_separates():
    """A bouncing jelly and a falling drop keep within 0.6 cells of the wall planes."""
    jelly = replace(COARSE, speed_range=[3.0, 3.0])
    water = replace(WATER2D, spacing=1.0 / 64.0, wall=0.125)
    for config, cells in ((jelly, 24), (water, 32)):
        solver = SolverConfig(grid_cells=cells, frame_dt=5e-3, frames=121)
        run = simulate(draw_scene(config, seed=3), solver)
        slack = 0.6 / cells
        assert bool((run.position >= run.bounds[:, 0] - slack).all())
        assert bool((run.position <= run.bounds[:, 1] + slack).all())


def test_substeps_chosen_are_the_fewest_the_rules_allow():
    """One substep fewer breaks the wave rule, and the message gives the way out."""
    scene = draw_scene(ELASTIC3D, seed=0)
    solver = SolverConfig(grid_cells=32, frame_dt=5e-3, frames=2)
    chosen = simulate(scene, solver).attributes["substeps"]
    too_few = replace(solver, substeps=chosen - 1)
    with pytest.raises(ValueError, match=rf"sound speed .* SolverConfig.substeps to {chosen}"):
        simulate(scene, too_few)


def test_wave_number_of_one_and_a_half_is_refused_before_the_run():
    """The time-step guard raises; it does not return NaN."""
    scene = draw_scene(ELASTIC3D, seed=0)
    frame_dt = 1.5 / 32 / scene.materials[0].sound_speed
    with pytest.raises(ValueError, match="breaks the time-step rule"):
        simulate(scene, SolverConfig(grid_cells=32, frame_dt=frame_dt, frames=2, substeps=1))


def test_unstable_run_raises_with_its_frame(monkeypatch: pytest.MonkeyPatch):
    """With the first guard switched off a far too large step ends in the second."""
    monkeypatch.setattr(simulate_module, "largest_substep", lambda *_: (1.0, "switched off"))
    scene = draw_scene(COARSE, seed=1)
    solver = SolverConfig(grid_cells=24, frame_dt=2e-2, frames=200, substeps=1)
    with pytest.raises(SimulationError, match=r"frame \d+: guard '(speed|finite|box)' broken"):
        simulate(scene, solver)


@pytest.mark.parametrize(
    ("position", "speed", "guard"),
    [
        (float("nan"), 0.0, "guard 'finite'"),
        (0.5, 1e4, "guard 'speed'"),
        (0.01, 0.0, "guard 'box'"),
    ],
)
def test_each_guard_names_itself_and_the_remedy(position: float, speed: float, guard: str):
    """Checked on one particle of a frame."""
    walls = walls_of(draw_scene(COARSE, seed=0), 24)
    at, moving = torch.full((1, 3), position), torch.full((1, 3), speed)
    with pytest.raises(SimulationError, match=rf"frame 7: {guard} broken.*Raise SolverConfig"):
        simulate_module._require_sound(at, moving, walls, 1e-3, 7)


@pytest.mark.parametrize(
    ("position", "message"), [(float("nan"), "not finite"), (0.99, "outside its walls")]
)
def test_start_that_cannot_run_is_refused(position: float, message: str):
    """Positions must be finite and inside."""
    scene = draw_scene(COARSE, seed=0)
    moved = scene.position.clone()
    moved[5, 0] = position
    with pytest.raises(ValueError, match=message):
        simulate(Scene(**vars(scene) | {"position": moved}), SOLVER)


def test_walls_too_near_the_side_of_the_grid_are_refused():
    """Two cells of room on each side keep every stencil on the grid."""
    scene = draw_scene(ELASTIC3D, seed=0)
    with pytest.raises(ValueError, match=r"nearer than 2 cells .* SceneConfig.wall"):
        simulate(scene, SolverConfig(grid_cells=16, frame_dt=5e-3, frames=2))


def test_missing_device_is_refused():
    """The message says what would work."""
    with pytest.raises(ValueError, match="no device 'abacus'"):
        simulate(draw_scene(COARSE, seed=0), SOLVER, device="abacus")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"grid_cells": 4}, "at least 8"),
        ({"frame_dt": 0.0}, "must be > 0 s"),
        ({"frames": 0}, "at least 1"),
        ({"substeps": 0}, "at least 1"),
    ],
)
def test_impossible_solvers_are_refused(values: dict, message: str):
    """Each message names the field."""
    with pytest.raises(ValueError, match=message):
        replace(SOLVER, **values)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(
    "config",
    [
        COARSE,
        replace(WATER2D, spacing=1.0 / 48.0),
        replace(COARSE, material="fixed_corotated"),
        replace(
            COARSE,
            material="drucker_prager_sand",
            material_parameters=COARSE.material_parameters | {"friction_angle": 30.0},
        ),
        replace(
            COARSE,
            material="viscoplastic_goop",
            material_parameters=COARSE.material_parameters
            | {"yield_stress": 100.0, "viscosity": 20.0},
        ),
    ],
)
def test_cuda_and_cpu_agree(config):
    """One source for both; sums in another order, so 1e-5 m over 20 frames."""
    scene, solver = draw_scene(config, seed=0), replace(SOLVER, frames=21)
    on_cpu = simulate(scene, solver).position
    on_gpu = simulate(scene, solver, device="cuda").position
    torch.testing.assert_close(on_gpu, on_cpu, rtol=0.0, atol=1e-5)


def test_compiling_is_not_part_of_the_measured_run(monkeypatch: pytest.MonkeyPatch):
    """The kernels are there before the clock starts: a cold cache must not slow the solver."""
    from giorom.mpm import engine

    events, load, clock = [], engine.wp.load_module, time.perf_counter

    def noted_load(*arguments: Any, **options: Any) -> Any:
        events.append("load")
        return load(*arguments, **options)

    def noted_clock() -> float:
        events.append("clock")
        return clock()

    monkeypatch.setattr(engine.wp, "load_module", noted_load)
    monkeypatch.setattr(simulate_module, "time", SimpleNamespace(perf_counter=noted_clock))
    simulate(draw_scene(COARSE, seed=0), replace(SOLVER, frames=2))
    assert events == ["load", "load", "clock", "clock"]  # grid kernels and those of the law


def test_lone_grain_that_is_pulled_apart_bears_no_strain():
    """Sand has no tension: ``b`` returns to one in every substep, to rounding.

    One grain on its own keeps its velocity gradient (APIC is exact for affine fields) and is
    pulled apart in every substep; rounding in one triangle of ``b`` must not feed on itself.
    """
    sand = make_material(
        "drucker_prager_sand",
        {"density": 1e3, "youngs_modulus": 1e6, "poissons_ratio": 0.2, "friction_angle": 30.0},
    )
    scene = Scene(
        position=torch.tensor([[0.51, 0.49]]),
        velocity=torch.zeros(1, 2),
        affine_velocity=torch.tensor([[[200.0, -50.0], [-20.0, 150.0]]]),
        volume=torch.tensor([1e-4]),
        particle_type=torch.tensor([SAND]),
        materials=(sand,),
        material_index=torch.tensor([0]),
        bounds=torch.tensor([[0.1, 0.9], [0.1, 0.9]]),
    )
    engine = Engine(scene, walls_of(scene, 60), substep_dt=3e-4, device="cpu")
    engine.advance(3000)
    (strain,) = engine.strain()
    torch.testing.assert_close(strain, torch.eye(2), rtol=0.0, atol=1e-6)


def test_substeps_recorded_in_groups_are_the_same_substeps():
    """250 at once are 250 one by one, bit for bit, on the CPU."""
    scene = draw_scene(COARSE, seed=2)
    solver = replace(SOLVER, frame_dt=2e-2, frames=2, substeps=250)
    together, single = (simulate_module.Run(scene, solver)._engine for _ in range(2))
    together.advance(250)
    for _ in range(250):
        single.advance(1)
    assert torch.equal(together.position(), single.position())
    assert not torch.equal(together.position(), scene.position)
