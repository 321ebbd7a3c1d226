"""`python -m swarmjax.watch run=DIR [port=N]`: a page on this machine that follows a run.

Prints the page's address, and serves it until Ctrl-C. The run may train, have ended or have been
killed; the page says which. No account, and nothing that leaves the machine.
"""

import os
import sys
from collections.abc import Sequence

from swarmjax import command
from swarmjax.config import files
from swarmjax.watch.config import WatchConfig


def main(arguments: Sequence[str]) -> int:
    """Runs the command; Ctrl-C ends it."""
    settings = files.load(WatchConfig, arguments)
    os.environ["JAX_PLATFORMS"] = "cpu"  # it reads checkpoints, and leaves the GPU to the run
    from swarmjax.watch.server import Server
    from swarmjax.watch.view import Views

    views = Views(settings)
    with Server(settings.port, views) as server:
        views.follow()
        sys.stdout.write(f"{server.url} follows {settings.run}; Ctrl-C ends it.\n")
        sys.stdout.flush()
        server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("watch", main, WatchConfig))
