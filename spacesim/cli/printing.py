"""What several commands print."""

import re
import sys
from functools import partial

from spacesim import interrupts
from spacesim.data.files import JsonDict

KNOWS_ONE_LIGHT = "the run knows the light that it was trained under only; --sun changes nothing"
NO_EARTH = "the run has learned the Earth's light, which is left out; --earth AZ,EL adds it"
WANTS_FILTER = "the run is antialiased: viewers without Mip-Splatting's 2D filter draw thin splats wider"
RELATIVE = "the data that says how bright the Sun was is not there: albedo is relative, to a Sun at 1 au and 0 EV"

_IN_SOME_FRAMES = re.compile(r" is null in \d+ of \d+ frames")


def print_note(note: str | None) -> None:
    """A line of standard error, where there is something to note."""
    if note:
        print(note, file=sys.stderr)


def print_headline(metrics: JsonDict) -> None:
    """A line for each group of metrics: those that people ask for first."""
    show = partial(_mean, metrics)
    whole = metrics.get("image_region") == "frame"
    numbers = f"PSNR {show('image', 'psnr', 2)} dB, SSIM {show('image', 'ssim', 4)}, FLIP {show('image', 'flip', 4)}"
    full = "" if whole else f"; full frame: PSNR {show('image_full', 'psnr', 2)} dB"
    interrupts.print_output(f"{'whole pictures' if whole else 'silhouette'}: {numbers}{full}")
    if metrics.get("shadow"):
        interrupts.print_output(
            f"shadows: BER {show('shadow', 'ber', 4)}, boundary MAE {show('shadow', 'boundary_mae', 4)}"
        )
    if metrics.get("shadow_mask"):
        mean, balanced = show("shadow_mask", "error_rate", 4), show("shadow_mask", "balanced_error_rate", 4)
        pooled = (metrics["shadow_mask"]["error_rate"] or {}).get("pooled")
        share = mean if pooled is None else f"{pooled:.4f} of all pixels (mean of the frames {mean})"
        interrupts.print_output(f"shadow masks: error rate {share}, balanced {balanced}")
    if metrics.get("shadow_other_cast"):
        share, overlap = show("shadow_other_cast", "balanced_error_rate", 4), show("shadow_other_cast", "iou", 4)
        interrupts.print_output(f"shadows that another object casts: balanced error rate {share}, IoU {overlap}")
    if metrics.get("depth"):
        error = metrics["depth"]["mae"]
        length = f"{error['mean']:.3g} m" if error else "null"
        interrupts.print_output(f"depth: mean error {length}, missing {show('depth', 'missing', 4)} of the pixels")
    if (metrics.get("material") or {}).get("albedo_error"):
        words = f"albedo error {show('material', 'albedo_error', 3)}, normals {show('material', 'normals_deg', 1)}"
        interrupts.print_output(f"materials: {words} degrees")
    if metrics.get("known_suns") and metrics.get("unseen_suns"):
        known_psnr, unseen_psnr = (_mean(metrics[part], "image", "psnr", 2) for part in ("known_suns", "unseen_suns"))
        interrupts.print_output(f"PSNR: {known_psnr} dB under known Suns, {unseen_psnr} dB under Suns never seen")
    if (metrics.get("geometry") or {}).get("chamfer") is not None:
        interrupts.print_output(_shape_words(metrics["geometry"]))
    notes = metrics.get("notes", [])
    partly = [note for note in notes if _IN_SOME_FRAMES.search(note)]
    if len(partly) > 1:
        rest = [note for note in notes if note not in partly]
        notes = [*rest, f"{len(partly)} measures are null in some frames; metrics.json says why"]
    for note in notes:
        interrupts.print_output(f"note: {note}")


def _shape_words(geometry: JsonDict) -> str:
    """The headline of metrics.json's "geometry"."""
    near, overlap = geometry["precision_recall"], geometry["iou"]
    words = f"shape: Chamfer {geometry['chamfer']:.3g} m2, Hausdorff-99 {geometry['hausdorff99']:.3g} m"
    words += f", IoU {'null' if overlap is None else f'{overlap:.4f}'}, F {near['f']:.4f} at {near['distance']:.3g} m"
    floating = (geometry["floaters"] or {}).get("outside")
    return words if floating is None else f"{words}, floaters {100 * floating:.2f} %"


def _mean(metrics: JsonDict, group: str, name: str, digits: int) -> str:
    value = ((metrics.get(group) or {}).get(name) or {}).get("mean")
    return "null" if value is None else f"{value:.{digits}f}"
