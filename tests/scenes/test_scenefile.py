"""Scene files: lines of keys, values to dataclasses and back, what is refused and how, the page that describes them."""

import ast
import importlib.util
import random
import re
import warnings
from dataclasses import MISSING, fields, replace
from pathlib import Path
from types import NoneType
from typing import get_args, get_origin, get_type_hints

import numpy as np
import pytest

from spacesim.data import toml
from spacesim.data.errors import InputError
from spacesim.data.structure import keys_of
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.build import build
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.rig import RigConfig
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.config import MaterialConfig, ObjectConfig, QualityConfig, SceneConfig
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.rigs import RIGS
from spacesim.scenes.scenefile import BUILT_IN_SCENES, RULES, SCENES, read_scene, scene_text

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "reference" / "scene-files.md").read_text(encoding="utf-8")

EVERYTHING = '''\
# every way to write a key
a = 1
"b c" . 'd"e' = """
two # no comment
lines""" # a comment
"\\u00e4" = [ 1, # one
  [2,
   "]"], { x = 1, y.z = '}' },
]
f = \'\'\'
[no.table]
g = 1\'\'\'\'
[ t . "u" ]
v.w = 1979-05-27 07:32:00
v.x = { deep = { deeper = [ [ ], { } ] } }
[[many]]
k = "\\\\"
[many.inner]
k = ""
[[many.list]]
k = 1
[[many.list]]
k = 2

[[many]]
k = -1e3
[[many.list]]
k = 3
'''
LINES = {
    ("a",): 2,
    ("b c", 'd"e'): 3,
    ("ä",): 6,
    ("ä", 0): 6,
    ("ä", 1): 7,
    ("ä", 1, 0): 7,
    ("ä", 1, 1): 8,
    ("ä", 2): 8,
    ("ä", 2, "x"): 8,
    ("ä", 2, "y", "z"): 8,
    ("f",): 10,
    ("t",): 13,
    ("t", "u"): 13,
    ("t", "u", "v"): 14,
    ("t", "u", "v", "x", "deep", "deeper", 1): 15,
    ("many",): 16,
    ("many", 0): 16,
    ("many", 0, "k"): 17,
    ("many", 0, "inner", "k"): 19,
    ("many", 0, "list", 1): 22,
    ("many", 0, "list", 1, "k"): 23,
    ("many", 1): 25,
    ("many", 1, "list", 0, "k"): 28,
}


def everywhere(value, at=()):
    """All places in plain values."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield (*at, key)
        yield from everywhere(one, (*at, key))


@pytest.fixture
def refusal(tmp_path):
    """What is said about a scene file with this text, after the path of the file."""

    def said(text, name="my.toml"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(InputError) as refused:
            read_scene(path)
        message = str(refused.value)
        assert message.startswith(str(path))
        assert "\n" not in message
        return message.removeprefix(str(path))

    return said


@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["LF", "CRLF"])
def test_lines_of_keys(end):
    document = toml.parse(EVERYTHING.replace("\n", end), "x")
    assert {keys: document.lines[keys] for keys in LINES} == LINES
    assert set(everywhere(document.values)) == set(document.lines)


@pytest.mark.parametrize("name", BUILT_IN_SCENES)
def test_lines_of_the_built_in_scenes(name):
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    document = toml.parse(text, name)
    assert set(everywhere(document.values)) == set(document.lines)
    rows = text.splitlines()
    assert all(str(keys[-1]) in rows[line - 1] for keys, line in document.lines.items() if isinstance(keys[-1], str))


def test_what_is_missing_is_placed_in_its_table():
    document = toml.parse("\n[a]\nb = 1\n", "x")
    places = [document.place(keys) for keys in [("a", "b"), ("a", "c", 3), ("d",), ()]]
    assert places == ["x, line 3", "x, line 2", "x", "x"]


def test_dumped_values_are_read_back():
    values = {
        "z": 1,
        "text": 'quotes " \\ \x7f \t é 🛰',
        "list": [1.5, 1e-300, -0.0, 1e22, [True, False], []],
        "table": {"a b": {"": 1}, "empty": {}},
        "only": {"tables": {"x": 1}},
        "many": [{"k": 1, "inner": {"k": 2}, "list": [{"k": 3}, {}]}, {}],
    }
    assert toml.parse(toml.dump(values), "x").values == values
    for impossible in (float("nan"), None, "\udc80"):
        with pytest.raises(InputError):
            toml.dump({"a": impossible})


def test_built_in_scenes():
    crafts = {"boxsat", "boxsat-pair", "telescope", "cubesat", "upper-stage", "small-body"}
    assert set(BUILT_IN_SCENES) == {*crafts, "speedplus"}
    assert read_scene("boxsat") == SceneConfig("boxsat", (ObjectConfig(spacecraft="boxsat"),))
    assert [one.position for one in read_scene("boxsat-pair").objects] == [(0, 0, 0), (-3, -3, -3)]
    telescope = read_scene("telescope")
    assert type(telescope.rig) is RIGS["polar-arc"]
    assert telescope.rig.suns == 24


@pytest.mark.parametrize("name", BUILT_IN_SCENES)
def test_a_printed_scene_is_the_same_scene(name, tmp_path):
    suns = None if name == "speedplus" else [(10, 20), (30, -40)]  # every frame of it has its own
    scene = read_scene(name, seed=3, sun=suns, views=5)
    (tmp_path / "printed.toml").write_text(scene_text(scene), encoding="utf-8")
    assert read_scene(tmp_path / "printed.toml") == scene


FULL = """
seed = 7

[[objects]]
spacecraft = "boxsat"
position = [1, 2.5, -3]
materials = { "panel_*" = "dull", bus = "white-paint" }

[[objects]]
mesh = "parts/any.stl"
name = "debris"
units = "mm"
up = "y"

[materials.dull]
preset = "solar-cell"
albedo = 0.05
roughness = 0.5

[sun]
shape = "directional"

[earth]

[rig]
kind = "random"
sun = [[10, 20], [30, -40]]
far = 50

[camera]
resolution = [320, 240]
distortion = [-0.1, 0, 0, 0, 0]
sensor = {}
"""


def test_everything_that_a_scene_file_says(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "any.stl").touch()
    path = tmp_path / "full.toml"
    path.write_bytes(b"\xef\xbb\xbf" + FULL.replace("\n", "\r\n").encode())  # as editors on Windows save it
    scene = read_scene(path)
    box, debris = scene.objects
    assert (scene.name, scene.seed, scene.folder) == ("full", 7, tmp_path)
    assert box.position == (1.0, 2.5, -3.0)
    assert all(type(x) is float for x in box.position)
    assert dict(box.materials) == {"panel_*": "dull", "bus": "white-paint"}
    assert (debris.mesh, debris.name, debris.units, debris.up) == ("parts/any.stl", "debris", "mm", "y")
    assert scene.materials == {"dull": MaterialConfig("solar-cell", (0.05, 0.05, 0.05), 0.5)}
    assert scene.sun.angular_radius == 0
    assert scene.earth == EarthConfig()
    assert scene.rig == RIGS["random"](sun=((10, 20), (30, -40)), far=50)
    assert scene.camera.resolution == (320, 240)
    assert scene.camera.sensor is not None
    elsewhere = scene_text(scene)
    assert str(tmp_path / "parts" / "any.stl") in elsewhere
    (tmp_path / "again.toml").write_text(elsewhere, encoding="utf-8")
    assert read_scene(tmp_path / "again.toml").objects[1].mesh == str(tmp_path / "parts" / "any.stl")


def test_a_printed_mesh_is_relative_to_where_one_is(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "any.stl").touch()
    monkeypatch.chdir(tmp_path)
    assert 'mesh = "a/any.stl"' in scene_text(read_scene("a/any.stl"))
    monkeypatch.chdir(tmp_path / "a")
    assert 'mesh = "any.stl"' in scene_text(read_scene("../a/any.stl"))


def test_a_mesh_file_is_a_scene(tmp_path):
    (tmp_path / "any.STL").touch()
    scene = read_scene(tmp_path / "any.STL", units="mm", up="y", views=3)
    assert (scene.name, scene.folder, scene.rig.views) == ("any", tmp_path, 3)
    assert scene.objects == (ObjectConfig(mesh="any.STL", units="mm", up="y"),)
    with pytest.raises(InputError, match=r"^units: expected one of m, cm"):
        read_scene(tmp_path / "any.STL", units="miles")
    with pytest.raises(InputError, match=r"^up: expected a mesh file as the scene, found boxsat"):
        read_scene("boxsat", up="y")


def test_options():
    scene = read_scene("boxsat", resolution=64, sun=[(1, 2), (3, 4)], spp=None, distance=9.0, fov_deg=20.0)
    assert (scene.camera.resolution, scene.camera.fov_deg, scene.quality.spp) == ((64, 64), 20.0, 64)
    assert (scene.rig.sun, scene.rig.suns, scene.rig.distance) == (((1.0, 2.0), (3.0, 4.0)), 2, 9.0)
    assert read_scene("boxsat", resolution=(64, 32)).camera.resolution == (64, 32)
    assert read_scene("telescope", sun=[(1, 2)]).rig.suns == 1
    again = read_scene("upper-stage", suns=3)
    assert (again.rig.sun, again.rig.suns) == ((), 3)
    for name, value in {
        "views": 0,
        "resolution": 0,
        "sun": [(0, 91)],
        "teapots": 1,
        "suns": 0,
        "seed": -1,
        "min_sunlit": 1,
    }.items():
        with pytest.raises(InputError, match=f"^{name}: expected"):
            read_scene("boxsat", **{name: value})
    with pytest.raises(InputError, match=r"^fov: expected one of the options .*, fov_deg, .*; did you mean fov_deg\?$"):
        read_scene("boxsat", fov=30)
    with pytest.raises(InputError, match=r"^distance: expected one of the options .*") as refused:
        read_scene("upper-stage", distance=1.0)
    rig = "across, across_phase_deg, altitude_km, duration_s, known_test_views, phase_deg, shared_test_views, size, "
    rig += "sun, sun_moves, suns, test_suns, test_views, views of upper-stage, whose rig is of kind fly-around"
    assert str(refused.value).endswith(f"options {rig} (fibonacci and polar-arc know distance)")


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("boxsta", r"^scene: expected one of boxsat, .*, found 'boxsta'; did you mean boxsat\?$"),
        ("teapot", r"^scene: expected one of boxsat, .* or a mesh file, found 'teapot'$"),
        ("", r"^scene: expected one of boxsat"),
        ("folder", r"found the folder .*folder.$"),
        ("none.toml", r"none.toml: expected a scene file, found none$"),
        ("folder.toml", r"folder.toml: expected a scene file, found a folder$"),
        ("none.glb", r"found no file 'none.glb'$"),
        ("a/b", r"found no file 'a/b'$"),
        ("long" * 999, r"^scene: expected"),
        ("long" * 999 + ".toml", r"expected a scene file, found one that cannot be read"),
        ("a\0b", r"^scene: expected"),
        ("a\0b.toml", r"^scene: expected a path without a null character, found"),
    ],
)
def test_no_such_scene(source, said, tmp_path, monkeypatch):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.toml").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said):
        read_scene(source)


BOXSAT = '[[objects]]\nspacecraft = "boxsat"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", ": objects: expected tables in double brackets, found none"),
        ("# nothing\n", ": objects: expected"),
        ("objects = []", ", line 1: objects: expected at least one object, found none"),
        ("[objects]\nspacecraft='boxsat'", ", line 1: objects: expected tables in double brackets, found a table"),
        ("[[objects]]", ", line 1: objects[0]: expected either spacecraft or mesh, found neither"),
        (BOXSAT + "mesh='a.glb'", ", line 1: objects[0]: expected either spacecraft or mesh, found both"),
        (BOXSAT + "\n[rig]\nveiws = 3", ", line 5: rig.veiws: expected one of kind, suns, views"),
        (BOXSAT + "\n[rig]\nveiws = 3", "found 'veiws'; did you mean rig.views?"),
        ("veiws = 3\n" + BOXSAT, ", line 1: veiws: expected one of name, objects"),
        ("views = 3\n" + BOXSAT, "found 'views'; did you mean rig.views?"),
        (BOXSAT + "[rig]\nkind = 'fibonaci'", ", line 4: rig.kind: expected one of fibonacci, polar-arc"),
        (BOXSAT + "[rig]\nkind = 'fibonaci'", "did you mean fibonacci?"),
        (BOXSAT + "[rig]\nkind = 1", ", line 4: rig.kind: expected one of fibonacci"),
        (BOXSAT + "[rig]\n\nviews = 0", ", line 5: rig.views: expected at least 1, found 0"),
        (BOXSAT + "[rig]\nviews = 1000000000000", ", line 4: rig.views: expected at most 10,000,000, found 10"),
        (BOXSAT + "[rig]\nsuns = 9999\nviews = 9999", ", line 5: rig.views: expected at most 10,000,000 frames of all"),
        (BOXSAT + "[rig]\ntest_suns = 10000000", ", line 3: rig.views: expected at most 10,000,000 frames of all Suns"),
        (BOXSAT + "[rig]\nnear = 3", "distance, found 'near'; kind random knows it"),
        (BOXSAT + "[rig]\nkind = 'approach'\ndistance = 3", "'distance'; kind fibonacci and polar-arc know it"),
        ("near = 3\n" + BOXSAT, "found 'near'; did you mean rig.near?"),
        (
            BOXSAT + "[rig]\nkind = 'random'\nrandom_suns = true\nsuns = 2",
            ", line 5: rig.random_suns: expected 1 suns and 0 test_suns, as every frame has its own, "
            "found 2 suns and 0 test_suns",
        ),
        (
            BOXSAT + "[camera]\nresolution = 20000",
            "134,217,728 pixels, 16,384 a side, found 20000 x 20000",
        ),
        (BOXSAT + "scale = 1e300", ", line 3: objects[0].scale: expected a factor from 1e-09 to 1e+09, found 1e+300"),
        (BOXSAT + "position = [1e30, 0, 0]", ", line 3: objects[0].position: expected metres from -1e+09 to 1e+09"),
        (BOXSAT + "units = 'mm'", ", line 3: objects[0].units: expected beside a mesh only, found 'mm'"),
        (BOXSAT + "two_sided = false", ", line 3: objects[0].two_sided: expected beside a mesh only, found False"),
        (
            BOXSAT + "[materials.glass]\npreset = 'glass'",
            ", line 3: materials.glass: expected a name that no preset has, found 'glass'",
        ),
        (
            BOXSAT + "[materials.x]\npreset = 'grey-paint'\nroughness = 0.5",
            ", line 5: materials.x.roughness: expected none, as grey-paint has none, found 0.5",
        ),
        (
            BOXSAT + "[materials.x]\npreset = 'white-paint'\nalbedo = 0.95",
            ", line 5: materials.x.albedo: expected at most 0.9 under a coat, which adds its gloss, found 0.95",
        ),
        (BOXSAT + "[quality]\nspp = 9999999", ", line 4: quality.spp: expected at most 1,000,000, found 9999999"),
        (BOXSAT + "[quality]\nmax_depth = 2000", ", line 4: quality.max_depth: expected at most 1,000, found 2000"),
        (BOXSAT + "[rig]\nviews = 3.0", ", line 4: rig.views: expected a whole number, found 3.0"),
        (BOXSAT + "[rig]\nviews = true", ", line 4: rig.views: expected a whole number, found True"),
        (BOXSAT + "[rig]\nviews = '3'", ", line 4: rig.views: expected a whole number, found '3'"),
        (BOXSAT + "rig.suns = 2", ", line 3: objects[0].rig: expected one of spacecraft"),
        (BOXSAT + "[rig]\nsun = [[1, 2],\n [3]]", ", line 5: rig.sun[1]: expected a list of 2 numbers, found [3]"),
        (BOXSAT + "[rig]\nsun = [1, 2]", ", line 4: rig.sun[0]: expected a list of 2 numbers, found 1"),
        (BOXSAT + "[rig]\nsun = [[0, 99]]", ", line 4: rig.sun: expected a finite azimuth"),
        (BOXSAT + "[camera]\nfov_deg = nan", ", line 4: camera.fov_deg: expected a finite number, found nan"),
        (BOXSAT + "[camera]\nfov_deg = -inf", ", line 4: camera.fov_deg: expected a finite number, found -inf"),
        (
            BOXSAT + f"[camera]\nfov_deg = 1{'0' * 400}",
            ", line 4: camera.fov_deg: expected a finite number, found 100",
        ),
        (BOXSAT + f"[camera]\nfov_deg = 1{'0' * 9999}", ": expected TOML"),
        (
            BOXSAT + "[camera]\nfov_deg = 0",
            ", line 4: camera.fov_deg: expected an angle from 0.001 to 120 degrees, found 0",
        ),
        (BOXSAT + "[camera]\nfov_deg = 1979-05-27", ", line 4: camera.fov_deg: expected a finite number"),
        (BOXSAT + "[camera]\nresolution = 3", ", line 4: camera.resolution: expected at least 8 pixels, found 3"),
        (BOXSAT + "[camera]\nresolution = 64.0", ", line 4: camera.resolution[0]: expected a whole number, found 64.0"),
        (BOXSAT + "[camera]\nresolution = [1]", "camera.resolution: expected a list of 2 whole numbers or one for all"),
        (BOXSAT + "[camera]\ntone = 'warm'", ", line 4: camera.tone: expected one of srgb, filmic, found 'warm'"),
        (BOXSAT + "[camera.sensor]\nfog = 1", ", line 4: camera.sensor.fog: expected"),
        (BOXSAT + "camera = 3", ", line 3: objects[0].camera: expected"),
        ("camera = 3\n" + BOXSAT, ", line 1: camera: expected a table, found 3"),
        ("earth = true\n" + BOXSAT, ", line 1: earth: expected a table, found True"),
        (BOXSAT + "position = 0", ", line 3: objects[0].position: expected a list of 3 numbers, found 0"),
        (BOXSAT + "rotation_wxyz = [0,0,0,0]", ", line 3: objects[0].rotation_wxyz: expected four finite numbers"),
        (BOXSAT + BOXSAT + "scale = -1", ", line 5: objects[1].scale: expected a factor from 1e-09 to 1e+09, found -1"),
        (BOXSAT + "color = [1,1,1]", ", line 3: objects[0].color: expected"),
        (BOXSAT + "[sun]\ncolor = [1,1,1]", ", line 4: sun.color: expected one of shape, distance_au, found"),
        ("folder = '/'\n" + BOXSAT, ", line 1: folder: expected"),
        (BOXSAT.replace("boxsat", "boxsta"), ", line 2: objects[0].spacecraft: expected one of boxsat"),
        (BOXSAT.replace("boxsat", "boxsta"), "found 'boxsta'; did you mean boxsat?"),
        ('[[objects]]\nmesh = "a\\u0000b"', ", line 2: objects[0].mesh: expected text without a null character"),
        (f"[[objects]]\nmesh = '{'long' * 999}'", ", line 2: objects[0].mesh: expected a mesh file"),
        ("[[objects]]\n\nmesh = 'none.glb'", ", line 3: objects[0].mesh: expected a mesh file, found no file"),
        (BOXSAT + "[objects.materials]\nbus = 'gold'", ", line 4: objects[0].materials.bus: expected one of"),
        (
            BOXSAT + "[objects.materials]\nbus = 3",
            ", line 4: objects[0].materials.bus: expected text in quotes",
        ),
        (
            BOXSAT + "[materials.x]\nroughness = 0.5",
            ", line 3: materials.x.preset: expected text in quotes",
        ),
        (BOXSAT + "[materials.x]\npreset = 'gold'", ", line 4: materials.x.preset: expected one of"),
        (BOXSAT + "[materials.x]\npreset = 'glass'\nalbedo = 2", ", line 5: materials.x.albedo: expected fractions"),
        (BOXSAT + "materials = { bux = 'glass' }", ", line 3: objects[0].materials.bux: expected a part of boxsat"),
        (BOXSAT + "materials = { bux = 'glass' }", "found none that fits; did you mean bus?"),
        (BOXSAT + "materials = { bus = 'glass', 'z*' = 'glass' }", ': objects[0].materials."z*": expected a part'),
        (BOXSAT + "materials = 'x'", ", line 3: objects[0].materials: expected a table, found 'x'"),
        (BOXSAT + "[sun]\n\nshape disc\n", ", line 5: expected TOML, found an error: expected '=' after a key"),
        (BOXSAT + "[sun]\n[sun]\n", ", line 4: expected TOML, found an error: cannot declare"),
        (BOXSAT + "[sun]\nshape = 'disc'\nshape = 'disc'\n", ", line 5: expected TOML, found an error"),
        (BOXSAT + "a = [1,\n\n", ", line 3: expected TOML, found an error"),
        (BOXSAT + "a = " + "[" * 100_000, ": expected TOML, found lists or tables nested too deeply"),
        (b"\xff\xfe" + BOXSAT.encode("utf-16-le"), ": expected text in UTF-8, found byte 0xff"),
        (b"\x00" * 100, ", line 1: expected TOML"),
    ],
)
def test_broken_files_end_in_a_sentence_with_the_line(refusal, text, said):
    assert said in refusal(text)


def test_a_huge_file_is_not_read(tmp_path):
    path = tmp_path / "big.toml"
    with path.open("wb") as file:
        file.truncate(10 << 30)
    with pytest.raises(InputError) as refused:
        read_scene(path)
    assert str(refused.value) == f"{path}: expected a scene file of at most 1,048,576 bytes, found 10,737,418,240"


@pytest.mark.parametrize("part", ["a", "'a'", '"a"'])
def test_keys_of_many_parts_are_refused(refusal, part):
    assert "parts" in refusal(" . ".join([part] * 17) + " = 1")
    assert "parts" in refusal("x = {" + ".".join([part] * 100_000) + " = 1 }")
    assert "line 1: a: expected one of" in refusal(".".join([part] * 16) + " = 1")


def test_damaged_files_are_read_or_refused(tmp_path):
    """Bytes changed, dropped and doubled at random: no other exception than InputError, and mostly with a line."""
    path = tmp_path / "damaged.toml"
    sound = (FULL + EVERYTHING).encode()
    with_line = 0
    for seed in range(400):
        dice = random.Random(seed)
        data = bytearray(FULL.encode() if seed % 2 else sound)
        for _ in range(dice.randint(1, 4)):
            at = dice.randrange(len(data))
            change = [bytes([dice.randrange(256)]), b"", bytes(data[at : at + 9]) * 2, b"[", b'"', b"\n"]
            data[at : at + dice.randint(0, 2)] = dice.choice(change)
        path.write_bytes(data)
        try:
            read_scene(path)
        except InputError as error:
            with_line += ", line " in str(error)
    assert with_line > 300


def numeric_keys(cls, table=""):
    """(`table`, a line with X for a number) of each field of `cls` that is a number or a list of them."""
    for key, hint in get_type_hints(cls).items():
        inner = [one for one in get_args(hint) if one is not NoneType] or [hint]
        if inner == [int] or inner == [float] or (hint in (int, float)):
            yield table, f"{key} = X"
        elif get_origin(hint) is tuple and set(inner) <= {int, float, Ellipsis}:
            count = 5 if Ellipsis in inner else len(inner)
            yield table, f"{key} = [X{', 1' * (count - 1)}]"
            yield table, f"{key} = [{'X, ' * count}]"


PLACES = [
    *((table, line) for table, line in numeric_keys(SceneConfig)),
    *((BOXSAT + table, line) for table, line in numeric_keys(ObjectConfig)),
    *numeric_keys(MaterialConfig, "[materials.x]\npreset = 'white-paint'\n"),
    *((table, line) for table, line in numeric_keys(SunConfig, "[sun]\n") if not line.startswith("color")),
    *numeric_keys(EarthConfig, "[earth]\n"),
    *numeric_keys(CameraConfig, "[camera]\n"),
    *numeric_keys(SensorConfig, "[camera.sensor]\n"),
    *numeric_keys(QualityConfig, "[quality]\n"),
    *((t, line) for kind, rig in RIGS.items() for t, line in numeric_keys(rig, f"[rig]\nkind = '{kind}'\n")),
    *(("[rig]\n", line) for line in ("sun = [[X, 1]]", "sun = [[1, X]]")),
]
VALUES = ["0", "-1", "nan", "inf", "-inf", "1e300", "-1e300", "1e-300", str(10**20), "true", '"x"', "[]"]


@pytest.mark.parametrize(("table", "line"), PLACES)
def test_impossible_numbers_of_every_key(table, line, tmp_path):
    """Each is refused with its line, or the scene can be built, its views planned, and it can be written down."""
    path = tmp_path / "my.toml"
    refused = set()
    for value in VALUES:
        text = table + line.replace("X", value) + "\n"
        at = text.count("\n")
        path.write_text(text if BOXSAT in text else text + BOXSAT)
        try:
            scene = read_scene(path)
        except InputError as error:
            sentence = str(error)
            assert sentence.startswith(f"{path}, line "), sentence
            assert "\n" not in sentence
            assert sentence.count(": expected ") == 1, sentence
            refused.add(value)
            if value in ("nan", "inf", "true", '"x"'):
                assert f"line {at}: " in sentence, sentence
        else:
            with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
                warnings.simplefilter("error")
                small = replace(scene, rig=replace(scene.rig, views=min(scene.rig.views, 2), test_views=1))
                train, test = plan_views(build(small), small)
                assert all(np.isfinite(view.camera.world_from_camera).all() for _, view in train + test)
            scene_text(scene)
    assert refused >= {"nan", "inf", "-inf", "true", '"x"'}


@pytest.mark.parametrize("turn", ["[1e-200, 0, 0, 0]", "[5e-324, 0, 0, 0]", "[1e300, 0, 0, 0]", "[-3, 0, 0, 0]"])
def test_quaternions_of_any_length(turn, tmp_path):
    path = tmp_path / "turned.toml"
    path.write_text(BOXSAT + f"rotation_wxyz = {turn}\n")
    np.testing.assert_allclose(build(read_scene(path)).objects[0].world_from_object, np.eye(4), atol=1e-15)


def test_objects_that_single_precision_cannot_hold_are_named():
    def sized(*objects):
        return build(SceneConfig("x", objects))

    for name, scale, said in (("cubesat", 1e-8, r"\de-\d\d m"), ("small-body", 1e9, r"[\d.]+e\+1\d m")):
        with pytest.raises(
            InputError, match=rf"^object {name}: expected a size from 1e-06 to 1e\+10 m, found .*{said}$"
        ):
            sized(ObjectConfig(spacecraft=name, scale=scale))
    far = ObjectConfig(spacecraft="boxsat", name="far", position=(1e9, 0, 0))
    with pytest.raises(InputError, match=r"^object far: expected a size of at least 1e-05 of the scene's, found"):
        sized(far)
    with pytest.raises(InputError, match=r"^object cubesat: expected a size of at least"):
        sized(ObjectConfig(spacecraft="cubesat"), ObjectConfig(spacecraft="boxsat", scale=1e6))
    assert sized(ObjectConfig(spacecraft="boxsat", scale=1e6)).bounding_sphere[1] > 1e6


FIELD = re.compile(r"^(\w+): [^=\n]+(?:= ([^#\n]*))?", re.MULTILINE)
TABLES = {
    **{"The scene": SceneConfig, "[[objects]]": ObjectConfig, "[materials.NAME]": MaterialConfig},
    **{"[sun]": SunConfig, "[earth]": EarthConfig, "[camera]": CameraConfig, "[camera.sensor]": SensorConfig},
    **{f'[rig] kind = "{kind}"': rig for kind, rig in RIGS.items()},
    **{"[background]": BackgroundConfig, "[quality]": QualityConfig},
}


@pytest.fixture(scope="module")
def generated():
    """The page of all keys, as the documentation site has it."""
    spec = importlib.util.spec_from_file_location("generate_scene_page", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.scene_page()


def rows_of(page, title):
    """Keys and defaults, as text, in the Python below a title of the page."""
    section = re.search(rf"^## {re.escape(title)}\n.*?^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    return {key: default.strip() for key, default in FIELD.findall(section.group(1))}


@pytest.mark.parametrize("title", TABLES)
def test_the_page_has_every_key_and_its_default(title, generated):
    cls = TABLES[title]
    rows = rows_of(generated, title)
    if issubclass(cls, RigConfig):
        rows = {**rows_of(generated, "[rig]"), **rows}
    assert set(rows) == set(keys_of(cls, RULES))
    stated = [f for f in fields(cls) if f.name in rows and f.default_factory is MISSING]
    assert len(stated) >= 2
    for f in stated:
        if f.default is MISSING:
            assert rows[f.name] == "", f.name
        else:
            value = ast.literal_eval(rows[f.name])
            assert value == (pytest.approx(f.default, rel=1e-5) if isinstance(value, float) else f.default), f.name


def test_every_table_of_the_page_is_checked(generated):
    assert set(re.findall(r"^## (.*)$", generated, re.MULTILINE)) == {*TABLES, "[rig]"}


BLOCKS = re.findall(r"^```toml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_examples_on_the_page(number, tmp_path):
    """Each is a whole scene file, or a part of one."""
    text = BLOCKS[number] if "[[objects]]" in BLOCKS[number] else BLOCKS[number] + BOXSAT
    for mesh in re.findall(r'mesh = "(.*)"', text):
        (tmp_path / mesh).parent.mkdir(exist_ok=True)
        (tmp_path / mesh).touch()
    (tmp_path / "page.toml").write_text(text, encoding="utf-8")
    assert read_scene(tmp_path / "page.toml").name == "page"
