"""A client of `spacesim serve`: one request, one answer."""

import json
import logging
from collections.abc import Sequence
from types import TracebackType

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import JsonValue
from spacesim.data.records import Camera, Sun, check_camera
from spacesim.data.structure import checked
from spacesim.serve.protocol import VERSION, arrays_of, import_zmq

PATIENCE = 5.0  #: seconds after which one who waits is told

_log = logging.getLogger(__name__)


class CameraClient:
    """Asks a camera that answers (docs/how-to/closed-loop.md), for one thread: each has a client of its own. `with`
    closes it. timeout: seconds to wait. Raises InputError where pyzmq is not installed, and for an address that is
    none."""

    @checked
    def __init__(self, address: str = "tcp://127.0.0.1:5556", timeout: float = 60.0) -> None:
        zmq = import_zmq()
        self.address, self.timeout = address, timeout
        self._socket = zmq.Context.instance().socket(zmq.REQ)
        for option in (zmq.REQ_RELAXED, zmq.REQ_CORRELATE):  # after a timeout it can ask again
            self._socket.setsockopt(option, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.connect(address)
        except (zmq.ZMQError, TypeError) as error:
            raise InputError(
                f"address: expected one such as tcp://127.0.0.1:5556, found {address!r} ({error})"
            ) from None

    def picture(
        self, camera: Camera, sun: Sun | Sequence[float] | None = None, **options: JsonValue
    ) -> dict[str, np.ndarray]:
        """The arrays that were asked for, by name. sun: as for `Run.render`; options: exposure (EV), outputs=("rgb",
        "depth", ...), seed, see spacesim/serve/protocol.py. Raises InputError for what cannot be, WorkError where
        no server answers."""
        check_camera(camera)
        lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        fields = {"camera": {"world_from_camera": camera.world_from_camera.tolist(), **lens}, **options}
        if (towards := Sun.of(sun)) is not None:
            fields["sun"] = towards.direction.tolist()
        self._socket.send(json.dumps({"version": VERSION, "id": 0, **fields}).encode())
        if not self._poll():
            raise WorkError(f"{self.address}: expected an answer within {self.timeout:g} s, found none")
        return arrays_of(self._socket.recv_multipart())

    def _poll(self) -> bool:
        """Whether an answer comes within `timeout` seconds; says so where it takes longer than `PATIENCE`."""
        soon = min(PATIENCE, self.timeout)
        if self._socket.poll(round(1e3 * soon)):
            return True
        if soon < self.timeout:
            _log.warning("%s: no answer after %g s, waiting up to %g s", self.address, soon, self.timeout)
        return bool(self._socket.poll(round(1e3 * (self.timeout - soon))))

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def __enter__(self) -> "CameraClient":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
