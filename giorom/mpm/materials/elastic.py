r"""Elastic solids: they bear every strain and come back from it. SI units."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.materials.base import Solid, first_invariant, isotropic
from giorom.mpm.return_maps import principal_stretches
from giorom.state import ELASTIC


@dataclass(frozen=True, kw_only=True)
class StableNeoHookean(Solid):
    r"""Stable neo-Hookean solid: stress free at rest, finite when squeezed or inverted.

    .. math::
        \Psi = \frac{\mu_S}{2}(I_C - 3) + \frac{\lambda_S}{2}(J - a)^2
               - \frac{\mu_S}{2}\log(I_C + 1), \qquad
        a = 1 + \frac{3 \mu_S}{4 \lambda_S}.

    Expanded about rest this law has the Lamé constants ``3/4 mu_S`` and
    ``lambda_S - 5/8 mu_S``. So that ``youngs_modulus`` and ``poissons_ratio`` are the moduli
    that a small strain measures, the constants of the law are ``mu_S = 4/3 mu`` and
    ``lambda_S = lambda + 5/6 mu``.

    Source:
        arXiv:2407.03925v2, equations 22-23; Smith, de Goes and Kim, "Stable Neo-Hookean
        Flesh Simulation", ACM TOG 2018, for ``a`` and the change of constants.
    """

    name: ClassVar[str] = "stable_neo_hookean"
    particle_type: ClassVar[int] = ELASTIC

    def law_constants(self, dimension: int) -> tuple[float, float, float]:
        """Constants ``(mu_S [Pa], lambda_S [Pa], a)`` of the energy."""
        del dimension
        mu, lam = self.lame_constants
        mu_s, lam_s = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
        return mu_s, lam_s, 1.0 + 0.75 * mu_s / lam_s

    def energy(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume of ``b = F F^T``, up to a constant [Pa]."""
        mu, lam, a = self.law_constants(b.shape[-1])
        invariant = first_invariant(b)
        volume_ratio = torch.linalg.det(b).sqrt()
        shear = invariant - 3.0 - torch.log(invariant + 1.0)
        return 0.5 * mu * shear + 0.5 * lam * (volume_ratio - a) ** 2

    def kirchhoff_stress(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
        r"""Kirchhoff stress of ``b = F F^T`` [Pa].

        .. math::
            \tau = \mu_S \Big(1 - \frac{1}{I_C + 1}\Big) b + \lambda_S J (J - a) I
        """
        mu, lam, a = self.law_constants(b.shape[-1])
        shear = mu * (1.0 - 1.0 / (first_invariant(b) + 1.0))
        volume_ratio = torch.linalg.det(b).sqrt()
        return shear[..., None, None] * b + isotropic(lam * volume_ratio * (volume_ratio - a), b)


@dataclass(frozen=True, kw_only=True)
class FixedCorotated(Solid):
    r"""Fixed corotated solid: linear in the principal stretches ``s_i``.

    .. math::
        \Psi = \mu \sum_i (s_i - 1)^2 + \frac{\lambda}{2} (J - 1)^2, \qquad
        \tau = 2 \mu (b - \sqrt b) + \lambda J (J - 1) I.

    Source:
        Stomakhin, Howes, Schroeder and Teran, "Energetically Consistent Invertible
        Elasticity", SCA 2012; written in ``b = F F^T``, so that no rotation is needed.
    """

    name: ClassVar[str] = "fixed_corotated"
    particle_type: ClassVar[int] = ELASTIC

    def law_constants(self, dimension: int) -> tuple[float, float]:
        """Constants ``(mu [Pa], lambda [Pa])`` of the energy."""
        del dimension
        return self.lame_constants

    def energy(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume of ``b = F F^T`` [Pa]."""
        mu, lam = self.lame_constants
        stretch, _ = principal_stretches(b)
        volume_ratio = stretch.prod(-1)
        return mu * ((stretch - 1.0) ** 2).sum(-1) + 0.5 * lam * (volume_ratio - 1.0) ** 2

    def kirchhoff_stress(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
        """Kirchhoff stress of ``b = F F^T`` [Pa]."""
        mu, lam = self.lame_constants
        stretch, axes = principal_stretches(b)
        root = (axes * stretch[..., None, :]) @ axes.mT
        volume_ratio = stretch.prod(-1)
        return 2.0 * mu * (b - root) + isotropic(lam * volume_ratio * (volume_ratio - 1.0), b)
