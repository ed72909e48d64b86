"""Rows that leap away are told from motions, steps and noise, in logs and on recordings of real arms."""

import warnings

import numpy as np
import pytest
from learning.identification.test_model_selection import DATA

from torchdq.learning import LogWarning, read
from torchdq.learning.logs.outliers import spikes, spikes_told


def motion(rows=2000, seed=0):
    t = np.linspace(0, 20, rows)[:, None]
    rng = np.random.default_rng(seed)
    return 30 * np.sin(t + np.arange(2)) + 5 * np.sign(np.cos(t)) + 0.3 * rng.normal(size=(rows, 2))


def test_a_few_rows_far_away_are_found_and_no_others():
    x = motion()
    assert not spikes(x).any()
    for rows in ([700], [700, 701], [5, 900, 1990]):
        wrong = x.copy()
        wrong[rows, 1] = 1e4
        found = spikes(wrong)
        assert np.flatnonzero(found[:, 1]).tolist() == rows and not found[:, 0].any()
    shuffled = np.random.default_rng(1).permutation(x)
    assert not spikes(shuffled).any()


def test_steps_short_motions_and_rest_are_no_spikes():
    x = np.zeros((3000, 1))
    x[1000:1100, 0] = 40 * np.sin(np.linspace(0, np.pi, 100))  # a short motion in a long rest
    x[2000:] = 8.0  # a step
    x[2500:2512] = 500.0  # a collision, longer than a fault of the bus
    assert not spikes(x + 1e-3 * np.random.default_rng(0).normal(size=x.shape)).any()
    quantised = np.where(np.random.default_rng(0).uniform(size=(3000, 2)) < 0.01, 1e-4, 0.0)
    quantised[:, 1] = motion(3000)[:, 1]
    assert not spikes(quantised).any()
    assert not spikes(motion(10)).any()


def test_words_name_the_column_the_rows_and_the_usual_size():
    x = motion()
    x[[20, 30, 40, 50, 60, 70], 0] = 500.0
    (words,) = spikes_told(("a", "b"), x, first=2)
    assert words.startswith("a is 500 in row 22, 500 in row 32") and "and 1 more rows, elsewhere up to" in words
    assert "b is" not in words and "delete these rows" in words


def test_a_log_with_spikes_is_read_with_a_warning():
    tau = motion()
    time = 0.01 * np.arange(len(tau))
    q = np.sin(time)[:, None] + np.arange(2)
    arrays = {"time": time, "q": q, "qd": None, "tau": tau}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(arrays)
    tau[[100, 1500], 1] = -1e4
    with pytest.warns(LogWarning, match="column 'tau2' is -1e.04 in row 100, -1e.04 in row 1500"):
        assert (read(arrays).tau[100] == tau[100]).all()


@pytest.mark.parametrize("name", ["panda_gaz2019", "ur10e_innopolis", "double_pendulum_dfki_A0"])
def test_recordings_have_none(name):
    if not (DATA / name).is_dir():
        pytest.skip("the recordings are not here")
    recordings = pytest.importorskip("recordings")
    files = [path for path in sorted((DATA / name).glob("*.csv*")) if "15harm" not in path.name]
    with warnings.catch_warnings():
        warnings.simplefilter("error", LogWarning)
        for path in files[:4]:
            read(path, recordings.layout_of(path))
