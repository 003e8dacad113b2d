"""The learned law against elasticity, plasticity and objectivity."""

import math
from dataclasses import replace

import pytest
import torch

from giorom.layers.learned_law import (
    START,
    LearnedLaw,
    determinant,
    deviator,
    with_unit_determinant,
)
from giorom.state import ELASTIC, GOOP, PLASTICINE, RIGID, SAND, WATER

DT = 1e-3
DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])


def law_in_double(dimension):
    return LearnedLaw(dimension).double().requires_grad_(False)


def types(kind, count=1):
    return torch.full((count,), kind)


def rest(law, kind, count=1):
    strain = law.rest(types(kind, count))
    return replace(
        strain,
        isochoric=strain.isochoric.double(),
        volume_ratio=strain.volume_ratio.double(),
    )


def pure_shear(dimension, rate):
    gradient = torch.zeros(1, dimension, dimension, dtype=torch.float64)
    gradient[0, 0, 0], gradient[0, 1, 1] = rate, -rate
    return gradient


@DIMENSIONS
@pytest.mark.parametrize("kind", [RIGID, PLASTICINE, WATER, SAND, GOOP, ELASTIC])
def test_the_undeformed_state_bears_nothing(dimension, kind):
    law = law_in_double(dimension)
    assert float(law.stress(rest(law, kind), types(kind)).abs().max()) == 0.0


@DIMENSIONS
def test_small_strains_give_hookes_law(dimension):
    """Tau = 2 G dev(e) + K tr(e) I for a symmetric strain e of 1e-6."""
    law = law_in_double(dimension)
    generator = torch.Generator().manual_seed(0)
    strain = torch.randn(1, dimension, dimension, generator=generator, dtype=torch.float64)
    strain = 1e-6 * (strain + strain.mT)
    found = law.flow(rest(law, ELASTIC), strain, types(ELASTIC), dt=1.0)
    trace = strain.diagonal(dim1=1, dim2=2).sum()
    wanted = 2.0 * START["shear"] * deviator(strain)
    wanted += START["bulk"] * trace * torch.eye(dimension, dtype=torch.float64)
    torch.testing.assert_close(law.stress(found, types(ELASTIC)), wanted, atol=1e-9, rtol=1e-4)


@DIMENSIONS
@pytest.mark.parametrize("kind", [PLASTICINE, SAND, GOOP, ELASTIC])
def test_a_turn_turns_the_stress_and_nothing_else(dimension, kind):
    """A strained sample that is turned by R bears R tau R^T (objectivity)."""
    law = law_in_double(dimension)
    squeeze = -20.0 * torch.eye(dimension, dtype=torch.float64)[None]
    before = law.flow(rest(law, kind), squeeze + pure_shear(dimension, 10.0), types(kind), dt=DT)
    turn = torch.eye(dimension, dtype=torch.float64)[None].clone()
    c, s = math.cos(0.7), math.sin(0.7)
    turn[0, :2, :2] = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    spin = (turn - torch.eye(dimension, dtype=torch.float64)) / DT
    after = law.flow(before, spin, types(kind), dt=DT)
    stress = law.stress(before, types(kind))
    if kind == GOOP:  # goop goes on relaxing while it turns
        after = replace(after, isochoric=turn @ before.isochoric @ turn.mT)
    torch.testing.assert_close(law.stress(after, types(kind)), turn @ stress @ turn.mT)


@DIMENSIONS
def test_the_isochoric_tensor_keeps_its_determinant(dimension):
    generator = torch.Generator().manual_seed(1)
    tensor = torch.randn(500, dimension, dimension, generator=generator, dtype=torch.float64)
    deviation = deviator(tensor + tensor.mT)
    length = torch.linspace(0.0, 1.5, 500, dtype=torch.float64)[:, None, None]
    deviation *= length / deviation.square().sum(dim=(1, 2), keepdim=True).sqrt()
    found = with_unit_determinant(deviation)
    one = torch.ones(500, dtype=torch.float64)
    torch.testing.assert_close(determinant(found), one, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(determinant(tensor), torch.linalg.det(tensor))


@DIMENSIONS
def test_a_liquid_bears_no_shear(dimension):
    law = law_in_double(dimension)
    gradient = pure_shear(dimension, 30.0) - 5.0 * torch.eye(dimension, dtype=torch.float64)
    found = law.stress(law.flow(rest(law, WATER), gradient, types(WATER), dt=DT), types(WATER))
    assert float(deviator(found).abs().max()) < 1e-9
    assert float(found[0, 0, 0]) < 0.0  # pressed: it pushes back


@DIMENSIONS
def test_plasticine_bears_its_strength_and_no_more(dimension):
    law, strain = law_in_double(dimension), None
    strain = rest(law, PLASTICINE)
    for _ in range(20):
        strain = law.flow(strain, pure_shear(dimension, 20.0), types(PLASTICINE), dt=DT)
    found = deviator(law.stress(strain, types(PLASTICINE))).square().sum().sqrt()
    assert float(found) == pytest.approx(START["strength"], rel=1e-6)


@DIMENSIONS
def test_sand_bears_a_share_of_its_pressure(dimension):
    law = law_in_double(dimension)
    identity = torch.eye(dimension, dtype=torch.float64)
    strain = law.flow(rest(law, SAND), -10.0 * identity[None], types(SAND), dt=DT)
    for _ in range(100):
        strain = law.flow(strain, pure_shear(dimension, 20.0), types(SAND), dt=DT)
    stress = law.stress(strain, types(SAND))
    pressure = -stress.diagonal(dim1=1, dim2=2).mean()
    shear = deviator(stress).square().sum().sqrt()
    assert float(shear) == pytest.approx(START["friction"] * float(pressure), rel=1e-6)
    assert float(pressure) > 0.0


@DIMENSIONS
def test_sand_that_came_apart_resists_only_from_its_old_volume_on(dimension):
    """No tension while it expands; pressed back it bears nothing, pressed further it does."""
    law = law_in_double(dimension)
    apart = 50.0 * torch.eye(dimension, dtype=torch.float64)[None]
    back = -apart / (1.0 + 50.0 * DT)
    strain, found = rest(law, SAND), []
    for gradient in (apart, back, -apart):
        strain = law.flow(strain, gradient, types(SAND), dt=DT)
        found.append(float(law.stress(strain, types(SAND))[0, 0, 0]))
    assert found[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert found[2] < -1.0


def test_goop_relaxes_at_its_own_pace():
    """The excess over the strength falls as exp(-t / T) (Perzyna)."""
    law = law_in_double(2)
    strain = replace(
        rest(law, GOOP),
        isochoric=with_unit_determinant(deviator(pure_shear(2, 0.2))),
    )
    still = torch.zeros(1, 2, 2, dtype=torch.float64)
    excess = []
    for _ in range(3):
        stress = deviator(law.stress(strain, types(GOOP))).square().sum().sqrt()
        excess.append(float(stress) - START["strength"])
        strain = law.flow(strain, still, types(GOOP), dt=DT)
    decay = math.exp(-DT / START["relaxation"])
    assert excess[0] > 1.0
    assert excess[1] / excess[0] == pytest.approx(decay, rel=1e-6)
    assert excess[2] / excess[1] == pytest.approx(decay, rel=1e-6)


@DIMENSIONS
def test_a_solid_never_yields(dimension):
    """Sheared far and back again, it is where it was."""
    law = law_in_double(dimension)
    there = pure_shear(dimension, 100.0)
    back = torch.linalg.inv(torch.eye(dimension, dtype=torch.float64) + DT * there)
    back = (back - torch.eye(dimension, dtype=torch.float64)) / DT
    strain = law.flow(rest(law, ELASTIC), there, types(ELASTIC), dt=DT)
    assert float(law.stress(strain, types(ELASTIC)).abs().max()) > START["strength"]
    strain = law.flow(strain, back, types(ELASTIC), dt=DT)
    assert float(law.stress(strain, types(ELASTIC)).abs().max()) < 1e-5


@pytest.mark.parametrize(
    ("exponent", "law_of_ratio"),
    [(1e-4, torch.log), (1.0, lambda j: j - 1.0), (2.0, lambda j: 0.5 * (j**2 - 1.0))],
)
def test_the_exponent_chooses_how_the_bulk_stiffens(exponent, law_of_ratio):
    law = law_in_double(2)
    law.log_exponent.fill_(math.log(exponent))
    ratio = torch.linspace(0.6, 1.2, 7, dtype=torch.float64)
    strain = replace(rest(law, WATER, 7), volume_ratio=ratio)
    found = law.stress(strain, types(WATER, 7))[:, 0, 0]
    torch.testing.assert_close(found, START["bulk"] * law_of_ratio(ratio), atol=5e-3, rtol=0.0)


@pytest.mark.parametrize("kind", [RIGID, PLASTICINE, WATER, SAND, GOOP, ELASTIC])
def test_a_constant_is_used_where_changing_it_changes_the_stress(kind):
    """Each is raised by a tenth, under a strain below and one above what the material bears."""
    changed = set()
    squeeze = -40.0 * torch.eye(2, dtype=torch.float64)[None]

    def stress(law):
        strains = [rest(law, kind)]
        for rate in (1.0, 60.0, 60.0):
            gradient = squeeze + pure_shear(2, rate)
            strains.append(law.flow(strains[-1], gradient, types(kind), dt=DT))
        return torch.cat([law.stress(strain, types(kind)) for strain in strains])

    for name in START:
        law = law_in_double(2)
        law.get_parameter(f"log_{name}")[kind] += 0.1
        if not torch.allclose(stress(law), stress(law_in_double(2)), rtol=1e-9, atol=1e-9):
            changed.add(f"log_{name}")
    used = law_in_double(2).used(types(kind, 3))
    assert {name for name, mask in used.items() if mask.any()} == changed
    assert all(mask.nonzero().flatten().tolist() in ([], [kind]) for mask in used.values())
