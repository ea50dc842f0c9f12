"""Which truth a client gets: stored where the data have it, traced where the scene is known, else a sentence."""

import threading
from collections.abc import Hashable, Sequence
from contextlib import suppress
from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.records import Dataset
from spacesim.scenes.config import SceneConfig
from spacesim.splat.compose.pose import Pose
from spacesim.splat.run import Predictor
from spacesim.viewer.drawing.frames import picture_size
from spacesim.viewer.session import Session
from spacesim.viewer.state import DisplaySettings, SceneState, ViewerCamera
from spacesim.viewer.truth.scene import (
    compose_scene,
    load_recorded_scene,
    match_objects,
    model_of_objects,
    pose_objects,
    split_scene,
)
from spacesim.viewer.truth.tracer import TraceRequest, TraceResult
from spacesim.viewer.truth.truth import SIDE, TraceQueue, ViewerTruth, matching_frame, stored_truth


class TruthService:
    """Truth for sessions.

    data: of each model, the folder of the dataset that its scene is recorded in, or None
    dataset: whose frames are truth where its scene is the one that is shown, or None
    start: shown for a dataset without a recorded scene
    """

    def __init__(self, data: Sequence[Path | None], dataset: Dataset | None, start: SceneState) -> None:
        self._data, self._dataset, self._start = data, dataset, start
        self._scenes: list[SceneConfig] | str | None = None
        self._whole: SceneConfig | None = None  # the dataset's own scene
        self._lock = threading.Lock()
        self._queue = TraceQueue(self._on_trace_result)

    def request_truth(
        self, session: Session, view: ViewerCamera, state: SceneState, settings: DisplaySettings
    ) -> ViewerTruth | int | str:
        """See `TruthSource`."""
        models = self._models(state)
        if self._dataset is not None and models is not None and settings.stops == 0:
            number = matching_frame(self._dataset, view, state)
            stored = None if number is None else stored_truth(self._dataset, number, settings.mode, models)
            if stored is not None:
                return stored
        if state.sun is None:
            return "the Sun's direction is not known"
        scenes = self._recorded_scenes()
        if isinstance(scenes, str):
            return scenes
        try:
            scene = compose_scene(scenes, state.poses)
        except InputError as error:
            return str(error)
        camera = view.camera(*picture_size(view, min(SIDE, settings.side)))
        models = model_of_objects(scenes)
        request = TraceRequest(0, scene, camera, state.sun, settings.samples, settings.mode, models, settings.stops)
        return self._queue.ask(session, request)

    def cancel_truth(self, session: Session) -> None:
        """See `TruthSource`."""
        self._queue.cancel(session)

    def stop(self) -> None:
        """End the process that traces."""
        self._queue.stop()

    def _models(self, state: SceneState) -> list[int] | None:
        """Of each object of the dataset the number of the model that it is part of, where the models stand as the
        objects do, else None. Where scenes are not known: an empty list where they stand as at the start, or, of one
        model, where it was trained."""
        scenes = self._recorded_scenes()
        if not isinstance(scenes, str) and self._whole is not None:
            places = match_objects(pose_objects(scenes, state.poses), self._whole.objects)
            return None if places is None else [model_of_objects(scenes)[place] for place in places]
        start = self._start.poses if len(self._start.poses) > 1 else (Pose(),)
        return [] if [pose.key for pose in state.poses] == [pose.key for pose in start] else None

    def _recorded_scenes(self) -> list[SceneConfig] | str:
        """The scenes of the models' data, or why they are not known; looked up once."""
        with self._lock:
            if self._scenes is None:
                with suppress(InputError):
                    self._whole = self._scene(self._dataset.root) if self._dataset else None
                try:
                    self._scenes = [self._scene(path) for path in self._data]
                except InputError as error:
                    self._scenes = self._parts() or str(error)
            return self._scenes

    def _parts(self) -> list[SceneConfig] | None:
        """The scenes of several models by the dataset's own, which shows all of them as they stand at the start."""
        whole = self._whole if len(self._data) > 1 else None
        return None if whole is None else split_scene(whole, self._start.poses)

    def _scene(self, path: Path | None) -> SceneConfig:
        if path is None:
            others = "them" if len(self._data) == 1 else "data of the whole scene, an object for each model,"
            raise InputError(
                f"the data that a model was trained on are not where they were; name {others} when the viewer starts"
            )
        return load_recorded_scene(path)

    @staticmethod
    def _on_trace_result(session: Hashable, answer: TraceResult) -> None:
        assert isinstance(session, Session)
        session.on_trace_result(answer)


def dataset_folder(run: Predictor) -> Path | None:
    """The folder of the dataset that a run was trained on, if it is there."""
    path = Path(str(run.config.get("data", {}).get("path", "")))
    folder = path if path.is_dir() else path.parent
    return folder if str(path) and (folder / "transforms.json").is_file() else None
