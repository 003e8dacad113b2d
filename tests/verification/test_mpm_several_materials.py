"""Scenes of several materials, the change of a law during a run, and what both refuse."""

import hashlib
import json
from collections.abc import Sequence

import pytest
import torch

from giorom.mpm import (
    DruckerPragerSand,
    FixedCorotated,
    MaterialSwitch,
    Scene,
    SolverConfig,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
    WeaklyCompressibleFluid,
    simulate,
)
from giorom.mpm.boundary import walls_of
from giorom.mpm.device_laws import FAMILIES
from giorom.mpm.engine import Engine
from giorom.mpm.materials import MATERIALS, Material
from giorom.mpm.return_maps import cone_slope
from giorom.mpm.shapes import lattice
from giorom.state import KINEMATIC

MODULI = {"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
RUBBER = StableNeoHookean(**MODULI)
CLAY = VonMisesPlasticine(**MODULI, yield_stress=1e3)
SAND = DruckerPragerSand(**MODULI, friction_angle=25.0)
WATER = WeaklyCompressibleFluid(density=700.0, bulk_modulus=4e4)
LAWS = [
    RUBBER,
    FixedCorotated(**MODULI),
    WATER,
    SAND,
    CLAY,
    ViscoplasticGoop(**MODULI, yield_stress=100.0, viscosity=50.0),
]
CELLS, SPACING, DT = 32, 1.0 / 64.0, 5e-4


def bodies(
    materials: Sequence[Material],
    centers: Sequence[Sequence[float]],
    velocities: Sequence[Sequence[float]],
    *,
    gravity: float = 0.0,
) -> Scene:
    """One small block of each material."""
    d = len(centers[0])
    block = torch.from_numpy(lattice((0.125,) * d, SPACING)).float()
    count = len(block)
    index = torch.arange(len(materials)).repeat_interleave(count)
    types = torch.tensor([material.particle_type for material in materials])
    return Scene(
        position=torch.cat([block + torch.tensor(center) for center in centers]),
        velocity=torch.tensor(velocities).repeat_interleave(count, dim=0),
        affine_velocity=torch.zeros(len(index), d, d),
        volume=torch.full((len(index),), SPACING**d),
        particle_type=types[index],
        materials=tuple(materials),
        material_index=index,
        bounds=torch.tensor([[0.0625, 0.9375]] * d),
        gravity=gravity,
    )


def changed(scene: Scene, **values: object) -> Scene:
    return Scene(**vars(scene) | values)


def subset(scene: Scene, chosen: torch.Tensor) -> Scene:
    """The chosen particles alone, in the order given."""
    fields = (
        "position",
        "velocity",
        "affine_velocity",
        "volume",
        "particle_type",
        "material_index",
    )
    return changed(scene, **{name: getattr(scene, name)[chosen] for name in fields})


def engine_of(scene: Scene) -> Engine:
    return Engine(scene, walls_of(scene, CELLS), substep_dt=DT, device="cpu")


def crash(first: Material, second: Material, dimension: int) -> Scene:
    """Two blocks that meet in the middle after 0.03 s."""
    left, right = [0.4] + [0.5] * (dimension - 1), [0.6] + [0.52] * (dimension - 1)
    speed = [1.5, 0.25, 0.0][:dimension]
    return bodies([first, second], [left, right], [speed, [-each for each in speed]])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("second", LAWS[1:], ids=lambda law: law.name)
def test_colliding_bodies_exchange_momentum_and_lose_none(second: Material, dimension: int):
    """Newton's third law: P_1 changes, P_1 + P_2 does not (1e-5 of the exchanged amount)."""
    scene = crash(RUBBER, second, dimension)
    engine = engine_of(scene)
    first = scene.material_index == 0
    mass, before = scene.mass.double(), engine.velocity().double()
    engine.advance(160)
    after = engine.velocity().double()
    gained = [mass[mask] @ (after - before)[mask] for mask in (first, ~first)]
    assert float(gained[0].norm()) > 0.2 * float(mass[first].sum())
    assert float((gained[0] + gained[1]).norm() / gained[0].norm()) < 1e-5


@pytest.mark.parametrize("dimension", [2, 3])
def test_bodies_far_apart_move_as_if_each_were_alone(dimension: int):
    """No shared node, no interaction: bit for bit the single-material runs."""
    centers = [[0.2, 0.3, 0.5], [0.5, 0.6, 0.5], [0.8, 0.3, 0.5]]
    velocity = [[0.3, -2.0, 0.1], [0.2, -1.0, 0.0], [-0.2, -2.5, 0.2]]
    materials = [SAND, WATER, CLAY]
    scene = bodies(
        materials,
        [each[:dimension] for each in centers],
        [each[:dimension] for each in velocity],
        gravity=9.8,
    )
    together = engine_of(scene)
    together.advance(120)
    for index, material in enumerate(materials):
        own = scene.material_index == index
        single = subset(scene, own)
        single = changed(
            single,
            materials=(material,),
            material_index=torch.zeros_like(single.material_index),
        )
        alone = engine_of(single)
        alone.advance(120)
        assert torch.equal(together.position()[own], alone.position())
        assert torch.equal(together.strain(index), alone.strain())
        assert torch.equal(together.volume_correction(index), alone.volume_correction())


def test_order_of_the_particles_does_not_matter():
    """Materials mixed in the list, held particles among them: same motion to rounding."""
    scene = crash(CLAY, WATER, 2)
    types = torch.where(scene.position[:, 1] < 0.48, KINEMATIC, scene.particle_type)
    scene = changed(scene, particle_type=types, clamp_plane=0.48)
    assert scene.material_index[scene.kinematic].unique().tolist() == [0, 1]
    order = torch.randperm(len(types), generator=torch.Generator().manual_seed(0))
    one, other = engine_of(scene), engine_of(subset(scene, order))
    one.advance(100)
    other.advance(100)
    torch.testing.assert_close(one.position()[order], other.position(), rtol=0.0, atol=5e-6)
    torch.testing.assert_close(one.velocity()[order], other.velocity(), rtol=0.0, atol=2e-3)
    own = scene.material_index[order] == 1
    ranks = torch.argsort(torch.argsort(order[own]))
    torch.testing.assert_close(one.strain(1)[ranks], other.strain(1), rtol=0.0, atol=1e-4)
    held = scene.kinematic
    assert torch.equal(one.position()[held], scene.position[held])


def test_held_particles_of_every_material_stay_where_they_are():
    """Without a clamp plane too: nothing moves or strains them, and the others fly past."""
    scene = crash(CLAY, WATER, 2)
    held = torch.arange(len(scene.position)) % 3 == 1
    types = torch.where(held, KINEMATIC, scene.particle_type)
    engine = engine_of(changed(scene, particle_type=types))
    engine.advance(40)
    assert torch.equal(engine.position()[held], scene.position[held])
    moved = (engine.position() - scene.position)[~held].norm(dim=1)
    assert float(moved.min()) > 0.5 * 40 * DT * 1.5
    volume_ratio = engine.strain(1)
    own = held[scene.material_index == 1]
    assert bool((volume_ratio[own] == 1.0).all())
    assert not bool((volume_ratio[~own] == 1.0).all())


def test_a_body_of_two_equal_materials_is_one_body():
    """The material index is a label: splitting a body by it changes nothing but rounding."""
    whole = bodies([RUBBER], [[0.5, 0.3]], [[0.5, -2.0]], gravity=9.8)
    half = torch.arange(len(whole.position)) % 2
    split = changed(whole, materials=(RUBBER, RUBBER), material_index=half)
    one, other = engine_of(whole), engine_of(split)
    one.advance(200)
    other.advance(200)
    torch.testing.assert_close(one.position(), other.position(), rtol=0.0, atol=5e-6)


def test_same_scene_of_three_materials_gives_the_same_bits():
    """One thread, fixed order: two runs have one SHA-256, and the attributes list the laws."""
    scene = bodies(
        [SAND, WATER, LAWS[5]], [[0.3, 0.4], [0.5, 0.4], [0.7, 0.4]], [[1.0, -1.0]] * 3, gravity=9.8
    )
    solver = SolverConfig(grid_cells=CELLS, frame_dt=5e-3, frames=31)
    runs = [simulate(scene, solver) for _ in range(2)]
    digests = {hashlib.sha256(run.position.numpy().tobytes()).hexdigest() for run in runs}
    assert len(digests) == 1
    kept = json.loads(json.dumps(runs[0].attributes))["materials"]
    assert [each["material"] for each in kept] == [
        "drucker_prager_sand",
        "weakly_compressible_fluid",
        "viscoplastic_goop",
    ]
    assert kept[1]["bulk_modulus"] == WATER.bulk_modulus
    assert runs[0].particle_type.unique().tolist() == [5, 6, 7]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_time_step_guard_names_the_stiffest_law_of_the_scene(law: Material):
    """A wave number of 1.5 is refused before the run, whichever material is too stiff."""
    soft = StableNeoHookean(density=1000.0, youngs_modulus=1e3, poissons_ratio=0.3)
    scene = bodies([soft, law], [[0.3, 0.4], [0.7, 0.4]], [[0.0, 0.0]] * 2)
    solver = SolverConfig(
        grid_cells=CELLS, frame_dt=1.5 / CELLS / law.sound_speed, frames=2, substeps=1
    )
    with pytest.raises(ValueError, match=rf"{law.name} .*Set SolverConfig.substeps"):
        simulate(scene, solver)


def melting(frame: int = 8) -> Scene:
    """A clay block that falls onto the floor and turns to sand while it lies there."""
    scene = bodies([CLAY, RUBBER], [[0.35, 0.14], [0.7, 0.14]], [[0.0, -2.0]] * 2, gravity=9.8)
    switch = MaterialSwitch(frame=frame, material_index=0, material=SAND)
    return changed(scene, switch=switch)


def test_melting_clay_is_clay_until_the_switch_and_sand_after_it():
    """Frames up to the switch are those of clay; afterwards clay and sand part."""
    scene = melting()
    solver = SolverConfig(grid_cells=CELLS, frame_dt=5e-3, frames=25)
    melts = simulate(scene, solver)
    stays = simulate(changed(scene, switch=None), solver)
    assert torch.equal(melts.position[:9], stays.position[:9])
    clay = scene.material_index == 0
    assert not torch.equal(melts.position[9, clay], stays.position[9, clay])
    width = [float(run.position[-1, clay, 0].std()) for run in (melts, stays)]
    assert width[0] > 1.02 * width[1]
    kept = json.loads(json.dumps(melts.attributes))["material_switch"]
    assert (kept["frame"], kept["material"]) == (8, "drucker_prager_sand")


def beyond_the_cone(b: torch.Tensor) -> torch.Tensor:
    """|dev tau| + alpha tr tau of every particle [Pa]; positive is outside the yield surface."""
    stress = SAND.kirchhoff_stress(b.double())
    trace = stress.diagonal(dim1=1, dim2=2).sum(1)
    deviator = stress - 0.5 * trace[:, None, None] * torch.eye(2, dtype=torch.float64)
    return deviator.flatten(1).norm(dim=1) + cone_slope(25.0, dimension=2) * trace


def test_melted_state_obeys_the_yield_surface_of_sand_at_once():
    """Clay bears tension and sand does not: the switch projects the strain that clay left."""
    scene = melting()
    engine = engine_of(scene)
    engine.advance(80)
    rubber, place = engine.strain(1), engine.position()
    assert float(beyond_the_cone(engine.strain()).max()) > 100.0
    engine.switch(0, SAND)
    tolerance = 1e-6 * SAND.youngs_modulus
    assert float(beyond_the_cone(engine.strain()).max()) < tolerance
    assert torch.equal(engine.strain(1), rubber)
    assert torch.equal(engine.position(), place)
    engine.advance(80)
    assert float(beyond_the_cone(engine.strain()).max()) < tolerance


@pytest.mark.parametrize("frame", [15, 16, 40])
def test_switch_that_no_frame_of_the_run_would_show_is_refused(frame: int):
    """The law changes after frame s, so that a run of n frames shows it if s <= n - 2."""
    solver = SolverConfig(grid_cells=CELLS, frame_dt=5e-3, frames=16)
    with pytest.raises(
        ValueError,
        match=rf"frame is {frame}, but the run has 16 .*--solver.frames\) to {frame + 2}",
    ) as caught:
        simulate(melting(frame), solver)
    assert "\n" not in str(caught.value)
    last = simulate(melting(14), solver).position
    assert not torch.equal(
        last[15], simulate(changed(melting(14), switch=None), solver).position[15]
    )


def test_switch_to_the_same_law_changes_no_bit():
    """A change to what it is: strain and stress are carried over."""
    scene = bodies([RUBBER], [[0.5, 0.14]], [[0.3, -2.0]], gravity=9.8)
    same = changed(scene, switch=MaterialSwitch(frame=5, material_index=0, material=RUBBER))
    solver = SolverConfig(grid_cells=CELLS, frame_dt=5e-3, frames=16)
    assert torch.equal(simulate(scene, solver).position, simulate(same, solver).position)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"materials": ()}, "materials is empty"),
        ({"material_index": torch.full((64,), 2)}, "particle 0 has material_index 2"),
        ({"switch": (5, 0, WATER)}, "carries the strain b .* carries J"),
        ({"switch": (5, 1, SAND)}, "from 0 to 0"),
        ({"switch": (0, 0, SAND)}, "frame must be at least 1"),
        (
            {"switch": (5, 0, StableNeoHookean(**MODULI | {"density": 1.0}))},
            "mass is conserved",
        ),
    ],
)
def test_impossible_scenes_are_refused(values: dict, message: str):
    """Each message names the rule."""
    scene = bodies([CLAY], [[0.5, 0.5]], [[0.0, 0.0]])
    if "switch" in values:
        frame, index, material = values["switch"]
        values = {"switch": MaterialSwitch(frame=frame, material_index=index, material=material)}
    with pytest.raises(ValueError, match=message):
        changed(scene, **values)


def test_law_without_a_kernel_is_refused_by_name():
    """A law may exist as a reference alone; a run of it must say so."""

    class Jelly(FixedCorotated):
        name = "house_made_jelly"

    scene = bodies([Jelly(**MODULI)], [[0.5, 0.5]], [[0.0, 0.0]])
    solver = SolverConfig(grid_cells=CELLS, frame_dt=5e-3, frames=2)
    with pytest.raises(ValueError, match=r"no kernel for the material 'house_made_jelly'"):
        simulate(scene, solver)


def test_every_material_of_the_registry_has_a_kernel():
    """What YAML can name can be simulated."""
    assert set(FAMILIES) == set(MATERIALS)
