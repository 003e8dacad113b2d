"""Small files of every foreign format, to be mutated by ``fuzz_readers.py``.

They are written by the formats' own libraries where there is one. A seed with ``pack`` is
mutated inside its packing and packed again with right check sums.
"""

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.crc32c import crc32c, masked

__all__ = ["Seed", "all_seeds"]

METADATA = json.dumps({"bounds": [[0, 1], [0, 1]], "dim": 2, "dt": 0.01, "write_every": 2}).encode()


def _same(content: bytes) -> bytes:
    return content


@dataclass(frozen=True, kw_only=True)
class Seed:
    """A file to mutate and what must stand around it."""

    name: str
    reader: str
    """Name of the reader."""

    target: str
    """Name of the file that is mutated."""

    content: bytes
    """What is mutated."""

    pack: Callable[[bytes], bytes] = _same
    """Makes the file of the mutated content."""

    others: dict[str, bytes] = field(default_factory=dict)
    """Other files of the folder."""

    is_folder: bool = False
    """Whether the folder is read and not the file."""


def all_seeds(folder: Path) -> list[Seed]:
    """The seeds of all formats.

    Args:
        folder: An empty folder for files that libraries write.

    Returns:
        The seeds.
    """
    seeds = [
        *_tfrecord(),
        *_pickles(folder),
        *_npz(),
        *_npy(),
        *_nclaw(folder),
        *_hdf5(folder),
        *_text(),
    ]
    return [*seeds, *_vtk(folder)]


def _motion(*shape: int, kind: str = "<f4") -> np.ndarray:
    return np.random.default_rng(0).uniform(size=shape).astype(kind)


def _framed(payload: bytes) -> bytes:
    """A TFRecord with right check sums."""
    length = struct.pack("<Q", len(payload))
    sums = [struct.pack("<I", masked(crc32c([part]))) for part in (length, payload)]
    return length + sums[0] + payload + sums[1]


def _part(number: int, content: bytes) -> bytes:
    """A length-delimited field of a message shorter than 16384 bytes."""
    size = len(content)
    length = bytes([size]) if size < 128 else bytes([size & 127 | 128, size >> 7])
    return bytes([number << 3 | 2]) + length + content


def _tfrecord() -> Iterator[Seed]:
    def entry(key: str, value: bytes) -> bytes:
        return _part(1, _part(1, key.encode()) + _part(2, value))

    types = np.array([5, 3, 0, 7, 6], "<i8").tobytes()
    frames = b"".join(_part(1, _part(1, _part(1, frame.tobytes()))) for frame in _motion(6, 5, 2))
    context = entry("particle_type", _part(1, _part(1, types)))
    message = _part(1, context) + _part(2, entry("position", frames))
    common: dict[str, Any] = {"reader": "gns-tfrecord", "target": "train.tfrecord"}
    yield Seed(name="tfrecord", content=_framed(message) * 2, **common)
    yield Seed(name="tfrecord-inner", content=message, pack=_framed, **common)
    yield Seed(
        name="tfrecord-metadata",
        reader="gns-tfrecord",
        target="metadata.json",
        content=METADATA,
        others={"train.tfrecord": _framed(message)},
        is_folder=True,
    )


def _windows() -> dict[str, Any]:
    positions = _motion(4, 9, 2)
    return {
        "particle_type": [np.full(4, 5, np.int32)] * 3,
        "position": [positions[:, start : start + 6] for start in range(3)],
        "n_particles_per_example": [np.array([4], np.int32)] * 3,
        "output": [positions[:, start + 6] for start in range(3)],
    }


def _zipped(name: str, *, others: dict[str, bytes] | None = None) -> Callable[[bytes], bytes]:
    """Packs a member into an archive."""

    def pack(content: bytes) -> bytes:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for other, value in (others or {}).items():
                archive.writestr(other, value)
            archive.writestr(name, content)
        return buffer.getvalue()

    return pack


def _pickles(folder: Path) -> Iterator[Seed]:
    import torch

    rollout = {
        "position": [_motion(5, 9, 3), _motion(4, 8, 3, kind=">f8")],
        "particle_type": [np.full(5, 5), np.full(4, 6)],
        "output": [_motion(5, 3), _motion(8, 3)],
    }
    for protocol in (2, 4, 5):
        yield Seed(
            name=f"mpm-verse-obj-{protocol}",
            reader="mpm-verse",
            target="train.obj",
            content=pickle.dumps(_windows(), protocol),
        )
    yield Seed(
        name="mpm-verse-rollout",
        reader="mpm-verse",
        target="rollout.obj",
        content=pickle.dumps(rollout, 4),
    )
    for is_zip in (True, False):
        torch.save(rollout, folder / "rollout.pt", _use_new_zipfile_serialization=is_zip)
        yield Seed(
            name="mpm-verse-pt" if is_zip else "mpm-verse-pt-old",
            reader="mpm-verse",
            target="rollout.pt",
            content=(folder / "rollout.pt").read_bytes(),
        )
    yield Seed(
        name="mpm-verse-pt-inner",
        reader="mpm-verse",
        target="rollout.pt",
        content=pickle.dumps(rollout, 2),
        pack=_zipped("archive/data.pkl"),
    )


def _npz() -> Iterator[Seed]:
    pair = np.empty(2, dtype=object)
    pair[0], pair[1] = _motion(4, 5, 2), np.full(5, 6)
    for name, save in (("npz", np.savez), ("npz-packed", np.savez_compressed)):
        buffer = io.BytesIO()
        save(buffer, simulation_0=pair, position=_motion(3, 4, 3), particle_type=np.full(4, 5))
        yield Seed(name=name, reader="gns-npz", target="train.npz", content=buffer.getvalue())
    for name, array in (("npz-inner", pair), ("npz-inner-plain", _motion(4, 5, 2))):
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=True)
        yield Seed(
            name=name,
            reader="gns-npz",
            target="train.npz",
            content=buffer.getvalue(),
            pack=_zipped("simulation_0.npy"),
        )


def _npy() -> Iterator[Seed]:
    """Frames, a motion, and the records of our own ``.npz``."""
    records = np.zeros(2, [("positions", "<f4", (4, 5, 2)), ("particle_type", "<i8", (5,))])
    arrays = {"frames": _motion(5, 3), "motion": _motion(4, 5, 3), "records": records}
    files = {}
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.save(buffer, array)
        files[name] = buffer.getvalue()
    yield _sequence("npy-frames", "npy", "npy", files["frames"])
    yield Seed(name="npy-motion", reader="npy", target="motion.npy", content=files["motion"])
    yield Seed(
        name="npz-records",
        reader="gns-npz",
        target="train.npz",
        content=files["records"],
        pack=_zipped("trajectories.npy"),
    )


def _nclaw(folder: Path) -> Iterator[Seed]:
    import torch

    state = {key: torch.rand(4, 3) for key in ("x", "v", "C", "F")}
    for is_zip in (True, False):
        torch.save(state, folder / "0000.pt", _use_new_zipfile_serialization=is_zip)
        content = (folder / "0000.pt").read_bytes()
        yield Seed(
            name="nclaw" if is_zip else "nclaw-old",
            reader="nclaw",
            target="state/0000.pt",
            content=content,
            others={"state/0001.pt": content},
            is_folder=True,
        )
        if is_zip:
            with zipfile.ZipFile(folder / "0000.pt") as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
    name = next(name for name in members if name.endswith("data.pkl"))
    yield Seed(
        name="nclaw-inner",
        reader="nclaw",
        target="state/0000.pt",
        content=members.pop(name),
        pack=_zipped(name, others=members),
        is_folder=True,
    )


def _hdf5(folder: Path) -> Iterator[Seed]:
    import h5py

    path = folder / "train.h5"
    for name, options in (
        ("lagrangebench", {}),
        ("lagrangebench-packed", {"compression": "gzip", "shuffle": True, "chunks": (2, 4, 2)}),
    ):
        with h5py.File(path, "w") as file:
            group = file.create_group("00000")
            group.create_dataset("position", data=_motion(5, 4, 2), **options)
            group["particle_type"] = np.full(4, 5)
            group.attrs["frame_dt"], group.attrs["bounds"] = 0.1, np.array([[0.0, 1.0]] * 2)
        yield Seed(name=name, reader="lagrangebench", target="train.h5", content=path.read_bytes())
    with h5py.File(path, "w") as file:
        file["particles"], file["boundary"] = _motion(4, 5, 4), _motion(4, 3, 4)
    yield Seed(
        name="neural-mpm", reader="lagrangebench", target="sim_0.h5", content=path.read_bytes()
    )
    with h5py.File(path, "w") as file:
        file["x"], file["q"] = _motion(3, 5), _motion(3, 5)
    frame = path.read_bytes()
    others = {f"sim_seq_a/h5_f_{number:010d}.h5": frame for number in (1, 2)}
    yield Seed(
        name="crom",
        reader="crom",
        target="sim_seq_a/h5_f_0000000000.h5",
        content=frame,
        others=others,
        is_folder=True,
    )


def _text() -> Iterator[Seed]:
    points = _motion(6, 3)
    lines = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in points)
    header = (
        "ply\nformat {} 1.0\nelement vertex 6\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    vertices = "".join(f"v {line}\n" for line in lines.splitlines()) + "f 1 2 3\nf 3//1 4//2 5//3\n"
    legacy = "# vtk DataFile Version 3.0\nfuzz\n{}\nDATASET POLYDATA\nPOINTS 6 float\n"
    files = {
        "ply-ascii": ("ply", header.format("ascii").encode() + lines.encode()),
        "ply-little": ("ply", header.format("binary_little_endian").encode() + points.tobytes()),
        "ply-big": (
            "ply",
            header.format("binary_big_endian").encode() + points.astype(">f4").tobytes(),
        ),
        "obj": ("obj", vertices.encode()),
        "vtk-ascii": ("vtk", legacy.format("ASCII").encode() + lines.encode()),
        "vtk-binary": (
            "vtk",
            legacy.format("BINARY").encode() + points.astype(">f4").tobytes() + b"\n",
        ),
    }
    for name, (kind, content) in files.items():
        yield _sequence(name, kind, kind, content)
    table = "x,y,z,particle_type\n" + "".join(f"{x:.4f},{y:.4f},{z:.4f},5\n" for x, y, z in points)
    yield _sequence("csv", "csv", "csv", table.encode())


def _sequence(name: str, reader: str, extension: str, content: bytes) -> Seed:
    """A motion of three equal frames, the second of which is mutated."""
    return Seed(
        name=name,
        reader=reader,
        target=f"frame_1.{extension}",
        content=content,
        others={f"frame_{number}.{extension}": content for number in (0, 2)},
        is_folder=True,
    )


def _vtk(folder: Path) -> Iterator[Seed]:
    """XML files of VTK, and its HDF5 file."""
    import pyvista

    cloud = pyvista.PolyData(_motion(6, 3))
    for name, binary in (("vtp-ascii", False), ("vtp-binary", True)):
        cloud.save(folder / "frame.vtp", binary=binary)
        yield _sequence(name, "vtk", "vtp", (folder / "frame.vtp").read_bytes())
    cloud.cast_to_unstructured_grid().save(folder / "frame.vtu")
    yield _sequence("vtu", "vtk", "vtu", (folder / "frame.vtu").read_bytes())
    yield Seed(
        name="vtkhdf", reader="vtk", target="motion.vtkhdf", content=_temporal(folder / "a.vtkhdf")
    )


def _temporal(path: Path) -> bytes:
    """A motion of three steps in VTK's HDF5 layout."""
    import h5py

    steps, count = 3, 5
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 0)
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", 8))
        root["NumberOfPoints"] = np.full(steps, count)
        root["Points"] = _motion(steps * count, 3)
        series = root.create_group("Steps")
        series.attrs["NSteps"] = steps
        series["Values"] = np.arange(steps) * 0.1
        series["PartOffsets"] = np.arange(steps)
        series["NumberOfParts"] = np.ones(steps, int)
        series["PointOffsets"] = np.arange(steps) * count
    return path.read_bytes()
