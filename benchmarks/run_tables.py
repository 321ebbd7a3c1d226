"""Makes the Markdown tables of docs/benchmarks.md from the lines of `benchmarks.run`."""

import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

Line = dict[str, Any]
# Keys that distinguish the lines of one entry.
_KEYS = ("arenas", "robots", "seed", "trainer", "cache", "reset", "share")
_SHARES = ("seconds_to_0.90", "seconds_to_0.95")
_COUNTED = ("step", "substeps", "resets", "precision", "matmul_precision")


def newest(lines: Iterable[Line]) -> list[Line]:
    """Selects the newest results, and skips lines without a result.

    Args:
      lines: lines of a file of results, oldest first.

    Returns:
      The newest result for each combination of entry, benchmark and `_KEYS`.
    """
    found = {}
    for line in lines:
        if not {"failed", "skipped"} & line.keys():
            found[line.get("entry"), line["benchmark"], *(line.get(key) for key in _KEYS)] = line
    return list(found.values())


def missing(lines: Sequence[Line]) -> list[Line]:
    """Returns the `failed` and `skipped` lines that no later result replaces."""
    found = {}
    for i, line in enumerate(lines):
        if {"failed", "skipped"} & line.keys():
            given = {key: str(line[key]) for key in _KEYS if key in line}
            if not any(_answers(line, given, later) for later in lines[i + 1 :]):
                found[line.get("entry"), *given.items()] = line
    return list(found.values())


def _answers(line: Line, given: dict[str, str], later: Line) -> bool:
    """Tells whether a later line has the result that a failed or skipped line lacks."""
    same = later.get("entry") == line.get("entry")
    result = not {"failed", "skipped"} & later.keys()
    return same and result and all(str(later.get(key)) == x for key, x in given.items())


def label(line: Line) -> str:
    """Names the measured system: a peer by its name, swarmjax by its body and implementation."""
    if "peer" in line:
        return line["peer"]
    return f"swarmjax, {line['robot']}, {line['impl']}"


def choose(lines: Iterable[Line], *benchmarks: str) -> list[Line]:
    """Selects the lines of some benchmarks; `.environment` also selects `peer_*.environment`."""
    return [line for line in lines if line["benchmark"].endswith(benchmarks)]


def markdown(lines: Sequence[Line]) -> str:
    """Writes all tables, with one section per device.

    Args:
      lines: lines of a file of results.

    Returns:
      Markdown without a main heading.
    """
    results = newest(lines)
    parts = []
    for device in dict.fromkeys(line["device"] for line in results):
        mine = [line for line in results if line["device"] == device]
        parts += [f"### {device}", "", f"Commits: {_words(mine, 'commit')}.", ""]
        for title, write in SECTIONS.items():
            rows = write(mine)
            if rows:
                parts += [f"#### {title}", "", *rows, ""]
    without = missing(lines)
    if without:
        parts += ["### Without a result", "", *_missing_rows(without), ""]
    return "\n".join(parts)


def _words(lines: Sequence[Line], key: str) -> str:
    return ", ".join(f"`{value}`" for value in dict.fromkeys(str(line[key]) for line in lines))


def _rows(heads: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Makes a table whose first column is text and whose other columns are numbers."""
    cells = [list(row) for row in body]
    if not cells:
        return []
    rule = ["---", *["--:"] * (len(heads) - 1)]
    return [f"| {' | '.join(row)} |" for row in (heads, rule, *cells)]


def speed(value: float | None) -> str:
    """Formats a speed with three digits, in thousands, millions or billions."""
    if value is None:
        return "-"
    for unit, name in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value:.3g}"


def seconds(value: float | None, digits: int = 1) -> str:
    """Formats seconds with `digits` decimal places; None becomes `-`."""
    return "-" if value is None else f"{value:.{digits}f}"


def _over(
    lines: Sequence[Line], key: str, show: Callable[[Line], str], name: Callable[[Line], str]
) -> list[str]:
    """Makes a table with a column for each value of a key, and a row for each name."""
    columns = sorted({line[key] for line in lines})
    rows: dict[str, dict[Any, str]] = {}
    for line in lines:
        rows.setdefault(name(line), {})[line[key]] = show(line)
    heads = [key, *(f"{column:,}" for column in columns)]
    return _rows(
        heads, ([title, *(row.get(x, "") for x in columns)] for title, row in rows.items())
    )


def _environment(lines: Sequence[Line]) -> list[str]:
    mine = [line for line in choose(lines, ".environment") if not _is_robots(line)]
    return _over(mine, "arenas", lambda line: speed(line["robot_steps_per_s"]), label)


def _is_robots(line: Line) -> bool:
    return line["benchmark"].startswith("robots_speed")


def _counted(lines: Sequence[Line]) -> list[str]:
    """Makes the table of what a step includes, with one row per system."""
    mine = {label(line): line for line in choose(lines, ".environment")}
    body = ([name, *(str(line.get(key, "")) for key in _COUNTED)] for name, line in mine.items())
    return [row.replace("--:", "---") for row in _rows(["system", *_COUNTED], body)]


def _physics(lines: Sequence[Line]) -> list[str]:
    mine = choose(lines, "steps_per_second.physics")
    return _over(mine, "arenas", lambda line: speed(line["robot_steps_per_s"]), label)


def _training(lines: Sequence[Line]) -> list[str]:
    mine = choose(lines, "steps_per_second.training")
    return _over(mine, "arenas", lambda line: speed(line["transitions_per_s"]), label)


def _robots(lines: Sequence[Line]) -> list[str]:
    mine = [line for line in lines if _is_robots(line)]

    def name(line: Line) -> str:
        return f"{label(line)}: {line['benchmark'].partition('.')[2]}"

    return _over(mine, "robots", lambda line: speed(line["robot_steps_per_s"]), name)


def _compile(lines: Sequence[Line]) -> list[str]:
    mine = choose(lines, "steps_per_second.environment", "steps_per_second.training")

    def name(line: Line) -> str:
        return f"{label(line)}: {line['benchmark'].partition('.')[2]}"

    def show(line: Line) -> str:
        return f"{line['compile_s']:.1f} s, {_bytes(line['program_bytes'] / line['arenas'])}"

    return _over(mine, "arenas", show, name)


def _memory(lines: Sequence[Line]) -> list[str]:
    heads = ("swarm", "arenas", "XLA's analysis", "XLA's peak", "Warp's peak", "the card's")
    keys = ("program_bytes", "peak_bytes", "warp_bytes", "device_bytes")
    body = (
        [label(line), f"{line['arenas']:,}", *(_per_arena(line, key) for key in keys)]
        for line in choose(lines, "memory")
    )
    return _rows(heads, body)


def _per_arena(line: Line, key: str) -> str:
    return "-" if line[key] is None else _bytes(line[key] / line["arenas"])


def _bytes(value: float) -> str:
    return f"{value / 1024:.3g} KiB"


def _trainers(lines: Sequence[Line]) -> list[str]:
    """Makes a row for each trainer and number of arenas.

    Speeds are medians over all seeds. Seconds are given as their median and for each seed.
    """
    rows: dict[tuple[str, int], list[Line]] = {}
    for line in lines:
        if "trainer" in line:
            rows.setdefault((line["trainer"], line["arenas"]), []).append(line)
    heads = (
        "trainer",
        "arenas",
        "seeds",
        "transitions/s",
        "arena steps/s",
        "compile, s",
        "to 0.90, s",
        "to 0.95, s",
    )
    return _rows(
        heads,
        (
            [
                name,
                f"{arenas:,}",
                str(len(mine)),
                *(speed(_middle(mine, key)) for key in ("transitions_per_s", "arena_steps_per_s")),
                seconds(mine[0]["compile_s"]),
                *(_median([x[key] for x in mine], 2) for key in _SHARES),
            ]
            for (name, arenas), mine in rows.items()
        ),
    )


def _middle(lines: Sequence[Line], key: str) -> float:
    return statistics.median(line[key] for line in lines)


def _success(lines: Sequence[Line]) -> list[str]:
    """Makes a row for each swarm, with the median over all seeds and the value of each seed."""
    rows: dict[tuple[str, str], list[Line]] = {}
    for line in choose(lines, "command_to_success"):
        rows.setdefault((line["entry"], label(line)), []).append(line)
    heads = ("swarm", "seeds", "to 0.90, s", "to 0.95, s", "saved, s", "judged in MuJoCo C")
    keys = (*_SHARES, "saved_s")
    return _rows(
        heads,
        (
            [
                name,
                str(len(mine)),
                *(_median([line[key] for line in mine]) for key in keys),
                ", ".join(f"{line['judged']:.3f}" for line in mine),
            ]
            for (_, name), mine in rows.items()
        ),
    )


def _median(values: Sequence[float | None], digits: int = 1) -> str:
    """Formats the median and all values; a seed that never succeeded counts as the slowest."""
    known = sorted(value if value is not None else float("inf") for value in values)
    middle = statistics.median_high(known)
    shown = ", ".join(seconds(value, digits) for value in values)
    return f"{seconds(None if middle == float('inf') else middle, digits)} ({shown})"


def _start_up(lines: Sequence[Line]) -> list[str]:
    heads = ("swarm", "caches", "to the first update, s", "of which compiling, s")
    body = (
        [label(line), line["cache"], seconds(line["seconds"]), seconds(line["compile_s"])]
        for line in choose(lines, "start_up")
    )
    return _rows(heads, body)


def _missing_rows(lines: Sequence[Line]) -> Iterator[str]:
    for line in lines:
        why = "skipped" if "skipped" in line else "failed"
        what = ", ".join(f"{key}={line[key]}" for key in _KEYS if key in line)
        name = line.get("entry", line["benchmark"])
        yield f"- {name}{f' ({what})' if what else ''}: {why}: {line[why]}"


# Titles of the tables, and the functions that make their rows.
SECTIONS: dict[str, Callable[[Sequence[Line]], list[str]]] = {
    "Environment: robot steps a second, random actions": _environment,
    "What is counted": _counted,
    "Physics alone: robot steps a second": _physics,
    "Training: robot transitions a second": _training,
    "More robots: robot steps a second": _robots,
    "Compile time, and memory an arena by XLA's analysis": _compile,
    "Memory an arena": _memory,
    "Trainers": _trainers,
    "From the command to trained": _success,
    "Start": _start_up,
}
