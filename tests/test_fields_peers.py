"""The fields of other methods: each against the equation or another implementation it follows."""

import pytest
import torch
from scipy.interpolate import NearestNDInterpolator
from torch import Tensor

from giorom.fields import FieldConfig, build_field
from giorom.fields.crom import CodedNetwork, CromConfig, CromField
from giorom.fields.gauss_newton import gauss_newton
from giorom.fields.kernel_rom import KernelRomConfig, KernelRomField
from giorom.fields.nearest import NearestConfig, NearestField
from giorom.fields.neural_basis import NeuralField, NeuralFieldConfig
from giorom.fields.pod import PodConfig, PodField
from giorom.fields.pod_autoencoder import PodAutoencoderConfig, PodAutoencoderField
from giorom.fields.shepard import ShepardConfig, ShepardField
from giorom.state import Trajectory
from giorom.training.field_loop import FieldTrainingConfig, train_field


def cloud(count: int, dimension: int = 2, seed: int = 0) -> Tensor:
    """Random points in the unit box."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=generator, dtype=torch.float64)


def curl(points: Tensor, amount: float) -> Tensor:
    """One family of motions with one coefficient: a curl that is nonlinear in it."""
    angle = amount * (0.5 + points[:, 1:])
    x, y = points[:, :1], points[:, 1:]
    turned = [x * angle.cos() - y * angle.sin(), x * angle.sin() + y * angle.cos()]
    return torch.cat(turned, dim=1)


def motion(points: Tensor, amounts: list[float]) -> Trajectory:
    """A body at rest, then curled by given amounts."""
    moved = [curl(points, amount) for amount in amounts]
    return Trajectory(
        position=torch.stack([points, *moved]),
        particle_type=torch.full((len(points),), 8),
        frame_dt=0.01,
        bounds=torch.tensor([[-9.0, 9.0]] * points.shape[1], dtype=torch.float64),
    )


def parameters(module: torch.nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("same_body", [True, False])
def test_nearest_is_the_interpolator_of_scipy(dimension, same_body):
    """Nearest neighbour of every point among the samples of one body."""
    samples, query = cloud(40, dimension), cloud(300, dimension, seed=1)
    moved = 0.1 * cloud(40, dimension, seed=2)
    expected = NearestNDInterpolator(samples.numpy(), moved.numpy())(query.numpy())
    field = NearestField(NearestConfig(same_body=same_body), dimension=dimension)
    found = field.bind(samples, query)(samples + moved)
    torch.testing.assert_close(found, query + torch.from_numpy(expected), rtol=0, atol=1e-12)


@pytest.mark.parametrize("power", [1.0, 2.0, 3.5])
def test_shepard_is_the_sum_over_the_eight_nearest(power):
    """Sum of u / d^p over sum of 1 / d^p, point by point, by a dense loop."""
    samples, query = cloud(40), cloud(600, seed=1)
    moved = 0.1 * cloud(40, seed=2)
    found = ShepardField(ShepardConfig(power=power), dimension=2).bind(samples, query)
    for point, place in zip(query, found(samples + moved), strict=True):
        distances = sorted((float((point - s).norm()), k) for k, s in enumerate(samples))[:8]
        total = sum(distance**-power for distance, _ in distances)
        expected = sum((d**-power / total) * moved[k] for d, k in distances)
        torch.testing.assert_close(place - point, expected, rtol=0, atol=1e-12)


def test_shepard_gives_a_sample_its_own_displacement():
    """Also where two samples lie at the same place: their mean."""
    samples = cloud(20)
    samples[3] = samples[7]
    moved = 0.1 * cloud(20, seed=2)
    found = ShepardField(ShepardConfig(), dimension=2).bind(samples, samples)(samples + moved)
    expected = moved.clone()
    expected[[3, 7]] = (moved[3] + moved[7]) / 2
    torch.testing.assert_close(found - samples, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("activation", ["elu", "sine"])
def test_the_jacobian_of_the_decoder_is_that_of_automatic_differentiation(activation):
    """The hand-written chain rule against reverse mode."""
    config = CromConfig(latent=5, width=12, depth=3, activation=activation, frequency=3.0)
    network = CodedNetwork(config, dimension=3).double()
    point, code = cloud(7, 3), cloud(1, 5, seed=1)[0]
    value, jacobian = network.linearize(point, code)
    expected = torch.autograd.functional.jacobian(lambda q: network(point, q), code)
    torch.testing.assert_close(value, network(point, code), rtol=0, atol=1e-14)
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-12)


def test_one_gauss_newton_step_solves_a_linear_problem():
    """Without damping the step is the least squares solution, from any start."""
    matrix, target = cloud(20, 4) - 0.5, cloud(20, 1, seed=1)[:, 0]
    found = gauss_newton(
        lambda q: (matrix @ q, matrix), target, cloud(4, 1, seed=3)[:, 0], iterations=1, damping=0.0
    )
    expected = torch.linalg.lstsq(matrix, target[:, None]).solution[:, 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_gauss_newton_never_ends_worse_than_it_began():
    """On a function whose undamped step overshoots: atan from far away."""

    def linearize(q: Tensor) -> tuple[Tensor, Tensor]:
        return q.atan(), torch.diag(1.0 / (1.0 + q.square()))

    start = torch.tensor([3.0, -8.0], dtype=torch.float64)
    last = float(start.atan().square().sum())
    for iterations in (1, 2, 5, 40):
        found = gauss_newton(
            linearize, torch.zeros(2).double(), start, iterations=iterations, damping=1e-6
        )
        now = float(found.atan().square().sum())
        assert now <= last
        last = now
    assert last < 1e-20


def test_gauss_newton_keeps_the_start_where_nothing_depends_on_the_code():
    """A Jacobian of zeros gives no step and no error."""
    start = torch.ones(3, dtype=torch.float64)
    zero = torch.zeros(5, 3, dtype=torch.float64)
    found = gauss_newton(
        lambda q: (zero[:, 0], zero), zero[:, 0] + 1, start, iterations=4, damping=0.0
    )
    assert torch.equal(found, start)


def test_the_code_of_a_decoder_linear_in_it_is_recovered_exactly():
    """ELU is the identity above zero: where all are, g(X, q) is linear in q, and q unique."""
    config = CromConfig(latent=2, width=8, depth=2, iterations=1, damping=0.0)
    field = CromField(config, dimension=2).double().requires_grad_(False)
    field.network.place.bias.fill_(50.0)
    for layer in field.network.hidden:
        layer.weight.abs_()
    samples, query = cloud(30), cloud(50, seed=1)
    wanted = torch.tensor([0.3, -0.2], dtype=torch.float64)

    def moved(points: Tensor) -> Tensor:
        point = field.point(points)
        return points + field.network(point, wanted) - field.network(point, 0 * wanted)

    decode = field.bind(samples, query)
    torch.testing.assert_close(decode.code(moved(samples)), wanted, rtol=0, atol=1e-10)
    torch.testing.assert_close(decode(moved(samples)), moved(query), rtol=0, atol=1e-10)


def test_solving_for_the_code_lowers_the_misfit_of_the_encoder():
    """After a short training, at the samples of an unseen amount of a known family."""
    torch.manual_seed(0)
    sizes = {"latent": 4, "width": 24, "depth": 2, "encoder_width": 16}
    field = CromField(CromConfig(**sizes, iterations=8), dimension=2)
    amounts = [0.1 * n for n in range(1, 11)]
    motions = [motion(cloud(200, seed=seed).float(), amounts) for seed in (0, 1)]
    config = FieldTrainingConfig(steps=100, samples=60, queries=100, learning_rate=5e-3)
    train_field(field, motions, config, seed=0, minutes=1.0, report=lambda numbers: None)
    body = cloud(200, seed=5).float()
    truth = curl(body, 0.77)
    errors = []
    for iterations in (0, 8):
        field.config = CromConfig(**sizes, iterations=iterations)
        found = field.bind(body[:60], body)(truth[:60])
        errors.append(float((found - truth).norm() / (truth - body).norm()))
    assert errors[1] < 0.8 * errors[0] < 0.3


def test_centred_pod_is_the_mean_and_the_singular_vectors_of_the_rest():
    """On its own nodes, with as many samples: the projection of the snapshots by an SVD."""
    axis = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
    nodes = torch.cartesian_prod(axis, axis)
    amounts = [0.1 * n for n in range(1, 13)]
    trajectory = motion(nodes, amounts)
    config = PodConfig(modes=3, nodes=25, center=True, ridge=1e-14)
    field = PodField(config, dimension=2).double()
    field.prepare([trajectory])
    # The grid is larger than the body by a thousandth; put it onto the points to compare exactly.
    snapshots = (trajectory.position[1:] - nodes).flatten(1).T
    mean = snapshots.mean(dim=1, keepdim=True)
    left = torch.linalg.svd(snapshots - mean).U[:, :3]
    expected = mean + left @ (left.T @ (snapshots - mean))
    decode = field.bind(nodes, nodes)
    found = torch.stack([decode(p) - nodes for p in trajectory.position[1:]]).flatten(1).T
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3 * float(snapshots.abs().max()))
    # Rank three about the mean leaves less than rank three about zero.
    about_zero = torch.linalg.svdvals(snapshots)[3:].square().sum()
    assert float((expected - snapshots).square().sum()) < float(about_zero)


def test_training_teaches_the_bottleneck_a_motion_it_has_not_seen():
    """Far less error after some steps, on an unseen body and amount of a family of motions."""
    amounts = [0.25 * n for n in range(1, 13)]
    motions = [motion(cloud(120, seed=seed).float(), amounts) for seed in (0, 1)]
    torch.manual_seed(0)
    config = PodAutoencoderConfig(modes=4, latent=2, width=16, nodes=36, snapshots=24)
    field = PodAutoencoderField(config, dimension=2)
    field.prepare(motions)
    body = cloud(120, seed=5).float()
    moved = torch.stack([curl(body, amount) - body for amount in (0.6, 1.3, 1.9)])
    before = float(field.loss(body, moved, solve_count=40).detach())
    training = FieldTrainingConfig(steps=120, samples=40, queries=80, learning_rate=1e-2)
    train_field(field, motions, training, seed=0, minutes=1.0, report=lambda numbers: None)
    assert float(field.loss(body, moved, solve_count=40).detach()) < 0.25 * before


def test_the_published_kernel_smooths_with_a_gaussian_when_its_network_is_silent():
    """exp(-d^2 / 2 s^2) over the sum of it, with s = 0.6 median spacings."""
    field = KernelRomField(KernelRomConfig(neighbors=50), dimension=2).double()
    torch.nn.init.zeros_(field.network[-1].weight)
    samples, query = cloud(50), cloud(1000, seed=1)
    table = (samples[:, None] - samples).norm(dim=2) + 9.0 * torch.eye(50, dtype=torch.float64)
    width = 0.6 * table.amin(dim=1).quantile(0.5, interpolation="midpoint")
    weight = torch.exp(-0.5 * ((query[:, None] - samples).norm(dim=2) / width).square())
    moved = 0.1 * cloud(50, seed=2)
    expected = query + (weight @ moved) / weight.sum(dim=1, keepdim=True)
    found = field.bind(samples, query)(samples + moved).detach()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("network", "count"),
    [
        # Last biases, which the subtraction of the body at rest cancels, are left out: 3 of each.
        (lambda: CodedNetwork(CromConfig.published(), dimension=3), 4113 - 3),
        (lambda: CodedNetwork(CromConfig(width=60), dimension=3), 16983 - 3),
        (lambda: CodedNetwork(CromConfig(), dimension=3), 71043 - 3),
        (lambda: KernelRomField(KernelRomConfig(), dimension=3), 5967 - 3),
        (lambda: NeuralField(NeuralFieldConfig(), dimension=3), 18540),
        (lambda: build_field(FieldConfig(kind="shepard"), dimension=3), 0),
        (lambda: build_field(FieldConfig(kind="nearest"), dimension=3), 0),
    ],
)
def test_networks_have_the_published_number_of_parameters(network, count):
    """CROM with 6 x 30, 32 x 60 and 32 x 128; the kernel of the third version; LiCROM 20 x 60."""
    assert parameters(network()) == count


@pytest.mark.parametrize(
    ("record", "values", "message"),
    [
        (ShepardConfig, {"neighbors": 0}, "neighbors must be >= 1, got 0"),
        (ShepardConfig, {"power": 0.0}, "power must be > 0, got 0"),
        (CromConfig, {"latent": 0}, "latent must be >= 1, got 0"),
        (CromConfig, {"iterations": -1}, "iterations must be >= 0"),
        (CromConfig, {"frequency": 0.0}, "frequency must be > 0"),
        (KernelRomConfig, {"width": 0.0}, "width must be > 0"),
        (KernelRomConfig, {"octaves": 0}, "octaves must be >= 1"),
        (PodAutoencoderConfig, {"width": 0}, "width must be >= 1"),
        (PodAutoencoderConfig, {"nodes": 1}, "nodes must be >= 8"),
    ],
)
def test_sizes_no_field_can_be_built_with_are_refused(record, values, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        record(**values)
