"""Read files of ``torch.save`` without PyTorch's unpickler.

Two layouts exist: a zip archive with ``data.pkl`` and one member per tensor storage, and, from
before PyTorch 1.6, five pickles followed by the storages. Both give the same tree of dicts, lists
and lazy arrays. A bare pickle is accepted too.
"""

import re
from pathlib import Path
from typing import Any

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource, FileSource
from giorom.data.readers.lazy_array import LazyArray, StorageSlice, TensorStorage
from giorom.data.readers.restricted_pickle import first_texts, load_pickle
from giorom.data.readers.zip_archive import ZipArchive, is_zip

__all__ = ["load_torch_file", "looks_packed", "torch_file_texts"]

LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
LEGACY_VERSION = 1001
"""What a file from before PyTorch 1.6 begins with."""


def load_torch_file(path: Path) -> Any:
    """Read a file of ``torch.save``, or a bare pickle.

    Args:
        path: The file.

    Returns:
        Dicts with text keys, lists, tuples, numbers and ``StoredArray``; array bytes are unread.

    Raises:
        DataError: If it is damaged, or its pickle asks for more than arrays.
    """
    if is_zip(path):
        return _load_archive(path)
    source = FileSource(path)
    first = load_pickle(source)
    return _load_legacy(source, first.end) if first.value == LEGACY_MAGIC else first.value


def torch_file_texts(path: Path) -> list[str]:
    """Short texts near the beginning of the pickle in a file, to tell what it is.

    Args:
        path: The file.

    Returns:
        The texts; empty if it is no such file.
    """
    try:
        if is_zip(path):
            archive = ZipArchive(path)
            return first_texts(archive.source(_pickle_name(archive)))
        source = FileSource(path)
        texts = first_texts(source)
        if not texts and source.size > 20 and source.read_at(0, 3) == b"\x80\x02\x8a":
            start = 0
            for _ in range(3):
                start = load_pickle(source, start=start).end
            texts = first_texts(source, start=start)
        return texts
    except DataError:
        return []


def looks_packed(path: Path) -> bool:
    """Whether a file begins like one of ``torch.save`` or a pickle, be it whole or damaged.

    Args:
        path: The file.

    Returns:
        Whether it does; False if it cannot be read.
    """
    try:
        return is_zip(path) or FileSource(path).read_at(0, 1) == b"\x80"
    except DataError:
        return False


def _pickle_name(archive: ZipArchive) -> str:
    """The member that holds the pickle."""
    names = [name for name in archive.members if re.fullmatch(r"([^/]+/)?data\.pkl", name)]
    if len(names) != 1:
        raise DataError(f"{archive.path} is no file of torch.save: it has no data.pkl.")
    return names[0]


def _load_archive(path: Path) -> Any:
    """Read the zip layout."""
    archive = ZipArchive(path)
    name = _pickle_name(archive)
    folder = name.removesuffix("data.pkl")
    is_big = False
    if f"{folder}byteorder" in archive.members:
        order = archive.source(f"{folder}byteorder")
        is_big = order.read_at(0, min(order.size, 8)).strip() == b"big"
    loaded = load_pickle(archive.source(name), has_storages=True)
    for storage in loaded.storages:
        member = f"{folder}data/{storage.key}"
        if not re.fullmatch(r"[0-9]{1,12}", storage.key):
            raise DataError(f"{path} names a tensor storage {storage.key[:40]!r}. It is damaged.")
        _place(storage, archive.source(member), 0, is_big=is_big)
    return loaded.value


def _load_legacy(source: ByteSource, start: int) -> Any:
    """Read the five pickles and the storages after them."""
    version = load_pickle(source, start=start)
    system = load_pickle(source, start=version.end)
    if version.value != LEGACY_VERSION or type(system.value) is not dict:
        raise DataError(f"{source.name} is no file of torch.save of a known version.")
    loaded = load_pickle(source, start=system.end, has_storages=True)
    keys = load_pickle(source, start=loaded.end)
    is_big = system.value.get("little_endian") is False
    by_key: dict[str, list[TensorStorage]] = {}
    for storage in loaded.storages:
        by_key.setdefault(storage.key, []).append(storage)
    names = keys.value if type(keys.value) is list else [None]
    if any(type(name) is not str or name not in by_key for name in names):
        raise DataError(f"{source.name}: the list of tensor storages is damaged.")
    offset = keys.end
    for key in names:
        count = int.from_bytes(source.read_at(offset, 8), "big" if is_big else "little")
        if count != by_key[key][0].count:
            raise DataError(f"{source.name}: tensor storage {key!r} has another length than named.")
        for storage in by_key[key]:
            _place(storage, source, offset + 8, is_big=is_big)
        offset += 8 + count * _item_size(by_key[key][0])
    return loaded.value


def _place(storage: TensorStorage, source: ByteSource, offset: int, *, is_big: bool) -> None:
    """Note where a storage lies, once it is known to lie there."""
    length = storage.count * _item_size(storage)
    if offset + length > source.size:
        raise DataError(
            f"{source.name} is cut off: a tensor storage of {length} bytes is announced, but "
            f"{source.size - offset} are there."
        )
    storage.source, storage.offset, storage.is_big = source, offset, is_big


def _item_size(storage: TensorStorage) -> int:
    return LazyArray(storage.dtype, (), (), StorageSlice(storage, 0)).item_size
