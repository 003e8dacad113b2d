"""What every time-stepper must satisfy, whatever it is made of.

A stepper joins with one line in ``STEPPERS``: a factory that takes the space dimension and
returns a module from ``Features`` to normalised accelerations (q d).
"""

from collections.abc import Callable
from dataclasses import fields

import pytest
import safetensors.torch
import torch
from torch import nn

from giorom.baselines import BaselineConfig, NetworkShape, build_baseline
from giorom.baselines.choice import settings_type
from giorom.features import Features
from giorom.time_stepper import TimeStepper, TimeStepperConfig

SMALL = {
    "hidden": 16,
    "latent_side": 5,
    "latent_width": 8,
    "gno_in_hidden": [8, 8],
    "gno_out_hidden": [8, 8],
    "transformer_width": 16,
    "heads": 2,
}


def giorom(dimension: int, **overrides: object) -> TimeStepper:
    """The recommended model, small."""
    bounds = [[-0.1, 1.1]] * dimension
    config = TimeStepperConfig.default(dimension, latent_bounds=bounds, **(SMALL | overrides))
    return TimeStepper(config)


def published(dimension: int) -> TimeStepper:
    """The published variant, small, with a grid that reaches every particle."""
    bounds = [[0.0, 1.0]] * dimension
    config = TimeStepperConfig.paper(
        dimension, latent_bounds=bounds, **(SMALL | {"latent_radius": 0.25})
    )
    return TimeStepper(config)


def without_grid(dimension: int) -> TimeStepper:
    """Message passing alone."""
    return giorom(dimension, latent=False)


def first_version(dimension: int) -> TimeStepper:
    """A Fourier operator on the grid, for 3-D bodies on a plane; no skip, accelerations sent."""
    return giorom(
        dimension,
        processor="fourier_plane" if dimension == 3 else "fourier",
        fourier_modes=4,
        fourier_width=8,
        fourier_hidden=8,
        occupied_tokens=False,
        gno_input="acceleration",
        latent_skip=False,
    )


def fourier_alone(dimension: int) -> TimeStepper:
    """Kernel integrals and a native Fourier operator without message passing."""
    return giorom(
        dimension,
        processor="fourier",
        fourier_modes=4,
        fourier_width=8,
        occupied_tokens=False,
        layers_before=0,
        layers_after=0,
    )


def unprocessed(dimension: int) -> TimeStepper:
    """To the grid and back."""
    return giorom(dimension, processor="none")


def two_integrals(dimension: int) -> TimeStepper:
    """A kernel integral over the graph beside each of those to the grid and back, no messages."""
    return giorom(dimension, processor="none", layers_before=0, layers_after=0, gno_layers=2)


def sliced(dimension: int) -> TimeStepper:
    """A transformer of slices on the grid."""
    return giorom(dimension, processor="transolver", slices=5)


def convolved(dimension: int) -> TimeStepper:
    """Convolutions on the grid, which goes beyond the bounds."""
    return giorom(
        dimension,
        processor="convolution",
        convolution_width=8,
        convolution_layers=2,
        occupied_tokens=False,
        latent_padding=0.1,
    )


def baseline(kind: str, **settings: object) -> Callable[[int], nn.Module]:
    """A network of another method, with these settings."""

    def build(dimension: int) -> nn.Module:
        shape = NetworkShape(
            dimension=dimension,
            node_width=7 * dimension,
            edge_width=dimension + 1,
            bounds=[[-0.1, 1.1]] * dimension,
        )
        record = settings_type(kind)(**settings)
        return build_baseline(BaselineConfig(kind=kind, shape=shape, **{kind: record}))

    return build


STEPPERS: dict[str, Callable[[int], nn.Module]] = {
    "giorom": giorom,
    "published": published,
    "without_grid": without_grid,
    "first_version": first_version,
    "fourier_alone": fourier_alone,
    "unprocessed": unprocessed,
    "two_integrals": two_integrals,
    "sliced": sliced,
    "convolved": convolved,
    "gnot": baseline("gnot", width=16, layers=2, heads=2),
    "ipot": baseline("ipot", width=16, latents=6, bands=3, heads=2, cross_heads=2),
    "ipot_query": baseline("ipot", width=20, latents=6, bands=3, heads=4, query_features=True),
    "transolver": baseline("transolver", width=16, layers=2, slices=5),
    "operator": baseline("operator", width=16, layers=2),
}

TRANSLATION_INVARIANT = {"without_grid"}
"""Steppers that never read a position. The others read where a particle is in the latent grid,
which is fixed in the domain: a translation of the body alone is a different input to them."""


@pytest.fixture(params=[f"{name}-{d}d" for name in STEPPERS for d in (2, 3)])
def case(request: pytest.FixtureRequest) -> tuple[str, int]:
    """Name of the stepper and space dimension."""
    name, dimension = request.param.split("-")
    return name, int(dimension[0])


@pytest.fixture
def dimension(case: tuple[str, int]) -> int:
    """Space dimension."""
    return case[1]


@pytest.fixture
def stepper(case: tuple[str, int]) -> nn.Module:
    """A stepper in float64."""
    name, dimension = case
    torch.manual_seed(0)
    return STEPPERS[name](dimension).double().eval()


def test_permuting_the_particles_permutes_the_accelerations(
    stepper, dimension, random_features, make_features
):
    """The samples are a set: f(P x) = P f(x), up to the order of the sums."""
    features = random_features([40], dimension=dimension)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    permuted = make_features(
        features.position[order],
        features.node[order],
        features.particle_type[order],
        features.batch,
    )
    torch.testing.assert_close(stepper(permuted), stepper(features)[order], rtol=0, atol=1e-11)


def test_a_scene_does_not_feel_the_others_of_its_batch(
    stepper, dimension, random_features, make_features
):
    """f(A and B) = f(A) and f(B): scenes overlap in space and must not mix (spec bug B1)."""
    both = random_features([30, 17, 25], dimension=dimension)
    alone = []
    for scene in range(3):
        own = both.batch == scene
        features = make_features(
            both.position[own], both.node[own], both.particle_type[own], both.batch[own] * 0
        )
        alone.append(stepper(features))
    torch.testing.assert_close(stepper(both), torch.cat(alone), rtol=0, atol=1e-11)


def test_a_translation_changes_nothing_where_no_position_is_read(
    case, stepper, dimension, random_features, make_features
):
    """f(x + c) = f(x), for the steppers that claim it."""
    if case[0] not in TRANSLATION_INVARIANT:
        pytest.skip("reads the place in the latent grid")
    features = random_features([40], dimension=dimension)
    moved = make_features(
        features.position + 0.25, features.node, features.particle_type, features.batch
    )
    torch.testing.assert_close(stepper(moved), stepper(features), rtol=0, atol=1e-11)


def test_lonely_particles_and_scenes_give_finite_numbers(
    stepper, dimension, random_features, make_features
):
    """No neighbour, no grid node in reach, a scene of one: empty means are zero, not 0/0."""
    features = random_features([20, 1, 1], dimension=dimension)
    position = features.position.clone()
    position[0], position[20] = 40.0, -30.0
    lonely = make_features(position, features.node, features.particle_type, features.batch)
    acceleration = stepper(lonely)
    acceleration.square().sum().backward()
    assert acceleration.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in stepper.parameters())


def test_gradients_are_finite_and_reach_every_parameter(stepper, dimension, random_features):
    """No parameter is dead (spec: 45 % of the official ones are)."""
    stepper(random_features([30, 20], dimension=dimension)).square().sum().backward()
    for name, parameter in stepper.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_saved_and_loaded_weights_give_the_same_accelerations(
    case, stepper, dimension, random_features, tmp_path
):
    """The state dict is the whole model."""
    features = random_features([30], dimension=dimension)
    safetensors.torch.save_file(stepper.state_dict(), tmp_path / "weights.safetensors")
    torch.manual_seed(1)
    other = STEPPERS[case[0]](dimension).double().eval()
    other.load_state_dict(safetensors.torch.load_file(tmp_path / "weights.safetensors"))
    torch.testing.assert_close(other(features), stepper(features), rtol=0, atol=0)


def test_the_input_is_not_changed(stepper, dimension, random_features):
    """Two draws from one seed are equal; one is used, and must stay equal to the other."""
    used, kept = (random_features([30], dimension=dimension) for _ in range(2))
    stepper(used).sum().backward()
    for name in (item.name for item in fields(Features)):
        if name not in ("edges", "batch_size"):
            torch.testing.assert_close(getattr(used, name), getattr(kept, name), rtol=0, atol=0)
    torch.testing.assert_close(used.edges.sender, kept.edges.sender, rtol=0, atol=0)
    torch.testing.assert_close(used.edges.offset, kept.edges.offset, rtol=0, atol=0)


def test_the_output_has_the_precision_of_the_input(stepper, dimension, random_features):
    """Single precision differs from double by rounding (1e-7 times the depth) and no more."""
    double = stepper(random_features([30], dimension=dimension))
    single = stepper.float()(random_features([30], dimension=dimension, dtype=torch.float32))
    assert double.shape == single.shape == (30, dimension)
    assert (double.dtype, single.dtype) == (torch.float64, torch.float32)
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4)


def test_autocast_is_close_to_single_precision(stepper, dimension, random_features):
    """bfloat16 keeps 8 bits: a few per cent of the spread of the output, with gradients."""
    features = random_features([30, 20], dimension=dimension, dtype=torch.float32)
    single = stepper.float()(features)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = stepper(features)
    mixed.float().square().sum().backward()
    assert ((mixed - single).square().mean() / single.square().mean()).sqrt() < 0.1
    assert all(parameter.grad.isfinite().all() for parameter in stepper.parameters())


def test_repeating_a_step_repeats_every_bit(stepper, dimension, random_features):
    """On the CPU sums run in a fixed order, forwards and backwards."""
    features = random_features([30, 20], dimension=dimension, dtype=torch.float32)
    runs = []
    for _ in range(2):
        stepper.float().zero_grad()
        output = stepper(features)
        output.square().sum().backward()
        runs.append([output.detach(), *(p.grad.clone() for p in stepper.parameters())])
    assert all(torch.equal(first, second) for first, second in zip(*runs, strict=True))
