"""The solver on coarser grids: a similarity changes nothing, mass is kept, the step is searched."""

import math
from dataclasses import fields, replace
from itertools import count

import pytest
import torch

from giorom.evaluation import coarse_solver
from giorom.evaluation.coarse_solver import (
    SolverRun,
    largest_stable_substeps,
    rules_substeps,
    run_coarse,
    score_coarse,
    seeded_at,
    sparse_error,
    timed,
)
from giorom.evaluation.noise_floor import deviation, seed_elsewhere
from giorom.mpm import SceneConfig, SolverConfig, draw_scene, simulate
from giorom.mpm.materials import MATERIALS
from giorom.mpm.scene_config import MaterialChoice
from giorom.mpm.similar import SAME, STRESSES, on_cells
from giorom.sampling import sample_farthest

PARAMETERS = {
    "density": 1000.0,
    "youngs_modulus": 1e5,
    "poissons_ratio": 0.2,
    "bulk_modulus": 1e5,
    "yield_stress": 500.0,
    "viscosity": 20.0,
    "friction_angle": 30.0,
}

SOLVER = SolverConfig(grid_cells=20, frame_dt=5e-3, frames=13)


def thrown(law: str = "stable_neo_hookean", **changes):
    """A few hundred particles of a spinning block on their way to a wall."""
    needed = {field.name for field in fields(MATERIALS[law])} & set(PARAMETERS)
    family = {
        "family": "thrown",
        "dimension": 2,
        "material": law,
        "material_parameters": {name: PARAMETERS[name] for name in needed},
        "shapes": ["box"],
        "height_range": [0.3, 0.3],
        "slenderness": [1.0, 1.0],
        "spacing": 0.02,
        "speed_range": [2.0, 2.0],
        "spin_range": [5.0, 5.0],
        "gravity": 9.8,
        "wall": 0.2,
    }
    return draw_scene(SceneConfig(**(family | changes)), seed=3)


@pytest.mark.parametrize("law", sorted(MATERIALS))
def test_a_scene_in_other_units_of_length_moves_alike(law):
    """Lengths times s, stresses times s^2, time kept: the same motion but for the rounding."""
    scene = thrown(law)
    similar = on_cells(scene, grid_cells=20, coarsening=1.0)
    assert similar.grid_cells == 16  # twelve cells between the walls, two beyond each
    assert similar.factor == pytest.approx(1.25)
    own = replace(SOLVER, grid_cells=16)
    found, truth = simulate(similar.scene, own).position, simulate(scene, SOLVER)
    motion = float((truth.position - truth.position[:1]).square().sum(dim=2).mean())
    assert motion > 1e-3
    error = (similar.metres(found) - truth.position).square().sum(dim=2).mean()
    assert float(error) < 1e-7 * motion
    assert torch.equal(run_coarse(scene, SOLVER).position, truth.position)


def test_every_parameter_of_every_law_has_a_known_unit():
    names = {field.name for law in MATERIALS.values() for field in fields(law)}
    assert names == {*STRESSES, *SAME}


@pytest.mark.parametrize("coarsening", [1.0, 2.0, 3.0, 4.0])
def test_the_walls_of_a_coarse_grid_are_those_of_the_fine_one(coarsening):
    """Lower walls on nodes; upper ones at most a cell farther out; two cells beyond each."""
    scene = thrown()
    similar = on_cells(scene, grid_cells=20, coarsening=coarsening)
    fine, cell = scene.bounds.double(), coarsening / 20
    low, high = (similar.metres(side) for side in similar.scene.bounds.unbind(dim=1))
    torch.testing.assert_close(low, fine[:, 0], atol=1e-7, rtol=0.0)
    torch.testing.assert_close(high, fine[:, 1], atol=1e-7, rtol=0.0)
    nodes = similar.scene.bounds * similar.grid_cells
    torch.testing.assert_close(nodes[:, 0], torch.full_like(nodes[:, 0], 2.0))
    assert bool(((nodes[:, 1] - 1e-6).ceil() <= similar.grid_cells - 2).all())
    assert similar.factor == pytest.approx(1.0 / (similar.grid_cells * cell))
    back = similar.metres(similar.scene.position)
    torch.testing.assert_close(back, scene.position, atol=1e-6, rtol=0.0)


def test_a_clamped_body_is_held_up_to_the_same_plane(tiny):
    """The clamp plane of the fine grid is a row of nodes of the coarse one."""
    scene = draw_scene(tiny.scene, seed=0)
    for coarsening in (1.0, 2.0):
        similar = on_cells(scene, grid_cells=16, coarsening=coarsening)
        plane = similar.scene.clamp_plane * similar.grid_cells
        assert plane == pytest.approx(round(plane), abs=1e-6)
        fine_plane = math.ceil(scene.clamp_plane * 16 - 0.25) / 16
        assert plane * coarsening / 16 + float(similar.origin[1]) == pytest.approx(fine_plane)


def test_samples_take_over_the_mass_of_every_material():
    """Mass and the momentum of a uniform motion are those of the full body."""
    sand = MaterialChoice(
        material="drucker_prager_sand",
        material_parameters={
            "density": 2000.0,
            "youngs_modulus": 1e5,
            "poissons_ratio": 0.2,
            "friction_angle": 30.0,
        },
    )
    scene = thrown(mixture=[sand], bodies=[4, 4], height_range=[0.12, 0.12])
    assert len(scene.materials) == 2
    samples = sample_farthest(scene.position, 20)
    points = seeded_at(scene, samples)
    assert torch.equal(points.position, scene.position[samples])
    for index in range(2):
        own, fine = points.material_index == index, scene.material_index == index
        assert float(points.mass[own].sum()) == pytest.approx(float(scene.mass[fine].sum()))
    alone = seeded_at(scene, samples[:1])
    assert float(alone.volume) == pytest.approx(float(scene.volume.sum()))
    everything = seeded_at(scene, torch.arange(len(scene.position)))
    assert torch.equal(everything.volume, scene.volume)


def test_a_coarser_grid_is_farther_from_the_fine_run_and_takes_fewer_substeps():
    """Truncation error and the Courant number both grow with the cell."""
    scene = thrown()
    truth = simulate(scene, SOLVER)
    samples = sample_farthest(scene.position, 60)
    options = {"samples": samples}
    errors, substeps = [], []
    for coarsening in (1.0, 2.0, 4.0):
        run = run_coarse(scene, SOLVER, coarsening=coarsening, **options)
        errors.append(sparse_error(run, truth, samples))
        substeps.append(rules_substeps(scene, SOLVER, coarsening=coarsening, **options))
    assert errors == sorted(errors)
    assert substeps == sorted(substeps, reverse=True)
    assert 0.0 < errors[0] < 0.1 * errors[-1]
    count = largest_stable_substeps(scene, SOLVER, truth, coarsening=2.0, **options)
    assert count <= substeps[1]
    longest = run_coarse(scene, SOLVER, coarsening=2.0, substeps=count, **options)
    assert longest.diverged_at is None
    assert sparse_error(longest, truth, samples) <= 1.1 * errors[1]


def fake_runs(monkeypatch, *, stable_from: int, errors=lambda substeps: 1.0):
    """A solver that breaks a guard below some substeps, and has a given error above."""

    def run(scene, solver, *, substeps, **_):
        position = torch.full((2, 1, 2), math.sqrt(errors(substeps) / 2.0))
        broken = None if substeps >= stable_from else 1
        return SolverRun(
            position=position,
            seconds=[1.0],
            diverged_at=broken,
            grid_cells=8,
            cell=0.1,
            substeps=substeps,
        )

    monkeypatch.setattr(coarse_solver, "run_coarse", run)
    monkeypatch.setattr(coarse_solver, "rules_substeps", lambda *_, **__: 20)


def test_the_longest_step_without_broken_guard_or_larger_error_is_found(monkeypatch):
    """Steps are tried up to four times the rules' one, a quarter of it where that breaks."""
    scene = thrown()
    still = torch.zeros(2, 1, 2)
    truth = replace(
        simulate(scene, replace(SOLVER, frames=2)),
        position=still,
        particle_type=still[0, :, 0].long(),
    )
    search = {"stable": 10, "never": 1000, "short": 40, "always": 1}
    found = {}
    for name, limit in search.items():
        fake_runs(monkeypatch, stable_from=limit)
        found[name] = largest_stable_substeps(scene, SOLVER, truth)
    assert found == {"stable": 10, "never": None, "short": 40, "always": 5}
    fake_runs(monkeypatch, stable_from=1, errors=lambda n: 1.0 if n >= 14 else 1.2)
    assert largest_stable_substeps(scene, SOLVER, truth) == 14
    assert largest_stable_substeps(scene, SOLVER, truth, floor=1.2) == 5


def test_a_coarse_run_that_breaks_a_guard_says_when_and_stays_where_it_was():
    """Two orders of magnitude beyond the rule of the sound speed."""
    scene = thrown(material_parameters=PARAMETERS_STIFF)
    run = run_coarse(scene, SOLVER, substeps=1)
    assert run.diverged_at is not None
    assert run.position.shape == (13, len(scene.position), 2)
    assert torch.equal(run.position[-1], run.position[run.diverged_at - 1])
    assert bool(run.position.isfinite().all())


PARAMETERS_STIFF = {"density": 1000.0, "youngs_modulus": 1e9, "poissons_ratio": 0.2}


def test_scores_of_a_coarse_run_are_those_of_its_samples_and_of_what_they_carry():
    """A field that knows the truth leaves no error; one that is off by s leaves |s|^2."""
    scene = thrown()
    truth = simulate(scene, SOLVER)
    samples = sample_farthest(scene.position, 60)
    run = run_coarse(scene, SOLVER, samples=samples, coarsening=2.0)
    frame = count(1)
    shift = torch.tensor([0.03, 0.04])
    row = score_coarse(
        run, truth, samples=samples, decode=lambda _: truth.position[next(frame)] + shift
    )
    assert row["full_rollout_mse"] == pytest.approx(12 / 13 * 0.05**2, rel=1e-4)
    assert row["sparse_rollout_mse"] == sparse_error(run, truth, samples) > 0.0
    assert row["points"] == 60
    total = row["solver_seconds"] + row["upscale_seconds"]
    assert row["seconds_per_frame"] == pytest.approx(total)
    assert [item for _, item in timed(iter("abc"))] == ["a", "b", "c"]
    with pytest.raises(ValueError, match="decode, which carries the samples"):
        score_coarse(run, truth, samples=samples)


def test_particles_seeded_elsewhere_stay_in_their_cells_and_nearly_repeat_the_motion():
    """Within a quarter spacing; a rigid spin is kept, v(x + dx) = v(x) + C dx; small error."""
    scene = thrown()
    moved, _ = seed_elsewhere(scene, SOLVER, 0)
    offset = moved.position - scene.position
    assert 0.004 < float(offset.abs().max()) <= 0.25 * 0.02 * (1.0 + 1e-4)
    expected = scene.velocity + torch.einsum("pij,pj->pi", scene.affine_velocity, offset)
    torch.testing.assert_close(moved.velocity, expected)
    truth = simulate(scene, SOLVER)
    errors = deviation(seed_elsewhere, scene, SOLVER, truth, seed=0)
    assert float(errors[0]) == pytest.approx(0.0, abs=1e-13)
    motion = float((truth.position - truth.position[:1]).square().sum(dim=2).mean())
    assert 0.0 < float(errors.mean()) < 0.01 * motion
