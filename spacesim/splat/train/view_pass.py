"""One view of a training step: forward from Gaussians to a picture, its loss, and backward to gradients of Gaussians.

All is recorded and replayed without tracing, lists and what reads them once for each capacity. Where the number of
pairs is expected, a view is projected and listed in one recording, and blended in it where that needs no light; where
it is not, the host waits between two. Another recording blends what light has shown, compares, and goes back. On a CPU
kernels of text stand between more of them.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Float
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.upload import held, upload_numbers
from spacesim.data.records import Camera
from spacesim.splat.light.model import LightModel, Shading
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.adjoint import SplatGradients
from spacesim.splat.raster.blend import backward
from spacesim.splat.raster.cameras import pinhole_numbers
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import lists_of_boxes
from spacesim.splat.raster.lists.capacity import Extent
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.seen import shown_splats
from spacesim.splat.raster.supersample import upsampled_camera
from spacesim.splat.train.async_lists import TrainingPairs, ViewPairs
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.loss.photometric_llvm import loss_and_gradient
from spacesim.splat.train.optimizer.update import ViewGradients
from spacesim.splat.train.stages import (
    BlendTape,
    ListedView,
    LossSettings,
    TargetImage,
    ViewRequest,
    ViewSplats,
    by_name,
    compared_pictures,
    draw_view,
    find_view_boxes,
    in_order,
    list_view,
    picture_loss,
)
from spacesim.splat.train.strategies.strategy import OnScreen
from spacesim.splat.train.views import TrainingView

#: units of the field from which on it takes less time to find the Gaussians that show nothing than to light them
WIDE = 128
KEPT = 4096  #: cameras whose numbers are kept: a training shows the same ones again and again


@dataclass
class RenderedView:
    """A view that was drawn."""

    camera: Pinhole  #: with as many pixels as are blended
    downscale: int  #: pixels of the view on a side of each pixel that is compared
    radii: Float | None  #: of `screen_radii`, or None where densification does not watch
    channels: dict[str, int]  #: how many planes each name has
    shading: Shading | None  #: its light, of a method of light
    tape: ListedView | BlendTape | None  #: until the way back has read it; listed where light comes in between

    def group(self, values: list[Float], name: str) -> list[Float]:
        """Of what was blended, or its gradients, what has that name."""
        return by_name(values, self.channels).get(name, [])

    def take_tape(self) -> ListedView | BlendTape:
        """What the way back reads, which is not held any longer: memory is shortest here."""
        assert self.tape is not None, "a view goes back once"
        tape, self.tape = self.tape, None
        return tape


@dataclass
class ViewLoss:
    """The loss of a view."""

    value: Float  #: of width 1
    grad_gains: Float | None = None  #: [3] by the target's gains, if it has some


@dataclass
class ViewResult:
    """What a step has learned from one view: for the Gaussians, and for the networks."""

    gradients: ViewGradients | None  #: for the Gaussians; None once `take_gradients` has given them
    loss: Float  #: Float of width 1
    by_networks: list[Float] = field(default_factory=list)  #: by their weights, then by the pictures' embeddings
    by_sun: Float | None = None  #: [3], by its direction, of pictures whose Suns are unknown

    def add_to_rows(self, grad_rows: list[Float]) -> None:
        """Gradients of the Gaussians' first rows, Floats [N], that come from elsewhere."""
        assert self.gradients is not None, "gradients are read once"
        self.gradients.grad_rows = grad_rows

    def add_seen(self, seen: OnScreen) -> None:
        """What densification watches of the view."""
        assert self.gradients is not None, "gradients are read once"
        self.gradients.seen = seen

    def take_gradients(self) -> ViewGradients:
        """The gradients, which are not held any longer."""
        assert self.gradients is not None, "gradients are read once"
        gradients, self.gradients = self.gradients, None
        return gradients


class ViewPass:
    """Forward and backward of views, one after another. scale: of the scene, metres, the unit of depth

    pairs: says for how many tile lists are made; nothing may be kept of a view before it has said that they `all_fit`
    """

    def __init__(self, config: TrainConfig, scale: float) -> None:
        self.config, self.scale, self.pairs = config, scale, TrainingPairs()
        terms = LossSettings(
            config.ssim_weight,
            config.visibility_weight,
            config.depth_weight,
            config.normal_weight,
            scale,
            config.light.curve.tone if config.light and config.light.curve else None,
            config.supersample,
            config.light.peaks if config.light else None,
        )
        factors = [2**power for power in range(config.num_downscales + 1)]
        self._loss_settings = {downscale: replace(terms, downscale=downscale) for downscale in factors}
        self._find_boxes, self._list = recorded(find_view_boxes), recorded(list_view)
        self._draw = recorded(draw_view, elements=_elements)
        self._pictures, self._loss = recorded(compared_pictures), recorded(picture_loss)
        self._compare_at_once = recorded(self._compare, elements=_elements_of_picture)
        self._camera_numbers = lru_cache(KEPT)(partial(_camera_numbers, config.supersample))
        self._hidden = _hidden_weight(config)
        self._screen_sizes: dict[tuple[int, int, int], Float] = {}  # by width, height, number of the view in its step

    def forward(
        self,
        gaussians: Gaussians,
        rows: list[Float],
        light: LightModel | None,
        view: TrainingView,
        degree: int,
        downscale: int,
        watched: bool,
    ) -> RenderedView:
        """Draw a view. rows: `gaussians.rows()`;  light: of a method of light;  degree: of the harmonics;  downscale:
        see `RenderedView`;  watched: whether densification wants to know of it"""
        self.pairs.pending.clear()  # of a step that was interrupted
        camera, pairs = self._camera(view.camera, downscale), self.pairs.of_view("picture", view.index)
        extent = Extent.of(gaussians.count, camera.width, camera.height, training=True)
        config, grid = self.config, extent.grid
        asked = ViewRequest(
            rows, camera, degree, config.antialiased, config.shape_terms, self.scale, watched, extent.live
        )
        expected = pairs.expected(extent)
        drawn: ViewSplats | None = None
        if expected is None:
            drawn = self._find_boxes(asked, extent.most, grid)
            splats, values, radii = drawn.splats, drawn.values, drawn.radii
        else:
            listing = held(expected, "pairs"), extent.capacities(expected), grid
            if light is None:
                whole = self._draw(asked, *listing)
                pairs.check(extent, whole.pair_ends, expected)
                return RenderedView(camera, downscale, whole.radii, whole.channels, None, whole.tape)
            splats, values, radii, lists, pair_ends = self._list(asked, *listing)
            pairs.check(extent, pair_ends, expected)
        batch: PaddedBatch | None = None
        if self._hidden is not None and light is not None:
            if drawn is not None:
                lists, drawn = _lists_of(drawn, extent, pairs), None
            around, size = light.surroundings(gaussians), (camera.width, camera.height)
            shown = shown_splats(splats, lists, size, self._hidden, around.order if around else None)
            room = self.pairs.of_view("shown", view.index).room_for(extent, shown.count)
            batch = PaddedBatch.of_chosen(shown, room, gaussians.count) if room else None
        of_sun = self.pairs.of_view("sun", view.index)
        shading = light.shade(gaussians, camera, view.sun, view.index, of_sun, view.earth, batch) if light else None
        if shading:
            values["color"] = shading.colors
            if config.visibility_weight > 0 and shading.visibility is not None:
                values["visibility"] = [shading.visibility]
        if drawn is not None:  # after shading, which needs memory of its own, where it does not need the lists
            lists, drawn = _lists_of(drawn, extent, pairs), None
        planes, channels = in_order(values)
        listed = ListedView(splats, lists, planes, extent.most)
        return RenderedView(camera, downscale, radii, channels, shading, listed)

    def _camera(self, camera: Camera, downscale: int) -> Pinhole:
        """With as many pixels as are blended of a view. A new array each time: two views of a step may be one, and no
        array may stand in two places of a recording's arguments."""
        numbers, width, height = self._camera_numbers(camera, downscale)
        return Pinhole(upload_numbers(numbers), width, height)

    def backward(
        self, drawn: RenderedView, target: TargetImage, camera: Camera, absolute: bool
    ) -> tuple[ViewLoss, SplatGradients]:
        """Loss of a view, and its gradients by splats and by what was blended. camera: of the target;  absolute: also
        what `watched` reads"""
        tape, terms = drawn.take_tape(), self._loss_settings[drawn.downscale]
        blended, size = (drawn.camera.width, drawn.camera.height), (camera.width, camera.height)
        # kernels of text stand between recordings, and gradients of nothing are as many as there are Gaussians
        compare = self._compare if is_usable() or tape.lists.capacity == 0 else self._compare_at_once
        return compare(tape, drawn.channels, blended, target, size, terms, absolute)

    def _compare(
        self,
        view: ListedView | BlendTape,
        channels: dict[str, int],
        blended_size: tuple[int, int],
        target: TargetImage,
        size: tuple[int, int],
        terms: LossSettings,
        absolute: bool,
    ) -> tuple[ViewLoss, SplatGradients]:
        """See `backward`. channels: how many planes each name has;  sizes: pixels that are blended, and the target's"""
        tape = view.blend(blended_size) if isinstance(view, ListedView) else view
        planes, transmittance = by_name(tape.blended.features, channels), tape.blended.transmittance
        value, grad_planes, grad_transmittance = self._picture_loss(planes, transmittance, target, size, terms)
        (grad_gains,) = grad_planes.pop("gains", [None])
        by_planes = in_order(grad_planes)[0], grad_transmittance
        gradients = backward(tape.splats, tape.blended, tape.lists, blended_size, *by_planes, absolute)
        return ViewLoss(value, grad_gains), gradients

    def _picture_loss(
        self,
        planes: dict[str, list[Float]],
        transmittance: Float,
        target: TargetImage,
        size: tuple[int, int],
        terms: LossSettings,
    ) -> tuple[Float, dict[str, list[Float]], Float]:
        """`picture_loss`, its photometric term by kernels of text where they can be launched."""
        shown, known = (planes, transmittance, target, size, terms), None
        if terms.ssim > 0 and is_usable():
            picture, truth = self._pictures(*shown)
            width, height = (extent // terms.downscale for extent in size)
            known = loss_and_gradient(picture, truth, width, height, terms.ssim)
        return self._loss(*shown, known)

    def watched(self, drawn: RenderedView, grad_splats: SplatGradients, place: int) -> OnScreen:
        """What densification watches of a view. place: its number in the step"""
        assert drawn.radii is not None, "radii are there where refinement watches"
        sizes = self._sizes(drawn.camera, place)
        return OnScreen(grad_splats.absolute_x, grad_splats.absolute_y, drawn.radii, sizes)

    def _sizes(self, camera: Pinhole, place: int) -> Float:
        """Of its pictures, as `OnScreen` has them. Each place in a step has its own: see `_camera`."""
        width, height = camera.width, camera.height
        if (width, height, place) not in self._screen_sizes:
            self._screen_sizes[width, height, place] = ad.Float([0.5 * width, 0.5 * height, max(width, height)])
        return self._screen_sizes[width, height, place]

    def to_gradients(
        self, drawn: RenderedView, loss: ViewLoss, grad_splats: SplatGradients, light: LightModel | None
    ) -> ViewResult:
        """What the view teaches, back through its light."""
        grad_values = by_name(grad_splats.features, drawn.channels)
        if drawn.shading is None or light is None:
            return ViewResult(ViewGradients(drawn.camera, grad_splats.splats, grad_values), loss.value)
        grad_visibility = grad_values.pop("visibility", [None])[0]
        by_sun = self.config.sun == "unknown"
        grad_light = light.adjoint(drawn.shading, grad_values.pop("color"), grad_visibility, by_sun)
        gradients = ViewGradients(drawn.camera, grad_splats.splats, grad_values, grad_light.features)
        learned = [*grad_light.weights, *grad_light.embeddings]
        return ViewResult(gradients, loss.value, learned, grad_light.sun[0] if by_sun else None)


def _hidden_weight(config: TrainConfig) -> float | None:
    """`TrainConfig.hidden_weight` as it counts; None where all Gaussians are lit."""
    light = config.light
    if light is None:
        return None
    if light.field.width < WIDE and (select() == "cuda" or config.hidden_weight == 0):
        return None
    return min(config.hidden_weight, config.refinement.prune_opacity)


def _lists_of(drawn: ViewSplats, extent: Extent, pairs: ViewPairs) -> TileLists:
    """The host waits for how many pairs there are."""
    return lists_of_boxes(drawn.footprints, drawn.boxes, extent, pairs.counted(extent, drawn.boxes))


def _elements(arrays: list[Float], view: ViewRequest, *_: object) -> int:
    """The fewer of Gaussians and pixels."""
    return min(dr.width(arrays[0]), view.camera.width * view.camera.height)


def _elements_of_picture(arrays: list[Float], _view: object, _counts: object, size: tuple[int, int], *_: object) -> int:
    """The same, of `ViewPass._compare`."""
    return min(dr.width(arrays[0]), size[0] * size[1])


def _camera_numbers(supersample: int, camera: Camera, downscale: int) -> tuple[list[float], int, int]:
    blended = upsampled_camera(camera.downscaled(downscale), supersample)
    return pinhole_numbers(blended), blended.width, blended.height
