import re
from pathlib import Path

import h5py
import numpy as np
import session_samples as samples
from make_session_sample import SAMPLE, WINDOWS
from test_session_store import check

from dvsviz.session import schema
from dvsviz.session.records import STATUSES
from dvsviz.session.store import SessionWriter, open_session

DOCUMENT = (Path(__file__).parents[1] / "docs" / "session-format.md").read_text()
ROW = re.compile(r"^\| `([\w/]+)` \| (\w+) \| ([\w×]+) \| ([^|]+?) \| (.+?) \|$", re.MULTILINE)


def documented() -> dict[str, tuple[str, str, str]]:
    return {place: (dtype, row, unit) for place, dtype, row, unit, _ in ROW.findall(DOCUMENT)}


def test_the_document_and_the_schema_say_the_same() -> None:
    columns = {
        f"{table.name}/{c.name}": (c.dtype, "×".join(map(str, c.shape)) or "scalar", c.unit or "1")
        for table in schema.TABLES
        for c in table.columns
    }
    assert documented() == columns | dict.fromkeys(schema.BYTES, ("uint8", "scalar", "1"))
    assert f"`{schema.FORMAT}` version {schema.VERSION}" in DOCUMENT
    for number, name in (*enumerate(STATUSES), *enumerate(schema.CAUSES)):
        assert f"{number} {name.value}" in DOCUMENT


def test_a_file_holds_what_the_document_says_and_nothing_else(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path / "s.h5", samples.header()).close()
    found: dict[str, tuple[str, str, str]] = {}

    def visit(name: str, node: object) -> None:
        if isinstance(node, h5py.Dataset) and name != "commit":
            row = "×".join(map(str, node.shape[1:])) or "scalar"
            found[name] = (str(node.dtype), row, node.attrs.get("unit", "") or "1")

    with h5py.File(tmp_path / "s.h5") as file:
        file.visititems(visit)
        attributes = [*file.attrs, *file["camera"].attrs]
        names = list(file["commit"].attrs["names"])
    assert found == documented()
    assert all(f"`{name}`" in DOCUMENT for name in attributes)
    assert names == ["sequence", "complete", *schema.COUNTED, "crc32"]


def test_the_sample_of_version_1_stays_readable() -> None:
    assert SAMPLE.stat().st_size < 100_000
    session = open_session(SAMPLE)
    check(session, WINDOWS)
    assert session.complete and session.summary == {"windows": WINDOWS}
    assert [b.text for b in session.bookmarks] == ["lost here"] and session.tags == ("sample",)
    assert len(session.keyframes) == 5 and session.failures[0].worst == 41
    revision = session.map_at(35)
    assert revision is not None
    np.testing.assert_array_equal(revision.texture, samples.texture(3))
    found = session.checkpoint_at(WINDOWS)
    assert found is not None
    np.testing.assert_array_equal(found[1]["pose"], samples.pose(39))
    truth = session.ground_truth
    assert truth is not None and len(truth) == 4
