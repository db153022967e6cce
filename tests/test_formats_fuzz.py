from pathlib import Path

import pytest
from fuzz_formats import FILES, fuzz


@pytest.mark.data
@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_opened_or_refused(data_dir: Path, tmp_path: Path, name: str) -> None:
    counts = fuzz(data_dir / name, 50, 1, tmp_path)
    assert counts["opened"] + counts["refused"] == 50
    assert counts["refused"] > 0
