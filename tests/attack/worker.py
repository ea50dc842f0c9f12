"""Runs the commands on its standard input, a line of JSON each, one after another in one process.

Each answer is a line: {"code", "errors", "output"}. A traceback that comes out of `main` gives code None.
"""

import contextlib
import io
import json
import os
import sys
import traceback
from pathlib import Path

from spacesim.cli import main  # names a libLLVM before drjit is imported

import drjit  # isort: skip
from sooner import spare_work  # isort: skip


def peak() -> int:
    """Bytes of memory that this process has held at most since that was asked for anew."""
    return 1024 * int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])


def run(arguments: list[str]) -> dict[str, object]:
    """One command."""
    output, errors = io.StringIO(), io.StringIO()
    code: int | None
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            code = main(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except BaseException:
            code = None
            traceback.print_exc(file=errors)
    return {"code": code, "output": output.getvalue()[-2000:], "errors": errors.getvalue()[-6000:]}


def serve() -> None:
    """Answer until the input ends. "peak": bytes of memory that the command took at most."""
    spare_work()
    drjit.set_thread_count(1)  # as there is a worker a core: threads that wait for work keep one busy
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        request = json.loads(line)
        os.chdir(request["folder"])
        Path("/proc/self/clear_refs").write_text("5")  # from now on the peak is this command's (proc(5))
        found = run(request["arguments"])
        answers.write(json.dumps({**found, "peak": peak()}) + "\n")


if __name__ == "__main__":
    serve()
