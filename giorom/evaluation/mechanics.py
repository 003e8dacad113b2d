"""Whether a predicted motion keeps what mechanics keeps: energy, momentum, volume.

All particles weigh the same, so that energy and momentum are given per mass of the body, and no
mass needs to be known. Velocities are differences of positions between frames. The functions of a
single cloud do not ask which particle is where.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

SMOOTHING = 1.2
"""Smoothing length of the density, in spacings; its kernel reaches twice as far."""


def kinetic_energy(
    position: Float[Tensor, "t p d"], *, frame_dt: float
) -> Float[Tensor, " t_minus_1"]:
    r"""Kinetic energy per mass between consecutive frames [J/kg].

    .. math::
        E_k = \frac{1}{2p} \sum_i \left| \frac{x_i^{k} - x_i^{k-1}}{\Delta t} \right|^2
    """
    velocity = position.double().diff(dim=0) / frame_dt
    return 0.5 * velocity.square().sum(dim=2).mean(dim=1)


def momentum(position: Float[Tensor, "t p d"], *, frame_dt: float) -> Float[Tensor, "t_minus_1 d"]:
    """Momentum per mass between consecutive frames, the velocity of the centroid [m/s]."""
    return position.double().mean(dim=1).diff(dim=0) / frame_dt


def kinetic_energy_mse(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"], *, frame_dt: float
) -> float:
    """Mean over frames of the squared difference of kinetic energies per mass [(J/kg)^2]."""
    return float((_energies(predicted, truth, frame_dt)).diff(dim=0).square().mean())


def kinetic_energy_error(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"], *, frame_dt: float
) -> float:
    """Root of summed squared differences of kinetic energy over that of summed squares [-].

    One for a body that is held still; zero for one with the right energy at every time.
    """
    energies = _energies(predicted, truth, frame_dt)
    scale = energies[1].square().sum().clamp_min(1e-300)
    return float((energies.diff(dim=0).square().sum() / scale).sqrt())


def momentum_error(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"], *, frame_dt: float
) -> float:
    """Root mean square over frames of the difference of momenta per mass [m/s]."""
    difference = momentum(predicted, frame_dt=frame_dt) - momentum(truth, frame_dt=frame_dt)
    return float(difference.square().sum(dim=1).mean().sqrt())


def _energies(predicted: Tensor, truth: Tensor, frame_dt: float) -> Float[Tensor, "2 t"]:
    return torch.stack([kinetic_energy(motion, frame_dt=frame_dt) for motion in (predicted, truth)])


def number_density(cloud: Float[Tensor, "p d"], *, spacing: float) -> Float[np.ndarray, " p"]:
    r"""Points per volume at each point, smoothed as in smoothed particle hydrodynamics [m^-d].

    .. math::
        n_i = \sum_j W(|x_i - x_j|, h), \qquad h = 1.2 \cdot \text{spacing},

    with the cubic spline of support 2 h, the point itself included.

    Source:
        Monaghan, "Smoothed particle hydrodynamics", Reports on Progress in Physics 68 (2005).
    """
    points = cloud.detach().to("cpu", torch.float64).numpy()
    length = SMOOTHING * spacing
    pairs = cKDTree(points).query_pairs(2.0 * length, output_type="ndarray")
    distance = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    value = _cubic_spline(distance / length)
    count = len(points)
    total = np.full(count, float(_cubic_spline(np.zeros(1))[0]))
    for end in (0, 1):
        total += np.bincount(pairs[:, end], weights=value, minlength=count)
    return total * spline_height(points.shape[1]) / length ** points.shape[1]


def spline_height(dimension: int) -> float:
    """Value of the cubic spline of unit smoothing length at its centre; its integral is one."""
    return {2: 10.0 / (7.0 * np.pi), 3: 1.0 / np.pi}[dimension]


def _cubic_spline(ratio: np.ndarray) -> np.ndarray:
    """The cubic spline over its value at the centre."""
    near = 1.0 - 1.5 * ratio**2 + 0.75 * ratio**3
    far = 0.25 * np.clip(2.0 - ratio, 0.0, None) ** 3
    return np.where(ratio < 1.0, near, far)


def density_error(predicted: Float[np.ndarray, " p"], truth: Float[np.ndarray, " p"]) -> float:
    """How far apart two sets of densities are, as distributions, over the true mean [-].

    Mean absolute difference of the sorted values: clumps and collapse both count, and it does not
    matter which particle is where.

    Args:
        predicted: ``number_density`` of the predicted cloud.
        truth: That of the true one, with as many points.
    """
    return float(np.abs(np.sort(predicted) - np.sort(truth)).mean() / truth.mean())


def volume_ratio(predicted: Float[np.ndarray, " p"], truth: Float[np.ndarray, " p"]) -> float:
    """Predicted over true volume, each the sum of the volumes of the points [-].

    Args:
        predicted: ``number_density`` of the predicted cloud; a point fills its inverse.
        truth: That of the true one.
    """
    return float((1.0 / predicted).sum() / (1.0 / truth).sum())


def smallest_distance(cloud: Float[Tensor, "p d"]) -> float:
    """Distance of the two points that are nearest to each other [m]."""
    points = cloud.detach().to("cpu", torch.float64).numpy()
    return float(cKDTree(points).query(points, k=2)[0][:, 1].min())
