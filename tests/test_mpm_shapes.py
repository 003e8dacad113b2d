"""Procedural shapes, mesh files and their filling with particles."""

import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from giorom.mpm.creatures import CREATURES, draw_creature
from giorom.mpm.mesh import Columns, load_mesh_shape
from giorom.mpm.shape_library import SHAPES, Proportions, draw_shape
from giorom.mpm.shapes import (
    Shape,
    box_distance,
    capsule_distance,
    cylinder_distance,
    fill,
    lattice,
    superquadric_level,
    torus_distance,
    volume_of,
)

trimesh = pytest.importorskip("trimesh")

NAMES = [(name, d) for name, (_, dimensions) in SHAPES.items() for d in dimensions]


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def drawn(name: str, dimension: int, seed: int = 0) -> Shape:
    wanted = Proportions(height=0.3, dimension=dimension, slenderness=(0.5, 0.8))
    return draw_shape(name, wanted, generator=generator(seed))


@pytest.mark.parametrize(("name", "dimension"), NAMES)
def test_every_shape_has_the_height_asked_for(name: str, dimension: int):
    """The bounding box of a fine lattice inside is the stated one; a creature's longest edge."""
    shape = drawn(name, dimension)
    spacing = 0.3 / (60 if dimension == 3 else 200)
    points = lattice(shape.extent, spacing)
    inside = points[shape.level(points) < 0.0]
    edges = inside.max(axis=0) - inside.min(axis=0)
    stated = max(shape.extent) if name in CREATURES else shape.extent[1]
    assert math.isclose(stated, 0.3, rel_tol=1e-9)
    np.testing.assert_allclose(edges, shape.extent, atol=3.0 * spacing)


@pytest.mark.parametrize(
    ("name", "dimension"),
    [pair for pair in NAMES if drawn(*pair).volume is not None],
)
def test_lattice_volume_is_that_of_the_closed_form(name: str, dimension: int):
    """N h^d counts the volume; 2 % at 60 (3-D) and 200 (2-D) points per height."""
    shape = drawn(name, dimension)
    spacing = 0.3 / (60 if dimension == 3 else 200)
    count = (shape.level(lattice(shape.extent, spacing)) < 0.0).sum()
    assert math.isclose(count * spacing**dimension, shape.volume, rel_tol=0.02)


@pytest.mark.parametrize("name", CREATURES)
def test_creature_is_one_closed_piece_symmetric_in_its_middle_plane(name: str):
    """One component on a lattice that reaches beyond the box, whose border is outside."""
    for seed in range(2):
        shape = draw_creature(name, size=0.5, generator=generator(seed))
        spacing = 0.5 / 44
        axes = [
            (np.arange(count) - 0.5 * (count - 1)) * spacing
            for count in (round(edge / spacing) + 4 for edge in shape.extent)
        ]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        inside = (shape.level(grid.reshape(-1, 3)) < 0.0).reshape(grid.shape[:3])
        assert ndimage.label(inside)[1] == 1
        core = inside[1:-1, 1:-1, 1:-1]
        assert core.sum() == inside.sum()
        assert np.array_equal(inside, inside[:, :, ::-1])


def test_creatures_of_different_seeds_and_names_are_different_bodies():
    """Volumes over the cube of the size differ by more than a lattice counts wrong."""
    volumes = [
        volume_of(draw_creature(name, size=1.0, generator=generator(seed)))
        for name in ("quadruped", "rabbit")
        for seed in (0, 2)
    ]
    assert min(abs(a - b) / a for a, b in combinations(volumes, 2)) > 0.02


@pytest.mark.parametrize(("name", "dimension"), [("torus", 3), ("capsule", 3), ("disc", 2)])
def test_counted_volume_is_that_of_the_closed_form(name: str, dimension: int):
    """The lattice of ``volume_of`` is fine enough for 1 %."""
    shape = drawn(name, dimension)
    counted = volume_of(replace(shape, volume=None))
    assert math.isclose(counted, volume_of(shape), rel_tol=0.01)


@pytest.mark.parametrize(
    ("level", "point", "distance"),
    [
        (box_distance(np.array([0.1, 0.2, 0.3])), [0.4, 0.6, 0.3], 0.5),
        (box_distance(np.array([0.1, 0.2, 0.3])), [0.0, 0.15, 0.0], -0.05),
        (capsule_distance(0.1, 0.2), [0.0, 0.5, 0.0], 0.2),
        (cylinder_distance(0.1, 0.2), [0.4, 0.6, 0.0], 0.5),
        (torus_distance(0.3, 0.1), [0.3, 0.0, 0.0], -0.1),
        (superquadric_level(np.array([0.1, 0.2, 0.3]), 2.0), [0.0, 0.2, 0.0], 0.0),
    ],
)
def test_level_functions_at_known_points(level, point: list[float], distance: float):
    """Distances by hand (3-4-5 triangles)."""
    assert math.isclose(level(np.array([point]))[0], distance, abs_tol=1e-12)


@pytest.mark.parametrize(("name", "dimension"), NAMES)
def test_filling_stays_inside_and_repeats_with_its_seed(name: str, dimension: int):
    """Every particle inside, jitter bounded, the same seed the same points."""
    shape, spacing = drawn(name, dimension), 0.012
    points, volume = fill(shape, spacing=spacing, generator=generator(1))
    again, _ = fill(shape, spacing=spacing, generator=generator(1))
    other, _ = fill(shape, spacing=spacing, generator=generator(2))
    straight, _ = fill(shape, spacing=spacing, generator=generator(1), jitter=0.0)
    assert (shape.level(points) < 0.0).all()
    assert np.abs(points - straight).max() <= 0.25 * spacing
    np.testing.assert_array_equal(points, again)
    assert not np.array_equal(points, other)
    whole = shape.volume or len(points) * spacing**dimension
    assert math.isclose(volume * len(points), whole, rel_tol=1e-12)


def test_filling_a_shape_below_the_spacing_is_refused():
    """The ring is thinner than the lattice: no point falls inside."""
    with pytest.raises(ValueError, match=r"Lower SceneConfig\.spacing"):
        fill(drawn("torus", 3), spacing=0.3, generator=generator())


@pytest.mark.parametrize("spacing", [0.5, 1e30, 1e308])
def test_spacing_beyond_the_shape_is_refused(spacing: float):
    """One particle would stand for a body smaller than its own cell."""
    with pytest.raises(ValueError, match=r"less than the spacing of its particles"):
        fill(drawn("pebble", 2), spacing=spacing, generator=generator())


def test_unknown_shape_names_the_known_ones():
    """A sphere is no 2-D shape; the message lists those that are."""
    with pytest.raises(ValueError, match="disc"):
        drawn("sphere", 2)


def test_mesh_inside_test_agrees_with_the_exact_ball():
    """A fine icosphere, points clear of its faceted surface."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    columns = Columns(np.asarray(mesh.triangles, dtype=np.float64), signed=True)
    points = generator().uniform(-1.2, 1.2, (4000, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 0.995) > 0.01
    np.testing.assert_array_equal(columns.contains(points)[clear], (radius < 0.995)[clear])


def test_rays_through_edges_and_corners_are_counted_once():
    """A box mesh under a lattice that hits its edges, corners and face diagonals."""
    mesh = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    columns = Columns(np.asarray(mesh.triangles, dtype=np.float64), signed=True)
    axis = np.linspace(-0.75, 0.75, 13)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    largest = np.abs(points).max(axis=1)
    clear = np.abs(largest - 0.5) > 1e-3
    np.testing.assert_array_equal(columns.contains(points)[clear], (largest < 0.5)[clear])


def test_overlapping_closed_parts_are_solid():
    """Two interpenetrating balls: the winding number is two where they overlap."""
    left = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    right = left.copy().apply_translation([0.8, 0.0, 0.0])
    both = trimesh.util.concatenate([left, right])
    columns = Columns(np.asarray(both.triangles, dtype=np.float64), signed=True)
    assert columns.contains(np.array([[0.4, 0.0, 0.0], [-0.5, 0.1, 0.0]])).all()
    assert not columns.contains(np.array([[0.4, 1.5, 0.0]])).any()


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_mesh_of_any_unit_is_rescaled(size: float, tmp_path: Path):
    """The longest edge becomes the stated size, the volume follows with its cube."""
    path = tmp_path / "brick.obj"
    mesh = trimesh.creation.box(extents=(size, 2.0 * size, 0.5 * size))
    mesh.apply_translation([7.0 * size, 0.0, -3.0 * size])
    mesh.export(path)
    shape = load_mesh_shape(path, size=0.4)
    np.testing.assert_allclose(shape.extent, (0.2, 0.4, 0.1), rtol=1e-6)
    assert math.isclose(shape.volume, 0.2 * 0.4 * 0.1, rel_tol=1e-6)
    points, _ = fill(shape, spacing=0.02, generator=generator())
    assert len(points) == 10 * 20 * 5


def test_texture_seams_do_not_open_a_mesh(tmp_path: Path):
    """An .obj whose corners are doubled by texture coordinates is still closed."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    for number, face in enumerate(mesh.faces):
        lines += [f"vt {number / 100.0} {corner / 3.0}" for corner in range(3)]
        corners = [f"{v + 1}/{3 * number + c + 1}" for c, v in enumerate(face)]
        lines.append("f " + " ".join(corners))
    path = tmp_path / "seams.obj"
    path.write_text("\n".join(lines))
    assert load_mesh_shape(path, size=1.0).parameters["faces"] == len(mesh.faces)


def test_open_mesh_is_refused_in_one_line(tmp_path: Path):
    """A ball without one triangle has no inside."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    path = tmp_path / "holed.obj"
    mesh.export(path)
    with pytest.raises(ValueError, match=r"holed\.obj is not closed") as caught:
        load_mesh_shape(path, size=1.0)
    assert "\n" not in str(caught.value)


def test_missing_and_empty_mesh_files_are_refused(tmp_path: Path):
    """One line that names the file."""
    with pytest.raises(ValueError, match="does not exist"):
        load_mesh_shape(tmp_path / "nothing.obj", size=1.0)
    empty = tmp_path / "empty.obj"
    empty.write_text("# no faces\n")
    with pytest.raises(ValueError, match=r"empty\.obj"):
        load_mesh_shape(empty, size=1.0)


@pytest.mark.parametrize("suffix", [".zip", ".3mf", ".gltf", ".dae"])
def test_mesh_files_that_may_hide_more_are_not_opened(tmp_path: Path, suffix: str):
    """An archive of 1 MB can hold a mesh of gigabytes."""
    path = (tmp_path / "ball").with_suffix(suffix)
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"is of no kind that is read: \.obj, \.stl"):
        load_mesh_shape(path, size=1.0)
