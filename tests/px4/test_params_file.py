"""Parameter files: what is read, what is refused and where, and that what is written reads back equal."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.document import ConfigError
from companion.px4 import params_file
from companion.px4.required import BY_NAME, WANTED, file_values
from tools.docs import px4 as published

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs/px4"

# As QGroundControl 4 writes it.
QGROUNDCONTROL = """\
# Onboard parameters for Vehicle 1
#
# Stack: PX4 Pro
# Vehicle: Multi-Rotor
# Version: 1.16.1
#
# Vehicle-Id Component-Id Name Value Type
1\t1\tBAT1_V_CHARGED\t4.050000190734863281\t9
1\t1\tCAL_GYRO0_ID\t1310988\t6
1\t1\tCOM_FLTMODE6\t-1\t6

1\t1\tEKF2_EVP_NOISE\t1e-2\t9\r
"""
NAMES = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_", min_size=1, max_size=16)
VALUES = st.integers(-(2**31), 2**31 - 1) | st.floats(width=32, allow_nan=False, allow_infinity=False)


def test_a_file_of_qgroundcontrol_is_read() -> None:
    values = params_file.parse(QGROUNDCONTROL, "qgc.params").values[1]
    assert values == {
        "BAT1_V_CHARGED": params_file.single(4.05),
        "CAL_GYRO0_ID": 1310988,
        "COM_FLTMODE6": -1,
        "EKF2_EVP_NOISE": params_file.single(0.01),
    }
    assert [type(value) for value in values.values()] == [float, int, int, float]


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff# Onboard parameters\r\n1\t1\tEKF2_EV_DELAY\t25.0\t9\r\n",
        "1\t1\tEKF2_EV_DELAY\t                   25.0\t9\n",
        "1 1 EKF2_EV_DELAY   25.0 9\n",
        "1,1,EKF2_EV_DELAY,25.0,9\n1, 124, EKF2_EV_DELAY, 5.0, 9",
        "# a line separator\u2028 in a comment\n1\t1\tEKF2_EV_DELAY\t25.0\t9\t\n",
    ],
    ids=["byte order mark", "padded cells", "spaces", "commas", "line separator"],
)
def test_columns_are_read_as_other_tools_write_them(tmp_path: Path, text: str) -> None:
    path = tmp_path / "other.params"
    path.write_bytes(text.encode())
    assert params_file.read(path).values == {1: {"EKF2_EV_DELAY": 25.0}}


def test_parameters_of_other_components_and_vehicles_are_skipped_by_name() -> None:
    """A CAN node's names may be lower case and repeated, and its types are others."""
    text = "1\t1\tA\t2.0\t9\n1\t124\tA\t25.0\t9\n1\t125\tgps_type\t1\t2\n2\t1\tA\t3.0\t9\n2\t1\tB\t1\t6\n"
    values, skipped = params_file.parse(text, "mine.params").of_vehicle(1)
    assert values == {"A": 2.0}
    assert params_file.skipped_lines(skipped) == [
        "vehicle 2, component 1: A, B", "vehicle 1, component 124: A", "vehicle 1, component 125: gps_type",
    ]  # fmt: skip


def test_a_file_of_another_vehicle_or_component_is_refused_by_name() -> None:
    with pytest.raises(
        ConfigError, match=r"mine\.params: expected parameters of vehicle 3 .*, found those of vehicle 2;"
    ):
        params_file.parse("2\t1\tA\t2.0\t9\n", "mine.params").of_vehicle(3)
    with pytest.raises(ConfigError, match=r"mine\.params: expected .*, found vehicle 1, component 50: MC_ROLLRATE_P"):
        params_file.parse("1\t50\tMC_ROLLRATE_P\t    0.12\t9\n", "mine.params")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("EKF2_EV_CTRL 11", "expected 5 fields (vehicle, component, name, value, type), found 2"),
        ("1\t1\tEKF2_EVP_NOISE\t0,1\t9", "EKF2_EVP_NOISE: expected a number (type 9), found '0,1'"),
        ("1\t1\tEKF2_EV_CTRL\t11", "expected 5 fields"),
        ("0\t1\tEKF2_EV_CTRL\t11\t6", "a vehicle id from 1 to 255, found '0'"),
        ("1\tx\tEKF2_EV_CTRL\t11\t6", "a component id from 1 to 255, found 'x'"),
        ("1\t1\tekf2\t11\t6", "a name with 1 to 16 of the characters A-Z, 0-9 and _, found 'ekf2'"),
        ("1\t1\tEKF2_EV_CTRL_TOO_LONG\t11\t6", "a name with 1 to 16"),
        ("1\t1\tEKF2_EV_CTRL\t11\t8", "type 6 (INT32) or 9 (REAL32), found '8'"),
        ("1\t1\tEKF2_EV_CTRL\t11.0\t6", "EKF2_EV_CTRL: expected a whole number (type 6), found '11.0'"),
        ("1\t1\tEKF2_EV_CTRL\t2147483648\t6", "a whole number that fits into 32 bits, found 2147483648"),
        ("1\t1\tEKF2_EVP_NOISE\tnan\t9", "expected a number (type 9), found 'nan'"),
        ("1\t1\tEKF2_EVP_NOISE\t1e39\t9", "a number that fits into single precision, found 1e39"),
        ("1\t1\tEKF2_EVP_NOISE\t1e400\t9", "a number that fits into single precision, found 1e400"),
        ("1\t1\tA\t1\t6", "A is already set in line 2"),
    ],
)
def test_a_mistake_is_reported_with_its_line(line: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        params_file.parse(f"# mine\n1\t1\tA\t0\t6\n{line}\n", "mine.params")
    assert len(caught.value.lines) == 1
    assert caught.value.lines[0].startswith("mine.params:3: ")
    assert said in caught.value.lines[0]


def test_every_mistake_is_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "two.params"
    path.write_text("1\t1\tA\tx\t6\n1\t1\tB\t1\t6\n1\t1\tC\ty\t9\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        params_file.read(path)
    assert [line.partition(": ")[0] for line in caught.value.lines] == [f"{path}:1", f"{path}:3"]


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"# nothing\n", "expected parameters of .*, found none"), (b"\xff\xfe", "expected UTF-8 text")],
)
def test_a_file_without_parameters_is_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "odd.params"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said):
        params_file.read(path)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file or directory"):
        params_file.read(tmp_path / "none.params")


@given(st.dictionaries(NAMES, VALUES, min_size=1))
def test_what_is_written_reads_back_equal(values: dict[str, float | int]) -> None:
    text = params_file.text(values, ["a heading", ""], {name: [f"about {name}"] for name in values})
    read = params_file.parse(text, "x").values[1]
    assert list(read) == list(values)
    for name, value in values.items():
        assert type(read[name]) is type(value)
        assert read[name] == value


@given(VALUES, VALUES)
def test_a_value_is_the_same_only_as_itself_and_in_its_own_type(one: float | int, other: float | int) -> None:
    assert params_file.same(one, one)
    assert params_file.same(one, other) is (type(one) is type(other) and one == other)


def test_single_precision_counts() -> None:
    assert params_file.same(0.1, params_file.single(0.1))
    assert not params_file.same(0.1, 0.1000001)


def test_the_published_file_is_the_table() -> None:
    """Made by `python -m tools.docs.px4 .`."""
    text = published.indoor_mocap_text()
    assert (CONFIGS / "indoor_mocap.params").read_text(encoding="utf-8") == text
    assert params_file.read(CONFIGS / "indoor_mocap.params").values[1] == pytest.approx(file_values())
    for wanted in WANTED:
        assert (wanted.name in file_values()) is (wanted.file and wanted.value is not None)
        if wanted.name in file_values():
            assert f"# {wanted.name}: {wanted.why.split(';')[0].split('.')[0][:30]}" in text, "its reason"


def test_the_pilots_radio_is_switched_off_by_a_file_of_its_own() -> None:
    own = params_file.read(CONFIGS / "no_radio.params")
    assert own.of_vehicle(1) == own.of_vehicle(7) == ({"COM_RC_IN_MODE": 4}, {}), (
        "the project's own files are for any vehicle"
    )
    assert "COM_RC_IN_MODE" not in file_values()
    assert (CONFIGS / "no_radio.params").read_text(encoding="utf-8") == published.no_radio_text()
    assert BY_NAME["COM_RC_IN_MODE"].value == 4


def test_the_table_of_parameters_in_the_docs_is_up_to_date() -> None:
    """Made by `python -m tools.docs.px4 .`."""
    page = (ROOT / "docs/internals/px4.md").read_text(encoding="utf-8")
    assert published.table_markdown() in page
