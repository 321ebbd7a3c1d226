"""Trains a small run over devices, and writes its learners and metrics.

The arguments are `OUT DEVICES WORDS [COORDINATOR RANK]`, where WORDS are words of the config with
spaces between them. With a coordinator, this is one of two processes with one device each.
"""

import re
import sys
from typing import Any

import jax
import numpy as np

from swarmjax.run.compiled import compile_chunk
from swarmjax.run.load_settings import load_train
from swarmjax.training import mesh
from swarmjax.training import program as programs

# An episode takes two updates, so cohorts are judged and stages change within twenty updates.
WORDS = [
    "arenas=64",
    "budget=40960",
    "streams=2",
    "task.step_limit=64",
    "curriculum.threshold=0.02",
]


def main(out: str, devices: str, words: str, *more: str) -> None:
    """Trains, and writes the learners and the metrics of all updates."""
    if more:
        jax.distributed.initialize(more[0], 2, int(more[1]))
    config = load_train([*WORDS, *words.split(), f"devices={devices}"])
    program, schedule = programs.load(config)
    state = jax.jit(mesh.init(program))(schedule)
    call: Any = compile_chunk(program, schedule, state).call
    state, metrics = call(schedule, state, np.int32(config.updates))
    found = {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(state.learners)
    }
    found["sums"] = np.array(len(re.findall(r" all-reduce(?:-start)?\(", call.as_text())))
    found |= {f"metrics/{name}": np.asarray(values) for name, values in metrics.items()}
    if jax.process_index() == 0:
        np.savez(out, allow_pickle=False, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
