"""Prints the tables of speeds and trainers in README, docs/benchmarks.md and docs/performance.md.

`python docs/_ext/readme_tables.py` reads `benchmarks/results/suites.jsonl`. Of equal measurements,
those of the newest commit count. All figures of a table must come from one commit on the devices
that are printed below it. A speed is a median; its range follows if it is wider than 10 %.
"""

import json
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Line = dict[str, Any]
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "suites.jsonl"
CARD, CORES = "1 x NVIDIA H200", "CPU x86_64, 2 cores"
ARENAS = (4096, 16384, 65536)
ARENAS_ON_CORES = (128, 1024, 4096)
ENVIRONMENT, TRAINING = "steps_per_second.environment", "steps_per_second.training"
ENVIRONMENTS = {
    "**swarmjax**, planar, rigid contacts": {"benchmark": ENVIRONMENT},
    "**swarmjax**, wheeled, MJX with swarmjax's solver, 2 substeps": {
        "benchmark": ENVIRONMENT,
        "robot": "wheeled",
    },
    "JaxMARL JaxNav, kinematic": {"benchmark": "peer_jaxnav.environment", "reset": "pool"},
    "CAMAR, penalty forces, 3 substeps": {"benchmark": "peer_camar.environment"},
    "VMAS, uncompiled, penalty forces, 2 substeps, no resets": {
        "benchmark": "peer_vmas.environment"
    },
}
TRAINERS = {
    "**swarmjax**": "swarmjax",
    "Brax PPO, our settings": "Brax PPO, our settings",
    "Brax PPO, our settings, its bounded actions": "Brax PPO, our settings and its bounded actions",
    "Brax PPO, Playground's settings": "Brax PPO, Playground's settings",
}
ON_CORES = {
    "**swarmjax**": {"benchmark": TRAINING},
    "Stable-Baselines3, swarmjax's environment": {"benchmark": "peer_sb3"},
    "BenchMARL IPPO, VMAS": {"benchmark": "peer_benchmarl"},
}
STEPPED_BY = {
    ("planar", "auto"): "swarmjax's own solver for discs and boxes",
    ("planar", "mjx"): "MJX",
    ("wheeled", "auto"): "GPU: MJX with swarmjax's contact solver; CPU: MJX",
    ("wheeled", "mjx"): "MJX",
}


DEFAULTS = {"robot": "planar", "solver": "auto"}  # also of peers' lines, which lack these entries


def read() -> list[Line]:
    """Reads the lines, newest last."""
    lines = [json.loads(line) for line in RESULTS.read_text().splitlines()]
    return [DEFAULTS | line for line in lines]


def find(lines: list[Line], **where: Any) -> list[Line]:
    """Returns the lines with these entries that are of the newest commit among them."""
    where = DEFAULTS | where
    found = [line for line in lines if all(line.get(k) == v for k, v in where.items())]
    return [line for line in found if line["commit"] == found[-1]["commit"]]


def tables(lines: list[Line]) -> Iterator[str]:
    """Yields the tables of docs/benchmarks.md, then those of docs/performance.md."""
    card = {"device": CARD}
    yield _by_size("environment, robot steps/s", lines, ENVIRONMENTS, ARENAS, card)
    yield _of_trainers(lines)
    yield _by_size(
        "training on two cores, transitions/s", lines, ON_CORES, ARENAS_ON_CORES, {"device": CORES}
    )
    training = {body: {"benchmark": TRAINING, "robot": body} for body in ("planar", "wheeled")}
    yield _by_size("training, transitions/s", lines, training, ARENAS, card)
    yield _of_physics(lines)


def _by_size(
    head: str,
    lines: list[Line],
    rows: dict[str, dict[str, Any]],
    sizes: tuple[int, ...],
    where: dict[str, Any],
) -> str:
    """Makes a table of speeds with a column for each number of arenas."""
    found = {
        name: [find(lines, arenas=arenas, **where, **row)[-1] for arenas in sizes]
        for name, row in rows.items()
    }
    cells = [[name, *map(_speed, each)] for name, each in found.items()]
    heads = [head, *(f"{arenas:,} arenas" for arenas in sizes)]
    return _table(heads, cells, [line for each in found.values() for line in each])


def _of_trainers(lines: list[Line]) -> str:
    heads = ["training, 5 seeds", "arena steps/s", "s to 90 %", "s to 95 % of targets"]
    rows, used = [], []
    for name, trainer in TRAINERS.items():
        seeds = find(lines, device=CARD, benchmark="race", trainer=trainer)
        speed = _short(statistics.median(line["arena_steps_per_s"] for line in seeds))
        rows.append([name, speed, _seconds(seeds, "0.90"), _seconds(seeds, "0.95")])
        used += seeds
    return _table(heads, rows, used)


def _of_physics(lines: list[Line]) -> str:
    heads = ["`robot`, `sim.solver`, stepped by", "H200, 65,536 arenas", "two cores, 128 arenas"]
    rows, used = [], []
    for (robot, solver), by in STEPPED_BY.items():
        where = {"benchmark": ENVIRONMENT, "robot": robot, "solver": solver}
        card = find(lines, device=CARD, arenas=65536, **where)[-1]
        cores = find(lines, device=CORES, arenas=128, **where)[-1]
        rows.append([f"`{robot}`, `{solver}`: {by}", _speed(card), _speed(cores)])
        used += [card, cores]
    return _table(heads, rows, used)


def _seconds(seeds: list[Line], share: str) -> str:
    """Returns the median and range of the seconds to a share, and how many never got there."""
    found = sorted(s for line in seeds if (s := line[f"seconds_to_{share}"]) is not None)
    if not found:
        return f"never; {len(seeds)} seeds"
    # Brax compiles in its first two calls, whose times are thus estimates (benchmarks/race.py).
    first = any(line["curve"][1][1] >= float(share) for line in seeds)
    text = f"{'at most ' if first else ''}{statistics.median(found):.2f}"
    text += f" ({found[0]:.2f} to {found[-1]:.2f})" if len(found) > 1 else ""
    never = len(seeds) - len(found)
    return text + f"; {never} never" * (never > 0)


def _speed(line: Line) -> str:
    """Returns the transitions or robot steps per second, with their range if it is wide."""
    median, calls_s = line["transitions_per_s"] or line["robot_steps_per_s"], line["calls_s"]
    slowest, fastest = (median * line["call_s"] / end(calls_s) for end in (max, min))
    if fastest - slowest < 0.1 * median:
        return _short(median)
    size = _unit(median)[1]
    return f"{_short(median)} ({_digits(slowest / size)} to {_digits(fastest / size)})"


def _short(value: float) -> str:
    unit, size = _unit(value)
    return f"{_digits(value / size)} {unit}"


def _unit(value: float) -> tuple[str, float]:
    return ("M", 1e6) if value >= 1e6 else ("k", 1e3)


def _digits(value: float) -> str:
    return f"{value:.{0 if value >= 100 else 1}f}"


def _table(heads: list[str], rows: list[list[str]], used: list[Line]) -> str:
    """Lays out a table, and names the commit and the devices."""
    commits, devices = {line["commit"][:7] for line in used}, {line["device"] for line in used}
    assert len(commits) == 1
    body = [heads, ["---", *["--:"] * (len(heads) - 1)], *rows]
    text = "\n".join(f"| {' | '.join(row)} |" for row in body)
    return f"{text}\n\n{' and '.join(sorted(devices))}; commit {commits.pop()}.\n"


if __name__ == "__main__":
    sys.stdout.write("\n".join(tables(read())))
