"""Materials of a run, read out of its model of light: in what unit, and as pictures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool
from spacesim.backend.upload import upload, upload_rows
from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, read_json
from spacesim.data.geometry import Array, as_numbers
from spacesim.data.images.tone import STANDARD_EXPOSURE, Curve, Tone, tone_and_exposure
from spacesim.data.records import Camera
from spacesim.learning.prediction import MaterialView, check_picture
from spacesim.learning.reflectance import seen_side_normals, unit_normals
from spacesim.splat.light.material import FittedMaterial
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.output import RenderOutput, over_alpha, planes_image
from spacesim.splat.raster.render import render
from spacesim.splat.raster.supersample import render_supersampled
from spacesim.splat.raster.surface import unit

ONE_AU = 1361.0  #: irradiance of the Sun, W m^-2, where the data does not say: STANDARD_EXPOSURE is made for it


@dataclass(frozen=True, eq=False)
class SunlitWhite:
    """A white Lambertian surface that faces the Sun, in the pictures of training."""

    display: Array  #: [3] linear display value
    tone: Tone  #: the pictures' tone curve
    is_known: bool  #: else Sun and exposure are taken as 1 au and 0 EV, and reflectances are relative

    @staticmethod
    def of(data: Path, curve: Curve | None) -> "SunlitWhite":
        """By the scene.json in the folder of a run's data, if it is there. curve: of the run's linear colours, whose
        exposure it knows itself"""
        path = data / "scene.json"
        scene = read_json(path) if path.is_file() else {}
        scene = scene if isinstance(scene, dict) else {}
        development = tone_and_exposure(scene)
        tone, exposure = development or ("srgb", 0.0)
        irradiance = _irradiance(scene)
        exposure = exposure if curve is None else curve.exposure
        found = np.full(3, ONE_AU) if irradiance is None else irradiance
        is_known = irradiance is not None and (development is not None or curve is not None)
        return SunlitWhite(found * STANDARD_EXPOSURE * 2.0**exposure / np.pi, tone, is_known)


def draw_material(
    gaussians: Gaussians,
    material: FittedMaterial,
    normals: np.ndarray,
    camera: Camera,
    antialiased: Bool | bool,
    supersample: int,
) -> MaterialView:
    """What a camera sees of the materials and learned normals ([N, 3] world axes, of any length) of Gaussians."""
    check_picture(camera)
    colors = [*upload_rows(material.albedo.T), *upload_rows(material.specular.T)]
    planes = [*colors, upload(material.roughness), upload(material.metallic)]
    learned = unit_normals(upload_rows(normals.T))

    def draw(seen: Pinhole) -> RenderOutput:
        towards = seen_side_normals(learned, seen.directions_to(gaussians.means))
        return render(gaussians, seen, outputs=("alpha",), features=[*planes, *towards], antialiased=antialiased)

    output = render_supersampled(draw, camera, supersample)
    assert output.features is not None
    straight = [over_alpha(plane, output.alpha) for plane in output.features[:8]]
    shown = planes_image([*straight, *unit(ad.Array3f(output.features[8:]))], camera.width, camera.height)
    return MaterialView(
        albedo=shown[..., :3],
        specular=shown[..., 3:6],
        roughness=shown[..., 6],
        metallic=shown[..., 7],
        normal=shown[..., 8:],
        alpha=output.image("alpha"),
    )


def no_material(path: Path, found: str) -> InputError:
    """Of a model whose material cannot be read."""
    expected = "a run of Gaussians whose light takes cosines about learned normals alone (light.field.inputs=surface)"
    return InputError(f"{path}: expected {expected}, to read materials, found {found}")


def _irradiance(scene: JsonMapping) -> Array | None:
    """[3] W m^-2 of a scene.json; None where it does not say."""
    numbers = as_numbers(scene.get("sun_irradiance"))
    return numbers if numbers.shape == (3,) and np.isfinite(numbers).all() and numbers.min() > 0 else None
