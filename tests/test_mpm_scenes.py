"""Random scenes: seeds, clamps, placement and what is refused."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from giorom.mpm import SolverConfig, draw_scene, simulate
from giorom.mpm.bodies import draw_bodies
from giorom.mpm.scene_config import (
    ELASTIC3D,
    JELLY3D,
    WATER2D,
    MaterialChoice,
    SwitchChoice,
)
from giorom.state import ELASTIC, KINEMATIC, SAND, WATER

trimesh = pytest.importorskip("trimesh")


def test_importing_the_simulator_starts_neither_warp_nor_trimesh():
    """Scenes can be drawn on a machine without the simulator's engine."""
    code = (
        "import sys, giorom.mpm; "
        "from giorom.mpm.scene_config import ELASTIC3D; giorom.mpm.draw_scene(ELASTIC3D, seed=0); "
        "sys.exit('warp' in sys.modules or 'trimesh' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0  # noqa: S603


@pytest.mark.parametrize("config", [ELASTIC3D, WATER2D, JELLY3D])
def test_same_seed_gives_the_same_scene(config):
    """Bit for bit; another seed gives another one."""
    one, again, other = (draw_scene(config, seed=seed) for seed in (4, 4, 5))
    for name in ("position", "velocity", "affine_velocity", "volume", "particle_type"):
        assert torch.equal(getattr(one, name), getattr(again, name))
    assert one.attributes == again.attributes
    assert not torch.equal(one.position[0], other.position[0])


@pytest.mark.parametrize("config", [ELASTIC3D, WATER2D, JELLY3D])
def test_scenes_of_a_preset_lie_inside_their_walls(config):
    """Every particle inside, velocities within the range, attributes are JSON values."""
    for seed in range(12):
        scene = draw_scene(config, seed=seed)
        assert bool((scene.position > scene.bounds[:, 0]).all())
        assert bool((scene.position < scene.bounds[:, 1]).all())
        assert scene.attributes["shape"] in config.shapes
        json.dumps(scene.attributes)


def test_clamped_body_stands_on_its_clamp_and_moves_above_it():
    """The lowest tenth is held and at rest; the top speed is the drawn one."""
    for seed in range(12):
        scene = draw_scene(ELASTIC3D, seed=seed)
        held = scene.kinematic
        height = scene.attributes["shape_extent"][1]
        assert torch.equal(held, scene.position[:, 1] <= scene.clamp_plane)
        assert scene.clamp_plane == pytest.approx(ELASTIC3D.base_height + 0.1 * height)
        assert float(scene.velocity[held].abs().max()) == 0.0
        assert set(scene.particle_type.tolist()) == {KINEMATIC, ELASTIC}
        top = float(scene.velocity.norm(dim=1).max())
        assert top == pytest.approx(scene.attributes["initial_motion"]["top_speed"], rel=1e-5)
        assert 0.7 <= top <= 1.7


def test_thrown_body_starts_as_a_rigid_motion():
    """V = v_0 + omega x (x - x_c), the affine velocity being its gradient."""
    scene = draw_scene(JELLY3D, seed=1)
    around = scene.position - scene.position.mean(dim=0)
    motion = scene.attributes["initial_motion"]
    angular = torch.tensor(motion["angular_velocity"]).expand_as(around)
    expected = torch.tensor(motion["linear_velocity"]) + torch.linalg.cross(angular, around)
    torch.testing.assert_close(scene.velocity, expected, rtol=1e-5, atol=1e-5)
    gradient = scene.affine_velocity[0]
    torch.testing.assert_close(gradient, -gradient.T)


def test_held_particles_never_move():
    """Bit for bit, over a whole swing."""
    scene = draw_scene(replace(ELASTIC3D, spacing=1.0 / 48.0, wall=0.1), seed=2)
    solver = SolverConfig(grid_cells=24, frame_dt=5e-3, frames=61)
    motion = simulate(scene, solver).position
    assert torch.equal(motion[:, scene.kinematic], motion[:1, scene.kinematic].expand(61, -1, -1))
    assert float((motion[-1] - motion[0])[~scene.kinematic].norm(dim=1).max()) > 1e-3


@pytest.mark.parametrize("clamped_fraction", [0.1, 0.129, 0.15, 0.18])
def test_body_swings_about_its_clamp_wherever_the_plane_lies(clamped_fraction: float):
    """A cantilever returns: its mean displacement stays below a third of its largest.

    The clamp plane passes between two rows of nodes at four different places (4.96, 5.24,
    5.44 and 5.73 cells); were the row below it the last sticky one, the body would tear off
    its held particles (mean over largest 0.6, measured, against 0.15).
    """
    config = replace(
        ELASTIC3D,
        shapes=["box"],
        height_range=[0.3, 0.3],
        slenderness=[0.53, 0.53],
        clamped_fraction=clamped_fraction,
        impulses=["bend"],
        speed_range=[1.5, 1.5],
    )
    scene = draw_scene(config, seed=1)
    motion = simulate(scene, SolverConfig(grid_cells=32, frame_dt=5e-3, frames=121)).position
    top = scene.position[:, 1] > scene.position[:, 1].quantile(0.9)
    swing = (motion - motion[0])[:, top].mean(dim=1)
    assert swing.mean(dim=0).norm() < swing.norm(dim=1).max() / 3.0


SEVERAL = replace(
    WATER2D, bodies=[2, 4], height_range=[0.08, 0.16], speed_range=[0.5, 1.0], spin_range=[0.0, 3.0]
)


def test_water_drop_is_of_type_water_and_held_out_shapes_come_on_request():
    """The ``shape`` argument reaches shapes that are never drawn."""
    scene = draw_scene(WATER2D, seed=0, shape="disc")
    assert scene.attributes["shape"] == "disc"
    assert set(scene.particle_type.tolist()) == {WATER}


def test_bodies_of_one_scene_keep_a_cell_apart():
    """Brute force over the particles of any two bodies; their number is in the range."""
    counts = set()
    for seed in range(40):
        bodies = draw_bodies(SEVERAL, seed=seed)
        counts.add(len(bodies))
        for one, other in combinations(bodies, 2):
            nearest = cdist(one.position, other.position).min()
            assert nearest > 2.0 * SEVERAL.spacing
    assert counts == {2, 3, 4}


def test_scene_of_several_bodies_has_the_momentum_of_its_parts():
    """Each centre of mass moves with its drawn velocity: P = sum m_b v_b."""
    scene, bodies = draw_scene(SEVERAL, seed=3), draw_bodies(SEVERAL, seed=3)
    momentum = (scene.volume[:, None] * scene.velocity).double().sum(dim=0)
    expected = sum(
        body.volume * len(body.position) * torch.tensor(body.motion["linear_velocity"])
        for body in bodies
    )
    torch.testing.assert_close(momentum, expected.double(), rtol=1e-5, atol=1e-8)
    assert len(scene.attributes["bodies"]) == len(bodies)
    start = 0
    for body in bodies:
        part = slice(start, start + len(body.position))
        gradient = torch.from_numpy(body.gradient).float().expand_as(scene.affine_velocity[part])
        assert torch.equal(scene.affine_velocity[part], gradient)
        start = part.stop
    assert start == len(scene.position)


def test_scene_that_cannot_hold_its_bodies_is_refused():
    """Nine boxes of half the width of the box: the message says which and what to change."""
    with pytest.raises(ValueError, match=r"no place apart .* Lower SceneConfig\.bodies"):
        draw_scene(replace(SEVERAL, bodies=[9, 9], height_range=[0.4, 0.4]), seed=0)


def test_large_body_keeps_to_the_part_of_its_placement_where_it_fits():
    """Half a metre wide and a range that reaches to the wall: always inside."""
    config = replace(
        WATER2D,
        height_range=[0.5, 0.5],
        slenderness=[1.0, 1.0],
        placement=[[0.11, 0.5], [0.4, 0.89]],
    )
    centers = np.array([draw_bodies(config, seed=seed)[0].center for seed in range(30)])
    low, high = config.wall + 0.25, 1.0 - config.wall - 0.25
    assert ((centers >= low - 1e-9) & (centers <= high + 1e-9)).all()
    assert centers[:, 0].max() <= 0.5
    assert centers[:, 1].min() >= 0.4


STIFF = MaterialChoice(
    material="stable_neo_hookean",
    material_parameters={"density": 1e3, "youngs_modulus": 1e6, "poissons_ratio": 0.3},
    particle_type=0,
)
GRAINS = {"density": 1e3, "youngs_modulus": 1e6, "poissons_ratio": 0.2, "friction_angle": 30.0}
MIXED = replace(
    SEVERAL,
    mixture=[
        STIFF,
        MaterialChoice(material="drucker_prager_sand", material_parameters=GRAINS),
    ],
)


def test_each_body_of_a_mixture_is_of_one_material_and_all_occur():
    """Type and density follow the material; the scene lists those in use and no other."""
    seen = set()
    for seed in range(12):
        scene, bodies = draw_scene(MIXED, seed=seed), draw_bodies(MIXED, seed=seed)
        start = 0
        for body in bodies:
            part = slice(start, start + len(body.position))
            (kind,) = scene.particle_type[part].unique().tolist()
            (index,) = scene.material_index[part].unique().tolist()
            assert kind == (WATER, 0, SAND)[body.choice]
            name = ("weakly_compressible_fluid", STIFF.material, "drucker_prager_sand")
            assert scene.materials[index].name == name[body.choice]
            start = part.stop
        assert scene.material_index.unique().tolist() == list(range(len(scene.materials)))
        seen |= {body.choice for body in bodies}
    assert seen == {0, 1, 2}


def test_mixed_bodies_move_for_two_frames():
    """The solver takes such a scene; types are kept."""
    seed = next(n for n in range(20) if len(draw_scene(MIXED, seed=n).materials) == 3)
    scene = draw_scene(MIXED, seed=seed)
    run = simulate(scene, SolverConfig(grid_cells=64, frame_dt=2.5e-3, frames=3))
    assert torch.equal(run.particle_type, scene.particle_type)
    assert float((run.position[-1] - run.position[0]).norm(dim=1).min()) > 0.0


def test_melting_body_holds_its_shape_until_the_switch_and_spreads_after_it():
    """Plasticine that becomes sand: its height stays, then falls under its own weight."""
    solid = {"density": 1e3, "youngs_modulus": 3e5, "poissons_ratio": 0.25}
    config = replace(
        WATER2D,
        material="von_mises_plasticine",
        material_parameters=solid | {"yield_stress": 2e4},
        shapes=["box"],
        height_range=[0.3, 0.3],
        slenderness=[0.5, 0.5],
        speed_range=[0.0, 0.0],
        spacing=1.0 / 64.0,
        wall=0.125,
        placement=[[0.5, 0.5], [0.276, 0.276]],
        switch=SwitchChoice(
            frame=40,
            material="drucker_prager_sand",
            material_parameters=solid | {"friction_angle": 20.0},
        ),
    )
    run = simulate(
        draw_scene(config, seed=0), SolverConfig(grid_cells=32, frame_dt=5e-3, frames=91)
    )
    height = run.position[:, :, 1].quantile(0.98, dim=1) - 0.125
    assert float(height[40]) > 0.9 * float(height[0])
    assert float(height[90]) < 0.75 * float(height[0])
    again = replace(config, switch=None)
    kept = simulate(
        draw_scene(again, seed=0), SolverConfig(grid_cells=32, frame_dt=5e-3, frames=91)
    )
    assert torch.equal(kept.position[:41], run.position[:41])
    assert float(kept.position[90, :, 1].quantile(0.98) - 0.125) > 0.9 * float(height[0])


@pytest.mark.parametrize("shape", ["torus", "fish", "box"])
def test_number_of_particles_is_the_one_asked_for(shape: str):
    """Whatever the body's volume, to 3 %; its spacing is kept among the attributes."""
    config = replace(JELLY3D, spacing=None, points=4000, held_out_shapes=["torus", "fish"])
    scene = draw_scene(config, seed=1, shape=shape)
    assert len(scene.position) == pytest.approx(4000, rel=0.03)
    filled = float(scene.volume.double().sum())
    assert scene.attributes["spacing"] ** 3 * 4000 == pytest.approx(filled, rel=0.03)


def test_lying_mesh_is_clamped_over_its_own_height(tmp_path: Path):
    """A rod along axis 0: longest edge = drawn height, one layer or more is held."""
    path = tmp_path / "rod.obj"
    trimesh.creation.box(extents=(8.0, 1.0, 2.0)).export(path)
    scene = draw_scene(ELASTIC3D, seed=0, shape=str(path))
    longest = scene.attributes["shape_extent"][0]
    assert ELASTIC3D.height_range[0] <= longest <= ELASTIC3D.height_range[1]
    assert 0 < int(scene.kinematic.sum()) < len(scene.position)


def test_scene_that_reaches_beyond_a_wall_is_refused():
    """The message says by how much, beyond which wall, and what to change."""
    config = replace(JELLY3D, placement=[[0.1, 0.1], [0.5, 0.5], [0.5, 0.5]])
    with pytest.raises(ValueError, match=r"m beyond the lower wall of axis 0 .*placement"):
        draw_scene(config, seed=0)
    with pytest.raises(ValueError, match="beyond the upper wall of axis 1"):
        draw_scene(replace(ELASTIC3D, height_range=[0.9, 0.9]), seed=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dimension": 4}, "dimension must be 2 or 3"),
        ({"shapes": ["teapot"]}, "no 3-D shape 'teapot'"),
        ({"shapes": []}, "needs at least one"),
        ({"held_out_shapes": ["box"]}, "must not be in shapes too"),
        ({"height_range": [0.3, 0.2]}, "lowest <= highest"),
        ({"spacing": 0.0}, "spacing must be > 0 m"),
        ({"wall": 0.5}, "between 0 and 0.5"),
        ({"base_height": math.nan}, "base_height .* must lie between 0 and 1 m, got nan"),
        ({"base_height": math.inf}, "base_height .* must lie between 0 and 1 m, got inf"),
        ({"clamped_fraction": 1.0}, "between 0 and 1"),
        ({"impulses": ["jump"]}, "bend, sway, twist, axial"),
        ({"placement": [[0.5, math.inf]] * 3}, "placement must be finite with lowest <= highest"),
        ({"placement": [[0.5, 0.4]] * 3}, "placement must be finite with lowest <= highest"),
        ({"placement": [[0.5, 0.5]]}, "each of the 3 axes"),
        ({"spacing": None}, "exactly one of spacing and points"),
        ({"points": 100}, "exactly one of spacing and points"),
        ({"spacing": None, "points": 0}, "points must be >= 1"),
        ({"mixture": [STIFF]}, "a clamped scene has one body of one material"),
        ({"bodies": [1, 2]}, "a clamped scene has one body"),
        ({"bodies": [2, 1]}, "1 <= fewest <= most"),
        ({"family": "thrown", "bodies": [0, 1]}, "1 <= fewest <= most"),
        ({"material": "steel"}, "no material 'steel'"),
    ],
)
def test_impossible_configurations_are_refused(change: dict, message: str):
    """Each message names the field and the rule."""
    with pytest.raises(ValueError, match=message):
        replace(ELASTIC3D, **change)


@pytest.mark.parametrize("particle_type", [KINEMATIC, -1, 9])
def test_type_that_no_material_may_have_is_refused(particle_type: int):
    """Three is for held particles; nine is beyond the embedding."""
    with pytest.raises(ValueError, match="must be 0 to 8 and not 3"):
        replace(STIFF, particle_type=particle_type)


def test_switch_before_the_first_frame_is_refused():
    """Then the body simply is of the other material."""
    with pytest.raises(ValueError, match="must be at least 1"):
        SwitchChoice(frame=0, material="drucker_prager_sand", material_parameters=GRAINS)
