"""Tables that tell a trajectory, in all formats, and all that can be wrong with one."""

import json
import sys

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.scenes.trajectory.table import read_table

PLACE = ["camera_x_m", "camera_y_m", "camera_z_m"]
TURN = [f"world_from_camera_q{axis}" for axis in "wxyz"]
ROWS = {
    "time_s": [0.0, 1.5, 2.0],
    **dict(zip(PLACE, [[1.0, 2.0, 3.0], [0.0, 0.5, 1.0], [9.0, 8.0, 7.0]], strict=True)),
    **dict(zip(TURN, [[1.0, 0.6, 0.0], [0.0, 0.8, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], strict=True)),
    "battery_v": [1.0, 2.0, 3.0],  # which means nothing here
}


def csv_of(columns):
    names = list(columns)
    return "\n".join([",".join(names), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))])


def write(path, columns):
    if path.suffix == ".csv":
        path.write_text(csv_of(columns) + "\n")
    elif path.name == "rows.json":
        path.write_text(
            json.dumps([dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)])
        )
    elif path.suffix == ".json":
        path.write_text(json.dumps(columns))
    else:
        pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
        parquet = pytest.importorskip("pyarrow.parquet")
        parquet.write_table(pyarrow.table(columns), path)
    return path


@pytest.mark.parametrize("name", ["a.csv", "columns.json", "rows.json", "a.parquet"])
def test_every_format_tells_the_same(tmp_path, name):
    motion = read_table(write(tmp_path / name, ROWS))
    assert motion.camera.times.tolist() == ROWS["time_s"]
    np.testing.assert_array_equal(motion.camera.values, np.transpose([ROWS[name] for name in PLACE]))
    np.testing.assert_array_equal(motion.camera_turn.quaternions, np.transpose([ROWS[name] for name in TURN]))
    assert (motion.day, motion.timed, motion.sun, motion.target) == (None, True, None, None)


def test_units_directions_and_epochs(tmp_path):
    columns = {
        "time_utc": ["2030-03-01T23:59:59.5", "2030-061 00:00:01+00:00"],
        **{f"target_{axis}_km": [1.0, 2.0] for axis in "xyz"},
        **{f"target_v{axis}_km_s": [0.5, 0.25] for axis in "xyz"},
        **dict(zip((f"target_from_world_q{axis}" for axis in "wxyz"), ([0.6], [0.8], [0], [0]), strict=True)),
        **dict(zip(("sun_x", "sun_y", "sun_z"), ([3, 0], [0, 0], [4, 9]), strict=True)),
    }
    columns = {name: values * (2 // len(values)) for name, values in columns.items()}
    motion = read_table(write(tmp_path / "a.csv", columns))
    assert motion.epoch(motion.target.times[1]) == "2030-03-02T00:00:01.000000"
    assert np.diff(motion.target.times) == pytest.approx([1.5])
    assert motion.target.values[1].tolist() == [2000.0] * 3
    assert motion.target.rates[1].tolist() == [250.0] * 3
    assert motion.target_turn.quaternions[0].tolist() == [0.6, -0.8, 0, 0]
    np.testing.assert_allclose(motion.sun.values, [[0.6, 0, 0.8], [0, 0, 1]])


def changed(**columns):
    return {**ROWS, **columns}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (changed(world_from_camera_qw=[1.0, 0.6, 0.3]), "quaternions of length 1, found one of 1.04403 in row 3"),
        (changed(time_s=[0.0, 2.0, 1.0]), "times that grow, found in row 3 one that is before row 2"),
        (changed(time_s=[0.0, 0.0, 1.0]), "times that grow, found in row 2 one that repeats that of row 1"),
        (changed(time_s=[0.0, float("nan"), 1.0]), "expected finite times, found nan in row 2"),
        (changed(camera_y_m=[0.0, float("inf"), 1.0]), r"finite numbers, found \[2.0, inf, 8.0\] in row 2"),
        (
            changed(camera_y_m=[0.0, 1e300, 1.0]),
            r"camera position: expected up to 1e\+15 m .* found \[2.0, 1e\+300, 8.0\] ",
        ),
        (changed(camera_y_m=[0.0, 1.0, -1.1e15]), r"expected up to 1e\+15 m along an axis, found .* in row 3"),
        (
            changed(**{f"camera_v{a}_m_s": [0, 0, 3e8] for a in "xyz"}),
            r"camera position: expected up to 2.99792e\+08 m/s along an axis, found .* in row 3",
        ),
        (changed(camera_y_m=[0.0, 1.0, 1e15]), None),
        (changed(camera_y_m=[0.0, "x", 1.0]), "camera_y_m: expected a number, found 'x' in row 2"),
        (changed(camera_y_m=[0.0, "", 1.0]), "camera_y_m: expected a number, found '' in row 2"),
        ({k: v for k, v in ROWS.items() if k != "camera_y_m"}, "camera_y_m: expected a column beside camera_x_m"),
        ({k: v for k, v in ROWS.items() if not k.endswith("qz")}, "camera_qz: expected a column beside world_from_cam"),
        (changed(target_x_ft=[0, 0, 0]), "target_x_ft: expected a unit of m or km at its end, found ft"),
        (changed(camera_vx_m=[0, 0, 0]), "camera_vx_m: expected a unit of m_s or km_s at its end, found m"),
        (changed(target_x=[0, 0, 0]), "target_x: expected a unit of m or km at its end, found none"),
        (changed(target2_x_m=[0, 0, 0]), "target2_y_m: expected a column beside target2_x_m"),
        (changed(sun_azimuth=[0, 0, 0]), "sun_azimuth: expected a column that is known"),
        (changed(camera_from_world_q0=[0, 0, 0]), "camera_from_world_q0: .*did you mean camera_from_world_q[wxyz]"),
        (
            changed(**{f"camera_{a}_km": [0, 0, 0] for a in "xyz"}),
            "camera_x_km: expected one way to say the cam",
        ),
        (
            changed(**{f"camera_from_world_q{a}": [0, 0, 0] for a in "wxyz"}),
            "camera_from_world_qw: expected one way to say the attitude of the camera, found world_from_camera_qw too",
        ),
        (changed(**{f"target_v{a}_m_s": [0, 0, 0] for a in "xyz"}), "target_x_m: expected a position beside the veloc"),
        (changed(sun_x=[0, 0, 1], sun_y=[0, 1, 0], sun_z=[1, 0, 0]), None),
        (
            changed(sun_x=[0, 0, 1], sun_y=[0, 1, 0], sun_z=[0, 0, 0]),
            "sun_x: expected 3 finite numbers, .* found",
        ),
        (changed(exposure=[1, 0, 1]), "exposure: expected a number above 0, found 0 in row 2"),
        (changed(time_utc=["2030-01-01"] * 3), "time_utc: expected one way to say the time, found time_s too"),
        ({"time_utc": ["2030-01-01T25:00:00"], "exposure": [1]}, "time_utc: expected an epoch such as .* in row 1"),
        ({name: [] for name in ROWS}, "expected a header and at least one row, found no row"),
    ],
)
@pytest.mark.parametrize("name", ["a.csv", "columns.json"])
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, name, columns, message):
    path = write(tmp_path / name, columns)
    if message is None:
        read_table(path)
        return
    with pytest.raises(InputError, match=message) as caught:
        read_table(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).count(str(path)) == 1
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", b"", "expected a table, .csv, .json, .parquet, found .txt"),
        ("a.csv", b"", "expected a header and at least one row, found nothing"),
        ("a.csv", b"time_s,camera_x_m\n1\n", "expected 2 values in row 1, found 1"),
        ("a.csv", b"time_s;camera_x_m\n1;2,5\n", "a.csv: expected commas between columns, found ';'$"),
        ("a.csv", b'"time_s";"camera_x_m"\n1;2\n', "a.csv: expected commas between columns, found ';'$"),
        ("a.csv", b"time_s|camera_x_m|b, c\n1|2|3\n", "a.csv: expected commas between columns, found '.'$"),
        ("a.csv", b"time_s\tcamera_x_m\n1\t2\n", "a.csv: expected commas between columns, found '.t'$"),
        ("a.csv", b"time_s,time_s\n1,2\n", "expected each column once, found 'time_s' twice"),
        ("a.csv", b'time_s\n"1\n', "expected CSV in UTF-8, found something else"),
        ("a.csv", b"\xff\xfe", "expected CSV in UTF-8, found something else"),
        ("a.json", b"[{", "expected JSON, found text that breaks off"),
        ("a.json", b"3", "expected a list of rows or an object of columns"),
        ("a.json", b'[{"time_s": 1}, {"time": 2}]', "expected the same columns in every row, found 'time' not in all"),
        ("a.json", b'{"time_s": [1, 2], "exposure": [1]}', "expected columns of one length, found 1 and 2"),
        ("a.json", b'{"time_s": [[1], 2]}', "time_s: expected a number, found '\\[1\\]' in row 1"),
        ("a.json", b'{"time_s": [0, true, 2]}', "time_s: expected a number, found 'True' in row 2"),
        ("a.json", b'[{"time_s": false}]', "time_s: expected a number, found 'False' in row 1"),
        ("a.json", b'{"time_s": [1], "time_s": [2]}', "a.json: expected each column once, found 'time_s' twice"),
        ("a.json", b'[{"time_s": 1}, {"time_s": 2, "time_s": 3}]', "expected each column once, found 'time_s' twice"),
        ("a.json", b"[]", "expected a header and at least one row, found nothing"),
    ],
)
def test_files_that_are_no_tables(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_table(path)
    with pytest.raises(InputError, match="expected a trajectory, found none"):
        read_table(tmp_path / "none.csv")


def test_a_misspelled_column_is_reported_once(tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "a.csv").write_text("time_s,sunx,sun_y,sun_z\n0,1,0,0\n")
    with pytest.raises(InputError, match=r"sun_x: expected a column beside sun_y, found sunx$"):
        read_table(tmp_path / "a.csv")
    assert caplog.records == []
    (tmp_path / "a.csv").write_text("time_s,sun_x,sun_y,sun_z,note\n0,1,0,0,9\n")
    read_table(tmp_path / "a.csv")
    said = [record.getMessage() for record in caplog.records]
    assert said == [f"{tmp_path / 'a.csv'}: columns that mean nothing here: note"]


def test_parquet_without_pyarrow(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"expected the package pyarrow .* pip install 'spacesim\[parquet\]'"):
        read_table(tmp_path / "a.parquet")


def test_what_is_no_parquet(tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match="expected Parquet, found something else"):
        read_table(tmp_path / "a.parquet")
