"""Orbit and attitude ephemeris messages against the motion that they are written from."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.scenes.build import build
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.rig import TargetSphere, plan
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.scenefile import read_scene, scene_text
from spacesim.scenes.trajectory.ccsds import motion_of, read_message
from spacesim.scenes.trajectory.ephemeris import J2000_FRAMES, sun_direction
from spacesim.scenes.trajectory.epochs import read_epochs
from spacesim.scenes.trajectory.rig import FileRig

META = {
    "OBJECT_NAME": "A",
    "OBJECT_ID": "2030-001A",
    "CENTER_NAME": "EARTH",
    "REF_FRAME": "EME2000",
    "TIME_SYSTEM": "UTC",
    "START_TIME": "2030-03-01T12:00:00",
    "STOP_TIME": "2030-03-01T12:10:00",
}
AEM = {
    "REF_FRAME_A": "EME2000",
    "REF_FRAME_B": "SC_BODY_1",
    "ATTITUDE_DIR": "A2B",
    "TIME_SYSTEM": "UTC",
    "ATTITUDE_TYPE": "QUATERNION",
    "QUATERNION_TYPE": "LAST",
}
N = 1.1e-3  # radians a second of the orbit


def epoch(t):
    return f"2030-03-01T12:{int(t) // 60:02d}:{t % 60:09.6f}"


def orbit(t, ahead=0.0):
    """(position, velocity), km and km/s."""
    a = N * t + ahead
    place, ahead = np.array([np.cos(a), np.sin(a), 0.3]), np.array([-np.sin(a), np.cos(a), 0])
    return 7000 * place, 7000 * N * ahead


def attitude(t):
    """world_from_body"""
    return Rotation.from_rotvec([0.01 * t, 0.0, 0.0]) * Rotation.from_euler("z", 0.4)


def kvn(kind, meta, lines, version="2.0"):
    said = "\n".join(f"{key} = {value}" for key, value in meta.items())
    text = f"META_START\nCOMMENT of a test\n{said}\nMETA_STOP\n"
    return f"CCSDS_{kind}_VERS = {version}\nCREATION_DATE = 2030-01-01T00:00:00\nORIGINATOR = T\n\n{text}\n{lines}\n"


def oem(path, times, ahead=0.0, **meta):
    lines = [f"{epoch(t)} {' '.join(repr(float(x)) for x in np.concatenate(orbit(t, ahead)))}" for t in times]
    covariance = "COVARIANCE_START\nEPOCH = 2030-03-01T12:00:00\n1 2 3\nCOVARIANCE_STOP"
    path.write_text(kvn("OEM", {**META, **meta}, "\n".join([*lines, covariance])))
    return path


def aem(path, times, first=False, version="1.0", **meta):
    def line(t):
        q = attitude(t).as_quat()
        return f"{epoch(t)} {' '.join(repr(float(x)) for x in (np.roll(q, 1) if first else q))}"

    path.write_text(kvn("AEM", {**AEM, **meta}, "\n".join(map(line, times)), version))
    return path


TIMES = range(0, 541, 60)


def test_a_chase_of_two_spacecraft(tmp_path):
    """Positions between epochs within 2 m in 7,000 km, relative ones far better; Earth and Sun are known."""
    oem(tmp_path / "chaser.oem", TIMES, ahead=-2e-6)
    oem(tmp_path / "target.oem", TIMES)
    aem(tmp_path / "chaser.aem", TIMES)
    aem(tmp_path / "target.aem", range(0, 601, 30))
    scene = tmp_path / "s.toml"
    scene.write_text(
        '[[objects]]\nspacecraft = "boxsat"\n[rig]\nkind = "file"\nviews = 19\n'
        'camera = ["chaser.oem", "chaser.aem"]\ntarget = ["target.oem", "target.aem"]\n'
    )
    config = read_scene(scene)
    train, _ = plan_views(build(config), config)
    assert len(train) == 19
    for k, (_, view) in enumerate(train):
        t = 30.0 * k
        assert view.epoch == f"{epoch(t)}"
        turn = attitude(t)
        place = turn.inv().apply(1e3 * (orbit(t, -2e-6)[0] - orbit(t)[0]))
        np.testing.assert_allclose(view.camera.position, place, atol=1e-4)
        np.testing.assert_allclose(view.camera.world_from_camera[:3, :3], np.eye(3), atol=1e-9)  # both turn alike
        np.testing.assert_allclose(view.earth, turn.inv().apply(-1e3 * orbit(t)[0]), atol=0.5)
        sun = turn.inv().apply(sun_direction(*read_epochs([epoch(t)], "t"))[0])
        np.testing.assert_allclose(view.sun.direction, sun, atol=1e-6)
    assert config.to_json()["rig"]["camera"] == ["chaser.oem", "chaser.aem"]


def test_quaternions_in_every_way_that_they_are_written(tmp_path):
    """Body axes that are those of the frame, turned by 30 degrees about z: the columns of world_from_body."""
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    swapped = {"REF_FRAME_A": "SC_BODY_1", "REF_FRAME_B": "EME2000"}
    ways = [
        ({}, (0, 0, s, c)),
        ({"QUATERNION_TYPE": "FIRST"}, (c, 0, 0, s)),
        ({"ATTITUDE_DIR": "B2A"}, (0, 0, -s, c)),
        (swapped, (0, 0, -s, c)),
        ({**swapped, "ATTITUDE_DIR": "B2A"}, (0, 0, s, c)),
        ({"ATTITUDE_TYPE": "QUATERNION/RATE"}, (0, 0, s, c, 9, 9, 9)),
    ]
    half = np.sqrt(0.75)
    for number, (changes, q) in enumerate(ways):
        path = tmp_path / f"{number}.aem"
        path.write_text(kvn("AEM", {**AEM, **changes}, f"2030-060T12:00:00 {' '.join(map(str, q))}", "1.0"))
        motion = motion_of({"camera": [path]}, with_sun=False)
        turn = motion.camera_turn.at(motion.times())[0]
        np.testing.assert_allclose(turn, [[half, -0.5, 0], [0.5, half, 0], [0, 0, 1]], atol=1e-12)
    second = {key: value for key, value in AEM.items() if key not in ("ATTITUDE_DIR", "QUATERNION_TYPE")}
    lines = f"DATA_START\n2030-060T12:00:00 0 0 {s} {c}\nDATA_STOP"
    (tmp_path / "2.aem").write_text(kvn("AEM", second, lines, "2.0"))
    again = motion_of({"camera": [tmp_path / "2.aem"]}, with_sun=False)
    np.testing.assert_allclose(again.camera_turn.at(again.times())[0], turn, atol=1e-12)


@pytest.mark.parametrize(
    ("write", "meta", "warning"),
    [
        (oem, {}, None),
        (oem, {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "3"}, None),
        (oem, {"INTERPOLATION": "Lagrange", "INTERPOLATION_DEGREE": "7"}, "LAGRANGE of degree 7 .* cubic by their"),
        (oem, {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "5"}, "HERMITE of degree 5 .* cubic by their"),
        (aem, {"INTERPOLATION_METHOD": "LINEAR", "INTERPOLATION_DEGREE": "1"}, None),
        (aem, {"INTERPOLATION_METHOD": "HERMITE", "INTERPOLATION_DEGREE": "7"}, "HERMITE of degree 7 .* slerped"),
    ],
)
def test_another_interpolation_than_ours_is_warned_of_once(tmp_path, caplog, write, meta, warning):
    one, other = write(tmp_path / "1", TIMES, **meta), write(tmp_path / "2", range(540, 601, 60), **meta)
    (tmp_path / "two").write_text(one.read_text() + other.read_text().partition("\n\n")[2])
    read_message(tmp_path / "two")
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == (warning is not None)
    assert warning is None or re.search(f"^{tmp_path}/two: asks for {warning}", lines[0])


def test_a_message_that_was_cut_off_is_warned_of(tmp_path, caplog):
    whole = oem(tmp_path / "whole.oem", range(0, 601, 60))
    read_message(whole)
    assert not caplog.records
    (tmp_path / "cut.oem").write_text(whole.read_text().partition(epoch(540))[0])
    assert len(read_message(tmp_path / "cut.oem").times) == 9
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.endswith("cut.oem: its data end 120.000 s before its STOP_TIME, 2030-03-01T12:10:00; is it whole?")


def test_errors_name_the_line_of_a_later_segment(tmp_path):
    one, two = aem(tmp_path / "1", range(0, 121, 60)), aem(tmp_path / "2", range(120, 301, 60))
    text = one.read_text() + two.read_text().partition("\n\n")[2]
    wrong = text.replace(f"{epoch(240)} ", f"{epoch(240)} 9")
    (tmp_path / "a.aem").write_text(wrong)
    line = next(k for k, line in enumerate(wrong.splitlines(), start=1) if line.startswith(epoch(240)))
    with pytest.raises(InputError, match=f"a.aem: expected quaternions of length 1, found one of .* in line {line}$"):
        motion_of({"camera": [tmp_path / "a.aem"]}, with_sun=False)


def test_segments_that_meet(tmp_path):
    one, two = oem(tmp_path / "1", range(0, 121, 60)), oem(tmp_path / "2", range(120, 301, 60))
    both = tmp_path / "both.oem"
    both.write_text(one.read_text() + two.read_text().partition("\n\n")[2])
    whole = read_message(oem(tmp_path / "whole.oem", range(0, 301, 60)))
    found = read_message(both)
    np.testing.assert_array_equal(found.times, whole.times)
    np.testing.assert_array_equal(found.values, whole.values)
    for first, how in ((180, "leave a gap"), (60, "overlap")):
        apart = oem(tmp_path / "3", range(first, 301, 60))
        both.write_text(one.read_text() + apart.read_text().partition("\n\n")[2])
        with pytest.raises(InputError, match=f"begins where the last one ends, found two that {how}"):
            read_message(both)


def test_xml_tells_the_same_as_kvn(tmp_path):
    def elements(values):
        return "".join(f"<{key}>{value}</{key}>" for key, value in values.items())

    for path, names, state in (
        (oem(tmp_path / "a.oem", TIMES), ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"), "{}"),
        (aem(tmp_path / "a.aem", TIMES), ("Q1", "Q2", "Q3", "QC"), "<quaternionEphemeris>{}</quaternionEphemeris>"),
    ):
        kind, meta = path.suffix[1:], META if path.suffix == ".oem" else AEM
        tag = "stateVector" if kind == "oem" else "attitudeState"
        lines = [line.split() for line in path.read_text().splitlines() if line.startswith("2030")]
        lines = [line for line in lines if len(line) > 4]
        states = [state.format(elements(dict(zip(("EPOCH", *names), line, strict=True)))) for line in lines]
        data = "".join(f"<{tag}>{one}</{tag}>" for one in states)
        segment = f"<segment><metadata>{elements(meta)}</metadata><data>{data}</data></segment>"
        xml = path.with_suffix(".xml")
        xml.write_text(
            f'<?xml version="1.0"?><!-- of a test --><ndm xmlns="urn:ccsds"><{kind} id="CCSDS_{kind.upper()}_VERS" '
            f'version="2.0"><header/><body>{segment}</body></{kind}></ndm>'
        )
        one, other = read_message(path), read_message(xml)
        np.testing.assert_array_equal(other.values, one.values)
        np.testing.assert_array_equal(other.times, one.times)
        assert (other.kind, other.frame, other.day, other.center) == (one.kind, one.frame, one.day, one.center)


def test_damaged_files_end_in_a_sentence(tmp_path):
    """Bytes changed, cut out and put in at random, of messages and of a table."""
    table = tmp_path / "a.csv"
    table.write_text("time_s,camera_x_m,camera_y_m,camera_z_m,sun_x,sun_y,sun_z\n0,1,2,3,1,1,1\n1,2,2,3,0,1,1\n")
    random = np.random.default_rng(3)
    pieces = [b"nan", b"1e999", b",", b"\n", b"-", b'"', b"\0", b"9" * 40, b"\xff"]
    ended = []
    for path in (oem(tmp_path / "a.oem", TIMES), aem(tmp_path / "a.aem", TIMES), table):
        whole = path.read_bytes()
        for number in range(150):
            at = int(random.integers(len(whole)))
            cut = int(random.integers(0, 4))
            damaged = tmp_path / f"damaged{path.suffix}"
            damaged.write_bytes(whole[:at] + pieces[number % len(pieces)] + whole[at + cut :])
            rig = FileRig(path=str(damaged)) if path == table else FileRig(camera=(str(damaged),), sun=((45.0, 35.0),))
            try:
                plan(rig, TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16)), 0)
            except InputError as error:
                ended.append(str(error))
    assert 200 < len(ended) < 450
    assert [one for one in ended if "\n" in one] == []


def test_the_documented_scene_file_is_one(tmp_path):
    text = (Path(__file__).parents[3] / "docs/how-to/trajectory.md").read_text(encoding="utf-8")
    (scene,) = re.findall(r'^```toml title="chase.toml"\n(.*?)^```', text, re.MULTILINE | re.DOTALL)
    (tmp_path / "chase.toml").write_text(scene, encoding="utf-8")
    for name in ("chaser", "target"):
        oem(tmp_path / f"{name}.oem", TIMES, 2e-6 * (name == "chaser"))
        aem(tmp_path / f"{name}.aem", TIMES)
    config = read_scene(tmp_path / "chase.toml")
    assert len(plan_views(build(config), config)[0]) == len(TIMES)
    written = tmp_path / "again.toml"
    written.write_text(scene_text(config), encoding="utf-8")
    again = read_scene(written)
    assert len(plan_views(build(again), again)[0]) == len(TIMES)


def test_the_sun_against_the_almanacs_formula():
    """Its low precision formula (0.01 degrees) is of the equinox of date: precessed in longitude."""
    for year in (1990, 2010, 2030, 2049):
        for day in (1, 80, 172, 300):
            ordinal, seconds = read_epochs([f"{year}-{day:03d}T06:00:00"], "t")
            n = ordinal + seconds[0] / 86400 - 730120.5  # days since noon of 2000-01-01, proleptic ordinal 730120
            anomaly = np.radians(357.528 + 0.9856003 * n)
            longitude = 280.460 + 0.9856474 * n + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
            longitude = np.radians(longitude - 1.39697 * n / 36525)
            e = np.radians(23.439)
            sun = [np.cos(longitude), np.cos(e) * np.sin(longitude), np.sin(e) * np.sin(longitude)]
            found = sun_direction(ordinal, seconds)[0]
            assert np.degrees(np.linalg.norm(np.cross(found, sun))) < 0.025
            assert found @ sun > 0


def test_a_sun_of_ones_own_takes_the_place(tmp_path):
    path = oem(tmp_path / "a.oem", TIMES)
    table = tmp_path / "sun.csv"
    table.write_text(f"time_utc,sun_x,sun_y,sun_z\n{epoch(0)},1,0,0\n{epoch(540)},1,0,0\n")
    target, camera = TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16))
    rig = FileRig(camera=(str(path),), target=(str(oem(tmp_path / "b.oem", TIMES, 1e-6)),), path=str(table))
    assert {tuple(view.sun.direction) for view in plan(rig, target, camera, 0)[0]} == {(1, 0, 0)}
    rig = FileRig(camera=rig.camera, target=rig.target, sun=((90.0, 0.0),))
    np.testing.assert_allclose(plan(rig, target, camera, 0)[0][0].sun.direction, [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("meta", "found"),
    [
        ({"REF_FRAME": "TEME"}, "about EARTH in TEME"),
        ({"REF_FRAME": "ITRF"}, "about EARTH in ITRF"),
        ({"CENTER_NAME": "MARS"}, "about MARS in EME2000"),
    ],
)
def test_a_sun_that_cannot_be_computed_is_asked_for(tmp_path, meta, found):
    """Of other axes, other bodies and attitudes alone; with a Sun given they work."""
    target, camera = TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16))
    rig = FileRig(camera=(str(oem(tmp_path / "a.oem", TIMES, **meta)),))
    expected = (
        "expected a sun of the rig, or a table with a Sun, as it is computed for an orbit about EARTH in EME2000, "
    )
    with pytest.raises(InputError, match=f"a.oem: {expected}.* only, found an orbit {found}$"):
        plan(rig, target, camera, 0)
    view = plan(replace(rig, sun=((90.0, 0.0),)), target, camera, 0)[0][0]
    np.testing.assert_allclose(view.sun.direction, [0, 1, 0], atol=1e-12)
    assert (view.earth is None) == ("CENTER_NAME" in meta)
    alone = FileRig(camera=(str(aem(tmp_path / "a.aem", TIMES)),))
    with pytest.raises(InputError, match=rf"a.aem: {expected}.* only, found attitudes alone$"):
        plan(alone, target, camera, 0)


@pytest.mark.parametrize("frame", J2000_FRAMES)
def test_frames_whose_sun_is_computed_are_documented(tmp_path, frame):
    rig = FileRig(camera=(str(oem(tmp_path / "a.oem", TIMES, REF_FRAME=frame)),))
    view = plan(rig, TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16)), 0)[0][0]
    np.testing.assert_allclose(view.sun.direction, sun_direction(*read_epochs([epoch(0)], "t"))[0], atol=1e-12)
    assert frame in (Path(__file__).parents[3] / "docs/how-to/trajectory.md").read_text(encoding="utf-8")


def test_a_table_beside_messages_of_another_time_system(tmp_path):
    """UTC and TDB are 69 s apart: never taken for each other, whichever body either tells."""
    table = tmp_path / "camera.csv"
    table.write_text(f"time_utc,camera_x_m,camera_y_m,camera_z_m\n{epoch(0)},1,0,0\n{epoch(540)},1,0,0\n")
    target, camera = TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16))
    for system in ("TDB", "TAI"):
        rig = FileRig(path=str(table), target=(str(oem(tmp_path / "t.oem", TIMES, TIME_SYSTEM=system)),))
        with pytest.raises(InputError, match=f"rig: expected one time system in all of its files .* UTC and {system}"):
            plan(rig, target, camera, 0)
    oem(tmp_path / "t.oem", TIMES)
    assert len(plan(rig, target, camera, 0)[0]) == 2
    both = FileRig(
        camera=(str(oem(tmp_path / "c.oem", TIMES, TIME_SYSTEM="TDB")),),
        target=(str(oem(tmp_path / "t.oem", TIMES, 1e-6, TIME_SYSTEM="TDB")),),
    )
    assert len(plan(both, target, camera, 0)[0]) == len(TIMES)  # Earth and Sun in their system too


def test_messages_that_do_not_fit(tmp_path):
    first = oem(tmp_path / "a.oem", TIMES)

    def refused(message, *others, body="target", **meta):
        with pytest.raises(InputError, match=message):
            motion_of({"camera": [first], body: others})

    refused(
        "b.oem: expected the frame EME2000, as in .*a.oem, found TEME", oem(tmp_path / "b.oem", TIMES, REF_FRAME="TEME")
    )
    refused("b.oem: expected the time system UTC, .* found TDB", oem(tmp_path / "b.oem", TIMES, TIME_SYSTEM="TDB"))
    refused("b.oem: expected the center EARTH, .* found MOON", oem(tmp_path / "b.oem", TIMES, CENTER_NAME="MOON"))
    refused("b.aem: expected the frame EME2000, .* found LVLH", aem(tmp_path / "b.aem", TIMES, REF_FRAME_A="LVLH"))
    with pytest.raises(InputError, match=r"expected one source of each track, found .*a.oem and .*c.oem"):
        motion_of({"camera": [first, oem(tmp_path / "c.oem", TIMES)]})
    late = oem(tmp_path / "b.oem", [59 * 60])
    with pytest.raises(InputError, match=r"found that .*a.oem ends before .*b.oem"):
        motion_of({"camera": [first], "target": [late]}).times()
    icrf = aem(tmp_path / "i.aem", TIMES, REF_FRAME_A="ICRF")  # the same axes
    assert motion_of({"camera": [first, icrf]}).camera_turn is not None


def test_a_message_of_a_place_that_nothing_has(tmp_path):
    path = oem(tmp_path / "a.oem", TIMES)
    path.write_text(path.read_text().replace(" 0.0 ", " 1e300 ", 1))
    with pytest.raises(InputError, match=r"a.oem: expected up to 1e\+15 m along an axis, found .*1e\+303.* in line 16"):
        motion_of({"camera": [path]})


LINE = "2030-03-01T12:00:00 0 0 0 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected CCSDS_OEM_VERS or CCSDS_AEM_VERS, found neither"),
        ("<?xml version='1.0'?><oem/>", "expected metadata and data in every segment, at least one, found none"),
        ("<?xml version='1.0'?><opm/>", "expected one OEM or AEM in XML, found 0"),
        ("<oem>", "expected XML, found text that breaks off"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><oem>&b;</oem>", "expected XML without declarations of its own"),
        ("CCSDS_OPM_VERS = 2.0", "found CCSDS_OPM_VERS = 2.0"),
        ("CCSDS_AEM_VERS = 1.0", "expected metadata and data in every segment, at least one, found none"),
        (kvn("AEM", AEM, ""), "expected metadata and data in every segment"),
        (kvn("OEM", {"CENTER_NAME": "EARTH"}, LINE), "REF_FRAME: expected it in the metadata of every segment"),
        (
            kvn("AEM", {**AEM, "ATTITUDE_TYPE": "SPIN"}, LINE),
            "ATTITUDE_TYPE: expected one of .* found SPIN",
        ),
        (
            kvn("AEM", {**AEM, "ATTITUDE_TYPE": "EULER_ANGLE"}, "2030-03-01T12:00:00 10 20 30"),
            "ATTITUDE_TYPE: expected one of QUATERNION, .* found EULER_ANGLE",
        ),
        (
            "<aem><segment><metadata><REF_FRAME_A>ICRF</REF_FRAME_A><REF_FRAME_B>SC_BODY_1</REF_FRAME_B><TIME_SYSTEM>UTC"
            "</TIME_SYSTEM><ATTITUDE_TYPE>euler_angle</ATTITUDE_TYPE></metadata><data><attitudeState><eulerAngle><EPOCH>"
            "2030-03-01T12:00:00</EPOCH><ANGLE_1>1</ANGLE_1></eulerAngle></attitudeState></data></segment></aem>",
            "ATTITUDE_TYPE: expected one of QUATERNION, .* found EULER_ANGLE",
        ),
        (kvn("AEM", {**AEM, "ATTITUDE_DIR": "C2D"}, LINE), "ATTITUDE_DIR: expected A2B or B2A, found C2D"),
        (kvn("AEM", AEM, LINE[:-1]), "expected an epoch and 4 numbers, found '2030-03-01T12:00:00 0 0 0' in line 15"),
        (kvn("AEM", AEM, LINE.replace(" 1", " x")), "expected numbers in line 15, found another word .*'x'"),
        (kvn("AEM", AEM, LINE.replace("12:", "24:")), "epoch: expected an epoch such as .* in line 15"),
        (kvn("AEM", AEM, LINE.replace(" 1", " 2")), "expected quaternions of length 1, found one of 2 in line 15"),
        (kvn("AEM", AEM, f"{LINE}\n\n{LINE}"), "times that grow, found in line 17 one that repeats that of line 15"),
        (kvn("AEM", AEM, f"{LINE}\n{LINE.replace('12:', '11:')}"), "found in line 16 one that is before line 15"),
        (kvn("AEM", AEM, LINE.replace(" 1", " nan")), "expected quaternions of length 1, found one of nan in line 15"),
    ],
)
def test_files_that_are_no_message_are_refused(tmp_path, text, message):
    path = tmp_path / "a.msg"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        motion_of({"camera": [path]})
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
