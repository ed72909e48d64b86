"""Random numbers that belong to one environment each."""

from itertools import pairwise

import pytest
import torch
from messages import refused

from torchdq.envs.rng import SEEDS, Streams, seeded
from torchdq.envs.row_selection import Indexed
from torchdq.errors import ArgumentError

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def correlation(a, b):
    """Correlation of two equal shapes of numbers."""
    return torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1].item()


def test_words_are_those_of_the_reference_implementation():
    # SplitMix64 of S. Vigna seeded with 0, whose first word hashes one step
    words = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F, 0xF88BB8A8724C81EC]
    streams = Streams(torch.tensor([0x9E3779B97F4A7C15 - (1 << 64)]), torch.tensor([0]))
    doubles = torch.tensor([[((w >> 12) + 0.5) / 2**52 for w in words]], dtype=torch.float64)
    assert torch.equal(streams.uniform(4, torch.float64)[0], doubles)
    halves = [half for w in words for half in (w & 0xFFFFFFFF, w >> 32)]
    assert torch.equal(streams.uniform(7)[0], torch.tensor([[((h >> 9) + 0.5) / 2**23 for h in halves[:7]]]))


@DTYPES
def test_moments_are_those_of_uniform_numbers(dtype):
    u = seeded(0, 1000).uniform(1000, dtype)[0].double()
    # one standard error of a million: 0.00029, 0.00022 / 12, 0.001; five are allowed
    assert abs(u.mean() - 1 / 2) < 5 * 0.00029
    assert abs(u.var() * 12 - 1) < 5 * 0.0009
    for rows, columns in ((1, 0), (0, 1), (1, 1), (0, 2), (2, 0)):
        assert abs(correlation(u[rows:, columns:], u[: 1000 - rows, : 1000 - columns])) < 5 * 0.001


@DTYPES
def test_all_bits_are_used_equally(dtype):
    u = seeded(5, 200).uniform(5000, dtype)[0].double()
    for bit in range(1, 20):
        assert abs((u * 2**bit).floor().remainder(2).mean() - 0.5) < 5 * 0.0005


@DTYPES
def test_successive_draws_do_not_resemble_each_other(dtype):
    streams, draws = seeded(0, 100_000), []
    for _ in range(10):
        u, streams = streams.uniform(1, dtype)
        draws.append(u)
    for earlier, later in pairwise(draws):
        assert abs(correlation(earlier.double(), later.double())) < 5 * 0.0032


def test_every_interval_is_hit_equally_often():
    u, _ = seeded(1, 1000).uniform(1000)
    counts = torch.histc(u, 100, 0.0, 1.0)
    chi_squared = ((counts - 1e4) ** 2 / 1e4).sum().item()
    assert 50 < chi_squared < 170  # 99 expected, 14 its standard deviation


@DTYPES
def test_differences_are_as_random_as_the_numbers(dtype):
    # those of a sequence that only counts, however scrambled, take few values
    u = seeded(0, 1000).uniform(1000, dtype)[0].double()
    for difference in (u[:, 1:] - u[:, :-1], u[:, 2:] - u[:, :-2], u[1:] - u[:-1]):
        counts = torch.histc(difference.remainder(1.0), 1000, 0.0, 1.0)
        expected = difference.numel() / 1000
        assert 750 < ((counts - expected) ** 2 / expected).sum() < 1250  # 999 expected, 45 its standard deviation


@pytest.mark.parametrize("word", [0, -1, 2**63 - 1, -(2**63)])
@DTYPES
def test_neither_end_is_ever_drawn(dtype, word, monkeypatch):
    monkeypatch.setattr("torchdq.envs.rng._mixed", lambda z: torch.full_like(z, word))
    u, _ = seeded_without_mixing().uniform(4, dtype)
    assert bool(((u > 0) & (u < 1)).all())


def seeded_without_mixing():
    """Streams whose words do not matter."""
    return Streams(torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64))


@pytest.mark.parametrize("width", [1, 2, 7, 14])
@DTYPES
def test_a_row_does_not_depend_on_the_others(dtype, width):
    many, streams = seeded(10, 50).uniform(width, dtype)
    some = torch.tensor([3, 41, 7])
    assert torch.equal(seeded(10, 50).rows(Indexed(some)).uniform(width, dtype)[0], many[some])
    assert torch.equal(seeded(10 + 41, 1).uniform(width, dtype)[0][0], many[41])
    assert torch.equal(seeded([51, 13], 2).uniform(width, dtype)[0], many[[41, 3]])
    assert many.shape == (50, width) and many.dtype == dtype
    assert not torch.equal(streams.uniform(width, dtype)[0], many)


def test_streams_go_on_where_they_were():
    first, streams = seeded(0, 4).uniform(6)
    second, _ = streams.uniform(6)
    assert torch.equal(torch.cat([first, second], 1), seeded(0, 4).uniform(12)[0])


def test_drawing_changes_nothing():
    streams = seeded(0, 4)
    before = [x.clone() for x in streams]
    streams.uniform(9)
    streams.with_rows(Indexed(torch.tensor([1])), seeded(7, 1))
    assert all(torch.equal(a, b) for a, b in zip(streams, before, strict=True))


def test_some_rows_are_seeded_again():
    streams = seeded(0, 4).uniform(3)[1].with_rows(Indexed(torch.tensor([2])), seeded(9, 1))
    assert torch.equal(streams.uniform(3)[0][2], seeded(9, 1).uniform(3)[0][0])
    assert torch.equal(streams.uniform(3)[0][1], seeded(0, 4).uniform(3)[1].uniform(3)[0][1])


@pytest.mark.parametrize("seed", [-1, SEEDS, 0.5, "0", [1, 2, 3], [0, None]])
def test_wrong_seeds_are_refused(seed):
    with refused(ArgumentError):
        seeded(seed, 2)
