"""The body time-stepper against rod theory, conservation laws and its own inverse problem."""

import gc
import math
from dataclasses import replace

import pytest
import torch
import yaml

from giorom.body_stepper import BodyStepper, BodyStepperConfig, cofactors
from giorom.config import Experiment
from giorom.data.trajectory_file import iterate_trajectories
from giorom.data.windows import WindowBatch
from giorom.evaluation.evaluate import evaluate_trajectory
from giorom.evaluation.rollout import single_scene
from giorom.layers import body_grid as module
from giorom.layers.body_grid import body_grid, held_plane
from giorom.pipeline import rollout, start_from_velocity, unconnected
from giorom.records import parse_record
from giorom.simulator import Simulator
from giorom.state import ELASTIC, KINEMATIC, Body, concatenate_states
from giorom.training.loss import motion_loss

DIMENSIONS = pytest.mark.parametrize("dimension", [2, 3])
SPACING = 0.0125
BULK, SHEAR = 400.0, 300.0


def stepper(dimension, *, viscosity=1e-6, **options):
    options = {"spacing": 0.05, "substeps": 2} | options
    model = BodyStepper(BodyStepperConfig(**options), dimension=dimension)
    model.log_bulk.data.fill_(math.log(BULK))
    model.log_shear.data.fill_(math.log(SHEAR))
    model.log_viscosity.data.fill_(math.log(viscosity))
    return model.requires_grad_(False)


def bar(dimension=2, *, sides=(6, 16), held=True, shift=0.0):
    """A standing bar on the origin; with a held row of particles under it, if it is held."""
    axes = [SPACING * (torch.arange(side) + 0.5) for side in (*sides, sides[0])[:dimension]]
    if held:
        axes[1] = torch.cat([torch.tensor([0.0]), axes[1]])
    position = torch.cartesian_prod(*axes)
    kind = torch.full((len(position),), ELASTIC)
    kind[position[:, 1] == 0.0] = KINEMATIC
    return Body(position=position + shift, particle_type=kind)


def moving(model, body, velocity, *, samples=None, frame_dt=2e-3):
    """The state of a body thrown with a velocity field."""
    samples = torch.arange(len(body.position)) if samples is None else samples
    position = body.position[samples]
    state = start_from_velocity(
        position,
        velocity(position),
        particle_type=body.particle_type[samples],
        bounds=torch.tensor([[-1.0, 2.0]] * position.shape[1]),
        frame_dt=frame_dt,
        history=2,
        body=body,
    )
    return model.start(state, velocity(position))


def moved(model, state, frames, **options):
    return list(rollout(state, frames, connect=unconnected, step=model.step, **options))


def along(axis, profile):
    """A velocity along one axis that depends on the height."""

    def velocity(position):
        result = torch.zeros_like(position)
        result[:, axis] = profile(position[:, 1])
        return result

    return velocity


@pytest.mark.parametrize(
    ("axis", "sides", "frame_dt"), [(1, (6, 32), 4e-4), (0, (6, 48), 4e-3)], ids=["rod", "beam"]
)
def test_a_held_bar_swings_with_the_period_of_theory(axis, sides, frame_dt):
    """Fixed-free rod: T = 4 L / c; Euler-Bernoulli beam: T = 2 pi L^2 / 3.516 sqrt(A / E I) ...

    with c^2 = E and, in two dimensions, E = 4 K G / (K + G). It crosses its rest after T / 2.
    The shear that the theory of the beam neglects makes it 1.4 % slower (Timoshenko).
    """
    model = stepper(2, spacing=0.025, substeps=4)
    width, height = SPACING * sides[0], SPACING * sides[1]
    modulus = 4.0 * BULK * SHEAR / (BULK + SHEAR)
    period = 4.0 * height / math.sqrt(modulus)
    if axis == 0:
        period = 2.0 * math.pi * height**2 / 3.516 / math.sqrt(modulus * width**2 / 12.0)
    body = bar(sides=sides)
    mode = along(axis, lambda y: 0.1 * torch.sin(0.5 * math.pi * y / height))
    if axis == 0:
        mode = along(axis, lambda y: 0.1 * (y / height) ** 2)
    state = moving(model, body, mode, frame_dt=frame_dt)
    tip = int(body.position[:, 1].argmax())
    frames = math.ceil(0.6 * period / frame_dt)
    way = [
        float(s.position[tip, axis] - s.reference[tip, axis]) for s in moved(model, state, frames)
    ]
    after = next(k for k in range(len(way)) if way[k] < 0.0)
    crossing = after + way[after - 1] / (way[after - 1] - way[after])
    assert crossing * frame_dt == pytest.approx(0.5 * period, rel=0.04)


@DIMENSIONS
def test_a_swing_keeps_its_energy_without_viscosity_and_loses_it_with(dimension):
    """Kinetic and elastic energy, psi = G (tr b - d) / 2 + K (J - 1)^2 / 2, over many swings."""
    body = bar(dimension, sides=(4, 10))
    rest = along(0, lambda y: 1.5 * y)

    def energies(model, frames):
        grid = body_grid(body, model.config.grid(dimension))
        mass = torch.linalg.inv(grid.inverse_mass(model._inertia(grid, 2e-3)).double())
        result = []
        for state in moved(model, moving(model, body, rest), frames):
            nodes = state.memory[0][: grid.node_count].double()
            u, v = nodes[:, :dimension], nodes[: grid.free_count, dimension:]
            gradient = torch.eye(dimension) + u[grid.node].mT @ grid.slope.double()
            volume = torch.linalg.det(gradient)
            trace = gradient.square().sum(dim=(1, 2)) * volume ** (-2.0 / dimension)
            density = 0.5 * SHEAR * (trace - dimension) + 0.5 * BULK * (volume - 1.0) ** 2
            elastic = (grid.volume * density).sum()
            result.append(float(elastic + 0.5 * (v * (mass @ v)).sum()))
        return torch.tensor(result).unfold(0, 30, 30).mean(dim=1)

    kept = energies(stepper(dimension), 90)
    torch.testing.assert_close(kept, kept[:1].expand_as(kept), rtol=0.03, atol=0.0)
    lost = energies(stepper(dimension, viscosity=1.0), 60)
    assert float(lost[-1]) < 0.6 * float(kept[0])


@DIMENSIONS
def test_a_free_body_flies_straight_and_falls_in_a_parabola(dimension):
    """X = x0 + v t + g t^2 / 2; what frames sample of it is exact to rounding."""
    model = stepper(dimension)
    model.gravity[1] = -9.8
    body = bar(dimension, sides=(5, 7), held=False)
    state = moving(model, body, lambda x: torch.full_like(x, 0.5))
    last = moved(model, state, 50)[-1]
    wanted = body.position + 0.5 * 0.1
    wanted[:, 1] -= 0.5 * 9.8 * 0.1**2
    torch.testing.assert_close(last.position, wanted, atol=1e-4, rtol=0.0)


@DIMENSIONS
def test_a_turned_body_rests(dimension):
    """The law does not depend on the observer: a rotation by one radian makes no force."""
    model = stepper(dimension)
    body = bar(dimension, sides=(5, 7), held=False)
    turn = torch.eye(dimension)
    turn[:2, :2] = torch.tensor([[math.cos(1), -math.sin(1)], [math.sin(1), math.cos(1)]])
    state = moving(model, body, torch.zeros_like)
    turned = body.position @ turn.T
    state = replace(state, history=turned[:, None].expand_as(state.history), memory=None)
    last = moved(model, state, 20)[-1]
    torch.testing.assert_close(last.position, turned, atol=2e-5, rtol=0.0)


@DIMENSIONS
def test_momentum_and_turn_of_a_free_body_are_kept(dimension):
    """A wobbling, turning body: centroid on a straight line, angular momentum constant."""
    model = stepper(dimension)
    body = bar(dimension, sides=(5, 9), held=False)

    def velocity(x):
        r = x - x.mean(dim=0)
        result = torch.zeros_like(x)
        result[:, 0], result[:, 1] = 1.0 - 4.0 * r[:, 1] + 30.0 * r[:, 1] ** 2, 4.0 * r[:, 0]
        return result

    states = moved(model, moving(model, body, velocity), 40)
    drift = torch.stack([s.position.mean(dim=0) for s in states]).diff(dim=0)
    torch.testing.assert_close(drift, drift[:1].expand_as(drift), atol=2e-6, rtol=0.0)

    def turning(state):
        r = state.history.mean(dim=1)
        v = state.velocity
        return float((r[:, 0] * v[:, 1] - r[:, 1] * v[:, 0]).mean())

    assert turning(states[-1]) == pytest.approx(turning(states[0]), rel=0.02)


@DIMENSIONS
def test_scenes_of_a_batch_move_as_each_does_alone(dimension):
    """Two bodies of different size, one held and one free, side by side in one batch."""
    model = stepper(dimension)
    sway = along(0, lambda y: y)
    first = moving(model, bar(dimension, sides=(5, 8)), sway)
    second = moving(model, bar(dimension, sides=(4, 6), held=False), sway)
    together = moved(model, concatenate_states([first, second]), 5)[-1]
    for scene, state in enumerate((first, second)):
        alone = moved(model, state, 5)[-1]
        found = single_scene(together, scene)
        torch.testing.assert_close(found.position, alone.position, atol=0.0, rtol=0.0)
        assert torch.equal(found.memory[0], alone.memory[0])
        assert found.bodies == state.bodies


@DIMENSIONS
def test_the_number_of_samples_changes_nothing(dimension):
    """A motion that a quarter of the samples determine is the same with four times as many."""
    model = stepper(dimension)
    body = bar(dimension, sides=(5, 9), held=False)
    generator = torch.Generator().manual_seed(0)
    many = torch.randperm(len(body.position), generator=generator)[: len(body.position) // 2]
    few = many[: len(many) // 4]
    stretch = along(1, lambda y: 8.0 * y)
    last = [moved(model, moving(model, body, stretch, samples=s), 30)[-1] for s in (few, many)]
    torch.testing.assert_close(last[0].position, last[1].position[: len(few)], atol=2e-5, rtol=0.0)
    assert float((last[0].position - last[0].reference).abs().max()) > 0.01


@DIMENSIONS
def test_a_base_that_moves_carries_the_body_along(dimension):
    """Base and body set off at one speed: every particle keeps it, the base exactly as told."""
    model = stepper(dimension)
    body = bar(dimension, sides=(5, 8))
    drift = torch.tensor([0.4, 0.1, 0.2])[:dimension]
    state = moving(model, body, drift.expand_as)
    told = body.position + 2e-3 * torch.arange(1, 31)[:, None, None] * drift
    last = moved(model, state, 30, prescribed=told)[-1]
    assert torch.equal(last.position[last.kinematic], told[-1][last.kinematic])
    torch.testing.assert_close(last.position, told[-1], atol=2e-5, rtol=0.0)


def test_a_state_that_was_moved_takes_the_velocity_of_it():
    """Shown the true motion of a thrown body, it goes on as thrown: memory follows positions."""
    model = stepper(2)
    body = bar(held=False)
    state = moving(model, body, torch.zeros_like)
    thrown = torch.tensor([1e-3, 5e-4])
    for frame in range(3):
        state = model.step(state, unconnected(state))
        history = state.history.clone()
        history[:, -1] = state.reference + (frame + 1) * thrown
        state = replace(state, history=history)
    later = model.step(state, unconnected(state))
    torch.testing.assert_close(later.position, state.position + thrown, atol=1e-5, rtol=0.0)


def test_a_motion_goes_on_from_positions_alone():
    """Two frames of a swing say how it goes on, nearly as well as what the stepper remembers."""
    model = stepper(2)
    body = bar()
    states = moved(model, moving(model, body, along(0, lambda y: 2.0 * y)), 30)
    forgotten = replace(states[19], memory=None)
    last = moved(model, forgotten, 10)[-1].position
    way = float((states[-1].position - states[19].position).norm())
    assert float((last - states[-1].position).norm()) < 0.15 * way


def test_training_finds_the_stiffness_that_made_the_motion():
    """Gradients of the motion alone bring the shear modulus from 1.5 times the truth to it."""
    truth, model = stepper(2), stepper(2)
    model.log_shear += math.log(1.5)
    body = bar(sides=(4, 10))
    start = moving(truth, body, along(0, lambda y: 6.0 * y), samples=torch.arange(0, 44, 2))
    target = torch.stack([s.position for s in moved(truth, start, 12)])
    batch = WindowBatch(state=start, target=target.transpose(0, 1), edges=None)
    stiffness = model.log_shear.requires_grad_(True)
    optimizer = torch.optim.Rprop([stiffness], lr=0.1)
    for _ in range(14):
        loss = motion_loss(model.step, batch, connect=unconnected)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(stiffness[ELASTIC].detach().exp()) == pytest.approx(SHEAR, rel=0.03)


def test_a_few_steps_of_training_beat_holding_still_and_are_stored(
    tiny_values, data_folder, run_training, tmp_path
):
    """Trained on clamped bodies, stored, loaded: scores on a held-out body, no gravity learned."""
    tiny_values["body_stepper"] = {"spacing": 0.125, "height_spacing": 0.0625, "held_rows": 0.0625}
    tiny_values["training"] |= {"objective": "motion", "turn": False, "unroll": [[0.0, 3]]}
    experiment = parse_record(Experiment, tiny_values, where="test")
    run_training(experiment, data_folder, tmp_path / "run", steps=3)
    simulator = Simulator.from_pretrained(tmp_path / "run")
    assert simulator.config.body_stepper == experiment.body_stepper
    assert not simulator.dynamics.gravity.any()
    (trajectory,) = iterate_trajectories(data_folder, "test")
    scores = evaluate_trajectory(simulator, trajectory)["sparse"]
    assert scores["rollout_mse"] < 0.1 * scores["static_mse"]
    assert scores["one_step_mse"] < 0.1 * scores["rollout_mse"]


def test_a_grid_that_cannot_be_laid_leaves_no_folder(tiny_values, data_folder, tmp_path, refuse):
    """Refused before the run begins; a whole group is replaced, or taken away, by its name."""
    file, out = tmp_path / "tiny.yaml", tmp_path / "run"
    tiny_values["grid_stepper"] = {"spacing": 0.1}
    tiny_values["training"] |= {"objective": "motion", "turn": False, "unroll": [[0.0, 3]]}
    file.write_text(yaml.safe_dump(tiny_values))
    words = ("train", "--config", file, "--data", data_folder, "--out", out, "--max-steps", 1)
    line = refuse(*words, "--grid_stepper", "null", "--body_stepper", "{spacing: 1.0e-9}")
    assert "Raise BodyStepperConfig.spacing" in line
    assert "GridStepperConfig.spacing" in refuse(*words, "--grid_stepper.spacing", "1e-9")
    assert not out.exists()


def test_operators_are_kept_with_their_body_and_for_it_alone():
    """The same body: the same grid; an equal one: its own; a body that is gone leaves none."""
    config = BodyStepperConfig(spacing=0.05).grid(2)
    first, second = bar(), bar()
    before = len(module._KNOWN)
    assert body_grid(first, config) is body_grid(first, config)
    assert body_grid(first, config) is not body_grid(second, config)
    assert body_grid(first, config) is not body_grid(first, replace(config, lumped=0.5))
    del first, second
    gc.collect()
    assert len(module._KNOWN) <= before


@pytest.mark.parametrize("dimension", [2, 3])
def test_cofactors_are_those_of_the_inverse(dimension):
    """The cofactor matrix of F is det F times the transposed inverse."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.eye(dimension) + 0.3 * torch.randn(7, dimension, dimension, generator=generator)
    found, determinant = cofactors(matrix)
    torch.testing.assert_close(determinant, torch.linalg.det(matrix))
    torch.testing.assert_close(found, determinant[:, None, None] * torch.linalg.inv(matrix).mT)


def test_rows_that_hold_are_those_next_to_the_highest_held_particle():
    """Rows 0.1 m apart hold up to the row above a particle, or below one that is 0.02 m higher."""
    for top, wanted in ((0.23, 0.3), (0.31, 0.3), (0.35, 0.4)):
        height = torch.linspace(0.0, 1.0, 101, dtype=torch.float64).numpy()
        position = height[:, None].repeat(2, axis=1)
        assert held_plane(position, height <= top, rows=0.1) == (1, pytest.approx(wanted))
        assert held_plane(position, height <= top, rows=None) == (1, pytest.approx(top, abs=0.01))


def test_what_cannot_be_stepped_is_refused_in_one_line():
    model, body = stepper(2), bar()
    state = moving(model, body, torch.zeros_like)
    with pytest.raises(ValueError, match="does not say which"):
        model.step(replace(state, bodies=None), unconnected(state))
    height = body.position[:, 1]
    for kinematic, message in (
        (height > 0.1, "holds bodies from below alone"),
        (height >= 0.0, "every particle of the body is kinematic"),
    ):
        kind = torch.where(kinematic, KINEMATIC, ELASTIC)
        other = Body(position=body.position, particle_type=kind)
        with pytest.raises(ValueError, match=message):
            model.step(replace(state, bodies=(other,), memory=None), unconnected(state))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"spacing": 0.0}, "spacing must be > 0 m"),
        ({"spacing": math.inf}, "spacing must be > 0 m and finite"),
        ({"spacing": 0.1, "substeps": 0}, "substeps must lie between 1 and"),
        ({"spacing": 0.1, "substeps": 10**9}, "substeps must lie between 1 and"),
        ({"spacing": 0.1, "cells": 10**9}, "cells must lie between 1 and"),
        ({"spacing": 0.1, "height_spacing": math.inf}, "height_spacing must be > 0 m and finite"),
        ({"spacing": 0.1, "lumped": 1.5}, "must lie in"),
        ({"spacing": 0.1, "held_rows": 0.0}, "held_rows must be > 0"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        BodyStepperConfig(**values)


@pytest.mark.parametrize(("spacing", "message"), [(1e-9, "would have"), (1e-3, "free nodes")])
def test_a_grid_that_no_memory_holds_is_refused_before_it_is_laid(spacing, message):
    """1e-9 m: 1e16 nodes around the bar; 1e-3 m: nine rows of nodes around each particle."""
    model, body = stepper(2, spacing=spacing), bar(sides=(30, 30))
    with pytest.raises(ValueError, match=message):
        moving(model, body, torch.zeros_like)


@pytest.mark.parametrize("modulus", [1e30, math.inf, math.nan])
def test_a_body_too_stiff_for_its_steps_fails_in_words(modulus):
    model, body = stepper(2), bar()
    model.log_shear.data.fill_(math.log(modulus))
    with pytest.raises(FloatingPointError, match="too stiff for its steps"):
        moving(model, body, torch.zeros_like)
