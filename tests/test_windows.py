"""Training windows are slices of trajectories; turning them is a symmetry."""

from dataclasses import replace
from itertools import islice

import pytest
import torch

from giorom.data.windows import (
    SampledTrajectory,
    StepSampler,
    WindowBatch,
    Windows,
    concatenate_windows,
    free_particles,
    sample_trajectories,
    step_generator,
    turn,
)
from giorom.graph import radius_edges
from giorom.sampling import SamplingConfig, sample
from giorom.state import KINEMATIC, SAND, Trajectory

HISTORY, FUTURE = 3, 2


def motion(frames: int, *, dimension: int = 3, particles: int = 12, seed: int = 0) -> Trajectory:
    """Random positions with one kinematic particle; the domain is not centred on zero."""
    generator = torch.Generator().manual_seed(seed)
    shape = (frames, particles, dimension)
    return Trajectory(
        position=1.0 + torch.rand(shape, generator=generator, dtype=torch.float64),
        particle_type=torch.tensor([KINEMATIC] + [SAND] * (particles - 1)),
        frame_dt=0.5,
        bounds=torch.tensor([[0.0, 3.0], [0.0, 2.0], [1.0, 4.0]][:dimension]).double(),
    )


def sampled(frames: list[int], **options: int) -> list[SampledTrajectory]:
    """Trajectories of these lengths with their reference graphs."""
    result = []
    for seed, count in enumerate(frames):
        body = motion(count, seed=seed, **options)
        batch = torch.zeros(body.position.shape[1], dtype=torch.long)
        edges = radius_edges(body.position[0], batch, 0.4)
        result.append(SampledTrajectory(motion=body, reference=body.position[0], edges=edges))
    return result


def windows(frames: list[int], **options: int) -> Windows:
    """Windows of three given and two following frames."""
    return Windows(sampled(frames, **options), history=HISTORY, future=FUTURE)


def batch(count: int, **options: int) -> WindowBatch:
    """The first windows side by side."""
    data = windows([count + HISTORY + FUTURE], **options)
    return concatenate_windows([data[number] for number in range(count)])


def test_running_numbers_cover_every_window_once_in_order():
    """Window k of a trajectory is its frames k to k + history + future - 1."""
    frames = [5, 9, 6]
    data = windows(frames)
    expected = [(which, s) for which, f in enumerate(frames) for s in range(f - 4)]
    assert len(data) == len(expected)
    for number, (which, first) in enumerate(expected):
        window, track = data[number], data.trajectories[which].motion.position
        last = first + HISTORY
        assert torch.equal(window.state.history, track[first:last].transpose(0, 1))
        assert torch.equal(window.target, track[last : last + FUTURE].transpose(0, 1))
        assert torch.equal(window.state.reference, track[0])


@pytest.mark.parametrize("number", [-1, 3])
def test_a_window_that_is_not_there_is_refused(number):
    """Iteration over the data set ends by this error."""
    with pytest.raises(IndexError, match=f"no window {number}; there are 3"):
        windows([7])[number]


@pytest.mark.parametrize("frames", [[], [9, 4]])
def test_too_short_a_trajectory_is_refused(frames):
    """The message says how many frames a window needs."""
    with pytest.raises(ValueError, match=r"needs 3 \+ 2 frames"):
        windows(frames)


def test_windows_side_by_side_keep_scenes_apart():
    """Rows of scene k are window k, and so are its edges, shifted."""
    data = windows([8])
    both = concatenate_windows([data[0], data[3]])
    assert both.state.batch_size == 2
    for scene, number in enumerate((0, 3)):
        own = both.state.batch == scene
        assert torch.equal(both.state.history[own], data[number].state.history)
        assert torch.equal(both.target[own], data[number].target)
    half = len(data[0].edges.sender)
    assert torch.equal(both.edges.sender[half:], data[3].edges.sender + 12)
    assert torch.equal(both.to("cpu").edges.offset, both.edges.offset)


def test_without_a_fixed_graph_a_batch_has_none():
    """Graphs of current positions are built on the fly."""
    data = Windows([replace(t, edges=None) for t in sampled([8])], history=3, future=2)
    joined = concatenate_windows([data[0], data[1]])
    assert joined.edges is joined.to("cpu").edges is None


def test_the_first_subset_is_the_one_that_use_would_take():
    """Farthest points from the centroid; the others start elsewhere. Motion and types follow."""
    body = motion(6, particles=40)
    config = SamplingConfig(reduction=4.0)
    found = sample_trajectories([body], config, subsets=3, reference_radius=0.5)
    assert [t.motion.position.shape for t in found] == [(6, 10, 3)] * 3
    index = sample(body.position[0], config)
    assert torch.equal(found[0].motion.position, body.position[:, index])
    assert torch.equal(found[0].motion.particle_type, body.particle_type[index])
    assert not torch.equal(found[1].motion.position, found[2].motion.position)
    edges = radius_edges(found[1].motion.position[0], torch.zeros(10, dtype=torch.long), 0.5)
    assert torch.equal(found[1].edges.sender, edges.sender)
    none = sample_trajectories([body], config, subsets=1, reference_radius=None)
    assert none[0].edges is None


def test_resumed_sampling_draws_what_an_uninterrupted_run_would():
    """Batches depend on the seed and the step alone."""
    whole = list(islice(StepSampler(50, batch_size=4, seed=7), 10))
    resumed = list(islice(StepSampler(50, batch_size=4, seed=7, first_step=6), 4))
    other = list(islice(StepSampler(50, batch_size=4, seed=8), 10))
    assert resumed == whole[6:]
    assert other != whole
    assert len({tuple(numbers) for numbers in whole}) == 10


def test_every_seed_has_its_own_random_numbers():
    """A hundred seeds at the first and at a late step: no two generators alike."""
    drawn = {
        float(torch.rand((), generator=step_generator(seed, step), dtype=torch.float64))
        for seed in range(100)
        for step in (0, 1, 99_999)
    }
    assert len(drawn) == 300


def test_sampling_draws_every_window_equally():
    """2000 batches of 4 out of 10: each window 800 times, within 4 sigma."""
    drawn = torch.tensor(list(islice(StepSampler(10, batch_size=4, seed=0), 2000))).flatten()
    count = torch.bincount(drawn, minlength=10)
    assert (count - 800).abs().max() < 4 * (8000 * 0.1 * 0.9) ** 0.5


def turned(before: WindowBatch, seed: int = 0) -> WindowBatch:
    """Turned by the random numbers of ``seed``."""
    return turn(before, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("dimension", [2, 3])
def test_turning_keeps_distances_heights_and_the_middle_axis(dimension):
    """A rigid motion about the vertical through the middle of the domain."""
    before = batch(6, dimension=dimension)
    after = turned(before)
    middle = before.state.bounds.mean(dim=1)
    sides = [axis for axis in range(dimension) if axis != 1]
    for old, new in (
        (before.state.history, after.state.history),
        (before.target, after.target),
        (before.state.reference[:, None], after.state.reference[:, None]),
    ):
        torch.testing.assert_close(new[..., 1], old[..., 1], rtol=0, atol=1e-12)
        away_old, away_new = ((x - middle)[..., sides].norm(dim=-1) for x in (old, new))
        torch.testing.assert_close(away_new, away_old, rtol=0, atol=1e-6)
    for scene in range(6):
        own = before.state.batch == scene
        old, new = (
            torch.cat([b.state.history[own, -1], b.target[own, 0]]) for b in (before, after)
        )
        torch.testing.assert_close(torch.pdist(new), torch.pdist(old), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_turning_commutes_with_finite_differences(dimension):
    """The acceleration of the turned motion is the turned acceleration: same map at all frames.

    The linear part is found from the displacements and must be orthogonal, with determinant
    plus or minus one.
    """
    before = batch(6, dimension=dimension)
    after = turned(before)
    for scene in range(6):
        own = before.state.batch == scene
        old, new = (b.state.history[own] for b in (before, after))
        shifted = [(x - x[:1, :1]).flatten(0, 1) for x in (old, new)]
        linear = torch.linalg.lstsq(*shifted).solution
        torch.testing.assert_close(
            linear @ linear.T, torch.eye(dimension).double(), rtol=0, atol=1e-6
        )
        change = [x[:, 2] - 2.0 * x[:, 1] + x[:, 0] for x in (old, new)]
        torch.testing.assert_close(change[0] @ linear, change[1], rtol=0, atol=1e-6)
        torch.testing.assert_close(
            (before.target[own, 1] - before.target[own, 0]) @ linear,
            after.target[own, 1] - after.target[own, 0],
            rtol=0,
            atol=1e-6,
        )


@pytest.mark.parametrize("dimension", [2, 3])
def test_half_of_the_scenes_are_mirrored_and_angles_differ(dimension):
    """Determinants are plus and minus one about equally often; 4 sigma of 200."""
    before = batch(200, dimension=dimension, particles=5)
    after = turned(before)
    old, new = (b.state.history[:, 0].view(200, 5, dimension) for b in (before, after))
    old, new = old[:, 1:] - old[:, :1], new[:, 1:] - new[:, :1]
    linear = torch.linalg.lstsq(old, new).solution
    mirrored = int((torch.linalg.det(linear) < 0).sum())
    assert abs(mirrored - 100) < 4 * (200 * 0.25) ** 0.5
    if dimension == 3:
        assert len(set(linear[:, 0, 0].abs().mul(1e6).round().tolist())) > 150


def test_turning_leaves_the_batch_alone_and_repeats_with_the_seed():
    """Public functions never change what they are given."""
    used, kept = batch(3), batch(3)
    first, again, other = turned(used), turned(used), turned(used, seed=1)
    assert torch.equal(used.state.history, kept.state.history)
    assert torch.equal(used.target, kept.target)
    assert torch.equal(first.target, again.target)
    assert not torch.equal(first.target, other.target)


def test_free_particles_are_those_that_are_not_kinematic():
    """Losses and metrics count these."""
    assert free_particles(batch(2).state).tolist() == [*range(1, 12), *range(13, 24)]


def test_the_past_before_the_first_frame_is_straight():
    """x_(-k) = x_0 - k (x_1 - x_0), and the reference stays the first true frame."""
    body = motion(4)
    config = SamplingConfig(count=12)
    (result,) = sample_trajectories([body], config, subsets=1, reference_radius=None, past=2)
    order = sample(body.position[0], config)
    true = body.position[:, order]
    torch.testing.assert_close(result.motion.position[2:], true, rtol=0.0, atol=0.0)
    velocity = true[1] - true[0]
    torch.testing.assert_close(result.motion.position[0], true[0] - 2.0 * velocity)
    torch.testing.assert_close(result.reference, true[0], rtol=0.0, atol=0.0)
