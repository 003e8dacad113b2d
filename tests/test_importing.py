"""An import is the inverse of nothing lost: what is stored is what the source said, or nothing is.

Sources are made here by hand; the readers of real formats have tests of their own.
"""

import json

import numpy as np
import pytest

from giorom.data.conversion import Conversion, converted
from giorom.data.importing import ImportOptions, import_trajectories
from giorom.data.metadata import DataError, read_metadata
from giorom.data.own_dataset import is_own, own_trajectories
from giorom.data.readers import from_arrays
from giorom.data.readers.source import ForeignTrajectory
from giorom.data.report import Origin
from giorom.data.statistics import Statistics, measure_statistics
from giorom.data.trajectory_file import SPLITS, iterate_trajectories, trajectory_count
from giorom.state import KINEMATIC, SAND, WATER

h5py = pytest.importorskip("h5py")

FRAME_DT = 0.0025
BOX = np.array([[0.1, 0.9]] * 2)


def positions(number=0, *, frames=14, count=30, dim=2):
    """A cloud that falls and drifts."""
    rng = np.random.default_rng(number)
    start = 0.3 + 0.3 * rng.random((count, dim))
    velocity = 0.2 * rng.standard_normal((count, dim))
    time = FRAME_DT * np.arange(frames)[:, None, None]
    fall = np.array([0.0, -9.81, 0.0][:dim])
    return (start + velocity * time + 0.5 * fall * time**2).astype(np.float32)


def foreign(number=0, *, position=None, **changes):
    position = positions(number) if position is None else position
    values = {
        "name": f"file[{number}]",
        "particle_type": np.full(position.shape[1], SAND),
        "frames": lambda: iter(position),
        "frame_dt": FRAME_DT,
        "bounds": BOX,
    }
    return ForeignTrajectory(**(values | changes))


def load(source, folder, *, progress=lambda name, frames: None, **options):
    """Import into a folder."""
    conversion = Conversion(**options.pop("conversion", {}))
    return import_trajectories(
        source,
        folder,
        options=ImportOptions(conversion=conversion, **options),
        origin=Origin(format="test", source="file"),
        progress=progress,
    )


def stored(folder):
    """Every trajectory of a data set by its name in the source."""
    return {
        t.attributes["source"]: t for split in SPLITS for t in iterate_trajectories(folder, split)
    }


def test_everything_is_stored_as_the_source_has_it(tmp_path):
    """Positions bit for bit, types, time, walls; each trajectory once."""
    kinds = np.array([KINEMATIC] * 3 + [WATER] * 27)
    load([foreign(i, particle_type=kinds) for i in range(7)], tmp_path / "set")
    found = stored(tmp_path / "set")
    assert sorted(found) == [f"file[{i}]" for i in range(7)]
    for number in range(7):
        trajectory = found[f"file[{number}]"]
        assert np.array_equal(trajectory.position.numpy(), positions(number))
        assert trajectory.particle_type.tolist() == kinds.tolist()
        assert trajectory.frame_dt == FRAME_DT
        np.testing.assert_allclose(trajectory.bounds, BOX, rtol=1e-6)


def test_the_metadata_are_those_of_an_equal_data_set(tmp_path):
    """Statistics of the stored training split, counted and measured again from the files."""
    report = load([foreign(i) for i in range(7)], tmp_path / "set")
    metadata = read_metadata(tmp_path / "set")
    again = measure_statistics(iterate_trajectories(tmp_path / "set", "train")).to_metadata()
    for key, value in Statistics.from_metadata(metadata).to_metadata().items():
        np.testing.assert_allclose(value, again[key], rtol=1e-9, atol=1e-18)
    assert metadata["num_trajs_train"] == trajectory_count(tmp_path / "set", "train")
    assert metadata["default_connectivity_radius"] == report.suggestion.radius
    assert metadata["dt"] == FRAME_DT
    assert metadata["system"] == "imported"
    assert not (tmp_path / "set" / "parts").exists()
    assert json.loads((tmp_path / "set" / "report.json").read_text()) == report.as_json()
    assert (tmp_path / "set" / "report.md").read_text().startswith("# file")


def test_measured_gravity_is_kept_for_the_free_fall_baseline(tmp_path):
    load([foreign(i) for i in range(3)], tmp_path / "set")
    for trajectory in stored(tmp_path / "set").values():
        assert trajectory.attributes["gravity"] == pytest.approx(9.81, rel=0.02)


def test_frames_are_read_one_by_one(tmp_path):
    """A source of many frames is never in memory: at most one frame ahead of the writer."""
    alive = {"now": 0, "most": 0}

    class Frame(np.ndarray):
        def __del__(self):
            alive["now"] -= 1

    def frames():
        for frame in positions(frames=200):
            alive["now"] += 1
            alive["most"] = max(alive["most"], alive["now"])
            yield frame.view(Frame)

    load([foreign(i, frames=frames) for i in range(3)], tmp_path / "set")
    assert alive["most"] <= 4


# Splits.


@pytest.mark.parametrize(
    ("said", "counts"),
    [
        ([None] * 10, (8, 1, 1)),
        (["train"] * 6 + ["valid"] * 2 + ["test"] * 2, (6, 2, 2)),
        (["train"] * 9 + ["test"], (8, 1, 1)),
        (["train"] * 10, (8, 1, 1)),
        (["test"] * 10, (8, 1, 1)),
    ],
)
def test_parts_are_those_of_the_source_and_validation_is_never_missing(tmp_path, said, counts):
    report = load([foreign(i, split=s) for i, s in enumerate(said)], tmp_path / "set")
    found = tuple(trajectory_count(tmp_path / "set", split) for split in SPLITS)
    assert found == counts
    assert tuple(report.facts["splits"].values()) == counts
    moved = said[0] is not None and "valid" not in said
    assert any("valid" in note or "divided" in note for note in report.notes) == moved


def test_given_shares_outweigh_the_source(tmp_path):
    load([foreign(i, split="train") for i in range(10)], tmp_path / "set", shares=(0.3, 0.2))
    assert [trajectory_count(tmp_path / "set", split) for split in SPLITS] == [5, 3, 2]


def test_test_trajectories_of_the_source_stay_in_test(tmp_path):
    said = ["train"] * 5 + ["test"] * 2
    load([foreign(i, split=s) for i, s in enumerate(said)], tmp_path / "set")
    names = {t.attributes["source"] for t in iterate_trajectories(tmp_path / "set", "test")}
    assert names == {"file[5]", "file[6]"}


# Conversion.


def test_stride_skip_unit_and_axes_change_what_they_say(tmp_path):
    """Frames 2, 5, 8, 11 of x, y in centimetres with y down."""
    source = [
        foreign(i, position=100.0 * positions(i) * np.array([1.0, -1.0]), bounds=None)
        for i in range(3)
    ]
    conversion = {"stride": 3, "skip": 2, "scale": 0.01, "axes": "x,-y"}
    report = load(source, tmp_path / "set", conversion=conversion)
    trajectory = stored(tmp_path / "set")["file[0]"]
    np.testing.assert_allclose(trajectory.position, positions(0)[2::3], rtol=1e-5)
    assert trajectory.frame_dt == pytest.approx(3.0 * FRAME_DT)
    assert len(report.notes) == 5  # four changes and the walls


@pytest.mark.parametrize("frame_dt", [1e-320, 1e-200, 1e200])
def test_an_absurd_time_between_frames_is_refused(tmp_path, frame_dt):
    """Its square has no place in float64, so that no acceleration has."""
    with pytest.raises(DataError, match="no float32 holds"):
        load([foreign()], tmp_path / "set", conversion={"frame_dt": frame_dt})
    with pytest.raises(DataError, match="no float32 holds"):
        converted(foreign(frame_dt=frame_dt), Conversion())
    assert list(tmp_path.iterdir()) == []


def test_walls_follow_unit_and_axes():
    """A box in cm seen with axes z, -x: both change, low stays below high."""
    box = np.array([[10.0, 20.0], [0.0, 1.0], [-5.0, 30.0]])
    position = np.zeros((2, 4, 3))
    source = foreign(position=position, bounds=box)
    found = converted(source, Conversion(scale=0.01, axes="z,-x"))
    np.testing.assert_allclose(found.bounds, [[-0.05, 0.3], [-0.2, -0.1]])
    assert converted(source, Conversion(bounds=(0.0, 1.0, 2.0, 3.0))).bounds.tolist() == [
        [0.0, 1.0],
        [2.0, 3.0],
    ]


def test_walls_without_a_type_can_be_told_by_their_rest(tmp_path):
    """Five particles that never move become kinematic, and so leave the statistics."""
    position = [positions(i) for i in range(3)]
    for motion in position:
        motion[:, :5] = motion[0, :5]
    source = [foreign(i, position=p) for i, p in enumerate(position)]
    report = load(source, tmp_path / "set", frozen_kinematic=True)
    assert report.facts["types"] == {"3": 15, "6": 75}
    assert report.facts["frozen"] == 0
    assert sum("never move were made kinematic" in note for note in report.notes) == 3
    free = [foreign(i, position=p[:, 5:]) for i, p in enumerate(position)]
    alone = load(free, tmp_path / "free").facts["statistics"]
    assert report.facts["statistics"] == alone
    assert load(source, tmp_path / "plain").facts["frozen"] == 15
    still = foreign(9, position=np.repeat(positions()[:1], 5, axis=0))
    report = load([*source, still], tmp_path / "still", frozen_kinematic=True)
    assert report.facts["types"] == {"3": 15, "6": 105}


@pytest.mark.parametrize("keep", [(0, 1), (3, 1), (0, 4), (5, 3), (40, 2)])
def test_announced_and_delivered_frames_agree(keep):
    skip, stride = keep
    found = converted(foreign(frame_count=14), Conversion(skip=skip, stride=stride))
    assert found.frame_count == len(list(found.frames()))


@pytest.mark.parametrize(("said", "replaced"), [(None, 0), (0.005, 0), (1.0 / 60.0, 1)])
def test_a_given_time_that_contradicts_the_source_is_noted(tmp_path, said, replaced):
    """One note for all trajectories, with both numbers; none where nothing is contradicted."""
    source = [foreign(i, frame_dt=said) for i in range(3)]
    report = load(source, tmp_path / "set", conversion={"frame_dt": 0.005})
    assert report.facts["frame_dt"] == 0.005
    note = "--frame-dt 0.005 replaces the 0.0166667 s between frames that the source says."
    assert report.notes.count(note) == replaced
    assert sum("replaces" in line for line in report.notes) == replaced


def test_unknown_walls_are_put_half_a_spacing_around_the_particles(tmp_path):
    axis = 0.1 * np.arange(5)
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    shift = np.array([[0.01 * k * k, 0.01 * k] for k in range(9)])
    moved = (lattice + shift[:, None]).astype(np.float32)
    report = load([foreign(i, position=moved, bounds=None) for i in range(3)], tmp_path / "set")
    expected = [[-0.05, 0.4 + 0.64 + 0.05], [-0.05, 0.4 + 0.08 + 0.05]]
    np.testing.assert_allclose(read_metadata(tmp_path / "set")["bounds"], expected, atol=1e-3)
    assert any("does not say where its walls are" in note for note in report.notes)
    assert report.facts["bounds_given"] is False


def test_different_walls_become_one_box_around_all(tmp_path):
    boxes = [BOX, BOX + 0.05, BOX]
    report = load([foreign(i, bounds=b) for i, b in enumerate(boxes)], tmp_path / "set")
    np.testing.assert_allclose(read_metadata(tmp_path / "set")["bounds"], [[0.1, 0.95]] * 2)
    assert any("different bounds" in note for note in report.notes)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"frame_dt": 0.0}, "--frame-dt must be > 0"),
        ({"frame_dt": float("nan")}, "--frame-dt must be > 0"),
        ({"scale": -1.0}, "--scale must be > 0"),
        ({"stride": 0}, "--stride must be >= 1"),
        ({"skip": -1}, "--skip must be >= 0"),
        ({"particle_type": 9}, "--particle-type must lie between 0 and 8"),
        ({"bounds": (0.0, 1.0, 2.0)}, "--bounds needs LOW HIGH"),
        ({"bounds": (0.0, 1.0, 2.0, 1.0)}, "LOW < HIGH"),
        ({"bounds": (0.0, float("inf"), 0.0, 1.0)}, "must be finite"),
        ({"axes": "x,x"}, "--axes must name"),
        ({"axes": "x"}, "--axes must name"),
        ({"axes": "x,w"}, "--axes must name"),
    ],
)
def test_conversions_nothing_can_be_made_of_are_refused(values, message):
    with pytest.raises(DataError, match=message):
        Conversion(**values)


# What is refused leaves nothing behind.


def bad_positions():
    position = positions(1)
    position[5, 7, 1] = np.nan
    return position


def truncated():
    yield from positions(1)[:5]
    raise DataError("file[1] is truncated after frame 5. Copy it again.")


def grown():
    yield positions(1)[0]
    yield np.concatenate([positions(1)[1]] * 2)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({"position": bad_positions()}, r"file.1.: particle 7 is at .* at frame 5"),
        ({"position": np.full((5, 30, 2), 1e39)}, "particle 0 is at .* at frame 0"),
        ({"frames": truncated}, "truncated after frame 5"),
        ({"frames": grown}, "60 particles on 2 axes at frame 1, where 30 on 2 are needed"),
        ({"frames": lambda: iter(())}, "has no frame to keep"),
        ({"position": positions(dim=3), "bounds": None}, "30 particles on 3 axes at frame 0"),
        ({"position": np.zeros((5, 30, 1)), "bounds": None}, "on 1 axes"),
        ({"frame_dt": None}, "--frame-dt SECONDS"),
        ({"frame_dt": -1.0}, "--frame-dt SECONDS"),
        ({"frame_dt": 0.5}, "share it"),
        ({"particle_type": np.full(30, 12)}, "type 12"),
        ({"particle_type": np.zeros(0, np.int64)}, "0 particles"),
        ({"bounds": np.array([[0.0, 1.0]] * 3)}, "bounds for 3"),
    ],
)
def test_bad_sources_are_refused_in_one_line_and_leave_nothing(tmp_path, second, message):
    source = [foreign(0), foreign(1, **second), foreign(2)]
    with pytest.raises(DataError, match=message) as caught:
        load(source, tmp_path / "set")
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_source_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no trajectory to import"):
        load([], tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_data_without_a_free_particle_are_refused(tmp_path):
    kinds = np.full(30, KINEMATIC)
    with pytest.raises(ValueError, match="no acceleration can be measured"):
        load([foreign(i, particle_type=kinds) for i in range(3)], tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "second",
    [
        {"position": bad_positions()},
        {"frames": truncated},
        {"frames": grown},
        {"frame_dt": 2.0 * FRAME_DT},
        {"frame_dt": None},
        {"particle_type": np.full(30, 77)},
    ],
)
def test_bad_trajectories_can_be_left_out_and_are_listed(tmp_path, second):
    source = [foreign(0), foreign(1, **second), foreign(2), foreign(3)]
    report = load(source, tmp_path / "set", drop_bad=True)
    assert sorted(stored(tmp_path / "set")) == ["file[0]", "file[2]", "file[3]"]
    assert report.facts["trajectories"] == 3
    assert sum(note.startswith("Left out: file[1]") for note in report.notes) == 1
    whole = load([foreign(0), foreign(2), foreign(3)], tmp_path / "other")
    assert report.facts == whole.facts


def broken_off(readable):
    """A reader that gives up after some trajectories."""
    yield from (foreign(i) for i in range(readable))
    raise DataError("file: record 3 fails its check sum. Copy it again.")


def test_what_was_read_before_a_source_broke_off_can_be_kept(tmp_path):
    """The same as the readable part alone, except that it says what is missing."""
    report = load(broken_off(3), tmp_path / "set", drop_bad=True)
    whole = load([foreign(i) for i in range(3)], tmp_path / "other")
    assert report.facts == whole.facts
    assert stored(tmp_path / "set").keys() == stored(tmp_path / "other").keys()
    said = [note for note in report.notes if "The rest of the source could not be read" in note]
    assert said == [note for note in report.notes if "record 3 fails its check sum" in note]
    assert len(said) == 1


@pytest.mark.parametrize(("readable", "drop_bad"), [(0, True), (3, False)])
def test_a_source_that_breaks_off_is_refused_without_leave_or_content(tmp_path, readable, drop_bad):
    with pytest.raises(DataError, match="record 3 fails its check sum"):
        load(broken_off(readable), tmp_path / "set", drop_bad=drop_bad)
    assert list(tmp_path.iterdir()) == []


def test_when_all_are_bad_nothing_is_left(tmp_path):
    source = [foreign(1, position=bad_positions())]
    with pytest.raises(DataError, match="All were dropped, the first: file"):
        load(source, tmp_path / "set", drop_bad=True)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_import_says_so_and_leaves_nothing(tmp_path):
    def interrupted():
        yield from positions(1)[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="nothing was left at"):
        load([foreign(0), foreign(1, frames=interrupted)], tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_data_set_is_never_overwritten(tmp_path):
    load([foreign(i) for i in range(3)], tmp_path / "set")
    before = {p.name: p.read_bytes() for p in (tmp_path / "set").iterdir()}
    with pytest.raises(DataError, match="already exists and is not empty"):
        load([foreign(i) for i in range(4)], tmp_path / "set")
    assert {p.name: p.read_bytes() for p in (tmp_path / "set").iterdir()} == before


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "set").mkdir()
    load([foreign(i) for i in range(3)], tmp_path / "set")
    assert is_own(tmp_path / "set")
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_limit_takes_the_first_trajectories_and_reads_no_other(tmp_path):
    def unread():
        raise AssertionError("must not be read")
        yield

    source = [foreign(0), foreign(1), foreign(2), foreign(3, frames=unread)]
    load(source, tmp_path / "set", limit=3)
    assert sorted(stored(tmp_path / "set")) == ["file[0]", "file[1]", "file[2]"]


def test_progress_hears_of_every_frame(tmp_path):
    heard = []
    load([foreign(i) for i in range(3)], tmp_path / "set", progress=lambda *a: heard.append(a))
    assert heard == [(f"file[{i}]", 1) for i in range(3) for _ in range(14)]


def test_arrays_of_a_program_become_a_data_set(tmp_path):
    """Generators that are read once are enough."""
    source = (
        from_arrays(iter(positions(i)), frame_dt=FRAME_DT, name=f"run {i}", bounds=BOX)
        for i in range(4)
    )
    load(source, tmp_path / "set")
    found = stored(tmp_path / "set")
    for number in range(4):
        assert np.array_equal(found[f"run {number}"].position.numpy(), positions(number))


# Our own data as a source.


def test_our_own_data_set_is_read_back_as_it_was_written(tmp_path):
    load([foreign(i) for i in range(5)], tmp_path / "set")
    assert is_own(tmp_path / "set")
    assert is_own(tmp_path / "set" / "train.h5")
    assert not is_own(tmp_path)
    assert not is_own(tmp_path / "set" / "metadata.json")
    expected = [t for split in SPLITS for t in iterate_trajectories(tmp_path / "set", split)]
    found = list(own_trajectories(tmp_path / "set"))
    assert [f.split for f in found] == ["train"] * 3 + ["valid", "test"]
    for ours, theirs in zip(found, expected, strict=True):
        assert np.array_equal(np.stack(list(ours.frames())), theirs.position.numpy())
        assert ours.frame_count == theirs.frame_count
        assert ours.frame_dt == theirs.frame_dt
        assert ours.particle_type.tolist() == theirs.particle_type.tolist()
    alone = list(own_trajectories(tmp_path / "set" / "train.h5"))
    assert [f.split for f in alone] == [None] * 3


def test_an_import_of_our_own_data_is_the_same_data(tmp_path):
    load([foreign(i) for i in range(5)], tmp_path / "one")
    load(own_trajectories(tmp_path / "one"), tmp_path / "two")
    for split in SPLITS:
        pairs = zip(
            iterate_trajectories(tmp_path / "one", split),
            iterate_trajectories(tmp_path / "two", split),
            strict=True,
        )
        assert all(np.array_equal(a.position, b.position) for a, b in pairs)
