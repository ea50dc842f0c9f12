"""COLMAP projects that are cut off, damaged or lack something: one sentence each."""

import struct

import numpy as np
import pytest
from colmap_files import Model, imported, project, ring, write_binary, write_masks, write_pictures

from spacesim.data.errors import InputError


def cut(name, size):
    return lambda root: (root / f"sparse/0/{name}").write_bytes((root / f"sparse/0/{name}").read_bytes()[:size])


def replace(name, old, new):
    path = f"sparse/0/{name}"
    return lambda root: (root / path).write_bytes((root / path).read_bytes().replace(old, new))


def poke(name, at, layout, *values):
    def change(root):
        data = bytearray((root / f"sparse/0/{name}").read_bytes())
        struct.pack_into(layout, data, at, *values)
        (root / f"sparse/0/{name}").write_bytes(data)

    return change


def without(*names):
    return lambda root: [(root / name).unlink() for name in names]


def write(name, text):
    return lambda root: (root / f"sparse/0/{name}").write_text(text)


NAN, HUGE = float("nan"), 2**60
BROKEN = {
    "cameras cut": (
        "binary",
        cut("cameras.bin", 30),
        "cameras.bin: expected a binary COLMAP model, found one that is cut",
    ),
    "cameras empty": (
        "binary",
        cut("cameras.bin", 0),
        "cameras.bin: expected a binary COLMAP model, found one that is cut",
    ),
    "images cut": (
        "binary",
        cut("images.bin", 900),
        "images.bin: expected a binary COLMAP model, found one that is cut",
    ),
    "images cut in a name": ("binary", cut("images.bin", 77), "images.bin: expected a binary COLMAP model, found one"),
    "points cut": (
        "binary",
        cut("points3D.bin", 300),
        "points3D.bin: expected a binary COLMAP model, found one that is",
    ),
    "points cut at the end": ("binary", cut("points3D.bin", -1), "points3D.bin: expected a binary COLMAP model, found"),
    "too many cameras": ("binary", poke("cameras.bin", 0, "<Q", HUGE), "cameras.bin: expected a binary COLMAP model"),
    "too many images": ("binary", poke("images.bin", 0, "<Q", HUGE), "images.bin: expected a binary COLMAP model"),
    "too many points": ("binary", poke("points3D.bin", 0, "<Q", HUGE), "points3D.bin: expected a binary COLMAP model"),
    "endless track": (
        "binary",
        poke("points3D.bin", 8 + 43, "<Q", 2**64 - 1),
        "points3D.bin: expected a binary COLMAP",
    ),
    "endless features": ("binary", poke("images.bin", 8 + 64 + 11, "<Q", HUGE), "images.bin: expected a binary COLMAP"),
    "fewer images": ("binary", poke("images.bin", 0, "<Q", 2), "images.bin: expected"),
    "no images": (
        "binary",
        lambda root: write_binary(root / "sparse/0", Model()),
        "expected registered images, found none",
    ),
    "text as binary": (
        "binary",
        write("images.bin", "# Image list\n"),
        "images.bin: expected a binary COLMAP model, found text",
    ),
    "binary as text": ("text", lambda root: (root / "sparse/0/images.txt").write_bytes(b"\1\0\0"), "found binary data"),
    "unknown model": (
        "binary",
        poke("cameras.bin", 12, "<i", 99),
        "camera 1: expected a camera model of COLMAP's, found number 99",
    ),
    "spherical": (
        "binary",
        lambda root: write_binary(root / "sparse/0", ring(cameras={1: ("EQUIRECTANGULAR", 16, 12, (16.0, 12.0))})),
        "expected a lens that a pinhole camera can stand for, found EQUI",
    ),
    "NaN focal length": (
        "binary",
        poke("cameras.bin", 32, "<d", NAN),
        "camera 1: expected 3 finite parameters of SIMPLE_PIN",
    ),
    "negative focal length": (
        "binary",
        poke("cameras.bin", 32, "<d", -1.0),
        "expected a size and focal lengths above 0",
    ),
    "no width": ("binary", poke("cameras.bin", 16, "<Q", 0), "expected a size and focal lengths above 0, found 0 x 12"),
    "wide": (
        "binary",
        poke("cameras.bin", 16, "<Q", 10**12),
        "view 0.png: expected 1000000000000x12 pixels as its camera",
    ),
    "NaN pose": (
        "binary",
        poke("images.bin", 12, "<d", NAN),
        "view 0.png: expected a pose of finite numbers, found [nan",
    ),
    "no rotation": (
        "binary",
        poke("images.bin", 12, "<4d", 0, 0, 0, 0),
        "view 0.png: expected a pose of finite numbers",
    ),
    "infinite shift": ("binary", poke("images.bin", 44, "<d", np.inf), "view 0.png: expected a pose of finite numbers"),
    "NaN point": (
        "binary",
        poke("points3D.bin", 16, "<d", NAN),
        "points3D.bin: expected finite positions, found another",
    ),
    "no such camera": (
        "binary",
        poke("images.bin", 68, "<I", 5),
        "view 0.png: expected one of its cameras, found number 5",
    ),
    "twice the same": (
        "binary",
        replace("images.bin", b"view 1", b"view 0"),
        "expected each image once, found view 0.png twice",
    ),
    "outside": (
        "text",
        replace("images.txt", b"view 0.png", b"../images/view 0.png"),
        "expected a name of a picture below",
    ),
    "text cameras": (
        "text",
        write("cameras.txt", "1 PINHOLE sixteen 12 20 20 8 6\n"),
        "cameras.txt: line 1: expected CAMERA_ID",
    ),
    "text parameters": (
        "text",
        write("cameras.txt", "1 PINHOLE 16 12 20 8 6\n"),
        "expected 4 finite parameters of PINHOLE",
    ),
    "text model": ("text", write("cameras.txt", "1 PINHOL 16 12 20 8 6\n"), "found 'PINHOL'; did you mean PINHOLE"),
    "text images": (
        "text",
        write("images.txt", "1 1 0 0 0 0 0 view.png\n\n"),
        "images.txt: line 1: expected IMAGE_ID QW",
    ),
    "text features": (
        "text",
        replace("images.txt", b"1.5 2.5 7 ", b"1.5 2.5 "),
        "expected X Y POINT3D_ID for each point of",
    ),
    "text points": ("text", write("points3D.txt", "1 2 3\n"), "points3D.txt: line 1: expected POINT3D_ID X Y Z"),
    "text colours": (
        "text",
        write("points3D.txt", "1 0 0 0 300 0 0 0\n"),
        "points3D.txt: line 1: expected POINT3D_ID X Y Z",
    ),
    "text NaN": ("text", write("points3D.txt", "7 nan 0 0 30 0 0 0\n"), "points3D.txt: expected finite positions"),
    "no cameras": (
        "binary",
        without("sparse/0/cameras.bin"),
        "expected a COLMAP model, cameras and images (.bin or .txt), in it",
    ),
    "packed": (
        "text",
        lambda root: (root / "sparse/0/cameras.txt").rename(root / "sparse/0/cameras.txt.gz"),
        "in sparse or in sparse/0, found cameras.txt.gz",
    ),
    "no pictures": ("binary", without(*(f"images/view {k}.png" for k in range(5))), "expected the pictures of"),
    "another shape": ("binary", lambda root: write_pictures(root / "images", ["view 0.png"], (12, 16)), "found 12x16"),
    "no picture": (
        "binary",
        lambda root: (root / "images/view 0.png").write_text("x"),
        "view 0.png: expected PNG, JPEG",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_project_ends_in_one_sentence(tmp_path, case):
    form, damage, sentence = BROKEN[case]
    root = project(tmp_path / "src", form=form)
    damage(root)
    with pytest.raises(InputError) as caught:
        imported(root, tmp_path / "out")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out/transforms.json").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"images": "nowhere"}, "images: expected a folder, found none at"),
        ({"masks": "nowhere"}, "masks: expected a folder, found none at"),
        ({"masks": "sparse"}, "masks: expected masks named like the pictures, view 0.png to view 4.png, found"),
        ({"masked": "half"}, "masked: expected one of empty, unknown, found 'half'"),
        ({"mask": "x"}, "mask: expected options of colmap, one of images, masks, masked, found another; did you mean"),
    ],
)
def test_wrong_options_end_in_one_sentence(tmp_path, options, sentence):
    root = project(tmp_path / "src")
    paths = {key: root / value if key in ("images", "masks") else value for key, value in options.items()}
    with pytest.raises(InputError) as caught:
        imported(root, tmp_path / "out", **paths)
    assert sentence in str(caught.value)


def test_masks_of_another_shape_end_in_one_sentence(tmp_path):
    write_masks(tmp_path / "masks", [f"view {k}.png" for k in range(5)], (12, 16))
    with pytest.raises(InputError, match=r"view 0\.png: expected 16x12 pixels, or a multiple or fraction"):
        imported(project(tmp_path / "src"), tmp_path / "out", masks=tmp_path / "masks")


@pytest.mark.parametrize("form", ["binary", "text"])
def test_cameras_of_no_image_do_not_matter(tmp_path, form):
    camera = ("SIMPLE_PINHOLE", 16, 12, (20.0, 8.0, 6.0))
    wrong = {2: ("EQUIRECTANGULAR", 16, 12, (16.0, 12.0)), 3: ("SIMPLE_PINHOLE", 0, 0, (0.0, 0.0, 0.0))}
    root = project(tmp_path / "src", ring(cameras={1: camera} | wrong), form)
    assert len(imported(root, tmp_path / "out").frames) == 5


def test_a_text_model_may_begin_with_a_mark_of_its_encoding(tmp_path):
    root = project(tmp_path / "src", ring(), "text")
    for path in (root / "sparse/0").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(imported(root, tmp_path / "out").frames) == 5
