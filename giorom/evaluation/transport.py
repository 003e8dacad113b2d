"""Optimal transport between two clouds of points: how far the material has to be carried.

Every point weighs the same, no function asks which particle is where, and all are symmetric in
their two clouds. Exact distances are assignments (SciPy). The Sinkhorn divergence needs POT, of the
extra ``baselines``: of the two libraries for it, POT calls itself stable and has had some thirty
releases by many authors, geomloss calls itself pre-alpha and has had seven. POT's own function for
the divergence compares the transported costs without the entropy, which may become negative; here
its potentials are put into the definition.
"""

import importlib.util
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

MOST_ASSIGNED = 2000
"""Most points that are assigned to each other exactly; the time grows with their cube."""

MOST_TRANSPORTED = 10_000
"""Most points of a Sinkhorn divergence: all pairs are held in memory."""

BLUR = 2.0
"""Square root of the entropic regularisation of squared distances, in spacings."""

TOLERANCE = 1e-6
"""Largest error of the marginals of an entropic plan; the cost is off by its square."""

MOST_ITERATIONS = 2000
"""Most iterations of an entropic plan."""

LARGEST_EXPONENT = 200.0
"""Largest nearest cost over the regularisation that is not yet computed with logarithms."""


def earth_mover_distance(
    first: Float[Tensor, "p d"],
    second: Float[Tensor, "k d"],
    *,
    exponent: Literal[1, 2] = 1,
    spacing: float | None = None,
) -> float:
    r"""Wasserstein distance of two clouds of equal size, exact for few points [m].

    .. math::
        W_n = \min_\sigma \left( \frac{1}{p} \sum_i | x_i - y_{\sigma(i)} |^n \right)^{1/n}.

    Above ``MOST_ASSIGNED`` points it is the root of the Sinkhorn divergence of the same cost.

    Args:
        first: One cloud [m].
        second: The other [m].
        exponent: n; the first power is what is called the earth mover's distance.
        spacing: Distance between neighbours [m], for many points only; by default that of ``first``
            and ``second`` in the mean.

    Raises:
        ValueError: If the clouds have different numbers of points, or too many.
        ModuleNotFoundError: If there are many points and POT is missing.
    """
    if len(first) != len(second):
        raise ValueError(
            f"points are assigned one to one, which needs clouds of equal size; got {len(first)} "
            f"and {len(second)} points. Compare the same points in both."
        )
    if len(first) > MOST_ASSIGNED:
        value = sinkhorn_divergence(first, second, exponent=exponent, spacing=spacing)
        return max(value, 0.0) ** (1.0 / exponent)
    cost = _costs(_array(first), _array(second), exponent)
    return float(cost[linear_sum_assignment(cost)].mean() ** (1.0 / exponent))


def sinkhorn_divergence(
    first: Float[Tensor, "p d"],
    second: Float[Tensor, "k d"],
    *,
    exponent: Literal[1, 2] = 2,
    spacing: float | None = None,
) -> float:
    r"""Debiased entropic transport cost of squared distances [m^2].

    .. math::
        S = \mathrm{OT}_\varepsilon(p, q) - \tfrac12 \mathrm{OT}_\varepsilon(p, p)
            - \tfrac12 \mathrm{OT}_\varepsilon(q, q), \qquad
        \mathrm{OT}_\varepsilon = \min_\pi \langle \pi, C \rangle
            + \varepsilon\, \mathrm{KL}(\pi \,|\, p \otimes q), \qquad
        \varepsilon = (2 \cdot \text{spacing})^n.

    A shift by s costs exactly ``|s|^2``. Squared costs are computed between the centred clouds, and
    the squared distance of the centroids is added: the mixed term of the cost is separable.

    Args:
        first: One cloud [m].
        second: The other [m].
        exponent: n, of the cost ``|x - y|^n``; the result has its unit.
        spacing: Distance between neighbours [m]; by default that of both clouds in the mean. Give
            the same value wherever results are compared.

    Raises:
        ValueError: If there are too many points, or the spacing is not positive.
        ModuleNotFoundError: If POT is missing.

    Source:
        Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences",
        AISTATS 2019.
    """
    largest = max(len(first), len(second))
    if largest > MOST_TRANSPORTED:
        raise ValueError(
            f"a Sinkhorn divergence holds all pairs of at most {MOST_TRANSPORTED} points in "
            f"memory, got {largest}. Compare the samples."
        )
    if spacing is None:
        spacing = 0.5 * (typical_spacing(first) + typical_spacing(second))
    if not spacing > 0.0:
        raise ValueError(f"spacing must be > 0 m, got {spacing!r}.")
    one, two = _array(first), _array(second)
    apart = 0.0
    if exponent == 2:
        apart = float(np.square(one.mean(axis=0) - two.mean(axis=0)).sum())
        one, two = one - one.mean(axis=0), two - two.mean(axis=0)
    epsilon = (BLUR * spacing) ** exponent
    costs = [_entropic_cost(_costs(a, b, exponent), epsilon) for a, b in _pairs(one, two)]
    return costs[0] - 0.5 * costs[1] - 0.5 * costs[2] + apart


def typical_spacing(cloud: Float[Tensor, "p d"]) -> float:
    """Median distance of a point to its nearest neighbour [m]."""
    points = _array(cloud)
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


def has_sinkhorn() -> bool:
    """Whether the library that the Sinkhorn divergence needs is installed."""
    return importlib.util.find_spec("ot") is not None


def _pairs(one: np.ndarray, two: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(one, two), (one, one), (two, two)]


def _array(cloud: Tensor) -> np.ndarray:
    return cloud.detach().to("cpu", torch.float64).numpy()


def _costs(one: np.ndarray, two: np.ndarray, exponent: int) -> np.ndarray:
    return cdist(one, two, "sqeuclidean" if exponent == 2 else "euclidean")


def _entropic_cost(cost: Float[np.ndarray, "p k"], epsilon: float) -> float:
    """Value of the entropic problem, from its potentials.

    At the optimum the two potentials add up to the value, and the plan is
    ``exp(log_u + log_v - C / epsilon)``.
    """
    try:
        import ot
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the Sinkhorn divergence needs POT, which is not installed. "
            "Install it with: pip install 'giorom[baselines]'"
        ) from None
    weights = [np.full(count, 1.0 / count) for count in cost.shape]
    nearest = max(cost.min(axis=0).max(), cost.min(axis=1).max())
    options = {"numItermax": MOST_ITERATIONS, "stopThr": TOLERANCE, "log": True, "warn": False}
    logarithms: list[np.ndarray] | None = None
    if nearest <= LARGEST_EXPONENT * epsilon:
        with np.errstate(all="ignore"):
            _, log = ot.sinkhorn(*weights, cost, epsilon, method="sinkhorn", **options)
            logarithms = [np.log(log["u"]).ravel(), np.log(log["v"]).ravel()]
    if logarithms is None or not all(np.isfinite(part).all() for part in logarithms):
        _, log = ot.sinkhorn(*weights, cost, epsilon, method="sinkhorn_log", **options)
        logarithms = [log["log_u"].ravel(), log["log_v"].ravel()]
    potentials = [part - np.log(own) for part, own in zip(logarithms, weights, strict=True)]
    return float(epsilon * sum(own @ part for own, part in zip(weights, potentials, strict=True)))
