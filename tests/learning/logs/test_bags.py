"""Bags of ROS 2, written by the library of MCAP, of a motion that is known in closed form."""

import io

import numpy as np
import pytest
from helpers import thinned
from recorded_logs import TIME, arrays, assert_holds, log_refused, sines

import torchdq
from torchdq.learning import Layout, read_log

pytest.importorskip("scipy", reason="topics of different rates need scipy")
writer = pytest.importorskip("mcap_ros2.writer", reason="bags need the extra 'ros'")

ROBOT = torchdq.robots.load("two_link")
STATE = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
STAMP = "int32 sec\nuint32 nanosec\n"
LINE = "=" * 80 + "\n"
EPOCH = 1_700_000_000 * 10**9  # [ns]


def bag(topics, stamped=True):
    """Bytes of a bag of joint states: names of joints, positions, velocities and efforts of each topic."""
    file = io.BytesIO()
    out = writer.Writer(file)
    parts = (STATE, "MSG: std_msgs/Header\n" + HEADER, "MSG: builtin_interfaces/Time\n" + STAMP)
    states = out.register_msgdef("sensor_msgs/msg/JointState", LINE.join(parts))
    words = out.register_msgdef("std_msgs/msg/String", "string data\n")
    for topic, (names, times, *signals) in topics.items():
        for k, t in enumerate(times):
            at = EPOCH + round(t * 1e9)
            stamp = {"sec": at // 10**9, "nanosec": at % 10**9} if stamped else {"sec": 0, "nanosec": 0}
            values = [x[k].tolist() if len(x) else [] for x in signals]
            state = dict(zip(("name", "position", "velocity", "effort"), (names, *values), strict=True))
            out.write_message(topic, states, {"header": {"stamp": stamp, "frame_id": ""}, **state}, log_time=at)
    out.write_message("/said", words, {"data": "hello"}, log_time=EPOCH)
    out.finish()
    return file.getvalue()


ARM = (*ROBOT.joint_names[::-1], "gripper")


def states(times=TIME, names=ARM):
    """Joint states of the arm, in another order than the robot's, and of a gripper."""
    x = arrays(2, times)
    return names, times, *(np.column_stack([x[name][:, ::-1], np.ones(len(times))]) for name in ("q", "qd", "tau"))


@pytest.mark.parametrize("stamped", thinned([True, False], [True]))
def test_joint_states_of_a_bag_are_read_in_the_robots_order(tmp_path, stamped):
    content = bag({"/joint_states": states()}, stamped)
    found, q = read_log(content, robot=ROBOT), read_log(content).q
    assert_holds(found)
    assert q.shape == (len(TIME), 3)
    np.testing.assert_array_equal(q[:, :2], found.q[:, ::-1])  # in the order of the messages
    named = Layout(columns={"q": "/joint_states/{joint}/position", "qd": None, "tau": "/joint_states/{joint}/effort"})
    np.testing.assert_array_equal(read_log(content, named, robot=ROBOT).tau, found.tau)
    halves = [bag({"/joint_states": states(TIME[part])}, stamped) for part in (slice(0, 900), slice(900, None))]
    for k, half in enumerate(halves):
        (tmp_path / f"run_{k}.mcap").write_bytes(half)
    assert_holds(read_log(tmp_path, robot=ROBOT))
    with log_refused("column.missing"):
        read_log(content, robot=torchdq.robots.load("panda"))


def test_topics_of_a_bag_are_joined_by_time():
    slow = np.arange(0.1, 3.9, 0.01) + 0.0007
    names, times, *_, tau = states(slow)
    efforts = (names, times, [], [], tau)
    content = bag({"/joint_states": (*states()[:3], [], []), "/efforts": efforts})
    columns = {"q": "/joint_states/{joint}/position", "qd": None, "tau": "/efforts/{joint}/effort"}
    found = read_log(content, Layout(columns=columns), robot=ROBOT)
    np.testing.assert_allclose(found.time, slow, atol=1e-6)
    np.testing.assert_allclose(found.tau, sines(slow, 2)[3], atol=1e-9)
    np.testing.assert_allclose(found.q[20:-20], sines(slow, 2)[0][20:-20], atol=1e-3)
    content = bag({"/joint_states": states(), "/others": states()})
    with log_refused("column.missing"):
        read_log(content, robot=ROBOT)
    assert_holds(read_log(content, Layout(columns={x: f"joint_states:{x}" for x in ("q", "qd", "tau")}), robot=ROBOT))


def test_bags_without_joint_states_or_damaged_are_refused():
    with log_refused("bag.states"):
        read_log(bag({}))
    whole = bag({"/joint_states": states(TIME[:100])})
    with log_refused("log.damaged"):
        read_log(whole[: len(whole) // 2])
    silent = bag({"/joint_states": (ARM, *states(TIME[:100])[1:4], [])})
    assert read_log(silent, Layout(columns={"tau": None})).tau is None
    with log_refused("column.missing"):
        read_log(silent)
