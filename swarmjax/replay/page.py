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

_SCRIPTS = tuple(f"replay/replay{part}.js" for part in ("_data", "_draw", "_gif", ""))


def page(
    settings: ReplayConfig,
    policies: Sequence[Policy],
    episodes: Sequence[ReplayEpisode],
    words: str,
) -> str:
    """Lays out the page.

    Args:
      settings: The replay's settings.
      policies: The policies that drive the robots.
      episodes: The recordings of each level.
      words: The command line that makes the page.

    Returns:
      HTML. Text about files and settings is either escaped or inside the packed data.
    """
    task = settings.task
    goal = goals.load(task, settings.robot, extension.load(settings.extensions).goals)
    header = {
        "policies": list(settings.policies),
        "about": f"{settings.suite or settings.stage.name}, {settings.robot.body} robots, "
        "simulated by MuJoCo C",
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
    return fill(episodes[0].label, packed)


def fill(title: str, packed: bytes) -> str:
    """Puts title and data into the template.

    Args:
      title: Title of the page until the page's script opens another episode.
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


def _facts(settings: ReplayConfig, policies: Sequence[Policy], words: str) -> list[tuple[str, str]]:
    """States how the episodes were made, one fact per line."""
    names = ("policy",) if len(policies) == 1 else ("first policy", "second policy")
    levels, versions = f"of {settings.suite or f'seed {settings.seed}'}", provenance.versions()
    if settings.worst is not None:
        levels = f"the {settings.worst} {levels} that went worst for the {names[0]}, worst first"
    return [
        *zip(names, (f"SHA-256 {each.digest}" for each in policies), strict=True),
        ("levels", levels),
        ("time", f"control steps of {settings.task.control_step:g} s"),
        (
            "versions",
            ", ".join(f"{name} {versions[name]}" for name in ("swarmjax", "mujoco", "numpy")),
        ),
        ("made by", words),
    ]
