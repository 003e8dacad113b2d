"""The command line: what it writes, and how it refuses. The keys are those other programs read."""

import json
import shutil
import subprocess
import sys

import pytest
import torch
import yaml

from giorom.cli import COMMANDS, main
from giorom.data.trajectory_file import read_trajectory_file
from giorom.simulator import Simulator

h5py = pytest.importorskip("h5py")
trimesh = pytest.importorskip("trimesh")

TRIVIAL = {"constant_velocity_mse", "free_fall_mse", "static_mse"}
SCORES = TRIVIAL | {
    "one_step_mse",
    "rollout_mse",
    "rollout_mse_without_seed_frames",
    "rollout_mse_axis_mean",
    "relative_displacement_error",
    "rollout_mse_at",
    "error_per_frame",
}


@pytest.fixture
def data_copy(data_folder, tmp_path):
    """A copy of the data set, free to be damaged."""
    ignored = shutil.ignore_patterns("parts")
    return shutil.copytree(data_folder, tmp_path / "copy", ignore=ignored)


@pytest.fixture
def out(tmp_path):
    """A folder that must not appear when the input is refused."""
    return tmp_path / "out"


@pytest.fixture(scope="session")
def meshes(tmp_path_factory):
    """A closed tetrahedron and the same without a face."""
    folder = tmp_path_factory.mktemp("meshes")
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.export(folder / "closed.obj")
    trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False).export(folder / "open.obj")
    return folder


def test_simulate_makes_a_data_set_and_overrides_reach_the_solver(succeed, tiny_yaml, out):
    """Keys of cli.md; --group.field changes one value, with a space or an equals sign."""
    words = ("simulate", "--config", tiny_yaml, "--solver.frames", "4", "--scene.spacing=0.05")
    result = succeed(*words, "--trajectories", 3, "--out", out, "--jobs", 1)
    assert {"trajectories", "points", "frames", "frame_dt", "seconds", "failed"} <= set(result)
    assert result["particle_substeps_per_second"] > 0
    assert (result["trajectories"], result["frames"], result["failed"]) == (3, 4, 0)
    assert json.loads((out / "metadata.json").read_text())["scene"]["spacing"] == 0.05


def test_train_stores_a_simulator_and_can_be_resumed(succeed, tiny_yaml, data_folder, out):
    """Keys of cli.md; a larger budget goes on where the smaller one ended."""
    words = ("train", "--config", tiny_yaml, "--data", data_folder, "--out", out)
    first = succeed(*words, "--max-steps", 2)
    keys = {"steps", "seconds", "steps_per_second", "best_rollout_mse", "parameters", "history"}
    assert keys <= set(first)
    assert first["steps"] == 2
    result = succeed(*words, "--max-steps", 4, "--resume")
    assert result["steps"] == 4
    simulator = Simulator.from_pretrained(out)
    stepper = simulator.dynamics.time_stepper
    assert result["parameters"] == sum(p.numel() for p in stepper.parameters())


def test_evaluate_writes_scores_and_leaves_strangers_alone(
    succeed, run_folder, data_folder, tmp_path
):
    """Keys of cli.md; metrics.json goes beside the model of a run and nowhere else."""
    result = succeed("evaluate", run_folder, "--data", data_folder, "--frames", 4)
    counts = {"system", "trajectories", "frames", "points", "sparse_points", "diverged"}
    assert counts | {"sparse", "full"} <= set(result)
    assert set(result["sparse"]) >= SCORES
    assert set(result["full"]) >= SCORES | {"projection_floor_mse"}
    assert result["frames"] == 4
    assert json.loads((run_folder / "metrics.json").read_text()) == result

    lonely = shutil.copytree(run_folder / "simulator", tmp_path / "deep" / "model")
    again = succeed("evaluate", lonely, "--data", data_folder, "--frames", 4)
    assert again["full"]["rollout_mse"] == result["full"]["rollout_mse"]
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["model"]


@pytest.mark.parametrize("extension", [".h5", ".vtkhdf", ".ply"])
def test_rollout_writes_the_format_of_the_extension(succeed, run_folder, out, extension):
    """The file named in the result exists and holds frames + 1 frames."""
    words = ("rollout", run_folder, "--shape", "capsule", "--frames", 2)
    result = succeed(*words, "--out", out / f"motion{extension}", "--sparse", 30)
    assert (result["frames"], result["sparse_points"]) == (2, 30)
    (written,) = result["files"]
    if extension == ".h5":
        motion = read_trajectory_file(out / "motion.h5")
        assert motion.position.shape == (3, result["points"], 3)
    elif extension == ".vtkhdf":
        with h5py.File(written) as file:
            assert file["VTKHDF/Steps"].attrs["NSteps"] == 3
    else:
        assert written == str(out / "motion")
        assert len(list((out / "motion").iterdir())) == 3


def test_rollout_starts_from_a_stored_trajectory_or_a_mesh(
    succeed, run_folder, data_folder, meshes, out
):
    """Frame 0 is the stored one; a closed mesh is filled."""
    words = ("rollout", "--pretrained", run_folder, "--frames", 1, "--out", out / "a.h5")
    succeed(*words, "--data", data_folder, "--trajectory", 0)
    with h5py.File(data_folder / "test.h5") as file:
        start = torch.from_numpy(file["00000/position"][0])
    assert torch.equal(read_trajectory_file(out / "a.h5").position[0], start)
    assert succeed(*words, "--shape", meshes / "closed.obj")["points"] > 100


def test_demo_judges_draws_and_writes(succeed, run_folder, out):
    """Keys of cli.md; every file it names exists."""
    words = ("demo", "--pretrained", run_folder, "--frames", 2, "--out", out)
    result = succeed(*words, "--points", 150, "--sparse", 30)
    keys = {"points", "sparse_points", "reduction", "frames", "rollout_mse", "speedup", "files"}
    keys |= TRIVIAL | {"projection_floor_mse", "seconds_per_frame", "solver_seconds_per_frame"}
    assert keys <= set(result)
    assert set(result["seconds_per_frame"]) >= {"graph", "network", "integrate", "upscale", "total"}
    assert (result["sparse_points"], result["frames"]) == (30, 2)
    assert result["files"]
    assert {str(path) for path in out.iterdir()} == set(result["files"])


def test_commands_say_what_they_did_unless_quiet(capsys, tiny_yaml, run_folder, data_folder, out):
    """A table or a line on stdout, nothing but progress on stderr."""
    calls = {
        "simulate": ("--config", tiny_yaml, "--trajectories", 1, "--out", out / "data"),
        "train": ("--config", tiny_yaml, "--data", data_folder, "--out", out / "run"),
        "evaluate": (run_folder, "--data", data_folder, "--frames", 3),
        "rollout": (run_folder, "--shape", "box", "--frames", 1, "--out", out / "a.h5"),
    }
    said = {"simulate": "trajectories", "train": "parameters", "evaluate": "rollout MSE"}
    for name, words in calls.items():
        more = ("--max-steps", 1) if name == "train" else ()
        assert main([str(word) for word in (name, *words, *more)]) == 0
        assert said.get(name, "particles") in capsys.readouterr().out


def test_help_of_every_command_ends_well(capsys):
    """Exit code 0, as everywhere."""
    for name in COMMANDS:
        assert main([name, "--help"]) == 0
        assert f"giorom {name}" in capsys.readouterr().out
    assert main(["--help"]) == 0
    listing = capsys.readouterr().out
    assert all(name in listing for name in COMMANDS)


def test_help_does_not_wait_for_pytorch():
    """Nothing heavy is imported before a command is chosen."""
    code = (
        "import sys; from giorom.cli import main; code = main(['--help']);"
        "heavy = {'torch', 'numpy', 'warp', 'h5py'} & set(sys.modules);"
        "sys.exit(code or ' '.join(sorted(heavy)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    assert b"simulate" in done.stdout


def test_names_of_models_are_whole_on_a_narrow_screen(capsys, monkeypatch):
    """A name that is cut short cannot be given to ``--pretrained``."""
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["models"]) == 0
    said = capsys.readouterr().out
    assert "elastic3d-small " in said
    assert "…" not in said


def test_unknown_command_offers_the_nearest(capsys):
    """A typing error costs one line."""
    assert main(["simulat"]) == 2
    assert "Did you mean 'simulate'?" in capsys.readouterr().err


@pytest.mark.parametrize("broken", ["open.obj", "missing.obj"])
@pytest.mark.parametrize("command", ["demo", "rollout", "simulate"])
def test_unusable_mesh_is_refused(refuse, meshes, run_folder, tiny_yaml, out, command, broken):  # noqa: PLR0917
    """The line names the file; no output appears."""
    shape = ("--shape", meshes / broken)
    words = {
        "demo": ("--pretrained", run_folder, "--out", out),
        "rollout": ("--pretrained", run_folder, "--out", out / "a.h5", "--frames", 1),
        "simulate": ("--config", tiny_yaml, "--out", out, "--trajectories", 1),
    }
    assert broken in refuse(command, *words[command], *shape)
    assert not out.exists()


def test_scene_outside_the_box_is_refused(refuse, tiny_yaml, out):
    """Before anything is simulated."""
    words = ("simulate", "--config", tiny_yaml, "--trajectories", 1, "--out", out)
    assert "beyond the upper wall" in refuse(*words, "--scene.height_range", "[3.0, 4.0]")
    assert not out.exists()


def test_damaged_data_are_refused(refuse, run_folder, tiny_yaml, data_copy, out):
    """A position that is not a number, then half a file: training and evaluation say which."""
    train = ("train", "--config", tiny_yaml, "--data", data_copy, "--out", out, "--max-steps", 2)
    for name in ("train", "test"):
        with h5py.File(data_copy / f"{name}.h5", "r+") as file:
            file["00000/position"][1, 0, 0] = float("nan")
    assert "not finite" in refuse(*train)
    assert "not finite" in refuse("evaluate", run_folder, "--data", data_copy)
    for name in ("train", "test"):
        content = (data_copy / f"{name}.h5").read_bytes()
        (data_copy / f"{name}.h5").write_bytes(content[: len(content) // 2])
    assert "train.h5 is truncated" in refuse(*train)
    assert "test.h5 is truncated" in refuse("evaluate", run_folder, "--data", data_copy)
    assert not out.exists()


def test_model_of_another_dimension_is_refused(refuse, run_folder, data_copy):
    """A flat data set and a model of bodies in space."""
    metadata = json.loads((data_copy / "metadata.json").read_text())
    metadata |= {"dim": 2, "bounds": metadata["bounds"][:2]}
    (data_copy / "metadata.json").write_text(json.dumps(metadata))
    with h5py.File(data_copy / "test.h5", "r+") as file:
        for group in file.values():
            position = group["position"][..., :2]
            del group["position"]
            group["position"] = position
            group.attrs["bounds"] = group.attrs["bounds"][:2]
    assert "2-dimensional" in refuse("evaluate", run_folder, "--data", data_copy)


def test_damaged_model_is_refused(refuse, run_folder, out, tmp_path):
    """Half the weights are no model."""
    model = shutil.copytree(run_folder / "simulator", tmp_path / "model")
    content = (model / "model.safetensors").read_bytes()
    (model / "model.safetensors").write_bytes(content[:1000])
    words = ("rollout", model, "--shape", "capsule", "--frames", 1, "--out", out / "a.h5")
    assert "model.safetensors" in refuse(*words)
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("simulate", "elastic3dsmall"), "Did you mean 'elastic3d-small'?"),
        (("simulate", "elastic3d-small", "--trajectory", "3"), "--trajector"),
        (("simulate", "elastic3d-small", "--job", "1", "--frmes", "3"), "no option '--frmes'"),
        (("simulate", "elastic3d-small", "--scene.spaceing", "1"), "Did you mean 'spacing'?"),
        (("simulate", "elastic3d-small", "--scen.spacing", "1"), "Did you mean 'scene'?"),
        (("simulate", "elastic3d-small", "--scene.spacing", "[1"), "not a value"),
        (("simulate", "elastic3d-small", "--scene.spacing"), "needs a value"),
        (("simulate", "elastic3d-small", "--trajectories", "0"), ">= 1"),
        (("simulate", "elastic3d-small", "--jobs", "0"), ">= 1"),
        (("simulate", "elastic3d-small", "--seed", "-1"), "whole number from 0"),
        (("simulate", "elastic3d-small", "--seed", "x"), "whole number from 0"),
        (("simulate", "elastic3d-small", "--threads", "0"), ">= 1"),
        (("simulate",), "name of a preset or --config"),
    ],
)
def test_mistyped_simulation_is_refused(refuse, out, words, text):
    """One line each, with the way out; no folder appears."""
    given = () if "--trajectories" in words else ("--trajectories", "1")
    assert text in refuse(words[0], *given, "--out", out, *words[1:])
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--frames", "0"), ">= 1"),
        (("--sparse", "100000"), "between 1 and"),
        (("--sparse", "0"), "between 1 and"),
        (("--seed", "-3"), "whole number from 0"),
        (("--bogus", "1"), "--bogus"),
        (("--shape", "capsul"), "capsule"),
    ],
)
@pytest.mark.parametrize("command", ["demo", "rollout"])
def test_mistyped_rollout_is_refused(refuse, run_folder, out, command, words, text):  # noqa: PLR0917
    """The same rules for both commands that roll out."""
    common = ("--pretrained", run_folder, "--shape", "capsule", "--frames", "1")
    target = out / "a.h5" if command == "rollout" else out
    assert text in refuse(command, *common, "--out", target, *words)
    assert not out.exists()


def test_unknown_extension_is_refused_before_the_model_is_read(refuse, out):
    """Formats that exist are listed."""
    words = ("rollout", "nothing", "--shape", "capsule", "--frames", 1, "--out", out / "a.xyz")
    line = refuse(*words)
    assert ".xyz" in line
    assert ".vtkhdf" in line
    assert not out.exists()


def test_budget_is_required_and_positive(refuse, tiny_yaml, data_folder, out):
    """An endless training is a mistake."""
    words = ("train", "--config", tiny_yaml, "--data", data_folder, "--out", out)
    assert "--max-steps" in refuse(*words)
    assert "> 0" in refuse(*words, "--max-minutes", "0")
    assert not out.exists()


def test_outputs_that_cannot_be_written_are_refused_first(
    refuse, run_folder, tiny_yaml, data_folder, tmp_path
):
    """A file where a folder is to be, a folder where a file is, a folder that is missing."""
    file = tmp_path / "file"
    file.write_text("kept")
    rollout = ("rollout", run_folder, "--shape", "capsule", "--frames", 1, "--out")
    simulate = ("simulate", "--config", tiny_yaml, "--trajectories", 1, "--out")
    train = ("train", "--config", tiny_yaml, "--data", data_folder, "--max-steps", 1, "--out")
    for words in (simulate, train, ("demo", "--pretrained", run_folder, "--out")):
        assert "there is a file" in refuse(*words, file)
        assert "is a file, not a folder" in refuse(*words, file / "inside")
    assert "is a file, not a folder" in refuse(*rollout, file / "a.h5")
    (tmp_path / "a.h5").mkdir()
    assert "there is a folder" in refuse(*rollout, tmp_path / "a.h5")
    missing = tmp_path / "missing" / "x.json"
    assert "does not exist" in refuse(*rollout, tmp_path / "b.h5", "--json", missing)
    assert "there is a folder" in refuse(*rollout, tmp_path / "b.h5", "--json", tmp_path)
    assert file.read_text() == "kept"
    assert not (tmp_path / "b.h5").exists()


def test_interruption_has_its_own_exit_code(monkeypatch, capsys, tiny_yaml, out):
    """130, the shell's convention, and a line that says how to go on."""
    from giorom.commands import simulate

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulate, "generate", interrupted)
    words = ["simulate", "--config", str(tiny_yaml), "--trajectories", "1", "--out", str(out)]
    assert main([*words, "--quiet"]) == 130
    assert "--resume" in capsys.readouterr().err


def test_failed_work_has_its_own_exit_code(monkeypatch, capsys, tiny_yaml, out):
    """3, and one line with the kind of the failure."""
    from giorom.commands import simulate

    def failing(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(simulate, "generate", failing)
    words = ["simulate", "--config", str(tiny_yaml), "--trajectories", "1", "--out", str(out)]
    assert main([*words, "--quiet"]) == 3
    assert capsys.readouterr().err == "giorom simulate: OSError: disk full\n"


def test_preset_may_stand_before_or_after_the_options(succeed, tiny_values, tmp_path, out):
    """A value of an override is never taken for the name of a preset."""
    file = tmp_path / "other.yaml"
    file.write_text(yaml.safe_dump(tiny_values))
    options = ("--trajectories", 1, "--out", out, "--solver.frames", 3, "--jobs", 1)
    before = succeed("simulate", file, *options)
    after = succeed("simulate", *options, file)
    assert before["points"] == after["points"]
    assert before["frames"] == after["frames"] == 3


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [
        ("--scene.spacing", "1e-9", "needs a lattice"),
        ("--scene.spacing", ".inf", "spacing must be > 0"),
        ("--scene.gravity", "-9.8", "gravity points down"),
        ("--scene.gravity", ".nan", "gravity points down"),
        ("--solver.grid_cells", "100000", "at most 1024"),
        ("--threads", "99999", "<= 1024"),
        ("--json", "/dev/null", "is a device"),
        ("--json", "x" * 5000, "cannot be written"),
        ("--shape", "x" * 5000 + ".obj", "does not exist"),
    ],
)
def test_absurd_values_are_refused_before_work(refuse, tiny_yaml, out, option, value, text):  # noqa: PLR0917
    """Neither memory nor a device file is touched for them."""
    words = ("simulate", "--config", tiny_yaml, "--trajectories", 1, "--out", out)
    assert text in refuse(*words, option, value)
    assert not out.exists()


@pytest.mark.parametrize("text", ["1: 2", "~: 2", "[" * 5000])
def test_strange_yaml_is_refused(refuse, tmp_path, out, text):
    """Keys that are no words, and lists without an end."""
    file = tmp_path / "strange.yaml"
    file.write_text(text)
    assert "strange.yaml" in refuse("simulate", file, "--trajectories", 1, "--out", out)


@pytest.mark.parametrize("name", ["broken.zip", "broken.dae", "broken.step", "broken.3mf"])
def test_mesh_of_a_reader_that_is_missing_is_refused(refuse, run_folder, tmp_path, out, name):
    """Whatever the library behind a format raises."""
    (tmp_path / name).write_bytes(b"no mesh")
    words = ("rollout", run_folder, "--frames", 1, "--out", out / "a.h5")
    assert name in refuse(*words, "--shape", tmp_path / name)


def test_endless_rollout_is_refused(refuse, run_folder, out):
    """Before the first frame."""
    words = ("--shape", "box", "--frames", 10**9)
    assert "GiB" in refuse("rollout", run_folder, *words, "--out", out / "a.h5")
    assert "GiB" in refuse("demo", "--pretrained", run_folder, *words, "--out", out)


def test_unknown_particle_type_is_refused(refuse, run_folder, data_copy):
    """The embedding has one slot for each of nine types."""
    with h5py.File(data_copy / "test.h5", "r+") as file:
        file["00000/particle_type"][0] = 99
    assert "holds 99" in refuse("evaluate", run_folder, "--data", data_copy)


def test_endless_frame_is_refused(capsys, tiny_yaml, out):
    """Substeps without number are a wrong unit; nothing is begun."""
    words = ["simulate", "--config", str(tiny_yaml), "--trajectories", "1", "--out", str(out)]
    assert main([*words, "--quiet", "--solver.frame_dt", "1e300"]) == 2
    assert "substeps" in capsys.readouterr().err
    assert not out.exists()
