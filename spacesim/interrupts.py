"""How a command ends early: Ctrl-C at any moment, SIGTERM, by which batch systems and containers end a process, and a
standard output that is full or whose reader has gone.

`spacesim.cli` imports this first. Where the process is the command itself, both signals then end in one sentence:
while modules are being imported the process ends at once (Python's exception would come out of compiled modules as some
other error, or leave them half made), else KeyboardInterrupt is raised as usual.
"""

import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from spacesim.data.errors import WorkError

STOPPED = "stopped"
MAX_SENTENCE_LENGTH = 2000  #: characters

_SHOW_CURSOR = "\x1b[?25h\n"  # which a bar of progress hides (ECMA-48 private mode 25)
_HERE = os.path.dirname(os.path.abspath(__file__))
_OWN = [os.path.join(_HERE, "__main__.py"), os.path.join(_HERE, "cli", "__main__.py")]

_is_command = os.path.basename(sys.argv[0]) in ("spacesim", "spacesim.exe") or os.path.abspath(sys.argv[0]) in _OWN
_is_running = False
_resume_command = ""
_ended_by: int = signal.SIGINT


@contextmanager
def interruptible() -> Iterator[None]:
    """Around the work of a command: KeyboardInterrupt is raised within and Ctrl-C, where the process is the command,
    ignored afterwards, as what is left is to report the outcome; SIGTERM then ends the process.

    Standard output is flushed. Raises BrokenPipeError without a reader, WorkError where it is full; what has not
    been printed is lost then, so that the interpreter does not fail on it when it exits.
    """
    global _is_running
    _is_running = True
    try:
        yield
    finally:
        if _is_command:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            if signal.getsignal(signal.SIGTERM) is _on_interrupt:
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
        print_output("", end="")


@contextmanager
def defer_interrupts() -> Iterator[Callable[[], bool]]:
    """Around work that has something to save when Ctrl-C or SIGTERM comes: the first makes the yielded function return
    True, a second one ends the work as usual, a second SIGTERM at once. Where the process is not the command, both do
    what they always do; one that is ignored stays so, as shells start commands with `&`: Ctrl-C is not theirs."""
    interrupted = False
    ours = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is _on_interrupt]

    def ask(number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        restore()
        _note(number)

    def restore() -> None:
        for number in ours:
            signal.signal(number, _on_interrupt)

    for number in ours:
        signal.signal(number, ask)
    try:
        yield lambda: interrupted
    finally:
        if not interrupted:
            restore()


def set_resume_command(words: str) -> None:
    """What makes the command that runs go on where Ctrl-C has ended it, "" where nothing does."""
    global _resume_command
    _resume_command = words


def interrupt_exit_code() -> int:
    """Exit code of a command that Ctrl-C has ended, or SIGTERM, as shells have it: 128 + the signal's number."""
    return 128 + _ended_by


def interrupt_message() -> str:
    """The sentence of such a command."""
    return f"{STOPPED}; what was finished is kept, {_resume_command} goes on from there" if _resume_command else STOPPED


def escape_unprintable() -> None:
    """From now on output takes any name of a file: what its encoding lacks, or what is no text, is escaped."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def print_output(text: object, end: str = "\n") -> None:
    """Print to standard output now. Raises as `interruptible`."""
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        _drop_output()
        raise
    except OSError as error:
        _drop_output()
        raise WorkError(f"standard output: cannot be written ({error.strerror or error})") from None


def print_error(sentence: str) -> None:
    """Print to standard error, where there is one; of an endless sentence, as damaged input makes it, both ends."""
    if len(sentence) > MAX_SENTENCE_LENGTH:
        half = MAX_SENTENCE_LENGTH // 2
        sentence = f"{sentence[:half]} ... {sentence[-half:]}"
    with suppress(OSError):
        print(f"spacesim: {sentence}", file=sys.stderr, flush=True)


def is_interrupt(error: BaseException | None) -> bool:
    """Ctrl-C; Dr.Jit turns one that comes while it traces into the cause of another error."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _drop_output() -> None:
    """What is still to be written goes nowhere."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _note(number: int) -> None:
    """What has ended the command; where that is SIGTERM, another one does not wait until Python has its turn."""
    global _ended_by
    _ended_by = number
    if number == signal.SIGTERM:
        signal.signal(number, signal.SIG_DFL)


def _on_interrupt(number: int, frame: FrameType | None) -> None:
    _note(number)
    if _is_running and not _is_importing(frame):
        raise KeyboardInterrupt
    with suppress(OSError):
        cursor = _SHOW_CURSOR if os.isatty(2) else ""
        os.write(2, f"{cursor}spacesim: {interrupt_message()}\n".encode())
    os._exit(interrupt_exit_code())


def _is_importing(frame: FrameType | None) -> bool:
    """A module is being imported: the import system's own frames are on the stack."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


for _number, _usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
    if _is_command and signal.getsignal(_number) is _usual:
        signal.signal(_number, _on_interrupt)
