"""Readers of recordings: every kind gives the same traffic, and bad files are refused by line and column."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from paths import SHARED, needs_shared

from limsim_jax.calibration.cleaning import segments, split_in_time
from limsim_jax.calibration.closed_loop import linked_recordings
from limsim_jax.calibration.report import gather
from limsim_jax.recordings import RecordingError, read_recording
from limsim_jax.recordings.recording import FOOT

TRAJECTORIES = SHARED / "trajectories"
SAMPLES, DT = 301, 0.1
LENGTH = (4.4, 4.8, 5.2)


def traffic():
    """Three cars one behind the other: front bumpers, speeds, accelerations, `[3 T]`."""
    t = np.arange(SAMPLES) * DT
    x, v, a = [], [], []
    for i in range(3):
        w = 0.3 + 0.1 * i
        v.append(12 + 2 * np.sin(w * t))
        x.append(300 - 25 * i + 12 * t + 2 / w * (1 - np.cos(w * t)))
        a.append(2 * w * np.cos(w * t))
    return t, np.array(x), np.array(v), np.array(a)


def rows_of(columns, values):
    """A CSV file from columns of equal length."""
    lines = [",".join(columns)]
    lines += [",".join(str(value) for value in row) for row in zip(*values, strict=True)]
    return "\n".join(lines) + "\n"


def number(x):
    return np.char.mod("%.4f", np.concatenate(x))


PAIR_COLUMNS = (
    "pair_id,time,duration,vehicle_id,frame_id,local_x,local_y,v_length,v_width,v_class,v_vel,v_acc,lane_id,"
    "preceding,preceding_local_y,preceding_length,preceding_vel,preceding_acc"
).split(",")


def ngsim_pairs(scale=1.0):
    """The metric table of pairs: car 2 behind 1, 3 behind 2."""
    t, x, v, a = traffic()
    x, v, a, length = x * scale, v * scale, a * scale, np.array(LENGTH) * scale
    n = len(t)
    values = []
    for i in (1, 2):
        values.append(
            [
                np.repeat(f"{i + 1}-{i}", n), np.char.mod("%.1f", t), np.repeat("30.1", n),
                np.repeat(i + 1, n),
                np.arange(n) + 100, np.repeat("5.0", n), np.char.mod("%.4f", x[i]), np.repeat(length[i], n),
                np.repeat("1.8", n), np.repeat(2, n), np.char.mod("%.4f", v[i]), np.char.mod("%.4f", a[i]),
                np.repeat(1, n), np.repeat(i, n), np.char.mod("%.4f", x[i - 1]), np.repeat(length[i - 1], n),
                np.char.mod("%.4f", v[i - 1]), np.char.mod("%.4f", a[i - 1]),
            ]
        )  # fmt: skip
    return rows_of(PAIR_COLUMNS, [np.concatenate(column) for column in zip(*values, strict=True)])


def ngsim(folder):
    """As published, in feet, with a truck's lane next to it and one id that comes again later."""
    _, x, v, a = traffic()
    columns = (
        "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Class,v_Vel,v_Acc,"
    )
    columns += "Lane_ID,Preceding,Following,Space_Headway,Time_Headway"
    lines = [columns]
    for again in (0, 5000):
        for i in range(3):
            for k in range(SAMPLES):
                frame = 100 + k + again
                lines.append(
                    f"{i + 1},{frame},{SAMPLES},{1113433135300 + 100 * frame},16.4,{x[i, k] / FOOT:.4f},"
                    f"{LENGTH[i] / FOOT:.4f},6,2,{v[i, k] / FOOT:.4f},{a[i, k] / FOOT:.4f},2,{i},0,0,0"
                )
    path = folder / "trajectories.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def tgsim(folder, scale=1.0):
    t, x, v, a = (y * 1.0 for y in traffic())
    lines = [
        "pair,leader_kind,run_no,timestamp,xLeaderReal,vLeaderReal,aLeaderReal,xFollowerReal,vFollowerReal,"
    ]
    lines[0] += "aFollowerReal,spacing,speed_difference,follower_id,leader_id"
    for i in (1, 2):
        for k in range(SAMPLES):
            values = (x[i - 1, k], v[i - 1, k], a[i - 1, k], x[i, k], v[i, k], a[i, k])
            gap = x[i - 1, k] - x[i, k] - 5
            numbers = ",".join(f"{scale * y:.4f}" for y in (*values, gap, v[i, k] - v[i - 1, k]))
            lines.append(f"{i},human,3,{t[k]:.1f},{numbers},{i + 1},{i}")
    path = folder / "tgsim.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def openacc(folder, scale=1.0):
    t, x, v, _ = traffic()
    lines = ["Date,8,10,2019", "Vehicle_order,FIRST,SECOND,THIRD", "Number_of_vehicles,3", "ACC,0"]
    lines += ["Distance_setting", "Time,Speed1,E1,N1,Speed2,E2,N2,Speed3,E3,N3,IVS1,IVS2"]
    for k in range(SAMPLES):
        own = [f"{v[i, k] * scale:.3f},{x[i, k] * scale:.3f},0.0" for i in range(3)]
        gaps = [f"{(x[i, k] - LENGTH[i] - x[i + 1, k]) * scale:.3f}" for i in range(2)]
        lines.append(f"{t[k]:.1f}," + ",".join(own + gaps))
    path = folder / "openacc.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def highd(folder):
    """Boxes by their upper left corner; a fourth car comes the other way."""
    _, x, v, a = traffic()
    lines = [
        "frame,id,x,y,width,height,xVelocity,yVelocity,xAcceleration,yAcceleration,precedingId,followingId,laneId"
    ]
    for i in range(3):
        for k in range(SAMPLES):
            corner = x[i, k] - LENGTH[i]
            lines.append(
                f"{k + 1},{i + 1},{corner:.4f},20,{LENGTH[i]},2,{v[i, k]:.4f},0,{a[i, k]:.4f},0,{i},0,6"
            )
            back = 5000 - x[i, k]  # drives towards smaller x: its front is its left end
            lines.append(
                f"{k + 1},{i + 11},{back:.4f},9,{LENGTH[i]},2,{-v[i, k]:.4f},0,{-a[i, k]:.4f},"
                f"0,{i and i + 10},0,3"
            )
    path = folder / "01_tracks.csv"
    path.write_text("\n".join(lines) + "\n")
    meta = ["id,width,height,initialFrame,finalFrame,numFrames,class,drivingDirection"]
    meta += [f"{i + 1},{LENGTH[i]},2,1,{SAMPLES},{SAMPLES},Car,2" for i in range(3)]
    meta += [f"{i + 11},{LENGTH[i]},2,1,{SAMPLES},{SAMPLES},Car,1" for i in range(3)]
    (folder / "01_tracksMeta.csv").write_text("\n".join(meta) + "\n")
    (folder / "01_recordingMeta.csv").write_text("id,frameRate,speedLimit\n1,10,33.3\n")
    return path


def ind(folder):
    """The same cars on a circle of 200 m radius, and a pedestrian."""
    _, x, v, _ = traffic()
    columns = (
        "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity,"
    )
    lines = [columns + "xAcceleration,yAcceleration,lonVelocity,latVelocity,lonAcceleration,latAcceleration"]
    for i in range(3):
        for k in range(SAMPLES):
            angle = (x[i, k] - LENGTH[i] / 2) / 200
            heading = np.degrees(angle) + 90
            lines.append(
                f"7,{i},{k},{k},{200 * np.cos(angle):.4f},{200 * np.sin(angle):.4f},"
                f"{heading % 360:.4f},1.8,{LENGTH[i]},"
                f"{-v[i, k] * np.sin(angle):.4f},{v[i, k] * np.cos(angle):.4f},0,0,{v[i, k]:.4f},0,0,0"
            )
    for k in range(50):
        lines.append(f"7,9,{k},{k},200,1,90,0.5,0.5,0,1,0,0,1,0,0,0")
    path = folder / "07_tracks.csv"
    path.write_text("\n".join(lines) + "\n")
    meta = ["recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class"]
    meta += [f"7,{i},0,{SAMPLES},{SAMPLES},1.8,{LENGTH[i]},car" for i in range(3)] + [
        "7,9,0,49,50,0.5,0.5,pedestrian"
    ]
    (folder / "07_tracksMeta.csv").write_text("\n".join(meta) + "\n")
    (folder / "07_recordingMeta.csv").write_text("recordingId,locationId,frameRate,speedLimit\n7,1,10,13.9\n")
    return path


def commonroad(folder):
    """Two lanelets one after the other on a line that runs north-east, and a third beside them."""
    _, x, v, _ = traffic()
    along = np.array([np.cos(0.6), np.sin(0.6)])
    left = np.array([-along[1], along[0]])

    def bound(side, begin, end, shift):
        points = [along * s + left * (shift + side) for s in np.linspace(begin, end, 30)]
        text = "".join(f"<point><x>{p[0]:.4f}</x><y>{p[1]:.4f}</y></point>" for p in points)
        return text

    def lanelet(name, begin, end, shift, links):
        sides = (("left", 1.75), ("right", -1.75))
        bounds = "".join(f"<{k}Bound>{bound(side, begin, end, shift)}</{k}Bound>" for k, side in sides)
        return f'<lanelet id="{name}">{bounds}{links}</lanelet>'

    lines = ['<?xml version="1.0"?>', '<commonRoad timeStepSize="0.1" benchmarkID="T">']
    lines.append(lanelet(1, 0, 420, 0, '<successor ref="2"/>'))
    lines += [lanelet(2, 420, 900, 0, '<predecessor ref="1"/>'), lanelet(3, 0, 900, 3.5, "")]
    for i in range(3):
        lines.append(f'<dynamicObstacle id="{i + 1}"><type>car</type><shape><rectangle>')
        lines.append(f"<length>{LENGTH[i]}</length><width>1.8</width></rectangle></shape>")
        for k in range(SAMPLES):
            p = along * (x[i, k] - LENGTH[i] / 2)
            tag = "initialState" if k == 0 else "state"
            state = f"<{tag}><position><point><x>{p[0]:.4f}</x><y>{p[1]:.4f}</y></point></position>"
            state += f"<orientation><exact>0.6</exact></orientation><time><exact>{k}</exact></time>"
            state += f"<velocity><exact>{v[i, k]:.4f}</exact></velocity></{tag}>"
            lines.append(("<trajectory>" if k == 1 else "") + state)
        lines.append("</trajectory></dynamicObstacle>")
    lines.append("</commonRoad>")
    path = folder / "scene.xml.gz"
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    return path


def pairs_file(folder, text=None):
    path = folder / "pairs.csv"
    path.write_text(ngsim_pairs() if text is None else text)
    return path


KINDS = {
    "NGSIM pairs": pairs_file,
    "NGSIM": ngsim,
    "TGSIM pairs": tgsim,
    "OpenACC": openacc,
    "highD": highd,
    "inD": ind,
    "CommonRoad": commonroad,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_same_traffic(kind, tmp_path):
    recording = read_recording(KINDS[kind](tmp_path))
    v = traffic()[2]
    assert recording.kind == kind
    assert recording.dt == pytest.approx(DT)
    assert not recording.defects
    followers = np.unique(recording.vehicle[recording.leader >= 0])
    assert len(followers) == {"NGSIM": 4, "highD": 4}.get(kind, 2)
    leaders = np.unique(recording.leader[recording.leader >= 0])
    assert set(leaders) & set(followers), "the second vehicle follows and leads: one name for both"
    for follower in followers:
        rows = (recording.vehicle == follower) & (recording.leader >= 0)
        i = 1 + np.argmin([np.abs(recording.v[rows][:200] - v[i][:200]).mean() for i in (1, 2)])
        gap = gap_of(kind, i)
        # On one's own path the leader is not known beyond where oneself has come to in the end.
        count = rows.sum() if kind == "inD" else SAMPLES
        assert count > 0.8 * SAMPLES
        np.testing.assert_allclose(recording.gap[rows][:count], gap[:count], atol=0.03)
        np.testing.assert_allclose(recording.v[rows][:count], v[i][:count], atol=0.01)
        np.testing.assert_allclose(recording.v_lead[rows][:count], v[i - 1][:count], atol=0.01)
        np.testing.assert_allclose(np.diff(recording.time[rows]), DT, atol=1e-6)
    found, quality = segments(recording)
    assert len(found) == len(followers) and quality.drivers == len(followers)
    assert quality.kept == pytest.approx(len(followers) * SAMPLES * DT, rel=0.15)
    assert quality.speed_rms < 0.05


def test_a_recording_serves_as_well_as_its_file(tmp_path):
    paths = [tgsim(tmp_path), openacc(tmp_path)]
    for some in (paths[0], paths):
        read = [read_recording(path) for path in paths][: None if some is paths else 1]
        (from_files, quality), (from_read, other) = gather(some), gather(read if some is paths else read[0])
        assert quality == other and len(from_files) == len(from_read) > 0
        for one, same in zip(from_files, from_read, strict=True):
            assert (one.driver, one.leader, one.source) == (same.driver, same.leader, same.source)
            np.testing.assert_array_equal(one.gap, same.gap)
    linked = [linked_recordings(some, period=20.0) for some in (paths, read)]
    assert linked[0].periods == linked[1].periods and linked[0].drivers == linked[1].drivers


def gap_of(kind, i):
    x = traffic()[1]
    return x[i - 1] - x[i] - (5.0 if kind == "TGSIM pairs" else LENGTH[i - 1])


def lines_of(text):
    return text.rstrip("\n").split("\n")


def edited(change):
    """The table of pairs with its lines changed."""
    lines = lines_of(ngsim_pairs())
    result = change(lines)
    return "\n".join(lines if result is None else result) + "\n"


def put(line, column, value):
    """Another value in one place; lines count from 1."""

    def change(lines):
        values = lines[line - 1].split(",")
        values[PAIR_COLUMNS.index(column)] = value
        lines[line - 1] = ",".join(values)

    return edited(change)


BAD = {
    "empty": ("", "is empty"),
    "no rows": (edited(lambda lines: lines[:1]), "line 2: no rows"),
    "missing column": (
        edited(lambda lines: [line.rpartition(",")[0].rpartition(",")[0] for line in lines]),
        "line 1: column preceding_vel is missing",
    ),
    "unknown": (
        "a,b,c\n1,2,3\n",
        'found are a, b, c; say which is what, as in --columns "time=a,x_lead=b,x=c"',
    ),
    "not a number": (put(17, "v_vel", "fast"), "line 17, column v_vel: 'fast'; a finite number"),
    "NaN": (put(30, "local_y", "NaN"), "line 30, column local_y: 'NaN'; a finite number"),
    "no value": (put(31, "preceding_local_y", ""), "line 31, column preceding_local_y: no value"),
    "one value less": (
        edited(lambda lines: [*lines[:9], lines[9].rpartition(",")[0], *lines[10:]]),
        "line 10: 17",
    ),
    "feet": (
        ngsim_pairs(1 / FOOT),
        "column v_length: cars are 16.4 m long in the median (it looks like feet)",
    ),
    "class": (put(5, "v_class", "7"), "line 5, column v_class: 7; 1 (motorcycle)"),
    "duplicate time": (
        edited(lambda lines: [*lines[:50], lines[49], *lines[50:]]),
        "line 51, column frame_id",
    ),
}

DEFECTS = {
    "gap in time": (
        edited(lambda lines: lines[:40] + lines[80:]),
        "line 41, column frame_id: 4.1 s are missing",
    ),
    "overlap": (put(60, "preceding_length", "40"), "line 60, column local_y: 2 overlaps its leader 1"),
    "leader behind": (put(70, "preceding_local_y", "1.0"), "line 70, column preceding_local_y: leader 1 is"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named_by_line_and_column(name, tmp_path):
    text, message = BAD[name]
    path = pairs_file(tmp_path, text)
    with pytest.raises(RecordingError) as caught:
        segments(read_recording(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_costs_its_stretch_and_not_the_file(name, tmp_path):
    text, message = DEFECTS[name]
    path = pairs_file(tmp_path, text)
    found, quality = segments(read_recording(path), shortest=3.0)
    assert any(message in finding for finding in quality.findings)
    # of two followers of 30 s: what is missing or overlaps, and 1 s on either side of an overlap
    assert sum(part.duration for part in found) == pytest.approx(
        56.0 if name == "gap in time" else 58.0, abs=0.6
    )
    assert min(part.gap.min() for part in found) > 1
    if name != "gap in time":
        with pytest.raises(RecordingError, match=r"so are 1 of 602 rows, and at most 0 % are tolerated"):
            read_recording(path, tolerated=0.0)


def test_a_file_that_is_wrong_as_a_whole_is_refused(tmp_path):
    def swap(lines):
        at = [PAIR_COLUMNS.index(name) for name in ("local_y", "preceding_local_y")]
        for k, line in enumerate(lines[1:], 1):
            values = line.split(",")
            values[at[0]], values[at[1]] = values[at[1]], values[at[0]]
            lines[k] = ",".join(values)
        return lines

    path = pairs_file(tmp_path, edited(swap))
    with pytest.raises(RecordingError, match=r"line 2, column preceding_local_y: leader 1 is .* behind"):
        read_recording(path)
    with pytest.raises(RecordingError, match=r"tolerated: 1\.5; a share within 0 and 1 is expected"):
        read_recording(path, tolerated=1.5)


def scaled(columns, factor):
    """Some columns in other units."""

    def change(lines):
        at = [PAIR_COLUMNS.index(column) for column in columns]
        for k, line in enumerate(lines[1:], 1):
            values = line.split(",")
            for column in at:
                values[column] = f"{float(values[column]) * factor:.4f}"
            lines[k] = ",".join(values)

    return edited(change)


@pytest.mark.parametrize(
    ("columns", "factor", "hint"),
    [
        (("local_y", "preceding_local_y"), 1 / FOOT, "column local_y: positions advance 3.28 times"),
        (("v_vel",), 1 / FOOT, "(that is speeds in feet per second)"),
        (("v_vel", "preceding_vel"), 3.6, "(that is speeds in km/h)"),
        (("preceding_vel",), 3.6, "in preceding_vel say (that is speeds in km/h)"),
    ],
)
def test_units_that_do_not_go_together_are_refused(columns, factor, hint, tmp_path):
    with pytest.raises(RecordingError) as caught:
        read_recording(pairs_file(tmp_path, scaled(columns, factor)))
    assert hint in str(caught.value)
    assert "m and m/s are expected" in str(caught.value)


def test_feet_are_refused_in_other_kinds(tmp_path):
    for write, column in ((tgsim, "spacing"), (openacc, "IVS1")):
        with pytest.raises(RecordingError, match=f"column {column}: .*feet"):
            read_recording(write(tmp_path, 1 / FOOT))


def test_metres_are_refused_where_feet_belong(tmp_path):
    path = ngsim(tmp_path)
    lines = [line.split(",") for line in lines_of(path.read_text())]
    for values in lines[1:]:
        for column in (5, 6, 9):
            values[column] = f"{float(values[column]) * FOOT:.4f}"
    path.write_text("\n".join(",".join(values) for values in lines))
    with pytest.raises(
        RecordingError, match=r"column v_length: cars are 1\.5 m long.*metres where feet belong"
    ):
        read_recording(path)


def test_milliseconds_are_no_seconds(tmp_path):
    path = tgsim(tmp_path)
    lines = [line.split(",") for line in lines_of(path.read_text())]
    for values in lines[1:]:
        values[3] = f"{float(values[3]) * 1000:.0f}"
    path.write_text("\n".join(",".join(values) for values in lines))
    with pytest.raises(RecordingError, match="column timestamp: steps of 100 s"):
        read_recording(path)


def test_a_missing_meta_file_is_named(tmp_path):
    path = highd(tmp_path)
    (tmp_path / "01_recordingMeta.csv").unlink()
    with pytest.raises(RecordingError, match=r"01_recordingMeta\.csv: no such file"):
        read_recording(path)


def test_a_defect_among_many_followers_is_cut_out_and_reported(tmp_path):
    """1 bad follower of 30: the file is good, and the row does not get into a fit."""
    body, copies = lines_of(ngsim_pairs())[1:], []
    for i in range(15):
        for line in body:
            values = line.split(",")
            values[3], values[13] = str(int(values[3]) + 10 * i), str(int(values[13]) + 10 * i)
            copies.append(values)
    bad = copies[150]
    bad[PAIR_COLUMNS.index("preceding_length")] = "60"
    recording = read_recording(
        pairs_file(tmp_path, "\n".join([",".join(PAIR_COLUMNS), *map(",".join, copies)]))
    )
    assert [defect.line for defect in recording.defects] == [152]
    found, quality = segments(recording, shortest=10.0)
    assert any("line 152, column local_y" in finding for finding in quality.findings)
    assert quality.dropped["near a defect"] == pytest.approx(2.0, abs=0.2)
    cut = [segment for segment in found if segment.driver == "2"]
    assert [len(segment) for segment in cut] == [140, 140]
    assert min(segment.gap.min() for segment in found) > 1


def test_changes_of_leader_and_lane_are_cut(tmp_path):
    lines = lines_of(ngsim_pairs())
    for k in range(1, len(lines)):
        values = lines[k].split(",")
        if k <= SAMPLES and k > 120:
            values[PAIR_COLUMNS.index("preceding")] = "9"
        if k > SAMPLES + 200:
            values[PAIR_COLUMNS.index("lane_id")] = "2"
        lines[k] = ",".join(values)
    found, quality = segments(read_recording(pairs_file(tmp_path, "\n".join(lines))), shortest=5.0)
    spans = [(s.driver, s.leader, round(s.time - 10, 1), round(s.time - 10 + s.duration, 1)) for s in found]
    # 1 s at both sides of the change of leader at 12 s, 2 s at both sides of the change of lane at 20 s
    assert spans == [
        ("2", "1", 0.0, 11.0),
        ("2", "9", 13.1, 30.1),
        ("3", "2", 0.0, 18.0),
        ("3", "2", 22.1, 30.1),
    ]
    assert set(quality.dropped) == {"near a lane change", "near a change of the leader"}


def test_segments_fit_together(tmp_path):
    """Gap and speeds are those of one motion, near the noisy positions and nearer to the truth."""
    rng = np.random.default_rng(0)
    v = traffic()[2]
    noisy = lines_of(ngsim_pairs())
    for k in range(1, len(noisy)):
        values = noisy[k].split(",")
        for column in ("local_y", "preceding_local_y"):
            at = PAIR_COLUMNS.index(column)
            values[at] = f"{float(values[at]) + rng.normal(0, 0.05):.4f}"
        noisy[k] = ",".join(values)
    found, quality = segments(read_recording(pairs_file(tmp_path, "\n".join(noisy))))
    for i, segment in enumerate(found, 1):
        step = np.diff(segment.gap) / DT
        mean = 0.5 * (segment.v_lead[1:] + segment.v_lead[:-1] - segment.v[1:] - segment.v[:-1])
        np.testing.assert_allclose(step, mean, atol=1e-9)
        inner = slice(10, -10)
        assert np.sqrt(np.mean((segment.v - v[i])[inner] ** 2)) < 0.15  # 0.35 without smoothing
        assert np.sqrt(np.mean((segment.gap - gap_of("NGSIM pairs", i))[inner] ** 2)) < 0.06
    assert 0.03 < quality.moved_rms < 0.1


def test_coarse_recordings_are_interpolated(tmp_path):
    lines = lines_of(ngsim_pairs())
    text = "\n".join([lines[0], *(line for line in lines[1:] if int(line.split(",")[4]) % 4 == 0)])
    recording = read_recording(pairs_file(tmp_path, text))
    assert recording.dt == pytest.approx(0.4)
    found, _ = segments(recording, smoothing=0)
    assert found[0].dt == 0.1 and len(found[0]) == 301
    np.testing.assert_allclose(found[0].gap, gap_of("NGSIM pairs", 1), atol=0.1)


def test_time_is_split_for_every_driver(tmp_path):
    found, _ = segments(read_recording(pairs_file(tmp_path)))
    first, second = split_in_time(found, 0.6)
    assert [len(part) for part in first] == [180, 180]
    assert [len(part) for part in second] == [121, 121]
    np.testing.assert_array_equal(np.concatenate([first[1].gap, second[1].gap]), found[1].gap)
    assert second[0].time == pytest.approx(found[0].time + 18.0)


@needs_shared
def test_the_recordings_at_hand():
    expected = {
        "ngsim_i80_0400_pairs.csv.gz": (94, 94, 2),
        "tgsim_pairs_runs01_11.csv.gz": (35, 23, 0),
        "openacc_zalazone_short_dynamic_part20.csv.gz": (9, 9, 0),
        "openacc_zalazone_no_ACC_handling_part22.csv.gz": (10, 5, 1),
    }
    found = []
    for name, (count, drivers, defects) in expected.items():
        recording = read_recording(TRAJECTORIES / name)
        found, quality = segments(recording)
        assert (len(found), quality.drivers, len(recording.defects)) == (count, drivers, defects), name
        assert min(segment.gap.min() for segment in found) > 0
        assert quality.speed_rms < 0.3
    # The weak receiver that the data's own notes name: vehicle 7, in spacings 6 and 7.
    assert {segment.driver for segment in found}.isdisjoint({"BMW_I3", "AUDI_E_TRON"})


@needs_shared
def test_scenes_give_the_leaders_of_their_lanes():
    path = TRAJECTORIES / "commonroad" / "USA_US101-15_1_T-1.xml.gz"
    recording = read_recording(path)
    found, _ = segments(recording, shortest=6.0)
    assert len(found) > 10
    assert min(segment.gap.min() for segment in found) > 1.5
    assert Path(recording.source) == path
