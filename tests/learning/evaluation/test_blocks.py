"""Blocks that are left out: whole motions, or parts with gaps, and regions of the states; correlation of residuals."""

import numpy as np
import torch
from recorded_logs import REAL, ROBOT, STEP, WIDTH, noise, states, torques

from torchdq.learning import Motion
from torchdq.learning.evaluation.blocks import blocks, of_motions, of_tensors, regions, too_few
from torchdq.learning.evaluation.statistics import correlation_times
from torchdq.learning.identification.evidence import gather
from torchdq.learning.identification.terms import COULOMB, VISCOUS


def rows_of(part):
    return set(range(part.start, part.stop))


def test_blocks_are_whole_motions_or_parts_with_gaps():
    q, qd, qdd = states(4, 100)
    whole = blocks(of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=q))
    assert [rows_of(block.rows) for block in whole] == [set(range(100 * k, 100 * k + 100)) for k in range(4)]
    assert not any(block.margins for block in whole)
    time = np.arange(700) * STEP
    x = np.random.default_rng(0).normal(size=(700, 2))
    one = Motion(time, x, x, x, x, x)
    recording = of_motions(ROBOT, one)
    parts = blocks(recording)
    assert len(parts) == 6 and set().union(*(rows_of(block.rows) for block in parts)) == set(range(700))
    for block in parts:
        margins = set().union(*map(rows_of, block.margins))
        assert not margins & rows_of(block.rows)
        near = {k for k in range(700) for end in (block.rows.start, block.rows.stop - 1) if abs(k - end) * STEP < 0.49}
        assert near - rows_of(block.rows) <= margins and len(margins) <= 2 * 26
    for first, second in regions(recording):
        assert {*first.tolist(), *second.tolist()} == set(range(700)) and len(first) + len(second) == 700
    slow, fast = regions(recording)[0]
    speed = np.linalg.norm(x / x.std(0), axis=1)
    assert speed[slow].max() <= speed[fast].min()
    assert len(regions(of_tensors(ROBOT, q=q, qd=qd, qdd=qdd))) == 2
    assert blocks(of_tensors(ROBOT, q=q[0, :50], qd=q[0, :50], qdd=q[0, :50])) == []
    many = blocks(of_tensors(ROBOT, q=q.reshape(20, 20, 2), qd=q.reshape(20, 20, 2), qdd=q.reshape(20, 20, 2)))
    assert len(many) == 10


def test_a_fold_holds_nothing_of_its_block():
    """Torques that are wrong in a block and beside it do not change the fit that is measured on it."""
    q, qd, qdd = (x[0] for x in states(1, 600))
    tau = torques(REAL, q[None], qd[None], qdd[None])[0]
    recording = of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=tau)
    spoilt = tau.clone()
    third = blocks(recording)[2]
    for part in (third.rows, *third.margins):
        spoilt[part] += 100.0
    folds = [
        gather(ROBOT, one, (VISCOUS, COULOMB), WIDTH, blocks(one)).folds
        for one in (recording, of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=spoilt))
    ]
    assert torch.allclose(folds[0][2], folds[1][2], rtol=1e-9, atol=1e-6 * float(folds[0][2].abs().max()))
    assert not torch.allclose(folds[0][0], folds[1][0], rtol=1e-2)


def test_a_fit_without_a_block_keeps_enough_rows():
    """Next to a block, half a second is left out, which may be all that there is."""
    x = np.random.default_rng(0).normal(size=(1000, 2))

    def recording(rows, rate, motions=1):
        return of_motions(ROBOT, [Motion(np.arange(rows) / rate, *[x[:rows]] * 4)] * motions)

    few = too_few(recording(500, 500))
    assert blocks(recording(500, 500)) == [] and few.value == 858 and few.expected.startswith("858 rows (1.7 s)")
    assert len(blocks(recording(858, 500))) == 6 and blocks(recording(840, 500)) == []
    few = too_few(recording(50, 100, 2))
    assert few.found == "50 rows (0.5 s)" and few.value == 60 and "each motion" in few.expected
    assert len(blocks(recording(60, 100, 2))) == 6 and blocks(recording(50, 100, 2)) == []


def test_correlation_times_are_those_of_the_process():
    for memory in (0.0, 0.5, 0.9):
        x = noise((3, 20000, 2), memory)
        found = correlation_times(x.reshape(-1, 2), (20000,) * 3)
        assert torch.allclose(found, torch.full_like(found, (1 + memory) / (1 - memory)), rtol=0.1)
    assert torch.equal(correlation_times(torch.zeros(10, 2).double(), (10,)), torch.ones(2).double())
