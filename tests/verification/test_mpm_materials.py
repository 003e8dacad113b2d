"""The constitutive laws against their energies and against linear elasticity."""

import math

import pytest
import torch

from giorom.mpm.materials import (
    StableNeoHookean,
    WeaklyCompressibleFluid,
    make_material,
    material_attributes,
)

RUBBER = StableNeoHookean(density=1000.0, youngs_modulus=1e5, poissons_ratio=0.3)


def random_deformation(dimension: int, seed: int) -> torch.Tensor:
    """A deformation gradient of some 20 % strain, float64."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(dimension, dimension, generator=generator, dtype=torch.float64)
    return torch.eye(dimension, dtype=torch.float64) + 0.15 * noise


def rotation(dimension: int, seed: int) -> torch.Tensor:
    orthogonal = torch.linalg.qr(random_deformation(dimension, seed)).Q
    orthogonal[:, 0] *= torch.linalg.det(orthogonal)
    return orthogonal


def young(b: torch.Tensor) -> torch.Tensor:
    return RUBBER.kirchhoff_stress(b)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("poissons_ratio", [0.0, 0.2, 0.45])
def test_rest_state_is_stress_free(dimension: int, poissons_ratio: float):
    """The constant a of Smith et al. 2018 is chosen so that tau(I) = 0."""
    material = StableNeoHookean(density=1.0, youngs_modulus=1.0, poissons_ratio=poissons_ratio)
    stress = material.kirchhoff_stress(torch.eye(dimension, dtype=torch.float64))
    torch.testing.assert_close(stress, torch.zeros_like(stress), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("dimension", [2, 3])
def test_solid_stress_is_the_derivative_of_its_energy(dimension: int):
    """The rule tau = (dPsi/dF) F^T, the derivative by automatic differentiation of the energy."""
    gradient = random_deformation(dimension, 3).requires_grad_()
    (first_piola,) = torch.autograd.grad(RUBBER.energy(gradient @ gradient.T), gradient)
    expected = (first_piola @ gradient.T).detach()
    stress = young((gradient @ gradient.T).detach())
    torch.testing.assert_close(stress, expected, rtol=1e-12, atol=1e-7)


def test_solid_stress_matches_finite_differences_of_its_energy():
    """tau_ij = dPsi/dF_ik F_jk with central differences of step 1e-5."""
    gradient, step = random_deformation(3, 5), 1e-5
    first_piola = torch.zeros(3, 3, dtype=torch.float64)
    for i in range(3):
        for k in range(3):
            delta = torch.zeros(3, 3, dtype=torch.float64)
            delta[i, k] = step
            high, low = gradient + delta, gradient - delta
            change = RUBBER.energy(high @ high.T) - RUBBER.energy(low @ low.T)
            first_piola[i, k] = change / (2.0 * step)
    stress = young(gradient @ gradient.T)
    torch.testing.assert_close(stress, first_piola @ gradient.T, rtol=1e-6, atol=1e-1)


def test_fluid_stress_is_the_derivative_of_its_energy():
    """The rule tau = J dPsi/dJ for an energy of J alone."""
    fluid = WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e5)
    ratio = torch.linspace(0.7, 1.3, 7, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(fluid.energy(ratio).sum(), ratio)
    expected = (slope * ratio).detach()
    torch.testing.assert_close(fluid.kirchhoff_stress(ratio.detach()), expected)


@pytest.mark.parametrize("dimension", [2, 3])
def test_stress_is_objective_and_symmetric(dimension: int):
    """tau(Q b Q^T) = Q tau(b) Q^T for every rotation Q; tau = tau^T."""
    gradient, turn = random_deformation(dimension, 1), rotation(dimension, 2)
    b = gradient @ gradient.T
    turned = young(turn @ b @ turn.T)
    torch.testing.assert_close(turned, turn @ young(b) @ turn.T, rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(young(b), young(b).T, rtol=1e-12, atol=1e-9)


def test_small_uniaxial_strain_measures_youngs_modulus_and_poissons_ratio():
    """Bar with free sides: sigma = E e along it, contracting by nu e across it."""
    strain, nu = 1e-6, RUBBER.poissons_ratio
    stretch = 1.0 + strain * torch.tensor([1.0, -nu, -nu], dtype=torch.float64)
    stress = young(torch.diag(stretch**2))
    expected = torch.diag(torch.tensor([RUBBER.youngs_modulus * strain, 0.0, 0.0]).double())
    torch.testing.assert_close(stress, expected, rtol=1e-5, atol=1e-5 * 1e5 * strain)


def test_plane_strain_is_the_body_with_unit_third_stretch():
    """The 2-D stress equals the in-plane part of the 3-D stress at F_zz = 1."""
    gradient = random_deformation(2, 4)
    solid = torch.eye(3, dtype=torch.float64)
    solid[:2, :2] = gradient
    in_plane = young(solid @ solid.T)[:2, :2]
    torch.testing.assert_close(young(gradient @ gradient.T), in_plane, rtol=1e-12, atol=1e-9)


def test_sound_speeds_are_those_of_linear_acoustics():
    """Linear acoustics: c = sqrt((lambda + 2 mu) / rho) for E 1e5, nu .2, and sqrt(K / rho)."""
    jelly = StableNeoHookean(density=1000.0, youngs_modulus=1e5, poissons_ratio=0.2)
    assert math.isclose(jelly.sound_speed, math.sqrt(1e5 * 0.8 / (1.2 * 0.6) / 1000.0))
    water = WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e5)
    assert math.isclose(water.sound_speed, 20.0)


def test_material_attributes_rebuild_the_material():
    """make_material inverts material_attributes."""
    attributes = material_attributes(RUBBER)
    name = attributes.pop("material")
    assert make_material(str(name), attributes) == RUBBER


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"density": -1.0, "youngs_modulus": 1e5, "poissons_ratio": 0.2}, "density must be > 0"),
        ({"density": 1.0, "youngs_modulus": 1e5, "poissons_ratio": 0.5}, "between -1 and 0.5"),
        ({"density": 1.0, "youngs_modulus": 1e5}, "lacks the parameters poissons_ratio"),
    ],
)
def test_impossible_materials_are_refused(parameters: dict[str, float], message: str):
    """Each message names the rule."""
    with pytest.raises(ValueError, match=message):
        make_material("stable_neo_hookean", parameters)


def test_unknown_material_names_the_known_ones():
    """The message lists the registry."""
    with pytest.raises(ValueError, match="stable_neo_hookean"):
        make_material("steel", {})
