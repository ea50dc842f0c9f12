"""The rasterizer's figures of docs/research/rasterizer.md: python tests/splat/accuracy.py      12 seconds on two cores

Pictures and gradients against the float64 reference, crops against whole pictures, brightness of pictures zoomed out.
"""

from dataclasses import replace

import drjit as dr
import numpy as np
from scipy.spatial.transform import Rotation
from splats import device_camera, random_splats
from twin import KINDS, columns_of, our_loss, own_features, picture, record, slope, twin_loss, wide_splats

from spacesim.backend import ad
from spacesim.splat.raster.gaussians import NAMES, Gaussians
from spacesim.splat.raster.output import OUTPUTS
from spacesim.splat.raster.render import render
from spacesim.splat.reference.rasterizer import render_reference

INTRINSICS = {"perspective": ("fx", "fy", "cx", "cy"), "orthographic": ("scale_x", "scale_y", "cx", "cy")}


def main() -> None:
    print("Largest difference from the twin: 20 scenes of 300 Gaussians, 96x72 pixels\n")
    print("| camera | mode | colour | alpha | depth [m] | median depth [m] | normal [deg] | pixels at the cut |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        for antialiased in (False, True):
            worst, at_cut, pixels = pictures(kind, antialiased)
            figures = " | ".join(f"{value:.0e}" for value in worst)
            print(f"| {kind} | {mode(antialiased)} | {figures} | {at_cut} of {pixels:,} |")
    print("\nGradients against central differences: norm of the difference over norm, 5 wide Gaussians, 16x12 pixels\n")
    print("| camera | mode | means | log_scales | quaternions | logit_opacities | sh | features | pose | intrinsics |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for kind in KINDS:
        for antialiased in (False, True):
            errors = gradients(kind, antialiased)
            print(f"| {kind} | {mode(antialiased)} | {' | '.join(f'{value:.0e}' for value in errors)} |")
    print("\nLargest difference of 40 crops from the whole picture: 3,000 Gaussians, 150x110 pixels\n")
    print("| camera | colour | alpha | depth [m] |\n|---|---|---|---|")
    for kind in KINDS:
        print(f"| {kind} | {' | '.join(f'{value:.0e}' for value in crops(kind))} |")
    print("\nMean alpha of a picture over that at 512 pixels: 400 Gaussians of 0.018 to 0.05 m, perspective\n")
    sizes = (256, 128, 64, 32, 16)
    print(f"| mode | {' | '.join(str(size) for size in sizes)} |\n|---|{'---|' * len(sizes)}")
    for antialiased in (False, True):
        print(f"| {mode(antialiased)} | {' | '.join(f'{value:.3f}' for value in zoomed(sizes, antialiased))} |")


def mode(antialiased: bool) -> str:
    return "anti-aliased" if antialiased else "classic"


def pictures(kind: str, antialiased: bool, scenes: int = 20) -> tuple[np.ndarray, int, int]:
    """(largest differences of colour, alpha, depth, median depth and normal; pixels at the cut; all pixels)."""
    worst, at_cut, pixels = np.zeros(5), 0, 0
    view = record(kind, 96, 72)
    for seed in range(scenes):
        arrays = random_splats(300, seed)
        twin = render_reference(arrays, view, antialiased=antialiased)
        ours = render(Gaussians.from_numpy(arrays), device_camera(view), outputs=OUTPUTS, antialiased=antialiased)
        apart = np.abs(ours.image("color") - twin.color).max(axis=-1)
        cut = apart > 1e-5  # one Gaussian's alpha is 1/255 but for rounding, and one side leaves it out
        solid = (twin.alpha > 0.05) & ~cut
        normal = ours.image("normal").astype(np.float64)
        angle = 2 * np.degrees(np.arcsin(np.clip(np.linalg.norm(normal - twin.normal, axis=-1) / 2, 0, 1)))
        found = (
            apart[~cut],
            np.abs(ours.image("alpha") - twin.alpha)[~cut],
            np.abs(ours.image("depth") - twin.depth)[solid],
            np.abs(ours.image("median_depth") - twin.median_depth)[solid],
            angle[solid],
        )
        worst = np.maximum(worst, [values.max() for values in found])
        at_cut, pixels = at_cut + int(cut.sum()), pixels + cut.size
    return worst, at_cut, pixels


def gradients(kind: str, antialiased: bool) -> list[float]:
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    gaussians, channels, twist = Gaussians.from_numpy(arrays), columns_of(features), dr.zeros(ad.Float, 6)
    camera = device_camera(view)
    dr.enable_grad(*gaussians.parameters().values(), *channels, twist, camera.values)
    dr.backward(our_loss(gaussians, camera.moved(twist), channels, antialiased=antialiased))

    def loss(**changed: np.ndarray) -> float:
        pose, numbers = changed.get("pose", np.zeros(6)), changed.get("intrinsics", intrinsics)
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]
        seen = replace(
            view,
            world_from_camera=view.world_from_camera @ np.linalg.inv(motion),
            **dict(zip(INTRINSICS[kind], numbers, strict=True)),
        )
        model = {name: changed.get(name, values) for name, values in arrays.items()}
        return twin_loss(model, seen, changed.get("features", features), antialiased=antialiased)

    intrinsics = np.array([getattr(view, name) for name in INTRINSICS[kind]])
    ours = {name: np.array(dr.grad(getattr(gaussians, name))).T.reshape(arrays[name].shape) for name in NAMES}
    ours["features"] = np.stack([np.array(dr.grad(channel)) for channel in channels], axis=1)
    ours["pose"], ours["intrinsics"] = np.array(dr.grad(twist)), np.array(dr.grad(camera.values))[12:16]
    starts = {**arrays, "features": features, "pose": np.zeros(6), "intrinsics": intrinsics}
    errors = []
    for name, found in ours.items():
        expected = slope(lambda values, name=name: loss(**{name: values}), starts[name])
        errors.append(float(np.linalg.norm(found - expected) / np.linalg.norm(expected)))
    return errors


def crops(kind: str) -> np.ndarray:
    arrays, camera, rng = random_splats(3000, 12, 1), device_camera(record(kind, 150, 110)), np.random.default_rng(0)
    arrays["log_scales"][:20] = -0.5
    arrays["means"] *= 2.5
    whole, worst = picture(arrays, camera), np.zeros(3)
    for _ in range(40):
        width, height = int(rng.integers(1, 151)), int(rng.integers(1, 111))
        x, y = int(rng.integers(0, 151 - width)), int(rng.integers(0, 111 - height))
        part = picture(arrays, camera.cropped(x, y, width, height))
        apart = [np.abs(part[name] - whole[name][y : y + height, x : x + width]).max() for name in part]
        worst = np.maximum(worst, apart)
    return worst


def zoomed(sizes: tuple[int, ...], antialiased: bool) -> list[float]:
    arrays = random_splats(400, 3, 0)
    arrays["log_scales"] = np.random.default_rng(1).uniform(-4, -3, (400, 3))
    gaussians = Gaussians.from_numpy(arrays)

    def mean(size: int) -> float:
        output = render(gaussians, device_camera(record("perspective", size, size)), antialiased=antialiased)
        return float(output.image("alpha").mean())

    return [mean(size) / mean(512) for size in sizes]


if __name__ == "__main__":
    main()
