from pathlib import Path

import pytest

from dvsviz.errors import FormatError
from dvsviz.formats.calibration import Calibration, read_calibration

K = {"fx": 335.4, "fy": 335.3, "cx": 129.9, "cy": 99.1}
ECD = "335.4 335.3 129.9 99.1 -0.1 0.2 0.003 0.004 0.05\n"
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.2, 0.003, 0.004]
  distortion_model: radtan
  intrinsics: [335.4, 335.3, 129.9, 99.1]
  resolution: [240, 180]
  rostopic: /dvs/image_raw
"""
ROS = """image_width: 240
image_height: 180
camera_name: davis
camera_matrix: {rows: 3, cols: 3, data: [335.4, 0, 129.9, 0, 335.3, 99.1, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.2, 0.003, 0.004, 0.05]}
"""
DSEC = """intrinsics:
  cam0:
    camera_matrix: [335.4, 335.3, 129.9, 99.1]
    distortion_coeffs: [-0.1, 0.2, 0.003, 0.004]
    distortion_model: radtan
    resolution: [240, 180]
"""
TOML = """width = 240
height = 180
fx = 335.4
fy = 335.3
cx = 129.9
cy = 99.1
distortion = [-0.1, 0.2, 0.003, 0.004, 0.05]
"""


@pytest.mark.parametrize(
    ("text", "size", "k3"),
    [
        (ECD, None, 0.05),
        (ECD + "240 180\n", (240, 180), 0.05),
        (KALIBR, (240, 180), 0.0),
        (ROS, (240, 180), 0.05),
        (DSEC, (240, 180), 0.0),
        (TOML, (240, 180), 0.05),
    ],
)
def test_layouts_agree(tmp_path: Path, text: str, size: tuple[int, int] | None, k3: float) -> None:
    (tmp_path / "any-name").write_text(text)
    found = read_calibration(tmp_path / "any-name")
    assert found == Calibration(**K, distortion=(-0.1, 0.2, 0.003, 0.004, k3), size=size)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("335.4 335.3 129.9 99.1\n", "line 1: expected 9 numbers, got 4"),
        ("\n\n1 2 3 4 5\n", "line 3: expected 9 numbers, got 5"),
        ("", "no calibration"),
        ("\x00\xff", "expected 9 numbers"),
        (KALIBR.replace("radtan", "equidistant"), "distortion model 'equidistant' is not supported"),
        (KALIBR.replace("pinhole", "omni"), "camera model 'omni' is not supported"),
        (KALIBR.replace("335.4,", ""), "cam0: expected four intrinsics"),
        (KALIBR.replace("335.4", "many"), "cam0: not a number"),
        (KALIBR.replace("[240, 180]", "[240, -180]"), "expected a size in pixels"),
        (KALIBR.replace("[335.4", "[335.4}"), "line 5: not valid YAML"),
        (ROS.replace("0, 0, 1]", "0, 0]"), "camera_matrix: expected nine numbers"),
        ("a: b\n", "no calibration of a known layout"),
        ("- a: b\n", "no calibration of a known layout"),
        (TOML.replace("fx = 335.4\n", ""), "fx is missing"),
        (TOML.replace("fx = 335.4", "fx = nan"), "finite"),
        (TOML.replace("fx = 335.4", "fx = "), "not valid TOML"),
        (TOML.replace(", 0.05]", "]").replace("0.2, ", ""), "0, 4 or 5 distortion values, got 3"),
    ],
)
def test_bad_calibrations(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c").write_text(text, encoding="latin-1")
    if "\xff" in text:
        message = "not a text file"
    with pytest.raises(FormatError, match=message) as caught:
        read_calibration(tmp_path / "c")
    assert str(tmp_path / "c") in str(caught.value) and "\n" not in str(caught.value) and caught.value.hint


def test_absent_and_huge(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be read: No such file"):
        read_calibration(tmp_path / "absent")
    (tmp_path / "huge").write_bytes(b"1 " * (1 << 20))
    with pytest.raises(FormatError, match="too large"):
        read_calibration(tmp_path / "huge")
