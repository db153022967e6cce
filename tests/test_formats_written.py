"""Layouts without a real file here: written by independent means, read back."""

import struct
from pathlib import Path

import cv2
import dv_processing as dv
import h5py
import numpy as np
import pytest
import yaml
from scipy.io import savemat

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.formats.open import open_recording

W, H = 240, 180


@pytest.fixture
def events(request: pytest.FixtureRequest) -> Events:
    rng = np.random.default_rng(5)
    n = 5000
    x, y = rng.integers(0, W, n), rng.integers(0, H, n)
    x[0], y[0] = W - 1, H - 1
    return Events(
        t_us=np.sort(rng.integers(0, 2_000_000, n)).astype(np.int64),
        x_px=x.astype(np.uint16),
        y_px=y.astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )


def assert_read(path: Path, events: Events, later_us: int = 0, **options) -> tuple[str, ...]:
    recording = open_recording(path, **options)
    found = recording.events.read(0, recording.events.count)
    np.testing.assert_array_equal(found.t_us, events.t_us + later_us)
    np.testing.assert_array_equal(found.x_px, events.x_px)
    np.testing.assert_array_equal(found.y_px, events.y_px)
    np.testing.assert_array_equal(found.is_positive, events.is_positive)
    return (recording.format, *recording.warnings)


def test_dsec(tmp_path: Path, events: Events) -> None:
    with h5py.File(tmp_path / "events.h5", "w") as file:
        file["events/t"] = events.t_us.astype(np.uint32)
        file["events/x"], file["events/y"] = events.x_px, events.y_px
        file["events/p"] = events.is_positive.astype(np.uint8)
        file["ms_to_idx"] = np.searchsorted(events.t_us, 1000 * np.arange(2000)).astype(np.uint64)
        file["t_offset"] = np.int64(49_599_300_523)
    assert assert_read(tmp_path / "events.h5", events, 49_599_300_523)[0] == "DSEC HDF5"
    assert open_recording(tmp_path / "events.h5").camera.width == 640


DSEC_CAMERA = """
intrinsics:
  cam0: {camera_model: pinhole, camera_matrix: [553.4, 552.9, 346.6, 216.5], resolution: [640, 480],
         distortion_model: radtan, distortion_coeffs: [-0.0935, 0.1948, 0.0, 0.0018]}
  cam3: {camera_model: pinhole, camera_matrix: [560.0, 561.0, 340.0, 220.0], resolution: [640, 480],
         distortion_model: radtan, distortion_coeffs: [-0.09, 0.19, 0.0, 0.001]}
  camRect0: {camera_model: pinhole, camera_matrix: [583.3, 583.3, 336.5, 220.9], resolution: [640, 480]}
extrinsics:
  R_rect0: [[0.99995, -0.006, 0.008], [0.006, 0.99998, 0.0], [-0.008, 0.0, 0.99997]]
"""


@pytest.mark.filterwarnings("error")
def test_dsec_calibration_and_rectify_map(tmp_path: Path, events: Events) -> None:
    left, right = tmp_path / "events/left", tmp_path / "events/right"
    for folder in (left, right):
        folder.mkdir(parents=True)
        with h5py.File(folder / "events.h5", "w") as file:
            for name, column in (
                ("t", events.t_us),
                ("x", events.x_px),
                ("y", events.y_px),
                ("p", events.is_positive),
            ):
                file[f"events/{name}"] = column.astype(np.uint32)
            file["t_offset"] = np.int64(7)
    values = yaml.safe_load(DSEC_CAMERA)
    fx, fy, cx, cy = values["intrinsics"]["cam0"]["camera_matrix"]
    px = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 1, 2)
    focal, _, u, v = values["intrinsics"]["camRect0"]["camera_matrix"]
    mapped = cv2.undistortPoints(
        px,
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        np.array(values["intrinsics"]["cam0"]["distortion_coeffs"]),
        R=np.array(values["extrinsics"]["R_rect0"]),
        P=np.array([[focal, 0, u], [0, focal, v], [0, 0, 1]]),
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
    ).reshape(480, 640, 2)
    with h5py.File(left / "rectify_map.h5", "w") as file:
        file["rectify_map"] = mapped.astype(np.float32)
    # The map alone is no calibration, and says what is missing.
    alone = open_recording(left / "events.h5")
    assert alone.camera.is_guess and "the rectify map alone tells no focal length" in alone.warnings[0]
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration/cam_to_cam.yaml").write_text(DSEC_CAMERA)
    said = open_recording(left / "events.h5", calibration=tmp_path / "calibration/cam_to_cam.yaml")
    found = open_recording(left / "events.h5")
    assert found.camera == said.camera and found.camera.fx == fx and not found.camera.is_guess
    assert found.warnings == ("calibration taken from cam_to_cam.yaml beside the events",)
    assert open_recording(right / "events.h5").camera.fx == 560.0
    with h5py.File(left / "rectify_map.h5", "r+") as file:
        file["rectify_map"][...] = mapped + 5
    assert "up to 7.1 px apart" in open_recording(left / "events.h5").warnings[1]


def test_mvsec(tmp_path: Path, events: Events) -> None:
    rows = np.column_stack([events.x_px, events.y_px, events.t_us * 1e-6, np.where(events.is_positive, 1, -1)])
    with h5py.File(tmp_path / "flying.hdf5", "w") as file:
        file["davis/left/events"] = rows.astype(np.float64)
    assert assert_read(tmp_path / "flying.hdf5", events)[0] == "MVSEC HDF5"


def test_other_hdf5(tmp_path: Path, events: Events) -> None:
    rows = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    rows["t"], rows["x"], rows["y"], rows["p"] = events.t_us, events.x_px, events.y_px, events.is_positive
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["CD/events"] = rows
    assert "assumed from the largest pixel" in assert_read(tmp_path / "a.h5", events)[1]
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["events/ts"], file["events/ps"] = events.t_us * 1e-6, events.is_positive
        file["events/xs"], file["events/ys"] = events.x_px, events.y_px
        file.attrs.update(width=W, height=H)
    assert_read(tmp_path / "b.h5", events)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["weights"] = np.zeros(5)
    with pytest.raises(FormatError, match="expected 'dvsviz-recording'"):
        open_recording(tmp_path / "c.h5")


def test_our_own_repaired(tmp_path: Path, events: Events) -> None:
    t = events.t_us.copy()
    t[100] = 0
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.attrs.update(format="dvsviz-recording", version=1, width=W, height=H)
        file["events/t"], file["events/p"] = t, events.is_positive.astype(np.uint8)
        file["events/x"], file["events/y"] = events.x_px, events.y_px
    with pytest.raises(FormatError, match="event 100: time runs backwards"):
        open_recording(tmp_path / "r.h5")
    recording = open_recording(tmp_path / "r.h5", repair=True)
    assert recording.events.count == len(events) - 1
    assert "1 event whose time ran backwards" in recording.warnings[0]
    with pytest.raises(FormatError, match="the sensor is 240x180, not 640x480"):
        file = tmp_path / "s.h5"
        with h5py.File(file, "w") as out:
            out.attrs.update(format="dvsviz-recording", version=1, width=W, height=H)
            out["events/t"], out["events/p"] = events.t_us, events.is_positive.astype(np.uint8)
            out["events/x"], out["events/y"] = events.x_px, events.y_px
        open_recording(file, size=(640, 480))


@pytest.mark.parametrize("start", [0, 1])
def test_mat(tmp_path: Path, events: Events, start: int) -> None:
    x, y = events.x_px + start, events.y_px + start
    x, y = np.maximum(x, start), np.maximum(y, start)
    p = np.where(events.is_positive, 1, -1)
    savemat(tmp_path / "m.mat", {"aedat": np.column_stack([x, y, p, events.t_us]).astype(float)})
    found = assert_read(tmp_path / "m.mat", events)
    assert found[0] == "MATLAB" and ("count from 1" in found[2]) is bool(start)
    savemat(tmp_path / "n.mat", {"ts": events.t_us, "x": x, "y": y, "pol": p})
    assert_read(tmp_path / "n.mat", events, size=(W, H))
    savemat(tmp_path / "s.mat", {"TD": {"ts": events.t_us, "x": x, "y": y, "p": p}, "other": 3.0})
    assert_read(tmp_path / "s.mat", events, size=(W, H))


def mat73(path: Path, arrays: dict[str, np.ndarray], struct: str = "") -> Path:
    """Write what MATLAB's `save -v7.3` does: HDF5 behind 512 bytes of header, arrays column by column."""
    with h5py.File(path, "w", userblock_size=512, libver="latest") as file:
        group = file.create_group(struct) if struct else file
        for name, array in arrays.items():
            group[name] = np.atleast_2d(array).T if array.ndim == 2 else array[None, :]
            group[name].attrs["MATLAB_class"] = np.bytes_("double" if array.dtype.kind == "f" else str(array.dtype))
        file["note"] = np.frombuffer(b"fast", np.uint8)[:, None].astype(np.uint16)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
        file.create_group("#refs#")
    with path.open("r+b") as file:
        text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2024 HDF5 schema 1.00 ."
        file.write(text.ljust(116) + bytes(8) + b"\x00\x02IM")
    return path


@pytest.mark.parametrize("start", [0, 1])
def test_mat_of_version_73(tmp_path: Path, events: Events, start: int) -> None:
    x, y = (values.astype(float) + start for values in (events.x_px, events.y_px))
    p, t = np.where(events.is_positive, 1.0, -1.0), events.t_us.astype(float)
    found = assert_read(mat73(tmp_path / "m.mat", {"aedat": np.column_stack([x, y, p, t])}), events)
    assert found[0] == "MATLAB 7.3" and ("count from 1" in found[2]) is bool(start)
    columns = {"ts": events.t_us, "x": x.astype(np.uint16), "y": y.astype(np.uint16), "p": p}
    assert_read(mat73(tmp_path / "s.mat", columns, struct="TD"), events, size=(W, H))
    with pytest.raises(FormatError, match="no events among"):
        open_recording(mat73(tmp_path / "n.mat", {"weights": t}))
    with pytest.raises(FormatError, match="a time or pixel is not a whole number"):
        open_recording(mat73(tmp_path / "f.mat", columns | {"x": x + 0.5}))
    data = (tmp_path / "m.mat").read_bytes()
    (tmp_path / "cut.mat").write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"cut\.mat: damaged or cut short"):
        open_recording(tmp_path / "cut.mat")


def aedat3(path: Path, events: Events, *, cut: int = 0) -> Path:
    data = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS240C\r\n#!END-HEADER\r\n"
    for first in range(0, len(events), 700):
        part = events[first : first + 700]
        rows = np.zeros(2 * len(part), "<u4").reshape(-1, 2)
        word = 1 | part.is_positive.astype(np.uint32) << 1 | part.y_px.astype(np.uint32) << 2
        rows[:, 0], rows[:, 1] = word | part.x_px.astype(np.uint32) << 17, part.t_us + 50
        data += struct.pack("<hhiiiiii", 1, 1, 8, 4, 1, len(part), len(part), len(part)) + rows.tobytes()
    imu = struct.pack("<Iifffffff", 1, 77, 0.0, -1.0, 0.0, 180.0, 0.0, 0.0, 30.0)
    data += struct.pack("<hhiiiiii", 3, 1, 36, 4, 1, 1, 1, 1) + imu
    frame = (
        struct.pack("<Iiiiiiiii", 1 | 1 << 1, 1, 2, 99, 4, 3, 2, 0, 0) + (np.arange(6) << 8).astype("<u2").tobytes()
    )
    data += struct.pack("<hhiiiiii", 2, 1, len(frame), 4, 1, 1, 1, 1) + frame
    path.write_bytes(data[: len(data) - cut])
    return path


def test_aedat3(tmp_path: Path, events: Events) -> None:
    path = aedat3(tmp_path / "a.aedat", events)
    assert assert_read(path, events, 50 + (1 << 31))[0] == "AEDAT 3.1"
    recording = open_recording(path)
    assert recording.imu is not None and recording.frames is not None
    np.testing.assert_allclose(recording.imu.gyro, [[np.pi, 0, 0]])
    np.testing.assert_allclose(recording.imu.accel, [[0, -9.80665, 0]])
    np.testing.assert_array_equal(recording.frames.read(0), [[0, 1, 2], [3, 4, 5]])
    assert recording.frames.t_us[0] == 99 + (1 << 31)
    with pytest.raises(FormatError, match="cut short inside a packet"):
        open_recording(aedat3(tmp_path / "b.aedat", events, cut=5))
    assert open_recording(tmp_path / "b.aedat", repair=True).events.count == len(events)


def evt21(events: Events) -> bytes:
    words, high = [], -1
    for t, x, y, p in zip(
        *(c.tolist() for c in (events.t_us, events.x_px, events.y_px, events.is_positive)), strict=True
    ):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 60 | high << 32)
        words.append(int(p) << 60 | (t & 63) << 54 | (x // 32 * 32) << 43 | y << 32 | 1 << (x % 32))
    return b"% evt 2.1\n% geometry 240x180\n% end\n" + np.array(words, "<u8").tobytes()


def test_evt21_and_cut_short(tmp_path: Path, events: Events) -> None:
    (tmp_path / "a.raw").write_bytes(evt21(events))
    assert assert_read(tmp_path / "a.raw", events)[0] == "Prophesee EVT2.1"
    (tmp_path / "b.raw").write_bytes(evt21(events)[:-3])
    with pytest.raises(FormatError, match=r"b\.raw, byte \d+: cut short inside an event"):
        open_recording(tmp_path / "b.raw")
    assert open_recording(tmp_path / "b.raw", repair=True).events.count == len(events) - 1


def test_times_of_32_bits_wrap(tmp_path: Path, events: Events) -> None:
    start = (1 << 32) - 1_000_000
    t = events.t_us + start
    dat = np.zeros(len(t), [("t", "<u4"), ("d", "<u4")])
    dat["t"] = t & 0xFFFFFFFF
    dat["d"] = events.x_px | events.y_px.astype(np.uint32) << 14 | events.is_positive.astype(np.uint32) << 28
    header = b"% Data file containing CD events.\n% Version 2\n% Width 240\n% Height 180\n\x0c\x08"
    (tmp_path / "a.dat").write_bytes(header + dat.tobytes())
    assert_read(tmp_path / "a.dat", events, start)


DVS128_HEADER = b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n"


def test_dvs128_aedat2(tmp_path: Path, events: Events) -> None:
    x, y = events.x_px % 128, events.y_px % 128
    word = (127 - x).astype(np.uint32) << 1 | (127 - y).astype(np.uint32) << 8 | ~events.is_positive
    rows = np.column_stack([word, events.t_us + 10]).astype(">u4")
    (tmp_path / "a.aedat").write_bytes(DVS128_HEADER + rows.tobytes())
    small = Events(t_us=events.t_us - events.t_us[0], x_px=x, y_px=y, is_positive=events.is_positive)
    assert_read(tmp_path / "a.aedat", small)


@pytest.mark.parametrize("version", [1, 2])
def test_dvs_msgs_bag(tmp_path: Path, events: Events, version: int) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    event = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
    array = "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
    if version == 2:
        event = event.replace("time ts", "builtin_interfaces/Time ts")
    store.register(get_types_from_msg(event, "dvs_msgs/msg/Event"))
    store.register(get_types_from_msg(array, "dvs_msgs/msg/EventArray"))
    types = store.types
    time, head = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]

    def stamp(us: int):
        return time(sec=us // 1_000_000, nanosec=us % 1_000_000 * 1000)

    def header(us: int):
        extra = {"seq": 0} if version == 1 else {}
        return head(stamp=stamp(us), frame_id="dvs", **extra)

    path = tmp_path / ("a.bag" if version == 1 else "bag")
    writer = Writer1(path) if version == 1 else Writer2(path, version=9)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
    few = events[:1500]
    with writer:
        topics = {
            name: writer.add_connection(name, "dvs_msgs/msg/EventArray", typestore=store)
            for name in ("/dvs/events", "/other/events")
        }
        pose = writer.add_connection("/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
        other = writer.add_connection("/other/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
        for first in range(0, len(few), 500):
            part = few[first : first + 500]
            columns = (part.t_us, part.x_px, part.y_px, part.is_positive)
            made = [
                types["dvs_msgs/msg/Event"](x=x, y=y, ts=stamp(t), polarity=p)
                for t, x, y, p in zip(*(c.tolist() for c in columns), strict=True)
            ]
            at = int(part.t_us[0])
            message = types["dvs_msgs/msg/EventArray"](header=header(at), height=H, width=W, events=made)
            for connection in topics.values():
                writer.write(connection, at * 1000, serialize(message, connection.msgtype))
            point = types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=float(first))
            turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
            posed = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
            posed = types["geometry_msgs/msg/PoseStamped"](header=header(at), pose=posed)
            writer.write(pose, at * 1000, serialize(posed, pose.msgtype))
            point = types["geometry_msgs/msg/Point"](x=7.0, y=8.0, z=9.0)
            moved = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
            moved = types["geometry_msgs/msg/PoseStamped"](header=header(at), pose=moved)
            writer.write(other, at * 1000, serialize(moved, other.msgtype))
    with pytest.raises(FormatError, match="2 event topics; choose one with --topic: /dvs/events, /other/events"):
        open_recording(path)
    with pytest.raises(FormatError, match="no event topic /none; event topics are: /dvs/events, /other/events"):
        open_recording(path, topic="/none")
    assert_read(path, few, topic="/dvs/events")
    truth = open_recording(path, topic="/dvs/events").ground_truth
    assert truth is not None
    np.testing.assert_array_equal(truth.positions, [[1, 2, 0], [1, 2, 500], [1, 2, 1000]])
    chosen = open_recording(path, topic="/dvs/events", ground_truth="/other/pose", gt_offset_s=0.5).ground_truth
    assert chosen is not None
    np.testing.assert_array_equal(chosen.positions, [[7, 8, 9]] * 3)
    np.testing.assert_array_equal(chosen.t_us, few.t_us[::500] + 500_000)
    with pytest.raises(FormatError, match="no topic /none of poses; topics of poses are: /other/pose, /pose"):
        open_recording(path, topic="/dvs/events", ground_truth="/none")


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_aedat4_that_lost_bytes(tmp_path: Path, compression: str) -> None:
    # Such a file sent the library's decompression into a loop without end.
    kind = getattr(dv.CompressionType, compression)
    writer = dv.io.MonoCameraWriter(
        str(tmp_path / "a.aedat4"), dv.io.MonoCameraWriter.EventOnlyConfig("c", (64, 48), kind)
    )
    store = dv.EventStore()
    for i in range(5000):
        store.push_back(i, i % 64, i % 48, i % 3 == 0)
    writer.writeEvents(store)
    del writer
    assert open_recording(tmp_path / "a.aedat4").events.count == 5000
    data = (tmp_path / "a.aedat4").read_bytes()
    middle = len(data) // 2
    for name, damaged in (("b", data[:middle] + data[middle + 7 :]), ("c", data[:-9]), ("d", data[:40])):
        (tmp_path / f"{name}.aedat4").write_bytes(damaged)
        with pytest.raises(FormatError, match=rf"{name}\.aedat4.*(damaged|cut short)"):
            open_recording(tmp_path / f"{name}.aedat4")
    # What is whole is read: all events where only the table at the end was cut short.
    assert open_recording(tmp_path / "c.aedat4", repair=True).events.count == 5000


@pytest.mark.data
def test_flipped_bits_in_a_compressed_packet(tmp_path: Path, data_dir: Path) -> None:
    # The library's decompression never came back from this one.
    data = bytearray((data_dir / "formats/davis346.aedat4").read_bytes())
    at = 2_908_238
    data[at + 200 : at + 216] = bytes(16)
    (tmp_path / "a.aedat4").write_bytes(data)
    with pytest.raises(FormatError, match=rf"byte {at}: a packet is damaged"):
        open_recording(tmp_path / "a.aedat4")
    recording = open_recording(tmp_path / "a.aedat4", repair=True)
    assert recording.events.count < 78_830 and "1 packet that is damaged dropped" in recording.warnings[0]
    (tmp_path / "b.aedat4").write_bytes(data[: len(data) // 2])
    recording = open_recording(tmp_path / "b.aedat4", repair=True)
    assert 20_000 < recording.events.count < 78_830 and "bytes of a last packet" in recording.warnings[1]
