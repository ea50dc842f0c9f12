"""Which truth a client gets: stored where the data have it, traced where the scene is known, else a sentence."""

import threading
from collections.abc import Hashable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from spacesim.data.errors import InputError
from spacesim.data.records import Dataset
from spacesim.splat.compose.pose import Pose
from spacesim.splat.run import Run
from spacesim.viewer.frames import sides
from spacesim.viewer.session import Session
from spacesim.viewer.state import Look, Stand, View
from spacesim.viewer.truth.scene import composed_scene, models_of, parted, places_among, posed_objects, recorded_scene
from spacesim.viewer.truth.tracer import Answer, Request
from spacesim.viewer.truth.truth import SIDE, Truth, TruthDesk, frame_at, stored_truth


class TruthService:
    """Truth for sessions.

    data: of each model, the folder of the dataset that its scene is recorded in, or None;  dataset: whose frames are
    truth where its scene is the one that is shown, or None;  start: which a dataset that tells no scene shows
    """

    def __init__(self, data: Sequence[Path | None], dataset: Dataset | None, start: Stand) -> None:
        self._data, self._dataset, self._start = data, dataset, start
        self._scenes: list[Any] | str | None = None
        self._whole: Any = None  # the dataset's own scene
        self._lock = threading.Lock()
        self._desk = TruthDesk(self._answered)

    def truth(self, session: Session, view: View, stand: Stand, look: Look) -> Truth | int | str:
        """See `TruthSource`."""
        models = self._models(stand)
        if self._dataset is not None and models is not None:
            number = frame_at(self._dataset, view, stand)
            stored = None if number is None else stored_truth(self._dataset, number, look.mode, models)
            if stored is not None:
                return stored
        if stand.sun is None:
            return "the Sun's direction is not known"
        scenes = self._recorded()
        if isinstance(scenes, str):
            return scenes
        try:
            scene = composed_scene(scenes, stand.poses)
        except InputError as error:
            return str(error)
        camera = view.camera(*sides(view, min(SIDE, look.side)))
        request = Request(0, scene, camera, stand.sun, look.samples, look.mode, models_of(scenes))
        return self._desk.ask(session, request)

    def no_truth(self, session: Session) -> None:
        """See `TruthSource`."""
        self._desk.cancel(session)

    def stop(self) -> None:
        """End the process that traces."""
        self._desk.stop()

    def _models(self, stand: Stand) -> list[int] | None:
        """Of each object of the dataset the number of the model that it is part of, where the models stand as the
        objects do, else None. Where scenes are not known: an empty list where they stand as at the start, or, of one
        model, where it was trained."""
        scenes = self._recorded()
        if not isinstance(scenes, str) and self._whole is not None:
            places = places_among(posed_objects(scenes, stand.poses), self._whole.objects)
            return None if places is None else [models_of(scenes)[place] for place in places]
        start = self._start.poses if len(self._start.poses) > 1 else (Pose(),)
        return [] if [pose.key for pose in stand.poses] == [pose.key for pose in start] else None

    def _recorded(self) -> list[Any] | str:
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

    def _parts(self) -> list[Any] | None:
        """The scenes of several models by the dataset's own, which shows all of them as they stand at the start."""
        several = self._whole is not None and len(self._data) > 1
        return parted(self._whole, self._start.poses) if several else None

    def _scene(self, path: Path | None) -> Any:
        if path is None:
            others = "them" if len(self._data) == 1 else "data of the whole scene, an object for each model,"
            raise InputError(f"the data that a model was trained on are not where they were; name {others} with --data")
        return recorded_scene(path)

    @staticmethod
    def _answered(session: Hashable, answer: Answer) -> None:
        assert isinstance(session, Session)
        session.answer(answer)


def data_of(run: Run) -> Path | None:
    """The folder of the dataset that a run was trained on, if it is there."""
    path = Path(str(run.config.get("data", {}).get("path", "")))
    folder = path if path.is_dir() else path.parent
    return folder if str(path) and (folder / "transforms.json").is_file() else None
