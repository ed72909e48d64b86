"""Random numbers that belong to one environment each."""

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
def test_numbers_and_their_differences_are_everywhere_equally_often(dtype):
    # differences of a sequence that only counts, however scrambled, take few values
    u = seeded(0, 1000).uniform(1000, dtype)[0].double()
    for x in (u, u[:, 1:] - u[:, :-1], u[:, 2:] - u[:, :-2], u[1:] - u[:-1]):
        counts = torch.histc(x.remainder(1.0), 1000, 0.0, 1.0)
        expected = x.numel() / 1000
        assert 750 < ((counts - expected) ** 2 / expected).sum() < 1250  # 999 expected, 45 its standard deviation


@pytest.mark.parametrize("word", [0, -1, 2**63 - 1, -(2**63)])
@DTYPES
def test_neither_end_is_ever_drawn(dtype, word, monkeypatch):
    monkeypatch.setattr("torchdq.envs.rng._mixed", lambda z: torch.full_like(z, word))
    u, _ = Streams(*torch.zeros(2, 1, dtype=torch.int64)).uniform(4, dtype)  # whose words do not matter
    assert bool(((u > 0) & (u < 1)).all())


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


def test_some_rows_are_seeded_again_and_the_streams_stay_as_they_are():
    streams = seeded(0, 4)
    before = [x.clone() for x in streams]
    changed = streams.uniform(3)[1].with_rows(Indexed(torch.tensor([2])), seeded(9, 1))
    assert torch.equal(changed.uniform(3)[0][2], seeded(9, 1).uniform(3)[0][0])
    assert torch.equal(changed.uniform(3)[0][1], streams.uniform(3)[1].uniform(3)[0][1])
    assert all(map(torch.equal, streams, before))


@pytest.mark.parametrize("seed", [-1, SEEDS, 0.5, "0", [1, 2, 3], [0, None]])
def test_wrong_seeds_are_refused(seed):
    with refused(ArgumentError):
        seeded(seed, 2)
