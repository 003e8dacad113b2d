"""One substep of the simulator: transfer identities, and the engine against a reference.

The reference is a plain float64 NumPy step of MLS-MPM (Hu et al. 2018) written from the
equations, one particle at a time.
"""

from itertools import product

import numpy as np
import pytest
import torch

from giorom.mpm import (
    DruckerPragerSand,
    FixedCorotated,
    Scene,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
    WeaklyCompressibleFluid,
)
from giorom.mpm.boundary import walls_of
from giorom.mpm.engine import Engine
from giorom.state import KINEMATIC

CELLS = 16
MODULI = {"density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
RUBBER = StableNeoHookean(**MODULI)
WATER = WeaklyCompressibleFluid(density=1000.0, bulk_modulus=4e4)
LAWS = [
    RUBBER,
    FixedCorotated(**MODULI),
    WATER,
    DruckerPragerSand(**MODULI, friction_angle=25.0),
    DruckerPragerSand(
        **MODULI, friction_angle=40.0, cohesion_strain=0.002, volume_correction=False
    ),
    VonMisesPlasticine(**MODULI, yield_stress=1e3),
    ViscoplasticGoop(**MODULI, yield_stress=100.0, viscosity=50.0),
]
every_law = pytest.mark.parametrize("material", LAWS, ids=lambda law: law.name)


def random_scene(dimension: int, material, *, count: int = 60, gravity: float = 0.0) -> Scene:
    """Particles all over the box, the walls included, moving at random."""
    generator = torch.Generator().manual_seed(dimension)
    position = 0.13 + 0.74 * torch.rand(count, dimension, generator=generator)
    return Scene(
        position=position,
        velocity=torch.randn(count, dimension, generator=generator),
        affine_velocity=torch.randn(count, dimension, dimension, generator=generator),
        volume=0.5**dimension / CELLS**dimension * (0.5 + torch.rand(count, generator=generator)),
        particle_type=torch.full((count,), material.particle_type),
        materials=(material,),
        material_index=torch.zeros(count, dtype=torch.long),
        bounds=torch.tensor([[0.125, 0.875]] * dimension),
        gravity=gravity,
    )


def splines(fraction: np.ndarray) -> np.ndarray:
    """Quadratic B-spline weights of the three nodes per axis, (3, d)."""
    return np.stack(
        [0.5 * (1.5 - fraction) ** 2, 0.75 - (fraction - 1) ** 2, 0.5 * (fraction - 0.5) ** 2]
    )


def stencil(x: np.ndarray):
    """Nodes, weights and offsets x_i - x_p [m] around one particle."""
    base = np.floor(x * CELLS - 0.5).astype(int)
    fraction = x * CELLS - base
    weights = splines(fraction)
    for corner in product(range(3), repeat=len(x)):
        weight = np.prod([weights[i, axis] for axis, i in enumerate(corner)])
        yield tuple(base + corner), weight, (np.array(corner) - fraction) / CELLS


def stress_of(material, state: np.ndarray, identity: np.ndarray) -> np.ndarray:
    """Kirchhoff stress as a matrix; a fluid gives its isotropic part alone."""
    tau = material.kirchhoff_stress(torch.from_numpy(state)).numpy()
    return tau if state.ndim == 3 else tau[:, None, None] * identity


class Reference:
    """The same scene in float64."""

    def __init__(self, scene: Scene, dt: float):
        self.scene, self.dt, self.walls = scene, dt, walls_of(scene, CELLS)
        self.x, self.v, self.affine = (
            values.double().numpy().copy()
            for values in (scene.position, scene.velocity, scene.affine_velocity)
        )
        self.volume = scene.volume.double().numpy()
        count, d = self.x.shape
        self.material = scene.materials[0]
        solid = self.material.state == "b"
        self.state = np.tile(np.eye(d), (count, 1, 1)) if solid else np.ones(count)
        self.volume_correction = np.zeros(count)

    def step(self) -> None:
        """Scatter, update the grid, gather."""
        d = self.x.shape[1]
        mass, momentum = np.zeros((CELLS,) * d), np.zeros((CELLS,) * d + (d,))
        identity, scale = np.eye(d), 4.0 * CELLS**2
        tau = stress_of(self.material, self.state, identity)
        held = self.scene.kinematic.numpy()
        for p in np.flatnonzero(~held):
            m = self.material.density * self.volume[p]
            affine = m * self.affine[p] - self.dt * self.volume[p] * scale * tau[p]
            for node, weight, offset in stencil(self.x[p]):
                mass[node] += weight * m
                momentum[node] += weight * (m * self.v[p] + affine @ offset)
        velocity = momentum / np.where(mass > 0.0, mass, 1.0)[..., None]
        velocity[..., 1] -= self.dt * self.scene.gravity
        self._walls(velocity)
        for p in np.flatnonzero(~held):
            v, gradient = np.zeros(d), np.zeros((d, d))
            for node, weight, offset in stencil(self.x[p]):
                v += weight * velocity[node]
                gradient += scale * weight * np.outer(velocity[node], offset)
            self.x[p] += self.dt * v
            self.v[p], self.affine[p] = v, gradient
            growth = identity + self.dt * gradient
            if self.state.ndim == 3:
                self.state[p] = growth @ self.state[p] @ growth.T
            else:
                self.state[p] *= 1.0 + self.dt * np.trace(gradient)
        self._return(~held)

    def _return(self, moving: np.ndarray) -> None:
        """What is kept of the trial strain."""
        if self.state.ndim == 3:
            kept, volume = self.material.return_map(
                torch.from_numpy(self.state[moving]),
                torch.from_numpy(self.volume_correction[moving]),
                substep_dt=self.dt,
            )
            self.state[moving], self.volume_correction[moving] = kept.numpy(), volume.numpy()

    def _walls(self, velocity: np.ndarray) -> None:
        d = velocity.shape[-1]
        stopped = np.zeros(velocity.shape[:-1], dtype=bool)
        for axis in range(d):
            along = np.moveaxis(velocity, axis, 0)
            low, high = self.walls.lower[axis], self.walls.upper[axis]
            touched = np.moveaxis(stopped, axis, 0)
            touched[: low + 1] |= along[: low + 1, ..., axis] < 0.0
            touched[high:] |= along[high:, ..., axis] > 0.0
            along[: low + 1, ..., axis] = np.maximum(along[: low + 1, ..., axis], 0.0)
            along[high:, ..., axis] = np.minimum(along[high:, ..., axis], 0.0)
        if self.scene.wall_contact == "stick":
            velocity[stopped] = 0.0
        np.moveaxis(velocity, 1, 0)[: self.walls.clamp_node + 1] = 0.0


def engine_of(scene: Scene, dt: float) -> Engine:
    return Engine(scene, walls_of(scene, CELLS), substep_dt=dt, device="cpu")


def close(actual: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    torch.testing.assert_close(
        actual.double(), torch.from_numpy(expected), rtol=tolerance, atol=tolerance
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_weights_sum_to_one_with_moments_zero_and_quarter_cell(dimension: int):
    """The sums: sum w = 1, sum w d = 0, sum w d d^T = dx^2 / 4 I: quadratic B-splines."""
    for x in 0.2 + 0.6 * np.random.default_rng(0).random((20, dimension)):
        weights, offsets = zip(*[(w, o) for _, w, o in stencil(x)], strict=True)
        w, o = np.array(weights), np.array(offsets)
        np.testing.assert_allclose(w.sum(), 1.0, rtol=1e-13)
        np.testing.assert_allclose(w @ o, 0.0, atol=1e-15)
        second = np.einsum("n,ni,nj->ij", w, o, o)
        np.testing.assert_allclose(second, np.eye(dimension) / (4 * CELLS**2), atol=1e-15)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("material", [RUBBER, WATER])
def test_grid_carries_the_mass_of_the_particles(dimension: int, material):
    """Partition of unity: the masses of the nodes sum to the masses of the particles."""
    scene = random_scene(dimension, material)
    engine = engine_of(scene, 1e-4)
    engine.advance(1)
    mass = engine.grid()[:, -1].double().sum()
    expected = material.density * scene.volume.double().sum()
    torch.testing.assert_close(mass, expected, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_affine_velocity_field_passes_the_grid_unchanged(dimension: int):
    """APIC: v = a + B x gives back v_p and C = B, whatever the particles' places."""
    scene = random_scene(dimension, RUBBER)
    generator = torch.Generator().manual_seed(7)
    gradient = torch.randn(dimension, dimension, generator=generator)
    inner = 0.3 + 0.4 * (scene.position - 0.13) / 0.74
    velocity = 0.5 + inner @ gradient.T
    affine = gradient.repeat(len(inner), 1, 1)
    scene = Scene(
        **vars(scene) | {"position": inner, "velocity": velocity, "affine_velocity": affine}
    )
    engine = engine_of(scene, 1e-6)
    engine.advance(1)
    torch.testing.assert_close(engine.velocity(), velocity, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(engine.affine_velocity(), affine, rtol=1e-4, atol=1e-4)


def require_agreement(scene: Scene) -> None:
    """Ten substeps of the engine in float32 and of the reference in float64."""
    reference, engine = Reference(scene, 5e-4), engine_of(scene, 5e-4)
    for _ in range(10):
        reference.step()
    engine.advance(10)
    close(engine.position(), reference.x, 2e-6)
    close(engine.velocity(), reference.v, 5e-5)
    close(engine.affine_velocity(), reference.affine, 5e-3)
    close(engine.strain(), reference.state, 5e-5)
    close(engine.volume_correction(), reference.volume_correction, 5e-6)


@pytest.mark.parametrize("dimension", [2, 3])
@every_law
def test_engine_agrees_with_the_reference_step(dimension: int, material):
    """Stress, return map, walls and gravity of every law."""
    require_agreement(random_scene(dimension, material, gravity=9.8))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("material", [RUBBER, WATER])
def test_engine_with_sticking_walls_agrees_with_the_reference_step(dimension: int, material):
    """The same where walls take the whole velocity."""
    scene = random_scene(dimension, material, gravity=9.8)
    require_agreement(Scene(**vars(scene) | {"wall_contact": "stick"}))


@pytest.mark.parametrize("dimension", [2, 3])
def test_clamped_engine_agrees_with_the_reference_step(dimension: int):
    """The same with a clamp plane and the particles below it held."""
    free = random_scene(dimension, RUBBER)
    held = free.position[:, 1] < 0.4
    kinds = torch.where(held, KINEMATIC, free.particle_type)
    scene = Scene(**vars(free) | {"particle_type": kinds, "clamp_plane": 0.4})
    reference, engine = Reference(scene, 5e-4), engine_of(scene, 5e-4)
    for _ in range(10):
        reference.step()
    engine.advance(10)
    close(engine.position(), reference.x, 2e-6)
    assert torch.equal(engine.position()[held], free.position[held])


def test_replayed_substeps_equal_separate_ones():
    """Recording the substeps of a frame must not change a bit."""
    scene = random_scene(3, RUBBER, gravity=9.8)
    at_once, one_by_one = engine_of(scene, 5e-4), engine_of(scene, 5e-4)
    at_once.advance(4)
    at_once.advance(4)
    for _ in range(8):
        one_by_one.advance(1)
    assert torch.equal(at_once.position(), one_by_one.position())
