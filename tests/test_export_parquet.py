"""The table of all windows as Parquet: what the CSV says, with kinds, units and nulls."""

from __future__ import annotations

import csv
from pathlib import Path

import gateway_samples as samples
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dvsviz.cli import main
from dvsviz.errors import DvsvizError
from dvsviz.export.parquet import export_parquet
from dvsviz.session.store import open_session
from dvsviz.view.shown import ShownSession


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parquet")
    recording = samples.make_recording(folder / "r.h5", 40)
    return samples.make_session(folder / "walk.h5", recording, 40)


def test_the_table_holds_what_the_session_holds(session: Path, tmp_path: Path) -> None:
    with open_session(session) as opened:
        assert export_parquet(ShownSession(opened, None), tmp_path / "x.parquet") == 40
    table = pq.read_table(tmp_path / "x.parquet")
    assert table["window"].to_pylist() == list(range(40))
    assert table.schema.field("start_us").type == pa.int64()
    assert table["start_us"].to_pylist() == [samples.WINDOW_US * k for k in range(40)]
    assert table["status"].to_pylist()[8:10] == ["tracking", "lost"]
    assert table["score"].null_count == 40, "what is not known is null"
    np.testing.assert_allclose(table["x"].to_numpy(), [samples.pose(k)[0, 3] for k in range(40)])
    assert table.schema.field("omega_x_rad_s").metadata == {b"unit": b"rad/s"}
    assert table.schema.metadata[b"session"] == b"walk"


def test_csv_and_parquet_from_the_command_line_say_the_same(session: Path, tmp_path: Path) -> None:
    for name in ("x.csv", "x.parquet"):
        assert main(["export", str(session), "--to", str(tmp_path / name)]) == 0
    table = pq.read_table(tmp_path / "x.parquet")
    rows = list(csv.DictReader((tmp_path / "x.csv").read_text().splitlines()))
    assert list(rows[0]) == table.column_names
    for name in table.column_names:
        for text, value in zip((row[name] for row in rows), table[name].to_pylist(), strict=True):
            assert (text == "") == (value is None)
            if isinstance(value, float):
                assert float(text) == pytest.approx(value, rel=1e-8)
            elif value is not None:
                assert text == str(value)


def test_a_folder_that_is_not_there_is_an_error_and_leaves_nothing(session: Path, tmp_path: Path) -> None:
    with open_session(session) as opened, pytest.raises(DvsvizError, match="cannot be written"):
        export_parquet(ShownSession(opened, None), tmp_path / "no" / "x.parquet")
    assert not list(tmp_path.iterdir())
