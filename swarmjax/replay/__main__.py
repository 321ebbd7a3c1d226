"""`python -m swarmjax.replay policy=FILE[,FILE] level=N,... | worst=K`: plays episodes.

Runs the episodes in MuJoCo's C engine, as `evaluate` does, and writes one HTML file that plays them
in a browser. `video=FILE.mp4` also renders them in 3-D. Two policies are shown side by side on the
same levels. No JAX.
"""

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from swarmjax import command, outputs
from swarmjax.config import ConfigError
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate import witness
from swarmjax.evaluate.trials import Entrant
from swarmjax.replay import page as replay_page
from swarmjax.replay import record
from swarmjax.replay import video as replay_video
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.episodes import replay


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, said = witness.load(ReplayConfig, arguments)
    entrants = evaluate_trials.read_policies(settings.policies, settings.extensions)
    out, video = Path(settings.out), settings.video and Path(settings.video)
    others = [*settings.policies, settings.suite, settings.video]
    _check_out(out, others, overwrite=settings.overwrite)
    if video:
        _check_video(video, [*settings.policies, settings.suite], overwrite=settings.overwrite)
    progress = Progress(console=Console(stderr=True), transient=True)
    progress.disable = not progress.console.is_terminal
    words = shlex.join(["python", "-m", "swarmjax.replay", *arguments])
    with progress:
        episodes = replay(settings, entrants, progress)
        page = replay_page.page(settings, [each.policy for each in entrants], episodes, words)
        outputs.write({out: page.encode()})
        if video:
            bar = progress.add_task("pictures", total=replay_video.count(settings, episodes))
            report = partial(progress.advance, bar)
            _write("video", video, lambda: replay_video.write(video, settings, episodes, report))
            outputs.note([video])
    sys.stdout.write(f"swarmjax.replay: {said}\n")
    for each in entrants:
        missing = _left_out(settings, each)
        if missing:
            sys.stdout.write(
                f"{each.path}: the rewards leave out {missing}: to see them, give extensions=FILE, "
                "the file that the policy was trained with\n"
            )
        if record.weights(each.policy, settings.task).path_progress:
            sys.stdout.write(
                f"{each.path}: the rewards leave out path_progress, which replays do not measure\n"
            )
    labels = "; ".join(episode.label for episode in episodes)
    sys.stdout.write(f"{out}: {labels}; {len(page) / 1e6:.2f} MB.\n")
    if video:
        sys.stdout.write(f"{video}: the same, {video.stat().st_size / 1e6:.2f} MB.\n")
    return 0


def _left_out(settings: ReplayConfig, entrant: Entrant) -> str:
    """Names the reward terms of training whose code is missing here."""
    earning = record.weights(entrant.policy, settings.task)
    own = record.own_terms(entrant.policy, settings.extensions, earning)
    found = {piece.name for piece, _ in own}
    return ", ".join(name for name, weight in earning.extra.items() if weight and name not in found)


def _check_file(key: str, path: Path, *, overwrite: bool) -> None:
    """Makes the folder of a file before the replay is computed, so that no result is lost."""
    outputs.check(key, [path], overwrite=overwrite)
    _write(key, path, lambda: path.parent.mkdir(parents=True, exist_ok=True))
    if path.is_dir():
        raise _unwritable(key, path, "it is a folder")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise _unwritable(key, path, "permission denied")


def _check_out(path: Path, others: Sequence[str | None], *, overwrite: bool) -> None:
    """Checks that the page can be written and does not overwrite one of the other files."""
    if path.suffix != ".html":
        raise ConfigError(f"out is {path}: give a name that ends with .html.")
    _check_apart("out", path, others)
    _check_file("out", path, overwrite=overwrite)


def _check_apart(key: str, path: Path, others: Sequence[str | None]) -> None:
    """Checks that a file does not overwrite another one that the command reads or writes."""
    for other in others:
        if other is not None and path.resolve() == Path(other).resolve():
            raise ConfigError(f"{key} is {path}, which is given as another file: give a new name.")


def _check_video(path: Path, others: Sequence[str | None], *, overwrite: bool) -> None:
    """Checks that the video can be made and written, and overwrites none of the other files."""
    if path.suffix != ".mp4":
        raise ConfigError(f"video is {path}: give a name that ends with .mp4.")
    _check_apart("video", path, others)
    _check_file("video", path, overwrite=overwrite)
    replay_video.check()


def _write(key: str, path: Path, write: Callable[[], object]) -> None:
    """Writes a file; turns missing permission or a full disk into a message."""
    try:
        write()
    except OSError as error:
        raise _unwritable(key, path, error.strerror or str(error)) from None


def _unwritable(key: str, path: Path, reason: str) -> ConfigError:
    return ConfigError(f"{key} is {path}, which cannot be written: {reason}.")


if __name__ == "__main__":
    sys.exit(command.run("replay", main, ReplayConfig))
