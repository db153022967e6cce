from pathlib import Path

import pytest
from fuzz_formats import fuzz

FILES = (
    "ecd/slider_depth.zip",
    "ecd/shapes_start/events.txt",
    "ecd/shapes_rotation_start/events.npz",
    "gyro/rotdisk.aedat",
    "dvs128/building.mat",
    "formats/dvs.es",
    "formats/atis.es",
    "formats/gen4.dat",
    "formats/evt2.raw",
    "formats/evt3.raw",
    "formats/davis346.aedat4",
    "formats/test_events_1.bag",
    "formats/test_events_1/test_events_1.db3",
    "formats/test_events_2/test_events_2_0.mcap",
)


@pytest.mark.data
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_opened_or_refused(data_dir: Path, tmp_path: Path, name: str) -> None:
    counts = fuzz(data_dir / name, 50, 1, tmp_path)
    assert counts["opened"] + counts["refused"] == 50
    assert counts["refused"] > 0
