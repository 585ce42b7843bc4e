"""Files of Rerun and MCAP, opened by the libraries of those formats."""

import numpy as np
import pytest


def topics_of(path):
    """Times [s] and values by joint and channel of an MCAP file, by the ROS 2 library's reader."""
    reader = pytest.importorskip("mcap_ros2.reader")
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    texts = []
    names = {"/joint_commands": "command_rad", "/joint_states": "position_rad"}
    for message in reader.read_ros2_messages(str(path)):
        content, topic = message.ros_msg, message.channel.topic
        time_s = message.log_time_ns * 1e-9
        if topic in names:
            stamp = content.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == message.log_time_ns
            for joint, value in zip(content.name, content.position, strict=True):
                found.setdefault((joint, names[topic]), []).append((time_s, value))
        elif topic == "/rosout":
            texts.append(content.msg)
        else:
            joint, name = topic.strip("/").split("/")
            found.setdefault((joint, name), []).append((time_s, content.data))
    return {k: np.array(v).T for k, v in found.items()}, texts


def entities_of(path):
    """Columns by entity and component of a Rerun file, by Rerun's own reader."""
    chunk = pytest.importorskip("rerun.chunk")
    found: dict[str, list[tuple[np.ndarray, list]]] = {}
    for part in chunk.RrdReader(path).stream().to_chunks():
        batch = part.to_record_batch()
        names = batch.schema.names
        if "time" not in names:
            continue
        times = batch.column("time").cast("int64").to_numpy() * 1e-9
        for name in names:
            if ":" in name:
                key = f"{part.entity_path}|{name.split(':')[-1]}"
                found.setdefault(key, []).append((times, batch.column(name).to_pylist()))
    return {
        key: (np.concatenate([t for t, _ in parts]), [v for _, vs in parts for v in vs])
        for key, parts in found.items()
    }
