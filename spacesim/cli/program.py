"""`spacesim COMMAND ...`: finds the command, runs it, and reports errors in one sentence."""

from spacesim import interrupts  # first: from here on Ctrl-C is reported in a sentence

# isort: split

import argparse
import errno
import logging
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from spacesim import backend
from spacesim.cli import (
    compose,
    demo,
    doctor,
    export,
    generate,
    locate,
    render,
    report,
    reproduce,
    serve,
    sweep,
    train,
    verify,
    view,
)
from spacesim.cli import eval as evaluate
from spacesim.cli import import_ as import_command
from spacesim.cli.parser import Parser
from spacesim.data.errors import InputError, WorkError
from spacesim.version import __version__

COMMANDS: dict[str, ModuleType] = {
    "doctor": doctor,
    "demo": demo,
    "generate": generate,
    "import": import_command,
    "train": train,
    "eval": evaluate,
    "report": report,
    "render": render,
    "sweep": sweep,
    "view": view,
    "serve": serve,
    "compose": compose,
    "verify": verify,
    "export": export,
    "locate": locate,
    "reproduce": reproduce,
}
"""Each has SUMMARY, a line about it; add_options(parser, arguments); run(options); NEEDS_BACKEND, whether a backend is
chosen before; and maybe option_of(field, options), the option that sets a field whose name is not the option's own."""

_OF_PATHS = (
    *(errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR),
    *(errno.ELOOP, errno.EEXIST, errno.EILSEQ),
)
"""Errors that speak of the path that the user named, not of the work."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        with interrupts.interruptible():
            _run(sys.argv[1:] if arguments is None else arguments)
    except (InputError, WorkError, backend.BackendError) as error:
        interrupts.print_error(str(error))
        return 2 if isinstance(error, InputError) else 1
    except MemoryError as error:
        interrupts.print_error(f"the memory is short ({error})")
        return 1
    except BrokenPipeError:
        return 1
    except (KeyboardInterrupt, Exception) as error:
        if interrupts.is_interrupt(error):
            interrupts.print_error(interrupts.interrupt_message())
            return interrupts.interrupt_exit_code()
        logging.getLogger("spacesim").debug("traceback", exc_info=error)
        if isinstance(error, OSError) and error.filename is not None and error.errno in _OF_PATHS:
            interrupts.print_error(f"{error.filename}: cannot be read or written ({error.strerror})")
            return 2
        if not isinstance(error, RuntimeError | OSError):
            raise
        reason = " ".join(str(error).split())
        interrupts.print_error(f"the computation failed ({reason}); --debug shows where")
        return 1
    return 0


def _run(arguments: Sequence[str]) -> None:
    interrupts.escape_unprintable()
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its tracebacks: what matters of them is reported
    options = parser(arguments).parse_args(arguments)
    if not options.debug:
        warnings.simplefilter("ignore")  # of libraries, about numbers that our messages report where they matter
    options.arguments = ("spacesim", *arguments)
    interrupts.set_resume_command("--resume" if hasattr(options, "resume") else "")
    if options.debug:
        logging.getLogger("spacesim").setLevel(logging.DEBUG)
    command = COMMANDS[options.command]
    if command.NEEDS_BACKEND:
        backend.select(options.backend)
    try:
        command.run(options)
    except (InputError, WorkError) as error:
        error.args = (in_flags(str(error), options),)
        raise


def parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of the command line: of the command that stands first in `arguments`, and with the names of all where
    none does, as to find out what their options are takes time."""
    root = Parser(prog="spacesim", description="Simulate spacecraft images, reconstruct them, evaluate the result.")
    root.add_argument("--version", action="version", version=f"spacesim {__version__}")
    commands = root.add_subparsers(required=True, metavar="COMMAND", dest="command", parser_class=Parser)
    named = {name: command for name, command in COMMANDS.items() if name in arguments[:1]}
    for name, command in (named or COMMANDS).items():
        command_parser: Parser = commands.add_parser(name, help=command.SUMMARY, description=command.SUMMARY)
        if name in arguments:
            command_parser.set_defaults(backend="auto")
            command.add_options(command_parser, arguments)
            if command.NEEDS_BACKEND:
                command_parser.add_argument(
                    "--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM"
                )
            command_parser.add_argument("--debug", action="store_true", help="log more, and tracebacks of what failed")
            option_of = getattr(command, "option_of", lambda field, options: None)
            command_parser.set_defaults(flags=command_parser.flags(), option_of=option_of)
    return root


def in_flags(sentence: str, options: argparse.Namespace) -> str:
    """An error of the library, "iterations: expected ...", with the option in the place of the field that it begins
    with: "--iterations: expected ...", and then also in that of words like test_views. In any sentence "resume=True"
    becomes "--resume", and where there is such an option "sun=unknown" "--sun unknown"."""

    def option(match: re.Match[str]) -> str:
        flag = options.option_of(match[1], options) or options.flags.get(match[1])
        if not flag and match[0] == "resume=True":  # of another command, which the sentence names
            return "--resume"
        if not flag:
            return match[0]
        return flag if match[2] == "True" else f"{flag}{'=' if ' ' in flag else ' '}{match[2]}"

    sentence = re.sub(r"(?<![^ ])([a-z_]+(?:\.[a-z_]+)*)=([\w-]+)(?=[ ,;]|$)", option, sentence)
    field, colon, rest = sentence.partition(": ")
    typed = [value for option in vars(options).values() for value in (option if isinstance(option, list) else [option])]
    if not colon or field in {str(value) for value in typed if isinstance(value, str | Path)}:
        return sentence
    flag = options.option_of(field, options) or options.flags.get(field)
    if not flag or " " in flag:  # beside --set the user writes names of fields
        return f"{flag}: {rest}" if flag else sentence
    expected, found, end = rest.partition(", found ")  # what was found stays as the user wrote it
    names = re.sub(r"(?<![^ ])[a-z]+_[a-z_]+(?=[ ,;]|$)", lambda word: options.flags.get(word[0], word[0]), expected)
    return f"{flag}: {names}{found}{end}"
