"""Rigs of SPICE kernels that are written here, against spiceypy's own answers."""

import json
import sys

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.transforms import read_dataset
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.rig import TargetSphere, plan
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.trajectory.spice import SpiceRig

spice = pytest.importorskip("spiceypy", reason="spiceypy is not installed")

LSK = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 36, @2015-JUL-1  37, @2017-JAN-1 )
\\begintext
"""
FK = """KPL/FK
\\begindata
NAIF_BODY_NAME += ( 'CHASER' 'TARGET' )
NAIF_BODY_CODE += ( -1000 -2000 )
FRAME_TARGET_BODY = -2000000
FRAME_-2000000_NAME = 'TARGET_BODY'
FRAME_-2000000_CLASS = 3
FRAME_-2000000_CLASS_ID = -2000000
FRAME_-2000000_CENTER = -2000
CK_-2000000_SCLK = -2000
CK_-2000000_SPK = -2000
FRAME_CHASER_CAM = -1000100
FRAME_-1000100_NAME = 'CHASER_CAM'
FRAME_-1000100_CLASS = 4
FRAME_-1000100_CLASS_ID = -1000100
FRAME_-1000100_CENTER = -1000
TKFRAME_-1000100_RELATIVE = 'J2000'
TKFRAME_-1000100_SPEC = 'ANGLES'
TKFRAME_-1000100_UNITS = 'DEGREES'
TKFRAME_-1000100_AXES = ( 3 1 3 )
TKFRAME_-1000100_ANGLES = ( 10 20 30 )
\\begintext
"""
SCLK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2030-01-01 )
SCLK_DATA_TYPE_2000 = ( 1 )
SCLK01_TIME_SYSTEM_2000 = ( 1 )
SCLK01_N_FIELDS_2000 = ( 2 )
SCLK01_MODULI_2000 = ( 4294967296 1000 )
SCLK01_OFFSETS_2000 = ( 0 0 )
SCLK01_OUTPUT_DELIM_2000 = ( 1 )
SCLK_PARTITION_START_2000 = ( 0 )
SCLK_PARTITION_END_2000 = ( 4.0E12 )
SCLK01_COEFFICIENTS_2000 = ( 0 9.0E8 1 )
\\begintext
"""
START, STOP = "2030-03-01T12:00:00", "2030-03-01T12:10:00"
N = 1.1e-3


@pytest.fixture(autouse=True)
def unloaded():
    yield
    spice.kclear()


def states(times, ahead, height=7000.0):
    """[N, 6] km, km/s of a circular orbit about the Earth."""
    a = N * (times - times[0]) + ahead
    place = height * np.stack([np.cos(a), np.sin(a), 0 * a], axis=1)
    return np.concatenate([place, height * N * np.stack([-np.sin(a), np.cos(a), 0 * a], axis=1)], axis=1)


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    """Names of all kernels, in one folder."""
    root = tmp_path_factory.mktemp("kernels")
    for name, text in {"a.tls": LSK, "b.tf": FK, "c.tsc": SCLK}.items():
        (root / name).write_text(text)
        spice.furnsh(str(root / name))
    first, last = spice.str2et(START), spice.str2et(STOP)
    times = np.linspace(first, last, 41)
    handle = spice.spkopn(str(root / "d.bsp"), "test", 0)
    spice.spkw13(handle, -2000, 399, "J2000", first, last, "target", 7, len(times), states(times, 0.0), times)
    spice.spkw13(handle, -1000, 399, "J2000", first, last, "chaser", 7, len(times), states(times, -3e-6), times)
    sun = np.tile([1.2e8, -8e7, 3e7, 0, 0, 0], (len(times), 1))
    spice.spkw09(handle, 10, 399, "J2000", first, last, "sun", 3, len(times), sun, times)
    spice.spkcls(handle)
    ticks = np.array([spice.sce2c(-2000, et) for et in times])
    turns = [spice.rotate(0.002 * (et - first), 1) @ spice.rotate(0.5, 3) for et in times]
    quaternions = np.array([spice.m2q(turn) for turn in turns])
    handle = spice.ckopn(str(root / "e.bc"), "test", 0)
    rates = np.zeros((len(times), 3))
    spice.ckw03(
        handle,
        ticks[0],
        ticks[-1],
        -2000000,
        "J2000",
        False,
        "target",
        len(ticks),
        ticks,
        quaternions,
        rates,
        1,
        ticks[:1],
    )
    spice.ckcls(handle)
    spice.kclear()
    return tuple(str(root / name) for name in ("a.tls", "b.tf", "c.tsc", "d.bsp", "e.bc"))


def rig(kernels, **options):
    defaults = {"start": START, "stop": STOP, "camera": "CHASER", "target": "TARGET", "views": 7}
    return SpiceRig(kernels=kernels, **{**defaults, **options})


TARGET, CAMERA = TargetSphere(np.zeros(3), 1.0), CameraConfig((16, 16))


@pytest.mark.parametrize("frame", ["J2000", "ECLIPJ2000", "CHASER_CAM"])
def test_states_are_spices_own(kernels, frame):
    names = {"camera_frame": "CHASER_CAM", "target_frame": "TARGET_BODY", "frame": frame}
    train, test = plan(rig(kernels, **names, test_views=3), TARGET, CAMERA, 0)
    assert (len(train), len(test)) == (7, 3)
    for kernel in kernels:
        spice.furnsh(kernel)
    first = spice.str2et(START)
    assert [view.epoch for view in train[:2]] == ["2030-03-01T12:00:00.000000", "2030-03-01T12:01:40.000000"]
    for view in train + test:
        et = first + view.time - train[0].time
        assert spice.et2utc(et, "ISOC", 6) == view.epoch
        place, _ = spice.spkpos("CHASER", et, "TARGET_BODY", "NONE", "TARGET")
        np.testing.assert_allclose(view.camera.position, 1e3 * place, atol=1e-5)
        turn = spice.pxform("CHASER_CAM", "TARGET_BODY", et)
        np.testing.assert_allclose(view.camera.world_from_camera[:3, :3], turn, atol=1e-9)
        sun, _ = spice.spkpos("SUN", et, "TARGET_BODY", "NONE", "TARGET")
        np.testing.assert_allclose(view.sun.direction, sun / np.linalg.norm(sun), atol=1e-12)
        earth, _ = spice.spkpos("EARTH", et, "TARGET_BODY", "NONE", "TARGET")
        np.testing.assert_allclose(view.earth, 1e3 * earth, atol=1e-6)
        np.testing.assert_allclose(view.sky_from_world, spice.pxform("TARGET_BODY", frame, et), atol=1e-9)
    spice.kclear()


def test_kernels_of_the_caller_stay_loaded(kernels):
    spice.furnsh(kernels[0])
    plan(rig(kernels), TARGET, CAMERA, 0)
    assert spice.ktotal("ALL") == 1
    with pytest.raises(InputError):
        plan(rig(kernels, camera="NOBODY"), TARGET, CAMERA, 0)
    assert spice.ktotal("ALL") == 1
    spice.kclear()


def test_without_an_attitude_the_camera_looks_at_the_target(kernels):
    for view in plan(rig(kernels), TARGET, CAMERA, 0)[0]:
        x, y, z = (view.camera.camera_from_world @ [0, 0, 0, 1])[:3]
        assert max(abs(x), abs(y)) < 1e-9
        assert z == pytest.approx(21.0, abs=0.1)  # 3e-6 of 7,000 km
    sun = plan(rig(kernels[:2] + kernels[3:4], sun=((90.0, 0.0),)), TARGET, CAMERA, 0)[0][0].sun
    np.testing.assert_allclose(sun.direction, [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"stop": "2030-03-01T12:11:00"},
            r"camera: expected kernels that contain it, found SPICE\(SPKINSUFFDATA\)",
        ),
        ({"start": "2030-03-01T11:59:00", "camera": "SUN"}, r"camera: .*SPICE\(SPKINSUFFDATA\)"),
        ({"camera": "NOBODY"}, r"camera: .* found SPICE\(IDCODENOTFOUND\): The target, 'NOBODY'"),
        ({"camera_frame": "NONE_SUCH"}, r"camera_frame: .* found SPICE\(UNKNOWNFRAME\)"),
        ({"frame": "NONE_SUCH"}, r"camera: .* SPICE\(UNKNOWNFRAME\)"),
        ({"start": "yesterday"}, "start: expected kernels that contain it, found SPICE"),
        ({"start": STOP, "stop": START}, "stop: expected an epoch after start"),
    ],
)
def test_what_kernels_do_not_tell(kernels, options, message):
    with pytest.raises(InputError, match=message) as caught:
        plan(rig(kernels, **options), TARGET, CAMERA, 0)
    assert "\n" not in str(caught.value)
    assert spice.ktotal("ALL") == 0


def test_an_earth_that_is_not_covered(kernels, tmp_path):
    """Without it there are no eclipses, so it is not left out where kernels tell it for a part of the time."""
    for kernel in kernels[:2]:
        spice.furnsh(kernel)
    first, last = spice.str2et(START), spice.str2et(STOP)
    spice.kclear()
    name = str(tmp_path / "f.bsp")
    handle = spice.spkopn(name, "test", 0)
    for body, begin, end, ahead in ((-2000, first, last, 0), (-1000, first, last, 1e-9), (399, first + 60, last, 1e-5)):
        times = np.linspace(begin, end, 41)
        orbit = states(times, ahead, height=1.5e8)
        spice.spkw13(handle, body, 10, "J2000", begin, end, "test", 7, len(times), orbit, times)
    spice.spkcls(handle)
    with pytest.raises(InputError, match=r"earth: expected kernels that contain it, found SPICE\(SPKINSUFFDATA\)"):
        plan(rig((*kernels[:2], name)), TARGET, CAMERA, 0)
    covered = plan(rig((*kernels[:2], name), start="2030-03-01T12:02:00"), TARGET, CAMERA, 0)[0]
    assert all(view.earth is not None for view in covered)


def test_an_attitude_that_is_not_covered(kernels):
    without = tuple(kernel for kernel in kernels if not kernel.endswith(".bc"))
    with pytest.raises(InputError, match=r"target_frame: .* found SPICE\(NOFRAMECONNECT\)"):
        plan(rig(without, target_frame="TARGET_BODY"), TARGET, CAMERA, 0)


def test_files_that_are_no_kernels(kernels, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"none.bsp: expected a SPICE kernel, found none"):
        plan(rig((*kernels, str(tmp_path / "none.bsp"))), TARGET, CAMERA, 0)
    (tmp_path / "bad.bsp").write_bytes(b"DAF/SPK " + bytes(3000))
    with pytest.raises(InputError, match=r"kernels: .*bad.bsp: expected kernels that contain it, found SPICE"):
        plan(rig((*kernels, str(tmp_path / "bad.bsp"))), TARGET, CAMERA, 0)
    with pytest.raises(InputError, match="kernels: expected names of files, found "):
        SpiceRig(start=START, stop=STOP, camera="A", target="B")
    with pytest.raises(InputError, match="camera: expected a name, found ''"):
        rig(kernels, camera="")
    with pytest.raises(InputError, match="start: expected an epoch, found ''"):
        rig(kernels, start="")
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(InputError, match=r"kernels: expected the package spiceypy, .* pip install 'spacesim\[spice\]'"):
        plan(rig(kernels), TARGET, CAMERA, 0)


def test_a_dataset_of_kernels(kernels, tmp_path):
    scene = tmp_path / "s.toml"
    scene.write_text(
        '[[objects]]\nspacecraft = "boxsat"\n[rig]\nkind = "spice"\nviews = 2\n'
        f'kernels = {json.dumps(kernels)}\nstart = "{START}"\nstop = "{STOP}"\n'
        'camera = "CHASER"\ntarget = "TARGET"\ntarget_frame = "TARGET_BODY"\n'
    )
    generate(read_scene(scene, resolution=16, spp=1, points=50), tmp_path / "data")
    frames = json.loads((tmp_path / "data/transforms.json").read_text())["frames"]
    assert [frame["epoch"] for frame in frames] == ["2030-03-01T12:00:00.000000", "2030-03-01T12:10:00.000000"]
    assert [frame["sun_visibility"] for frame in frames] == [1.0, 1.0]
    assert len(read_dataset(tmp_path / "data").train) == 2
    scene = json.loads((tmp_path / "data/scene.json").read_text())
    names = [file["name"] for file in scene["files"]]
    assert names == scene["config"]["rig"]["kernels"] == ["a.tls", "b.tf", "c.tsc", "d.bsp", "e.bc"]
