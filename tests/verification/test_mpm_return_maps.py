"""The return maps: on their yield surface, idempotent, and equal to their closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from giorom.mpm import DruckerPragerSand, ViscoplasticGoop, VonMisesPlasticine
from giorom.mpm.materials import Solid
from giorom.mpm.return_maps import (
    cone_slope,
    from_principal_strains,
    principal_stretches,
    sand_map,
    viscoplastic_map,
)

MODULI = {"density": 1000.0, "youngs_modulus": 3e5, "poissons_ratio": 0.25}
CLAY = VonMisesPlasticine(**MODULI, yield_stress=5e3)
GOOP = ViscoplasticGoop(**MODULI, yield_stress=5e3, viscosity=200.0)
SAND = DruckerPragerSand(**MODULI, friction_angle=25.0)
DT = 1e-3

strain_vectors = st.integers(2, 3).flatmap(
    lambda d: st.lists(st.floats(-0.6, 0.6), min_size=d, max_size=d)
)
gains = st.floats(0.0, 0.3)
some = settings(max_examples=60, deadline=None, derandomize=True)


def tensor(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def dev(strain: torch.Tensor) -> torch.Tensor:
    return strain - strain.mean(-1, keepdim=True)


def turned(strain: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """``b`` of principal strains, on random axes."""
    d = strain.shape[-1]
    noise = torch.randn(d, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return from_principal_strains(strain, torch.linalg.qr(noise).Q)


def strains_of(b: torch.Tensor) -> torch.Tensor:
    return principal_stretches(b)[0].log()


def mapped(law: Solid, b: torch.Tensor, volume: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    return law.return_map(b, tensor([volume]).squeeze(0), substep_dt=DT)


def deviatoric_stress(law: Solid, b: torch.Tensor) -> float:
    stress = law.kirchhoff_stress(b)
    mean = stress.diagonal().mean() * torch.eye(len(b), dtype=b.dtype)
    return float((stress - mean).norm())


@some
@given(strain_vectors)
def test_plasticine_ends_on_or_inside_its_yield_surface_and_keeps_its_volume(values: list[float]):
    """|dev tau| <= sigma_y, det b unchanged, and a second application changes nothing."""
    trial = turned(tensor(values))
    kept, _ = mapped(CLAY, trial)
    assert deviatoric_stress(CLAY, kept) <= CLAY.yield_stress * (1.0 + 1e-9)
    torch.testing.assert_close(torch.linalg.det(kept), torch.linalg.det(trial), rtol=1e-9, atol=0)
    torch.testing.assert_close(mapped(CLAY, kept)[0], kept, rtol=1e-9, atol=1e-12)
    if float(dev(tensor(values)).norm()) < CLAY.yield_strain * (1.0 - 1e-9):
        assert torch.equal(kept, trial)


@some
@given(strain_vectors)
def test_plasticine_flows_along_the_deviator(values: list[float]):
    """Closest-point projection: dev e' is dev e, shortened to the yield strain."""
    strain = tensor(values)
    kept = viscoplastic_map(
        strain, yield_strain=CLAY.yield_strain, relaxation_time=0.0, substep_dt=DT
    )
    length = float(dev(strain).norm())
    scale = min(1.0, CLAY.yield_strain / length) if length > 0.0 else 1.0
    torch.testing.assert_close(dev(kept), scale * dev(strain), rtol=1e-9, atol=1e-15)


@some
@given(strain_vectors, gains)
def test_sand_ends_on_or_inside_its_cone_and_twice_is_once(values: list[float], gain: float):
    """|dev tau| + alpha tr tau <= 0 after the map, and the mapped state is a fixed point."""
    trial, d = turned(tensor(values)), len(values)
    kept, volume = mapped(SAND, trial, gain)
    stress = SAND.kirchhoff_stress(kept)
    alpha = cone_slope(SAND.friction_angle, dimension=d)
    beyond = deviatoric_stress(SAND, kept) + alpha * float(stress.trace())
    assert beyond <= 1e-9 * SAND.youngs_modulus
    again, same = SAND.return_map(kept, volume, substep_dt=DT)
    torch.testing.assert_close(again, kept, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(same, volume, rtol=0.0, atol=1e-12)


@some
@given(strain_vectors, gains, st.sampled_from([0.0, 0.01]))
def test_sand_keeps_the_sum_of_strain_trace_and_volume_correction(
    values: list[float], gain: float, cohesion: float
):
    """Bookkeeping: v + tr e is the logarithm of the true volume, which no projection changes."""
    strain, volume = tensor(values), tensor([gain]).squeeze(0)
    kept, after = sand_map(strain, volume, slope=0.4, cohesion_strain=cohesion)
    torch.testing.assert_close(kept.sum() + after, strain.sum() + volume, rtol=1e-12, atol=1e-12)
    assert float(after) >= -1e-12


@some
@given(strain_vectors)
def test_sand_pulled_apart_goes_to_the_tip_and_sand_inside_stays(values: list[float]):
    """The three cases of Klár et al. 2016: tip, inside, cone with the trace kept."""
    strain, d = tensor(values), len(values)
    trial = turned(strain)
    kept, volume = mapped(SAND, trial)
    trace, length = float(strain.sum()), float(dev(strain).norm())
    if trace > 1e-9:
        torch.testing.assert_close(kept, torch.eye(d, dtype=kept.dtype), rtol=0.0, atol=1e-12)
        assert float(volume) == pytest.approx(trace)
    elif length + SAND.slope(d) * trace < -1e-9:
        assert torch.equal(kept, trial)
    elif trace < -1e-9:
        assert float(strains_of(kept).sum()) == pytest.approx(trace, rel=1e-9)
        assert float(dev(strains_of(kept)).norm()) == pytest.approx(-SAND.slope(d) * trace)


@some
@given(strain_vectors)
def test_goop_lies_between_plasticine_and_elasticity(values: list[float]):
    """Viscosity 0 is von Mises, infinite viscosity is elastic, and between it is between."""
    trial = turned(tensor(values))
    thin, thick = replace(GOOP, viscosity=1e-12), replace(GOOP, viscosity=1e15)
    torch.testing.assert_close(mapped(thin, trial)[0], mapped(CLAY, trial)[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(
        mapped(replace(GOOP, viscosity=0.0), trial)[0], mapped(CLAY, trial)[0]
    )
    torch.testing.assert_close(mapped(thick, trial)[0], trial, rtol=1e-9, atol=1e-9)
    between = deviatoric_stress(GOOP, mapped(GOOP, trial)[0])
    lowest = deviatoric_stress(CLAY, mapped(CLAY, trial)[0])
    assert lowest * (1 - 1e-9) <= between <= deviatoric_stress(GOOP, trial) * (1 + 1e-9)


@pytest.mark.parametrize("dimension", [2, 3])
def test_confined_plasticine_follows_its_closed_form_there_and_back(dimension: int):
    """Confined bar, e = (a, 0, 0): with q = sqrt((d - 1)/d) and B = lambda + 2 mu / d.

    Elastic until ``q a = sigma_y / 2 mu``, then ``tau_1 = B a + q sigma_y``; unloading is
    elastic over twice the yield strain and ends at ``tau_1 = B a - q sigma_y``.
    """
    mu, lam = CLAY.lame_constants
    q, bulk = math.sqrt((dimension - 1) / dimension), lam + 2.0 * mu / dimension
    elastic, step = torch.eye(dimension, dtype=torch.float64), 1e-3
    highest = 0.1
    forth = [step * n for n in range(1, 101)]
    back = [highest - step * n for n in range(1, 101)]
    for index, a in enumerate([*forth, *back]):
        growth = torch.eye(dimension, dtype=torch.float64)
        growth[0, 0] = math.exp(step if index < 100 else -step)
        elastic, _ = mapped(CLAY, growth @ elastic @ growth.T)
        if index < 100:
            deviator = min(2.0 * mu * q * a, CLAY.yield_stress)
        else:
            fall = 2.0 * mu * q * (highest - a)
            deviator = max(CLAY.yield_stress - fall, -CLAY.yield_stress)
        expected = bulk * a + q * deviator
        assert float(CLAY.kirchhoff_stress(elastic)[0, 0]) == pytest.approx(
            expected, rel=1e-9, abs=1e-6
        )


def test_pure_shear_of_plasticine_saturates_at_the_yield_stress():
    """F = diag(k, 1/k, 1): tau_1 = -tau_2 = min(2 mu ln k, sigma_y / sqrt 2)."""
    mu, _ = CLAY.lame_constants
    elastic = torch.eye(3, dtype=torch.float64)
    for n in range(1, 61):
        growth = torch.diag(tensor([math.exp(1e-3), math.exp(-1e-3), 1.0]))
        elastic, _ = mapped(CLAY, growth @ elastic @ growth)
        expected = min(2.0 * mu * 1e-3 * n, CLAY.yield_stress / math.sqrt(2.0))
        torch.testing.assert_close(
            CLAY.kirchhoff_stress(elastic),
            torch.diag(tensor([expected, -expected, 0.0])),
            rtol=1e-9,
            atol=1e-6,
        )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("friction_angle", [15.0, 25.0, 31.0])
def test_sand_squeezed_in_a_box_pushes_sideways_as_rankine_says(
    dimension: int, friction_angle: float
):
    """Mohr-Coulomb at yield: side over top stress = (1 - sin phi)/(1 + sin phi), Rankine 1857.

    In the plane the cone is Mohr-Coulomb's law; in space the confined state is triaxial
    compression, where the cone is fitted. The elastic ratio nu/(1 - nu) = 1/4 is below.
    """
    sand = replace(SAND, friction_angle=friction_angle, poissons_ratio=0.2)
    elastic, volume = torch.eye(dimension, dtype=torch.float64), tensor([0.0]).squeeze(0)
    growth = torch.eye(dimension, dtype=torch.float64)
    growth[1, 1] = math.exp(-1e-3)
    for _ in range(20):
        elastic, volume = sand.return_map(growth @ elastic @ growth, volume, substep_dt=DT)
    stress = sand.kirchhoff_stress(elastic)
    sine = math.sin(math.radians(friction_angle))
    assert float(stress[0, 0] / stress[1, 1]) == pytest.approx((1 - sine) / (1 + sine), rel=1e-9)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kept", [True, False])
def test_sand_that_parts_and_returns_presses_only_without_volume_correction(
    dimension: int, kept: bool
):
    """Expansion by 0.1 and back in ten steps: no stress if the volume is remembered.

    Without, the same way back squeezes unstrained sand by 0.1: p = B * 0.1.
    """
    sand = replace(SAND, volume_correction=kept)
    elastic, volume = torch.eye(dimension, dtype=torch.float64), tensor([0.0]).squeeze(0)
    for sign in (1.0, -1.0):
        for _ in range(10):
            growth = math.exp(sign * 0.01 / dimension)
            elastic, volume = sand.return_map(growth**2 * elastic, volume, substep_dt=DT)
        if sign > 0.0:
            assert float(volume) == pytest.approx(0.1 if kept else 0.0)
    mu, lam = sand.lame_constants
    pressure = 0.0 if kept else -0.1 * (lam + 2.0 * mu / dimension)
    torch.testing.assert_close(
        sand.kirchhoff_stress(elastic),
        pressure * torch.eye(dimension, dtype=torch.float64),
        rtol=1e-9,
        atol=1e-6,
    )
    assert float(volume) == pytest.approx(0.0, abs=1e-12)


def relaxed_excess(dt: float, time: float) -> float:
    """Overstress left of a shear strain held for some time, relative to its start."""
    strain = tensor([0.2, -0.2, 0.0])
    start = float(strain.norm()) - GOOP.yield_strain
    for _ in range(round(time / dt)):
        strain = viscoplastic_map(
            strain,
            yield_strain=GOOP.yield_strain,
            relaxation_time=GOOP.relaxation_time,
            substep_dt=dt,
        )
    return (float(strain.norm()) - GOOP.yield_strain) / start


def test_held_shear_relaxes_as_implicit_euler_of_an_exponential():
    """r_n = r_0 (1 + dt/T)^-n exactly, T = eta / mu."""
    relaxation = GOOP.viscosity / GOOP.lame_constants[0]
    dt = relaxation / 20.0
    expected = (1.0 + dt / relaxation) ** -40
    assert relaxed_excess(dt, 2.0 * relaxation) == pytest.approx(expected, rel=1e-12)


def test_relaxation_converges_to_the_exponential_with_first_order():
    """The ODE r' = -r/T: halving the step halves the error."""
    relaxation = GOOP.relaxation_time
    errors = [
        abs(relaxed_excess(relaxation / n, relaxation) - math.exp(-1.0)) for n in (50, 100, 200)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.03)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize("rate", [0.1, 1.0, 10.0])
def test_steady_flow_of_goop_is_binghams_law(rate: float):
    """|s| = sigma_y + 2 eta |D| once elastic strain no longer grows."""
    flow = rate * tensor([1.0, -1.0, 0.0])
    strain, dt = torch.zeros(3, dtype=torch.float64), GOOP.relaxation_time / 10.0
    for _ in range(int(40 + GOOP.yield_strain / (dt * float(flow.norm()))) + 400):
        strain = viscoplastic_map(
            strain + dt * flow,
            yield_strain=GOOP.yield_strain,
            relaxation_time=GOOP.relaxation_time,
            substep_dt=dt,
        )
    stress = 2.0 * GOOP.lame_constants[0] * float(dev(strain).norm())
    expected = GOOP.yield_stress + 2.0 * GOOP.viscosity * float(flow.norm())
    assert stress == pytest.approx(expected, rel=1e-9)


def test_cone_of_the_plane_is_mohr_coulomb_for_every_stress():
    """|t1 - t2| / 2 = -(t1 + t2) / 2 sin phi is |dev| = -alpha tr with alpha = sin phi / sqrt 2."""
    sine = math.sin(math.radians(33.0))
    for low in (-1.0, -7.0):
        high = low * (1.0 - sine) / (1.0 + sine)
        stress = tensor([low, high])
        alpha = cone_slope(33.0, dimension=2)
        assert float(dev(stress).norm()) == pytest.approx(-alpha * (low + high), rel=1e-12)
