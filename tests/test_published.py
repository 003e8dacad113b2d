"""The table of published data sets holds what its own records promise."""

import pytest
import torch

from giorom.data.published import PUBLISHED, PublishedDataset, published_for

ROWS = list(PUBLISHED.values())
PRINTED = [row for row in ROWS if row.statistics is not None]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_every_row_is_complete_in_itself(row: PublishedDataset):
    """One wall pair per axis, known counts below the largest, ids of the GNS convention."""
    assert row.bounds is None or len(row.bounds) == row.dimension
    assert all(0.0 <= low < high <= 1.0 for low, high in row.bounds or ())
    assert all(0 < count <= row.most_particles for count in row.particle_counts)
    assert set(row.particle_types) <= {0, 3, 5, 6, 7}
    assert row.frames >= 300
    assert row.source


@pytest.mark.parametrize("row", PRINTED, ids=lambda row: row.name)
def test_printed_statistics_are_those_of_a_body_that_falls_and_comes_to_rest(
    row: PublishedDataset,
):
    """Mean path down shorter than the box, spreads far above the means, acceleration near zero.

    A frame of free fall adds g dt^2 to the velocity; impacts make the spread of the
    acceleration larger than that, never a tenth of it.
    """
    statistics = row.statistics
    gravity = 9.8 * row.frame_dt**2
    height = 0.8
    assert -height < float(statistics.velocity_mean[1]) * row.frames < 0.0
    assert bool((statistics.velocity_std > statistics.velocity_mean.abs()).all())
    assert bool((statistics.acceleration_std > gravity / 2.0).all())
    assert bool((statistics.acceleration_mean.abs() < 0.01 * statistics.acceleration_std).all())
    assert statistics.velocity_std.dtype == torch.float64


def test_systems_find_the_sets_they_imitate():
    """Both water rows for water; the small preset counts too; jelly imitates none."""
    assert [row.name for row in published_for("water2d")] == ["WaterDrop", "WaterDropSample"]
    assert [row.name for row in published_for("sand2d-small")] == ["Sand"]
    assert published_for("jelly3d") == []
