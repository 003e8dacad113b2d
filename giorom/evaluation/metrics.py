"""Errors of predicted motions. Pure functions of positions.

Squared errors are squared Euclidean distances (summed over axes), averaged over particles and
frames, in square metres: the convention of arXiv:2407.03925.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def squared_error_per_frame(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]
) -> Float[Tensor, " t"]:
    """Mean over particles of the squared distance, for each frame [m^2]."""
    return (predicted.double() - truth.double()).square().sum(dim=2).mean(dim=1)


def relative_displacement_error(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]
) -> float:
    """Root of summed squared errors over summed squared displacements from the first frame.

    Unlike a relative error of absolute positions, it does not fall when the domain is moved away
    from the origin, and a body held still scores one.
    """
    motion = (truth.double() - truth[:1].double()).square().sum()
    error = (predicted.double() - truth.double()).square().sum()
    return float((error / motion.clamp_min(1e-300)).sqrt())


def amplitude_ratio(predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]) -> float:
    """Predicted over true root mean square displacement from the first frame.

    One if the body moves as much as it should; below one if the motion has been damped.
    """

    def size(motion: Tensor) -> Tensor:
        return (motion.double() - truth[:1].double()).square().sum().sqrt()

    return float(size(predicted) / size(truth).clamp_min(1e-300))


def displacement_correlation(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]
) -> float:
    """Cosine between predicted and true displacement over all frames: one if in phase."""
    a = (predicted.double() - truth[:1].double()).flatten()
    b = (truth.double() - truth[:1].double()).flatten()
    return float(a @ b / (a.norm() * b.norm()).clamp_min(1e-300))


def centroid_error(predicted: Float[Tensor, "p d"], truth: Float[Tensor, "p d"]) -> float:
    """Distance between the centroids of two clouds [m]."""
    return float((predicted.double().mean(dim=0) - truth.double().mean(dim=0)).norm())


def bounding_box_error(predicted: Float[Tensor, "p d"], truth: Float[Tensor, "p d"]) -> float:
    """Mean distance between corresponding sides of the two bounding boxes [m]."""
    lower = (predicted.double().amin(dim=0) - truth.double().amin(dim=0)).abs()
    upper = (predicted.double().amax(dim=0) - truth.double().amax(dim=0)).abs()
    return float(torch.cat([lower, upper]).mean())
