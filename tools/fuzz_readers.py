"""Feed mutated files to every reader of foreign data and count what happens.

    python tools/fuzz_readers.py --count 100000 --jobs 2 --json fuzz.json

Each format has small seed files; ``inner`` seeds are mutated inside their packing (the message of a
TFRecord, a member of an archive) and packed again with right check sums, since a reader that
compares check sums would otherwise stop at once. Input i of a seed depends on the number
alone, so that a finding is repeated with ``--only SEED --first i --count 1``.

An input may be read or be refused by a ``DataError`` of one line. Anything else is a finding:
another exception, a hang (``--seconds``), too much memory (``--memory``), or the end of the
process, which is why the inputs run in child processes: HDF5 is a C library. With
``python -W error`` a warning is a finding too.
"""

import argparse
import json
import multiprocessing
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing import connection
from pathlib import Path
from typing import Any

from fuzz_seeds import Seed, all_seeds

from giorom.data.readers import READERS, DataError, Reader

INTERESTING = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)
INTERESTING_WIDE = (*INTERESTING, 1 << 40, (1 << 62), (1 << 63) - 1, (1 << 64) - 1)
NUMBERS = (b"-1", b"0", b"999999999999", b"1e999", b"nan", b"9" * 40)

MOST_FRAMES = 2_000
"""Frames that are read of one input."""


class Hang(Exception):  # noqa: N818 - what happened
    """An input took too long."""


def mutate(data: bytes, generator: random.Random) -> bytes:
    """One to four changes of a file.

    Args:
        data: The file.
        generator: Where the choices come from.

    Returns:
        The changed file.
    """
    changed = bytearray(data)
    for _ in range(generator.randint(1, 4)):
        change = generator.choice(MUTATIONS)
        change(changed, generator)
    return bytes(changed)


def _place(data: bytearray, generator: random.Random) -> int:
    """Somewhere in the file, more often near its ends, where headers are."""
    if not data:
        return 0
    near = generator.random()
    if near < 0.3:
        return generator.randrange(min(len(data), 128))
    if near < 0.4:
        return len(data) - 1 - generator.randrange(min(len(data), 64))
    return generator.randrange(len(data))


def _flip(data: bytearray, generator: random.Random) -> None:
    if data:
        data[_place(data, generator)] ^= 1 << generator.randrange(8)


def _set(data: bytearray, generator: random.Random) -> None:
    if data:
        data[_place(data, generator)] = generator.choice((0, 1, 0x7F, 0x80, 0xFF, 0x2E, 0x28))


def _number(data: bytearray, generator: random.Random) -> None:
    """Overwrite a length field."""
    code, size = generator.choice((("H", 2), ("I", 4), ("Q", 8)))
    start = _place(data, generator)
    values = [value for value in (*INTERESTING_WIDE, len(data)) if value < 1 << (8 * size)]
    packed = struct.pack(generator.choice("<>") + code, generator.choice(values))
    data[start : start + size] = packed[: max(0, len(data) - start)]


def _text_number(data: bytearray, generator: random.Random) -> None:
    """Overwrite a number in text."""
    start = _place(data, generator)
    while start < len(data) and not 48 <= data[start] <= 57:
        start += 1
    end = start
    while end < len(data) and 48 <= data[end] <= 57:
        end += 1
    if end > start:
        data[start:end] = generator.choice(NUMBERS)


def _cut(data: bytearray, generator: random.Random) -> None:
    del data[_place(data, generator) :]


def _remove(data: bytearray, generator: random.Random) -> None:
    start = _place(data, generator)
    del data[start : start + generator.choice((1, 2, 4, 8, 64))]


def _insert(data: bytearray, generator: random.Random) -> None:
    start = _place(data, generator)
    data[start:start] = generator.randbytes(generator.choice((1, 2, 4, 8, 64)))


def _repeat(data: bytearray, generator: random.Random) -> None:
    start, length = _place(data, generator), generator.choice((1, 4, 16, 128))
    data[start:start] = data[start : start + length] * generator.randint(1, 3)


def _swap(data: bytearray, generator: random.Random) -> None:
    length = generator.choice((1, 4, 16))
    first, second = _place(data, generator), _place(data, generator)
    one, two = bytes(data[first : first + length]), bytes(data[second : second + length])
    if len(one) == len(two):
        data[first : first + length], data[second : second + length] = two, one


MUTATIONS = (
    _flip,
    _flip,
    _set,
    _number,
    _number,
    _text_number,
    _cut,
    _remove,
    _insert,
    _repeat,
    _swap,
)


def read_everything(reader: Reader, path: Path) -> bool:
    """Detect and read an input; whether it was read and not refused.

    Args:
        reader: The reader.
        path: The input.

    Returns:
        Whether it was read.

    Raises:
        AssertionError: If a refusal is longer than a line or detection raises.
    """
    reader.detect(path)
    left = MOST_FRAMES
    try:
        for trajectory in reader.read(path):
            count = len(trajectory.particle_type)
            for frame in trajectory.frames():
                if frame.ndim != 2 or len(frame) != count or frame.shape[1] not in (2, 3):
                    raise AssertionError(f"a frame of shape {frame.shape} for {count} particles")
                left -= 1
                if left == 0:
                    return True
    except DataError as refusal:
        text = str(refusal)
        if "\n" in text or len(text) > 2_000:
            raise AssertionError(f"a refusal of {len(text)} characters: {text[:200]}") from None
        return False
    return True


def _inputs(seed: Seed, first: int, count: int) -> Iterator[tuple[int, bytes]]:
    """The mutated files of a seed."""
    for number in range(first, first + count):
        generator = random.Random(f"{seed.name}:{number}")  # noqa: S311 - no secret
        yield number, seed.pack(mutate(seed.content, generator))


def _limit(options: argparse.Namespace) -> None:
    """Limits of a child process."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    memory = used + options.memory * (1 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def stop(*_: Any) -> None:
        raise Hang

    signal.signal(signal.SIGALRM, stop)


def _child(seed: Seed, first: int, options: argparse.Namespace, state: Any, log: Path) -> None:
    """Run the inputs of a seed from a number on; ``state`` survives this process."""
    reader = next(reader for reader in READERS if reader.name == seed.reader)
    folder = Path(tempfile.mkdtemp(dir=options.folder))
    for name, content in seed.others.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    target = folder / seed.target
    target.parent.mkdir(parents=True, exist_ok=True)
    path = folder if seed.is_folder else target
    target.write_bytes(seed.pack(seed.content))
    if not (reader.detect(path) and read_everything(reader, path)):
        _note(log, -1, "the seed itself is not read")
    _limit(options)
    left = options.first + options.count - first
    for number, data in _inputs(seed, first, left):
        state[0] = number
        target.write_bytes(data)
        signal.setitimer(signal.ITIMER_REAL, options.seconds)
        try:
            state[2 if read_everything(reader, path) else 1] += 1
        except Hang:
            _note(log, number, f"hangs for more than {options.seconds} s")
        except BaseException as error:
            _note(log, number, _describe(error))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    shutil.rmtree(folder, ignore_errors=True)
    state[0] = options.first + options.count


def _describe(error: BaseException) -> str:
    """An exception and where it was raised."""
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    code = place.tb_frame.f_code.co_filename if place else ""
    where = f"{Path(code).name}:{place.tb_lineno if place else 0}"
    return f"{type(error).__name__} at {where}: {str(error)[:120]}"


def _note(log: Path, number: int, what: str) -> None:
    """Write a finding down at once: the process may end before long."""
    with log.open("a") as file:
        file.write(json.dumps([number, what]) + "\n")


def fuzz(seed: Seed, options: argparse.Namespace, folder: Path) -> None:
    """All inputs of a seed, in child processes that are replaced when they end early.

    Args:
        seed: The seed.
        options: The command line.
        folder: Where the findings and the counts are written, as ``NAME.log`` and ``NAME.json``.
    """
    context = multiprocessing.get_context("fork")
    state = context.Array("q", [options.first, 0, 0], lock=False)
    log = folder / f"{seed.name}.log"
    begin, first = time.monotonic(), options.first
    while first < options.first + options.count:
        child = context.Process(target=_child, args=(seed, first, options, state, log))
        child.start()
        child.join()
        first = state[0]
        if child.exitcode != 0:
            _note(log, first, f"ends the process (exit code {child.exitcode})")
            first += 1
    lines = log.read_text().splitlines() if log.exists() else []
    result = {
        "seed": seed.name,
        "inputs": options.count,
        "refused": state[1],
        "read": state[2],
        "findings": [json.loads(line) for line in lines],
        "seconds": round(time.monotonic() - begin, 1),
    }
    (folder / f"{seed.name}.json").write_text(json.dumps(result))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000, help="inputs of each seed")
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--jobs", type=int, default=1, help="seeds at a time")
    parser.add_argument("--only", nargs="*", default=[], help="names of seeds or readers")
    parser.add_argument("--seconds", type=float, default=20.0, help="longest time of an input")
    parser.add_argument("--memory", type=int, default=1024, help="memory beyond the start [MiB]")
    parser.add_argument("--folder", default="/dev/shm", help="where the inputs are written")  # noqa: S108
    parser.add_argument("--json", type=Path, help="where to write the counts")
    return parser.parse_args()


def _run(seeds: list[Seed], options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Fuzz some seeds at a time."""
    context = multiprocessing.get_context("fork")
    waiting, running, results = list(seeds), {}, []
    while waiting or running:
        while waiting and len(running) < options.jobs:
            seed = waiting.pop(0)
            process = context.Process(target=fuzz, args=(seed, options, folder))
            process.start()
            running[process.sentinel] = (process, seed)
        for sentinel in connection.wait(list(running)):
            process, seed = running.pop(sentinel)
            process.join()
            results.append(json.loads((folder / f"{seed.name}.json").read_text()))
            _report(results[-1])
    return results


def main() -> int:
    """Fuzz every seed and print a table.

    Returns:
        1 if there was a finding.
    """
    options = _options()
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        options.folder = folder = Path(name)
        wanted = set(options.only)
        seeds = [
            seed for seed in all_seeds(folder) if not wanted or {seed.name, seed.reader} & wanted
        ]
        results = _run(seeds, options, folder)
    total: Counter[str] = Counter()
    for result in results:
        total.update({key: result[key] for key in ("inputs", "refused", "read")})
        total["findings"] += len(result["findings"])
    missing = sorted({reader.name for reader in READERS} - {seed.reader for seed in seeds})
    sys.stdout.write(f"total: {dict(total)}; readers not fuzzed: {', '.join(missing) or 'none'}\n")
    if options.json:
        options.json.write_text(json.dumps({"total": total, "seeds": results}, indent=2) + "\n")
    return 1 if total["findings"] else 0


def _report(result: dict[str, Any]) -> None:
    """One line per seed, and its first findings."""
    sys.stdout.write(
        f"{result['seed']:28} {result['inputs']:8} inputs  {result['refused']:8} refused  "
        f"{result['read']:7} read  {len(result['findings']):4} findings  {result['seconds']:7} s\n"
    )
    for number, what in result["findings"][:5]:
        sys.stdout.write(f"    input {number}: {what}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main())
