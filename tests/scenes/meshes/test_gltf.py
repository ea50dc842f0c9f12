"""glTF files: geometry, surfaces and pictures against documents that the tests write or read by hand."""

import base64
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from spacesim import backend
from spacesim.backend import memory
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb
from spacesim.scenes.materials.table import principled
from spacesim.scenes.meshes.read import read_mesh
from spacesim.scenes.meshes.textures import Notes, Surface, material_of
from spacesim.scenes.scene import Scene, SceneObject, load

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="<f4")
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype="<f4")  # glTF: v down, (0, 1) is the picture's lower left
QUAD = np.array([0, 1, 2, 0, 2, 3], dtype="<u2")
CODES = {"<i1": 5120, "|i1": 5120, "|u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def png(picture: np.ndarray) -> str:
    """A data URI."""
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "png")
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


class Document:
    """A glTF document in the making: arrays become accessors of one buffer."""

    def __init__(self, **top) -> None:
        self.data = b""
        self.json = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], **top}

    def view(self, array: np.ndarray) -> int:
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.json["bufferViews"]) - 1

    def add(self, array: np.ndarray, **more) -> int:
        entry = {
            "bufferView": self.view(array),
            "componentType": CODES[array.dtype.str],
            "count": len(array),
            "type": TYPES[array.size // len(array)],
        }
        self.json["accessors"].append({**entry, **more})
        return len(self.json["accessors"]) - 1

    def mesh(self, *primitives: dict, **node) -> "Document":
        self.json.setdefault("meshes", []).append({"primitives": list(primitives)})
        self.json.setdefault("nodes", []).append({"mesh": len(self.json["meshes"]) - 1, **node})
        return self

    def square(self, **more) -> dict:
        attributes = {"POSITION": self.add(SQUARE), "TEXCOORD_0": self.add(SQUARE_UV)}
        return {"attributes": attributes, "indices": self.add(QUAD), **more}

    def write(self, path: Path) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        path.write_text(json.dumps({**self.json, "buffers": [{"byteLength": len(self.data), "uri": uri}]}))
        return path


def textured(tmp_path: Path, picture: np.ndarray, more=None, **pbr) -> Path:
    """A square whose base colour is `picture`."""
    texture = {"index": 0, **(more or {})}
    material = {"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": texture, "metallicFactor": 0.0, **pbr}}
    document = Document(materials=[material], textures=[{"source": 0}], images=[{"uri": png(picture)}])
    return document.mesh(document.square(material=0)).write(tmp_path / "plate.gltf")


def ball(tmp_path: Path, normals=None, **node) -> Path:
    """An icosphere about the origin with a normal at each vertex: its position, unless said otherwise."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    stored = sphere.vertices if normals is None else normals(np.array(sphere.vertices))
    document = Document()
    attributes = {"POSITION": document.add(sphere.vertices.astype("<f4")), "NORMAL": document.add(stored.astype("<f4"))}
    primitive = {"attributes": attributes, "indices": document.add(sphere.faces.astype("<u2").ravel())}
    return document.mesh(primitive, **node).write(tmp_path / "ball.gltf")


CORNERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], dtype=np.uint8)


def looked_up(path: Path, points: np.ndarray) -> np.ndarray:
    """[N, 3] diffuse reflectance that rays along -z hit at x, y = points [N, 2], through the scene's own loader."""
    mi = backend.mitsuba()
    craft, _ = read_mesh(path, up="z")
    loaded = load(Scene("plate", (SceneObject(craft),)))
    starts = loaded.units.points(np.column_stack([points, np.full(len(points), 5.0)]))
    rays = mi.Ray3f(mi.Point3f(np.ascontiguousarray(starts.T, np.float32)), mi.Vector3f(0, 0, -1))
    hit = loaded.sunlit.ray_intersect(rays)
    return np.array(hit.bsdf().eval_diffuse_reflectance(hit)).T


def test_textures_have_the_right_orientation(tmp_path):
    picture = np.repeat(np.repeat(CORNERS, 8, axis=0), 8, axis=1)
    seen = looked_up(textured(tmp_path, picture), [[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])
    np.testing.assert_array_equal(seen > 0.4, CORNERS.reshape(4, 3) > 0)  # upper left, upper right, lower left, right


def test_textures_of_a_trimesh_file_have_the_right_orientation(tmp_path):
    picture = Image.fromarray(np.repeat(np.repeat(CORNERS, 8, axis=0), 8, axis=1))
    plate = trimesh.Trimesh(SQUARE, QUAD.reshape(2, 3), process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, metallicFactor=0.0)
    plate.visual = trimesh.visual.TextureVisuals(uv=SQUARE[:, :2], material=material)
    plate.export(tmp_path / "plate.glb")
    seen = looked_up(tmp_path / "plate.glb", [[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])
    np.testing.assert_array_equal(seen > 0.4, CORNERS.reshape(4, 3) > 0)


def test_a_glb_agrees_with_its_bytes_read_by_hand(tmp_path):
    ball = trimesh.creation.icosphere(1)
    material = trimesh.visual.material.PBRMaterial(
        name="Gold Foil", baseColorFactor=[200, 100, 50, 255], metallicFactor=0.25, roughnessFactor=0.75
    )
    ball.visual = trimesh.visual.TextureVisuals(material=material)
    data = trimesh.Scene(ball).export(file_type="glb")
    (tmp_path / "ball.glb").write_bytes(data)
    size = struct.unpack_from("<I", data, 12)[0]
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]

    def array(index, dtype, width):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(body, dtype, accessor["count"] * width, start).reshape(-1, width)

    primitive = document["meshes"][0]["primitives"][0]
    positions = array(primitive["attributes"]["POSITION"], "<f4", 3).astype(float)
    faces = array(primitive["indices"], "<u4", 1).reshape(-1, 3)
    craft, report = read_mesh(tmp_path / "ball.glb")
    turned = np.stack([positions[:, 0], -positions[:, 2], positions[:, 1]], axis=-1)
    np.testing.assert_allclose(craft.parts[0].mesh.triangles, turned[faces])
    written = document["materials"][0]["pbrMetallicRoughness"]
    made = craft.parts[0].material
    np.testing.assert_allclose(made.albedo, written["baseColorFactor"][:3])
    assert (made.bsdf["metallic"], made.bsdf["roughness"]) == (written["metallicFactor"], written["roughnessFactor"])
    assert report.materials == ("ball/Gold_Foil",)


def test_defaults_of_the_standard(tmp_path):
    document = Document(materials=[{}])
    craft, _ = read_mesh(document.mesh(document.square(material=0)).write(tmp_path / "a.gltf"))
    made = craft.parts[0].material
    assert (made.albedo, made.bsdf["metallic"], made.bsdf["roughness"]) == ((1.0, 1.0, 1.0), 1.0, 1.0)


def test_factors_multiply_pictures_in_linear_light(tmp_path):
    picture = np.full((2, 2, 3), 200, dtype=np.uint8)
    path = textured(tmp_path, picture, baseColorFactor=[0.5, 0.25, 1.0, 1.0])
    albedo = read_mesh(path)[0].parts[0].material.albedo
    np.testing.assert_allclose(albedo, linear_from_srgb(200 / 255) * np.array([0.5, 0.25, 1.0]), rtol=0.01)


def test_green_is_roughness_and_blue_is_metal(tmp_path):
    picture = np.zeros((2, 2, 3), dtype=np.uint8)
    picture[0, 0] = [9, 200, 100]
    pbr = {"metallicRoughnessTexture": {"index": 0}, "metallicFactor": 0.5, "roughnessFactor": 0.25}
    document = Document(
        materials=[{"pbrMetallicRoughness": pbr}], textures=[{"source": 0}], images=[{"uri": png(picture)}]
    )
    craft, report = read_mesh(document.mesh(document.square(material=0)).write(tmp_path / "a.gltf"))
    images = craft.parts[0].material.images
    assert images["roughness"][0, 0] == 50
    assert images["metallic"][0, 0] == 50
    assert images["roughness"][1, 1] == 13  # a mirror never meets the Sun
    assert any("0.05" in line for line in report.changed)


@pytest.mark.parametrize(("normal", "brighter"), [([191, 128, 238], "right"), ([128, 191, 238], "top")])
def test_normal_maps_lean_the_right_way(tmp_path, normal, brighter):
    picture = np.full((2, 2, 3), normal, dtype=np.uint8)
    pbr = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "baseColorFactor": [0.5, 0.5, 0.5, 1]}
    document = Document(
        materials=[{"normalTexture": {"index": 0}, "pbrMetallicRoughness": pbr}],
        textures=[{"source": 0}],
        images=[{"uri": png(picture)}],
    )
    craft, _ = read_mesh(document.mesh(document.square(material=0)).write(tmp_path / "a.gltf"), up="z")
    mi = backend.mitsuba()
    scene = load(Scene("plate", (SceneObject(craft),))).sunlit
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.3, 0.6, 5.0), mi.Vector3f(0, 0, -1)))

    def value(*towards):
        light = mi.Vector3f(*(np.array(towards) / np.linalg.norm(towards)).tolist())
        return float(np.array(hit.bsdf().eval(mi.BSDFContext(), hit, hit.to_local(light)))[0, 0])

    lit = {"right": value(1, 0, 1), "left": value(-1, 0, 1), "top": value(0, 1, 1), "bottom": value(0, -1, 1)}
    assert max(lit, key=lambda side: lit[side]) == brighter
    other = {"right": "left", "top": "bottom"}[brighter]
    assert lit[brighter] > 2 * lit[other]


def test_normal_scale_and_mirrored_coordinates(tmp_path):
    picture = np.full((2, 2, 3), [191, 128, 238], dtype=np.uint8)
    for uv, mirrored in ((SQUARE_UV, False), (SQUARE_UV * [-1, 1], True)):
        document = Document(
            materials=[{"normalTexture": {"index": 0, "scale": 0.0}}],
            textures=[{"source": 0}],
            images=[{"uri": png(picture)}],
        )
        square = document.square(material=0)
        square["attributes"]["TEXCOORD_0"] = document.add(uv.astype("<f4"))
        craft, report = read_mesh(document.mesh(square).write(tmp_path / "a.gltf"))
        flat = craft.parts[0].material.images["normal"][0, 0]
        np.testing.assert_allclose(flat, [127.5, 127.5, 255], atol=1)
        assert any("mirrored" in line for line in report.changed) == mirrored


def test_texture_transform_of_the_extensions_example(tmp_path):
    """It "utilizes only the lower left quadrant of the source image"."""
    transform = {"offset": [0, 1], "rotation": 1.57079632679, "scale": [0.5, 0.5]}
    path = textured(tmp_path, CORNERS, {"extensions": {"KHR_texture_transform": transform}})
    uv = read_mesh(path)[0].parts[0].mesh.visual.uv
    np.testing.assert_allclose([uv.min(axis=0), uv.max(axis=0)], [[0, 0.5], [0.5, 1.0]], atol=1e-6)


def test_second_set_of_coordinates_and_wrap_mode(tmp_path):
    pbr = {"baseColorTexture": {"index": 0, "texCoord": 1}, "metallicRoughnessTexture": {"index": 0}}
    document = Document(
        materials=[{"name": "skin", "pbrMetallicRoughness": pbr}],
        textures=[{"source": 0, "sampler": 0}],
        images=[{"uri": png(CORNERS)}],
        samplers=[{"wrapS": 33071, "wrapT": 33071}],
    )
    square = document.square(material=0)
    square["attributes"]["TEXCOORD_1"] = document.add((SQUARE_UV * 65535).astype("<u2"), normalized=True)
    square["attributes"]["TEXCOORD_0"] = document.add(np.zeros((4, 2), "<f4"))
    craft, report = read_mesh(document.mesh(square).write(tmp_path / "a.gltf"))
    part = craft.parts[0]
    np.testing.assert_allclose(part.mesh.visual.uv, SQUARE_UV)
    assert part.material.bsdf["base_color"]["wrap_mode"] == "clamp"
    assert set(part.material.images) == {"base_color"}
    assert any("other coordinates" in line for line in report.dropped)


@pytest.mark.parametrize(("mode", "corners"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 0, 2, 3])])
def test_strips_and_fans_are_wound_like_triangles(tmp_path, mode, corners):
    document = Document()
    primitive = {"attributes": {"POSITION": document.add(SQUARE)}, "mode": mode}
    primitive["indices"] = document.add(np.array(corners, dtype="|u1"))
    craft, _ = read_mesh(document.mesh(primitive).write(tmp_path / "a.gltf"), up="z")
    np.testing.assert_allclose(craft.parts[0].mesh.face_normals, [[0, 0, 1]] * 2)
    assert craft.parts[0].mesh.area == pytest.approx(1.0)


def test_sparse_quantised_and_unindexed_positions(tmp_path):
    document = Document(extensionsUsed=["KHR_mesh_quantization"], extensionsRequired=["KHR_mesh_quantization"])
    short = np.zeros((3, 4), dtype="<i2")  # rows of 8 bytes, as vertex attributes must be
    short[:, :3] = [[0, 0, 0], [32767, 0, 0], [0, 32767, 0]]
    view = document.view(short)
    document.json["bufferViews"][view]["byteStride"] = 8
    entry = {"bufferView": view, "componentType": 5122, "count": 3, "type": "VEC3", "normalized": True}
    document.json["accessors"].append(entry)
    rows, values = document.view(np.array([1], "|u1")), document.view(np.array([[2, 0, 0]], "<f4"))
    sparse = {"count": 1, "indices": {"bufferView": rows, "componentType": 5121}, "values": {"bufferView": values}}
    other = document.add(SQUARE[[0, 1, 3]])
    document.json["accessors"].append({**document.json["accessors"][other], "sparse": sparse})
    document.mesh({"attributes": {"POSITION": 0}}).mesh({"attributes": {"POSITION": 2}})
    craft, _ = read_mesh(document.write(tmp_path / "a.gltf"))
    assert [part.mesh.area for part in craft.parts] == pytest.approx([0.5, 1.0])


def test_nodes_move_turn_and_mirror(tmp_path):
    document = Document()
    corner = document.add(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4"))
    faces = document.add(np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "|u1"))
    tetrahedron = {"attributes": {"POSITION": corner}, "indices": faces}
    half = np.sqrt(0.5)
    document.mesh(tetrahedron, translation=[10, 0, 0], rotation=[0, 0, half, half], scale=[1, 2, -3], name="leaf")
    document.json["nodes"].append({"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 5, 0, 1]})
    craft, report = read_mesh(document.write(tmp_path / "a.gltf"), up="z")
    part = craft.parts[0]
    assert part.name == "leaf"
    np.testing.assert_allclose(part.mesh.vertices, [[10, 5, 0], [10, 6, 0], [8, 5, 0], [10, 5, -3]], atol=1e-6)
    assert part.mesh.volume == pytest.approx(1.0)
    assert not report.changed[1:]  # grey paint alone: a mirrored node needs no mending


def test_unsupported_features_are_named(tmp_path):
    document = Document(
        materials=[
            {
                "name": "lamp",
                "emissiveFactor": [1, 1, 1],
                "alphaMode": "BLEND",
                "occlusionTexture": {"index": 0},
                "extensions": {"KHR_materials_clearcoat": {}},
            }
        ],
        animations=[{}],
        extensionsUsed=["KHR_lights_punctual"],
    )
    square = document.square(material=0)
    document.mesh(square, {"attributes": square["attributes"], "mode": 1})
    report = read_mesh(document.write(tmp_path / "a.gltf"))[1]
    text = "\n".join(report.dropped)
    for word in ("emission", "occlusion", "clearcoat", "animations", "KHR_lights_punctual", "lines"):
        assert word in text
    assert "transparent" not in text
    assert report.opaque == ("transparent surfaces: lamp",)


def test_names_are_plain_and_different(tmp_path):
    document = Document()
    square = {"attributes": {"POSITION": document.add(SQUARE)}, "indices": document.add(QUAD)}
    for name in ("B\ufffd\ufffdzierCurve", "Bézier", "Bézier", "", "日本", "../x"):
        document.mesh(square, name=name)
    names = [part.name for part in read_mesh(document.write(tmp_path / "a.gltf"))[0].parts]
    assert names == ["B_zierCurve", "Bezier", "Bezier_2", "part", "part_2", "x"]


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("lost.png", "not there"),
        ("../secret.png", "outside"),
        ("..%2Fsecret.png", "outside"),
        ("/etc/hostname", "outside"),
        ("https://example.org/a.png", "an address"),
        ("link.png", "outside"),
        ("words.png", "decoded"),
        ("data:image/png;base64,!!!!", "decoded"),
    ],
)
def test_a_picture_that_cannot_be_had_leaves_the_factor_and_is_named(tmp_path, uri, said):
    folder = tmp_path / "sat"
    folder.mkdir()
    Image.fromarray(CORNERS).save(tmp_path / "secret.png")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "words.png").write_text("no picture")
    pbr = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.25, 0.125, 1]}
    document = Document(materials=[{"pbrMetallicRoughness": pbr}], textures=[{"source": 0}], images=[{"uri": uri}])
    craft, report = read_mesh(document.mesh(document.square(material=0)).write(folder / "a.gltf"))
    assert craft.parts[0].material.albedo == (0.5, 0.25, 0.125)
    assert not craft.parts[0].material.images
    assert any(said in line for line in report.dropped)


def test_a_picture_beside_the_file_is_read(tmp_path):
    Image.fromarray(CORNERS).save(tmp_path / "my skin.png")
    pbr = {"baseColorTexture": {"index": 0}}
    document = Document(
        materials=[{"pbrMetallicRoughness": pbr}], textures=[{"source": 0}], images=[{"uri": "my%20skin.png"}]
    )
    craft, report = read_mesh(document.mesh(document.square(material=0)).write(tmp_path / "a.gltf"))
    np.testing.assert_array_equal(craft.parts[0].material.images["base_color"], CORNERS)
    assert report.textures == 1


def broken(change) -> dict:
    document = Document()
    document.mesh({"attributes": {"POSITION": document.add(SQUARE)}, "indices": document.add(QUAD)})
    value = json.loads(json.dumps({**document.json, "buffers": [{"byteLength": len(document.data)}]}))
    uri = "data:application/octet-stream;base64," + base64.b64encode(document.data).decode()
    value["buffers"][0]["uri"] = uri
    change(value)
    return value


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["buffers"][0].update(uri="lost.bin"), "lost.bin.*not there"),
        (lambda d: d["buffers"][0].update(uri="../lost.bin"), "outside"),
        (lambda d: d["buffers"][0].update(byteLength=999), "expected 999 bytes"),
        (lambda d: d["accessors"][0].update(count=4_000_000_000), "4,000,000,000"),
        (lambda d: d["accessors"][0].update(count=-1), "an index"),
        (lambda d: d["accessors"][0].update(type="MAT4"), "components"),
        (lambda d: d["bufferViews"][0].update(byteOffset=10_000), "buffer view"),
        (lambda d: d["nodes"][0].update(children=[0]), "a tree of nodes|found none"),
        (lambda d: d.update(scenes=[{"nodes": [0, 0]}]), "a tree of nodes"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "without compression"),
        (lambda d: d["meshes"][0]["primitives"][0].update(indices="x"), "an index"),
        (lambda d: d.pop("meshes"), "damage"),
        (lambda d: d.update(nodes=7), "damage"),
    ],
)
def test_broken_documents_end_in_one_sentence(tmp_path, change, said):
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(broken(change)))
    with pytest.raises(InputError, match=said) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)


def test_a_glb_that_is_cut_off(tmp_path):
    data = trimesh.Scene(trimesh.creation.box()).export(file_type="glb")
    path = tmp_path / "cut.glb"
    for size in (3, 11, 19, 60, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"cut off|begins with"):
            read_mesh(path)


def reflected(bsdf: dict) -> np.ndarray:
    """[32] fraction of light from 32 directions, spread evenly in cosine squared, that a plate sends back."""
    mi = backend.mitsuba()
    count, each = 32, 4000
    loaded = mi.load_dict(bsdf)
    cosine = np.sqrt((np.arange(count) + 0.5) / count).repeat(each)
    rng = np.random.default_rng(0).random((3, count * each)).astype(np.float32)
    hit = mi.SurfaceInteraction3f()
    hit.t, hit.n, hit.sh_frame = mi.Float(1.0), mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    hit.wi = mi.Vector3f(upload(np.sqrt(1 - cosine**2)), 0, upload(cosine))
    weight = loaded.sample(mi.BSDFContext(), hit, upload(rng[0]), mi.Point2f(upload(rng[1]), upload(rng[2])))[1]
    return np.array(weight)[0].reshape(count, each).mean(axis=1)


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.3, 0.6, 1.0])
def test_no_surface_gives_out_more_light_than_an_even_sky_brings(metallic, roughness):
    """Means over directions spread in cosine squared are what a plate reflects of an even sky."""
    surface = Surface("white", (1.0, 1.0, 1.0), metallic, roughness)
    assert reflected(dict(material_of(surface, "a", "b", Notes()).bsdf)).mean() <= 1.0


def test_without_the_limit_there_would_be_more():
    assert reflected(dict(principled("white", (1.0, 1.0, 1.0), 0.0, 1.0).bsdf)).mean() > 1.02


@pytest.mark.parametrize("scale", [[1, 1, 1], [1.0, 2.0, 0.5], [-1.0, 2.0, 0.5]])
def test_normals_of_vertices_follow_their_node(tmp_path, scale):
    """Of an ellipsoid x^T A x = 1 the normal is along A x, whatever stretched, mirrored or turned the sphere."""
    path = ball(tmp_path, scale=scale, rotation=[0.5, 0.5, 0.5, 0.5])  # x to y, y to z, z to x
    craft, report = read_mesh(path, up="z", scale=3.0)
    part = craft.parts[0]
    corners = part.mesh.triangles.reshape(-1, 3)
    expected = corners / np.roll(scale, 1) ** 2
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(part.normals, expected, atol=2e-6)
    assert part.mesh.is_watertight
    assert part.mesh.volume > 0
    assert not report.dropped


def test_smooth_surfaces_shade_as_if_round_and_their_truth_stays_flat(tmp_path):
    mi = backend.mitsuba()
    craft, _ = read_mesh(ball(tmp_path), up="z")
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3]) @ np.diag([2.0, 2.0, 2.0, 1.0])
    scene = Scene("ball", (SceneObject(craft, turn),))
    loaded = load(scene)
    starts = loaded.units.points(np.random.default_rng(0).uniform([-1.2, -1.2, 5], [1.2, 1.2, 5], (500, 3)))
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(starts.T, np.float32)), mi.Vector3f(0, 0, -1))
    hit = loaded.sunlit.ray_intersect(ray)
    point = np.array(hit.p).T
    outward = point / np.linalg.norm(point, axis=1, keepdims=True)
    shading, geometric = np.array(hit.sh_frame.n).T, np.array(hit.n).T
    assert np.degrees(np.arccos(np.clip((shading * outward).sum(axis=1), -1, 1))).max() < 0.2
    assert np.degrees(np.arccos(np.clip((geometric * outward).sum(axis=1), -1, 1))).max() > 3
    facets = scene.mesh.face_normals[np.array(hit.prim_index)]
    np.testing.assert_allclose(geometric, facets, atol=1e-5)


def test_normals_that_cannot_be_are_the_facets_own(tmp_path):
    def damaged(normals):
        normals[:40] = 0.0
        normals[40:80] = np.nan
        normals[80] = -normals[80]
        return normals

    part = read_mesh(ball(tmp_path, damaged), up="z")[0].parts[0]
    facets = np.repeat(part.mesh.face_normals, 3, axis=0)
    unit = part.mesh.triangles.reshape(-1, 3)
    broken = np.isin(part.mesh.faces.ravel(), np.arange(81))
    np.testing.assert_allclose(part.normals[broken], facets[broken], atol=1e-6)
    np.testing.assert_allclose(part.normals[~broken], unit[~broken], atol=1e-6)
    inward = read_mesh(ball(tmp_path, lambda normals: -normals), up="z")[0].parts[0]
    np.testing.assert_allclose(inward.normals, unit, atol=1e-6)


def test_normals_of_flat_faces_are_not_kept(tmp_path):
    document = Document()
    square = document.square()
    square["attributes"]["NORMAL"] = document.add(np.tile([0, 0, 1], (4, 1)).astype("<f4"))
    craft, _ = read_mesh(document.mesh(square).write(tmp_path / "plate.gltf"), up="z")
    assert craft.parts[0].normals is None


def test_an_accessor_without_data_is_no_larger_than_can_be_meant(tmp_path):
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 60_000_000, "type": "VEC3"}],
    }
    path = tmp_path / "zeros.gltf"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="accessor 0: expected at most 16,777,216 bytes, found 60,000,000 elements"):
        read_mesh(path)


def test_a_mesh_that_is_placed_too_often_is_refused_before_it_is_made(tmp_path, monkeypatch):
    document = Document().mesh({"attributes": {"POSITION": 0}})
    document.add(np.tile(SQUARE, (30_000, 1))[:90_000])
    document.json["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(1000)]
    document.json["scenes"] = [{"nodes": list(range(1000))}]
    document.json["buffers"] = [
        {"byteLength": len(document.data), "uri": "data:;base64," + base64.b64encode(document.data).decode()}
    ]
    path = tmp_path / "many.gltf"
    path.write_text(json.dumps(document.json))
    monkeypatch.setattr(memory, "main_memory", lambda: 400_000_000)
    with pytest.raises(InputError, match="expected a mesh that fits into memory"):
        read_mesh(path)
