"""One frame evaluated: the pictures to compare, its metrics, what is written of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.errors import WorkError
from spacesim.data.geometry import Array
from spacesim.data.images import has_alpha, load_image, luminance, read_labels, write_png
from spacesim.data.images.tone import (
    PEAK,
    STANDARD_EXPOSURE,
    exposure_value,
    linear_from_display,
    mu_law,
    tone_and_exposure,
)
from spacesim.data.records import Dataset, Frame, Image, Truth
from spacesim.data.store import SHADOW_NONE, SHADOW_SELF_CAST, load_truth
from spacesim.eval import pictures
from spacesim.eval.metrics import grazing, image, lpips, shadow
from spacesim.eval.metrics.depth import depth_metrics
from spacesim.eval.metrics.image import Mask

if TYPE_CHECKING:
    from spacesim.splat.run import Prediction, Predictor


@dataclass(frozen=True, eq=False)
class FrameImages:
    """A frame's pictures."""

    prediction: np.ndarray  #: [H, W, 3] sRGB values in [0, 1] over black, black where not valid
    truth: np.ndarray  #: as `prediction`
    silhouette: Mask  #: [H, W] bool, the object's among them
    valid: Mask  #: [H, W] bool, pixels that are not to be ignored
    #: [H, W, 3] each: prediction and truth of linear light over black, by `data.images.tone.mu_law`, in [0, 1]; None
    #: where the radiance or the exposure of the truth is not known
    encoded: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True, eq=False)
class FrameLight:
    """What is known of a frame's light."""

    truth: Truth | None  #: None where the dataset has none
    #: [H, W] predicted share of the solar disc that is seen, None where the method predicts none
    visibility: np.ndarray | None
    alpha: np.ndarray  #: [H, W] predicted
    depth: np.ndarray  #: [H, W] predicted of surfaces, metres; 0 where alpha is below one half


@dataclass(frozen=True, eq=False)
class FrameTarget:
    """What a frame is compared with."""

    image: Image  #: the true picture, with its valid pixels
    silhouette: Mask  #: [H, W] bool, the object's pixels among the valid ones; all of them where it is not known
    source: str  #: where the silhouette is from: "truth", "alpha", or "frame" where it is not known


def frame_target(dataset: Dataset, frame: Frame) -> FrameTarget:
    """Raises InputError where the dataset is broken."""
    loaded = load_image(dataset, frame)
    if frame.silhouette_path is not None and not any(frame.distortion):
        silhouette, source = read_labels(dataset.root / frame.silhouette_path, frame.camera) > 0, "truth"
    else:
        silhouette = loaded.alpha >= 0.5
        if frame.silhouette_path is not None and not has_alpha(dataset.root / frame.file_path):
            source = "truth"  # undistorted, as its picture
        else:
            source = "frame" if np.all(loaded.alpha == 1) else "alpha"
    return FrameTarget(loaded, silhouette & loaded.valid, source)


def frame_images(
    dataset: Dataset, frame: Frame, prediction: "Prediction", traced: Truth | None = None
) -> tuple[FrameImages, str]:
    """The pictures to compare, and where the silhouette is from, see `FrameTarget`. traced: the truth of linear light

    Raises WorkError where the prediction is not finite, InputError where the dataset is broken.
    """
    predicted = (prediction.rgb, prediction.alpha, prediction.visibility)
    if not all(np.all(np.isfinite(plane)) for plane in predicted if plane is not None):
        raise WorkError(f"{frame.file_path}: the prediction has values that are not finite; train the run again")
    target = frame_target(dataset, frame)
    valid = target.image.valid
    images = FrameImages(
        prediction=np.where(valid[..., None], np.clip(prediction.rgb, 0, 1), np.float32(0)),
        truth=target.image.over(np.zeros(3)),
        silhouette=target.silhouette,
        valid=valid,
        encoded=None if traced is None else _encoded(dataset, frame, prediction, traced),
    )
    return images, target.source


def frame_light(dataset: Dataset, frame: Frame, prediction: "Prediction") -> FrameLight:
    """Raises InputError where the truth that the dataset names is missing or broken."""
    truth = None if frame.gt_path is None else load_truth(dataset, frame)
    depth = np.where(prediction.alpha >= 0.5, np.nan_to_num(prediction.depth, posinf=0, neginf=0), 0)
    return FrameLight(truth, prediction.visibility, prediction.alpha, depth)


def own_exposure(run: "Predictor", frame: Frame) -> float | None:
    """EV of a frame that has its own, where a run knows light; else None."""
    if frame.exposure is None or run.gaussian_run is None or run.gaussian_run.curve is None:
        return None
    return exposure_value(frame.exposure)


def _encoded(
    dataset: Dataset, frame: Frame, prediction: "Prediction", traced: Truth
) -> tuple[np.ndarray, np.ndarray] | None:
    """See `FrameImages.encoded`. What predicts sRGB values alone shows light up to white, by the dataset's curve."""
    development = tone_and_exposure(dataset.scene)
    if development is None:
        return None
    tone, exposure = development
    factor = frame.exposure or STANDARD_EXPOSURE * 2.0**exposure
    light = prediction.linear if prediction.linear is not None else linear_from_display(prediction.rgb, tone)
    predicted, true = (mu_law(np.clip(v, 0, PEAK)) for v in (light, factor * np.nan_to_num(traced.radiance)))
    return predicted, true


def is_photograph(frame: Frame, source: str) -> bool:
    """Whether a frame shows neither what is object nor where the Sun is: then darkness says nothing of shadow. source:
    of its silhouette"""
    return source == "frame" and frame.sun is None and frame.gt_path is None


def image_groups(
    view: FrameImages, network: lpips.Lpips | None, source: str = "truth", photograph: bool = False
) -> dict[str, shadow.Metrics | None]:
    """The frame's values of the groups that compare pictures. Where the silhouette's `source` is "frame", "image" is
    "image_full". photograph: see `is_photograph`"""
    inside = image.interior(view.valid.shape)
    predicted, true = luminance(view.prediction), luminance(view.truth)
    full = _image_metrics(view, view.valid, view.valid & inside, network)
    over = full if source == "frame" else _image_metrics(view, view.silhouette, view.silhouette, network)
    if photograph:
        return {"image": over, "image_full": full, "shadow": None, "shadow_full": None}
    return {
        "image": over,
        "image_full": full,
        "shadow": shadow.luminance_metrics(prediction=predicted, truth=true, mask=view.silhouette),
        "shadow_full": shadow.luminance_metrics(prediction=predicted, truth=true, mask=view.valid),
    }


def visibility_groups(light: FrameLight, view: FrameImages) -> dict[str, shadow.Metrics | None]:
    """The frame's values of the groups about predicted visibility; None where either side is missing, and for a kind of
    shadow that the frame does not show."""
    if light.visibility is None or light.truth is None:
        return {"shadow_mask": None, **dict.fromkeys(shadow.KINDS)}
    predicted, true, classes = light.visibility, light.truth.sun_visibility, light.truth.shadow
    sees_the_sun_or_a_caster = classes >= SHADOW_SELF_CAST
    mask = view.valid & sees_the_sun_or_a_caster
    return {
        "shadow_mask": shadow.visibility_metrics(prediction=predicted, truth=true, mask=mask),
        **{
            kind: shadow.kind_metrics(prediction=predicted, truth=true, classes=classes, kind=kind, valid=view.valid)
            for kind in shadow.KINDS
        },
    }


def depth_groups(light: FrameLight, view: FrameImages) -> dict[str, shadow.Metrics | None]:
    """The frame's values of the group about depth, over pixels whose centre shows an object; None without truth."""
    if light.truth is None:
        return {"depth": None}
    return {"depth": depth_metrics(light.depth, light.truth.depth, view.valid & (light.truth.object_id > 0))}


def tally_grazing(light: FrameLight, view: FrameImages) -> Array | None:
    """Sums of the frame by grazing angle; None without truth."""
    if light.truth is None:
        return None
    return grazing.tally(
        truth=light.truth,
        predicted_luminance=luminance(view.prediction),
        true_luminance=luminance(view.truth),
        visibility=light.visibility,
        mask=view.valid,
    )


def depth_range(light: FrameLight) -> tuple[float, float] | None:
    """(nearest, farthest) true depth, metres, predicted where there is no truth; None where nothing is seen."""
    depth = light.depth if light.truth is None else light.truth.depth
    seen = depth[depth > 0]
    return (float(seen.min()), float(seen.max())) if seen.size else None


def write_pictures(folder: Path, view: FrameImages, light: FrameLight, photograph: bool = False) -> None:
    """Three pictures, two of dark pixels but of photographs, three more where visibility is predicted and known, and of
    the depths, `depth_range` in colours."""
    images = {
        "truth": pictures.as_bytes(view.truth),
        "prediction": pictures.as_bytes(view.prediction),
        "error": pictures.error_picture(view.prediction, view.truth, view.valid),
    }
    if not photograph:
        dark, truly_dark = (shadow.is_shadowed(luminance(p)) for p in (view.prediction, view.truth))
        images["shadow_truth"] = pictures.shadow_picture(truly_dark, truly_dark, view.silhouette)
        images["shadow_prediction"] = pictures.shadow_picture(dark, truly_dark, view.silhouette)
    if light.visibility is not None and light.truth is not None:
        classes = light.truth.shadow
        mask = view.valid & (classes != SHADOW_NONE)
        images["mask_truth"] = pictures.kinds_picture(classes, mask)
        images["mask_prediction"] = pictures.mask_picture(light.visibility < 0.5, classes, mask)
        images["visibility"] = pictures.visibility_picture(light.visibility, light.alpha)
    span = depth_range(light)
    if span is not None:
        images["depth"] = pictures.depth_picture(light.depth, span)
        if light.truth is not None:
            images["depth_truth"] = pictures.depth_picture(light.truth.depth, span)
    for name, picture in images.items():
        write_png(folder / f"{name}.png", picture)


def _image_metrics(view: FrameImages, mask: Mask, windows: Mask, network: lpips.Lpips | None) -> shadow.Metrics:
    """Metrics over `mask`; SSIM over `windows`, the centres of its windows."""
    predicted, true = view.prediction, view.truth
    distance = None
    if network and mask.any():
        distance = network(image.crop_to_mask(predicted, mask), image.crop_to_mask(true, mask))
    encoded = view.encoded
    return {
        "psnr": image.psnr(prediction=predicted, truth=true, mask=mask),
        "ssim": image.ssim(prediction=predicted, truth=true, mask=windows),
        "lpips": distance,
        "mae": image.mae(prediction=predicted, truth=true, mask=mask),
        "rmse": image.rmse(prediction=predicted, truth=true, mask=mask),
        "flip": image.flip(prediction=predicted, truth=true, mask=mask),
        "psnr_mu": image.psnr(*encoded, mask=mask) if encoded else None,
    }
