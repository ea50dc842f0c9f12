"""pycolmap's bundle adjustment, and what it says of a lens."""

import importlib
import logging
import threading
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.importers.video.model import SfmModel, field_of_view

INSTALL = "pip install 'spacesim[sfm]'"
_SOFT, _SOFT_SIDE = 0.3, 960  # pixels from which on a feature pulls less, as highlights move; on a longer side of so
# many and less, on a longer one as many more
_ENOUGH = 0.9  # share of pictures with a pose, from which on a lens without distortion will do
_BETTER = 0.95  # share of the error that may be left, for distortion to be believed, or a focal length to be in doubt
_OTHER_FOV, _BETTER_FOV = 1.1, 0.97  # times the one that was given, and the share of the error left with it: another
_OTHER_FOCAL = 1.15  # times the focal length: such a one must fit worse

_log = logging.getLogger(__name__)


def library() -> ModuleType:
    """pycolmap. Raises InputError where it is missing."""
    try:
        return importlib.import_module("pycolmap")
    except (ImportError, OSError):
        raise InputError(f"structure from motion: expected pycolmap, found none; type: {INSTALL}") from None


T = TypeVar("T")


def run(colmap: ModuleType, work: Callable[[object], T], poll: Callable[[], None] | None = None) -> T:
    """What `work` gives, which is called with a token that ends it, in a thread of its own, so that Ctrl-C is heard.
    `poll` is called while it runs. Raises WorkError where pycolmap fails."""
    token = colmap.CancellationToken()
    results: list[T] = []
    failures: list[BaseException] = []

    def call() -> None:
        try:
            results.append(work(token))
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.25)
            if poll is not None:
                poll()
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if failures:
        raise WorkError(f"structure from motion: pycolmap failed ({' '.join(str(failures[0]).split())})")
    return results[0]


def soft_pixels(width: int, height: int) -> float:
    """Pixels from which on a feature that is so far off pulls less."""
    return _SOFT * max(max(width, height) / _SOFT_SIDE, 1.0)


def adjust(colmap: ModuleType, model: Any, focal: bool, distorted: bool) -> float:
    """Adjust all of a model but what is known of its lens, by features of which those far off pull little, and return
    the median error, pixels."""
    options = colmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_extra_params = focal, distorted
    options.print_summary = False
    camera = next(iter(model.cameras.values()))
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = soft_pixels(camera.width, camera.height)
    options.ceres.solver_options.num_threads = 1  # equal results
    options.ceres.solver_options.function_tolerance = 1e-6
    which = colmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        which.add_image(number)
    which.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = colmap.create_default_bundle_adjuster(options, which, model)
    run(colmap, lambda token: adjuster.solve())
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()]))


def is_bent(colmap: ModuleType, models: Sequence[Any], count: int, focal: bool) -> bool:
    """Whether distortion may help: the first model lacks pictures, or fits better with it. It is adjusted without."""
    if not models:
        return True
    plain = adjust(colmap, models[0], focal, False)
    return models[0].num_reg_images() < _ENOUGH * count or (
        adjust(colmap, colmap.Reconstruction(models[0]), focal, True) < _BETTER * plain
    )


def doubt_focal(colmap: ModuleType, found: Any, model: SfmModel, distorted: bool) -> None:
    """Log a warning where a longer or a shorter focal length fits nearly as well as the one that was found."""
    depth = float(np.median(model.depths))
    errors = []
    for factor in (1 / _OTHER_FOCAL, _OTHER_FOCAL):
        other = colmap.Reconstruction(found)
        for camera in other.cameras.values():
            camera.params = [factor * camera.params[0], *camera.params[1:]]
        for frame in other.frames.values():
            if frame.has_pose():
                pose = frame.rig_from_world
                moved = pose.translation + np.array([0.0, 0.0, (factor - 1) * depth])
                frame.rig_from_world = colmap.Rigid3d(pose.rotation, moved)
        errors.append(adjust(colmap, other, False, distorted))
    error = float(np.median(model.errors))
    if min(errors) * _BETTER < error:
        wide = field_of_view(model.width, model.focal)
        _log.warning(
            "the field of view, estimated as %.3g degrees, is uncertain: a focal length %.0f %% %s fits nearly as well "
            "(%.3g instead of %.3g pixels off); name it with fov",
            wide, 100 * (_OTHER_FOCAL - 1), "shorter" if errors[0] < errors[1] else "longer", min(errors), error,
        )  # fmt: skip


def doubt_given(colmap: ModuleType, found: Any, distorted: bool) -> None:
    """Log a warning where the focal length that was given fits clearly worse than another."""
    free = colmap.Reconstruction(found)
    given, better = adjust(colmap, found, False, distorted), adjust(colmap, free, True, distorted)
    cameras = [next(iter(one.cameras.values())) for one in (found, free)]
    angles = [field_of_view(camera.width, camera.params[0]) for camera in cameras]
    if better < _BETTER_FOV * given and max(angles) > _OTHER_FOV * min(angles):
        _log.warning(
            "fov: the pictures fit better with %.3g degrees than with %.3g as given (%.3g instead of %.3g pixels off)",
            angles[1], angles[0], better, given,
        )  # fmt: skip
