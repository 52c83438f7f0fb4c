"""Random and mutated bytes at every door of the product: ``python tests/fuzz.py --inputs 1000000 --door xbus``.

A door passes when it raises nothing but its named errors, takes a good input right after every bad one, and its process
does not grow. What fails is printed with the input, in hex, and the exit code is 1. Doors are in ``fuzz_doors``.
"""

from __future__ import annotations

import gc
import json as json_module
import os
import random
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

LARGEST_GROWTH = 4.0
"""MiB of resident memory, after a twentieth of the inputs to settle."""
KEPT_FAILURES = 5
INTERESTING = (b"\x00", b"\xff", b"\x7f", b"\x80", b"\xfa\xff", b"\x50", b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f")
TOKENS = (
    *(b"NaN", b"1e999", b"-1", b"0", b"18446744073709551616", b"null", b"true", b'""', b"[]", b"{}", b'"\\ud800"'),
    *(b"1e-400", b"inf", b"nan", b"''", b"-0.0", b"[[", b"}", b"\xc3\x28", b"1979-05-27"),
)


@dataclass(frozen=True, slots=True)
class Door:
    """One way into the product.

    Attributes:
        take: gives it an input; may raise ``refusals`` and nothing else.
        refusals: the door's named errors.
        seeds: good inputs, which are mutated.
        recover: raises when the door does not take a good input now.
        share: of all inputs, when all doors are tried together.
        text: whether inputs are JSON or TOML, which are also mutated token by token.
    """

    take: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...]
    seeds: Sequence[bytes]
    recover: Callable[[], None]
    share: float = 1.0
    text: bool = False


class Mutator:
    """An endless source of inputs for one door; the same seed gives the same ones."""

    def __init__(self, door: Door, seed: str) -> None:
        self._random = random.Random(seed)
        self._seeds, self._text = door.seeds, door.text
        self._longest = max(64, 2 * max(map(len, door.seeds)))

    def next(self) -> bytes:
        """One input: now and then pure noise, mostly a good one with a few things done to it."""
        rng = self._random
        if rng.random() < 0.1:
            return rng.randbytes(rng.randrange(min(300, self._longest)))
        data = bytearray(rng.choice(self._seeds))
        for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
            self._mutate(data)
        return bytes(data[: 4 * self._longest])

    def _mutate(self, data: bytearray) -> None:
        rng = self._random
        size = len(data)
        at = rng.randrange(size + 1)
        end = min(size, at + rng.randrange(1, 9))
        match rng.randrange(10 if self._text else 8):
            case 0 | 1 if size:
                data[at % size] ^= 1 << rng.randrange(8)
            case 2 if size:
                data[at % size] = rng.randrange(256)
            case 3:
                data[at:end] = rng.choice(INTERESTING)
            case 4:
                del data[at : at + rng.choice((1, 2, 4, rng.randrange(size + 1)))]
            case 5:
                data[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 6:
                data[at:at] = bytes(data[at:end]) * rng.choice((1, 2, 3, 50))
            case 7:
                other = rng.choice(self._seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            case 8:
                self._replace_token(data, at)
            case 9:
                data[at:at] = rng.choice((b"[", b"{", b'{"a":', b'"', b"\n", b"=")) * rng.choice((1, 2, 3000))

    def _replace_token(self, data: bytearray, at: int) -> None:
        """A number or a word becomes something that surprises."""
        rng = self._random
        first = next((i for i in range(at, min(len(data), at + 80)) if chr(data[i]).isalnum()), len(data))
        last = next(
            (i for i in range(first, len(data)) if not (chr(data[i]).isalnum() or data[i] in b".-+_")), len(data)
        )
        data[first:last] = rng.choice(TOKENS)


@dataclass(slots=True)
class Result:
    """How one door did."""

    door: str
    inputs: int = 0
    taken: int = 0
    refused: int = 0
    failures: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Where it broke → what was raised and the first input that did it, in hex."""
    growth: float = 0.0
    """MiB."""
    slowest: float = 0.0
    """s that the slowest input took."""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.failures and self.growth <= LARGEST_GROWTH


def fuzz(name: str, door: Door, inputs: int, seed: int, step: Callable[[int], None] = lambda _: None) -> Result:
    """Try ``inputs`` inputs at one door; ``step`` is told how many were done."""
    result, mutator, now = Result(name), Mutator(door, f"{seed}/{name}"), time.perf_counter
    start, before, settled = now(), resident(), max(1, inputs // 20)
    door.recover()
    for index in range(inputs):
        data = mutator.next()
        first = now()
        try:
            door.take(data)
            result.taken += 1
        except door.refusals:
            result.refused += 1
        except Exception as error:
            _note(result, error, data)
        result.slowest = max(result.slowest, now() - first)
        try:
            door.recover()
        except Exception as error:
            _note(result, error, data)
        result.inputs += 1
        if index == settled:
            gc.collect()
            before = resident()
        if index % 1000 == 999:
            step(1000)
            if len(result.failures) >= KEPT_FAILURES:
                break
    gc.collect()
    result.growth, result.seconds = resident() - before, now() - start
    return result


def resident() -> float:
    """Resident memory of this process, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _note(result: Result, error: Exception, data: bytes) -> None:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(frame.filename).name}:{frame.lineno}"
    result.failures.setdefault(place, (f"{type(error).__name__}: {error}"[:200], data.hex()))


def show(results: Sequence[Result]) -> None:
    """A row a door, then what failed."""
    table = Table("door", "inputs", "taken", "refused", "failures", "grew MiB", "slowest ms", "a second", "")
    for result in results:
        speed = result.inputs / max(result.seconds, 1e-9)
        numbers = (result.inputs, result.taken, result.refused, len(result.failures))
        cells = [*(f"{number}" for number in numbers), f"{result.growth:.1f}", f"{result.slowest * 1e3:.1f}"]
        table.add_row(result.door, *cells, f"{speed:.0f}", "ok" if result.passed else "FAILED")
    console = Console(width=max(Console().width, 110))
    console.print(table)
    for result in results:
        for place, (words, data) in result.failures.items():
            console.print(f"{result.door}: {place}: {words}\n  input {data}", markup=False, soft_wrap=True)


def main(
    inputs: Annotated[int, typer.Option(help="How many, over all doors together.")] = 1_000_000,
    door: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
    seed: Annotated[int, typer.Option(help="Another one brings other inputs.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Throw bytes at the doors and see that each refuses in its own words, recovers, and does not grow."""
    from fuzz_doors import open_doors

    from trotd.bench.report import shown

    with open_doors(door) as doors:
        total = sum(item.share for item in doors.values())
        results = []
        for name, item in doors.items():
            count = max(1, round(inputs * item.share / total))
            bar = iter(shown(range(1 + count // 1000), name, 1 + count // 1000))
            results.append(fuzz(name, item, count, seed, lambda _, bar=bar: next(bar, None) and None))  # type: ignore[misc]
            for _ in bar:
                pass
    if json:
        rows = [{key: getattr(r, key) for key in Result.__slots__} | {"passed": r.passed} for r in results]
        print(json_module.dumps(rows))
    else:
        show(results)
    raise typer.Exit(0 if all(result.passed for result in results) else 1)


if __name__ == "__main__":
    typer.run(main)
