"""Files that are written take the place of earlier ones of their kind, and of nothing else."""

import json
import shutil
from pathlib import Path

import pytest

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.integrity.outputs import check_evaluation_folder, check_output, clear_evaluation


def is_refused(path: Path, kind: str, words: str) -> bool:
    with pytest.raises(InputError) as refused:
        check_output(path, kind)
    return str(refused.value).startswith(f"{path}: expected a file that is no {words}'s own, found one of ")


def test_names_and_folders(tmp_path):
    for name in ("a.OBJ", "sub/a.ply"):
        check_output(tmp_path / name, "mesh")
    with pytest.raises(
        InputError, match=r"a\.txt: expected a file name that ends in .ply, .obj, .glb or .stl, found .txt"
    ):
        check_output(tmp_path / "a.txt", "mesh")
    with pytest.raises(InputError, match=r"a: expected a file name that ends in .ply, found no extension"):
        check_output(tmp_path / "a", "ply")
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(InputError, match="expected a file to write, found a folder"):
        check_output(tmp_path / "a.ply", "ply")


def test_files_of_a_run(tiny_run, tmp_path):
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    (run / "page.html").touch()
    (tmp_path / "checkpoints").mkdir()
    for name in ("config.json", "training.json"):
        assert is_refused(run / name, "poses", "run")
        (tmp_path / f"{name}.ply").symlink_to(run / name)
        assert is_refused(tmp_path / f"{name}.ply", "ply", "run")
    for free, kind in ((run / "page.html", "html"), (run / "poses.json", "poses"), (run / "a.ply", "ply")):
        check_output(free, kind)


def test_files_of_an_evaluation_but_for_those_of_the_same_kind(tiny_eval):
    assert is_refused(tiny_eval / "report.html", "html", "evaluation")
    assert is_refused(tiny_eval / "camera_density.png", "picture", "evaluation")
    assert is_refused(next(tiny_eval.glob("frames/*/truth.png")), "camera density", "evaluation")
    assert is_refused(tiny_eval / "geometry/reconstruction.ply", "mesh", "evaluation")
    check_output(tiny_eval / "report.html", "report")
    check_output(tiny_eval / "camera_density.png", "camera density")


def test_files_of_a_dataset_without_digests(tmp_path):
    for name in ("images/a.png", "images/b.png", "images/c.png", "p.ply"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    frames = [{"file_path": "./images/a.png"}, {"file_path": "images/b"}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames, "ply_file_path": "p.ply"}))
    assert is_refused(tmp_path / "images/a.png", "picture", "dataset")
    assert is_refused(tmp_path / "images/b.png", "picture", "dataset")
    assert is_refused(tmp_path / "p.ply", "ply", "dataset")
    assert is_refused(tmp_path / "transforms.json", "poses", "dataset")
    check_output(tmp_path / "images/c.png", "picture")


def test_functions_that_write_are_guarded(tiny_run, tiny_data, tiny_eval, tmp_path):
    view = ss.load_run(tiny_run).render(ss.read_dataset(tiny_data).test[0].camera)
    with pytest.raises(InputError, match="no dataset's own"):
        view.save(tiny_data / "images/test_00000.png")
    with pytest.raises(
        InputError, match=r"transforms\.json: expected a file name that ends in .html or .htm, found .json"
    ):
        ss.write_report(tiny_eval, tiny_data / "transforms.json")
    assert ss.write_report(tiny_eval, tiny_eval / "report.html").is_file()


def test_all_that_an_evaluation_writes_is_known(tiny_eval, tmp_path):
    """What a killed one leaves is taken for it, and nothing of it stays."""
    folder = Path(shutil.copytree(tiny_eval, tmp_path / "eval"))
    check_evaluation_folder(folder)
    (folder / "report.html").unlink()
    (folder / "metrics.json").unlink()
    check_evaluation_folder(folder)
    clear_evaluation(folder)
    assert list(folder.iterdir()) == []
