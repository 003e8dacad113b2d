"""Every preset of the package: its first scenes, its size and, for the small ones, its solver.

Sizes are those of arXiv:2407.03925v2, Table 1 (P particles, Q samples, frames), which the 2-D
sets inherit from their published models: there P is the most a trajectory has.
"""

from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path

import pytest
import torch

from giorom.config import Experiment, load_experiment, preset_names
from giorom.data.published import published_for
from giorom.mpm import draw_scene, simulate
from giorom.mpm.bodies import draw_bodies
from giorom.mpm.boundary import walls_of
from giorom.mpm.scene_config import SceneConfig
from giorom.mpm.simulate import chosen_substeps
from giorom.records import parse_record
from giorom.state import ELASTIC, GOOP, KINEMATIC, PLASTICINE, RIGID, SAND, WATER

SMALL = [name for name in preset_names() if name.endswith("-small")]
FULL = [name for name in preset_names() if not name.endswith("-small")]

TABLE_1 = {
    "water3d": (55_000, 1_700, 1000, {WATER}),
    "sand3d": (32_000, 1_000, 400, {SAND}),
    "plasticine3d": (5_000, 1_100, 320, {PLASTICINE}),
    "elastic3d": (78_000, 2_600, 120, {KINEMATIC, ELASTIC}),
    "jelly3d": (32_000, 1_000, 300, {ELASTIC}),
    "water2d": (1_000, 120, 1000, {WATER}),
    "sand2d": (2_000, 300, 320, {SAND}),
    "goop2d": (1_900, 200, 400, {GOOP}),
    "multimaterial2d": (2_000, 250, 1000, {RIGID, WATER, SAND, GOOP}),
}


def test_every_system_has_a_preset_of_the_paper_and_a_small_one():
    """Nine systems, eighteen presets."""
    assert set(FULL) == set(TABLE_1)
    assert {name.removesuffix("-small") for name in SMALL} == set(TABLE_1)


@pytest.mark.parametrize("name", preset_names())
def test_first_scene_of_a_preset_can_be_simulated(name: str):
    """Inside the walls of its grid, a time step is found, the record survives its storage."""
    experiment = load_experiment(name)
    scene = draw_scene(experiment.scene, seed=0)
    walls_of(scene, experiment.solver.grid_cells).require_inside(scene.position)
    assert 1 <= chosen_substeps(scene, experiment.solver) <= 64
    values = asdict(experiment.scene)
    assert parse_record(SceneConfig, values, where="stored") == experiment.scene


@pytest.mark.parametrize("name", SMALL)
def test_same_seed_draws_the_same_scene_of_a_preset(name: str):
    """Bit for bit; the next seed draws another."""
    config = load_experiment(name).scene
    one, again, other = (draw_scene(config, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(one.position, again.position)
    assert torch.equal(one.velocity, again.velocity)
    assert one.attributes == again.attributes
    assert one.attributes != other.attributes


@pytest.mark.parametrize("name", [name for name in FULL if name.endswith("3d")])
def test_full_size_in_space_is_that_of_the_paper(name: str):
    """P and Q to 3 %, frames exactly."""
    particles, samples, frames, types = TABLE_1[name]
    experiment = load_experiment(name)
    scene = draw_scene(experiment.scene, seed=1)
    assert len(scene.position) == pytest.approx(particles, rel=0.03)
    assert experiment.sampling.sample_count(len(scene.position)) == samples
    assert experiment.solver.frames == frames
    assert set(scene.particle_type.tolist()) == types
    assert len(experiment.scene.shapes) >= 4
    assert len(experiment.scene.held_out_shapes) >= 4


@pytest.mark.parametrize("name", [name for name in FULL if name.endswith("2d")])
def test_full_size_in_the_plane_is_that_of_the_published_sets(name: str):
    """Most particles near the published number, as many samples to each; same walls and clock."""
    particles, samples, frames, types = TABLE_1[name]
    experiment = load_experiment(name)
    scenes = [draw_scene(experiment.scene, seed=seed) for seed in range(30)]
    most = max(len(scene.position) for scene in scenes)
    assert 0.6 * particles < most < 1.1 * particles
    ratio = particles / samples
    assert experiment.sampling.sample_count(most) == pytest.approx(most / ratio, rel=0.03)
    assert experiment.solver.frames == frames
    assert {kind for scene in scenes for kind in scene.particle_type.unique().tolist()} == types
    walls = walls_of(scenes[0], experiment.solver.grid_cells).planes.tolist()
    assert walls == [[pytest.approx(0.1), pytest.approx(0.9)]] * 2
    for row in published_for(experiment.system):
        assert row.frame_dt == experiment.solver.frame_dt
        assert row.frames == frames
        assert set(row.particle_types) == types


@pytest.mark.parametrize("name", ["sand2d", "goop2d", "multimaterial2d"])
def test_bodies_of_a_preset_always_find_room_and_never_overlap(name: str):
    """Bounding boxes are more than a particle apart along an axis, in forty scenes."""
    config = load_experiment(name).scene
    for seed in range(40):
        for one, other in combinations(draw_bodies(config, seed=seed), 2):
            above = one.position.min(axis=0) - other.position.max(axis=0)
            below = other.position.min(axis=0) - one.position.max(axis=0)
            assert max(above.max(), below.max()) > config.spacing


@pytest.mark.parametrize("name", [name for name in SMALL if not name.startswith("elastic")])
def test_small_preset_advances_by_two_frames(name: str):
    """The solver takes it: guards hold, and its bodies fall by g t^2 / 2 beside their motion.

    Before anything touches a wall the centre of mass flies: x + v t + g t (t + dt) / 2, the
    last term between the continuous one and that of the substeps.
    """
    experiment: Experiment = load_experiment(name)
    scene = draw_scene(experiment.scene, seed=0)
    solver = replace(experiment.solver, frames=3)
    run = simulate(scene, solver)
    time = 2.0 * solver.frame_dt
    weight = (scene.mass / scene.mass.sum())[:, None].double()
    expected = (weight * (scene.position + time * scene.velocity).double()).sum(dim=0)
    expected[1] -= 0.5 * scene.gravity * time * (time + run.attributes["substep_dt"])
    center = (weight * run.position[2].double()).sum(dim=0)
    torch.testing.assert_close(center, expected, rtol=0.0, atol=2e-5)


def test_melting_scene_of_the_documentation_runs_through_its_switch(tmp_path: Path):
    """The YAML of docs/scenes.md: loads as it is; with an early switch the laws change in time.

    Up to the frame of the switch the motion is that of the same scene without one, bit for
    bit; the body is on the floor by then, so that the next frames differ.
    """
    text = (Path(__file__).parents[1] / "docs" / "scenes.md").read_text(encoding="utf-8")
    path = tmp_path / "melting.yaml"
    path.write_text(text.split("```yaml")[1].split("```")[0], encoding="utf-8")
    experiment = load_experiment(str(path))
    low = replace(
        experiment.scene,
        points=500,
        placement=[[0.5, 0.5], [0.38, 0.38], [0.5, 0.5]],
        wall=0.125,
        shapes=["rabbit"],
        speed_range=[0.0, 0.0],
        height_range=[0.5, 0.5],
        switch=replace(experiment.scene.switch, frame=8),
    )
    solver = replace(experiment.solver, grid_cells=16, frames=16)
    melting = simulate(draw_scene(low, seed=0), solver)
    staying = simulate(draw_scene(replace(low, switch=None), seed=0), solver)
    assert torch.equal(melting.position[:9], staying.position[:9])
    assert float((melting.position[15] - staying.position[15]).abs().max()) > 1e-4
