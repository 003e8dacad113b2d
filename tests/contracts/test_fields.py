"""What every field must satisfy, whatever it is made of.

A kind joins with one line in ``SETTINGS``: small settings with which it trains in a moment on a few
bending squares or cubes.
"""

from typing import Any, get_args

import pytest
import safetensors.torch
import torch
from torch import Tensor

from giorom.fields import Field, FieldConfig, FieldKind, build_field
from giorom.records import parse_record
from giorom.state import Trajectory
from giorom.training.field_loop import FieldTrainingConfig, train_field

SETTINGS: dict[str, dict[str, Any]] = {
    "neural_basis": {"modes": 6, "width": 12, "depth": 2},
    "pod": {"modes": 6, "nodes": 125, "snapshots": 8, "sweeps": 2},
    "pod_autoencoder": {"modes": 4, "latent": 3, "width": 8, "nodes": 125, "snapshots": 8},
    "autoencoder": {"latent": 4, "width": 16, "depth": 2},
    "crom": {"latent": 4, "width": 16, "depth": 2, "encoder_width": 8},
    "kernel": {"neighbors": 8, "hidden": 8},
    "kernel_rom": {"neighbors": 8, "hidden": 8},
    "nearest": {},
    "shepard": {},
    "local": {},
    "transport": {},
}

TRANSLATES = {
    "autoencoder": 1e-12,
    "kernel": 1e-12,
    "nearest": 1e-12,
    "shepard": 1e-12,
    "local": 1e-10,
    "transport": 1e-10,
}
"""Kinds that move every point along with a rigid translation, and to which error [m]."""

TURNS = {"local": 1e-10, "transport": 1e-10}
"""Kinds that reproduce affine motions, rotations among them, and to which error [m]."""

TRAINING = FieldTrainingConfig(steps=3, frames=3, samples=20, queries=40)


def cloud(count: int, dimension: int, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def bend(reference: Tensor, amount: float) -> Tensor:
    """A smooth motion that is not affine."""
    height = reference[:, 1:2]
    shift = torch.cat([height.square(), 0.3 * height * reference[:, :1]], dim=1)
    moved = reference.clone()
    moved[:, :2] += amount * shift
    return moved


def motion(dimension: int, seed: int) -> Trajectory:
    """One body that bends."""
    points = cloud(80, dimension, seed)
    return Trajectory(
        position=torch.stack([bend(points, 0.05 * frame) for frame in range(5)]),
        particle_type=torch.full((80,), 8),
        frame_dt=0.01,
        bounds=torch.tensor([[-1.0, 2.0]] * dimension, dtype=torch.float64),
    )


def make(kind: str, dimension: int, seed: int = 0) -> Field:
    """An untrained field in float64."""
    torch.manual_seed(seed)
    values = {"kind": kind, kind: SETTINGS[kind]}
    config = parse_record(FieldConfig, values, where="test")
    return build_field(config, dimension=dimension).double()


@pytest.fixture(scope="module", params=[f"{kind}-{d}d" for kind in SETTINGS for d in (2, 3)])
def case(request: pytest.FixtureRequest) -> tuple[str, int, Field]:
    """Name of the kind, space dimension, and a field after a few steps of training."""
    kind, dimension = request.param.split("-")
    field = make(kind, int(dimension[0]))
    motions = [motion(field.dimension, seed) for seed in (5, 6)]
    result = train_field(field, motions, TRAINING, seed=0, minutes=1.0, report=lambda numbers: None)
    assert result["steps"] == (3 if field.learns else 0)
    return kind, field.dimension, field.requires_grad_(False)


@pytest.fixture
def kind(case: tuple[str, int, Field]) -> str:
    """Name of the kind."""
    return case[0]


@pytest.fixture
def dimension(case: tuple[str, int, Field]) -> int:
    """Space dimension."""
    return case[1]


@pytest.fixture
def field(case: tuple[str, int, Field]) -> Field:
    """A field in float64."""
    return case[2]


def test_every_kind_is_tested():
    """A kind that can be chosen is held to the contract."""
    assert set(SETTINGS) == set(get_args(FieldKind))


def test_permuting_the_query_permutes_the_motion(field, dimension):
    """Each point is recovered on its own."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(1))
    moved = bend(samples, 0.2)
    expected = field.bind(samples, query)(moved)[order]
    found = field.bind(samples, query[order])(moved)
    assert found.shape == (50, dimension)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_permuting_the_samples_changes_nothing(field, dimension):
    """The samples are a set; rounding over the ridge of a basis, 1e-16 / 1e-8, may differ."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    moved = bend(samples, 0.2)
    expected = field.bind(samples, query)(moved)
    found = field.bind(samples[order], query)(moved[order])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)


def test_the_same_frames_give_the_same_motion(field, dimension):
    """Bit for bit: from a new decoder, from one that was restarted, and from a branch."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    frames = [bend(samples, amount) for amount in (0.1, 0.3, 0.2)]
    decode, other = field.bind(samples, query), field.bind(samples, query)
    first = torch.stack([decode(frame) for frame in frames])
    assert torch.equal(torch.stack([other(frame) for frame in frames]), first)
    decode.restart()
    assert torch.equal(torch.stack([decode(frame) for frame in frames]), first)
    if not decode.remembers:
        assert torch.equal(decode(frames[0]), first[0])


def test_a_body_at_rest_stays_at_rest(field, dimension):
    """No displacement of the samples, none of any point: phi(X) = X."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    decode = field.bind(samples, query)
    for _ in range(3):
        assert torch.equal(decode(samples), query)


def test_a_rigid_translation_is_reproduced_where_promised(kind, field, dimension):
    """Every point moves as the samples do."""
    if kind not in TRANSLATES:
        pytest.skip("a learned basis need not hold the translations")
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    shift = torch.arange(1.0, dimension + 1.0, dtype=torch.float64)
    decode = field.bind(samples, query)
    for part in (0.3, 1.0):
        found = decode(samples + part * shift)
        torch.testing.assert_close(found, query + part * shift, rtol=0, atol=TRANSLATES[kind])


def test_affine_motions_are_reproduced_where_promised(kind, field, dimension):
    """X -> A X + b, for a rotation and for a shear."""
    if kind not in TURNS:
        pytest.skip("does not promise affine motions")
    samples, query = cloud(40, dimension), cloud(50, dimension, seed=1)
    shear = torch.eye(dimension, dtype=torch.float64)
    shear[0, 1] = 0.7
    generator = torch.Generator().manual_seed(3)
    turn = torch.randn(dimension, dimension, generator=generator, dtype=torch.float64)
    for matrix in (torch.linalg.qr(turn).Q, shear):
        found = field.bind(samples, query)(samples @ matrix.T + 0.5)
        torch.testing.assert_close(found, query @ matrix.T + 0.5, rtol=0, atol=TURNS[kind])


def test_held_points_stay_where_they_are_to_the_last_bit(field, dimension):
    """Whatever the samples do; the others are decoded as without."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    held = torch.arange(50) % 3 == 0
    free, fixed = field.bind(samples, query), field.bind(samples, query, held=held)
    for amount in (0.1, 0.2):
        moved = bend(samples, amount)
        expected, found = free(moved), fixed(moved)
        assert torch.equal(found[held], query[held])
        assert torch.equal(found[~held], expected[~held])


def test_gradients_are_finite_and_reach_every_parameter(kind, dimension):
    """Those of the training loss, after the domain has been set."""
    field = make(kind, dimension)
    if not field.learns:
        with pytest.raises(NotImplementedError, match="nothing to train"):
            field.loss(cloud(9, dimension), cloud(9, dimension)[None], solve_count=4)
        return
    field.prepare([motion(dimension, 5)])
    points = cloud(60, dimension)
    moved = torch.stack([bend(points, amount) - points for amount in (0.1, 0.2, 0.4)])
    moved = moved + 0.05 * (cloud(60, dimension, seed=2) - 0.5)
    field.loss(points, moved, solve_count=30).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_saved_and_loaded_weights_give_the_same_motion(kind, field, dimension, tmp_path):
    """The state dict is the whole field, its domain included."""
    safetensors.torch.save_file(field.state_dict(), tmp_path / "field.safetensors")
    other = make(kind, dimension, seed=1)
    other.load_state_dict(safetensors.torch.load_file(tmp_path / "field.safetensors"))
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    moved = bend(samples, 0.2)
    found, expected = (f.bind(samples, query)(moved) for f in (other, field))
    assert torch.equal(found, expected)


def test_the_input_is_not_changed(field, dimension):
    """Neither the samples, nor the query, nor the positions."""
    samples, query, moved = (cloud(30, dimension, seed=seed) for seed in range(3))
    field.bind(samples, query, held=torch.arange(30) < 5)(moved)
    for seed, used in enumerate((samples, query, moved)):
        assert torch.equal(used, cloud(30, dimension, seed=seed))


def test_the_output_has_the_precision_of_the_input(kind, field, dimension):
    """Single precision differs from double by rounding over the conditioning of a basis."""
    samples, query = cloud(30, dimension), cloud(50, dimension, seed=1)
    moved = bend(samples, 0.2)
    double = field.bind(samples, query)(moved)
    single = make(kind, dimension)
    single.load_state_dict(field.state_dict())
    decode = single.float().bind(samples.float(), query.float())
    found = decode(moved.float())
    assert (double.dtype, found.dtype) == (torch.float64, torch.float32)
    torch.testing.assert_close(found.double(), double, rtol=0, atol=1e-3)


def test_too_few_samples_are_refused_in_one_line(field, dimension):
    """The line says how many there are."""
    samples, query = cloud(1, dimension), cloud(50, dimension, seed=1)
    with pytest.raises(ValueError, match=r"at least \d samples.*got 1") as caught:
        field.bind(samples, query)
    assert "\n" not in str(caught.value)
