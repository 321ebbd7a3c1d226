"""Records policies on small stages, for the tests of replays."""

from pathlib import Path

import numpy as np

from swarmjax.evaluate import cells, trials
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.judge import Judge
from swarmjax.replay import record as replay_record
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import Recording, ReplayEpisode, ReplayScene
from swarmjax.task.stage_files import load_levels

SMALL = ("stage.robots=3", "stage.side=0.9", "stage.obstacles=2")


def judge(settings: ReplayConfig) -> Judge:
    """Returns the judge of a replay's first policy on its stage."""
    cell = cells.draw_stage(settings.evaluation, [0])
    (entrant,) = trials.read_policies(settings.policies[:1])
    return evaluate_judge.load(settings.evaluation, entrant.policy, cell.half)


def recorded(path: Path, *words: str) -> tuple[Judge, list[Recording]]:
    """Records the levels of a replay with the first policy."""
    settings = load_levels(ReplayConfig, [f"policy={path}", *words])
    found = judge(settings)
    levels = cells.split(cells.draw_stage(settings.evaluation, settings.levels).levels)
    return found, replay_record.record(found, levels)


def wandering(robots: int, frames: int, seed: int = 0) -> Recording:
    """Returns a recording that compresses badly: everything that moves is random at every step.

    In each step one ray in 50 is lit, one robot in 50 touches something, and one robot in 100
    begins a contact.
    """
    draw = np.random.default_rng(seed)
    stride = draw.uniform(-4e-3, 4e-3, (frames, robots, 2))  # m; full speed for a control step
    turn = draw.uniform(-0.1, 0.1, (frames, robots, 1))  # rad; full turn rate for a control step
    lit = draw.random((frames, robots, 8)) < 0.02
    begins = draw.random((frames, robots, 3)) < 0.01 / 3
    earning = {
        "progress": stride[..., 0],
        "proximity": -0.001 * lit.any(axis=-1),
        "arrival": np.zeros((frames, robots)),
        "contact": -0.02 * begins.sum(axis=-1),
        "time": np.full((frames, robots), -1e-3),
    }
    return Recording(
        scene=ReplayScene(
            side=1.2,
            box=np.array([[0.1, -0.2, 0.3, 0.05, 0.05]]),
            sensor=np.tile([0.03, 0.01, 1.0, 0.0], (robots, 8, 1)),
        ),
        target=np.tile(draw.uniform(-0.5, 0.5, (robots, 2)), (frames, 1, 1)),
        earns=np.zeros((frames, robots), bool),
        measured=np.zeros((frames, 0)),
        pose=np.concatenate([stride, turn], axis=-1).cumsum(axis=0),
        ray=np.where(lit, draw.uniform(0.0, 0.04, lit.shape), 0.04),
        distance=np.ones((frames, robots)),
        reward=earning,
        touching=draw.random((frames, robots, 3)) < 0.02 / 3,
        contacts=begins.cumsum(axis=0),
        arrived=np.zeros((frames, robots), bool),
        arrival=np.zeros(robots, int),
    )


def episode(*runs: Recording, level: int = 0) -> ReplayEpisode:
    """Returns a replay episode of these runs."""
    return ReplayEpisode(f"level {level}", level, list(runs))
