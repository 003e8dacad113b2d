"""The constitutive laws against their energies and against linear elasticity."""

import json
import math
from dataclasses import asdict, replace

import pytest
import torch

from giorom.mpm import draw_scene
from giorom.mpm.materials import (
    MATERIALS,
    DruckerPragerSand,
    FixedCorotated,
    Material,
    Solid,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
    WeaklyCompressibleFluid,
    make_material,
    material_attributes,
)
from giorom.mpm.scene_config import JELLY3D, SceneConfig
from giorom.records import parse_record

MODULI = {"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
RUBBER = StableNeoHookean(**MODULI)
SOLIDS: list[Solid] = [
    RUBBER,
    FixedCorotated(**MODULI),
    DruckerPragerSand(**MODULI, friction_angle=25.0),
    VonMisesPlasticine(**MODULI, yield_stress=5e3),
    ViscoplasticGoop(**MODULI, yield_stress=100.0, viscosity=50.0),
]
every_solid = pytest.mark.parametrize("solid", SOLIDS, ids=lambda law: law.name)
both_dimensions = pytest.mark.parametrize("dimension", [2, 3])


def random_deformation(dimension: int, seed: int) -> torch.Tensor:
    """A deformation gradient of some 20 % strain, float64."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(dimension, dimension, generator=generator, dtype=torch.float64)
    return torch.eye(dimension, dtype=torch.float64) + 0.15 * noise


def rotation(dimension: int, seed: int) -> torch.Tensor:
    orthogonal = torch.linalg.qr(random_deformation(dimension, seed)).Q
    orthogonal[:, 0] *= torch.linalg.det(orthogonal)
    return orthogonal


@both_dimensions
@pytest.mark.parametrize("poissons_ratio", [0.0, 0.2, 0.45])
@every_solid
def test_rest_state_is_stress_free(solid: Solid, dimension: int, poissons_ratio: float):
    """Of every law tau(I) = 0 (for the stable one Smith et al. 2018 chose a so)."""
    material = replace(solid, youngs_modulus=1.0, poissons_ratio=poissons_ratio)
    stress = material.kirchhoff_stress(torch.eye(dimension, dtype=torch.float64))
    torch.testing.assert_close(stress, torch.zeros_like(stress), rtol=0.0, atol=1e-14)


@both_dimensions
@every_solid
def test_solid_stress_is_the_derivative_of_its_energy(solid: Solid, dimension: int):
    """The rule tau = (dPsi/dF) F^T, the derivative by automatic differentiation of the energy."""
    gradient = random_deformation(dimension, 3).requires_grad_()
    (first_piola,) = torch.autograd.grad(solid.energy(gradient @ gradient.T), gradient)
    expected = (first_piola @ gradient.T).detach()
    stress = solid.kirchhoff_stress((gradient @ gradient.T).detach())
    torch.testing.assert_close(stress, expected, rtol=1e-10, atol=1e-7)


@both_dimensions
@every_solid
def test_solid_stress_matches_finite_differences_of_its_energy(solid: Solid, dimension: int):
    """tau_ij = dPsi/dF_ik F_jk with central differences of step 1e-5."""
    gradient, step = random_deformation(dimension, 5), 1e-5
    first_piola = torch.zeros(dimension, dimension, dtype=torch.float64)
    for i in range(dimension):
        for k in range(dimension):
            delta = torch.zeros(dimension, dimension, dtype=torch.float64)
            delta[i, k] = step
            high, low = gradient + delta, gradient - delta
            change = solid.energy(high @ high.T) - solid.energy(low @ low.T)
            first_piola[i, k] = change / (2.0 * step)
    stress = solid.kirchhoff_stress(gradient @ gradient.T)
    torch.testing.assert_close(stress, first_piola @ gradient.T, rtol=1e-6, atol=1e-1)


def test_fluid_stress_is_the_derivative_of_its_energy():
    """The rule tau = J dPsi/dJ for an energy of J alone."""
    fluid = WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e5)
    ratio = torch.linspace(0.7, 1.3, 7, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(fluid.energy(ratio).sum(), ratio)
    expected = (slope * ratio).detach()
    torch.testing.assert_close(fluid.kirchhoff_stress(ratio.detach()), expected)


@both_dimensions
@every_solid
def test_stress_is_objective_and_symmetric(solid: Solid, dimension: int):
    """tau(Q b Q^T) = Q tau(b) Q^T for every rotation Q; tau = tau^T."""
    gradient, turn = random_deformation(dimension, 1), rotation(dimension, 2)
    b = gradient @ gradient.T
    stress = solid.kirchhoff_stress(b)
    turned = solid.kirchhoff_stress(turn @ b @ turn.T)
    torch.testing.assert_close(turned, turn @ stress @ turn.T, rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(stress, stress.T, rtol=1e-12, atol=1e-9)


@both_dimensions
@every_solid
def test_return_map_is_objective(solid: Solid, dimension: int):
    """What is kept of Q b Q^T is what is kept of b, turned: no law has a preferred axis."""
    gradient, turn = random_deformation(dimension, 6), rotation(dimension, 2)
    gradient = gradient / torch.linalg.det(gradient) ** (1.0 / dimension) * 0.97
    b, nothing = gradient @ gradient.T, torch.zeros((), dtype=torch.float64)
    kept, volume = solid.return_map(b, nothing, substep_dt=1e-3)
    turned, same = solid.return_map(turn @ b @ turn.T, nothing, substep_dt=1e-3)
    torch.testing.assert_close(turned, turn @ kept @ turn.T, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(volume, same, rtol=0.0, atol=1e-12)


@every_solid
def test_small_uniaxial_strain_measures_youngs_modulus_and_poissons_ratio(solid: Solid):
    """Bar with free sides: sigma = E e along it, contracting by nu e across it."""
    strain, nu = 1e-6, solid.poissons_ratio
    stretch = 1.0 + strain * torch.tensor([1.0, -nu, -nu], dtype=torch.float64)
    stress = solid.kirchhoff_stress(torch.diag(stretch**2))
    expected = torch.diag(torch.tensor([solid.youngs_modulus * strain, 0.0, 0.0]).double())
    torch.testing.assert_close(stress, expected, rtol=1e-5, atol=1e-5 * 1e5 * strain)


@every_solid
def test_plane_strain_is_the_body_with_unit_third_stretch(solid: Solid):
    """The 2-D stress equals the in-plane part of the 3-D stress at F_zz = 1."""
    gradient = random_deformation(2, 4)
    body = torch.eye(3, dtype=torch.float64)
    body[:2, :2] = gradient
    in_plane = solid.kirchhoff_stress(body @ body.T)[:2, :2]
    plane = solid.kirchhoff_stress(gradient @ gradient.T)
    torch.testing.assert_close(plane, in_plane, rtol=1e-12, atol=1e-9)


def test_sound_speeds_are_those_of_linear_acoustics():
    """Linear acoustics: c = sqrt((lambda + 2 mu) / rho) for E 1e5, nu .2, and sqrt(K / rho)."""
    jelly = StableNeoHookean(density=1000.0, youngs_modulus=1e5, poissons_ratio=0.2)
    assert math.isclose(jelly.sound_speed, math.sqrt(1e5 * 0.8 / (1.2 * 0.6) / 1000.0))
    water = WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e5)
    assert math.isclose(water.sound_speed, 20.0)


@pytest.mark.parametrize(
    "material",
    [*SOLIDS, WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e5)],
    ids=lambda law: law.name,
)
def test_material_attributes_rebuild_the_material(material: Material):
    """make_material inverts material_attributes."""
    attributes = json.loads(json.dumps(material_attributes(material)))
    assert make_material(attributes.pop("material"), attributes) == material


def test_every_material_has_its_own_name_and_a_particle_type():
    """The GNS ids of water, sand and goop, 4 for plasticine, 8 for elastic bodies."""
    types = {name: law.particle_type for name, law in MATERIALS.items()}
    assert types == {
        "stable_neo_hookean": 8,
        "fixed_corotated": 8,
        "weakly_compressible_fluid": 5,
        "drucker_prager_sand": 6,
        "von_mises_plasticine": 4,
        "viscoplastic_goop": 7,
    }


def test_parameters_with_a_default_may_be_left_out():
    """Dry sand that keeps its volume, unless said otherwise; whole numbers and 0 / 1 are fine."""
    sand = make_material("drucker_prager_sand", MODULI | {"friction_angle": 25})
    assert sand == DruckerPragerSand(**MODULI, friction_angle=25.0)
    assert sand.volume_correction is True
    bouncing = make_material(
        "drucker_prager_sand", MODULI | {"friction_angle": 25.0, "volume_correction": 0.0}
    )
    assert bouncing.volume_correction is False


def test_scene_configuration_passes_truth_values_to_the_material():
    """YAML's true and false reach the law as such; numbers stay numbers."""
    values = asdict(JELLY3D) | {
        "material": "drucker_prager_sand",
        "material_parameters": MODULI | {"friction_angle": 25, "volume_correction": False},
    }
    config = parse_record(SceneConfig, values, where="test")
    sand = draw_scene(config, seed=0).materials[0]
    assert sand == DruckerPragerSand(**MODULI, friction_angle=25.0, volume_correction=False)


SAND = MODULI | {"friction_angle": 25.0}


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("stable_neo_hookean", MODULI | {"density": -1.0}, "density must be > 0"),
        ("fixed_corotated", MODULI | {"poissons_ratio": 0.5}, "between -1 and 0.5"),
        ("fixed_corotated", MODULI | {"youngs_modulus": math.nan}, "youngs_modulus must be > 0"),
        ("stable_neo_hookean", {"density": 1.0, "youngs_modulus": 1.0}, "lacks .* poissons_ratio"),
        ("stable_neo_hookean", MODULI | {"colour": 1.0}, "has no parameter 'colour'"),
        ("stable_neo_hookean", MODULI | {"density": True}, "density must be a number"),
        ("drucker_prager_sand", SAND | {"friction_angle": 90.0}, "between 0 and 90 degrees"),
        ("drucker_prager_sand", SAND | {"cohesion_strain": -0.1}, "cohesion_strain must be >= 0"),
        ("drucker_prager_sand", SAND | {"volume_correction": 0.5}, "must be true or false"),
        ("von_mises_plasticine", MODULI | {"yield_stress": 0.0}, "yield_stress must be > 0 Pa"),
        (
            "viscoplastic_goop",
            MODULI | {"yield_stress": 1.0, "viscosity": -1.0},
            "viscosity must be >= 0 Pa s",
        ),
    ],
)
def test_impossible_materials_are_refused(name: str, parameters: dict[str, float], message: str):
    """Each message names the rule."""
    with pytest.raises(ValueError, match=message):
        make_material(name, parameters)


def test_unknown_material_names_the_known_ones():
    """The message lists the registry."""
    with pytest.raises(ValueError, match="stable_neo_hookean"):
        make_material("steel", {})
