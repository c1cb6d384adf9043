"""Byte strings that are no simple messages, or hardly any more: each gives messages or a typed error.

Packets of every kind in every variant are damaged, joined, and cut anywhere; some strings are random from the start.
What a splitter holds is watched, and so is the time of each string.

python -m tools.benchmarks.fuzz_messages --count 1000000 --seed 1
"""

from __future__ import annotations

import argparse
import random
import resource
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from backends.controller.tcp.codec import (
    KINDS,
    LONGEST,
    Acknowledgement,
    Code,
    CodecError,
    Comm,
    FrameSplitter,
    Message,
    Unknown,
    Wire,
    decode,
    encode,
    judge,
)
from dualcal_hal.clock import RealClock

WIRES = tuple(Wire(order, real) for order in ("big", "little") for real in ("f32", "f64"))

_ODD_INTEGERS = (0, 1, -1, 3, 11, 12, 13, 4095, 4096, 4097, 65535, 2**31 - 1, -(2**31))
_ODD_REALS = (
    b"\x7f\xc0\x00\x00",
    b"\x7f\x80\x00\x00",
    b"\xff\x80\x00\x00",
    b"\x7f\xf0" + bytes(6),
    b"\x7f\xf8" + bytes(6),
)


class Fuzzer:
    """``longest_hold``: the most bytes that a splitter has held; ``slowest``: the longest that a string took, s."""

    def __init__(self, seed: int) -> None:
        self.outcomes: Counter[str] = Counter()
        self.longest_hold = 0
        self.slowest = 0.0
        self._chance = random.Random(seed)
        self._clock = RealClock()
        self._packets = {wire: [encode(message, wire) for message in _one_of_each()] for wire in WIRES}

    def run(self, count: int) -> None:
        """So many strings; whatever is no CodecError goes through."""
        for _ in range(count):
            wire = self._chance.choice(WIRES)
            data = self._string(wire)
            begin = self._clock.now()
            self.outcomes[self._read(data, wire)] += 1
            self.slowest = max(self.slowest, self._clock.now() - begin)

    def _string(self, wire: Wire) -> bytes:
        chance = self._chance
        if chance.random() < 0.1:
            return chance.randbytes(chance.choice((1, 8, 16, 64, 300, 2000)))
        data = bytearray(b"".join(chance.choices(self._packets[wire], k=chance.randint(1, 4))))
        for _ in range(chance.randint(0, 3)):
            self._damage(data, wire)
        return bytes(data)

    def _damage(self, data: bytearray, wire: Wire) -> None:
        chance = self._chance
        if not data:
            return
        place, length = chance.randrange(len(data)), chance.choice((1, 4, 12, 40))
        match chance.randrange(7):
            case 0:
                data[place] ^= 1 << chance.randrange(8)
            case 1:
                del data[place : place + length]
            case 2:
                data[place:place] = chance.randbytes(length)
            case 3:
                del data[place:]
            case 4:
                field = place & ~3
                data[field : field + 4] = chance.choice(_ODD_INTEGERS).to_bytes(4, wire.byte_order, signed=True)
            case 5:
                real = chance.choice(_ODD_REALS)
                field = place & ~3
                data[field : field + len(real)] = real if wire.byte_order == "big" else real[::-1]
            case 6:
                data[place : place + length] = data[:length]

    def _read(self, data: bytes, wire: Wire) -> str:
        """What became of it: the error that it ends with, or that it was read."""
        outcome = "read"
        if self._chance.random() < 0.1:
            wire = self._chance.choice(WIRES)  # a server that is not as it was judged
        with suppress(CodecError):
            judge(data)
        try:
            splitter = FrameSplitter(wire.byte_order)
            for chunk in self._cut(data):
                for frame in splitter.feed(chunk):
                    try:
                        decode(frame, wire)
                    except CodecError as error:
                        outcome = type(error).__name__
                self.longest_hold = max(self.longest_hold, splitter.held)
        except CodecError as error:
            outcome = type(error).__name__
        assert self.longest_hold < 4 + LONGEST
        return outcome

    def _cut(self, data: bytes) -> Iterator[bytes]:
        most = self._chance.choice((1, 3, 50, 4096))
        while data:
            size = self._chance.randint(1, most)
            yield data[:size]
            data = data[size:]


def _one_of_each() -> Iterator[Message]:
    for kind in KINDS.values():
        values: dict[str, Any] = {
            name: (1 if layout == "i" else 0.5) if layout in "ir" else (1,) * 10 if layout == "10i" else (0.5,) * 10
            for name, layout in kind.BODY
        }
        yield kind(**values)
        yield Acknowledgement(id=kind.ID)
    yield Acknowledgement(id=11, code=Code.FAILURE)
    yield Unknown(id=2017, comm=Comm.TOPIC, body=bytes(532))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    clock = RealClock()
    begin = clock.now()
    fuzzer = Fuzzer(arguments.seed)
    fuzzer.run(arguments.count)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{arguments.count} strings in {clock.now() - begin:.0f} s: {dict(fuzzer.outcomes)}; "
        f"at most {fuzzer.longest_hold} bytes held, {1000 * fuzzer.slowest:.1f} ms a string, peak {peak:.0f} MiB"
    )


if __name__ == "__main__":
    main()
