"""Files that are written take the place of earlier ones of their kind, and of nothing else."""

import errno
import json
import shutil
from pathlib import Path

import pytest

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.integrity import outputs
from spacesim.data.integrity.outputs import check_evaluation_folder, check_output, clear_evaluation, replaced_content


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


def clear(folder: Path) -> None:
    for name in ("own.json", "a/own", "b/own"):
        (folder / name).unlink(missing_ok=True)


def put(out: Path, text: str, names=("a/own", "own.json"), stop=None, clear=clear) -> None:
    with replaced_content(out, clear) as part:
        for name in names:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_text(text)
        if stop is not None:
            raise stop


def content(out: Path) -> dict[str, str]:
    return {str(path.relative_to(out)): path.read_text() for path in out.rglob("*") if path.is_file()}


def test_content_is_replaced_as_a_whole(tmp_path):
    out = tmp_path / "x/out"
    with pytest.raises(ValueError, match="stop"):
        put(out, "none", stop=ValueError("stop"))
    assert not out.exists()
    put(out, "old", ("a/own", "b/own", "own.json"))
    (out / "a/mine").write_text("mine")
    with pytest.raises(ValueError, match="stop"):
        put(out, "none", stop=ValueError("stop"))
    assert content(out) == {"a/own": "old", "b/own": "old", "own.json": "old", "a/mine": "mine"}
    put(out, "new")
    assert content(out) == {"a/own": "new", "own.json": "new", "a/mine": "mine"}


class Killed(BaseException):
    """The process ends here: nothing after it runs, the `finally` of this test's process aside."""


@pytest.mark.parametrize("error", [KeyboardInterrupt, Killed])
@pytest.mark.parametrize("step", ["clear", "rename", "first move", "second move"])
def test_complete_content_gets_to_its_place_whatever_happens(tmp_path, monkeypatch, step, error):
    """After Ctrl-C at once, after kill -9 by the next call, even where that one fails."""
    put(tmp_path, "old", ("a/own", "b/own", "own.json"))
    moved, rename, replace, todo = [], Path.rename, Path.replace, [error()]

    def stop_at(name: str) -> None:
        if step == name and todo:
            raise todo.pop()

    def stopping_clear(folder: Path) -> None:
        stop_at("clear")
        clear(folder)

    def stopping_rename(path: Path, target: Path) -> Path:
        if path.name == outputs.WRITTEN:
            stop_at("rename")
        return rename(path, target)

    def stopping_replace(path: Path, target: Path) -> Path:
        stop_at(("first move", "second move")[len(moved) > 0])
        moved.append(path)
        return replace(path, target)

    monkeypatch.setattr(Path, "rename", stopping_rename)
    monkeypatch.setattr(Path, "replace", stopping_replace)
    with pytest.raises(error):
        put(tmp_path, "new", clear=stopping_clear)
    assert not todo
    if error is Killed:
        assert content(tmp_path) != {"a/own": "new", "own.json": "new"}
        with pytest.raises(ValueError, match="stop"):
            put(tmp_path, "none", stop=ValueError("stop"))
    assert content(tmp_path) == {"a/own": "new", "own.json": "new"}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(("name", "is_folder"), [("a", False), ("own.json", True), ("a/own", True)])
def test_nothing_takes_the_place_of_another_kind(tmp_path, name, is_folder):
    put(tmp_path, "old", ("b/own",))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).mkdir() if is_folder else (tmp_path / name).write_text("mine")
    before = content(tmp_path)
    with pytest.raises(InputError, match=f"{name}: expected room for a {'file' if is_folder else 'folder'}, found a "):
        put(tmp_path, "new")
    assert content(tmp_path) == before


def test_a_link_to_a_folder_on_another_disk_stays(tmp_path, monkeypatch):
    put(tmp_path / "out", "old")
    (tmp_path / "out/a").rename(tmp_path / "far")
    (tmp_path / "out/a").symlink_to(tmp_path / "far")
    replace = Path.replace

    def other_disk(path: Path, target: Path) -> Path:
        if path.name == "own":
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", other_disk)
    put(tmp_path / "out", "new")
    assert (tmp_path / "out/a").is_symlink()
    assert content(tmp_path / "far") == {"own": "new"}
    assert (tmp_path / "out/own.json").read_text() == "new"
