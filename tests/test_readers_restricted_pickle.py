"""The restricted pickle reader, on pickles of the real picklers and on hostile ones."""

import collections
import copyreg
import io
import os
import pickle
import struct
import tracemalloc
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from giorom.data.metadata import DataError
from giorom.data.readers.torch_file import load_torch_file

PROTOCOLS = (2, 3, 4, 5)


def written(path: Path, data: bytes) -> Path:
    file = path / "data.pkl"
    file.write_bytes(data)
    return file


def array_of(value: Any) -> np.ndarray:
    return value.array.read(most_bytes=1 << 30)


def sample(dtype: str) -> np.ndarray:
    """Values that use every byte, so that text encodings and byte orders cannot hide."""
    generator = np.random.default_rng(0)
    raw = generator.integers(0, 256, 5 * 3 * 2 * np.dtype(dtype).itemsize, dtype=np.uint8)
    return raw.view(dtype).reshape(5, 3, 2)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8", "<f2", "<i4", ">i8", "|u1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_bit_by_bit(protocol: int, dtype: str, order: str, tmp_path: Path):
    """NumPy pickles, we read: every protocol, type, byte order and order of the axes."""
    array = np.asarray(sample(dtype), order=order)
    value = load_torch_file(written(tmp_path, pickle.dumps({"a": array, "b": array}, protocol)))
    native = array.astype(array.dtype.newbyteorder("="))
    for key in ("a", "b"):
        assert array_of(value[key]).tobytes() == native.tobytes()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_containers_and_numbers_come_back(protocol: int, tmp_path: Path):
    """Whatever data files hold besides arrays."""
    plain = {"n": None, "t": (True, False), "i": [0, -1, 255, 70_000, 1 << 40], "f": 2.5}
    ordered = collections.OrderedDict(text="ü", nested={"deep": [(), [], {}]})
    value = load_torch_file(written(tmp_path, pickle.dumps([plain, ordered], protocol)))
    assert value == [plain, dict(ordered)]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("time_axis", [0, 1, 2])
@pytest.mark.parametrize("order", ["C", "F"])
def test_frames_are_the_slices_along_time(
    protocol: int, time_axis: int, order: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Against NumPy's indexing; blocks are made so small that several passes are needed."""
    monkeypatch.setattr("giorom.data.readers.lazy_array.BLOCK_BYTES", 100)
    monkeypatch.setattr("giorom.data.readers.lazy_array.STEP_BYTES", 64)
    array = np.asarray(np.random.default_rng(1).normal(size=(9, 8, 7)), order=order)
    value = load_torch_file(written(tmp_path, pickle.dumps(array, protocol)))
    frames = list(value.array.frames(time_axis=time_axis))
    assert np.array_equal(np.stack(frames), np.moveaxis(array, time_axis, 0))


def test_an_array_that_would_be_read_again_and_again_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Gigabytes that are stored particle after particle; the way out is said."""
    monkeypatch.setattr("giorom.data.readers.lazy_array.BLOCK_BYTES", 100)
    value = load_torch_file(written(tmp_path, pickle.dumps(np.zeros((9, 70, 3)))))
    assert len(list(value.array.frames(time_axis=0))) == 9
    with pytest.raises(DataError, match="first axis"):
        list(value.array.frames(time_axis=1))


@pytest.mark.parametrize("is_zip", [True, False])
def test_tensors_come_back(is_zip: bool, tmp_path: Path):
    """torch.save writes, we read: both layouts, views, half widths, permuted axes."""
    tensor = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(0))
    saved = {
        "whole": tensor,
        "part": tensor[2:4],
        "permuted": tensor.permute(1, 0, 2),
        "half": tensor.half(),
        "brain": tensor.bfloat16(),
        "double": tensor.double(),
        "count": torch.arange(7),
        "numpy": tensor.numpy(),
    }
    path = tmp_path / "state.pt"
    torch.save(saved, path, _use_new_zipfile_serialization=is_zip)
    value = load_torch_file(path)
    for key, expected in saved.items():
        found = array_of(value[key])
        plain = torch.as_tensor(expected)
        plain = plain.float() if key == "brain" else plain
        assert np.array_equal(found, plain.numpy()), key


def test_tensors_of_a_big_endian_machine_come_back(tmp_path: Path):
    """PyTorch's own switch for the byte order."""
    tensor = torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    order = torch.serialization.LoadEndianness
    path = tmp_path / "state.pt"
    torch.save({"x": tensor}, path)
    assert order.BIG.value
    import zipfile

    swapped = tmp_path / "big.pt"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(swapped, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name.endswith("data/0"):
                data = np.frombuffer(data, "<f4").astype(">f4").tobytes()
            new.writestr(name, b"big" if name.endswith("byteorder") else data)
    assert np.array_equal(array_of(load_torch_file(swapped)["x"]), tensor.numpy())


def test_a_tensor_with_gaps_is_refused(tmp_path: Path):
    """Strides that skip elements are not guessed at."""
    path = tmp_path / "state.pt"
    torch.save(torch.zeros(4, 6)[:, ::2], path)
    with pytest.raises(DataError, match="contiguous"):
        load_torch_file(path)


class Marker:
    """Where hostile pickles would leave a trace."""

    hits: ClassVar[list[str]] = []


def strike(*_: Any) -> None:
    """What must never be called."""
    Marker.hits.append("struck")


class Reducing:
    """An object whose pickle calls something."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.parts = (function, arguments)

    def __reduce__(self) -> Any:
        """What the unpickler is told to call."""
        return self.parts


class Plain:
    """An object of a class of its own."""


def by_hand(opcodes: bytes) -> bytes:
    return b"\x80\x04" + opcodes + b"."


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value.encode())]) + value.encode()


def hostile() -> dict[str, bytes]:
    this = __name__.encode()
    touch = f"open({os.devnull!r})"
    array = np.zeros(3)
    files = {
        "os.system": pickle.dumps(Reducing(os.system, "true"), 2),
        "eval": pickle.dumps(Reducing(eval, touch), 3),
        "exec": pickle.dumps(Reducing(exec, touch), 4),
        "getattr": pickle.dumps(Reducing(getattr, array, "tofile"), 4),
        "numpy.load": by_hand(text("numpy") + text("load") + b"\x93" + text("x") + b"\x85R"),
        "numpy.core.records": b"\x80\x02cnumpy.core.records\nfromfile\n.",
        "fromfile": by_hand(b"cnumpy\nfromfile\n)R"),
        "nested": pickle.dumps({"a": [array, (Reducing(strike),)]}, 4),
        "a class": pickle.dumps(Plain(), 4),
        "dotted": by_hand(text("numpy") + text("ndarray.tofile") + b"\x93"),
        "dotted module": by_hand(text("numpy.core.multiarray") + text("_reconstruct.x") + b"\x93"),
        "global by bytes": by_hand(b"C\x05numpy" + text("dtype") + b"\x93"),
        "inst": by_hand(b"(i" + this + b"\nstrike\n"),
        "obj": by_hand(b"(c" + this + b"\nstrike\no"),
        "extension": by_hand(b"\x82\x01"),
        "persistent id by text": b"\x80\x02Pos.system\n.",
        "persistent id": by_hand(text("x") + b"Q"),
        "newobj": by_hand(b"cnumpy\nndarray\n)\x81"),
        "newobj_ex": by_hand(b"cnumpy\nndarray\n)}\x92"),
        "named and called": by_hand(b"cnumpy\nndarray\n)R"),
        "storage called": by_hand(b"ctorch\nFloatStorage\n)R"),
        "reduce of no global": by_hand(text("x") + b")R"),
        "build of a dict": by_hand(b"}}b"),
        "build of a global": by_hand(b"cnumpy\ndtype\n}b"),
        "set state twice": pickle.dumps(array, 2)[:-1] + b"Nb.",
        "codec": by_hand(b"c_codecs\nencode\n" + text("x") + text("rot13") + b"\x86R"),
        "buffers outside": by_hand(b"\x97"),
        "memory view": by_hand(b"\x98"),
        "old protocol": pickle.dumps({"a": 1}, 0),
        "duplicate": by_hand(b"]2"),
        "long text integer": by_hand(b"L" + b"9" * 100 + b"L\n"),
        "long integer": by_hand(b"\x8b\xff\xff\xff\x7f"),
    }
    return files


@pytest.mark.parametrize("name", [*hostile()])
def test_a_hostile_pickle_is_refused_and_nothing_is_run(name: str, tmp_path: Path):
    """None of these may reach Python's machinery; a refusal is one line."""
    Marker.hits.clear()
    with pytest.raises(DataError) as refusal:
        load_torch_file(written(tmp_path, hostile()[name]))
    assert "\n" not in str(refusal.value)
    assert Marker.hits == []


def test_the_unpickler_would_have_been_struck():
    """The counter-example shows that the trace works."""
    Marker.hits.clear()
    pickle.loads(hostile()["nested"])  # noqa: S301 - this is the point
    assert Marker.hits == ["struck"]


@pytest.mark.parametrize("name", ["os.system", "builtins.eval"])
def test_a_refusal_names_the_global(name: str, tmp_path: Path):
    """The message says what the file wanted."""
    function = {"os.system": os.system, "builtins.eval": eval}[name]
    wanted = name.replace("os.", f"{os.system.__module__}.")
    with pytest.raises(DataError, match=wanted):
        load_torch_file(written(tmp_path, pickle.dumps(Reducing(function, "1"), 4)))


def test_a_registered_extension_is_refused(tmp_path: Path):
    """Extension codes stand for globals that the receiving program has registered."""
    copyreg.add_extension(__name__, "strike", 77)
    try:
        data = pickle.dumps(Reducing(strike), 4)
        assert b"\x82M" in data
        with pytest.raises(DataError, match="EXT1"):
            load_torch_file(written(tmp_path, data))
    finally:
        copyreg.remove_extension(__name__, "strike", 77)


def state_of(shape: bytes, dtype: bytes, flags: bytes, content: bytes) -> bytes:
    """An array whose state is laid out by hand."""
    start = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
    return by_hand(start + b"(K\x01" + shape + dtype + flags + content + b"tb")


def damaged() -> dict[str, bytes]:
    good = pickle.dumps({"a": np.arange(600.0), "b": [1, 2]}, 4)
    float4 = b"cnumpy\ndtype\n" + text("f4") + b"\x89\x88\x87R"
    twelve = b"C\x0c" + bytes(12)
    huge = b"\x8a\x07" + (1 << 50).to_bytes(7, "little")
    files = {
        "cut off": good[:-40],
        "without its end": good[:-1],
        "in its middle": good[:200],
        "empty": b"",
        "one byte": b"\x80",
        "negative size": state_of(b"J" + struct.pack("<i", -3) + b"\x85", float4, b"\x89", twelve),
        "absurd size": state_of(huge + huge + huge + b"\x87", float4, b"\x89", twelve),
        "too few bytes": state_of(b"K\x04\x85", float4, b"\x89", twelve),
        "too many bytes": state_of(b"K\x02\x85", float4, b"\x89", twelve),
        "bool as size": state_of(b"\x88\x85", float4, b"\x89", twelve),
        "float as size": state_of(b"G" + bytes(8) + b"\x85", float4, b"\x89", twelve),
        "no bytes": state_of(b"K\x03\x85", float4, b"\x89", b"N"),
        "no type": state_of(b"K\x03\x85", b"N", b"\x89", twelve),
        "no order": state_of(b"K\x03\x85", float4, b"K\x01", twelve),
        "objects": pickle.dumps(np.array([Plain()], dtype=object), 4),
        "records": pickle.dumps(np.zeros(3, [("x", "f4")]), 4),
        "dates": pickle.dumps(np.zeros(3, "M8[s]"), 4),
        "long double": pickle.dumps(np.zeros(3, np.longdouble), 4),
        "complex": pickle.dumps(np.zeros(3, complex), 4),
        "text array": pickle.dumps(np.array(["a"]), 4),
        "empty stack": by_hand(b"0"),
        "no mark": by_hand(b"t"),
        "two values": by_hand(b"NN"),
        "mark left": by_hand(b"N("),
        "memo": by_hand(b"h\x05"),
        "memo of nothing": by_hand(b"\x94"),
        "memo of a mark": by_hand(b"(\x94"),
        "two numberings": by_hand(b"]\x94q\x07h\x07"),
        "append to none": by_hand(b"NNa"),
        "odd pairs": by_hand(b"}(" + text("a") + b"u"),
        "number as key": by_hand(b"}K\x01K\x02s"),
        "huge text": by_hand(b"\x8d" + b"\xff" * 8),
        "huge bytes": by_hand(b"B\xff\xff\xff\xff"),
        "no text": by_hand(b"\x8c\x01\xff"),
        "no latin": by_hand(b"c_codecs\nencode\n" + text("€") + text("latin1") + b"\x86R"),
        "wrong magic": pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(5, 2) * 9,
    }
    return files


@pytest.mark.parametrize("name", [*damaged()])
def test_a_damaged_pickle_is_refused_in_one_line(name: str, tmp_path: Path):
    """Wrong sizes, types, orders, stacks and ends; never another exception."""
    path = written(tmp_path, damaged()[name])
    with pytest.raises(DataError) as refusal:
        load_torch_file(path)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 400


def test_a_list_that_holds_itself_is_only_a_list(tmp_path: Path):
    """A cycle neither hangs nor recurses, as nothing walks through values it does not know."""
    cycle: list[Any] = []
    cycle.append(cycle)
    value = load_torch_file(written(tmp_path, pickle.dumps({"position": cycle}, 4)))
    assert value["position"][0] is value["position"]


def test_deep_nesting_does_not_recurse(tmp_path: Path):
    """Python's own limit is a thousand."""
    value = load_torch_file(written(tmp_path, by_hand(b"]" + b"\x85" * 5_000)))
    assert type(value) is tuple


def test_text_that_is_longer_than_the_array_is_found_when_it_is_read(tmp_path: Path):
    """In protocol 2 only decoding tells how many bytes a text holds."""
    data = bytearray(pickle.dumps(np.full(400, 200, np.uint8), 2))
    found = data.find(b"\xc3\x88" * 40)
    data[found : found + 2] = b"AA"
    array = load_torch_file(written(tmp_path, bytes(data))).array
    with pytest.raises(DataError, match="number of bytes"):
        array.read(most_bytes=1_000)


@pytest.mark.parametrize("limit", ["MOST_STACK", "MOST_OBJECTS"])
@pytest.mark.parametrize("opcodes", [b"(", b"]", b"K\x01", b"]\x94h\x00", b"]0("])
def test_a_pickle_that_fills_the_memory_is_refused(
    limit: str, opcodes: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Stack and objects have limits, lowered here to be reached quickly."""
    monkeypatch.setattr(f"giorom.data.readers.restricted_pickle.{limit}", 500)
    with pytest.raises(DataError, match="more than"):
        load_torch_file(written(tmp_path, by_hand(opcodes * 600)))


def test_a_pickle_without_an_end_in_sight_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Steps that leave nothing behind are counted too."""
    monkeypatch.setattr("giorom.data.readers.pickle_opcodes.MOST_STEPS", 1_000)
    with pytest.raises(DataError, match="steps"):
        load_torch_file(written(tmp_path, by_hand(b"N0" * 600)))


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_large_array_is_read_within_a_small_memory(protocol: int, tmp_path: Path):
    """Peak of a block, not of the file (40 MB); frames lie across the file."""
    path = tmp_path / "data.pkl"
    array = np.zeros((25_000, 200, 2), np.float32)
    with path.open("wb") as file:
        pickle.dump({"position": [array]}, file, protocol)
    del array
    size = path.stat().st_size
    blocks = "giorom.data.readers.lazy_array.BLOCK_BYTES"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, 8 << 20)
        tracemalloc.start()
        value = load_torch_file(path)
        frames = sum(1 for _ in value["position"][0].array.frames(time_axis=1))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert frames == 200
    assert size >= 40_000_000
    assert peak < size / 2


def test_pickles_of_the_python_pickler_are_read_too(tmp_path: Path):
    """The pickler written in Python lays memo and frames out in another way."""
    buffer = io.BytesIO()
    pickle._Pickler(buffer, 4).dump({"a": np.arange(6.0), "b": np.arange(6.0)})
    value = load_torch_file(written(tmp_path, buffer.getvalue()))
    assert np.array_equal(array_of(value["b"]), np.arange(6.0))
