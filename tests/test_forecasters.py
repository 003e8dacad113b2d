"""Latent forecasters: their networks by formula, their codes, and motions with a known law."""

import math

import pytest
import torch
from torch import Tensor

from giorom.forecasters import (
    CoralConfig,
    CoralField,
    DinoConfig,
    DinoField,
    DynamicsConfig,
    ForecasterConfig,
    ForecasterTrainingConfig,
    LatentDynamics,
    LatentForecaster,
    gather_motions,
    train_forecaster,
)
from giorom.state import Trajectory

OMEGA = 0.3
"""Angle of the oscillation from frame to frame."""


def parameters(module: torch.nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def cloud(count: int, dimension: int = 2, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator)


def swing(seed: int, frames: int = 30) -> Trajectory:
    """A body that swings about its undeformed state, in a shape that is not affine, by any size."""
    size = 2.0 * float(torch.rand((), generator=torch.Generator().manual_seed(seed))) - 1.0
    body = cloud(150, seed=seed)
    shape = torch.stack([body[:, 1].square(), 0.3 * body[:, 0] * body[:, 1]], dim=1)
    amount = [0.3 * size * math.sin(OMEGA * frame) for frame in range(frames)]
    return Trajectory(
        position=torch.stack([body + a * shape for a in amount]),
        particle_type=torch.full((150,), 8),
        frame_dt=0.01,
        bounds=torch.tensor([[-1.0, 2.0]] * 2),
    )


def small(kind: str) -> ForecasterConfig:
    """Sizes that train in a second."""
    return ForecasterConfig(
        kind=kind,
        dino=DinoConfig(code=6, width=24, layers=2, frequency=3.0, fit_rate=3e-2),
        coral=CoralConfig(code=6, width=24, layers=2, frequency=3.0),
        dynamics=DynamicsConfig(width=32, depth=2),
    )


@pytest.fixture(scope="module", params=["dino", "coral"])
def trained(request: pytest.FixtureRequest) -> tuple[LatentForecaster, dict]:
    """A forecaster that has seen some swings."""
    torch.manual_seed(0)
    forecaster = LatentForecaster(small(request.param), dimension=2)
    motions = gather_motions([swing(n) for n in range(8)], first=1, points=60, frames=12, seed=0)
    config = ForecasterTrainingConfig(points=30, code_rate=3e-2, field_rate=1e-2)
    result = train_forecaster(forecaster, motions, config, seed=0, steps=500)
    return forecaster.requires_grad_(False), result


@pytest.mark.parametrize(
    ("network", "count"),
    [
        (lambda: DinoField(DinoConfig.published(), dimension=2, states=1), 38593),
        (lambda: CoralField(CoralConfig.published(), dimension=3, states=3), 33923 + 49536),
        (lambda: LatentDynamics(DynamicsConfig.published(), code=100, context=0), 628327),
        # CORAL's swish has no learned factor: three numbers fewer.
        (lambda: LatentDynamics(DynamicsConfig.published(), code=256, context=0), 788224 + 3),
    ],
)
def test_networks_have_the_published_number_of_parameters(network, count):
    """Field and equation of DINo (Navier-Stokes) and of CORAL (Navier-Stokes, shallow water)."""
    assert parameters(network()) == count


def test_the_filter_network_is_the_product_of_shifted_waves():
    """h_l = f_l (B_l h_{l-1} + b_l + A_l c), point by point and without batches."""
    config = DinoConfig(code=3, width=8, layers=2)
    field = DinoField(config, dimension=2, states=4).double().requires_grad_(False)
    point, code = cloud(5).double(), cloud(2, 3, seed=1).double()
    found = field(point.expand(2, -1, -1), code)
    for n, p in ((0, 0), (1, 4)):
        value = field.first
        for level in range(3):
            angle = field.filters[level].weight @ point[p] + field.filters[level].bias
            wave = torch.cat([angle.sin(), angle.cos()])
            if level > 0:
                mixer = field.mixers[level - 1]
                value = mixer.weight @ value + mixer.bias
            value = wave * (value + field.shifts[level].weight @ code[n])
        expected = field.output.weight @ value + field.output.bias
        torch.testing.assert_close(found[n, p], expected, rtol=1e-12, atol=1e-12)


def test_the_network_of_sines_is_shifted_in_every_layer():
    """h_l = sin(w (W_l h_{l-1} + b_l + S_l z))."""
    config = CoralConfig(code=3, width=4, layers=2, frequency=2.0)
    field = CoralField(config, dimension=2, states=4).double().requires_grad_(False)
    point, code = cloud(1).double(), cloud(1, 3, seed=1).double()
    shift = field.shift.weight @ code[0] + field.shift.bias
    value = point[0]
    for layer, part in zip(field.hidden, shift.split(4), strict=True):
        value = torch.sin(2.0 * (layer.weight @ value + layer.bias + part))
    expected = field.output.weight @ value + field.output.bias
    torch.testing.assert_close(field(point[None], code)[0, 0], expected, rtol=1e-12, atol=1e-12)


def test_a_code_that_made_a_frame_is_found_again_in_what_it_makes():
    """The fitted code of a frame of the network's own reproduces it; codes need not be unique."""
    torch.manual_seed(0)
    config = DinoConfig(code=4, width=16, layers=1, frequency=3.0, fit_rate=3e-2, fit_steps=400)
    field = DinoField(config, dimension=2, states=4).requires_grad_(False)
    point, code = cloud(60).expand(3, -1, -1), 0.5 * torch.randn(3, 4)
    state = field(point, code)
    error = field(point, field.fit(point, state)) - state
    scale = (state - field(point, torch.zeros(3, 4))).norm()
    assert float(error.norm() / scale) < 0.02


def test_codes_of_frames_fitted_together_are_those_fitted_alone(trained):
    """Frames do not see each other, and the points of a frame are a set."""
    field = trained[0].field
    point, state = cloud(20).expand(3, -1, -1), torch.randn(3, 20, 4)
    order = torch.randperm(20)
    together = field.fit(point, state)
    alone = field.fit(point[1:2, order], state[1:2, order])
    torch.testing.assert_close(together[1:2], alone, rtol=1e-3, atol=1e-3)


def test_the_equation_of_an_oscillator_is_integrated_to_fourth_order():
    """Half the step of classical Runge-Kutta, a sixteenth of the error: z'' = -z against cosine."""

    class Oscillator(LatentDynamics):
        def forward(self, code, context):
            return torch.stack([code[:, 1], -code[:, 0]], dim=1)

    law = Oscillator(DynamicsConfig(width=1, depth=1), code=2, context=0).double()
    start, context = torch.tensor([[1.0, 0.0]]).double(), torch.zeros(1, 0).double()
    errors = []
    for steps in (20, 40):
        times = torch.linspace(0.0, 6.0, steps + 1, dtype=torch.float64)
        found = law.integrate(start, context, times)[:, 0]
        exact = torch.stack([times.cos(), -times.sin()], dim=1)
        errors.append(float((found - exact).abs().max()))
    assert errors[0] < 5e-3
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.15)


def test_an_unseen_swing_is_forecast_from_its_first_frames(trained):
    """Samples of frames 0 and 1 in, 28 frames of all points out: a known law of one coefficient."""
    forecaster, result = trained
    assert result["steps"] == 500
    wrong = moved = 0.0
    for seed in (20, 21, 22, 23):
        truth = swing(seed)
        body = truth.position[0]
        found = forecaster.forecast(body[:40], truth.position[:2, :40], body, frames=28)
        assert found.shape == (28, 150, 2)
        wrong += float((found - truth.position[2:]).square().sum())
        moved += float((truth.position[2:] - body).square().sum())
    assert (wrong / moved) ** 0.5 < 0.4


def test_the_field_alone_describes_frames_it_has_not_seen(trained):
    """Codes of true frames decoded at other points: the floor of every forecast."""
    forecaster, _ = trained
    truth = swing(20)
    body = truth.position[0]
    code = torch.stack(
        [forecaster.encode(body[:40], truth.position[k - 1 : k + 1, :40]) for k in (5, 9)]
    )
    found = forecaster.decode(code, body)
    error = (found - truth.position[[5, 9]]).norm()
    assert float(error / (truth.position[[5, 9]] - body).norm()) < 0.2


def test_held_points_stay_and_the_input_is_not_changed(trained):
    """To the last bit; the others are forecast as without."""
    truth = swing(20)
    body, given = truth.position[0].clone(), truth.position[:2, :40].clone()
    held = torch.arange(150) % 3 == 0
    free = trained[0].forecast(body[:40], given, body, frames=3)
    fixed = trained[0].forecast(body[:40], given, body, frames=3, held=held)
    assert torch.equal(fixed[:, held], body[held].expand(3, -1, -1))
    assert torch.equal(fixed[:, ~held], free[:, ~held])
    assert torch.equal(body, truth.position[0])
    assert torch.equal(given, truth.position[:2, :40])


def test_motions_hold_displacements_and_steps():
    """Differences from the undeformed body and from the frame before, at evenly spaced frames."""
    trajectories = [swing(seed) for seed in (0, 1)]
    motions = gather_motions(trajectories, first=3, points=10, frames=4, seed=0)
    assert motions.frame.tolist() == [3.0, 12.0, 20.0, 29.0]
    assert motions.stride == pytest.approx(26 / 3)
    for number, trajectory in enumerate(trajectories):
        body = trajectory.position[0]
        rows = [int((body - p).norm(dim=1).argmin()) for p in motions.point[number]]
        now, before = trajectory.position[12, rows], trajectory.position[11, rows]
        assert torch.equal(motions.state[number, 1, :, :2], now - body[rows])
        assert torch.equal(motions.state[number, 1, :, 2:], now - before)


def test_what_cannot_be_forecast_is_refused_in_one_line():
    """Each message names what was found and the remedy."""
    forecaster = LatentForecaster(small("dino"), dimension=2)
    with pytest.raises(ValueError, match="needs two given frames, for the velocity, got 1"):
        forecaster.forecast(cloud(5), cloud(5)[None], cloud(5), frames=3)
    with pytest.raises(ValueError, match="no two frames from frame 29 on"):
        gather_motions([swing(0)], first=29, points=5, frames=3, seed=0)
    motions = gather_motions([swing(0)], first=1, points=5, frames=3, seed=0)
    with pytest.raises(ValueError, match="needs a limit"):
        train_forecaster(forecaster, motions, ForecasterTrainingConfig(), seed=0)


@pytest.mark.parametrize(
    ("record", "values", "message"),
    [
        (DinoConfig, {"width": 7}, "width must be even"),
        (DinoConfig, {"code": 0}, "code must be >= 1, got 0"),
        (CoralConfig, {"frequency": 0.0}, "frequency must be > 0"),
        (CoralConfig, {"layers": 0}, "layers must be >= 1"),
        (DynamicsConfig, {"depth": 0}, "depth must be >= 1"),
        (ForecasterTrainingConfig, {"points": 0}, "points must be > 0"),
    ],
)
def test_sizes_no_forecaster_can_be_built_with_are_refused(record, values, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        record(**values)
