"""A sample of the fuzzing that ``make fuzz`` does at length, and that the harness sees what it is there to see."""

from __future__ import annotations

import mmap

import pytest
from fuzz import LARGEST_GROWTH, Door, Mutator, fuzz
from fuzz_doors import DOORS, open_doors

SAMPLE = {"config": 60, "recording": 150}


@pytest.mark.parametrize("name", sorted(DOORS))
def test_every_door_refuses_in_its_own_words_and_recovers(name: str) -> None:
    with open_doors([name]) as doors:
        result = fuzz(name, doors[name], SAMPLE.get(name, 400), seed=3)
    assert result.failures == {}
    assert result.inputs == result.taken + result.refused


class Toy:
    """A door that takes what begins with ``g``."""

    def __init__(self) -> None:
        self.good = True

    def take(self, data: bytes) -> None:
        if not data.startswith(b"g"):
            raise ValueError("does not begin with g")

    def recover(self) -> None:
        assert self.good

    def door(self, **changes: object) -> Door:
        fields = {"take": self.take, "refusals": (ValueError,), "seeds": [b"good"], "recover": self.recover}
        return Door(**(fields | changes))  # type: ignore[arg-type]


def test_an_error_without_a_name_is_reported_with_its_input() -> None:
    def take(data: bytes) -> None:
        if b"\xff" in data:
            raise KeyError("255")

    result = fuzz("toy", Toy().door(take=take), 2000, seed=0)
    ((words, data),) = result.failures.values()
    assert "KeyError" in words
    assert b"\xff" in bytes.fromhex(data)
    assert not result.passed


def test_a_door_that_does_not_recover_is_reported() -> None:
    toy = Toy()

    def take(data: bytes) -> None:
        toy.good = toy.good and b"\x00" not in data

    assert "AssertionError" in next(iter(fuzz("toy", toy.door(take=take), 2000, seed=0).failures.values()))[0]


def test_a_door_that_grows_is_reported() -> None:
    kept: list[mmap.mmap] = []

    def take(data: bytes) -> None:
        kept.append(mmap.mmap(-1, 1 << 17))  # pages of its own: an allocator may have some left from earlier tests
        kept[-1].write(b"x" * (1 << 17))

    result = fuzz("toy", Toy().door(take=take), 300, seed=0)
    for block in kept:
        block.close()
    assert result.growth > LARGEST_GROWTH
    assert not result.passed


def test_the_same_seed_brings_the_same_inputs() -> None:
    door = Toy().door()
    first, second, other = (Mutator(door, seed) for seed in ("a", "a", "b"))
    inputs = [first.next() for _ in range(50)]
    assert inputs == [second.next() for _ in range(50)]
    assert inputs != [other.next() for _ in range(50)]
    assert len(set(inputs)) > 20
