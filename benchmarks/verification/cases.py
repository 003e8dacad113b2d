"""Every benchmark, in the order of the report."""

from benchmarks.verification import (
    cantilever,
    contact,
    dam_break,
    elastic_wave,
    energy,
    goop,
    hydrostatics,
    repose,
    sand_collapse,
    sand_collapse_3d,
)
from benchmarks.verification.case import Case

CASES: dict[str, Case] = {
    module.CASE.name: module.CASE
    for module in (
        elastic_wave,
        cantilever,
        hydrostatics,
        dam_break,
        sand_collapse,
        sand_collapse_3d,
        repose,
        goop,
        energy,
        contact,
    )
}
"""By name."""
