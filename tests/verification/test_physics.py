"""The physical benchmarks at a size a test can afford; docs/verification has the full ones.

Each reference and tolerance stands in the row that the benchmark measures: a closed form, a
conservation law or a published experiment.
"""

import math

import numpy as np
import pytest

from benchmarks.verification import sand_collapse_3d
from benchmarks.verification.case import Outcome, Row
from benchmarks.verification.cases import CASES
from benchmarks.verification.report import update

HONEST_MISSES = {
    "the same, foremost particle": "a tongue one particle thin has no counterpart in the experiment"
}
"""Quantities that the report marks as missed, and why a test does not ask for them."""


def require_within(outcome: Outcome) -> None:
    """Every quantity within its own tolerance."""
    missed = [
        f"{row.quantity}: {row.measured:.5g}, reference {row.reference:.5g}, {row.tolerance}"
        for row in outcome.rows
        if not row.passed and row.quantity not in HONEST_MISSES
    ]
    assert not missed, "; ".join(missed)


@pytest.mark.parametrize("name", [name for name in CASES if name != "sand_collapse_3d"])
def test_benchmark_is_within_its_tolerances_and_draws_its_figure(name: str):
    """The references of the rows; a figure of more than one colour per axis."""
    outcome = CASES[name].measure(quick=True)
    require_within(outcome)
    figure = CASES[name].draw(outcome)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3].reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 20


def test_plane_angle_of_the_cone_is_that_of_its_stresses():
    """On the cone with no deviator out of plane: sin(phi_p) = (s1 - s2) / |s1 + s2|."""
    from giorom.mpm.return_maps import cone_slope

    slope = cone_slope(31.0, dimension=3)
    pressure = -1.0
    shear = -slope * 3.0 * pressure / math.sqrt(2.0)
    high, low = pressure + shear, pressure - shear
    expected = math.degrees(math.asin((high - low) / abs(high + low)))
    assert abs(sand_collapse_3d.plane_angle(31.0) - expected) < 1e-9
    assert abs(sand_collapse_3d.plane_angle(sand_collapse_3d.triaxial_angle(31.0)) - 31.0) < 1e-9


def test_round_column_runs_further_with_the_friction_of_plane_shear():
    """Less friction, more run-out; Lube 2004 as far as eleven cells to a radius go: -60 %."""
    outcome = sand_collapse_3d.measure(quick=True)
    triaxial, plane = outcome.curves["runs"]
    assert plane["runout"] > triaxial["runout"]
    expected = sand_collapse_3d.lube(1.0)[0]
    for run in (triaxial, plane):
        assert 0.4 * expected < run["runout"] < 1.15 * expected


def test_row_says_what_deviates_and_by_how_much():
    """Deviation relative to the reference, or a difference; bounds at both ends."""
    values = {"quantity": "q", "source": "s", "grid_cells": 8, "particles": 1}
    near = Row(measured=1.02, reference=1.0, lowest=-0.02, highest=0.03, **values)
    assert math.isclose(near.deviation, 0.02)
    assert near.passed
    assert near.tolerance == "-2 to +3 %"
    below = Row(measured=-3.0, reference=-2.0, lowest=-math.inf, highest=0.0, **values)
    assert math.isclose(below.deviation, -0.5)
    assert below.passed
    far = Row(measured=2.0, reference=0.5, lowest=-1.0, highest=1.0, absolute=True, **values)
    assert not far.passed
    assert far.tolerance == "± 1"


def test_report_keeps_other_cases_and_marks_what_missed(tmp_path):
    """One case after the other into the same folder: both in the page, in the usual order."""
    row = {
        "quantity": "height",
        "measured": 1.0,
        "reference": 2.0,
        "source": "a law",
        "deviation": -0.5,
        "absolute": False,
        "tolerance": "± 10 %",
        "passed": False,
        "grid_cells": 8,
        "particles": 10,
        "note": "too few cells",
    }
    common = {"quick": True, "seconds": 1.0, "seed": 0, "processor": "p", "versions": {"v": "1"}}
    for name, passed in (("goop", False), ("elastic_wave", True)):
        rows = [row | {"passed": passed}]
        update(tmp_path, [{"case": name, "rows": rows} | common])
    page = (tmp_path / "README.md").read_text()
    first, second = page.index("## Elastic waves"), page.index("## Yield height of goop")
    assert first < second
    assert "1 of 2 quantities" in page
    assert page.count("**no**") == 2
    assert all(word in page for word in ("too few cells", "goop.png", "elastic_wave.png"))
