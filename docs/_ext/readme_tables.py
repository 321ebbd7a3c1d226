"""Prints README's tables of speeds and trainers from `benchmarks/results/suites.jsonl`.

`python docs/_ext/readme_tables.py`. Of equal measurements, those of the newest commit count. All
figures of a table must come from one commit on one device, which is printed below it.
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
ENVIRONMENTS = {
    "**swarmjax**, planar, rigid contacts": {"benchmark": "steps_per_second.environment"},
    "**swarmjax**, wheeled, MJX, 2 substeps": {
        "benchmark": "steps_per_second.environment",
        "robot": "wheeled",
    },
    "JaxMARL JaxNav, kinematic": {"benchmark": "peer_jaxnav.environment", "reset": "pool"},
    "CAMAR, penalty forces, 3 substeps": {"benchmark": "peer_camar.environment"},
    "VMAS, penalty forces, 2 substeps, no resets": {"benchmark": "peer_vmas.environment"},
}
TRAINERS = {
    "**swarmjax**": "swarmjax",
    "Brax PPO, our settings": "Brax PPO, this environment",
    "Brax PPO, Playground's update settings": (
        "Brax PPO as MuJoCo Playground sets it, this environment"
    ),
}
ON_CORES = {
    "**swarmjax**, 128 arenas": {"benchmark": "steps_per_second.training", "arenas": 128},
    "BenchMARL IPPO, VMAS, 64 arenas": {"benchmark": "peer_benchmarl", "arenas": 64},
    "Stable-Baselines3, MuJoCo C, 16 arenas": {"benchmark": "cpu_sb3", "arenas": 16},
    "PPO-PyTorch's way, MuJoCo C, one arena": {"benchmark": "cpu_paper_way"},
}


def read() -> list[Line]:
    """Reads the lines, newest last; peers count as planar."""
    lines = [json.loads(line) for line in RESULTS.read_text().splitlines()]
    return [{"robot": "planar"} | line for line in lines]


def find(lines: list[Line], **where: Any) -> list[Line]:
    """Returns the lines with these entries that are of the newest commit among them."""
    where = {"robot": "planar"} | where
    found = [line for line in lines if all(line.get(k) == v for k, v in where.items())]
    return [line for line in found if line["commit"] == found[-1]["commit"]]


def tables(lines: list[Line]) -> Iterator[str]:
    """Yields the tables of environments, trainers, and trainers on two cores."""
    used: list[Line] = []
    heads = [f"{arenas:,} arenas" for arenas in ARENAS]
    rows = []
    for name, where in ENVIRONMENTS.items():
        each = [find(lines, device=CARD, arenas=arenas, **where)[-1] for arenas in ARENAS]
        rows.append([name, *(_millions(line["robot_steps_per_s"]) for line in each)])
        used += each
    yield _table(["environment, robot steps/s", *heads], rows, used)
    yield _of_trainers(lines)
    chosen = {name: find(lines, device=CORES, **where)[-1] for name, where in ON_CORES.items()}
    rows = [[name, f"{line['transitions_per_s']:,.0f}"] for name, line in chosen.items()]
    yield _table(["training on two cores", "transitions/s"], rows, list(chosen.values()))


def _of_trainers(lines: list[Line]) -> str:
    heads = [
        "training, 8,192 arenas, 5 seeds",
        "arena steps/s",
        "s to 90 %",
        "s to 95 % of targets",
    ]
    rows, used = [], []
    for name, trainer in TRAINERS.items():
        seeds = find(lines, device=CARD, benchmark="race", trainer=trainer, arenas=8192)
        speed = _millions(statistics.median(line["arena_steps_per_s"] for line in seeds))
        rows.append([name, speed, _seconds(seeds, "0.90"), _seconds(seeds, "0.95")])
        used += seeds
    return _table(heads, rows, used)


def _seconds(seeds: list[Line], share: str) -> str:
    """Returns the median and range of the seconds to a share, and how many never got there."""
    found = sorted(s for line in seeds if (s := line[f"seconds_to_{share}"]) is not None)
    if not found:
        return f"never; {len(seeds)} seeds"
    first = any(line["curve"][0][1] >= float(share) for line in seeds)  # judged for the first time
    text = f"{'at most ' if first else ''}{statistics.median(found):.2f}"
    text += f" ({found[0]:.2f} to {found[-1]:.2f})" if len(found) > 1 else ""
    never = len(seeds) - len(found)
    return text + f"; {never} never" * (never > 0)


def _millions(value: float) -> str:
    return f"{value / 1e6:.{0 if value >= 1e8 else 1}f} M"


def _table(heads: list[str], rows: list[list[str]], used: list[Line]) -> str:
    """Lays out a table, and names the commits and the device."""
    commits, devices = {line["commit"][:7] for line in used}, {line["device"] for line in used}
    assert len(commits) == len(devices) == 1
    body = [heads, ["---", *["--:"] * (len(heads) - 1)], *rows]
    text = "\n".join(f"| {' | '.join(row)} |" for row in body)
    return f"{text}\n\n{devices.pop()}; commit {commits.pop()}.\n"


if __name__ == "__main__":
    sys.stdout.write("\n".join(tables(read())))
