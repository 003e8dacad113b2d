"""What the tables of times measure is what they say: graphs, memory, processes, units."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.distance import cdist, pdist

from giorom.data.trajectory_file import read_trajectory, write_trajectory_file
from giorom.evaluation.fresh_process import call_afresh
from giorom.evaluation.stage_speed import (
    DecodeCase,
    StepCase,
    measure_decode,
    measure_step,
    states_of,
)
from giorom.reproduce.timing import equal_degree_radius
from giorom.reproduce.timing_table import compare_with_paper, step_row, upscale_seconds


@pytest.fixture(scope="module")
def trajectory(data_folder):
    """A motion of the tiny data set."""
    return read_trajectory(data_folder, "test", 0)


@pytest.fixture
def step_case(run_folder, trajectory, tmp_path):
    """A step of forty samples of it."""
    path = tmp_path / "motion.h5"
    write_trajectory_file(trajectory.subset(torch.arange(0, 80, 2)), path)
    return StepCase(
        simulator=run_folder,
        motion=path,
        radius=0.11,
        steps=4,
        seconds=60.0,
        threads=1,
        device="cpu",
    )


def test_the_graph_that_is_timed_has_the_edges_of_a_distance_matrix(step_case, trajectory):
    """Ordered pairs of different points within the radius, counted by SciPy.

    The graph of this model is that of the undeformed body.
    """
    found = measure_step(step_case)
    points = trajectory.position[0, 0:80:2].double().numpy()
    assert found["edges"] == 2 * int((pdist(points) <= 0.11).sum())
    assert (found["points"], found["steps_timed"]) == (40, 4)
    stages = [found[f"{name}_seconds"] for name in ("graph", "network", "integration")]
    assert all(seconds > 0.0 for seconds in stages)
    assert found["step_seconds_min"] <= found["step_seconds"] <= found["step_seconds_max"]
    row = step_row("any", found)
    assert row["degree"] == pytest.approx(found["edges"] / 40)
    assert row["seconds"] == pytest.approx(200 * found["step_seconds"])


def test_timed_steps_start_from_frames_of_the_motion_spread_over_all_of_it(trajectory):
    """First and last state are those of the first and last frame with a past and a next one."""
    states = states_of(trajectory, history=3, count=4)
    assert len(states) == 4
    assert torch.equal(states[0].history.transpose(0, 1), trajectory.position[0:3])
    assert torch.equal(states[-1].position, trajectory.position[-2])
    assert len(states_of(trajectory, history=3, count=1000)) == trajectory.frame_count - 3


def test_a_recovery_is_timed_over_all_frames(run_folder, trajectory, tmp_path):
    """Two hundred frames cost the binding once and every frame its share."""
    tensors = {
        "reference": trajectory.position[0, :40],
        "query": trajectory.position[0],
        "position": trajectory.position[1:5, :40],
        "bounds": trajectory.bounds,
    }
    tensors = {name: value.clone() for name, value in tensors.items()}
    save_file(tensors, tmp_path / "body.safetensors")
    case = DecodeCase(
        simulator=run_folder, body=tmp_path / "body.safetensors", threads=1, device="cpu"
    )
    found = measure_decode(case)
    assert (found["frames"], found["sparse_points"]) == (4, 40)
    assert found["points"] == trajectory.position.shape[1]
    whole = found["bind_seconds"] + 50 * found["decode_seconds"]
    assert upscale_seconds(found) == pytest.approx(whole)


HELD = """
import torch
from giorom.evaluation.memory import peak_memory
def hold(times):
    for _ in range(times):
        torch.ones((1 << 26) // 4)
for work in (lambda: None, lambda: hold(1), lambda: hold(2)):
    print(peak_memory(work, device="cpu")[1])
"""
"""Measured alone: memory that an earlier test gave back would be taken again unseen."""


def test_the_peak_is_the_size_of_what_was_held_even_if_it_is_given_back():
    """A tensor of 64 MiB is 64 MiB, two after each other no more, no tensor next to nothing."""
    size = 1 << 26
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    printed = subprocess.run(  # noqa: S603
        [sys.executable, "-c", HELD], capture_output=True, text=True, check=True, env=environment
    ).stdout
    nothing, once, twice = map(int, printed.split())
    assert nothing < size // 16
    assert size * 0.95 < once < size * 1.25
    assert size * 0.95 < twice < size * 1.25


def test_a_fresh_process_gives_its_result_or_says_why_there_is_none():
    """The absolute value of -3 is 3; a process that ends itself with code 7 says so."""
    assert call_afresh(abs, -3) == 3
    with pytest.raises(RuntimeError, match="ValueError: invalid literal"):
        call_afresh(int, "three")
    with pytest.raises(RuntimeError, match=r"was ended \(code 7\)"):
        call_afresh(os._exit, 7)


def test_eight_times_fewer_points_have_as_many_neighbors_at_twice_the_radius():
    """Counted by SciPy in the middle of a box of random points, within three standard errors."""
    assert equal_degree_radius(0.05, points=1000, instead_of=8000) == pytest.approx(0.1)
    generator = np.random.default_rng(0)
    degrees, errors = [], []
    for count, radius in ((8000, 0.1), (1000, equal_degree_radius(0.1, points=1, instead_of=8))):
        points = generator.random((count, 3))
        middle = points[(np.abs(points - 0.5) < 0.5 - radius).all(axis=1)]
        neighbors = (cdist(middle, points) <= radius).sum(axis=1) - 1
        degrees.append(neighbors.mean())
        # Neighbouring balls share points: as many independent ones as fit into the middle.
        balls = (1.0 - 2.0 * radius) ** 3 / (4.0 / 3.0 * np.pi * radius**3)
        errors.append((neighbors.mean() / balls) ** 0.5)
    assert abs(degrees[0] - degrees[1]) < 3.0 * np.hypot(*errors)


def test_times_are_compared_in_units_of_the_papers_network():
    """A method twice as slow as ours and ten times as slow as the paper's row says both."""
    rows = [
        {"method": "paper", "points": 5, "seconds": 2.0},
        {"method": "gns", "points": 5, "seconds": 4.0},
        {"method": "default", "points": 5, "seconds": 1.0},
    ]
    compare_with_paper(rows, {5: {"paper": 0.2, "gns": 0.4}}, by="points")
    assert [row["ratio"] for row in rows] == [pytest.approx(10.0), pytest.approx(10.0), None]
    assert [row["times_papers_network"] for row in rows] == [1.0, 2.0, 0.5]
    assert [row["paper_times_papers_network"] for row in rows] == [1.0, 2.0, None]
