"""Constitutive laws: what stress a deformation causes, and which deformation stays.

Every law is isotropic and gives the Kirchhoff stress ``tau = J sigma = P F^T`` (force on
the initial volume), so it depends on ``b = F F^T`` (solids) or ``J = det F`` (fluids) alone.
The float64 reference here is what the simulator's kernels are tested against.

Two dimensions mean plane strain: the third stretch is one (``F_zz = 1``), so invariants are
those of the three-dimensional body and the same constants hold in both dimensions. The yield
surfaces of the plastic laws are those of the plane, see ``giorom.mpm.return_maps``.

SI units: Pa, kg/m^3. This module needs torch alone.
"""

from dataclasses import MISSING, asdict, fields
from typing import Any

from giorom.mpm.materials.base import Solid
from giorom.mpm.materials.elastic import FixedCorotated, StableNeoHookean
from giorom.mpm.materials.fluid import WeaklyCompressibleFluid
from giorom.mpm.materials.plastic import DruckerPragerSand, ViscoplasticGoop, VonMisesPlasticine
from giorom.records import nearest

__all__ = [
    "MATERIALS",
    "DruckerPragerSand",
    "FixedCorotated",
    "Material",
    "Solid",
    "StableNeoHookean",
    "ViscoplasticGoop",
    "VonMisesPlasticine",
    "WeaklyCompressibleFluid",
    "make_material",
    "material_attributes",
]

Material = Solid | WeaklyCompressibleFluid

MATERIALS: dict[str, type[Solid] | type[WeaklyCompressibleFluid]] = {
    law.name: law
    for law in (
        StableNeoHookean,
        FixedCorotated,
        WeaklyCompressibleFluid,
        DruckerPragerSand,
        VonMisesPlasticine,
        ViscoplasticGoop,
    )
}
"""Every material by the name it has in YAML."""


def make_material(name: str, parameters: dict[str, Any]) -> Material:
    """Build a material from its YAML name and parameters.

    Args:
        name: A key of ``MATERIALS``.
        parameters: Field values of that material, SI; fields with a default may be left out.

    Returns:
        The material.

    Raises:
        ValueError: If the name or a parameter is unknown, missing or out of range.
    """
    if name not in MATERIALS:
        raise ValueError(f"there is no material {name!r}. {nearest(name, list(MATERIALS))}")
    known = {field.name: field for field in fields(MATERIALS[name])}
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise ValueError(
            f"material {name} has no parameter {unknown[0]!r}. {nearest(unknown[0], list(known))}"
        )
    missing = [
        key for key, field in known.items() if field.default is MISSING and key not in parameters
    ]
    if missing:
        raise ValueError(
            f"material {name} lacks the parameters {', '.join(missing)}. It takes "
            f"{', '.join(known)}."
        )
    values = {
        key: _value(name, key, value, truth=known[key].type is bool)
        for key, value in parameters.items()
    }
    return MATERIALS[name](**values)


def material_attributes(material: Material) -> dict[str, Any]:
    """Name and parameters of a material as JSON values, keys as in YAML."""
    return {"material": material.name, **asdict(material)}


def _value(name: str, key: str, value: Any, *, truth: bool) -> float | bool:
    """A parameter as its field wants it: a truth value may be written 0 or 1."""
    if truth and value in (0, 1):
        return bool(value)
    if truth or isinstance(value, bool) or not isinstance(value, int | float):
        wanted = "true or false" if truth else "a number"
        raise ValueError(f"material {name}: {key} must be {wanted}, got {value!r}.")
    return float(value)
