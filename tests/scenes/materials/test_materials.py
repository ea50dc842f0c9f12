"""Presets of materials: energy, closed forms, and RGB rendering against a spectral one."""

import json
from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np
import pytest

import spacesim  # noqa: F401
from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb
from spacesim.data.toml import read_document
from spacesim.scenes.lights.sun import SOLAR_IRRADIANCE
from spacesim.scenes.materials import spectra, textures
from spacesim.scenes.materials import table as m

NAMES = m.material_names()
SPECTRAL = [name for name in NAMES if m.material(name).reflectance]
LAMBERTIAN = [name for name in NAMES if m.material(name).bsdf["type"] == "diffuse"]
FAR = 1000.0  # metres between samples, so that none lights another


def mitsuba_bsdf(material: m.Material) -> Any:
    """The material as Mitsuba's BSDF, seen from both sides."""
    mi = backend.mitsuba()

    def resolved(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        if "image" in value:
            bitmap = mi.Bitmap(np.ascontiguousarray(material.images[value["image"]]))
            bitmap.set_srgb_gamma(not value["raw"])
            return {"type": value["type"], "raw": value["raw"], "bitmap": bitmap}
        return {key: resolved(item) for key, item in value.items()}

    return mi.load_dict({"type": "twosided", "bsdf": resolved(material.bsdf)})


def radiance(scene: Any, origins: np.ndarray, directions: np.ndarray, max_depth: int, seed: int = 0) -> np.ndarray:
    """[N, 3] along the rays [N, 3]."""
    mi = backend.mitsuba()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(origins))
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 100})
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T)))
    color, _, _ = integrator.sample(scene, sampler, ray)
    dr.eval(color)
    return color.numpy().T


def rectangle(material: m.Material, to_world: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": to_world, "bsdf": mitsuba_bsdf(material)}


def plates_seen(chosen: list[m.Material], emitter: dict[str, Any], angle_deg: float, count: int) -> np.ndarray:
    """Mean radiance [M, 3] of horizontal plates, each under `emitter` alone, seen at an angle from their normal."""
    mi = backend.mitsuba()
    transform = mi.ScalarTransform4f
    plates = {f"p{i:02d}": rectangle(x, transform().translate([FAR * i, 0, 0])) for i, x in enumerate(chosen)}
    scene = mi.load_dict({"type": "scene", "light": emitter, **plates})
    angle = np.radians(angle_deg)
    toward = np.array([np.sin(angle), 0.0, np.cos(angle)])
    spots = np.random.default_rng(1).uniform(-0.9, 0.9, (len(chosen), count, 2))
    targets = np.zeros((len(chosen), count, 3))
    targets[..., :2] = spots
    targets[..., 0] += FAR * np.arange(len(chosen))[:, None]
    origins = (targets + 2.0 * toward).reshape(-1, 3)
    found = radiance(scene, origins, np.broadcast_to(-toward, origins.shape), max_depth=2)
    return found.reshape(len(chosen), count, 3).mean(axis=1)


@pytest.mark.parametrize("angle_deg", [0.0, 50.0, 60.0, 80.0, 85.0])
def test_white_furnace(angle_deg):
    """Under light of radiance 1 from everywhere no surface is brighter than 1, and a perfect one is 1."""
    chosen = [m.material(name) for name in NAMES]
    chosen += [m.principled(f"p{i}", (1, 1, 1), i, 0.4) for i in (0.0, 1.0)]
    constant = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    seen = dict(zip([x.name for x in chosen], plates_seen(chosen, constant, angle_deg, 20_000), strict=True))
    for name, value in seen.items():
        limit = 1.21 if name == "p0.0" else 1.005  # Disney's diffuse lobe, see `principled`
        assert value.max() < limit, (name, value)
        assert value.min() > 0.009, (name, value)
    np.testing.assert_allclose(seen["lambertian-white"], 1.0, atol=0.005)
    np.testing.assert_allclose(seen["lambertian-grey"], 0.5, atol=0.005)
    for name in ("bare-aluminium", "nozzle-alloy", "anodised-aluminium", "gold-mli", "silver-mli"):
        tolerance = (0.16 if name.endswith("mli") else 0.07) if angle_deg else 0.015  # tilted facets lose more
        np.testing.assert_allclose(seen[name], m.material(name).albedo, rtol=tolerance, atol=0.003, err_msg=name)
    for name in ("white-paint", "carbon-fibre", "kapton", "glass"):  # a diffuse base and its coat's Fresnel
        coat = ((m.material_preset(name).ior - 1) / (m.material_preset(name).ior + 1)) ** 2
        if not angle_deg:
            np.testing.assert_allclose(seen[name], coat + np.array(m.material(name).albedo), atol=0.015, err_msg=name)


def test_the_whitest_coats_conserve_energy():
    """Under an even sky a coated plate of the whitest base reflects less than it gets, over all directions together."""
    chosen = [m.coated(f"{n} {alpha}", (m.WHITEST,) * 3, alpha, "", n) for n in (1.5, 1.7) for alpha in (0.1, 0.4, 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(4)
    cosines, weights = 0.5 * (nodes + 1), 0.5 * weights
    constant = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    seen = np.stack([plates_seen(chosen, constant, np.degrees(np.arccos(c)), 8000) for c in cosines])  # [A, M, 3]
    total = np.einsum("a,amc->mc", 2 * weights * cosines, seen)
    assert total.max() < 1.0
    assert total.min() > 0.9


@pytest.mark.parametrize("name", LAMBERTIAN)
def test_lambertian_plates_that_face_the_sun(name):
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 1361.0}}
    seen = plates_seen([m.material(name)], sun, 40.0, 64)[0]
    np.testing.assert_allclose(seen, np.array(m.material(name).albedo) * 1361 / np.pi, rtol=1e-5)


GRID = np.linspace(380.0, 780.0, 39)


def band_weights() -> np.ndarray:
    """[39, 3]: camera RGB, relative to sunlight, of light that has sunlight's spectrum times a hat about each
    wavelength of GRID, so that their sum over any function linear between them is its integral."""
    wavelength, response = spectra.response("sun")
    sunlight = np.interp(wavelength, *spectra.solar_spectrum())
    hats = np.stack([np.interp(wavelength, GRID, row) for row in np.eye(len(GRID))])
    return hats @ (sunlight[:, None] * response) / SOLAR_IRRADIANCE


def groove(chosen: list[m.Material], count: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [M, 3] that right-angled grooves of two plates of one material each send straight up under the
    Sun: light that has met them once, and twice."""
    mi = backend.mitsuba()
    transform = mi.ScalarTransform4f
    plates = {}
    for i, material in enumerate(chosen):
        for side in (-1.0, 1.0):
            place = transform().translate([FAR * i + side, 0, 1]).rotate([0, 1, 0], -45 * side)
            place = place @ transform().scale([np.sqrt(2.0), 20, 1])
            plates[f"g{i:02d}_{side:+.0f}"] = rectangle(material, place)
    sun = {"type": "directional", "direction": [0.25, 0.3, -1], "irradiance": {"type": "rgb", "value": 1.0}}
    scene = mi.load_dict({"type": "scene", "sun": sun, **plates})
    origins = np.zeros((len(chosen), count, 3))
    origins[..., :2] = np.random.default_rng(2).uniform(-1.8, 1.8, (len(chosen), count, 2))
    origins[..., 0] += FAR * np.arange(len(chosen))[:, None]
    origins[..., 2] = 5.0
    origins = origins.reshape(-1, 3)
    down = np.broadcast_to([0.1, 0.0, -1.0] / np.sqrt(1.01), origins.shape)
    once, twice = (
        radiance(scene, origins, down, depth).reshape(len(chosen), count, 3).mean(axis=1) for depth in (2, 3)
    )
    return once, twice - once


@pytest.fixture(scope="module")
def spectral_and_rgb() -> dict[str, np.ndarray]:
    """For each material with a spectrum: [bounces, (spectral, RGB), 3] of its groove."""
    names = SPECTRAL
    weights = band_weights()
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-6)
    spectral = np.zeros((2, len(names), 3))
    for k in range(0, len(GRID), 3):  # three wavelengths a render, one in each channel
        values = [spectra.reflectance_at(m.material(name).reflectance, GRID[k : k + 3]) for name in names]
        found = groove([m.customise(f"at {k}", n, albedo=tuple(v)) for n, v in zip(names, values, strict=True)])
        spectral += np.einsum("bmk,kc->bmc", np.stack(found), weights[k : k + 3])
    rgb = np.stack(groove([m.material(name) for name in names]))
    return {name: np.stack([spectral[:, i], rgb[:, i]], axis=1) for i, name in enumerate(names)}


def difference(pair: np.ndarray) -> float:
    """Largest difference of a channel, relative to the brightest one. A spectral value below 0 lies outside of the
    primaries' gamut and counts as 0, as no picture can hold it."""
    spectral, rgb = np.maximum(pair[0], 0.0), pair[1]
    return float(np.abs(rgb - spectral).max() / spectral.max())


SATURATED = {"gold-mli": (0.10, 0.125), "kapton": (0.05, 0.06)}
"""Where two bounces differ by more than 3 %, as docs/reference/models-and-materials.md says: within these bounds."""


@pytest.mark.parametrize("name", SPECTRAL)
def test_rgb_rendering_agrees_with_spectral_rendering(name, spectral_and_rgb):
    once, twice = spectral_and_rgb[name]
    low, high = SATURATED.get(name, (0.0, 0.03))
    assert once.max() > 1e-3, "light arrives"
    assert twice.max() > 1e-4
    assert difference(once) < 0.03
    assert low <= difference(twice) < high


@pytest.mark.parametrize("name", SPECTRAL)
def test_albedo_and_absorptance_follow_from_the_spectrum(name):
    """Of a coated surface the spectrum is the base's below its coat, which reflects ((n - 1) / (n + 1))^2 more."""
    row = m.material_preset(name)
    np.testing.assert_allclose(spectra.albedo_rgb(row.spectrum), row.albedo, atol=1e-3)
    coat = ((row.ior - 1) / (row.ior + 1)) ** 2 if row.ior else 0.0
    wavelengths, values = np.array(row.spectrum).T
    assert (np.diff(wavelengths) > 0).all()
    assert values.min() >= 0
    assert values.max() <= 1
    if row.absorptance is not None:
        reflectance = coat + spectra.solar_reflectance(row.spectrum)
        assert 1 - reflectance == pytest.approx(row.absorptance, abs=2e-3)


def test_presets_are_plain_data_with_a_source():
    for name in NAMES:
        material = m.material(name)
        json.dumps(material.bsdf)
        assert material.name == name
        assert len(material.source) > 20
        assert all(0 <= x <= 1 for x in material.albedo)
        assert material.tile is None or material.images
    with pytest.raises(InputError, match=r"expected one of lambertian-white, .*, found 'chrome'"):
        m.material("chrome")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("kind = 'metal'", "new: roughness: expected a number, as metal surfaces have one, found none"),
        (
            "kind = 'coated'\nalbedo = [0.95, 0.5, 0.5]\nroughness = 0.2",
            "line 3: albedo: expected at most 0.9 under a coat",
        ),
        ("kind = 'diffuse'\nalbedo = [5, 0.4, 0.3]", "line 3: albedo: expected numbers from 0 to 1, found 5, 0.4, 0.3"),
        ("kind = 'diffuse'\nrougness = 0.2", "line 3: rougness: expected one of kind, .*did you mean roughness"),
        ("kind = 'metal'\nroughness = 1\nnormals = 'x'", "line 4: normals: expected one of crinkle, grain, found 'x'"),
    ],
)
def test_a_row_that_cannot_be_ends_in_a_sentence(tmp_path, row, message):
    path = tmp_path / "materials.toml"
    albedo = "" if "albedo" in row else "albedo = [0.5, 0.4, 0.3]\n"
    path.write_text(f"[new]\n{row}\nsource = 'a reader'\n{albedo}", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        m._row(read_document(path), "new")


def test_textured_albedo_is_the_mean_that_mitsuba_sees():
    cells = m.material("solar-cell")
    mi = backend.mitsuba()
    bitmap = mi.Bitmap(cells.images["cells"])
    bitmap.set_srgb_gamma(True)
    texture = mi.load_dict({"type": "bitmap", "bitmap": bitmap})
    point = dr.zeros(mi.SurfaceInteraction3f)
    grid = (np.mgrid[:512, :512].reshape(2, -1) + 0.5) / 512
    point.uv = mi.Point2f(grid)
    np.testing.assert_allclose(texture.eval(point).numpy().mean(axis=1), cells.albedo, rtol=2e-3)


@pytest.mark.parametrize("image", [textures.crinkle(), textures.grain(), textures.cells((0.01, 0.02, 0.09))])
def test_images_repeat_without_a_seam(image):
    """Across the edge neighbours differ no more than anywhere else."""
    values = image.astype(float)
    for axis in (0, 1):
        steps = np.abs(np.diff(values, axis=axis)).mean(axis=(1 - axis, 2))
        seam = np.abs(np.take(values, 0, axis) - np.take(values, -1, axis)).mean()
        assert seam <= 1.05 * steps.max()


@pytest.mark.parametrize(("image", "slope"), [(textures.crinkle(), 0.22), (textures.grain(), 0.18)])
def test_normal_maps_hold_unit_normals_of_the_stated_slope(image, slope):
    normal = image / 127.5 - 1.0
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=0.01)
    found = normal[..., :2] / normal[..., 2:]
    assert np.sqrt((found**2).sum(axis=-1).mean()) == pytest.approx(slope, rel=0.02)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), 0.0, atol=0.005)  # a closed height field has no mean slope


def test_normal_map_is_right_side_up():
    """A bump's upper flank looks up in the image (green above one half), its right flank to the right."""
    y, x = np.mgrid[: textures.SIZE, : textures.SIZE] - 256.0
    normals = textures._normals(np.exp(-(x**2 + y**2) / 1e4), 0.2).astype(int)
    assert normals[200, 256, 1] > 140 > 115 > normals[312, 256, 1]
    assert normals[256, 312, 0] > 140 > 115 > normals[256, 200, 0]


def test_cells_show_a_grid():
    luminance = np.asarray(textures.cells((0.012, 0.023, 0.089)), float).mean(axis=-1)
    rows = luminance.mean(axis=1)
    bright = np.flatnonzero((rows > 1.5 * np.median(rows)) & (rows > np.roll(rows, 1)))
    assert len(bright) >= 4
    assert np.abs(rows[:128] - rows[128:256]).mean() < 6, "rows of cells repeat"


def test_customised_presets():
    red = m.customise("wing", "white-paint", albedo=(0.5, 0.1, 0.1), roughness=0.2)
    assert red.name == "wing"
    assert red.albedo == (0.5, 0.1, 0.1)
    assert red.bsdf["roughness"] == pytest.approx(0.2**0.5)
    assert red.reflectance == ()
    assert "albedo, roughness" in red.source
    assert m.customise("same", "gold-mli").bsdf == m.material("gold-mli").bsdf
    assert m.customise("large", "gold-mli", tile=2.0).tile == 2.0
    white = m.customise("white cells", "solar-cell", albedo=(0.5, 0.5, 0.5))
    assert white.albedo[0] > 0.4
    for bad, message in (
        ({"albedo": (1.2, 0, 0)}, "material x: albedo: expected numbers from 0 to 1, found 1.2, 0, 0"),
        ({"roughness": 0.0}, "material x: roughness: expected a number from 0.01 to 1, found 0.0"),
        ({"tile": 1.0}, "material x: tile: expected none, as white-paint has none, found 1.0"),
        ({"ior": float("nan")}, "ior: expected a number from 1.001 to 4, found nan"),
        ({"albedo": (0.5, 0.91, 0.5)}, "material x: albedo: expected at most 0.9 under a coat, .*, found 0.91"),
    ):
        with pytest.raises(InputError, match=message):
            m.customise("x", "white-paint", **bad)


def test_a_row_of_another_kind_is_refused(monkeypatch, tmp_path):
    """A mistyped kind would else be Lambertian; and the table's own coats are no whiter than what is checked above."""
    rows = [m.material_preset(name) for name in m.material_names()]
    assert max(max(row.albedo) for row in rows if row.kind == "coated") <= m.WHITEST
    table = tmp_path / "materials.toml"
    table.write_text('[foil]\nkind = "metall"\nsource = "chosen"\nalbedo = [0.5, 0.5, 0.5]\nroughness = 0.2\n')
    monkeypatch.setattr(m, "TABLE", table)
    message = "materials.toml: foil, line 2: kind: expected one of diffuse, coated, metal, found 'metall'"
    with pytest.raises(InputError, match=message):
        m._table.__wrapped__()


def test_principled_multiplies_images_by_factors():
    base = np.full((4, 4, 3), 188, np.uint8)  # linear 0.503
    rough = np.full((4, 4), 200, np.uint8)
    made = m.principled("gltf", (1.0, 0.5, 0.0), 0.3, 0.5, "test", {"base_color": base, "roughness": rough})
    np.testing.assert_allclose(made.albedo, [0.503, 0.2515, 0.0], atol=2e-3)
    np.testing.assert_allclose(linear_from_srgb(made.images["base_color"][0, 0] / 255), made.albedo, atol=5e-3)
    assert made.images["roughness"][0, 0] == 100
    assert made.bsdf["metallic"] == 0.3
    np.testing.assert_array_equal(base, 188)
    flat = m.principled("flat", images={"normal": np.full((2, 2, 3), (128, 128, 255), np.uint8)})
    assert flat.bsdf["type"] == "normalmap"
    mitsuba_bsdf(made)
    mitsuba_bsdf(flat)
    with pytest.raises(InputError, match="material x: metallic: expected numbers from 0 to 1, found 2"):
        m.principled("x", metallic=2.0)
