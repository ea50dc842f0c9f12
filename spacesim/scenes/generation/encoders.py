"""Encoding and writing of frames, in this process or in others beside it."""

import queue
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

from spacesim.data.errors import WorkError
from spacesim.data.records import Truth
from spacesim.data.store import FrameWriter, WrittenFrame
from spacesim.processes import ATTEMPTS, ChildProcess, as_raisable, connect_to_parent, end
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.exposure import record_image


@dataclass(frozen=True, eq=False)
class TracedFrame:
    """A frame before a camera has recorded it."""

    name: str  #: e.g. "train_00012"
    index: int  #: among all frames of the dataset, it makes the noise
    exposure: float | None  #: None: the camera's
    truth: Truth  #: what is recorded and written


@dataclass(frozen=True, eq=False)
class FrameEncoder:
    """Records, encodes and writes frames; any number of threads may do so at once."""

    writer: FrameWriter  #: into the dataset's folder
    camera: CameraConfig  #: exposure, tone and sensor
    seed: int  #: of the noise

    def write(self, frame: TracedFrame) -> WrittenFrame:
        """Returns once all its files are there."""
        truth, exposure = frame.truth, frame.exposure
        camera = self.camera if exposure is None else replace(self.camera, exposure=exposure)
        noise, behind = (self.seed, frame.index), truth.radiance_background
        recording = record_image(truth.radiance, truth.alpha, camera, noise, behind)
        return self.writer.write_frame(frame.name, truth, recording.image, recording.raw)


class EncoderProcesses:
    """Lets processes write frames, each for one thread of this process at a time: Python's lock, which encoders of one
    process share with its renderer, bounds them to a quarter of 16 cores."""

    def __init__(self, encoder: FrameEncoder) -> None:
        self._encoder = encoder
        self._idle: queue.LifoQueue[ChildProcess] = queue.LifoQueue()  # few processes do what few can

    def write(self, frame: TracedFrame) -> WrittenFrame:
        """Returns once all its files are there. Raises what the process raises; WorkError where several end over it."""
        for _ in range(ATTEMPTS):
            process = self._take()
            try:
                process.lend(frame)
                answer: WrittenFrame | BaseException = process.receive()
            except (EOFError, OSError):
                ending = process.ending()
                continue
            except BaseException:
                end([process])
                raise
            self._idle.put(process)
            if isinstance(answer, BaseException):
                raise answer
            return answer
        raise WorkError(
            f"{frame.name}: {ATTEMPTS} processes ended while they wrote it, the last {ending}; is the memory short?"
        )

    def close(self) -> None:
        """End them; no thread may be writing."""
        idle = []
        with suppress(queue.Empty):
            while True:
                idle.append(self._idle.get_nowait())
        end(idle)

    def start(self, count: int) -> None:
        """So many of them, and wait until they can write."""
        with ThreadPoolExecutor(count) as pool:
            for process in list(pool.map(lambda _: self._started(), range(count))):
                self._idle.put(process)

    def _take(self) -> ChildProcess:
        with suppress(queue.Empty):
            return self._idle.get_nowait()
        return self._started()

    def _started(self) -> ChildProcess:
        process = ChildProcess(__name__, lends=True)
        with suppress(EOFError, OSError):  # where it is dead already, the next message fails
            process.send(self._encoder)
            process.receive()
        return process


def main(socket: int) -> None:
    """Write one frame after another, until the parent goes."""
    inbox, tell = connect_to_parent(socket)
    encoder: FrameEncoder = inbox.get()
    tell(None)
    while True:
        frame: TracedFrame = inbox.get()
        try:
            tell(encoder.write(frame))
        except Exception as error:
            tell(as_raisable(error))
