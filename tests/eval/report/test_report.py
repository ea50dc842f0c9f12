"""The report as a browser parses it: its numbers, its pictures, and nothing from outside."""

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.eval.evaluate import evaluate
from spacesim.eval.labels import IMAGE, LOWER, Metric
from spacesim.eval.metrics.shadow import KINDS
from spacesim.eval.report import charts
from spacesim.eval.report.write import write_report

VOID = {"meta", "img", "path", "rect", "br", "wbr"}


class Page(HTMLParser):
    """Collects text, tags and attributes; fails where tags do not close in their order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.text.append(data)

    def values(self, tag, name):
        return [value for t, n, value in self.attributes if (t, n) == (tag, name)]


@pytest.fixture
def folder(make_run, dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    evaluate(make_run(lambda rgb: np.roll(rgb, 1, axis=1)), dataset, tmp_path / "eval")
    return tmp_path / "eval"


def another(folder, name, change):
    """A copy of an EVAL folder with metrics.json changed in place by `change`."""
    copy = folder.with_name(name)
    shutil.copytree(folder, copy)
    metrics = json.loads((copy / "metrics.json").read_text())
    change(metrics)
    (copy / "metrics.json").write_text(json.dumps(metrics))
    return copy


def page_of(*folders):
    out = folders[0].parent / "report.html"
    write_report(folders, out)
    return Page(out.read_text())


def test_how_far_estimated_suns_may_be_off_is_told(folder):
    def estimate(metrics):
        metrics["training"]["suns"] = {"sigma_deg": 37.4}

    assert "estimated Suns off" not in "".join(page_of(folder).text)
    assert "37° (median, by pictures held out)" in "".join(page_of(another(folder, "estimated", estimate)).text)


def test_numbers_are_there(folder):
    metrics = json.loads((folder / "metrics.json").read_text())
    text = "".join(page_of(folder).text)
    for group, keys in {
        "image": ("ssim", "mae", "rmse", "flip"),
        "image_full": ("ssim", "mae", "rmse", "flip"),
        "shadow": ("ber", "bias", "boundary_mae"),
        "shadow_full": ("ber", "bias", "boundary_mae"),
    }.items():
        for key in keys:
            value = metrics[group][key]
            assert f"{value['mean']:.4f} ± {value['std']:.4f}" in text
    for group in ("image", "image_full"):
        assert f"{metrics[group]['psnr']['mean']:.2f} ± {metrics[group]['psnr']['std']:.2f}" in text
    for fact in (
        "sphere",
        "vanilla",
        "spacesim train data --out runs/fake",
        "1.5.0",
        "123",
        "12.5 s",
        "llvm",
    ):
        assert fact in text
    for note in metrics["notes"]:
        assert note in text


def test_map_of_the_training_cameras(folder, lit, tmp_path):
    """Of the run that was trained on one frame; runs with the same map show it once; without training frames, none."""
    assert not (folder / "camera_density.png").exists()
    assert "Training cameras" not in page_of(folder).text
    page = page_of(lit, another(lit, "again", lambda metrics: metrics.update(run="runs/again")))
    assert "Training cameras" in page.text
    assert [alt for alt in page.values("img", "alt") if "density" in alt] == ["Camera density, fake, again"]


@pytest.fixture
def lit(relightable, tmp_path, monkeypatch):
    """An EVAL folder of a run that predicts visibility, under a known Sun and one never seen."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    run, dataset = relightable(edge=25)
    evaluate(run, dataset, tmp_path / "lit")
    return tmp_path / "lit"


def tables(page_text):
    """{caption: rows of cells' text} of a page's tables."""
    found = {}
    for part in re.findall(r"<table>(.*?)</table>", page_text, re.DOTALL):
        caption = re.search(r"<caption>(.*?)</caption>", part).group(1)
        rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", part)]
        found[caption] = [[re.sub(r"<[^>]*>", "", cell.replace("<br>", " ")) for cell in row] for row in rows]
    return found


def test_known_and_unseen_suns_have_tables_of_their_own(lit):
    def harder(metrics):
        metrics["unseen_suns"]["image"]["ssim"] |= {"mean": 0.4321, "std": 0.0123}

    lit = another(lit, "harder", harder)
    page_of(lit)
    metrics = json.loads((lit / "metrics.json").read_text())
    found = tables((lit.parent / "report.html").read_text())
    for suns, caption in (
        ("known_suns", "Known Suns: 2 views, 1 Sun"),
        ("unseen_suns", "Suns never seen in training: 2 views, 1 Sun"),
    ):
        head, row = found[caption]
        cells = dict(zip(head, row, strict=True))
        for group, key, label in (("image", "ssim", "SSIM ↑"), ("shadow_mask", "error_rate", "Mask error rate ↓")):
            value = metrics[suns][group][key]
            pooled = f"{value['pooled']:.4f} mean of frames " if group == "shadow_mask" else ""
            assert cells[label] == f"{pooled}{value['mean']:.4f} ± {value['std']:.4f}"
    assert found["Suns never seen in training: 2 views, 1 Sun"][1][2] == "0.4321 ± 0.0123"


def test_a_metric_that_is_appended_takes_the_place_of_none(lit, monkeypatch):
    """In the cards and in the tables by Suns, which show FLIP where no run has LPIPS."""
    before = page_of(lit)
    assert any("FLIP" in part for part in before.text)
    new = Metric("new", "Appended", "", LOWER, 4, "A metric of a later version.")
    for module in ("write", "tables"):
        monkeypatch.setattr(f"spacesim.eval.report.{module}.IMAGE", (*IMAGE, new))
    assert page_of(lit).text == before.text


def test_errors_by_grazing_angle_are_there(lit):
    def bins(metrics):
        metrics["by_grazing_angle"][0] |= {"pixels": 1234, "luminance_mae": 0.0625, "false_shadow": 0.5}

    lit = another(lit, "bins", bins)
    page = page_of(lit)
    head, first, *_, last = tables((lit.parent / "report.html").read_text())["By grazing angle"]
    assert dict(zip(head, first, strict=True)) == {
        "Grazing angle": "0–5°",
        "Pixels": "1,234",
        "Luminance MAE ↓": "0.0625",
        "Visibility MAE ↓": "–",
        "Error rate ↓": "–",
        "False shadow ↓": "0.5000",
        "Missed shadow ↓": "–",
    }
    steep = json.loads((lit / "metrics.json").read_text())["by_grazing_angle"][-1]
    assert last[:2] == ["40–90°", f"{steep['pixels']:,}"]
    labels = page.values("svg", "aria-label")
    assert [label for label in labels if "grazing" in label] == [
        f"{name} ↓ by grazing angle" for name in ("Luminance MAE", "False shadow", "Missed shadow")
    ]


def test_masks_and_the_relit_view_are_the_folders(lit):
    page = page_of(lit)
    shown = {
        np.asarray(Image.open(io.BytesIO(base64.b64decode(value.partition(",")[2])))).tobytes()
        for value in page.values("img", "src")
    }
    names = ("mask_truth", "mask_prediction", "visibility")
    for index in range(4):
        assert read_png(lit / "frames" / f"test_{index:05d}" / "mask_prediction.png").tobytes() in shown
    assert {read_png(lit / "frames" / "test_00000" / f"{name}.png").tobytes() for name in names} <= shown
    for path in (lit / "relight").iterdir():
        assert read_png(path).tobytes() in shown
    text = "".join(page.text)
    assert "under each of these Suns" in text
    assert "Every frame" in text
    assert text.count("unseen") > 3
    assert "no truth" not in text


def test_a_frame_of_a_few_pixels_is_not_the_best_by_masks(lit):
    def few(metrics):
        metrics["frames"][2]["shadow_mask"] |= {"balanced_error_rate": 0.0, "pixels": pixels}

    for pixels, found in ((3, False), (3000, True)):
        text = "".join(page_of(another(lit, f"few{pixels}", few)).text)
        assert ("balanced error rate 0.0000" in text) is found


def test_suns_without_truth_are_said_to_have_none(lit):
    def forget(metrics):
        metrics["relight"]["suns"][1] |= {"truth": None, "psnr": None}

    lit = another(lit, "forgotten", forget)
    (lit / "relight" / "truth_01.png").unlink()
    text = "".join(page_of(lit).text)
    assert text.count("no truth") == 1
    assert "the truth of this very view under 1 of these 2 Suns" in text


def test_runs_with_and_without_visibility_side_by_side(lit, folder):
    def moved(metrics):
        metrics["run"] = "runs/lit"

    lit = another(lit, "moved", moved)
    text = "".join(page_of(lit, folder).text)
    for title in ("One view, many Suns", "Shadow masks", "Known and unseen Suns", "By grazing angle"):
        assert title in text
    assert "None" not in text
    alone = "".join(page_of(folder).text)
    for title in ("One view, many Suns", "Shadow masks", "Known and unseen Suns"):
        assert title not in alone
    assert "By grazing angle" in alone


def test_evaluations_of_older_versions_are_read(folder):
    def older(metrics):
        for key in ("known_suns", "unseen_suns", "relight", "by_grazing_angle", *KINDS):
            del metrics[key]
        for frame in metrics["frames"]:
            for key in ("known_sun", *KINDS):
                del frame[key]

    text = "".join(page_of(another(folder, "older", older)).text)
    assert "By grazing angle" not in text
    assert "Results" in text


def test_nothing_from_outside(folder):
    page = page_of(folder)
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    references = [v for _, name, v in page.attributes if name in ("src", "href", "srcset", "data", "xlink:href")]
    assert references
    assert all(value.startswith("data:image/png;base64,") for value in references)
    pictures = re.compile("data:image/png;base64,[A-Za-z0-9+/=]+")
    rest = pictures.sub("", (folder.parent / "report.html").read_text())
    assert not re.search(r"https?:|//|url\(|@import", rest)


def test_pictures_are_the_folders(folder):
    page = page_of(folder)
    assert all(page.values("img", "alt"))
    pictures = [base64.b64decode(value.partition(",")[2]) for value in page.values("img", "src")]
    assert len(pictures) == 21
    shown = {np.asarray(Image.open(io.BytesIO(data))).tobytes() for data in pictures}
    frames = sorted(json.loads((folder / "metrics.json").read_text())["frames"], key=lambda frame: -frame["psnr"])
    for frame in (frames[0], frames[2], frames[-1]):
        for panel in ("truth", "prediction", "error", "shadow_truth", "shadow_prediction", "depth_truth", "depth"):
            assert read_png(folder / "frames" / frame["name"] / f"{panel}.png").tobytes() in shown


def test_hostile_names_are_escaped(folder):
    attack = '<script>alert("x")</script>\'"><img src=http://evil.example/x onerror=alert(1)>'

    def spoil(metrics):
        metrics |= {"run": f"runs/{attack}", "data": attack, "notes": [attack]}
        metrics["config"]["method"] = attack
        metrics["config"][attack] = attack
        metrics["training"]["command"] = attack
        metrics["versions"][attack] = attack
        metrics["dataset"]["scene"] = attack
        metrics["model"]["backend"] = attack
        for frame in metrics["frames"]:
            frame["file_path"] = attack

    hostile = another(folder, "hostile", spoil)
    for folders in ((hostile,), (hostile, folder)):
        page = page_of(*folders)
        assert "script" not in page.tags
        assert all(value.startswith("data:") for value in page.values("img", "src"))
        assert not any(name.startswith("on") for _, name, _ in page.attributes)
        assert attack in "".join(page.text)


def test_hostile_views_are_escaped(lit):
    attack = '"><script>alert(1)</script><b onclick="x">'

    def spoil(metrics):
        metrics["run"] = attack
        metrics["relight"]["view"] = attack
        for frame in metrics["frames"]:
            frame["file_path"] = attack

    hostile = another(lit, "hostile", spoil)
    for folders in ((hostile,), (hostile, lit)):
        page = page_of(*folders)
        assert "script" not in page.tags
        assert not any(name.startswith("on") for _, name, _ in page.attributes)
        assert attack in "".join(page.text)


def test_folders_cannot_be_left(folder):
    def climb(metrics):
        metrics["frames"][0]["name"] = "../../data"

    with pytest.raises(InputError, match="without folders"):
        page_of(another(folder, "climbing", climb))


def test_runs_side_by_side(folder):
    def better(metrics):
        metrics["run"] = "runs/better"
        metrics["config"]["seed"] = 8
        metrics["image"]["psnr"]["mean"] += 1
        metrics["shadow"]["sharpness_ratio"]["mean"] = 3.0

    copy = another(folder, "better", better)
    page = page_of(folder, copy)
    text = "".join(page.text)
    assert len(page.values("img", "src")) == 42
    assert text.count("fake") >= 4
    assert text.count("better") >= 4
    best = re.findall(r'class="best">([\d.]+)', (folder.parent / "report.html").read_text())
    metrics = [json.loads((f / "metrics.json").read_text()) for f in (folder, copy)]
    assert f"{metrics[1]['image']['psnr']['mean']:.2f}" in best
    assert f"{metrics[0]['shadow']['sharpness_ratio']['mean']:.3f}" in best
    assert "3.000" not in best


def test_runs_on_other_frames_are_not_compared(folder):
    """Three evaluations, two of them on the same frames: two parts, and a best one among those two alone."""

    def worse(metrics):
        metrics |= {"run": "runs/worse", "data": "/elsewhere/moved"}  # the frames say that they are the same
        for summary in metrics["image"].values():
            if summary:
                summary["mean"] += 0.5

    def other(metrics):
        metrics |= {"run": "runs/other"}
        metrics["dataset"] |= {"digest": "0123", "scene": "teapot", "resolution": [640, 480]}
        metrics["image"]["psnr"]["mean"] = 99.25

    page_of(folder, another(folder, "worse", worse), another(folder, "other", other))
    text = (folder.parent / "report.html").read_text()
    first, second = text.split('id="data-1"')[1].split('id="data-2"')
    assert "640 × 480 pixels" in second
    assert "640 × 480 pixels" not in first
    assert "99.25" not in first
    assert 'class="best"' in first
    assert 'class="best"' not in second
    assert text.count("<caption>Image</caption>") == 2
    assert "2 sets of frames" in text


def test_pictures_over_whole_frames_are_not_compared_with_those_over_silhouettes(folder):
    """Older evaluations tell it by image_region alone."""

    def whole(metrics):
        metrics |= {"run": "runs/whole", "image_region": "frame"}
        metrics["dataset"]["ignored"] = 0.84

    text = "".join(page_of(folder, another(folder, "whole", whole)).text)
    assert "2 sets of frames" in text
    assert "Over whole pictures; no silhouette is known" in text
    assert "84 % of the pixels count nowhere" in text


def test_a_digest_of_an_older_version_is_compared_by_what_it_tells(folder):
    digest = json.loads((folder / "metrics.json").read_text())["dataset"]["digest"]
    head, content = digest.split("-")

    def having(name, digest):
        return another(folder, name, lambda m: m.update(run=name, dataset=m["dataset"] | {"digest": digest}))

    old, other = having("old", head), having("other", f"{head}-{content[::-1]}")
    assert "sets of frames" not in "".join(page_of(folder, old).text)
    assert "2 sets of frames" in "".join(page_of(folder, old, other).text)


def test_evaluations_without_a_digest_are_known_by_their_folder(folder):
    def older(metrics):
        del metrics["dataset"]["digest"]
        metrics["run"] = "runs/older"

    def elsewhere(metrics):
        older(metrics)
        metrics["data"] = "/elsewhere"

    assert "sets of frames" not in "".join(page_of(folder, another(folder, "older", older)).text)
    assert "2 sets of frames" in "".join(page_of(folder, another(folder, "elsewhere", elsewhere)).text)


def test_photographs_are_spoken_of_as_such(folder):
    def photographs(metrics):
        without = "shadow", "shadow_full", "depth", "by_grazing_angle", "known_suns", "unseen_suns", "relight"
        metrics |= dict.fromkeys(without)
        metrics |= {"image_region": "frame", "image": metrics["image_full"], "notes": []}
        metrics["dataset"] |= {"truth": False, "suns": 0}
        for frame in metrics["frames"]:
            frame["sun"] = None

    page = page_of(another(folder, "photographs", photographs))
    text = "".join(page.text)
    for word in ("silhouette.", "BER", "Dark pixels", "Sun not known", "By Sun", "Truth", "object's"):
        assert word not in text, word
    assert "Over whole pictures; no silhouette is known" in text
    assert "against the pictures themselves" in text
    assert "Picture" in page.text
    assert len(page.values("img", "src")) == 12


def test_facts_that_nest_get_a_row_each(folder):
    def posed(metrics):
        metrics["dataset"]["config"] = {
            "objects": [{"mesh": "a.stl", "name": "", "two_sided": None}, {"mesh": "b.stl"}]
        }

    text = "".join(page_of(another(folder, "posed", posed)).text)
    for word in ("objects.0.mesh", "objects.1.mesh", "b.stl"):
        assert word in text, word
    for word in ("two_sided", "None"):
        assert word not in text, word


def test_what_was_fitted_is_said_beside_the_numbers(folder):
    def fitted(metrics):
        metrics["run"] = "runs/fitted"
        metrics["fitted"] = [{"name": "embedding", "how": "48 numbers"}, {"name": "gain", "how": "a factor"}]

    text = "".join(page_of(folder, another(folder, "fitted", fitted)).text)
    assert text.count("embedding, gain fitted") > 3
    assert "scored on the other (fitted: embedding, gain)" in text


def test_runs_of_the_same_name_get_different_labels(folder):
    def moved(metrics):
        metrics["run"] = "elsewhere/fake"

    text = "".join(page_of(folder, another(folder, "moved", moved)).text)
    assert "runs/fake" in text
    assert "elsewhere/fake" in text
    assert "(2)" in "".join(page_of(folder, folder).text)


@pytest.mark.parametrize("suns", [1, 100])
def test_histograms_of_few_and_many_suns(folder, suns):
    def multiply(metrics):
        frames = metrics["frames"]
        metrics["frames"] = [
            {**frames[i % 4], "psnr": 20 + i % 7 + 0.1 * i, "sun": [3.0 * (i % suns), 10.0]} for i in range(200)
        ]

    page = page_of(another(folder, "multiplied", multiply))
    titles = [value for value in page.values("svg", "aria-label") if "3°, 10°" in value or "0°, 10°" in value]
    if suns == 1:
        assert titles == ["Histogram, 0°, 10°"]
        assert "200 frames" in page.text
    else:
        assert sum("mean" in text and "of 2" in text for text in page.text) == 100


def test_nulls_everywhere(folder):
    def empty(metrics):
        for group in ("image", "image_full", "shadow", "shadow_full"):
            metrics[group] = dict.fromkeys(metrics[group])
        for frame in metrics["frames"]:
            frame["psnr"] = frame["sun"] = None
        metrics["training"] = {}
        metrics["dataset"] |= {"scene": None, "config": None, "versions": None, "suns": 0}

    text = "".join(page_of(another(folder, "empty", empty)).text)
    assert "None" not in text
    assert not re.search(r"\bnan\b", text)
    assert "No frame has a PSNR." in text


def test_one_frame_is_shown_once(folder):
    def only(metrics):
        metrics["frames"] = metrics["frames"][:1]

    assert len(page_of(another(folder, "only", only)).values("img", "src")) == 7


def test_depth_has_a_scale_in_metres(folder):
    """That of each frame; none for evaluations without it, nor for a frame that shows nothing."""

    def scaled(metrics):
        for frame, far in zip(metrics["frames"], (8.25, 9.25, 10.25), strict=False):
            frame["depth_range"] = [3.125, far]
        metrics["frames"][3]["depth_range"] = None

    def older(metrics):
        del metrics["depth"]
        for frame in metrics["frames"]:
            del frame["depth_range"], frame["depth"]

    deep = another(folder, "deep", scaled)
    text = "".join(page_of(deep).text)
    for far in (8.25, 9.25, 10.25):
        assert text.count(f"3.125\u00a0m  {far}\u00a0m") == 2
    assert "Depth" in page_of(deep, another(folder, "other", lambda metrics: metrics.update(run="o"))).text
    older = another(folder, "older", older)
    assert "Depth" not in page_of(older).text
    assert "metres along the optical axis" not in "".join(page_of(deep, older).text)


def test_frames_of_several_sizes_are_said_to_be(folder):
    many = another(folder, "many", lambda metrics: metrics["dataset"].update(resolution=[640, 480], sizes=3))
    assert "640 × 480 pixels and 2 other sizes" in "".join(page_of(many).text)
    assert "other size" not in "".join(page_of(folder).text)


def test_what_is_no_evaluation(folder, tmp_path):
    out = tmp_path / "report.html"
    with pytest.raises(InputError, match="at least one EVAL folder"):
        write_report([], out)
    with pytest.raises(InputError, match=r"nothing.metrics\.json"):
        write_report([tmp_path / "nothing"], out)
    with pytest.raises(InputError, match="schema 1"):
        write_report([another(folder, "newer", lambda metrics: metrics.update(schema=2))], out)
    with pytest.raises(InputError, match="model: expected a table, found none"):
        write_report([another(folder, "lacking", lambda metrics: metrics.pop("model"))], out)
    shutil.rmtree(folder / "frames")
    with pytest.raises(InputError, match="expected a picture"):
        write_report([folder], out)
    assert not out.exists()


def test_a_page_in_the_runs_folder_is_led_to(folder):
    run = folder.parent / "a run"
    run.mkdir()
    named = another(folder, "eval2", lambda metrics: metrics.update(run=str(run)))
    assert page_of(named).values("a", "href") == []
    (run / "page.html").write_text("")
    page = page_of(named)
    assert page.values("a", "href") == ["a%20run/page.html"]
    assert "To turn round, under a Sun to drag: " in page.text


def test_same_folder_same_bytes(folder, tmp_path):
    write_report([folder], tmp_path / "a.html")
    write_report([folder], tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_histogram_bars_stand_for_counts():
    svg = charts.histogram("a", [[0.5, 1.5, 1.5], [1.5]], [0, 1, 2, 3], 4)
    paths = re.findall(r'class="block (s\d)" d="M0 (\d+)V([\d.]+)H[\d.]+V([\d.]+)H[\d.]+V([\d.]+)', svg)
    base = float(paths[0][1])
    heights = {name: [base - float(top) for top in tops] for name, _, *tops in paths}
    unit = heights["s1"][1]
    assert unit > 0
    assert heights == {"s0": [unit, 2 * unit, 0], "s1": [0, unit, 0]}
    assert 4 * unit < base


def test_bars_stand_for_values():
    svg = charts.bar_chart("a", "x", ["p", "q", "r"], [(0, [1.0, None, 4.0]), (7, [2.0, 3.0, 0.0])])
    bars = re.findall(r'class="cell (s\d)" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', svg)
    heights = {"s0": [], "s1": []}
    spans = []
    for name, left, top, width, height in bars:
        heights[name].append(float(height))
        assert float(top) + float(height) == pytest.approx(charts.HEIGHT - 40, abs=0.11)
        spans.append((float(left), float(left) + float(width)))
    unit = heights["s0"][0]
    assert heights["s0"] == pytest.approx([unit, 4 * unit], abs=0.2)
    assert heights["s1"] == pytest.approx([2 * unit, 3 * unit, 0], abs=0.2)
    assert all(one[1] <= two[0] for one, two in zip(sorted(spans), sorted(spans)[1:], strict=False))
    assert spans == sorted(spans)
    empty = charts.bar_chart("a", "x", ["p"], [(0, [None])])
    assert "rect" not in empty
    assert "nan" not in empty


def test_ticks_are_round_and_reach_around():
    assert charts.nice_ticks(0, 2000, 5) == [0, 500, 1000, 1500, 2000]
    assert charts.nice_ticks(7, 7, 4)[0] <= 7 <= charts.nice_ticks(7, 7, 4)[-1]
    assert [charts.compact(value) for value in (0.05, 1500, 2e6)] == ["0.05", "1.5k", "2M"]
    for values in ([30.0], [12.3, 44.4], [0.0, 0.0], [-3.0, 99.0]):
        edges = charts.shared_edges(values)
        assert edges[0] <= min(values) <= max(values) <= edges[-1]
        assert np.histogram(values, edges)[0].sum() == len(values)


@pytest.mark.parametrize(
    ("key", "value"),
    [("model", None), ("model", 7), ("dataset", {}), ("dataset", None), ("frames", [{}]), ("notes", 7)],
)
def test_damaged_metrics_end_in_a_sentence(folder, tmp_path, key, value):
    damaged = another(folder, "damaged", lambda metrics: metrics.update({key: value}))
    with pytest.raises(InputError, match="damaged"):
        write_report([damaged], tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
