"""Tables of one's own: fields, units, and what is refused."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from limsim_jax.calibration.cleaning import segments
from limsim_jax.recordings import RecordingError, read_columns, read_recording, read_recordings

DT, LENGTH = 0.1, 4.5
T = np.arange(300) * DT
V_LEAD = 12 + 2 * np.sin(0.3 * T)
X_LEAD = 100 + 12 * T + 2 / 0.3 * (1 - np.cos(0.3 * T))
V = 12 + np.sin(0.3 * T)
X = 75 + 12 * T + 1 / 0.3 * (1 - np.cos(0.3 * T))
GAP = X_LEAD - X - LENGTH
COLUMNS = {"time": "t", "x_lead": "leader", "x": "follower"}


def pair(**changed):
    return {"t": T, "leader": X_LEAD, "follower": X} | changed


def as_file(folder, values, name="pairs.csv"):
    path = folder / name
    if path.suffix == ".parquet":
        pq.write_table(pa.table(values), path)
    else:
        pd.DataFrame(values).to_csv(path, index=False)
    return path


def check(recording):
    assert recording.dt == DT and len(recording) == 300
    np.testing.assert_allclose(recording.gap, GAP, atol=0.01)
    np.testing.assert_allclose(recording.v[1:-1], V[1:-1], atol=0.02)
    np.testing.assert_allclose(recording.v_lead[1:-1], V_LEAD[1:-1], atol=0.02)
    assert {recording.names[k] for k in recording.vehicle} == {"follower"}


@pytest.mark.parametrize("kind", ["csv", "parquet", "mapping", "pandas", "pyarrow"])
def test_every_container_gives_the_same_pair(kind, tmp_path):
    values = pair()
    data = {
        "csv": lambda: as_file(tmp_path, values),
        "parquet": lambda: as_file(tmp_path, values, "pairs.parquet"),
        "mapping": lambda: values,
        "pandas": lambda: pd.DataFrame(values),
        "pyarrow": lambda: pa.table(values),
    }[kind]()
    check(read_columns(data, columns=COLUMNS, length=LENGTH))


@pytest.mark.parametrize(
    "values",
    [
        {"time": T, "x": X, "x_lead": X_LEAD, "length_lead": np.full(300, LENGTH)},
        {"time": T, "x": X, "gap": GAP},
        {"time": T, "gap": GAP, "v": V, "v_lead": V_LEAD},
        {"Time": T, "GAP": GAP, "v": V, "v_lead": V_LEAD, "note": np.full(300, "text")},
    ],
)
def test_columns_that_are_named_like_fields_need_no_words(values, tmp_path):
    check(read_columns(values))
    check(read_recording(as_file(tmp_path, values)))


def test_units_of_a_position_hold_for_that_of_the_leader():
    data = pair(leader=X_LEAD / 1000, follower=X / 1000, t=T * 1000)
    check(read_columns(data, columns=COLUMNS, length=LENGTH, units={"x": "km", "time": "ms"}))
    speeds = {"time": T, "gap": GAP / 0.3048, "v": 3.6 * V, "v_lead": V_LEAD}
    units = {"gap": "ft", "v": "km/h", "v_lead": "m/s"}
    check(read_columns(speeds, units=units))


def test_pairs_are_told_apart_by_their_ids():
    """A second pair behind the first one: its leader is the first follower."""
    first = {"time": T, "x": X, "x_lead": X_LEAD, "id": np.full(300, 7), "id_lead": np.full(300, 5)}
    second = first | {"x": X - 30, "x_lead": X, "id": np.full(300, 9), "id_lead": np.full(300, 7)}
    both = {name: np.concatenate([second[name], first[name]]) for name in first}
    recording = read_columns(both, length=LENGTH)
    assert recording.names == ("5", "7", "9")
    follower = recording.vehicle == recording.names.index("9")
    assert {recording.names[k] for k in recording.leader[follower]} == {"7"}
    np.testing.assert_allclose(recording.gap[follower], 30 - LENGTH, atol=1e-6)
    del both["id_lead"]
    assert read_columns(both, length=LENGTH).names == ("7", "9", "leader of 7", "leader of 9")


def test_several_tables_are_several_recordings():
    found = read_recordings([pair(), pair()], columns=COLUMNS, length=LENGTH)
    assert [recording.source for recording in found] == ["data 0", "data 1"]
    with pytest.raises(RecordingError, match="at least one file or table is expected"):
        read_recordings([])


@pytest.mark.parametrize(
    ("field", "row", "value", "message"),
    [
        ("x", 17, np.nan, "data: row 17, column follower: 'nan'; a finite number is expected"),
        ("x_lead", 17, np.inf, "data: row 17, column leader: 'inf'; a finite number is expected"),
        ("length_lead", 3, np.nan, "data: row 3, column length_lead: 'nan'; a finite number is expected"),
        ("time", 40, 1.0, "data: row 40, column t: '1'; a time after that of the row before is expected"),
        ("v", None, V[:-1], "data: v has 299 rows, time 300; equally many are expected"),
    ],
)
def test_a_recording_made_by_hand_is_checked_as_well(field, row, value, message):
    recording = read_columns(pair(), columns=COLUMNS, length=LENGTH)
    values = value if row is None else at(getattr(recording, field), row, value)
    with pytest.raises(RecordingError) as caught:
        segments(replace(recording, **{field: values}))
    assert str(caught.value) == message


@pytest.mark.parametrize(("field", "value"), [("v", -3.0), ("v", 1e9), ("v_lead", 80.0)])
def test_an_impossible_speed_costs_its_stretch_and_is_named(field, value):
    data = {"time": T, "x": X, "x_lead": X_LEAD, "v": V, "v_lead": V_LEAD}
    data[field] = at(data[field], 280, value)
    found, quality = segments(read_columns(data, length=LENGTH))
    assert f"row 280, column {field}: {value:g} m/s; 0 to 70 m/s are expected" in quality.findings
    assert quality.dropped["impossible speeds"] == pytest.approx(DT)
    assert [len(one) for one in found] == [270]
    with pytest.raises(RecordingError, match="so are 1 of 300 rows"):
        read_columns(data, length=LENGTH, tolerated=0.0)


def test_an_overlap_names_the_gap_if_that_is_what_the_table_tells():
    data = {"time": T, "gap": at(GAP, 40, -3.0), "v": V, "v_lead": V_LEAD}
    with pytest.raises(RecordingError, match="row 40, column gap: follower overlaps its leader leader by 3"):
        read_columns(data, tolerated=0.0)


def test_bodies_that_touch_once_smoothed_cost_their_stretch():
    """A gap of 1 cm that shakes by 1 m for a moment: recorded above 0, smoothed below."""
    shake = 1.0 * (np.arange(300) == 150)
    data = {"time": T, "x": X, "gap": 0.01 + shake, "v": V, "v_lead": V}
    with pytest.raises(RecordingError, match="bodies that touch once smoothed: 30 s"):
        segments(read_columns(data, length=LENGTH))


def at(values, row, value):
    changed = np.array(values)
    changed[row] = value
    return changed


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (pair(leader=at(X_LEAD, 17, np.nan)), {}, "data: row 17, column leader: 'nan'; a finite number"),
        (pair(t=at(T, 20, T[19])), {}, "row 20, column t: this vehicle is at t = 1.90 s already"),
        (pair(leader=at(X_LEAD, 40, 0.0)), {"tolerated": 0.0}, "row 40, column leader: leader leader is"),
        (pair(leader=X, follower=X_LEAD), {}, "column leader: leader leader is"),
        (pair(leader=-X_LEAD, follower=-X), {}, "positions fall; positions that grow along the road"),
        (pair(t=T * 1000), {}, "column t: steps of 100 s; 0.01 to 0.5 s are expected"),
        (pair(leader=X_LEAD * 50, follower=X * 50), {}, "m/s; at most 70 m/s are expected"),
        (pair(), {"length": None}, "the length of the leaders is missing; length=4.5"),
        (pair(), {"length": 450.0}, "length: 450 m; the length of the leaders, 1 to 30 m"),
        (pair(), {"columns": {"time": "t"}}, "no column for x, x_lead; found are t, leader, follower; say"),
        (pair(), {"columns": COLUMNS | {"x": "me"}}, "data: column me is missing; found are t, leader"),
        (pair(), {"columns": {"leader": "leader"}}, "columns: 'leader' is no field; known are time, x"),
        (pair(), {"units": {"x": "yards"}}, "units: x in 'yards'; one of m, km, cm, ft, mi is expected"),
        (pair(), {"units": {"id": "m"}}, "units: 'id' is no field with a unit"),
        (3, {}, "data: a path, a table .* is expected, not int"),
        ({"t": T, "leader": X_LEAD[:5], "follower": X}, {}, "arrays of one length is expected, not dict"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(data, options, message):
    with pytest.raises(RecordingError, match=message.replace("[", r"\[")) as caught:
        read_columns(data, **{"columns": COLUMNS, "length": LENGTH} | options)
    assert "\n" not in str(caught.value)
