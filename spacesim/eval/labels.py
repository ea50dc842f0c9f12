"""What the metrics are called, which way is better, and what each means: for notes, tables and the report."""

from dataclasses import dataclass

from spacesim.data.images.tone import MU, PEAK
from spacesim.eval.metrics.lpips import MIN_SIDE
from spacesim.eval.metrics.shadow import BAND, THRESHOLD

HIGHER, LOWER = "↑", "↓"


@dataclass(frozen=True)
class Metric:
    """A metric: its names, its unit and what it means."""

    key: str  #: name in metrics.json
    label: str  #: its name on pages
    unit: str  #: "dB", "m", ...; "" of a share or a number alone
    goal: str  #: "↑", "↓" or "→ x", the value to come close to
    digits: int  #: decimals
    meaning: str  #: a sentence
    null: str = "no pixel is there to measure"  #: why it can be missing in a frame that shows the object

    def distance(self, value: float) -> float:
        """How far `value` is from the goal; the smaller, the better."""
        if self.goal in (HIGHER, LOWER):
            return value if self.goal == LOWER else -value
        return abs(value - float(self.goal.removeprefix("→")))


def metric_of(key: str, metrics: tuple[Metric, ...]) -> Metric:
    """The one of `metrics` that metrics.json calls `key`. Raises KeyError where there is none."""
    return {metric.key: metric for metric in metrics}[key]


IMAGE = (
    Metric(
        "psnr", "PSNR", "dB", HIGHER, 2,
        "Peak signal-to-noise ratio (2.18), peak 1; equal pictures: 100 dB.",
    ),
    Metric(
        "ssim", "SSIM", "", HIGHER, 4,
        "Structural similarity (2.19), 11 × 11 Gaussian window, the mean of its map.",
        "the frame is smaller than its window",
    ),
    Metric(
        "lpips", "LPIPS", "", LOWER, 4,
        "Learned perceptual distance (2.20), AlexNet, version 0.1.",
        f"a side of the picture is below the network's {MIN_SIDE} pixels",
    ),
    Metric("mae", "MAE", "", LOWER, 4, "Mean absolute error of the sRGB values in [0, 1] (2.21)."),
    Metric("rmse", "RMSE", "", LOWER, 4, "Root mean squared error of the sRGB values in [0, 1] (2.22)."),
    Metric("flip", "FLIP", "", LOWER, 4, "Mean perceived difference (LDR FLIP at 67 pixels per degree)."),
    Metric(
        "psnr_mu", "PSNR-μ", "dB", HIGHER, 2,
        f"PSNR of linear light up to {PEAK:g} times white, by the μ-law (μ = {MU:g}); sRGB values are decoded.",
        "no pixel is there to measure, or no radiance",
    ),
)  # fmt: skip

SHADOW = (
    Metric(
        "ber", "Shadow BER", "", LOWER, 4,
        f"Share of pixels put on the wrong side of luminance {THRESHOLD} (2.23).",
    ),
    Metric(
        "bias", "Shadow bias", "", "→ 0", 4,
        "Mean luminance error over true shadow (2.24); above 0: shadows too bright.",
        "no pixel of the truth is shadowed",
    ),
    Metric(
        "boundary_mae", "Boundary MAE", "", LOWER, 4,
        f"Mean absolute luminance error within {BAND} pixels of the true shadow's boundary (2.25).",
        "the truth has no shadow boundary",
    ),
    Metric(
        "sharpness_ratio", "Sharpness ratio", "", "→ 1", 3,
        "Mean luminance gradient there, prediction by truth (2.26); below 1: too soft.",
        "the truth has no shadow boundary",
    ),
)  # fmt: skip

POOLED = ", of all frames together; beside it the mean of the frames, of which some have few"

SHADOW_MASK = (
    Metric("error_rate", "Error rate", "", LOWER, 4, f"Share of lit and cast-shadow pixels put wrong{POOLED}."),
    Metric(
        "balanced_error_rate", "Balanced error rate", "", LOWER, 4,
        "Mean of the error rates of truly shadowed and truly lit pixels.",
        "the truth lacks lit or cast-shadow pixels",
    ),
    Metric(
        "iou", "IoU", "", HIGHER, 4,
        "Intersection over union of predicted and true cast shadow.",
        "neither prediction nor truth has a cast shadow",
    ),
    Metric(
        "visibility_mae", "Visibility MAE", "", LOWER, 4,
        f"Mean absolute error of the visible fraction of the solar disc{POOLED}.",
    ),
)  # fmt: skip

DEPTH = (
    Metric(
        "mae", "Depth MAE", "m", LOWER, 4,
        "Mean absolute error of the depth along the optical axis, where the run has one.",
        "no pixel of an object has a predicted depth",
    ),
    Metric(
        "rmse", "Depth RMSE", "m", LOWER, 4,
        "Root mean squared error of the same.",
        "no pixel of an object has a predicted depth",
    ),
    Metric("missing", "Missing", "", LOWER, 4, "Share of the object's pixels without depth: alpha is below one half."),
)  # fmt: skip

MATERIAL = (
    Metric(
        "albedo_error", "Albedo error", "", LOWER, 4,
        f"Mean error of the linear albedo, times one scale for the run, by the mean true albedo{POOLED}.",
    ),
    Metric(
        "normals_deg", "Normals", "°", LOWER, 1,
        "Mean angle between the Gaussians' shortest axes, as blended, and the true normals; 90° where nothing is.",
    ),
    Metric("learned_normals_deg", "Learned normals", "°", LOWER, 1, "The same of the normals that light is taught by."),
)  # fmt: skip

RECALL = Metric("recall", "Recall", "", HIGHER, 4, "Share of the pixels of that kind of shadow that is predicted dark.")

SHADOW_KIND = (RECALL, *SHADOW_MASK)

GROUPS = {
    "image": ("over the silhouette", IMAGE),
    "image_full": ("over whole frames", IMAGE),
    "shadow": ("over the silhouette", SHADOW),
    "shadow_full": ("over whole frames", SHADOW),
    "shadow_mask": ("over lit and cast-shadow pixels", SHADOW_MASK),
    "shadow_attached": ("over lit pixels and those that face away from the Sun", SHADOW_KIND),
    "shadow_self_cast": ("over lit pixels and shadow that an object casts on itself", SHADOW_KIND),
    "shadow_other_cast": ("over lit pixels and shadow that another object casts", SHADOW_KIND),
    "depth": ("over the object's pixels", DEPTH),
}
"""metrics.json's groups: where each is taken and what is in it."""
