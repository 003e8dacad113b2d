"""Files changed at random: every reader gives frames or one line, and nothing else.

Some mutants per format run with the suite. For a long run, set GIOROM_MUTANTS to their number per
format and GIOROM_MUTANT_SEED to another seed.
"""

import io
import os
import random
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from giorom.data.readers import READERS, DataError, Reader, detect_format

MUTANTS = int(os.environ.get("GIOROM_MUTANTS", "60"))

SEED = int(os.environ.get("GIOROM_MUTANT_SEED", "0"))

SECONDS = 20
"""A mutant that takes longer hangs; honest files of this size take a hundredth of a second."""

INSERTED = (
    b"", b" ", b"\n", b"\0", b'"', b"<", b"&amp;", b"0", b"-1", b"nan", b"1e400", b"9" * 15,
    b"4294967295", b"18446744073709551615", b"\xff" * 8, b"UInt8", b"Float64", b"appended",
    b"binary", b"ascii", b"string", b"list uchar int", b"BINARY", b"unsigned_char",
)  # fmt: skip

POINTS = np.random.default_rng(0).random((12, 3)).astype(np.float32)


def _vtk(extension: str, **setters: object) -> Callable[[Path], bytes]:
    """A file of VTK's own writer, set up by names of its methods."""

    def build(folder: Path) -> bytes:
        pv = pytest.importorskip("pyvista")
        vtk = pytest.importorskip("vtk")
        mesh = pv.PolyData(POINTS)
        mesh["id"] = np.arange(12)[::-1]
        mesh["velocity"] = POINTS
        mesh.field_data["TimeValue"] = [0.5]
        mesh.field_data["names"] = ["a b", "c"]
        legacy = extension == ".vtk"
        writer = vtk.vtkPolyDataWriter() if legacy else vtk.vtkXMLPolyDataWriter()
        writer.SetInputData(mesh)
        writer.SetFileName(str(folder / f"seed{extension}"))
        for name, value in setters.items():
            getattr(writer, name)(*([] if value is None else [value]))
        writer.Write()
        return (folder / f"seed{extension}").read_bytes()

    return build


def _hdf5(**options: object) -> Callable[[Path], bytes]:
    """A frame of CROM, by h5py."""

    def build(folder: Path) -> bytes:
        import h5py

        with h5py.File(folder / "seed", "w") as file:
            for name in ("x", "q"):
                file.create_dataset(name, data=POINTS.T, **options)
        return (folder / "seed").read_bytes()

    return build


def _npy(order: str) -> Callable[[Path], bytes]:
    """A motion of four frames, by NumPy."""

    def build(folder: Path) -> bytes:
        stream = io.BytesIO()
        np.save(stream, np.asarray(POINTS.reshape(4, 3, 3), order=order))
        return stream.getvalue()

    return build


def _bytes(content: bytes) -> Callable[[Path], bytes]:
    """A file by hand."""
    return lambda folder: content


PLY = b"ply\nformat %s 1.0\n%selement vertex 4\n%sproperty uchar id\nend_header\n%s"
AXES = b"property float x\nproperty float y\nproperty float z\n"
FACES = b"element face 1\nproperty list uchar int corners\n"
ROWS = np.zeros(4, dtype="<f4,<f4,<f4,u1")
ROWS["f0"], ROWS["f1"], ROWS["f3"] = POINTS[:4, 0], POINTS[:4, 1], range(4)

SEEDS = {
    "vtk text": ("vtk", "a.vtk", _vtk(".vtk", SetFileTypeToASCII=None)),
    "vtk binary": ("vtk", "a.vtk", _vtk(".vtk", SetFileTypeToBinary=None)),
    "vtk 4.2": ("vtk", "a.vtk", _vtk(".vtk", SetFileTypeToBinary=None, SetFileVersion=42)),
    "vtp text": ("vtk", "a.vtp", _vtk(".vtp", SetDataModeToAscii=None)),
    "vtp zlib": ("vtk", "a.vtp", _vtk(".vtp", SetDataModeToBinary=None)),
    "vtp lzma": ("vtk", "a.vtp", _vtk(".vtp", SetCompressorTypeToLZMA=None)),
    "vtp raw": (
        "vtk",
        "a.vtp",
        _vtk(".vtp", SetCompressorTypeToNone=None, SetEncodeAppendedData=0),
    ),
    "ply text": (
        "ply",
        "a.ply",
        _bytes(PLY % (b"ascii", b"", AXES, b"1 2 3 0\n4 5 6 1\n7 8 9 2\n1 1 1 3\n")),
    ),
    "ply binary": (
        "ply",
        "a.ply",
        _bytes(PLY % (b"binary_little_endian", FACES, AXES, b"\1\0\0\0\0" + ROWS.tobytes())),
    ),
    "obj": ("obj", "a.obj", _bytes(b"# a\nv 0 0 0.5 1\nv\t1 0 0\r\nv 0 1 0\nf 1/1 2/1 3/1\n")),
    "csv": ("csv", "a.csv", _bytes(b'"x","y [m]",z,id,type\n1,2,3,0,5\n4,5,6.5e-1,1,3\n')),
    "npy": ("npy", "a.npy", _npy("C")),
    "npy fortran": ("npy", "a.npy", _npy("F")),
    "crom": ("crom", "h5_f_0.h5", _hdf5()),
    "crom packed": (
        "crom",
        "h5_f_0.h5",
        _hdf5(chunks=(3, 5), compression="gzip", shuffle=True, fletcher32=True),
    ),
}


def _mutant(content: bytes, dice: random.Random) -> bytes:
    """The content with one to eight changes: bytes, words, cuts, copies, an early end."""
    changed = bytearray(content)
    for _ in range(dice.choice((1, 1, 1, 2, 3, 8))):
        at, kind = dice.randrange(len(changed) + 1), dice.randrange(6)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << dice.randrange(8)
        elif kind == 1:
            changed[at:at] = dice.choice(INSERTED)
        elif kind == 2:
            word = dice.choice(INSERTED)
            changed[at : at + len(word)] = word
        elif kind == 3:
            del changed[at : at + dice.choice((1, 1, 2, 4, 16, 200))]
        elif kind == 4:
            start = dice.randrange(len(changed) + 1)
            changed[at:at] = changed[start : start + dice.choice((1, 8, 64, 400))]
        elif kind == 5 and dice.random() < 0.3:
            del changed[at:]
    return bytes(changed)


@contextmanager
def _no_hang() -> Iterator[None]:
    """Raise where a block takes longer than ``SECONDS``; a signal ends C code's loops too late."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("case", SEEDS)
def test_a_mutant_gives_frames_or_one_line(tmp_path, case):
    """Seeds are files of independent writers; a warning counts as a failure."""
    name, file_name, build = SEEDS[case]
    reader = {reader.name: reader for reader in READERS}[name]
    seed, path = build(tmp_path), tmp_path / "mutant" / file_name
    path.parent.mkdir()
    path.write_bytes(seed)
    assert detect_format(path) is reader
    assert sum(1 for motion in reader.read(path) for _ in motion.frames()) >= 1
    dice = random.Random(f"{case} {SEED}")  # noqa: S311  (no secret)
    refused = 0
    for _ in range(MUTANTS):
        path.write_bytes(_mutant(seed, dice))
        reader.detect(path)
        with _no_hang(), warnings.catch_warnings(action="error"):
            refused += _is_refused(reader, path)
    assert 0 < refused < MUTANTS


def _is_refused(reader: Reader, path: Path) -> bool:
    """Whether a reader says in one line that it cannot read a file."""
    try:
        shapes = {len(frame.shape) for motion in reader.read(path) for frame in motion.frames()}
    except DataError as error:
        return "\n" not in str(error) or pytest.fail(f"several lines: {error}")
    assert shapes == {2}
    return False
