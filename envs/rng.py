"""Random numbers, one stream for each environment, so that a row does not depend on the number of rows.

A stream is a key and a counter; word k of it is a hash of the key and k (the finaliser of SplitMix64: G. L. Steele,
D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014). Only the counter changes
between draws, so streams are saved, restored and drawn from in any subset of rows. An environment has a stream for each
purpose, so that the numbers of a start do not depend on the steps before it, and can be drawn ahead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import device_of
from torchdq.envs.row_selection import SomeRows
from torchdq.errors import ArgumentError

_STEP = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio
_ONE = {torch.float32: 0x3F800000, torch.float64: 0x3FF0000000000000}  # the bits of 1
_FIRST, _SECOND = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
SEEDS = 2**63  # seeds are below it
SMALLEST = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}  # number that can be drawn; the largest is 1 less that


class Streams(NamedTuple):
    """Streams of random numbers, one per row."""

    key: Tensor  # [N] int64
    counter: Tensor  # [N] int64

    @classmethod
    def of(cls, buffers: Mapping[str, Tensor]) -> Streams:
        """Streams that are among the buffers of environments."""
        return cls(buffers["key"], buffers["counter"])

    def split(self, number: int) -> Streams:
        """A number of other streams for each of these, in columns [N, number], from their beginnings."""
        key = _mixed(self.key[:, None] + _signed(_SECOND) * torch.arange(1, number + 1, device=self.key.device))
        return Streams(key, torch.zeros_like(key))

    def column(self, k: int) -> Streams:
        """One of several streams of every row."""
        return Streams(self.key[:, k], self.counter[:, k])

    def with_column(self, k: int, streams: Streams) -> Streams:
        """The streams, one of every row replaced."""
        columns = list(self.counter.unbind(1))
        columns[k] = streams.counter
        return self._replace(counter=torch.stack(columns, 1))

    def uniform(self, width: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Streams]:
        """Numbers in (0, 1), ends excluded, shape [N, width], and the streams after them."""
        double = dtype == torch.float64
        words = width if double else (width + 1) // 2  # a word makes a double or two floats
        steps = torch.arange(words, device=self.key.device).mul_(_signed(_STEP))
        bits = _mixed((self.counter * _signed(_STEP) + self.key)[:, None] + steps)
        if not double:
            bits = bits.view(torch.int32)[:, :width]
        size, kept = (64, 52) if double else (32, 23)
        # bits k are the fraction of 1 + k/2^kept; taking the 1 off adds half a step, so that neither end occurs
        fraction = (bits >> (size - kept)).bitwise_and_((1 << kept) - 1)
        numbers = fraction.bitwise_or_(_ONE[dtype]).view(dtype).sub_(1 - 2.0 ** -(kept + 1))
        return numbers, self._replace(counter=self.counter + words)

    def series(self, steps: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Numbers [steps, N, width] of a number of draws, and the counters after them."""
        words = self.uniform(width, dtype)[1].counter - self.counter
        counter = self.counter + words * torch.arange(steps + 1, device=words.device)[:, None]
        long = Streams(self.key.repeat(steps), counter[:-1].flatten())
        return long.uniform(width, dtype)[0].view(steps, -1, width), counter[-1]

    def rows(self, rows: SomeRows) -> Streams:
        """Streams of some rows."""
        return Streams(rows.of(self.key), rows.of(self.counter))

    def with_rows(self, rows: SomeRows, streams: Streams) -> Streams:
        """The streams with some rows replaced."""
        return Streams(*(rows.replaced(own, new) for own, new in zip(self, streams, strict=True)))


def ranged(u: Tensor, ranges: Sequence[tuple[float, float]]) -> Tensor:
    """Random numbers [k, n] in (0, 1) as numbers in ranges, one for each column."""
    return torch.stack([a + (b - a) * x for (a, b), x in zip(ranges, u.unbind(1), strict=True)], 1)


def seeds_of(seed: Any, rows: int) -> list[int | None]:
    """Seed of every row, from one number s, which is s + i in row i, or from one or None for each row."""
    each = isinstance(seed, Sequence) and not isinstance(seed, str | bytes)
    if each and len(seed) != rows:
        raise ArgumentError(f"seed must be one number or {rows}, one for each row, found {len(seed)}")
    most = SEEDS - (1 if each else rows)
    for x in seed if each else (seed,):
        whole = isinstance(x, Integral) and not isinstance(x, bool)
        if not (whole and 0 <= int(x) <= most) and not (each and x is None):
            why = "" if each or rows == 1 else f", since row i of {rows} has the seed + i"
            raise ArgumentError(f"seed must be an integer between 0 and {most}{why}, found {x!r}")
    return list(seed) if each else [int(seed) + i for i in range(rows)]


def seeded(seed: int | Sequence[int], size: int, device: torch.device | str = "cpu") -> Streams:
    """New streams.

    Row i of those seeded with a number s is the first row of those seeded with s + i.

    Args:
        seed: from 0, or one for every row.
        size: number of rows.
        device: device of the streams.
    """
    seeds = seeds_of(seed, size)
    if None in seeds:
        raise ArgumentError(f"seed must be given for every row, found {seed!r}")
    key = torch.tensor(seeds, dtype=torch.int64, device=device_of("device", device))
    # twice, so that keys of neighbouring seeds are not neighbours in any stream
    key = _mixed(_mixed(key.mul_(_signed(_STEP)).add_(_signed(_FIRST))).add_(_signed(_STEP)))
    return Streams(key, torch.zeros_like(key))


def _mixed(z: Tensor) -> Tensor:
    """The hash of 64-bit words, computed in their place."""
    shifted = torch.empty_like(z)
    for by, factor in ((30, _FIRST), (27, _SECOND), (31, 1)):
        # the mask removes the copies of the sign that are shifted in from the left
        torch.bitwise_right_shift(z, by, out=shifted).bitwise_and_((1 << (64 - by)) - 1)
        z.bitwise_xor_(shifted)
        if factor != 1:
            z.mul_(_signed(factor))
    return z


def _signed(word: int) -> int:
    """A 64-bit word as a signed integer of torch."""
    return word - (1 << 64) if word >= 1 << 63 else word
