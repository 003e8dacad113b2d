"""The fields that are fitted to motions: closed forms, and what the fit must find."""

import math

import pytest
import torch
from torch import Tensor

from giorom.fields.autoencoder import AutoencoderConfig, AutoencoderField
from giorom.fields.contract import Field
from giorom.fields.kernel import FIRST_WIDTH, KernelConfig, KernelField
from giorom.fields.pod import PodConfig, PodField, gappy_modes
from giorom.state import Trajectory
from giorom.training.field_loop import FieldTrainingConfig, train_field


def cloud(count: int, dimension: int = 2, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def affine(points: Tensor, frame: int) -> Tensor:
    """One of many affine motions, the same for every body."""
    generator = torch.Generator().manual_seed(100 + frame)
    dimension = points.shape[1]
    matrix = torch.randn(dimension + 1, dimension, generator=generator, dtype=torch.float64)
    matrix = matrix.to(points.dtype)
    return points + 0.1 * (points @ matrix[:-1] + matrix[-1])


def motion(points: Tensor, frames: int, first: int = 0) -> Trajectory:
    """A body at rest, then at some affine motions."""
    moved = [affine(points, first + frame) for frame in range(frames)]
    return Trajectory(
        position=torch.stack([points, *moved]),
        particle_type=torch.full((len(points),), 8),
        frame_dt=0.01,
        bounds=torch.tensor([[-9.0, 9.0]] * points.shape[1], dtype=torch.float64),
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_pod_recovers_every_motion_of_the_training_span(dimension):
    """Affine maps span d (d + 1) modes and are linear between nodes: unseen ones are exact.

    Up to the ridge, which biases by about its size relative to the smallest mode.
    """
    count = dimension * (dimension + 1)
    config = PodConfig(modes=count, nodes=6**dimension, ridge=1e-12)
    field = PodField(config, dimension=dimension).double()
    field.prepare([motion(cloud(600, dimension), 3 * count)])
    samples, query = (0.1 + 0.8 * cloud(n, dimension, seed=n) for n in (40, 60))
    found = field.bind(samples, query)(affine(samples, 999))
    torch.testing.assert_close(found, affine(query, 999), rtol=0, atol=1e-7)


def test_pod_basis_at_the_nodes_is_orthonormal():
    """Left singular vectors of the snapshots."""
    field = PodField(PodConfig(modes=5, nodes=49), dimension=2).double()
    field.prepare([motion(cloud(500), 20)])
    basis = field.basis(field.nodes()).flatten(0, 1)
    torch.testing.assert_close(basis.T @ basis, torch.eye(5).double(), rtol=0, atol=1e-10)


def test_pod_of_one_body_agrees_with_the_singular_values():
    """Projection error of known snapshots = the discarded singular values (Eckart-Young)."""
    snapshots = torch.randn(40, 25, generator=torch.Generator().manual_seed(0)).double()
    modes = gappy_modes(snapshots, torch.ones(40, 25, dtype=torch.bool), 6, sweeps=0)
    left = snapshots - modes @ (modes.T @ snapshots)
    expected = torch.linalg.svdvals(snapshots)[6:].square().sum()
    torch.testing.assert_close(left.square().sum(), expected, rtol=1e-10, atol=0)


def test_gaps_are_filled_by_what_the_other_snapshots_show():
    """Rank two with a fifth of the entries missing: the modes span the true ones in the end."""
    generator = torch.Generator().manual_seed(0)
    left, right = (torch.randn(n, 2, generator=generator, dtype=torch.float64) for n in (50, 40))
    whole = left @ right.T
    known = torch.rand(50, 40, generator=generator) > 0.2
    modes = gappy_modes(whole * known, known, 2, sweeps=200)
    missed = left - modes @ (modes.T @ left)
    assert float(missed.norm() / left.norm()) < 1e-6
    unfilled = gappy_modes(whole * known, known, 2, sweeps=0)
    assert float((left - unfilled @ (unfilled.T @ left)).norm() / left.norm()) > 1e-2


def test_pod_joins_bodies_that_fill_different_parts_of_space():
    """Two overlapping bodies under the same kinds of motion give modes for a third across both."""
    points = cloud(1500)
    parts = [points[points[:, 0] < 0.6], points[points[:, 0] > 0.4]]
    field = PodField(PodConfig(modes=6, nodes=64, sweeps=400, ridge=1e-10), dimension=2).double()
    field.prepare([motion(part, 20, first=20 * i) for i, part in enumerate(parts)])
    samples, query = (0.1 + 0.8 * cloud(n, seed=n) for n in (60, 40))
    found = field.bind(samples, query)(affine(samples, 999))
    error = (found - affine(query, 999)).norm() / (affine(query, 999) - query).norm()
    assert float(error) < 0.02


def test_pod_without_training_or_with_too_little_is_refused():
    """One line each, with the remedy."""
    field = PodField(PodConfig(modes=8, nodes=16), dimension=2)
    with pytest.raises(ValueError, match="holds no modes yet; prepare it"):
        field.bind(cloud(9).float(), cloud(9).float())
    with pytest.raises(ValueError, match="3 training frames cannot give 8 modes"):
        field.prepare([motion(cloud(100).float(), 3)])


def test_kernel_without_network_is_the_normalised_gaussian():
    """Sum of exp(-(r / h)^2) u over sum of exp(-(r / h)^2), h in units of the median spacing."""
    config = KernelConfig(neighbors=50, correction=False)
    field = KernelField(config, dimension=2).double()
    samples, query = cloud(50), cloud(1000, seed=1)
    table = (samples[:, None] - samples).norm(dim=2) + 9.0 * torch.eye(50, dtype=torch.float64)
    width = FIRST_WIDTH * table.amin(dim=1).quantile(0.5, interpolation="midpoint")
    weight = torch.exp(-((query[:, None] - samples).norm(dim=2) / width).square())
    moved = 0.1 * cloud(50, seed=2)
    expected = query + (weight @ moved) / weight.sum(dim=1, keepdim=True)
    found = field.bind(samples, query)(samples + moved)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_a_point_far_from_all_samples_follows_the_nearest():
    """The Gaussian underflows there; the normalised one does not."""
    field = KernelField(KernelConfig(correction=False), dimension=2).double()
    samples = cloud(30)
    query = torch.cat([samples, torch.tensor([[40.0, 0.5]], dtype=torch.float64)])
    moved = 0.1 * cloud(30, seed=2)
    nearest = int((samples - query[-1]).norm(dim=1).argmin())
    found = field.bind(samples, query)(samples + moved)[-1]
    torch.testing.assert_close(found - query[-1], moved[nearest], rtol=0, atol=1e-12)


def error_before_and_after(
    field: Field, *, steps: int, learning_rate: float
) -> tuple[float, float]:
    """Relative squared error of an unseen body under unseen motions, about a training."""
    motions = [motion(cloud(150, seed=seed).float(), 12, first=12 * seed) for seed in range(4)]
    held_out = motion(cloud(150, seed=9).float(), 12, first=500)
    points = held_out.position[0]
    moved = held_out.position[1:] - points
    field.prepare(motions)
    before = float(field.loss(points, moved, solve_count=50).detach())
    config = FieldTrainingConfig(steps=steps, samples=50, queries=100, learning_rate=learning_rate)
    train_field(field, motions, config, seed=0, minutes=1.0, report=lambda numbers: None)
    return before, float(field.loss(points, moved, solve_count=50).detach())


def test_training_narrows_a_kernel_that_is_too_wide():
    """Three spacings smear every motion out; a width near one spacing is what fits."""
    field = KernelField(KernelConfig(correction=False), dimension=2)
    torch.nn.init.constant_(field.log_width, math.log(3.0))
    before, after = error_before_and_after(field, steps=40, learning_rate=1e-1)
    assert after < 0.7 * before
    assert 0.3 < float(field.log_width.detach().exp()) < 1.5


def test_training_teaches_the_autoencoder_a_body_it_has_not_seen():
    """A third less error after some steps, on motions of the same family."""
    torch.manual_seed(0)
    field = AutoencoderField(AutoencoderConfig(latent=6, width=32, depth=2), dimension=2)
    before, after = error_before_and_after(field, steps=150, learning_rate=5e-3)
    assert after < 0.67 * before


@pytest.mark.parametrize(
    ("record", "values", "message"),
    [
        (PodConfig, {"modes": 0}, "modes must be >= 1, got 0"),
        (PodConfig, {"nodes": 4}, "nodes must be >= 8, got 4"),
        (PodConfig, {"ridge": -1.0}, "ridge must be >= 0"),
        (KernelConfig, {"neighbors": 0}, "neighbors must be >= 1"),
        (AutoencoderConfig, {"latent": 0}, "latent must be >= 1"),
    ],
)
def test_sizes_no_field_can_be_built_with_are_refused(record, values, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        record(**values)
