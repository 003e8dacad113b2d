"""What each ablation changes really changes, and nothing else does."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from giorom.data.statistics import measure_statistics
from giorom.data.trajectory_file import iterate_trajectories, read_trajectory
from giorom.evaluation.discretisation import rebuilt
from giorom.graph import connect_points
from giorom.pipeline import start_from_trajectory
from giorom.reproduce import (
    SCALES,
    Study,
    figure6,
    figure8,
    figure9,
    table4,
    table10,
    table13,
    table14,
)
from giorom.reproduce.ablation import NETWORK, Variant, network_changes, together
from giorom.reproduce.changed_model import with_graph, with_latent_grid
from giorom.reproduce.charts import draw_rows
from giorom.time_stepper import TimeStepper
from giorom.training_data import load_training_data


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """A study that is asked for experiments alone."""
    return Study(scale=SCALES["cpu"], out=tmp_path)


def variants_of(study: Study) -> dict[str, list[Variant]]:
    """Everything that the ablations train."""
    return {
        "table4": table4.variants(),
        "table10": table10.variants(study),
        "table13": table13.variants(),
        "table14": table14.variants(48),
        "figure6": [
            *figure6.ratio_variants(5000, large=True),
            *figure6.radius_variants(0.007, 0.05),
        ],
        "figure8": figure8.variants(),
        "figure9": [v for panel in figure9.PANELS for v in panel.variants(study)],
    }


def test_no_two_rows_of_a_table_train_the_same_thing(study):
    """Rows differ in what they change; those of Figure 9 without changes are one on purpose."""
    for name, variants in variants_of(study).items():
        rows = [v for v in variants if v.changes or name != "figure9"]
        trained = {json.dumps([v.system, v.method, v.changes], sort_keys=True) for v in rows}
        assert len(trained) == len(rows), name


@pytest.mark.parametrize("scale", ["cpu", "paper"])
def test_the_changes_of_every_table_are_accepted_and_change_the_experiment(scale, tmp_path):
    """The last changes of each kind, those of all panels of Figure 9 at once."""
    study = Study(scale=SCALES[scale], out=tmp_path)
    for name, variants in variants_of(study).items():
        chosen = [v for v in variants if v.changes]
        panels = together(*[v.changes for v in chosen]) if name == "figure9" else None
        last = chosen[-1] if panels is None else replace(chosen[-1], changes=panels)
        changed = study.experiment(last.system, last.method, last.changes)
        assert changed != study.experiment(last.system, last.method), name


def test_every_panel_of_figure_9_holds_the_network_as_it_is_once(study):
    """A value the network has anyway changes nothing, so that its training is shared."""
    for panel in figure9.PANELS:
        usual = [variant for variant in panel.variants(study) if not variant.changes]
        assert len(usual) == 1, panel.label


def network(study: Study, variant: Variant) -> TimeStepper:
    """The network of a variant on a box."""
    experiment = study.experiment(variant.system, variant.method, variant.changes)
    box = [[0.0, 1.0]] * experiment.scene.dimension
    return TimeStepper(experiment.network(box)["time_stepper"])


def size(module: torch.nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def test_each_pair_of_message_passing_layers_of_table_10_adds_the_same_weights(study):
    """Two more layers cost twice one layer: parameters grow linearly, from 2 to 8."""
    networks = [network(study, variant) for variant in table10.variants(study)]
    sizes = [size(one) for one in networks]
    layer = size(networks[0].before[0])
    assert np.diff(sizes).tolist() == [2 * layer] * 3
    assert [len(one.before) + len(one.after) for one in networks] == [2, 4, 6, 8]


def test_the_network_as_it_is_is_no_change(study):
    """Values it has are dropped, others stay."""
    found = network_changes(study, "water2d", {"layers_before": 2, "heads": 8})
    assert found == {"time_stepper": {"overrides": {"heads": 8}}}
    assert network_changes(study, "water2d", {"layers_before": 2}) == {}


def test_a_training_on_some_trajectories_sees_and_scales_these_alone(tiny, data_folder):
    """Table 14: the first n trajectories give the windows and, measured anew, the scales."""
    fewer = replace(tiny, training=replace(tiny.training, trajectories=2))
    data, everything = load_training_data(fewer, data_folder), load_training_data(tiny, data_folder)
    first = list(iterate_trajectories(data_folder, "train"))[:2]
    assert data.metadata["vel_std"] == measure_statistics(first).to_metadata()["vel_std"]
    assert data.metadata["vel_std"] != everything.metadata["vel_std"]
    assert len(data.thinned) == 2 < len(everything.thinned)
    for mine, theirs in zip(data.validation, everything.validation, strict=True):
        torch.testing.assert_close(mine.motion.position, theirs.motion.position)


def test_more_trajectories_than_there_are_are_refused(tiny, data_folder):
    many = replace(tiny, training=replace(tiny.training, trajectories=99))
    with pytest.raises(ValueError, match=r"training\.trajectories is 99"):
        load_training_data(many, data_folder)
    with pytest.raises(ValueError, match="trajectories must be >= 1"):
        replace(tiny.training, trajectories=0)


def test_table_14_takes_the_shares_of_the_paper():
    """The paper's 1000 are all there are; its own numbers come back for 1000."""
    assert list(table14.counts(1000)) == [50, 150, 200, 400, 1000]
    assert list(table14.counts(100)) == [5, 15, 20, 40, 100]
    assert table14.counts(1) == {1: table14.PAPER[1000]}


def test_a_graph_is_described_by_degree_components_and_longest_edge():
    """Three points in a row joined to their neighbours, and one far away: 4 messages, 2 parts."""
    position = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [9.0, 0.0]])
    batch = torch.zeros(4, dtype=torch.long)
    facts = table13.describe_graph(
        connect_points(position, batch, radius=1.1, kind="radius"), position.numpy()
    )
    assert facts == table13.GraphFacts(neighbors=1.0, components=2, longest_edge=1.0)


def test_the_official_delaunay_graph_has_half_the_edges_of_the_whole_one():
    """In the plane it keeps every edge of every triangle, but in one direction; both are one part.

    Inside a square of n points with h on the hull there are 3 n - 3 - h edges (Euler).
    """
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(60, 2, generator=generator, dtype=torch.float64)
    batch = torch.zeros(60, dtype=torch.long)
    whole, official = (
        table13.describe_graph(
            connect_points(position, batch, radius=1.0, kind=kind), position.numpy()
        )
        for kind in ("delaunay", "delaunay_official")
    )
    from scipy.spatial import ConvexHull

    edges = 3 * 60 - 3 - len(ConvexHull(position.numpy()).vertices)
    assert whole.neighbors == pytest.approx(2 * edges / 60)
    assert official.neighbors == pytest.approx(edges / 60)
    assert whole.components == official.components == 1
    assert whole.longest_edge == official.longest_edge


def test_a_model_with_the_grid_it_was_trained_with_is_the_same_model(simulator, data_folder):
    """Table 12: the same grid gives the same step; another one with the same weights another."""
    trajectory = read_trajectory(data_folder, "test", 0)
    samples = simulator.sample(trajectory.position[0])
    state = start_from_trajectory(trajectory, samples, history=simulator.config.features.history)

    def moved(model):
        with torch.no_grad():
            return model.dynamics.step(state, model.connect(state)).position

    own = simulator.config.time_stepper.latent_side
    same = rebuilt(simulator, with_latent_grid(simulator.config, side=own, radius=None))
    finer = rebuilt(simulator, with_latent_grid(simulator.config, side=2 * own, radius=None))
    assert torch.equal(moved(same), moved(simulator))
    assert not torch.equal(moved(finer), moved(simulator))
    other = rebuilt(simulator, with_graph(simulator.config, kind="delaunay"))
    assert len(other.connect(state).sender) != len(simulator.connect(state).sender)


def test_figure_6_leaves_out_what_is_too_sparse_or_too_dense():
    """Shares of 5000 particles: the network on 3000 at most without a GPU, nothing on ten."""
    for large, first in ((True, 1.0), (False, 0.5)):
        found = figure6.ratio_variants(5000, large=large)
        network_shares = [v.labels["share"] for v in found if v.method == NETWORK]
        assert network_shares[0] == first
        assert network_shares[-1] == 0.007
    fewest = min(v.labels["share"] for v in figure6.ratio_variants(200, large=False))
    assert fewest == 0.062
    assert 200 * 0.031 < figure6.FEWEST


def test_the_radii_of_figure_6_are_multiples_of_the_rule_as_in_the_paper():
    """0.02 and 0.45 m beside a usual 0.06 m: a third, and 7.5 times."""
    radii = [v.changes["graph"]["radius"] for v in figure6.radius_variants(0.007, 0.09)]
    assert radii == pytest.approx([0.03, 0.06, 0.225, 0.675])


def test_the_best_noise_diverges_least_and_then_errs_least():
    """A smaller error over fewer surviving rollouts is no better."""
    rows = [
        {
            "system": "water3d",
            "noise": 0.0,
            "rollout_mse": 0.1,
            "static_mse": 1.0,
            "diverged": "3/4",
        },
        {
            "system": "water3d",
            "noise": 1.0,
            "rollout_mse": 0.4,
            "static_mse": 1.0,
            "diverged": "0/4",
        },
        {
            "system": "water3d",
            "noise": 2.0,
            "rollout_mse": 0.3,
            "static_mse": 1.0,
            "diverged": "0/4",
        },
        {
            "system": "water3d",
            "noise": 3.0,
            "rollout_mse": None,
            "static_mse": None,
            "diverged": "4/4",
        },
    ]
    figure8.mark_best(rows)
    assert [row["best"] for row in rows] == [False, False, True, False]
    assert rows[2]["times_static"] == 0.3
    assert rows[3]["times_static"] is None


def test_noises_are_placed_on_a_logarithmic_axis():
    """A named noise lies at its number; the geometric mean of two half-way between them."""
    for number, noise in enumerate(figure8.NOISES[1:], start=1):
        assert figure8._place(noise) == pytest.approx(number)
    assert figure8._place(math.sqrt(3e-5 * 3e-4)) == pytest.approx(2.5)


def test_rows_without_a_number_are_marked_and_not_drawn_at_zero():
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    draw_rows(axes, [{"rollout_mse": 2.0}, {"rollout_mse": None}], [0.0, 1.0])
    drawn = {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}
    assert drawn["ours: every rollout diverged"] == [[1.0, 0.03]]
    assert [[0.0, 2.0]] in drawn.values()


def test_every_variant_of_table_4_is_a_method_with_its_noise(study):
    """The noise of a row is that of its training, whatever the tuning of the method finds."""
    for variant, (method, noise, _, _) in zip(table4.variants(), table4.ROWS, strict=True):
        experiment = study.experiment(variant.system, variant.method, variant.changes)
        assert variant.method == method
        assert experiment.training.noise_std == noise
        assert asdict(experiment)["system"] == "plasticine3d"
