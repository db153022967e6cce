"""The figures of all windows as a Parquet table: the columns of the CSV file, with kinds, units and nulls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dvsviz import __version__
from dvsviz.errors import DvsvizError
from dvsviz.view.figures import UNITS, figures
from dvsviz.view.shown import ShownSession


def export_parquet(shown: ShownSession, out: Path) -> int:
    """Write one row a window and return how many there are.

    Numbers keep their kinds (times int64 microseconds, figures float64), states are a dictionary of texts, and what is
    not known is null. Each field's metadata holds its `unit`, the table's the session, the recording and the settings.

    Raises:
        DvsvizError: the file cannot be written.
    """
    arrays, fields = [], []
    for name, values in figures(shown).items():
        if values.dtype.kind == "f":
            column = pa.array(values, mask=~np.isfinite(values))
        elif values.dtype.kind in "OU":
            column = pa.array(values.tolist(), pa.string()).dictionary_encode()
        else:
            column = pa.array(values)
        arrays.append(column)
        fields.append(pa.field(name, column.type, metadata={"unit": UNITS.get(name, "1")}))
    header = shown.session.header
    schema = pa.schema(
        fields,
        metadata={
            "session": shown.name,
            "recording": header.recording_name,
            "config": header.config_json,
            "dvsviz_version": __version__,
        },
    )
    table = pa.Table.from_arrays(arrays, schema=schema)
    partial = out.with_name(f".{out.name}.partial")
    try:
        pq.write_table(table, partial, compression="zstd")
        partial.replace(out)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise DvsvizError(
            f"cannot be written: {error.strerror or error}", path=out, hint="check the folder"
        ) from error
    return table.num_rows
