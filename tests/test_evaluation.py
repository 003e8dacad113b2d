"""Scores: zero for an oracle, closed forms for predictions that need no model."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from giorom.data.trajectory_file import read_trajectory
from giorom.evaluation.evaluate import evaluate_trajectory, one_step_errors, summarize
from giorom.evaluation.metrics import (
    amplitude_ratio,
    displacement_correlation,
    relative_displacement_error,
    squared_error_per_frame,
)
from giorom.evaluation.referee import judge, scene_with_points
from giorom.evaluation.rollout import roll_out
from giorom.evaluation.trivial import constant_velocity, free_fall, hold_still
from giorom.fields import FieldConfig, FieldDecoder
from giorom.integrate import finite_differences
from giorom.mpm import MaterialSwitch, draw_scene, simulate
from giorom.pipeline import connect_within, integrated, start_from_trajectory
from giorom.simulator import Simulator
from giorom.state import KINEMATIC, Trajectory

# Wanted by other programs: the keys of the command line's results.
TRIVIAL = ("constant_velocity_mse", "free_fall_mse", "static_mse")
SCORES = (
    "one_step_mse",
    "rollout_mse",
    "rollout_mse_without_seed_frames",
    "rollout_mse_axis_mean",
    "relative_displacement_error",
    "rollout_mse_at",
    "error_per_frame",
    "clamped_constant_velocity_mse",
    "ballistic_clamped_mse",
    "frozen_shape_mse",
    "static_mse_at",
    "chamfer",
    "density_difference",
    "sliced_wasserstein",
    "final_centroid_error",
    "final_bounding_box_error",
    *TRIVIAL,
)
DEMO = (
    "points",
    "sparse_points",
    "reduction",
    "frames",
    "rollout_mse",
    "projection_floor_mse",
    "seconds_per_frame",
    "solver_seconds_per_frame",
    "speedup",
    *TRIVIAL,
)
ROUNDING = 1e-12
"""Squared float32 rounding of positions of order one [m^2]."""

CONNECT = connect_within(1e-6, configuration="current")


class Oracle(nn.Module):
    """The acceleration that leads to the next true frame."""

    def __init__(self, truth, samples):
        super().__init__()
        self.truth, self.samples = truth, samples

    def forward(self, state, edges):
        """Accelerations of the samples, whatever the graph."""
        following = self.truth[frame_of(self.truth[:, self.samples], state.position) + 1]
        return finite_differences(
            following[self.samples],
            state.position,
            state.history[:, -2],
            frame_dt=state.frame_dt,
        )

    def start(self, state, velocity):
        """The state as it is: the frames say where it stands."""
        return state

    def step(self, state, edges, prescribed=None):
        """The next true frame, by way of the acceleration."""
        return integrated(self)(state, edges, prescribed)


def frame_of(truth, position):
    """The frame of a true motion that a set of positions belongs to."""
    return int((truth - position).square().sum(dim=(1, 2)).argmin())


class OracleDecoder(FieldDecoder):
    """A decoder that knows the answer."""

    def __init__(self, truth, samples):
        super().__init__(truth[0, samples], truth[0])
        self.truth, self.samples = truth, samples

    def recover(self, position):
        """The frame these samples belong to."""
        return self.truth[frame_of(self.truth[:, self.samples], position)]


def make_oracle(simulator, truth):
    """A simulator that knows the answer, for the samples and for the body."""
    samples = simulator.sample(truth[0])
    simulator.dynamics = Oracle(truth, samples)
    simulator.decoder = lambda *_, samples: OracleDecoder(truth, samples)
    return simulator


def accelerated(*, frames=8, held=()):
    """Three particles with constant acceleration, exactly: x = x0 + v t + a t^2 / 2."""
    dt, start = 0.125, torch.tensor([[0.0, 4.0], [1.0, 5.0], [2.0, 6.0]])
    velocity = torch.tensor([[0.5, 0.0], [0.0, 1.0], [-0.5, 0.5]])
    time = dt * torch.arange(frames)[:, None, None]
    position = start + velocity * time + 0.5 * torch.tensor([0.0, -2.0]) * time**2
    kind = torch.full((3,), 8)
    kind[list(held)] = KINEMATIC
    return Trajectory(
        position=position,
        particle_type=kind,
        frame_dt=dt,
        bounds=torch.tensor([[-100.0, 100.0]] * 2),
        attributes={"gravity": 2.0},
    )


def test_trivial_predictions_equal_their_closed_forms():
    """With x_k quadratic, n frames on: still |x_(1+n) - x_1|, straight n (n+1) a dt^2 / 2, fall 0.

    All numbers are dyadic, so that float32 is exact.
    """
    motion = accelerated()
    state = start_from_trajectory(motion, torch.arange(3), history=2)
    truth, n = motion.position[2:], torch.arange(1, 7)
    gravity = torch.tensor([0.0, -2.0])
    assert torch.equal(hold_still(state, 6), motion.position[1].expand(6, -1, -1))
    error = squared_error_per_frame(constant_velocity(state, 6), truth)
    assert torch.equal(error, (n * (n + 1) / 2 * 2.0 * motion.frame_dt**2).double() ** 2)
    assert torch.equal(free_fall(state, 6, gravity=gravity), truth)


def test_trivial_predictions_respect_walls_and_clamps():
    """A particle stops at the wall; a held one stays where it is."""
    motion = replace(accelerated(held=(1,)), bounds=torch.tensor([[-100.0, 0.25], [0.0, 100.0]]))
    motion = replace(motion, position=motion.position - torch.tensor([2.0, 0.0]))
    state = start_from_trajectory(motion, torch.arange(3), history=2)
    for found in (
        constant_velocity(state, 50),
        free_fall(state, 50, gravity=torch.tensor([0.0, -2.0])),
    ):
        assert float(found[:, [0, 2], 0].max()) <= 0.25
        assert float(found[..., 1].min()) >= 0.0
        assert torch.equal(found[:, 1], state.position[1].expand(50, -1))


def test_metrics_are_zero_on_the_identity_and_known_on_a_known_shift():
    """A shift by s has squared error |s|^2; a body held still has relative error one."""
    truth = accelerated().position
    shift = torch.tensor([0.25, -0.5])
    assert float(squared_error_per_frame(truth, truth).max()) == 0.0
    assert torch.equal(
        squared_error_per_frame(truth + shift, truth), torch.full((8,), 0.3125).double()
    )
    still = truth[:1].expand_as(truth)
    assert relative_displacement_error(truth, truth) == 0.0
    assert relative_displacement_error(still, truth) == pytest.approx(1.0)
    half = still + 0.5 * (truth - still)
    assert amplitude_ratio(half, truth) == pytest.approx(0.5)
    assert displacement_correlation(half, truth) == pytest.approx(1.0)
    assert displacement_correlation(2 * still - truth, truth) == pytest.approx(-1.0)


def test_oracle_has_no_error_and_all_keys(simulator, data_folder):
    """True accelerations and a true decoder reproduce the data; floor and one step too."""
    trajectory = read_trajectory(data_folder, "test", 0)
    result = evaluate_trajectory(make_oracle(simulator, trajectory.position), trajectory)
    assert result["diverged_at"] is None
    assert result["frames"] == trajectory.frame_count - 2
    for where in ("sparse", "full"):
        scores = result[where]
        assert set(SCORES) <= set(scores)
        assert scores["rollout_mse"] < ROUNDING
        assert scores["one_step_mse"] < ROUNDING
        assert scores["relative_displacement_error"] < 1e-3
        assert scores["amplitude_ratio"] == pytest.approx(1.0, abs=1e-3)
        assert scores["static_mse"] > 1e-5
        assert 0.0 < scores["frozen_shape_mse"] < scores["static_mse"]
        assert max(scores["chamfer"], scores["sliced_wasserstein"]) < ROUNDING
        assert scores["density_difference"] < 0.05
        assert max(scores["final_centroid_error"], scores["final_bounding_box_error"]) < 1e-6
        assert len(scores["error_per_frame"]) == trajectory.frame_count
    assert result["full"]["projection_floor_mse"] < ROUNDING
    summary = summarize([result, result], system="tiny")
    for key in ("system", "trajectories", "frames", "points", "sparse_points", "diverged"):
        assert key in summary


def test_averages_with_and_without_given_frames_differ_by_their_number(simulator, data_folder):
    """Given frames have no error: sums agree, counts differ by the two given frames."""
    trajectory = read_trajectory(data_folder, "test", 0)
    result = evaluate_trajectory(simulator, trajectory, frames=6)
    assert result["frames"] == 6
    for scores in (result["sparse"], result["full"]):
        assert len(scores["error_per_frame"]) == 8
        assert scores["error_per_frame"][:2] == [0.0, 0.0]
        without = scores["rollout_mse_without_seed_frames"]
        assert scores["rollout_mse"] == pytest.approx(without * 6 / 8)
        assert scores["rollout_mse_axis_mean"] == pytest.approx(scores["rollout_mse"] / 3)
        assert without == pytest.approx(sum(scores["error_per_frame"]) / 6)


def test_frames_beyond_the_trajectory_are_not_made_up(simulator, data_folder):
    """There is no truth to compare with; too short a trajectory is refused."""
    trajectory = read_trajectory(data_folder, "test", 0)
    assert evaluate_trajectory(simulator, trajectory, frames=1000)["frames"] == 14
    short = replace(trajectory, position=trajectory.position[:2])
    with pytest.raises(ValueError, match="2 given frames and needs one more"):
        evaluate_trajectory(simulator, short)


def test_diverged_rollouts_are_counted_and_left_out_of_the_mean():
    """Mean of 1 and 3 is 2 whatever the diverged one scored; curves frame by frame."""

    def result(mse, diverged_at, frames):
        scores = {"rollout_mse": mse, "error_per_frame": [mse] * frames, "rollout_mse_at": {}}
        return {
            "diverged_at": diverged_at,
            "frames": frames,
            "points": 10,
            "sparse_points": 4,
            "sparse": scores,
            "full": scores,
        }

    results = [result(1.0, None, 3), result(math.nan, 2, 3), result(3.0, None, 4)]
    summary = summarize(results, system="x")
    assert summary["diverged"] == 1
    assert summary["trajectories"] == 3
    assert summary["sparse"]["rollout_mse"] == 2.0
    assert summary["sparse"]["rollout_mse_std"] == pytest.approx(math.sqrt(2.0))
    assert summary["sparse"]["error_per_frame"] == [2.0] * 3
    nothing = summarize([result(math.nan, 1, 3)], system="x")
    assert nothing["sparse"] is None
    assert nothing["diverged"] == 1
    with pytest.raises(ValueError, match="no trajectory to score"):
        summarize([], system="x")


@pytest.mark.parametrize("value", [1e9, math.nan])
def test_divergence_is_noticed_and_the_last_sound_frame_repeated(value):
    """Far outside the walls or not finite: both are a divergence at the third frame."""
    motion = accelerated()
    state = start_from_trajectory(motion, torch.arange(3), history=2)
    calls = []

    def acceleration(state, edges):
        calls.append(None)
        return torch.full_like(state.position, value if len(calls) == 3 else 0.0)

    found = roll_out(state, 5, connect=CONNECT, step=integrated(acceleration))
    assert found.diverged_at == 3
    assert len(found.position) == 5
    assert torch.equal(found.position[2:], found.position[1:2].expand(3, -1, -1))
    assert torch.isfinite(found.position).all()


def test_oracle_agrees_with_the_referee(simulator, tiny):
    """The referee's own motion, found again: no error, and the stages add up to the total."""
    scene = draw_scene(tiny.scene, seed=7, shape="capsule")
    truth = simulate(scene, replace(tiny.solver, frames=7)).position
    verdict = judge(make_oracle(simulator, truth), scene, frames=6, sparse_points=None)
    scores = verdict.scores
    assert set(DEMO) <= set(scores)
    assert scores["rollout_mse"] < ROUNDING
    assert scores["sparse_rollout_mse"] < ROUNDING
    assert scores["projection_floor_mse"] < ROUNDING
    assert scores["points"] == len(scene.position)
    assert scores["reduction"] == scores["points"] / scores["sparse_points"]
    still = squared_error_per_frame(truth[:1].expand_as(truth), truth).mean()
    assert scores["static_mse"] == pytest.approx(float(still))
    seconds = dict(scores["seconds_per_frame"])
    assert set(seconds) == {"sample", "graph", "network", "integrate", "upscale", "total"}
    assert seconds.pop("total") == pytest.approx(sum(seconds.values()))
    assert torch.equal(verdict.truth.position, truth)
    assert verdict.predicted.position.shape == truth.shape


def test_demo_shorter_than_a_change_of_material_is_judged_without_it(simulator, tiny):
    """Before the switch the motion is that of the first material, switch or not."""
    scene = draw_scene(tiny.scene, seed=7, shape="capsule")
    truth = simulate(scene, replace(tiny.solver, frames=7)).position
    melting = MaterialSwitch(frame=6, material_index=0, material=scene.materials[0])
    verdict = judge(make_oracle(simulator, truth), replace(scene, switch=melting), frames=6)
    assert torch.equal(verdict.truth.position, truth)


def test_spacing_follows_from_the_wanted_number_of_points(tiny):
    """Points go with the inverse cube of the spacing; none keeps the scene."""
    finer = scene_with_points(tiny.scene, points=800, found=100)
    assert finer.spacing == pytest.approx(tiny.scene.spacing / 2.0)
    assert scene_with_points(tiny.scene, points=None, found=100) is tiny.scene
    with pytest.raises(ValueError, match="must be >= 1"):
        scene_with_points(tiny.scene, points=0, found=100)


def test_memory_is_carried_along_the_true_positions(simulator, data_folder):
    """A stepper that counts its steps: every frame is stepped once, a fifth of them is scored."""
    trajectory = read_trajectory(data_folder, "test", 0)
    samples = simulator.sample(trajectory.position[0])
    seen = []

    def step(state, edges, prescribed):
        seen.append((0.0 if state.memory is None else float(state.memory[0, 0]), state.position))
        moved = prescribed + 1e-3 * len(seen)
        history = torch.cat([state.history[:, 1:], moved[:, None]], dim=1)
        memory = torch.full((len(samples), 1), float(len(seen)))
        return replace(state, history=history, memory=memory)

    simulator.dynamics.step = step
    sparse, _ = one_step_errors(simulator, trajectory, samples, frames=12)
    assert [memory for memory, _ in seen] == [float(k) for k in range(12)]
    for frame, (_, position) in enumerate(seen):
        assert torch.equal(position, trajectory.position[1 + frame, samples])
    expected = sum(3 * (1e-3 * count) ** 2 for count in (1, 6, 11)) / 3
    assert sparse == pytest.approx(expected, rel=1e-3)


def test_a_field_that_remembers_is_scored_from_the_undeformed_body(simulator, data_folder):
    """The floor is that of a new decoder, whatever was decoded before; scoring repeats itself."""
    config = replace(simulator.config, field=FieldConfig(kind="transport"))
    other = Simulator(config).eval()
    other.dynamics.load_state_dict(simulator.dynamics.state_dict())
    trajectory = read_trajectory(data_folder, split="valid", index=0)
    first, second = (evaluate_trajectory(other, trajectory) for _ in range(2))
    assert first == second
    history = other.config.features.history
    samples = other.sample(trajectory.position[0])
    truth = trajectory.position[history:]
    decode = other.decoder(trajectory.position[0], trajectory.kinematic, samples=samples)
    floor = torch.stack([decode(frame) for frame in truth[:, samples]])
    floor = torch.where(trajectory.kinematic[:, None], truth, floor)
    expected = float(squared_error_per_frame(floor, truth).sum()) / trajectory.frame_count
    assert first["full"]["projection_floor_mse"] == pytest.approx(expected, rel=1e-6)
