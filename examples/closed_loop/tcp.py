"""A client of `spacesim serve` by a plain TCP socket, as MATLAB's tcpclient and Simulink's TCP/IP blocks have it.

    python examples/closed_loop/tcp.py [PORT]

ZeroMQ's own protocol (ZMTP 3.0, rfc.zeromq.org/spec/23) needs 64 bytes of greeting and a command READY from each side;
then each frame is a byte of flags (1: more follow, 2: long, 4: a command), its length in 1 byte (long: 8, the highest
first), and its bytes. A question is an empty frame and the request, an answer an empty frame and those of
spacesim/serve/protocol.py.
"""

import json
import socket
import sys

import numpy as np

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(52, b"\0")
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"


def frame(content, flags=0):
    """A frame, short or long."""
    long = len(content) > 255
    return bytes([flags | 2 * long]) + len(content).to_bytes(8 if long else 1, "big") + content


def receive(stream):
    """Frames of the next message, without commands."""
    frames, more = [], True
    while more:
        flags = stream.read(1)[0]
        content = stream.read(int.from_bytes(stream.read(8 if flags & 2 else 1), "big"))
        if not flags & 4:
            frames, more = [*frames, content], flags & 1
    return frames


with socket.create_connection(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 5556)) as client:
    stream = client.makefile("rb")
    client.sendall(GREETING + frame(READY, 4))
    stream.read(64)  # its greeting
    for k in range(3):
        camera = {"position": [12 - k, 0, 0], "rotation_wxyz": [0.5, -0.5, -0.5, 0.5]}  # looks along -x, z is up
        camera |= {"width": 64, "height": 64, "fov_deg": 30}
        request = {"version": 1, "id": k, "camera": camera, "sun": [1, 0.5, 0.8], "seed": k}
        client.sendall(frame(b"", 1) + frame(json.dumps(request).encode()))
        _, header, *arrays = receive(stream)
        if not arrays:
            sys.exit(header.decode())
        rgb = np.frombuffer(arrays[0], np.uint8).reshape(64, 64, 3)
        print(f"{12 - k} m: mean {rgb.mean():.2f}")
