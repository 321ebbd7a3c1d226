"""Builds the page of a replay: one self-contained HTML file that loads nothing else."""

from collections.abc import Sequence

from swarmjax import extension, provenance
from swarmjax.pages import builder
from swarmjax.policy import Policy
from swarmjax.replay import pack
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import ReplayEpisode
from swarmjax.sim import gaps
from swarmjax.task.goals import load as goals

_SOFTWARE = ("swarmjax", "mujoco", "numpy")  # what computed the episodes
_SCRIPTS = ("replay/replay_data.js", "replay/replay_draw.js", "replay/replay.js")


def page(
    settings: ReplayConfig,
    policies: Sequence[Policy],
    episodes: Sequence[ReplayEpisode],
    words: str,
) -> str:
    """Lays out the page.

    Args:
      settings: The replay's settings.
      policies: The policies that drive.
      episodes: The recordings of each level.
      words: The command that makes the page.

    Returns:
      HTML. Text about files and settings is either escaped or inside the packed data.
    """
    task = settings.task
    goal = goals.load(task, settings.robot, extension.load(settings.extensions).goals)
    header = {
        "policies": list(settings.policies),
        "about": f"{_levels(settings)}, {settings.robot.body} robots, simulated by MuJoCo C",
        "facts": _facts(settings, policies, words),
        "step": task.control_step,
        "kinds": list(gaps.KINDS),
        "sensors": len(settings.robot.sensor_poses),
        "hull": settings.robot.hull_radius,
        "range": settings.robot.sensor_range,
        "targetRadius": task.target_radius,
        "arrival": task.arrival,
        "measures": [[each.label, each.unit] for each in goal.measures.values()],
    }
    packed = pack.pack(header, episodes, settings.robot.sensor_range)
    return fill(f"Replay of {' and '.join(settings.policies)} on {_levels(settings)}", packed)


def fill(title: str, packed: bytes) -> str:
    """Puts title and data into the template.

    Args:
      title: Title of the page.
      packed: The packed recordings, from `pack.pack`.

    Returns:
      HTML.
    """
    script = "\n".join(map(builder.read, _SCRIPTS))
    return builder.render(
        "replay/replay.html",
        styles=("replay/replay.css",),
        script=f'(() => {{\n"use strict";\n{script}}})();\n',
        title=title,
        packed=packed,
    )


def _levels(settings: ReplayConfig) -> str:
    """Names the stage or the suite of the levels."""
    return settings.stage.name if settings.suite is None else settings.suite


def _facts(settings: ReplayConfig, policies: Sequence[Policy], words: str) -> list[tuple[str, str]]:
    """States how the episodes were made, one fact per line."""
    names = zip(settings.policies, policies, strict=True)
    versions = provenance.versions()
    return [
        *((f"policy {name}", f"SHA-256 {trained.digest}") for name, trained in names),
        ("levels", _choice(settings)),
        ("time", f"control steps of {settings.task.control_step:g} s"),
        ("versions", ", ".join(f"{name} {versions[name]}" for name in _SOFTWARE)),
        ("made by", words),
    ]


def _choice(settings: ReplayConfig) -> str:
    """Writes which levels are shown."""
    origin = f"of seed {settings.seed}" if settings.suite is None else f"of {_levels(settings)}"
    if settings.worst is None:
        return origin
    return f"the {settings.worst} worst levels of {settings.policies[0]} {origin}, worst first"
