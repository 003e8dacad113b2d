"""``giorom benchmark solver``: what is counted, what is written, what is refused."""

import json
import multiprocessing
import threading
from dataclasses import replace

import pytest

from giorom.cli import main
from giorom.evaluation import solver_speed
from giorom.evaluation.machine import describe_machine
from giorom.evaluation.solver_speed import SpeedCase, measure_speed, standard_case, with_points
from giorom.mpm import draw_scene
from giorom.mpm.materials import MATERIALS
from giorom.mpm.simulate import Run


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Blocks of one frame."""
    monkeypatch.setattr(solver_speed, "BLOCK_WORK", 1)


@pytest.fixture
def tiny_case(tiny):
    """The tiny experiment as a case."""
    return SpeedCase(
        name="tiny", scene=tiny.scene, grid_cells=16, frame_dt=tiny.solver.frame_dt, substeps=40
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("law", list(MATERIALS))
def test_every_law_has_a_standard_case_of_the_size_asked_for(law, dimension):
    """A law that is added appears by itself; the body lies inside the walls of its grid."""
    case = standard_case(law, dimension=dimension, points=1000)
    scene = draw_scene(case.scene, seed=0)
    assert 900 <= len(scene.position) <= 1100
    assert scene.materials[0].name == law
    assert bool((scene.position > 2.0 / case.grid_cells).all())


def test_rates_follow_from_the_clock(tiny_case, monkeypatch):
    """P particles, 40 substeps, blocks of 2, 4 and 5 s by a clock that is set by hand."""
    readings = iter([0.0, 2.0, 10.0, 14.0, 20.0, 25.0])
    cpu = iter([0.0, 1.0, 1.0, 2.0, 2.0, 3.0])
    monkeypatch.setattr(solver_speed.time, "perf_counter", lambda: next(readings))
    monkeypatch.setattr(solver_speed.time, "process_time", lambda: next(cpu))
    row = measure_speed(tiny_case, processes=1, repeats=3, seed=0, device="cpu")
    work = row["points"] * 40
    assert row["substeps"] == 40
    assert row["particle_substeps_per_second"] == work / 4
    assert row["particle_substeps_per_second_min"] == work / 5
    assert row["particle_substeps_per_second_max"] == work / 2
    assert row["particle_substeps_per_cpu_second"] == work
    assert row["seconds_per_frame"] == 4
    assert row["microseconds_per_substep"] == pytest.approx(1e6 * 4 / 40)
    assert (row["processes"], row["threads"], row["device"]) == (1, 1, "cpu")


def test_blocks_are_timed_after_a_warm_up_and_have_the_frames_they_count(tiny_case, monkeypatch):
    """Three frames of warm-up (and the initial one), then two blocks of three."""
    asked, frames = [], Run.frames

    def counted(self):
        for frame in frames(self):
            asked.append(self.solver.frames)
            yield frame

    points = len(draw_scene(tiny_case.scene, seed=0).position)
    monkeypatch.setattr(Run, "frames", counted)
    monkeypatch.setattr(solver_speed, "FEWEST", points)
    monkeypatch.setattr(solver_speed, "BLOCK_WORK", 2 * points * 40 + 1)
    row = measure_speed(tiny_case, processes=1, repeats=2, seed=0, device="cpu")
    assert asked == [10] * 10
    assert row["points"] == points


def test_block_of_a_body_of_few_particles_is_as_long_as_that_of_many(tiny_case, monkeypatch):
    """One particle would otherwise be moved three million substeps in a block."""
    asked, frames = [], Run.frames

    def counted(self):
        for frame in frames(self):
            asked.append(self.solver.frames)
            yield frame

    monkeypatch.setattr(Run, "frames", counted)
    monkeypatch.setattr(solver_speed, "FEWEST", 10**6)
    monkeypatch.setattr(solver_speed, "BLOCK_WORK", 40 * 10**6)
    measure_speed(tiny_case, processes=1, repeats=2, seed=0, device="cpu")
    assert asked == [4] * 4


def test_rates_of_processes_side_by_side_are_added(tiny_case, monkeypatch):
    """Each block's rate is the sum of the processes' own."""

    def measured(*_, processes, **__):
        return [
            {
                "seconds": [1.0 + number, 2.0],
                "cpu_seconds": [1.0, 1.0],
                "block_frames": 1,
                "block_work": 40.0,
                "law": "fixed_corotated",
                "points": 1,
                "substeps": 40,
            }
            for number in range(processes)
        ]

    monkeypatch.setattr(solver_speed, "_side_by_side", measured)
    row = measure_speed(tiny_case, processes=2, repeats=2, seed=0, device="cpu")
    assert row["particle_substeps_per_second_max"] == 40 / 1 + 40 / 2
    assert row["particle_substeps_per_second_min"] == 40 / 2 + 40 / 2


@pytest.mark.slow
def test_two_processes_meet_before_each_block(tiny_case):
    """Both answer; their rates are counted together."""
    row = measure_speed(tiny_case, processes=2, repeats=2, seed=0, device="cpu")
    assert row["processes"] == 2
    assert row["particle_substeps_per_second"] > 0.0


def test_process_that_fails_lets_the_others_go_and_says_why(tiny_case):
    """It breaks the barrier they wait at; the line is what the parent raises."""
    barrier, (ours, theirs) = threading.Barrier(2), multiprocessing.Pipe()
    broken = replace(tiny_case, substeps=1)
    solver_speed._serve(theirs, barrier, broken, {"repeats": 1, "seed": 0, "device": "cpu"})
    assert barrier.broken
    assert ours.recv().startswith("ValueError: substep_dt")
    theirs.close()
    assert solver_speed._answer(ours) == "it was ended from outside"
    ours.close()


def test_number_of_particles_follows_the_wish(tiny_case):
    """Within a tenth, by the spacing alone."""
    finer = with_points(tiny_case, 1000, seed=0)
    assert 900 <= len(draw_scene(finer.scene, seed=0).position) <= 1100
    assert replace(finer, scene=tiny_case.scene) == tiny_case


def test_command_writes_rows_machine_and_table(tiny_yaml, tmp_path, capsys):
    """Keys of cli.md; the Markdown table has a line for each row below its two of heading."""
    json_file, table = tmp_path / "speed.json", tmp_path / "speed.md"
    words = ["benchmark", "solver", "--materials", "fixed_corotated", "--points", "300,500"]
    words += ["--dimensions", "2", "--repeats", "1"]
    assert main([*words, "--json", str(json_file), "--markdown", str(table)]) == 0
    assert "fixed" in capsys.readouterr().out
    result = json.loads(json_file.read_text())
    keys = {"points", "substeps", "particle_substeps_per_second", "seconds_per_frame", "threads"}
    assert all(keys | {"device", "law", "grid_cells"} <= set(row) for row in result["rows"])
    assert len(result["rows"]) == 2
    assert len(table.read_text().splitlines()) == 4
    assert result["machine"]["cores"] >= 1
    assert result["machine"]["versions"]["torch"]
    words = ["benchmark", "solver", str(tiny_yaml), "--repeats", "1", "--quiet"]
    assert main([*words, "--json", str(json_file)]) == 0
    (row,) = json.loads(json_file.read_text())["rows"]
    assert (row["case"], row["law"]) == ("tiny", "stable_neo_hookean")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["solvr"], "Did you mean 'solver'?"),
        (["solver", "--points", "0"], "--points takes whole numbers from 1"),
        (["solver", "--processes", "two"], "--processes takes whole numbers"),
        (["solver", "--processes", "9" * 40], "--processes takes whole numbers"),
        (["solver", "--repeats", "0"], "--repeats must lie between 1"),
        (["solver", "--materials", "sandd"], "drucker_prager_sand"),
        (["solver", "--dimensions", "1"], "must name 2 or 3"),
        (["solver", "elastic3d-smal"], "Did you mean 'elastic3d-small'?"),
        (["solver", "--bogus", "1"], "no option '--bogus'"),
    ],
)
def test_mistyped_benchmark_is_refused(capsys, words, text):
    """One line, exit code 2."""
    assert main(["benchmark", *words]) == 2
    assert text in capsys.readouterr().err


def test_help_lists_the_targets(capsys):
    """Of the family and of the target."""
    assert main(["benchmark"]) == 0
    assert "solver" in capsys.readouterr().out
    assert main(["benchmark", "solver", "--help"]) == 0
    assert "--processes" in capsys.readouterr().out


def test_law_with_an_unknown_parameter_is_named(monkeypatch):
    """Whoever adds a law is told where its typical value belongs."""
    typical = {name: value for name, value in solver_speed.TYPICAL.items() if name != "density"}
    monkeypatch.setattr(solver_speed, "TYPICAL", typical)
    with pytest.raises(ValueError, match=r"parameter density, .*TYPICAL"):
        standard_case("fixed_corotated", dimension=2, points=100)


def test_machine_is_described_with_json_values():
    """Load and versions are part of a measurement."""
    machine = json.loads(json.dumps(describe_machine()))
    assert len(machine["load_average"]) == 3
    assert machine["versions"]["python"].startswith("3.")
