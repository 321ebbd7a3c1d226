"""`python -m swarmjax.replay policy=FILE[,FILE] level=N,... | worst=K`: plays episodes.

Runs the episodes in MuJoCo's C engine, as `evaluate` does, and writes one HTML file that plays them
in a browser. `video=FILE.mp4` also renders them in 3-D. Two policies are shown side by side on the
same levels. Needs no JAX.

Examples:
  # level 0 of its last stage, into replay.html
  python -m swarmjax.replay policy=runs/first/policy.npz
  # several levels
  python -m swarmjax.replay policy=runs/first/policy.npz level=0,7,12
  # its five worst levels out of 1,000
  python -m swarmjax.replay policy=runs/first/policy.npz worst=5
  # two policies side by side
  python -m swarmjax.replay policy=a.npz,b.npz worst=3
  # another stage and body
  python -m swarmjax.replay policy=runs/first/policy.npz stage=s3 robot=planar
  # a video as well
  python -m swarmjax.replay policy=runs/first/policy.npz video=replay.mp4
"""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from swarmjax import command, life, outputs, words
from swarmjax.config import ConfigError
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.replay import page as replay_page
from swarmjax.replay import video as replay_video
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.episodes import replay


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, said = trained_settings.load(ReplayConfig, arguments)
    entrants = evaluate_trials.read_policies(settings.policies, settings.extensions)
    out, video = Path(settings.out), settings.video and Path(settings.video)
    _check_output("out", out, ".html")
    if video:
        _check_output("video", video, ".mp4")
        replay_video.check()
    made_by = command.line("replay", *arguments)
    words.say(f"swarmjax.replay: {said}")
    with life.progress("replay") as progress:
        episodes = replay(settings, entrants, progress)
        page = replay_page.page(settings, [each.policy for each in entrants], episodes, made_by)
        outputs.write({out: page.encode()})
        if video:
            pictures = [replay_video.rows(settings, each.runs) for each in episodes]
            bar = progress.add_task("pictures", total=sum(map(len, pictures)))
            report = partial(progress.advance, bar)
            replay_video.write(video, settings, episodes, report)
    sys.stdout.writelines(f"{episode.label}\n" for episode in episodes)
    words.say(f"{out}: {len(page) / 1e6:.2f} MB.")
    if video:
        words.say(f"{video}: the same episodes, {video.stat().st_size / 1e6:.2f} MB.")
    return 0


def _check_output(key: str, path: Path, ending: str) -> None:
    """Checks that a file can be written."""
    if path.suffix != ending:
        raise ConfigError(f"{key} is {path}: give a name that ends with {ending}.")
    outputs.make_room(key, path)


if __name__ == "__main__":
    sys.exit(command.run("replay", main, ReplayConfig))
