"""ROS 1 and ROS 2 bags, read with rosbags: events, frames, inertial measurements, calibration, poses. No ROS needed."""

from __future__ import annotations

import re
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dvsviz.errors import FormatError
from dvsviz.events.recording import Imu
from dvsviz.formats.ros_codecs import Columns, PacketDecoder, microseconds_of, parse_event_array
from dvsviz.formats.sink import RecordingSink
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

FORMAT_NAME = "ROS bag"
ROS1_MAGIC = b"#ROSBAG V2.0"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
_STORAGES = {".db3": "sqlite3", ".mcap": "mcap"}
_ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
_PACKETS = ("event_camera_msgs/msg/EventPacket",)
_POSES = {
    "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda m: (m.transform.translation, m.transform.rotation),
    "nav_msgs/msg/Odometry": lambda m: (m.pose.pose.position, m.pose.pose.orientation),
}
_IMU, _IMAGE, _INFO = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_CHANNELS = {"mono8": None, "8UC1": None, "bgr8": (0.114, 0.587, 0.299), "rgb8": (0.299, 0.587, 0.114)}
# Fields of the messages that bags of older ROS 2 versions do not carry.
_DEFINITIONS = {
    "event_camera_msgs/msg/EventPacket": "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\n"
    "uint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n",
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n",
    "dvs_msgs/msg/EventArray": "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
}


def convert_ros(path: Path, sink: RecordingSink) -> None:
    """Read a bag (a `.bag`, `.db3` or `.mcap` file, or a ROS 2 folder) into a recording.

    Raises:
        FormatError: the bag is damaged, has no event topic, or several and none was chosen.
    """
    # Slow to import and needed for bags alone.
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    damage = (Ros1Error, Ros2Error, SerdeError, TypesysError, sqlite3.Error, struct.error)
    try:
        with ExitStack() as stack:
            _read(_Bag(stack, path), path, sink)
    except (*damage, KeyError, IndexError, ValueError, AssertionError, EOFError, MemoryError) as error:
        # Where the library was given a link, the name of the link says nothing.
        reason = re.sub(r"\S+/(bag|metadata)\.\w+", path.name, " ".join(str(error).split()))[:160]
        reason = reason or type(error).__name__
        raise FormatError(
            f"damaged, or not a bag that can be read ({reason})", path=path, hint="copy it again"
        ) from error


@lru_cache(maxsize=2)
def _types(*, is_ros1: bool) -> Any:
    """Return the known message types of a ROS version; making them costs 0.3 s, so it is done once."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    known: dict[str, Any] = {}
    for name, text in _DEFINITIONS.items():
        known.update(get_types_from_msg(text, name))
    store.register(known)
    return store


class _Bag:
    """An open bag of either version; messages are read by the definitions known here, not by those inside the bag."""

    def __init__(self, stack: ExitStack, path: Path) -> None:
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader

        with path.open("rb") if path.is_file() else nullcontext() as file:
            self.is2 = file is None or not file.read(len(ROS1_MAGIC)).startswith(ROS1_MAGIC)
        if self.is2:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            path = _repaired(path, scratch)
        self._store = _types(is_ros1=not self.is2)
        self._reader: Any = stack.enter_context((Ros2Reader if self.is2 else Ros1Reader)(path))
        self.connections: list[Any] = list(self._reader.connections)
        self.start_ns, self.end_ns = int(self._reader.start_time), int(self._reader.end_time)

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield (connection, time of recording in nanoseconds, bytes) of the messages, in order."""
        return self._reader.messages(connections=connections)

    def deserialize(self, raw: bytes, msgtype: str) -> Any:
        """Return a message."""
        store = self._store
        return store.deserialize_cdr(raw, msgtype) if self.is2 else store.deserialize_ros1(raw, msgtype)


def _repaired(path: Path, scratch: Path) -> Path:
    """Return the bag, or a folder of links to it whose metadata names the storage that its files have."""
    if path.is_file() and path.suffix.lower() not in _STORAGES:
        # The library goes by the file's ending.
        with path.open("rb") as file:
            is_mcap = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
        link = scratch / ("bag.mcap" if is_mcap else "bag.db3")
        link.symlink_to(path.resolve())
        return link
    files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.suffix in _STORAGES)
    metadata = path / "metadata.yaml"
    if not files:
        raise FormatError("no .db3 or .mcap file in this folder", path=path, hint="copy the whole bag")
    content: Any = None
    if path.is_dir() and metadata.is_file() and metadata.stat().st_size < 1 << 24:
        try:
            content = yaml.safe_load(metadata.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise FormatError("not valid YAML", path=metadata, hint="copy it again") from error
    if not isinstance(content, dict) or not isinstance(content.get("rosbag2_bagfile_information"), dict):
        return path if path.is_file() else files[0]
    information = content["rosbag2_bagfile_information"]
    if information.get("storage_identifier"):
        return path
    information["storage_identifier"] = _STORAGES[files[0].suffix]
    (scratch / "metadata.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    for file in files:
        (scratch / file.name).symlink_to(file.resolve())
    return scratch


def _event_connection(bag: _Bag, path: Path, topic: str | None) -> Any:
    found = {c.topic: c for c in bag.connections if c.msgtype in (*_ARRAYS, *_PACKETS)}
    if topic is not None:
        if topic not in found:
            hint = f"event topics are: {', '.join(sorted(found)) or 'none'}"
            raise FormatError(f"no event topic {topic}", path=path, hint=hint)
        return found[topic]
    if not found:
        others = ", ".join(sorted({c.msgtype for c in bag.connections})) or "nothing"
        hint = "expected dvs_msgs/EventArray or event_camera_msgs/EventPacket"
        raise FormatError(f"there is no event topic among {others}"[:300], path=path, hint=hint)
    filled = {name: c for name, c in found.items() if c.msgcount > 0}
    if len(filled) > 1:
        hint = f"choose one with --topic: {', '.join(sorted(filled))}"
        raise FormatError(f"{len(filled)} event topics", path=path, hint=hint)
    if not filled:
        raise FormatError(f"topic {next(iter(found))} has no messages", path=path, hint="record it again")
    return next(iter(filled.values()))


def _first(bag: _Bag, msgtype: str | tuple[str, ...], near: str) -> Any:
    """Return the connection of a type whose topic shares most of its beginning with the event topic."""
    types = (msgtype,) if isinstance(msgtype, str) else msgtype

    def likeness(connection: Any) -> int:
        same = [a == b for a, b in zip(connection.topic, near, strict=False)]
        return same.index(False) if False in same else len(same)

    found = [c for c in bag.connections if c.msgtype in types and c.msgcount > 0]
    return max(found, key=likeness, default=None)


def _pose_connection(bag: _Bag, path: Path, events_topic: str, topic: str | None) -> Any:
    """Return the topic of true poses that was said, else the one that belongs to the events, or None."""
    if topic is None:
        return _first(bag, tuple(_POSES), events_topic)
    found = {c.topic: c for c in bag.connections if c.msgtype in _POSES}
    if topic not in found:
        hint = f"topics of poses are: {', '.join(sorted(found)) or 'none'}"
        raise FormatError(f"no topic {topic} of poses", path=path, hint=hint)
    return found[topic]


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


class _Events:
    """Turns the messages of the event topic into columns."""

    def __init__(self, bag: _Bag, connection: Any) -> None:
        self._bag, self._connection = bag, connection
        self._decoder: PacketDecoder | None = None

    def __call__(self, raw: bytes) -> tuple[tuple[int, int], Columns]:
        if self._connection.msgtype in _ARRAYS:
            return parse_event_array(raw, is_ros1=not self._bag.is2)
        message = self._bag.deserialize(raw, self._connection.msgtype)
        if self._decoder is None:
            self._decoder = PacketDecoder(str(message.encoding))
        data = np.asarray(message.events, np.uint8)
        columns = self._decoder(data, int(message.time_base), _stamp_ns(message))
        return (int(message.width), int(message.height)), columns


def _camera(bag: _Bag, size: tuple[int, int], topic: str, sink: RecordingSink) -> Camera:
    connection = _first(bag, _INFO, topic)
    if connection is None:
        return Camera.guess(*size)
    _, _, raw = next(iter(bag.messages(connections=[connection])))
    info = bag.deserialize(raw, connection.msgtype)
    k = np.asarray(info.K if hasattr(info, "K") else info.k, np.float64)
    d = np.asarray(info.D if hasattr(info, "D") else info.d, np.float64)
    model = info.distortion_model
    if len(k) != 9 or k[0] <= 0 or k[4] <= 0 or not np.all(np.isfinite(k)):
        return Camera.guess(*size)
    if model not in ("plumb_bob", "") or len(d) > 5 or not np.all(np.isfinite(d)):
        sink.warn(f"calibration of {connection.topic} left out: distortion model {model!r} is not supported")
        return Camera.guess(*size)
    k1, k2, p1, p2, k3 = [*d.tolist(), *[0.0] * (5 - len(d))]
    fx, fy, cx, cy = (float(k[i]) for i in (0, 4, 2, 5))
    return Camera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2, k3))


def _read(bag: _Bag, path: Path, sink: RecordingSink) -> None:
    events = _event_connection(bag, path, sink.options.topic)
    frames, imu = _first(bag, _IMAGE, events.topic), _first(bag, _IMU, events.topic)
    poses = _pose_connection(bag, path, events.topic, sink.options.truth_topic)
    decode, started = _Events(bag, events), False
    wanted = [c for c in (events, frames, imu, poses) if c is not None]
    start, span = bag.start_ns, max(1, bag.end_ns - bag.start_ns)
    samples: list[tuple[int, list[float]]] = []
    track: list[tuple[int, list[float]]] = []
    pending: list[tuple[int, np.ndarray]] = []
    shape = None
    for connection, time_ns, raw in bag.messages(connections=wanted):
        if connection.id == events.id and connection.topic == events.topic:
            size, columns = decode(raw)
            if not started:
                if min(size) < 1 or max(size) > 65_535:
                    raise FormatError(f"a sensor of {size[0]}x{size[1]}", path=path, place=events.topic)
                sink.start(_camera(bag, size, events.topic, sink))
                started = True
            sink.add(*columns)
            sink.options.report((time_ns - start) / span)
            continue
        message = bag.deserialize(raw, connection.msgtype)
        t_us = microseconds_of(_stamp_ns(message))
        if connection is imu:
            w, a = message.angular_velocity, message.linear_acceleration
            samples.append((t_us, [w.x, w.y, w.z, a.x, a.y, a.z]))
        elif connection is poses:
            p, q = _POSES[connection.msgtype](message)
            track.append((t_us, [p.x, p.y, p.z, q.w, q.x, q.y, q.z]))
        elif (image := _grey(message)) is not None and shape in (None, image.shape):
            shape = image.shape
            pending.append((t_us, image))
        if started:
            for frame_us, image in pending:
                sink.add_frame(frame_us, image)
            pending.clear()
    if not started:
        raise FormatError(f"topic {events.topic} has no messages", path=path, hint="record it again")
    _finish(samples, track, sink)


def _finish(
    samples: list[tuple[int, list[float]]], track: list[tuple[int, list[float]]], sink: RecordingSink
) -> None:
    if samples:
        samples.sort(key=lambda sample: sample[0])
        values = np.array([v for _, v in samples], np.float64)
        t_us = np.array([t for t, _ in samples], np.int64)
        sink.set_imu(Imu(t_us=t_us, gyro=values[:, :3], accel=values[:, 3:]))
    if track:
        unique = dict(sorted(track, key=lambda pose: pose[0]))
        values = np.array(list(unique.values()), np.float64)
        good = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[:, 3:], axis=1) > 0.5)
        if not good.all():
            sink.warn(f"{int((~good).sum())} poses that are not finite left out")
        if good.any():
            t_us = np.array(list(unique), np.int64)[good]
            T = se3.pose(se3.rotation_from_quaternion(values[good, 3:]), values[good, :3])
            sink.set_ground_truth(Trajectory(t_us=t_us, Ts_world_camera=T))


def _grey(message: Any) -> np.ndarray | None:
    """Return the grey values (height, width) uint8 of an image message, or None where they are of another kind."""
    if message.encoding not in _CHANNELS:
        return None
    weights = _CHANNELS[message.encoding]
    channels = 1 if weights is None else 3
    rows, width = int(message.height), int(message.width)
    data = np.asarray(message.data, np.uint8)
    if rows * int(message.step) != len(data) or width * channels > int(message.step) or len(data) == 0:
        return None
    pixels = data.reshape(rows, int(message.step))[:, : width * channels]
    if weights is None:
        return np.ascontiguousarray(pixels)
    return np.round(pixels.reshape(rows, width, 3) @ np.array(weights)).astype(np.uint8)
