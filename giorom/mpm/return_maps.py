r"""Return maps: how much of a trial strain a plastic material keeps.

They act on the principal logarithmic strains ``e_i = ln s_i`` of the elastic deformation,
``s_i^2`` the eigenvalues of ``b = F_e F_e^T``, one axis per dimension. With the Hencky energy
stress and strain share their axes and ``tau_i = 2 mu e_i + lambda tr e``, so each map has a
closed form. ``dev e = e - tr(e) / d`` and ``|.|`` is the Euclidean norm.

In two dimensions, plane strain, the deviator is that of the plane: once a plane flow is fully
developed the elastic strain out of plane is the mean of the two in it, and both deviators agree.

The float64 reference of the kernels' laws in ``device_laws.py``. Strains have no unit; time in s.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST_STRETCH = 0.05
"""Principal stretches are not taken below this, so that their logarithm stays finite."""


def principal_stretches(
    b: Float[Tensor, "*n d d"],
) -> tuple[Float[Tensor, "*n d"], Float[Tensor, "*n d d"]]:
    """Principal stretches ``s`` and axes (columns) of ``b = V diag(s^2) V^T``."""
    square, axes = torch.linalg.eigh(b)
    return square.clamp_min(SMALLEST_STRETCH**2).sqrt(), axes


def from_principal_strains(
    strain: Float[Tensor, "*n d"], axes: Float[Tensor, "*n d d"]
) -> Float[Tensor, "*n d d"]:
    """``b = V diag(exp(2 e)) V^T`` of logarithmic strains and axes (columns)."""
    return (axes * torch.exp(2.0 * strain)[..., None, :]) @ axes.mT


def viscoplastic_map(
    strain: Float[Tensor, "*n d"], *, yield_strain: float, relaxation_time: float, substep_dt: float
) -> Float[Tensor, "*n d"]:
    r"""Von Mises flow with Perzyna's linear overstress, one implicit Euler step.

    A Bingham body flows once its deviatoric stress ``s = 2 mu dev e`` passes the yield stress,
    at a rate that grows with the excess, ``eta`` being the plastic viscosity:

    .. math::
        \dot e^p = \frac{\langle |s| - \sigma_y \rangle}{2 \eta} \frac{s}{|s|}.

    The trial strain carries the whole strain of the step, so the backward difference reads
    ``dev e' = dev e - dt e^p(e')``. The flow is along the deviator and keeps its direction,
    which leaves one linear equation for its length; with ``r = |dev e| - yield_strain``,
    ``yield_strain = sigma_y / (2 mu)`` and ``T = eta / mu``:

    .. math::
        r' = r - \frac{\Delta t}{T} r' \;\Rightarrow\; r' = \frac{r}{1 + \Delta t / T}, \qquad
        |dev\, e| - |dev\, e'| = \frac{\Delta t}{\Delta t + T}\, r .

    ``T = 0`` is rate-independent von Mises plasticity, ``T -> inf`` elasticity. A held shear
    strain relaxes to the yield surface as ``(1 + dt/T)^-n``, which converges to ``exp(-t/T)``
    with first order. In steady flow ``|s| = sigma_y + 2 eta |D|``, Bingham's law.

    Args:
        strain: Trial principal logarithmic strains.
        yield_strain: ``sigma_y / (2 mu)``, where ``|dev tau| = sigma_y``.
        relaxation_time: ``T = eta / mu``; 0 for von Mises [s].
        substep_dt: Time step [s].

    Returns:
        Principal strains with the trace of the trial ones.

    Source:
        The von Mises map: Gao et al., "An Adaptive Generalized Interpolation Material Point
        Method for Simulating Elastoplastic Materials", ACM TOG 2017. Overstress: Perzyna,
        "Fundamental Problems in Viscoplasticity", Advances in Applied Mechanics 9, 1966;
        its step is the equation above, solved.
    """
    deviator = strain - strain.mean(-1, keepdim=True)
    length = deviator.norm(dim=-1, keepdim=True)
    share = 1.0 if relaxation_time == 0.0 else substep_dt / (substep_dt + relaxation_time)
    flow = share * (length - yield_strain).clamp_min(0.0)
    return strain - flow * deviator / length.clamp_min(torch.finfo(strain.dtype).tiny)


def sand_map(
    strain: Float[Tensor, "*n d"],
    volume_correction: Float[Tensor, "*n"],
    *,
    slope: float,
    cohesion_strain: float = 0.0,
) -> tuple[Float[Tensor, "*n d"], Float[Tensor, "*n"]]:
    r"""Drucker-Prager: sand slides when shear passes friction and parts when pulled.

    The cone ``|dev tau| + alpha tr tau <= 0`` reads in strains, with the slope
    ``k = alpha (d lambda + 2 mu) / (2 mu)`` and the trace ``t = tr e - d c`` above the
    cohesion strain ``c``:

    .. math::
        |dev\, e| + k\, t \le 0.

    Pulled apart (``t >= 0``) the state goes to the tip ``e = c``; else the deviator alone
    shrinks to the cone. Going to the tip forgets how far the grains came apart, and sand
    would gain volume with each bounce. The ``volume_correction`` v remembers it: ``v / d``
    joins each strain before the map, and afterwards ``v' = v + tr e - tr e'``, so that
    ``v + tr e``, the logarithm of the true volume, is kept by the map.

    Args:
        strain: Trial principal logarithmic strains.
        volume_correction: Logarithm of the volume gained; zeros switch it off.
        slope: ``k``.
        cohesion_strain: ``c``; 0 for dry sand.

    Returns:
        Principal strains on or inside the cone, and the new volume correction.

    Source:
        Klár et al., "Drucker-Prager Elastoplasticity for Sand Animation", ACM TOG 2016;
        volume correction: Tampubolon et al., "Multi-species simulation of porous sand and
        water mixtures", ACM TOG 2017.
    """
    dimension = strain.shape[-1]
    corrected = strain + volume_correction[..., None] / dimension
    trace = corrected.sum(-1, keepdim=True) - dimension * cohesion_strain
    deviator = corrected - corrected.mean(-1, keepdim=True)
    length = deviator.norm(dim=-1, keepdim=True)
    slide = (length + slope * trace).clamp_min(0.0)
    on_cone = corrected - slide * deviator / length.clamp_min(torch.finfo(strain.dtype).tiny)
    kept = torch.where(trace >= 0.0, torch.full_like(corrected, cohesion_strain), on_cone)
    return kept, volume_correction + strain.sum(-1) - kept.sum(-1)


def cone_slope(friction_angle: float, *, dimension: int) -> float:
    r"""``alpha`` of the cone ``|dev tau| + alpha tr tau = 0`` for a friction angle.

    In three dimensions the cone passes through the triaxial-compression edge of the
    Mohr-Coulomb pyramid; in plane strain it is Mohr-Coulomb's law exactly:

    .. math::
        \alpha_3 = \sqrt{\tfrac 2 3}\, \frac{2 \sin\varphi}{3 - \sin\varphi}, \qquad
        \alpha_2 = \frac{\sin\varphi}{\sqrt 2}.

    A circular cone meets the pyramid on one kind of edge alone. In a flow that keeps its volume in
    a plane the same ``alpha_3`` reads ``sin phi_p = 2 sqrt(3) sin phi / (3 - sin phi)``: sand of 31
    degrees acts there like sand of 46 (measured on heaps, docs/verification).

    Args:
        friction_angle: Angle of internal friction [degrees].
        dimension: 2 or 3.
    """
    sine = math.sin(math.radians(friction_angle))
    if dimension == 2:
        return sine / math.sqrt(2.0)
    return math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)
