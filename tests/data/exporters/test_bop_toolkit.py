"""BOP's own toolkit reads what we write, and reckons the same of it: github.com/thodan/bop_toolkit, on PYTHONPATH."""

import json
from itertools import product
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from spacesim.data.exporters import LabelledObject, write_bop
from spacesim.data.exporters.bop import _write_models
from spacesim.data.exporters.keypoints import BodyLabels
from spacesim.data.exporters.symmetries import find_symmetries
from spacesim.data.images import read_png
from spacesim.scenes.config import with_options
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.silhouette import silhouette_finder

WHY = "bop_toolkit_lib is not installed"
inout = pytest.importorskip("bop_toolkit_lib.inout", reason=WHY, exc_type=ImportError)
misc = pytest.importorskip("bop_toolkit_lib.misc", reason=WHY, exc_type=ImportError)
pose_error = pytest.importorskip("bop_toolkit_lib.pose_error", reason=WHY, exc_type=ImportError)
visibility = pytest.importorskip("bop_toolkit_lib.visibility", reason=WHY, exc_type=ImportError)

WIDTH, HEIGHT = 128, 96
DELTA = 15.0  # millimetres: scripts/calc_gt_info.py
TAUS = np.arange(0.05, 0.51, 0.05)  # of the diameter: scripts/eval_bop19_pose.py
COUNTS = "px_count_all", "px_count_valid", "px_count_visib"


@pytest.fixture(scope="module")
def bop(three_objects, tmp_path_factory) -> Path:
    """`three_objects`, cut off by the picture."""
    options = {"views": 2, "test_views": 2, "resolution": (WIDTH, HEIGHT)}
    root = tmp_path_factory.mktemp("bop")
    data = generate(with_options(three_objects, **options), root / "data")
    write_bop(data, root / "bop", silhouette_finder)
    return root / "bop"


@pytest.fixture(scope="module")
def models(bop) -> dict[int, dict]:
    """As the toolkit reads them."""
    return {k: inout.load_ply(bop / f"models_eval/obj_{k:06d}.ply") for k in infos(bop)}


def infos(bop: Path) -> dict[int, dict]:
    found: dict[int, dict] = inout.load_json(bop / "models_eval/models_info.json", keys_to_int=True)
    return found


class RayCaster:
    """Depth of a model alone, millimetres, by the method that the toolkit calls of its renderers."""

    def __init__(self, models: dict[int, dict], width: int, height: int) -> None:
        self.size, self.trees = (width, height), {}
        for number, model in models.items():
            points = np.ascontiguousarray(model["pts"], np.float64)
            faces = np.ascontiguousarray(model["faces"], np.int64)
            self.trees[number] = (igl.AABB(), points, faces)
            self.trees[number][0].init(points, faces)

    def render_object(self, obj_id, R, t, fx, fy, cx, cy):
        x, y = np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1]))
        rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(x.shape)], axis=-1).reshape(-1, 3) @ R  # to body axes
        origins = np.tile(-np.reshape(t, 3) @ R, (len(rays), 1))
        tree, points, faces = self.trees[obj_id]
        hit, reach, _ = tree.intersect_ray_first(points, faces, origins, np.ascontiguousarray(rays))
        return {"depth": np.where(hit >= 0, reach, 0).reshape(x.shape)}


def images_of(bop: Path):
    """(split, image number, camera, poses, gt_infos) as the toolkit reads them."""
    for split in ("train", "test"):
        scene = bop / split / "000000"
        cameras = inout.load_scene_camera(scene / "scene_camera.json")
        poses = inout.load_scene_gt(scene / "scene_gt.json")
        gt_infos = inout.load_json(scene / "scene_gt_info.json", keys_to_int=True)
        assert cameras.keys() == poses.keys() == gt_infos.keys() == {0, 1}
        for image in cameras:
            yield scene, image, cameras[image], poses[image], gt_infos[image]


def test_visibility_counts_and_boxes_are_those_that_the_toolkit_finds(bop, models):
    """As scripts/calc_gt_info.py does it, with its way to tell what is visible."""
    caster = RayCaster(models, 3 * WIDTH, 3 * HEIGHT)
    cut = hidden = 0
    for scene, image, camera, poses, gt_infos in images_of(bop):
        k = camera["cam_K"]
        depth = camera["depth_scale"] * inout.load_depth(scene / f"depth/{image:06d}.png")
        assert inout.load_im(scene / f"rgb/{image:06d}.png").shape == (HEIGHT, WIDTH, 3)
        distance = misc.depth_im_to_dist_im_fast(depth, k)
        for index, (pose, info) in enumerate(zip(poses, gt_infos, strict=True)):
            centre = k[0, 2] + WIDTH, k[1, 2] + HEIGHT
            place = pose["obj_id"], pose["cam_R_m2c"], pose["cam_t_m2c"]
            large = caster.render_object(*place, k[0, 0], k[1, 1], *centre)["depth"]
            alone = misc.depth_im_to_dist_im_fast(large[HEIGHT : 2 * HEIGHT, WIDTH : 2 * WIDTH], k)
            visible = visibility.estimate_visib_mask_gt(distance, alone, DELTA, visib_mode="bop19")
            ours = [read_png(scene / f"{name}/{image:06d}_{index:06d}.png") > 0 for name in ("mask", "mask_visib")]
            for mask, found in zip(ours, (alone > 0, visible), strict=True):
                assert (mask != found).sum() <= 4 + 0.02 * mask.sum()
            counts = (large > 0).sum(), (distance[alone > 0] > 0).sum(), visible.sum()
            for name, count in zip(COUNTS, counts, strict=True):
                assert abs(info[name] - count) <= 4 + 0.02 * count, name
            assert info["visib_fract"] == pytest.approx(visible.sum() / max((large > 0).sum(), 1), abs=0.03)
            if not visible.any():
                continue
            ys, xs = np.nonzero(large > 0)
            boxes = misc.calc_2d_bbox(xs - WIDTH, ys - HEIGHT), misc.calc_2d_bbox(*np.nonzero(visible)[::-1])
            for name, box in zip(("bbox_obj", "bbox_visib"), boxes, strict=True):
                np.testing.assert_allclose(info[name], box, atol=1.5)
            hidden += 0 < info["visib_fract"] < 0.9
            cut += info["px_count_all"] > ours[0].sum()
    assert cut > 0
    assert hidden > 0


def test_errors_are_zero_of_the_truth_alone(bop, models):
    caster = RayCaster(models, WIDTH, HEIGHT)
    turn = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    for scene, image, camera, poses, gt_infos in images_of(bop):
        k = camera["cam_K"]
        depth = camera["depth_scale"] * inout.load_depth(scene / f"depth/{image:06d}.png")
        for pose, seen in zip(poses, gt_infos, strict=True):
            number, info = pose["obj_id"], infos(bop)[pose["obj_id"]]
            points, r, t = models[number]["pts"], pose["cam_R_m2c"], pose["cam_t_m2c"]
            symmetries = misc.get_symmetry_transformations(info, max_sym_disc_step=0.01)
            assert pose_error.mssd(r, t, r, t, points, symmetries) == 0
            assert pose_error.mssd(r @ turn, t, r, t, points, symmetries) > 0.02 * info["diameter"]
            assert pose_error.mspd(r, t, r, t, k, points, symmetries) == 0
            if seen["visib_fract"] > 0.3:
                rest = depth, k, DELTA, TAUS, True, info["diameter"], caster, number
                assert max(pose_error.vsd(r, t, r, t, *rest)) == 0
                assert min(pose_error.vsd(r, t + np.array([[0.0], [0.0], [info["diameter"]]]), r, t, *rest)) > 0.2


def test_symmetries_take_models_to_themselves(tmp_path):
    """A prism, whose vertices fall on vertices, and a cylinder of 64 sides, about axes beside the origin."""
    shapes = trimesh.creation.box((1, 1, 3)), trimesh.creation.cylinder(0.5, 2, sections=64)
    targets, bodies = [], []
    for number, mesh in enumerate(shapes, start=1):
        mesh.apply_translation([0.2, -0.1, 0.3])
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        targets.append(LabelledObject(number, f"body {number}", np.eye(4), vertices, faces))
        bodies.append(BodyLabels(number, {"a": (0.0, 0.0, 0.0)}, "", *find_symmetries(vertices, faces)))
    _write_models(tmp_path, targets, [1, 2], bodies)
    models_info = inout.load_json(tmp_path / "models/models_info.json", keys_to_int=True)
    unturned = np.eye(3), np.zeros((3, 1))
    for number, least, tolerance in ((1, 8, 1e-6), (2, 300, 0.012)):
        points = inout.load_ply(tmp_path / f"models/obj_{number:06d}.ply")["pts"]
        ways = misc.get_symmetry_transformations(models_info[number], max_sym_disc_step=0.01)
        assert len(ways) >= least
        errors = [pose_error.adi(way["R"], way["t"], *unturned, points) for way in ways]
        assert max(errors) < tolerance * models_info[number]["diameter"]
        far = ways[len(ways) // 3]
        assert pose_error.add(far["R"], far["t"], *unturned, points) > 0.1 * models_info[number]["diameter"]
        assert pose_error.mssd(far["R"], far["t"], *unturned, points, ways) < 1e-9


def test_models_targets_and_results(bop, models, tmp_path):
    assert {number: len(model["faces"]) > 100 for number, model in models.items()} == {1: True, 2: True}
    for number, info in infos(bop).items():
        points = inout.load_ply(bop / f"models/obj_{number:06d}.ply")["pts"]
        assert info["diameter"] == pytest.approx(misc.calc_pts_diameter(points), rel=1e-6)
        low, size = ([info[f"{name}_{axis}"] for axis in "xyz"] for name in ("min", "size"))
        np.testing.assert_allclose(misc.calc_3d_bbox(*points.T), [*low, *size], rtol=1e-4, atol=1e-2)
    targets, results = [], []
    for scene, image, _, poses, gt_infos in images_of(bop):
        if scene.parent.name == "test":
            found = inout.get_im_targets(poses, gt_infos, 0.1)
            targets += [{"scene_id": 0, "im_id": image, "obj_id": k, **count} for k, count in found.items()]
            results += [
                {"scene_id": 0, "im_id": image, "obj_id": pose["obj_id"], "score": 1.0, "time": 1.0}
                | {"R": pose["cam_R_m2c"], "t": pose["cam_t_m2c"]}
                for pose in poses
            ]
    written = json.loads((bop / "test_targets_bop19.json").read_text())
    key = ("scene_id", "im_id", "obj_id", "inst_count")
    assert sorted([one[k] for k in key] for one in written) == sorted([one[k] for k in key] for one in targets)
    path = tmp_path / "truth_three-test.csv"
    inout.save_bop_results(path, results)
    assert inout.check_bop_results(path) == (True, "OK")
    again = inout.load_bop_results(path)
    for (a, b), name in product(zip(again, results, strict=True), ("R", "t")):
        np.testing.assert_allclose(a[name], b[name], atol=1e-4)
    camera = inout.load_cam_params(bop / "camera.json")
    assert camera["im_size"] == (WIDTH, HEIGHT)
