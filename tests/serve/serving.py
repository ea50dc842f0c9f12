"""A server on a thread of this process, and a view that tests ask for."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from spacesim.data.records import Camera, Sun
from spacesim.serve.draw import Served
from spacesim.serve.server import CameraServer

SUN = Sun.from_angles(40, 25)
CAMERA = Camera.look_at([9.0, -4.0, 3.0], [0, 0, 0], 40, 32, 30.0)


@contextmanager
def serving(served: Served) -> Iterator[str]:
    """The address of a server that draws on a thread of its own; nothing else may draw before it has answered."""
    server, ended = CameraServer(served, port=0), threading.Event()
    thread = threading.Thread(target=server.run, args=(ended.is_set,))
    thread.start()
    try:
        yield server.address
    finally:
        ended.set()
        thread.join()
        server.close()
