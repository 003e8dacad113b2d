"""The eigen-solve and the laws on the device, on random and on degenerate strains.

The references are ``torch.linalg.eigh`` and the float64 laws of ``giorom.mpm.materials``.
"""

from typing import Any, no_type_check

import pytest
import torch
import warp as wp  # noqa: TID253

from giorom.mpm import (
    DruckerPragerSand,
    FixedCorotated,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
)
from giorom.mpm.device_laws import FAMILIES, LAW_CONSTANTS, Constants, eigen_plane, eigen_space
from giorom.mpm.materials import Solid
from giorom.mpm.transfer import build_law_kernels

MODULI = {"density": 1000.0, "youngs_modulus": 1.0, "poissons_ratio": 0.3}
SOLIDS: list[Solid] = [
    StableNeoHookean(**MODULI),
    FixedCorotated(**MODULI),
    DruckerPragerSand(**MODULI, friction_angle=30.0),
    DruckerPragerSand(**MODULI, friction_angle=30.0, volume_correction=False),
    VonMisesPlasticine(**MODULI, yield_stress=0.1),
    ViscoplasticGoop(**MODULI, yield_stress=0.1, viscosity=0.0),
]


@wp.kernel(enable_backward=False)
@no_type_check
def solve_plane(
    b: wp.array(dtype=wp.mat22), values: wp.array(dtype=wp.vec2), axes: wp.array(dtype=wp.mat22)
):
    i = wp.tid()
    found, turn = eigen_plane(b[i])
    values[i] = found
    axes[i] = turn


@wp.kernel(enable_backward=False)
@no_type_check
def solve_space(
    b: wp.array(dtype=wp.mat33), values: wp.array(dtype=wp.vec3), axes: wp.array(dtype=wp.mat33)
):
    i = wp.tid()
    found, turn = eigen_space(b[i])
    values[i] = found
    axes[i] = turn


def random_axes(count: int, dimension: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, dimension, dimension, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(noise).Q


def assembled(values: torch.Tensor, seed: int) -> torch.Tensor:
    """Symmetric matrices of given eigenvalues on random axes, in float32."""
    axes = random_axes(len(values), values.shape[1], seed)
    b = (axes * values[:, None, :]) @ axes.mT
    return (0.5 * (b + b.mT)).float()


def strains(kind: str, dimension: int) -> torch.Tensor:
    """Matrices ``b``: random, nearly at rest, or with equal eigenvalues."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(500, dimension, generator=generator, dtype=torch.float64)
    if kind == "random":
        return assembled(torch.exp(0.8 * noise), 1)
    if kind == "small":
        return assembled(1.0 + 1e-4 * noise, 2)
    if kind == "equal":
        noise[:, 1] = noise[:, 0]
        return assembled(torch.exp(0.8 * noise), 3)
    if kind == "nearly equal":
        noise[:, 1] = noise[:, 0] + 1e-6 * noise[:, 1]
        return assembled(torch.exp(0.8 * noise), 4)
    scale = torch.exp(noise[:, :1, None].float())
    return scale * torch.eye(dimension).expand(500, dimension, dimension)


def solved(b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Eigenvalues and axes by the device function."""
    d = b.shape[-1]
    vector, matrix = (wp.vec2, wp.mat22) if d == 2 else (wp.vec3, wp.mat33)
    values = wp.empty(len(b), dtype=vector, device="cpu")
    axes = wp.empty(len(b), dtype=matrix, device="cpu")
    given = wp.array(b.numpy(), dtype=matrix, device="cpu")
    kernel = solve_plane if d == 2 else solve_space
    wp.launch(kernel, dim=len(b), inputs=[given], outputs=[values, axes], device="cpu")
    return torch.from_numpy(values.numpy()).double(), torch.from_numpy(axes.numpy()).double()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["random", "small", "equal", "nearly equal", "identity"])
def test_eigen_solve_agrees_with_lapack(kind: str, dimension: int):
    """Values as torch.linalg.eigh in float64; axes orthonormal and V diag V^T = b; 1e-6."""
    b = strains(kind, dimension)
    values, axes = solved(b)
    exact = b.double()
    scale = exact.abs().amax((1, 2))
    error = (values.sort(-1).values - torch.linalg.eigvalsh(exact)).abs().amax(-1)
    assert float((error / scale).max()) < 1e-6
    product = axes.mT @ axes - torch.eye(dimension, dtype=torch.float64)
    assert float(product.abs().max()) < 2e-6
    rebuilt = (axes * values[:, None, :]) @ axes.mT - exact
    assert float((rebuilt.abs().amax((1, 2)) / scale).max()) < 2e-6


def settled(material: Solid, b: torch.Tensor, gain: torch.Tensor) -> tuple[Any, Any, Any]:
    """State, volume correction and stress that the device law makes of trial states."""
    d = b.shape[-1]
    kernels = build_law_kernels(FAMILIES[material.name], d)
    state = wp.array(b.numpy(), dtype=kernels.state, device="cpu")
    volume = wp.array(gain.float().numpy(), dtype=float, device="cpu")
    stress = wp.zeros(len(b), dtype=kernels.state, device="cpu")
    given = material.law_constants(d)
    constants = Constants(*given, *[0.0] * (LAW_CONSTANTS - len(given)))
    arguments = [stress, state, volume, constants]
    wp.launch(kernels.settle, dim=len(b), inputs=arguments, device="cpu")
    return tuple(torch.from_numpy(each.numpy()).double() for each in (state, volume, stress))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("material", SOLIDS, ids=lambda law: law.name)
@pytest.mark.parametrize("kind", ["random", "small", "equal", "nearly equal", "identity"])
def test_law_on_the_device_agrees_with_its_reference(kind: str, material: Solid, dimension: int):
    """Return map and stress of 500 strains, float32 against float64; 1e-5 of the largest."""
    b = strains(kind, dimension)
    gain = 0.1 * torch.rand(len(b), generator=torch.Generator().manual_seed(5))
    if not isinstance(material, DruckerPragerSand) or not material.volume_correction:
        gain = torch.zeros_like(gain)
    state, volume, stress = settled(material, b, gain)
    kept, gained = material.return_map(b.double(), gain.double(), substep_dt=0.0)
    expected = material.kirchhoff_stress(kept)
    scale = 1.0 + b.double().abs().amax((1, 2), keepdim=True)
    assert float(((state - kept) / scale).abs().max()) < 3e-6
    assert float((volume - gained).abs().max()) < 3e-6
    allowed = 3e-6 * scale + 1e-5 * expected.abs().amax((1, 2), keepdim=True)
    assert bool(((stress - expected).abs() <= allowed).all())
