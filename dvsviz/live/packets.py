"""The bytes of an AEDAT4 event stream: header and packets, uncompressed.

Written here and not by dv-processing: its server, once a client has left, never ends (2.0.4: its last thread waits
for the interpreter that waits for it), and takes events one by one at a million per second.
"""

from __future__ import annotations

import struct

import numpy as np

from dvsviz.events.events import Events

_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "?"), ("_", "V3")])
_INFO = """<dv version="2.0">
    <node name="outInfo" path="/outInfo/">
        <node name="0" path="/outInfo/0/">
            <attr key="compression" type="string">NONE</attr>
            <attr key="originalModuleName" type="string">{source}</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/outInfo/0/info/">
                <attr key="sizeX" type="int">{width}</attr>
                <attr key="sizeY" type="int">{height}</attr>
                <attr key="source" type="string">{source}</attr>
            </node>
        </node>
    </node>
</dv>
"""


def stream_header(width: int, height: int, source: str = "dvsviz") -> bytes:
    """Return the flatbuffer that begins a stream of events: no compression, no table of packets, its description."""
    text = _INFO.format(width=width, height=height, source=source).encode()
    # Root offset, file identifier; then a table's list of fields and the table: compression left at its default,
    # position of the packets' table -1, offset of the description.
    head = struct.pack("<I4s", 24, b"IOHE") + bytes(6) + struct.pack("<HHHHH", 10, 20, 4, 12, 8)
    head += struct.pack("<iiI", 10, 0, 12) + struct.pack("<q", -1)
    body = head + struct.pack("<I", len(text)) + text + b"\0"
    body += bytes(-len(body) % 4)
    return struct.pack("<I", len(body)) + body


def event_packet(events: Events, stream: int = 0) -> bytes:
    """Return events as one packet, its head included."""
    rows = np.zeros(len(events), _EVENT)
    rows["t"], rows["x"], rows["y"], rows["p"] = events.t_us, events.x_px, events.y_px, events.is_positive
    body = struct.pack("<I4sHHHHiII", 16, b"EVTS", 0, 6, 8, 4, 6, 4, len(rows)) + rows.tobytes()
    body = struct.pack("<I", len(body)) + body
    return struct.pack("<ii", stream, len(body)) + body
