"""The page in headless Chromium: its pictures are the rasterizer's, its Sun and its view move, it asks nobody."""

import base64
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import wait_for
from PIL import Image
from tiny import REFINED, call

from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera, Sun
from spacesim.eval.metrics.image import psnr
from spacesim.splat.export.html import colors, seen, sunlight
from spacesim.splat.export.html.page import write_page
from spacesim.splat.export.html.sunlight import octahedral_directions
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import DirectionsConfig, FieldConfig, ViewAloneConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import preset, with_settings

COUNT = 150
EARTH = Earth([0.3, 0.2, -1.0], 50.0, albedo=1.0)
CLOSE = {"plain": 37, "relit": 29, "linear": 34, "directions": 30, "earthlit": 29}  #: dB at least


@pytest.fixture(scope="module", autouse=True)
def _coarse():
    """Smaller tables, sooner made."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in (
            (colors, "SUN_SIDE", 8),
            (colors, "VIEWS", 20),
            (colors, "CONDITIONS", 200),
            (sunlight, "SIDE", 16),
        ):
            patch.setattr(module, name, value)
        yield


def lit_run(name: str, light: LightConfig, bias: float = 0.0) -> Run:
    """A ball of flat Gaussians with an untrained but lively field. bias: of the logits of its colours"""
    rng = np.random.default_rng(5)
    arrays = ball(rng) | {"sh": np.zeros((COUNT, 0, 3)), "features": rng.normal(size=(COUNT, light.features))}
    model = LightModel.initial(light, TrainingFrame(np.zeros(3), 1.0, 4.0, 1.0), 3)
    model.weights = [upload(1.7 * np.array(weight)) for weight in model.weights]
    last = 2 * light.field.layers
    model.weights[last] = upload(np.array(model.weights[last]) + bias)
    config = {"method": name, "antialiased": True, "data": {"path": ""}}
    return Run(Path(name), config, {}, Gaussians.from_numpy(arrays), 0, model)


def ball(rng: np.random.Generator) -> dict[str, np.ndarray]:
    directions = rng.normal(size=(COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return {
        "means": directions * rng.uniform(0.5, 1, (COUNT, 1)),
        "log_scales": np.log(rng.uniform([0.08, 0.04, 0.005], [0.3, 0.2, 0.02], (COUNT, 3))),
        "quaternions": rng.normal(size=(COUNT, 4)),
        "logit_opacities": rng.normal(1, 2, COUNT),
    }


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    rng = np.random.default_rng(7)
    plain = Gaussians.from_numpy(ball(rng) | {"sh": rng.normal(scale=0.2, size=(COUNT, 16, 3))})
    small = {"features": 8, "width": 16}
    shadows = with_settings(preset("demo", "shadow-map"), REFINED).light
    assert shadows is not None
    linear = LightConfig(FieldConfig(**small, inputs=ViewAloneConfig()), linear=True, tone="filmic", exposure=0.0)
    return {
        "plain": Run(Path("plain <1>"), {"method": "vanilla", "data": {"path": ""}}, {}, plain, 0),
        "relit": lit_run("relit", shadows),
        "earthlit": lit_run("earthlit", replace(shadows, shadow=None, bounce=0, earth=True)),
        "linear": lit_run("linear", linear, -3.0),
        "radiance": lit_run("radiance", replace(shadows, shadow=None, bounce=0, linear=True, radiance=True)),
        "directions": lit_run("directions", LightConfig(FieldConfig(**small, inputs=DirectionsConfig()))),
    }


@pytest.fixture(scope="module")
def pages(runs, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    for name, run in runs.items():
        write_page(run, folder / f"{name}.html", earth=EARTH)
    return {name: folder / f"{name}.html" for name in runs}


@pytest.fixture(scope="module")
def tabs(browser, pages):
    """Each page opened from disk once it has drawn."""
    opened = {name: browser.open(path.as_uri(), 480, 360) for name, path in pages.items()}
    for tab in opened.values():
        tab.send("Page.bringToFront")  # others draw nothing
        wait_for(lambda tab=tab: tab.evaluate("window.controls?.waiting === null"), "the first picture")
    return opened


@pytest.fixture
def relit(tabs):
    tabs["relit"].send("Page.bringToFront")
    tabs["relit"].evaluate("controls.change(START)")
    return tabs["relit"]


def camera_at(eye: list[float], size: tuple[int, int] = (120, 90)) -> Camera:
    """That looks past the middle, its principal point out of it."""
    return Camera(look_at(eye, [0.1, -0.1, 0.05]), *size, 110.0, 112.0, 0.47 * size[0], 0.55 * size[1])


def drawn(tab, camera: Camera, sun: Sun) -> np.ndarray:
    """[H, W, 3]: what the page's renderer draws, over black."""
    axes, lens = camera.camera_from_world[:3, :3].ravel().tolist(), [camera.fx, camera.fy, camera.cx, camera.cy]
    view = json.dumps({"axes": axes, "eye": camera.position.tolist(), "lens": lens})
    address = tab.evaluate(
        f"""(() => {{ Object.assign(controls.canvas, {{ width: {camera.width}, height: {camera.height} }});
            controls.renderer.draw({view}, {json.dumps(sun.direction.tolist())});
            return controls.canvas.toDataURL(); }})()"""
    )
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGBA")) / 255.0
    return pixels[..., :3] * pixels[..., 3:]


def state(tab) -> SimpleNamespace:
    return SimpleNamespace(**tab.evaluate("controls.state"))


@pytest.mark.parametrize("name", CLOSE)
def test_pictures_are_those_of_render(name, runs, tabs):
    near_and_far = [[3.0, 0.5, 1.0], [-2.0, 2.0, -1.5], [0.2, -0.1, 4.0], [1.3, -0.6, 0.1]]
    for k, eye in enumerate(near_and_far):
        camera, sun = camera_at(eye), Sun.from_angles(77 * k + 13, 50 - 35 * k)
        rendered = np.clip(runs[name].predict(camera, replace(sun, earth=EARTH)).rgb, 0, 1)
        assert rendered.std() > 0.03
        assert psnr(drawn(tabs[name], camera, sun), rendered) > CLOSE[name], eye


def test_the_earth_is_as_bright_as_in_render(runs, tabs):
    camera, sun = camera_at([0.2, -0.1, -4.0]), Sun.from_angles(30, 80)
    both, alone = (np.clip(runs["earthlit"].predict(camera, one).rgb, 0, 1) for one in (replace(sun, earth=EARTH), sun))
    assert psnr(alone, both) + 5 < psnr(drawn(tabs["earthlit"], camera, sun), both)


def test_the_earth_hides_the_sun_as_in_render(runs, tabs):
    camera, limb = camera_at([0.2, -0.1, 4.0]), np.radians(EARTH.angular_radius_deg)
    side = np.cross(EARTH.direction, [0, 1, 0]) / np.linalg.norm(np.cross(EARTH.direction, [0, 1, 0]))
    shares = []
    for radii in (-2.0, -0.5, 0.3, 0.8):
        angle = limb + radii * 0.00465
        sun = Sun(np.cos(angle) * EARTH.direction + np.sin(angle) * side, EARTH)
        shares.append(sun.visible_share)
        for name in ("relit", "earthlit"):
            rendered = np.clip(runs[name].predict(camera, sun).rgb, 0, 1)
            tabs[name].send("Page.bringToFront")
            assert psnr(drawn(tabs[name], camera, sun), rendered) > 25, (name, radii)
    assert shares[0] == 0 < shares[1] < 0.3 < 0.6 < shares[2] < 0.8 < shares[3] < 1


def test_a_large_splat_near_the_eye_is_cut_as_in_render(runs, tabs):
    """Where linearization is clamped, and centres are behind the camera."""
    camera, sun = camera_at([0.4, 0.1, 0.0]), Sun.from_angles(40, 20)
    assert psnr(drawn(tabs["plain"], camera, sun), np.clip(runs["plain"].predict(camera).rgb, 0, 1)) > 30


def test_another_sun_moves_light_and_shadows(runs, tabs):
    camera = camera_at([3.0, 0.5, 1.0])
    pictures = [drawn(tabs["relit"], camera, Sun.from_angles(angle, 10)) for angle in (0, 180)]
    truth = [np.clip(runs["relit"].predict(camera, Sun.from_angles(angle, 10)).rgb, 0, 1) for angle in (0, 180)]
    assert psnr(*pictures) < 25 < psnr(pictures[0], truth[0])
    assert np.corrcoef((pictures[0] - pictures[1]).ravel(), (truth[0] - truth[1]).ravel())[0, 1] > 0.95


def test_the_suns_map_holds_its_directions(tabs):
    """A cell's middle is that cell; elsewhere four shares add up to one, also across the edges of the map."""
    directions = octahedral_directions(16)
    for index in (0, 17, 255, 128, 40):
        cells = tabs["relit"].evaluate(f"octahedralCells({directions[index].tolist()}, 16)")
        assert sum(share for cell, share in cells if cell == index) == pytest.approx(1, abs=1e-9)
    rng = np.random.default_rng(0)
    for direction in [*rng.normal(size=(60, 3)), [0, 0, -1], [1, 0, 0], [0, -1, 1e-9], [0.7, 0.7, -1e-3]]:
        direction = np.array(direction) / np.linalg.norm(direction)
        cells = tabs["relit"].evaluate(f"octahedralCells({direction.tolist()}, 16)")
        assert sum(share for _, share in cells) == pytest.approx(1)
        assert sum(share * directions[cell] for cell, share in cells) @ direction > 0.98


def test_dragging_orbits_and_the_wheel_zooms(relit):
    before, shown = state(relit), relit.picture()
    relit.drag((150, 200), (200, 180))
    after = state(relit)
    assert after.azimuth == pytest.approx(before.azimuth - 20, abs=1)
    assert after.elevation == pytest.approx(before.elevation - 8, abs=1)
    assert (after.sunAzimuth, after.distance) == (before.sunAzimuth, before.distance)
    assert np.abs(relit.picture().astype(int) - shown).max() > 40
    relit.send("Input.dispatchMouseEvent", type="mouseWheel", x=150, y=200, deltaX=0, deltaY=120)
    wait_for(lambda: state(relit).distance > 1.1 * before.distance, "the zoom")


def test_the_sun_is_dragged_by_its_handle_with_shift_and_by_sliders(relit):
    relit.frames(3)
    before, shown = state(relit), relit.picture()
    x, y = relit.evaluate(
        "(() => { const b = element('sun').getBoundingClientRect(); return [b.x + 22, b.y + 22]; })()"
    )
    relit.drag((x, y), (x + 50, y - 25))
    dragged = state(relit)
    assert dragged.sunAzimuth == pytest.approx(before.sunAzimuth + 20, abs=1)
    assert dragged.sunElevation == pytest.approx(before.sunElevation + 10, abs=1)
    assert (dragged.azimuth, dragged.elevation) == (before.azimuth, before.elevation)
    assert np.abs(relit.picture()[60:250].astype(int) - shown[60:250]).max() > 40
    for kind, at in (("mousePressed", 150), ("mouseMoved", 190), ("mouseReleased", 190)):
        pressed = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        relit.send("Input.dispatchMouseEvent", type=kind, x=at, y=200, buttons=1, modifiers=8, **pressed)
    wait_for(lambda: state(relit).sunAzimuth != dragged.sunAzimuth, "the Sun")
    assert state(relit).azimuth == before.azimuth
    relit.evaluate("{ element('elevation').value = -30; element('elevation').dispatchEvent(new Event('input')); }")
    assert state(relit).sunElevation == -30
    assert "-30°" in relit.text()


def test_slow_frames_have_fewer_pixels_until_all_is_at_rest(relit):
    share = relit.evaluate(
        """new Promise(done => {
            let frames = 0;
            const step = () => {
                const start = performance.now();
                while (performance.now() - start < 60);
                controls.change({ azimuth: controls.state.azimuth + 1 });
                if (++frames < 14) requestAnimationFrame(step);
                else done(controls.canvas.width / innerWidth);
            };
            step(); })"""
    )
    assert share < 0.5
    wait_for(lambda: relit.evaluate("controls.canvas.width === innerWidth"), "the full resolution")


def test_keys_and_reset(relit):
    start = state(relit)
    relit.evaluate("element('view').focus()")
    for key, modifiers in (("ArrowRight", 0), ("ArrowUp", 8), ("+", 0)):
        relit.send("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=modifiers)
    moved = state(relit)
    assert moved.azimuth != start.azimuth
    assert moved.sunElevation == start.sunElevation + 5
    assert moved.distance < start.distance
    relit.evaluate("document.querySelector('button[type=reset]').click()")
    assert state(relit) == start


def test_pages_without_relighting_have_no_sun_handle(tabs):
    for name, hidden in (("plain", True), ("linear", True), ("relit", False)):
        assert tabs[name].evaluate("[element('sun').hidden, element('suns').hidden]") == [hidden, hidden]
    assert f"vanilla, {COUNT} Gaussians, made by spacesim" in tabs["plain"].text()
    assert "plain <1>" in tabs["plain"].text()


def test_the_page_stands_alone_and_is_small(pages):
    for path in pages.values():
        text = path.read_text()
        assert "default-src 'none'" in text
        assert not re.search(r"https?:|import\s*\(|src=|\{\{", text)
        assert len(text) < 10e6 / 15_000 * COUNT + 250_000  # the tables and the program are the same for all


def test_what_a_shell_hides_is_not_seen():
    """A small ball amid a closed shell, and one far outside."""
    rng = np.random.default_rng(2)
    shell = fibonacci_sphere(2000)
    means = np.concatenate([shell, [[0.0, 0, 0], [0, 0, 1.6]]])
    arrays = {
        "means": means,
        "log_scales": np.log(np.concatenate([np.full((2000, 3), 0.09), np.full((2, 3), 0.05)])),
        "quaternions": rng.normal(size=(2002, 4)),
        "logit_opacities": np.full(2002, 7.0),
        "sh": np.zeros((2002, 1, 3)),
    }
    steps: list[None] = []
    found = seen.tabulate_seen(Gaussians.from_numpy(arrays), False, np.zeros(3), lambda: steps.append(None))
    bits = np.unpackbits(found.bits, axis=1, bitorder="little")
    assert len(steps) == bits.shape[1] == seen.SIDE**2
    assert bits[2000].sum() == 0
    assert bits[2001].all()  # beyond the pictures
    cosine = shell @ octahedral_directions(seen.SIDE).T
    assert bits[:2000][cosine > 0.3].mean() > 0.97
    assert bits[:2000][cosine < -0.75].mean() < 0.01


def test_what_is_hidden_is_not_drawn_but_from_within(relit):
    drawn_at = "(controls.state.distance = {}, controls.draw(), controls.renderer.drawn)"
    assert relit.evaluate(drawn_at.format(1)) > 0.5 * COUNT
    relit.evaluate("{ const { seen } = controls.renderer.arrays; window.kept = seen.slice(); seen.fill(0); }")
    assert relit.evaluate(drawn_at.format(1)) == 0
    assert relit.evaluate(drawn_at.format(0.05)) > 0
    relit.evaluate("{ controls.renderer.arrays.seen.set(kept); }")
    assert relit.evaluate(drawn_at.format(1)) > 0.5 * COUNT


def test_the_same_run_gives_the_same_bytes(runs, pages, tmp_path):
    reported: list[tuple[int, int]] = []
    write_page(runs["relit"], tmp_path / "again.html", lambda *done: reported.append(done), EARTH)
    assert (tmp_path / "again.html").read_bytes() == pages["relit"].read_bytes()
    assert reported[-1][0] == reported[-1][1] == len(reported)


def test_a_browser_without_webgl_shows_a_message(browser, pages):
    tab = browser.open("about:blank")
    tab.send("Page.enable")
    tab.send("Page.addScriptToEvaluateOnNewDocument", source="HTMLCanvasElement.prototype.getContext = () => null")
    tab.send("Page.navigate", url=pages["plain"].as_uri())
    wait_for(lambda: "needs WebGL 2" in tab.text(), "the sentence")
    tab.close()


def test_the_command(tiny_run, tmp_path):
    out = tmp_path / "page.html"
    done = call("export", tiny_run, "--html", out)
    assert (done.code, done.errors) == (0, [])
    assert done.output == f"{out}: 300 Gaussians, {out.stat().st_size / 1e6:.1f} MB\n"


def test_what_is_no_run_of_gaussians_is_refused(tiny_run, tmp_path, monkeypatch):
    out = tmp_path / "page.html"
    assert call("export", tmp_path / "scene.toml", "--html", out).is_refusal("scene.toml", "a scene")
    assert call("export", tmp_path / "absent", "--html", out).is_refusal("absent")
    assert call("export", tiny_run, "--html", tmp_path).is_refusal(tmp_path, "folder")
    assert call("export", tiny_run, "--html", tmp_path / "page.txt").is_refusal(
        "page.txt", "ends in .html or .htm, found .txt"
    )
    monkeypatch.setattr("spacesim.methods.load_run", lambda path: SimpleNamespace(gaussian_run=None))
    assert call("export", tiny_run, "--html", out).is_refusal("radiance field")
    assert not out.exists()
    empty = load_run(tiny_run)
    nothing = Gaussians.from_numpy({name: array[:0] for name, array in empty.gaussians.to_numpy().items()})
    with pytest.raises(InputError, match="found none"):
        write_page(Run(tiny_run, empty.config, {}, nothing, 0), out)
