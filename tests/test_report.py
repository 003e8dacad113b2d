"""The report: every number against a closed form, every suspicion against data that show just it.

The sound data are a cloud thrown upwards in free fall from the scheme x = x0 + v t + g t^2 / 2: no
suspicion may be raised about them. Each test spoils one thing.
"""

import json
import math

import numpy as np
import pytest
import torch

from giorom.data.conversion import Conversion
from giorom.data.importing import measure_trajectories
from giorom.data.metadata import DataError
from giorom.data.motion_checks import grid_of, nearest_neighbors, rows_are_shuffled
from giorom.data.readers.source import ForeignTrajectory
from giorom.data.report import Origin, make_report
from giorom.data.report_text import TYPES, markdown, overview_rows, statistics_rows
from giorom.data.statistics import Statistics, measure_statistics
from giorom.data.thinned import Thinned
from giorom.export.inspection import draw_histograms, draw_motions
from giorom.mpm.materials import MATERIALS
from giorom.state import KINEMATIC, WATER, Trajectory

FRAME_DT, FRAMES = 0.005, 14
BOX = np.array([[-10.0, 10.0]] * 3)


def motion(*, dim=3, count=100, frames=FRAMES, seed=0, gravity=9.81, frame_dt=FRAME_DT):
    """Positions (t, p, d) of a cloud in free fall that is slowly stirred."""
    rng = np.random.default_rng(seed)
    start = rng.random((count, dim))
    velocity = np.array([0.3, 2.0, -0.2][:dim]) + 0.3 * (start - 0.5)
    time = frame_dt * np.arange(frames)[:, None, None]
    fall = np.zeros(dim)
    fall[1] = -gravity
    stir = 0.02 * rng.standard_normal((count, dim)) * np.sin(8.0 * time)
    return start + velocity * time + 0.5 * fall * time**2 + stir


def foreign(position, *, kinds=None, dtype=np.float32, **changes):
    """A motion as a reader gives it."""
    frames = [frame.astype(dtype) for frame in position]
    values = {
        "name": "cloud[0]",
        "particle_type": np.full(position.shape[1], WATER) if kinds is None else np.array(kinds),
        "frames": lambda: iter(frames),
        "frame_dt": FRAME_DT,
        "bounds": BOX[: position.shape[2]],
    }
    return ForeignTrajectory(**(values | changes))


def report_of(*motions, conversion=None, origin=None):
    """The report of some motions."""
    measure, complete = measure_trajectories(
        motions, conversion=conversion or Conversion(), progress=lambda name, frames: None
    )
    if origin is None:
        origin = Origin(format="test", source="cloud", complete=complete)
    return make_report(measure, origin)


def three(spoil=lambda position: position, **options):
    """Three motions, the first of which is spoilt."""
    sound = [motion(seed=seed) for seed in range(3)]
    return [foreign(spoil(sound[0]), **options), *(foreign(p) for p in sound[1:])]


def suspicions(*motions, **options):
    return report_of(*motions, **options).suspicious


def only(found, text):
    """The one suspicion there is, which must speak of ``text``."""
    assert len(found) == 1, found
    assert text in found[0]
    return found[0]


def test_nothing_is_suspicious_about_sound_data():
    """In space, in the plane, in float64."""
    assert suspicions(*three()) == []
    assert suspicions(*(foreign(motion(dim=2, seed=seed)) for seed in range(3))) == []
    assert suspicions(*(foreign(motion(seed=s), dtype=np.float64) for s in range(3))) == []


def test_numbers_are_those_of_the_arrays():
    positions = [motion(seed=seed, count=100 + seed) for seed in range(3)]
    facts = report_of(*(foreign(p, dtype=np.float64) for p in positions)).facts
    assert facts["trajectories"] == 3
    assert (facts["points_min"], facts["points_mean"], facts["points"]) == (100, 101.0, 102)
    assert (facts["frames"], facts["frames_max"], facts["frame_dt"]) == (FRAMES, FRAMES, FRAME_DT)
    flat = np.concatenate([p.reshape(-1, 3) for p in positions])
    expected = np.stack([flat.min(axis=0), flat.max(axis=0)], axis=1)
    np.testing.assert_allclose(facts["extent"], expected, rtol=1e-5)
    trajectories = [
        Trajectory(
            position=torch.from_numpy(p),
            particle_type=torch.full((p.shape[1],), WATER),
            frame_dt=FRAME_DT,
            bounds=torch.from_numpy(BOX),
        )
        for p in positions
    ]
    measured = measure_statistics(trajectories)
    for key, value in measured.to_metadata().items():
        np.testing.assert_allclose(facts["statistics"][key], value, rtol=1e-9, atol=1e-15)
    for key, value in measured.in_si(frame_dt=FRAME_DT).to_metadata().items():
        np.testing.assert_allclose(facts["statistics"]["si"][key], value, rtol=1e-9, atol=1e-12)
    steps = max(np.linalg.norm(np.diff(p, axis=0), axis=2).max() for p in positions)
    assert facts["largest_step"]["metres"] == pytest.approx(steps, rel=1e-5)
    np.testing.assert_allclose(facts["gravity"], [0.0, -9.81, 0.0], atol=0.05)
    assert "metres and seconds" in facts["units"]


def test_the_largest_step_is_found_where_it_is():
    position = motion()
    position[7:, 31, 0] += 0.04
    step = report_of(foreign(position)).facts["largest_step"]
    assert (step["frame"], step["particle"], step["trajectory"]) == (7, 31, "cloud[0]")


def test_the_spacing_of_a_lattice_is_its_constant():
    axis = 0.05 * np.arange(8)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    found = nearest_neighbors(lattice)
    assert found.spacing == pytest.approx(0.05)
    distance = np.linalg.norm(lattice[found.particle] - lattice[found.nearest], axis=1)
    np.testing.assert_allclose(distance, 0.05)


def test_suggested_samples_are_a_twentieth_within_limits():
    """Of 100 particles all; of 6,000 a twentieth. The radius connects the samples."""
    small = report_of(foreign(motion())).facts["suggested"]
    assert small["sparse_points"] == 100
    large = report_of(foreign(motion(count=6000, frames=4))).facts["suggested"]
    assert large["sparse_points"] == 300
    assert large["radius"] > small["radius"] * 0.5
    assert large["neighbors"] > 3.0


# Time and units.


def test_centimetres_are_recognised_by_gravity():
    found = suspicions(*(foreign(100.0 * p, bounds=100.0 * BOX) for p in map_seeds()))
    assert "--unit cm" in only(found, "100 times 9.81")
    assert suspicions(*three(), conversion=Conversion()) == []


def test_the_advised_unit_cures_the_suspicion():
    motions = [foreign(1000.0 * p, bounds=1000.0 * BOX) for p in map_seeds()]
    assert "--unit mm" in only(suspicions(*motions), "1000 times 9.81")
    assert suspicions(*motions, conversion=Conversion(scale=0.001)) == []


def test_a_wrong_time_between_frames_is_named_with_the_right_one():
    """Label dt/2: gravity seems four times too strong, and sqrt(4) dt/2 = dt is proposed."""
    motions = [foreign(p, frame_dt=FRAME_DT / 2) for p in map_seeds()]
    found = only(suspicions(*motions), "s apart and not 0.0025 s (--frame-dt)")
    proposed = float(found.split("the frames are ")[1].split()[0])
    assert proposed == pytest.approx(FRAME_DT, rel=0.01)
    assert suspicions(*motions, conversion=Conversion(frame_dt=FRAME_DT)) == []


def test_an_unknown_time_between_frames_is_said():
    motions = [foreign(p, frame_dt=None) for p in map_seeds()]
    report = report_of(*motions)
    assert "--frame-dt" in only(report.suspicious, "is not known")
    assert report.facts["gravity"] is None
    assert report.facts["statistics"]["si"] is None


def test_different_times_between_frames_are_said():
    motions = [foreign(p, frame_dt=FRAME_DT * (1 + i)) for i, p in enumerate(map_seeds())]
    assert "--frame-dt" in only(suspicions(*motions), "differs (0.005, 0.01, 0.015 s)")


def map_seeds():
    return [motion(seed=seed) for seed in range(3)]


@pytest.mark.parametrize(
    ("order", "signs"),
    [
        ((0, 2, 1), (1, 1, 1)),
        ((1, 0, 2), (1, 1, 1)),
        ((0, 1, 2), (1, -1, 1)),
        ((0, 2, 1), (1, 1, -1)),
        ((1, 0, 2), (-1, 1, 1)),
    ],
)
def test_another_upward_axis_is_named_and_the_advice_cures_it(order, signs):
    """The advised axes are a turn: no mirror image, and things fall along -y again."""
    motions = [foreign(p[:, :, list(order)] * np.array(signs)) for p in map_seeds()]
    found = only(suspicions(*motions), "things fall along")
    axes = found.rsplit("--axes=", 1)[1].removesuffix(".")
    conversion = Conversion(axes=axes)
    assert suspicions(*motions, conversion=conversion) == []
    chosen, flips = conversion.axis_map()
    assert np.linalg.det(np.eye(3)[chosen] * flips[:, None]) == pytest.approx(1.0)


def test_another_upward_axis_in_the_plane_is_cured_too():
    motions = [foreign(motion(dim=2, seed=s)[:, :, ::-1]) for s in range(3)]
    found = only(suspicions(*motions), "things fall along -x")
    axes = found.rsplit("--axes=", 1)[1].removesuffix(".")
    assert suspicions(*motions, conversion=Conversion(axes=axes)) == []


def test_a_plane_motion_in_space_is_named_and_the_advice_cures_it():
    def flat(position):
        position = position.copy()
        position[..., 2] = 0.0
        return position

    motions = [foreign(flat(p)) for p in map_seeds()]
    assert "--axes x,y" in only(suspicions(*motions), "nothing accelerates along z")
    assert suspicions(*motions, conversion=Conversion(axes="x,y")) == []


def test_constant_speed_along_an_axis_is_no_acceleration_however_it_is_rounded():
    """Positions a + v t have no second difference; what float64 leaves of it is 1e-16."""
    time = FRAME_DT * np.arange(FRAMES)[:, None]

    def coast(position):
        position = position.copy()
        position[..., 2] = position[0, :, 2] + 0.3 * time
        return position

    motions = [foreign(coast(p), dtype=np.float64) for p in map_seeds()]
    only(suspicions(*motions), "nothing accelerates along z")


def test_free_fall_alone_teaches_nothing():
    """Every second difference is g dt^2: their deviation is rounding."""
    time = FRAME_DT * np.arange(FRAMES)[:, None, None]
    fall = np.array([0.0, -0.5 * 9.81, 0.0]) * time**2
    motions = [foreign(p[:1] + fall, dtype=np.float64) for p in map_seeds()]
    only(suspicions(*motions), "all particles accelerate alike")


# Frames.


def test_repeated_frames_at_the_beginning_are_named_and_the_advice_cures_it():
    def spoil(position):
        return np.concatenate([position[:1]] * 3 + [position])

    motions = three(spoil)
    assert "--skip 3" in only(suspicions(*motions), "begin with up to 3 repeated frames")
    assert suspicions(*motions, conversion=Conversion(skip=3)) == []


def test_every_frame_stored_twice_is_named_and_the_advice_cures_it():
    motions = [foreign(np.repeat(p, 2, axis=0), frame_dt=FRAME_DT / 2) for p in map_seeds()]
    found = suspicions(*motions)
    assert any("frames repeat the one before" in text and "--stride 2" in text for text in found)
    assert suspicions(*motions, conversion=Conversion(stride=2)) == []


def test_a_body_that_comes_to_rest_is_not_suspicious():
    """Frames that repeat at the end are rest, not repetition."""

    def rest(position):
        return np.concatenate([position, np.repeat(position[-1:], 5, axis=0)])

    assert not any("repeat" in text for text in suspicions(*three(rest)))


def test_short_trajectories_are_said():
    motions = [foreign(motion(seed=seed, frames=6)) for seed in range(3)]
    assert "velocities" in only(suspicions(*motions), "the shortest trajectory has 6 frames")


def test_fewer_than_three_trajectories_are_said():
    only(suspicions(foreign(motion())), "there is 1 trajectory; training needs at least three")
    pair = [foreign(motion(seed=seed)) for seed in range(2)]
    only(suspicions(*pair), "there are 2 trajectories")


# Particles.


def test_shuffled_rows_are_recognised_and_fast_motion_is_not():
    rng = np.random.default_rng(1)

    def shuffle(position):
        return np.stack([frame[rng.permutation(len(frame))] for frame in position])

    report = report_of(*three(shuffle))
    assert any("a row is not the same particle" in text for text in report.suspicious)
    assert report.facts["identity"] == "lost in 1 of 3 trajectories"
    fast = [foreign(p + 0.5 * np.arange(FRAMES)[:, None, None], bounds=None) for p in map_seeds()]
    assert report_of(*fast).facts["identity"].startswith("kept")


def test_what_a_source_says_about_identity_counts():
    motions = three(identity_kept=False)
    only(suspicions(*motions), "a row is not the same particle")
    sound = report_of(*(foreign(p, identity_kept=True) for p in map_seeds()))
    assert sound.suspicious == []
    assert sound.facts["identity"] == "kept, as the source says"


def test_neighbours_that_move_alike_are_not_shuffled_however_far():
    position = motion(count=300)[0]
    found = nearest_neighbors(position)
    assert rows_are_shuffled(np.full_like(position, 7.0), found) is False
    assert rows_are_shuffled(np.zeros_like(position), found) is None
    order = np.random.default_rng(0).permutation(300)
    assert rows_are_shuffled(position[order] - position, found) is True


def test_a_periodic_jump_is_named_with_frame_and_particle():
    def spoil(position):
        position = position.copy()
        position[11:, 17, 0] -= 5.0
        return position

    found = suspicions(*three(spoil))
    jump = next(text for text in found if "jumps over many others" in text)
    assert "frame 11, particle 17" in jump
    assert "Unwrap" in jump


def test_particles_that_leave_the_bounds_are_counted_and_the_advice_cures_it():
    def spoil(position):
        position = position.copy()
        position[5:, :4, 0] += 0.4 * np.arange(1, FRAMES - 4)[:, None]
        position[:, :, 0] += 8.0
        return position

    motions = three(spoil)
    found = only(suspicions(*motions), "4 particles of 1 trajectories leave the given bounds")
    numbers = found.rsplit("--bounds ", 1)[1].removesuffix(".").split()
    bounds = [float(number) for number in numbers]
    wider = [b + (0.5 if i % 2 else -1.5) for i, b in enumerate(bounds)]
    wider[0] = -2.0  # the other two motions begin there
    assert suspicions(*motions, conversion=Conversion(bounds=tuple(wider))) == []


@pytest.mark.parametrize(("beyond", "named"), [(0.9, False), (1.1, True)])
def test_a_particle_pressed_on_a_wall_by_less_than_a_spacing_is_none_outside(beyond, named):
    """Walls act through a grid or a kernel about a spacing wide, so the middle may pass them."""
    start = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 6)] * 3, indexing="ij"), -1).reshape(-1, 3)
    shaken = np.random.default_rng(0).normal(scale=1e-3, size=(FRAMES, 1, 1))
    position = start + shaken.cumsum(0) - shaken[0]
    walls = np.array([[-1.0, position[..., axis].max()] for axis in range(3)])
    walls[:, 1] -= beyond * 0.2
    found = suspicions(*(foreign(position, bounds=walls) for _ in range(3)))
    assert any("leave the given bounds" in text for text in found) == named


def test_neighbours_are_the_nearest_also_where_particles_coincide():
    """By brute force; a particle is never its own neighbour."""
    position = np.random.default_rng(1).integers(0, 5, (80, 2)).astype(np.float64)
    found = nearest_neighbors(position)
    table = np.linalg.norm(position[:, None] - position[None], axis=2)
    np.fill_diagonal(table, np.inf)
    assert (found.nearest != found.particle).all()
    np.testing.assert_array_equal(
        table[found.particle, found.nearest], table.min(axis=1)[found.particle]
    )
    assert found.spacing == np.median(table.min(axis=1))
    crowd = nearest_neighbors(np.zeros((50_000, 3)))
    assert crowd.spacing == 0.0
    assert (crowd.nearest != crowd.particle).all()


def test_frozen_particles_are_told_from_kinematic_ones():
    """A wall without a type is suspicious, a wall of type 3 is not."""

    def wall(position):
        position = position.copy()
        position[:, :5] = position[0, :5]
        return position

    only(suspicions(*three(wall)), "5 particles never move and are not kinematic")
    kinds = [KINEMATIC] * 5 + [WATER] * 95
    report = report_of(*three(wall, kinds=kinds))
    assert report.suspicious == []
    assert (report.facts["kinematic"], report.facts["moving_kinematic"]) == (5, 0)
    assert report_of(*three(kinds=kinds)).facts["moving_kinematic"] == 5


def test_doubles_are_counted():
    def spoil(position):
        position = position.copy()
        position[:, 9] = position[:, 3]
        return position

    report = report_of(*three(spoil))
    only(report.suspicious, "1 particles begin at the place of another one")
    assert report.facts["duplicates"] == 1


def test_what_is_not_finite_is_named_and_leaves_the_numbers_alone():
    """The report goes on without the particle; all others are measured as before."""

    def spoil(position):
        position = position.copy()
        position[6, 12, 1] = np.nan
        position[9, 3, 0] = np.inf
        return position

    report = report_of(*three(spoil))
    found = only(report.suspicious, "cloud[0] at frame 6, particle 12")
    assert "--drop-bad-trajectories" in found
    assert report.facts["not_finite"] == 2
    assert all(math.isfinite(v) for v in report.facts["statistics"]["acc_std"])
    sound = report_of(*three()).facts["statistics"]
    np.testing.assert_allclose(report.facts["statistics"]["vel_std"], sound["vel_std"], rtol=0.05)


def test_differing_particle_counts_are_said_with_the_way_out():
    motions = [foreign(motion(seed=seed, count=100 + seed)) for seed in range(3)]
    assert "sampling.reduction" in only(suspicions(*motions), "(100 to 102)")


def test_data_of_kinematic_particles_alone_teach_nothing():
    motions = [foreign(p, kinds=[KINEMATIC] * 100) for p in map_seeds()]
    only(suspicions(*motions), "nothing can be learnt")


def test_steps_longer_than_the_radius_are_said():
    """All move alike, so identity is kept, but past their neighbours."""
    far = 1.5 * np.arange(FRAMES)[:, None, None]
    motions = [foreign(p + far, bounds=None) for p in map_seeds()]
    only(suspicions(*motions), "graph radii in one frame")


# Precision and statistics.


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (lambda p: p.astype(np.float16).astype(np.float64), "float16"),
        (lambda p: np.round(p, 3), "3 decimals"),
        (lambda p: p + 3000.0, "float32"),
    ],
)
def test_accelerations_made_of_rounding_are_named(spoil, name):
    """Rounding errors e of variance q^2/12 give second differences of variance q^2/2."""
    motions = [foreign(spoil(p), bounds=None) for p in map_seeds()]
    found = only(suspicions(*motions), f"({name})")
    assert "--stride" in found


def test_rounding_noise_of_second_differences_is_the_grid_over_root_two():
    """Measured on three independent columns of rounding errors."""
    exact = np.random.default_rng(0).random((3, 100_000))
    rounded = np.round(exact, 4)
    found = grid_of(rounded.ravel())
    assert (found.name, found.step) == ("4 decimals", 1e-4)
    error = rounded - exact
    measured = (error[2] - 2.0 * error[1] + error[0]).std()
    assert found.acceleration_noise == pytest.approx(measured, rel=0.01)


@pytest.mark.parametrize(
    ("dtype", "name"), [(np.float16, "float16"), (np.float32, "float32"), (np.float64, "float64")]
)
def test_the_precision_of_numbers_is_recognised(dtype, name):
    values = np.random.default_rng(0).random(5000).astype(dtype).astype(np.float64)
    assert grid_of(values).name == name
    assert grid_of(values[:50]) is None


def test_float64_far_from_the_origin_loses_in_float32_and_is_told():
    """At 40 m, float32 steps are 4e-6 m; accelerations of the stir are 1e-5 m per frame^2."""
    motions = [foreign(p + 40.0, dtype=np.float64, bounds=None) for p in map_seeds()]
    only(suspicions(*motions), "storing these float64 positions as float32")


def test_statistics_of_the_file_are_compared_with_measured_ones():
    measured = report_of(*three()).facts["statistics"]

    def found(factor_velocity, factor_acceleration):
        stated = {
            "vel_mean": measured["vel_mean"],
            "vel_std": [factor_velocity * v for v in measured["vel_std"]],
            "acc_mean": measured["acc_mean"],
            "acc_std": [factor_acceleration * v for v in measured["acc_std"]],
        }
        origin = Origin(
            format="test", source="cloud", file_statistics=Statistics.from_metadata(stated)
        )
        return suspicions(*three(), origin=origin)

    assert found(1.0, 1.1) == []
    assert "acceleration spread 0.2 times ours" in only(found(1.0, 0.2), "contradict")
    assert "per second and not per frame" in only(found(200.0, 4e4), "contradict")
    assert "velocity spread is 0 and" in only(found(0.0, 0.0), "contradict")


def test_statistics_of_the_file_have_a_column_only_where_they_differ():
    measured = report_of(*three()).facts["statistics"]
    stated = Statistics.from_metadata(measured)
    other = Statistics.from_metadata(measured | {"acc_std": [2.0, 2.0, 2.0]})
    for statistics, shown in ((stated, False), (other, True)):
        origin = Origin(format="test", source="cloud", file_statistics=statistics)
        header, rows = statistics_rows(report_of(*three(), origin=origin))
        assert ("in the file" in header) == shown
        assert {len(row) for row in rows} == {len(header)}


def test_statistics_of_the_file_are_not_compared_with_a_part_of_it():
    stated = Statistics.from_metadata(
        {k: [1.0] * 3 for k in ("vel_mean", "vel_std", "acc_mean", "acc_std")}
    )
    origin = Origin(format="test", source="cloud", file_statistics=stated, complete=False)
    assert suspicions(*three(), origin=origin) == []


def test_published_sets_of_the_same_kind_stand_beside_ours():
    """WaterDrop: plane, dt 2.5 ms, walls 0.1 to 0.9, water; another time has no twin."""
    walls = np.array([[0.1, 0.9]] * 2)
    position = [0.2 + 0.3 * motion(dim=2, seed=s, frame_dt=0.0025) for s in range(3)]
    twins = report_of(*(foreign(p, frame_dt=0.0025, bounds=walls) for p in position))
    assert [row["name"] for row in twins.facts["published"]] == ["WaterDrop", "WaterDropSample"]
    header, rows = statistics_rows(twins)
    assert "WaterDrop" in header
    assert "0.0014" in rows[1][header.index("WaterDrop")]
    others = report_of(*(foreign(p, frame_dt=0.005, bounds=walls) for p in position))
    assert others.facts["published"] == []


# Hostile and degenerate data.


def test_nothing_breaks_the_report_or_the_pictures(tmp_path):
    """One particle, one frame, rest, infinities, all NaN, 1e40 m, 1e-42 m, absurd frame times."""
    rng = np.random.default_rng(0)
    for trial in range(12):
        dim = int(rng.choice([2, 3]))
        motions = [hostile(rng, dim) for _ in range(int(rng.choice([1, 3])))]
        measure, complete = measure_trajectories(
            motions, conversion=Conversion(), progress=lambda name, frames: None
        )
        report = make_report(measure, Origin(format="test", source="x", complete=complete))
        assert json.loads(json.dumps(report.as_json(), allow_nan=False))["trajectories"] >= 1
        assert markdown(report).startswith("# x")
        if trial == 6:
            draw_motions(measure.sheets, report.facts, tmp_path / "motions.png")
            draw_histograms(measure, report, tmp_path / "histograms.png")


def hostile(rng, dim):
    """A motion nobody wants to import."""
    count, frames = int(rng.choice([1, 2, 7, 40])), int(rng.choice([1, 2, 3, 9]))
    position = rng.random((1, count, dim)) * np.ones((frames, 1, 1))
    kind = rng.choice(["still", "point", "noise", "nan", "infinity", "all", "huge", "tiny"])
    if kind == "point":
        position[:] = 0.0
    if kind in ("noise", "nan", "infinity"):
        position = rng.random((frames, count, dim))
    if kind in ("nan", "infinity"):
        value = np.nan if kind == "nan" else -np.inf
        position[rng.integers(frames), rng.integers(count), 0] = value
    if kind == "all":
        position[:] = np.nan
    if kind in ("huge", "tiny"):
        position *= 1e40 if kind == "huge" else 1e-42
    return foreign(
        position,
        kinds=rng.choice([KINEMATIC, WATER], count),
        dtype=np.float64,
        bounds=None if rng.random() < 0.5 else BOX[:dim],
        frame_dt=[None, 1e-9, 1e9, FRAME_DT][rng.integers(4)],
    )


# The record.


def test_every_material_has_a_word():
    """The report names the types that the simulator writes."""
    assert {str(law.particle_type) for law in MATERIALS.values()} <= set(TYPES)


def test_the_markdown_page_holds_every_row_suspicion_and_note():
    report = report_of(foreign(motion(), notes=("Types were guessed.",)))
    page = markdown(report)
    for label, value in overview_rows(report):
        assert f"| {label} | {value} |" in page
    for text in (*report.suspicious, "Types were guessed."):
        assert f"- {text}" in page


def test_an_empty_source_is_refused():
    with pytest.raises(DataError, match="holds no trajectory"):
        report_of()


def test_what_is_kept_for_pictures_is_bounded_and_evenly_spread():
    kept = Thinned(most=10)
    for number in range(1000):
        kept.add(number)
        assert len(kept.items) <= 20
    assert 10 <= len(kept.items) <= 20
    assert len(set(np.diff(kept.items))) == 1
    assert kept.items[0] == 0
    assert kept.items[-1] > 900
