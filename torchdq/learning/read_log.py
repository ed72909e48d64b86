"""Logs of robot arms in files and arrays, checked, also against the robot that they are of."""

import warnings

import torch

from torchdq.findings import Finding
from torchdq.learning.evaluation.diagnostics import beyond_limits
from torchdq.learning.logs.errors import LogError, LogWarning
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.read import Log, Source, read
from torchdq.robot import Robot

STANDARD = Layout()


def read_log(
    path: Source,
    layout: Layout = STANDARD,
    rows: tuple[int, int] | None = None,
    rate: float | None = None,
    robot: Robot | None = None,
) -> Log:
    """Log in files, or made of arrays.

    Columns are found by name: time [s], q1 ... qn [rad], qd1 ... [rad/s], tau1 ... measured at the joints [N m] and, if
    they are known, qdd1 ... [rad/s^2]; of joints that slide, in m, m/s, N and m/s^2. Others stay unread.

    Args:
        path: path of the file, a file:// or package:// address, an open file, or its bytes: a text of numbers, packed
            with gzip or not, an NPZ or NPY file, a file of MATLAB, or a ROS 2 bag in MCAP. Or arrays by name; None
            instead of one says that it was not recorded. Or a list of files, which are joined by time.
        layout: names and units of the columns; by default time, q1 ..., qd1 ..., tau1 ... in SI units: s, rad, rad/s
            and N m, and of joints that slide (prismatic ones) m, m/s and N.
        rows: first row and the one after the last to use, counted from 0; None: all.
        rate: rows per second, on even time stamps, without what is too fast for them [Hz], e.g. for a log of a drive
            at 8 kHz; needs scipy. None: the rows as they are.
        robot: the robot that was recorded, whose number of joints and limits the log is checked against, and in whose
            order joints of bags are read; None: unknown.
    Raises:
        LogError: the file cannot be opened, a column is missing, a number is missing or not finite, time runs
            backwards, there is a gap, or a column is in degrees; or the robot has another number of joints.
        MissingLogError: there is no such file; it is a FileNotFoundError too.
        MissingLibraryError: scipy is not installed, and a rate or files of different times are given; or the extra
            "ros", for a bag.
    Warns:
        LogWarning: a position jumps farther than its velocities explain, an effort leaps in a few rows, or motions are
            far beyond the robot's limits; the same are in `Log.findings`.

    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read_log(path).tau
    array([[2. ],
           [2.1]])
    >>> read_log({"time": [0.0, 0.01], "q": [[0.1], [0.105]], "qd": None, "tau": [[2.0], [2.1]]}).tau.shape
    (2, 1)
    """
    log = read(path, layout, rows, rate, () if robot is None else robot.joint_names)
    if robot is not None:
        if log.q.shape[1] != robot.n:
            n, claim = log.q.shape[1], f"{robot.n} joints are needed, those of {robot.name!r}"
            cure = "lock joints of the robot, or choose columns by Layout"
            option = "--joints keeps some joints of the robot"
            raise LogError(Finding("log.joints", "", claim, str(n), cure, option, value=n), where=log.path)
        qd = None if log.qd is None else torch.from_numpy(log.qd)
        log = log._replace(findings=(*log.findings, *beyond_limits(robot, torch.from_numpy(log.q), qd)))
    if log.findings:
        warnings.warn(LogWarning(*log.findings, where=log.path), stacklevel=2)
    return log
