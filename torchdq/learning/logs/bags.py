"""Tables of ROS 2 bags in MCAP: joint states of every topic, as columns topic/joint/position, velocity and effort."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchdq.base.optional import imported
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.layouts import listed
from torchdq.learning.logs.tables import Rows, Table, arrays_table

MAGIC = b"\x89MCAP"  # first bytes of a bag
STATES = "sensor_msgs/msg/JointState"
FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}

Names = Sequence[str]
State = tuple[int, list[list[float]]]  # stamp of a message [ns], and the numbers in each of its fields


def bag_tables(path: Path, contents: Sequence[bytes], joints: Names, rows: Rows) -> list[Table]:
    """Tables of the joint states in the files of a bag, a table for each topic and set of joints.

    The arrays q, qd and tau of a table are those of the robot's joints, in their order; of all joints if none are
    given. Times are stamps of the messages, or when they were recorded where they have none, from the bag's first on.
    """
    extra = "'torchdq[ros]'"
    mcap = imported("mcap.reader", "mcap", "reading a bag", extra)
    factory = imported("mcap_ros2.decoder", "mcap-ros2-support", "reading a bag", extra).DecoderFactory()
    kinds: dict[str, str] = {}
    states: dict[tuple[str, Names], list[State]] = {}
    try:
        for content in contents:
            reader = mcap.make_reader(io.BytesIO(content))
            summary = reader.get_summary()
            channels = summary.channels.values() if summary else ()
            kinds |= {x.topic: summary.schemas[x.schema_id].name for x in channels if x.schema_id}
            topics = [x.topic for x in channels if kinds.get(x.topic) == STATES]
            for schema, channel, message in reader.iter_messages(topics or None):  # all of a bag without an index
                kinds[channel.topic] = kind = getattr(schema, "name", "")
                if kind == STATES:
                    state = factory.decoder_for(channel.message_encoding, schema)(message.data)
                    stamp = state.header.stamp.sec * 10**9 + state.header.stamp.nanosec or message.log_time
                    known = states.setdefault((channel.topic, tuple(state.name)), [])
                    known.append((stamp, [getattr(state, field) for field in FIELDS.values()]))
    except Exception as fault:  # the library raises errors of many kinds on damaged bytes
        claim = f"damaged or not a bag ({fault})"
        raise LogError(Finding("log.damaged", "", claim, "", "`mcap recover` may mend it"), where=path) from fault
    if not states:
        found = listed([f"{topic} ({kind})" for topic, kind in kinds.items()]) or "no topic"
        raise LogError(Finding("bag.states", "", f"a topic of {STATES} is needed", found), where=path)
    start = min(stamp for known in states.values() for stamp, _ in known)
    return [_table(path, topic, names, known, start, joints, rows) for (topic, names), known in states.items()]


def _table(path: Path, topic: str, names: Names, known: list[State], start: int, joints: Names, rows: Rows) -> Table:
    """Table of the joint states of a topic, whose fields may be empty."""
    arrays = {"time": np.array([(stamp - start) * 1e-9 for stamp, _ in known])}
    columns = {}
    wanted = [name for name in joints or names if name in names]
    for k, (signal, field) in enumerate(FIELDS.items()):
        if all(len(values[k]) == len(names) for _, values in known):
            x = np.array([values[k] for _, values in known])
            arrays |= {f"{topic}/{name}/{field}": x[:, j] for j, name in enumerate(names)}
            if len(wanted) == len(joints or names):
                columns[signal] = [f"{topic}/{name}/{field}" for name in wanted]
    table = arrays_table(path / topic.lstrip("/"), arrays, "time", rows)
    return table._replace(arrays={**table.arrays, **columns})
