"""`python -m swarmjax.watch run=DIR [port=N]`: serves a page on this machine that follows a run.

Prints the page's address, and serves it until Ctrl-C. The page shows whether the run trains, has
ended or has stopped early. The page needs no account, and sends nothing off the machine.

Examples:
  # serve a page on this machine, and print its address
  python -m swarmjax.watch run=runs/first
  # on a port of your choice,
  python -m swarmjax.watch run=runs/first port=8000
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax import command, words
from swarmjax.config import files
from swarmjax.watch.config import WatchConfig
from swarmjax.watch.live_page import LivePage
from swarmjax.watch.server import Server


def main(arguments: Sequence[str]) -> int:
    """Runs the command; Ctrl-C ends it."""
    settings = files.load(WatchConfig, arguments)
    with Server(settings.port, LivePage(Path(settings.run))) as server:
        words.say(f"{server.url} follows {settings.run}; Ctrl-C ends it.")
        server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("watch", main, WatchConfig))
