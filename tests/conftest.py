import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The real recordings: DVSVIZ_DATA, else the folder `shared/data` beside the checkout."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("DVSVIZ_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is not a folder (set DVSVIZ_DATA)")
    return folder


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    # Converted recordings of tests go to one folder a test run, never to the user's own cache.
    monkeypatch.setenv("DVSVIZ_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
