"""The least squares behind the field: exact recovery, other solvers, and its derivative."""

import pytest
import torch
from torch import Tensor

from giorom.fields.neural_basis import (
    BasisDecoder,
    NeuralField,
    NeuralFieldConfig,
    SampleSolver,
    projection_loss,
)


def cloud(count: int, seed: int = 0) -> Tensor:
    """Random points in the unit square."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 2, generator=generator, dtype=torch.float64)


def field(modes: int = 5, *, ridge: float = 0.0, **options: object) -> NeuralField:
    """A field with well-separated modes, in float64, always with the same weights."""
    torch.manual_seed(0)
    values = {"modes": modes, "width": 24, "depth": 2, "activation": "sine", "ridge": ridge}
    result = NeuralField(NeuralFieldConfig(**(values | options)), dimension=2).double()
    result.set_domain(cloud(500))
    return result


def displaced(model: NeuralField, points: Tensor, coefficients: Tensor) -> Tensor:
    """U(X) q for every frame of coefficients."""
    return torch.einsum("pdr,tr->tpd", model(points).detach(), coefficients)


def coefficients(frames: int, modes: int = 5) -> Tensor:
    """Random motion in the modes."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(frames, modes, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("samples", [3, 10, 200])
def test_the_coefficients_of_a_motion_in_the_span_are_recovered(samples):
    """U = U q gives q back, whatever samples are used (discretisation invariance)."""
    model, wanted = field(), coefficients(7)
    for seed in range(3):
        points = cloud(samples, seed)
        solver = SampleSolver(model(points).detach(), ridge=0.0)
        found = solver.solve(displaced(model, points, wanted))
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-8)


def test_the_decoded_motion_does_not_depend_on_the_samples():
    """Two sample sets of another size and place give the same motion of every point."""
    model, wanted, query = field(), coefficients(1), cloud(300, seed=9)
    expected = query + displaced(model, query, wanted)[0]
    for count, seed in ((8, 1), (150, 2)):
        points = cloud(count, seed)
        decode = model.bind(points, query)
        moved = decode(points + displaced(model, points, wanted)[0])
        torch.testing.assert_close(moved, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_solver_agrees_with_lapack(dtype):
    """torch.linalg.lstsq in float64 on a motion outside the span; the solve is always float64."""
    basis = field()(cloud(40)).detach().to(dtype)
    target = torch.randn(6, 40, 2, generator=torch.Generator().manual_seed(2), dtype=dtype)
    matrix, columns = basis.double().flatten(0, 1), target.double().flatten(1).T
    expected = torch.linalg.lstsq(matrix, columns).solution.T
    found = SampleSolver(basis, ridge=0.0).solve(target)
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_the_ridge_is_that_of_the_regularised_equations():
    """(B^T B + ridge mean(diag) I) q = B^T u, by a general solver."""
    basis = field()(cloud(40)).detach()
    target = torch.randn(40, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    matrix = basis.flatten(0, 1)
    normal = matrix.T @ matrix
    normal = normal + 0.1 * normal.diagonal().mean() * torch.eye(5, dtype=torch.float64)
    expected = torch.linalg.solve(normal, matrix.T @ target.flatten())
    found = SampleSolver(basis, ridge=0.1).solve(target)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_frames_are_solved_together_as_they_are_alone():
    """Any leading axes, also none."""
    basis = field()(cloud(30)).detach()
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(2, 3, 30, 2, generator=generator, dtype=torch.float64)
    solver = SampleSolver(basis, ridge=1e-8)
    together = solver.solve(target)
    assert together.shape == (2, 3, 5)
    for i in range(2):
        for k in range(3):
            torch.testing.assert_close(together[i, k], solver.solve(target[i, k]))


@pytest.mark.parametrize("modes", [5, 6, 9, 20])
def test_more_modes_than_equations_are_refused_without_a_ridge(modes):
    """2 samples in 2-D are 4 equations: the normal matrix is singular, rounding or not."""
    for seed in range(5):
        basis = field(modes)(cloud(2, seed)).detach()
        with pytest.raises(ValueError, match=f"2 samples do not determine {modes} modes"):
            SampleSolver(basis, ridge=0.0)
        SampleSolver(basis, ridge=1e-8)


def test_modes_that_repeat_are_refused_without_a_ridge():
    """Equal columns have no unique coefficients."""
    basis = field()(cloud(50)).detach()
    with pytest.raises(ValueError, match="do not determine 10 modes"):
        SampleSolver(torch.cat([basis, basis], dim=2), ridge=0.0)


@pytest.mark.parametrize("activation", ["elu", "sine"])
def test_the_loss_is_zero_for_a_motion_in_the_span(activation):
    """The held-back points are predicted exactly, relative to the motion."""
    model, points = field(activation=activation), cloud(60)
    motion = displaced(model, points, coefficients(4))
    loss = projection_loss(model, points, motion, solve_count=30)
    assert float(loss.detach()) < 1e-16


def test_the_loss_is_the_relative_error_of_the_held_back_points():
    """Mean (u - U q)^2 / mean u^2, with q from the decoder and the first points alone."""
    model, points = field(), cloud(60)
    generator = torch.Generator().manual_seed(3)
    motion = torch.randn(4, 60, 2, generator=generator, dtype=torch.float64)
    decode = model.bind(points[:20], points[20:])
    expected = 0.0
    for frame in motion:
        error = decode(points[:20] + frame[:20]) - points[20:] - frame[20:]
        expected += float(error.square().mean() / frame.square().mean()) / 4
    found = float(projection_loss(model, points, motion, solve_count=20).detach())
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_loss_does_not_depend_on_the_size_of_the_motion():
    """Relative error: all displacements times a thousand give the same number."""
    model, points = field(), cloud(60)
    motion = torch.randn(4, 60, 2, generator=torch.Generator().manual_seed(3)).double()
    small = projection_loss(model, points, motion, solve_count=20)
    large = projection_loss(model, points, 1e3 * motion, solve_count=20)
    torch.testing.assert_close(large, small, rtol=1e-9, atol=0)


def test_the_gradient_of_the_loss_is_that_of_finite_differences():
    """Central differences through the solve: error h^2 + eps / h, about 1e-8 at h = 1e-5."""
    model, points = field(modes=3, ridge=1e-6), cloud(25)
    motion = torch.randn(3, 25, 2, generator=torch.Generator().manual_seed(4)).double()

    def loss() -> Tensor:
        return projection_loss(model, points, motion, solve_count=12)

    loss().backward()
    for name, parameter in model.named_parameters():
        direction = torch.randn(
            parameter.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64
        )
        analytic = float((parameter.grad * direction).sum())
        values = []
        for step in (1e-5, -2e-5):
            parameter.data += step * direction
            values.append(float(loss().detach()))
        parameter.data += 1e-5 * direction
        assert (values[0] - values[1]) / 2e-5 == pytest.approx(analytic, rel=1e-5, abs=1e-7), name


def test_held_points_stay_where_they_are_to_the_last_bit():
    """Whatever the samples do; the others are decoded as without."""
    model, query, samples = field(), cloud(50, seed=3), cloud(20)
    held = torch.arange(50) % 3 == 0
    moved = samples + 0.1 * cloud(20, seed=4)
    free = model.bind(samples, query)(moved)
    found = model.bind(samples, query, held=held)(moved)
    assert torch.equal(found[held], query[held])
    assert torch.equal(found[~held], free[~held])


def test_the_domain_is_standardised():
    """Zero mean and unit spread at the input; the body may lie anywhere in any unit."""
    near, far = field(), field()
    points = cloud(500)
    far.set_domain(points * 1000.0 + 7.0)
    torch.testing.assert_close(far(points * 1000.0 + 7.0), near(points), rtol=0, atol=1e-10)


def test_basis_vectors_belong_to_points_one_by_one():
    """U of permuted or split points is the same vector: points do not mix."""
    model, points = field(), cloud(40)
    basis, order = model(points), torch.randperm(40, generator=torch.Generator().manual_seed(1))
    assert basis.shape == (40, 2, 5)
    torch.testing.assert_close(model(points[order]), basis[order], rtol=0, atol=1e-13)
    parts = torch.cat([model(part) for part in points.split(7)])
    torch.testing.assert_close(parts, basis, rtol=0, atol=1e-13)


def test_evaluating_in_chunks_changes_nothing():
    """Chunks bound the memory and no more."""
    model, samples, query = field(), cloud(30), cloud(50, seed=1)
    moved = samples + 0.1 * cloud(30, seed=2)
    expected = model.bind(samples, query)(moved)
    for chunk in (1, 7, 50):
        found = BasisDecoder(model, samples, query, ridge=0.0, chunk=chunk)(moved)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def test_a_basis_that_holds_the_translations_translates():
    """The first modes are the axes; every point moves as the samples do, up to the ridge."""
    model = field(6, ridge=1e-8)
    model.output.weight.data.unflatten(0, (2, 6))[:, :2] = 0.0
    model.output.bias.data.unflatten(0, (2, 6))[:, :2] = torch.eye(2, dtype=torch.float64)
    samples, query, shift = cloud(30), cloud(50, seed=1), torch.tensor([1.0, 2.0]).double()
    found = model.bind(samples, query)(samples + shift)
    torch.testing.assert_close(found, query + shift, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"modes": 0}, "modes must be >= 1, got 0"),
        ({"width": 0}, "width must be >= 1, got 0"),
        ({"depth": 0}, "depth must be >= 1, got 0"),
        ({"ridge": -1.0}, "ridge must be >= 0, got -1.0"),
        ({"ridge": float("nan")}, "ridge must be >= 0"),
    ],
)
def test_sizes_no_field_can_be_built_with_are_refused(values, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        NeuralFieldConfig(**values)
