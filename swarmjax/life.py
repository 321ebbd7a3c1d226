"""Prints a line now and then while long work goes on, also where the output is no terminal."""

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from swarmjax import words

EVERY_S = 10.0  # time between two lines, s

# Filters XLA's advice to file a bug about a program that compiles for two minutes. The advice is an
# error of XLA's log, and no setting of XLA hides it without hiding all other errors.
_ADVICE = r"slow_operation_alarm\.cc|^\*{32}$|^\[Compiling module |^Very slow compile\?|^The opera"
_FILTER = f"""import re, sys
for line in sys.stdin.buffer:
    re.search(rb"{_ADVICE}tion took |^$", line) or sys.stdout.buffer.write(line)"""


@contextlib.contextmanager
def shown(text: Callable[[], str], say: Callable[[str], object] = words.say) -> Iterator[None]:
    """Says every `EVERY_S` s a text and how long the block has run, and hides XLA's advice.

    Another process filters standard error, so that the last words of a process that crashes are
    printed too. The filter has a session of its own, so that Ctrl-C does not end it.
    """
    ended, began = threading.Event(), time.monotonic()

    def repeat() -> None:
        while not ended.wait(EVERY_S):
            say(f"{text()} after {words.duration(round(time.monotonic() - began))}")

    threading.Thread(target=repeat, daemon=True).start()
    stderr, command = os.dup(2), [sys.executable, "-uISc", _FILTER]
    pipe = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stderr, start_new_session=True)
    assert pipe.stdin is not None
    with pipe.stdin:
        os.dup2(pipe.stdin.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            ended.set()
            # Wait in a thread, since a child process that the block has started may hold the pipe
            # open.
            threading.Thread(target=pipe.wait, daemon=True).start()


@contextlib.contextmanager
def progress(command: str) -> Iterator[Any]:
    """Shows a command's progress on standard error: a bar on a terminal, elsewhere lines.

    Args:
      command: name of the command.

    Yields:
      Rich's progress, to which tasks are added.
    """
    from rich.console import Console  # slow, and not needed for a run
    from rich.progress import Progress

    console = Console(stderr=True)
    bar = Progress(console=console, transient=True, disable=not console.is_terminal)

    def text() -> str:
        done = (f"{t.completed:,.0f} of {t.total:,.0f} {t.description}" for t in bar.tasks)
        return f"swarmjax.{command}: {', '.join(done) or 'at work'}"

    with bar, shown(text, console.out) if bar.disable else contextlib.nullcontext():
        yield bar
