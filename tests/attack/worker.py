"""Runs commands one after another in one process, as told on its standard input, a line of JSON each.

Each answer is a line: {"code", "errors", "output"}. A traceback that comes out of `main` is told as code None.
"""

import contextlib
import io
import json
import os
import resource
import sys
import traceback
from pathlib import Path

from spacesim.cli import main


def virtual_size() -> int:
    """Bytes of address space that this process has."""
    fields = Path("/proc/self/status").read_text().split("VmSize:")[1].split()
    return 1024 * int(fields[0])


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
    """Answer until the input ends. The word "limit" in place of arguments bounds what may be taken from then on."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no answer
    for line in sys.stdin:
        told = json.loads(line)
        if isinstance(told, int):
            limit = virtual_size() + told
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            answers.write("{}\n")
        else:
            os.chdir(told["folder"])
            answers.write(json.dumps(run(told["arguments"])) + "\n")


if __name__ == "__main__":
    serve()
