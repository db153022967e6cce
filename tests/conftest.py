import os
from itertools import zip_longest
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Where two workers share the files, the browser's come first and one by one: two at once wait for each other."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    browser = [own for path, own in files.items() if path.parent.name == "browser"]
    others = [own for path, own in files.items() if path.parent.name != "browser"]
    mixed = [own for pair in zip_longest(browser, others, fillvalue=[]) for own in pair]
    items[:] = [item for own in mixed for item in own]
