"""`python -m swarmjax.evaluate policy=FILE suite=stages`: evaluates policies on new levels.

`cells.py` draws the levels, `trials.py` runs the episodes, and `summary.py` summarises them. This
module calls them, and writes and shows the result.

Examples:
  # 1,000 levels of the last stage of training, on wheels
  python -m swarmjax.evaluate policy=runs/first/policy.npz
  # another stage, and the planar body
  python -m swarmjax.evaluate policy=runs/first/policy.npz stage=s3 robot=planar
  # a suite, with tables in files
  python -m swarmjax.evaluate policy=runs/first/policy.npz suite=headline out=judged
  # all seeds of a run together
  python -m swarmjax.evaluate policy='runs/first/policy-seed*.npz'
  # two policies, level by level
  python -m swarmjax.evaluate compare=a.npz,b.npz
  # with noise and latency
  python -m swarmjax.evaluate policy=runs/first/policy.npz realism=real episodes=200
"""

import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from swarmjax import command, life, outputs, words
from swarmjax.evaluate import table as evaluate_table
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import Evaluation, evaluate
from swarmjax.exit_codes import INTERRUPTED


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, said = trained_settings.load(EvaluateConfig, arguments)
    out = None if settings.out is None else Path(settings.out)
    if out is not None:
        outputs.make_room("out", out, None if out.suffix == ".json" else out)
    try:
        with life.progress("evaluate") as progress:
            # Before the episodes, which take a minute, says which settings come from the policies.
            announce = partial(words.say, f"swarmjax.evaluate: {said}")
            evaluation = evaluate(settings, None, progress, announce)
    except KeyboardInterrupt:
        sys.stderr.write("swarmjax.evaluate: interrupted, nothing was written.\n")
        return INTERRUPTED
    if out is not None:
        outputs.write(_content(out, evaluation))
    evaluate_table.show(evaluate_table.console(), evaluation.result)
    return 0


def _content(out: Path, evaluation: Evaluation) -> dict[Path, bytes]:
    """Makes the contents of the JSON file, or of all files of a folder."""
    text = (json.dumps(evaluation.result, indent=2, allow_nan=False) + "\n").encode()
    if out.suffix == ".json":
        return {out: text}
    levels = evaluate_table.levels(evaluation.entrants, evaluation.trials)
    return {out / "result.json": text, out / "levels.csv": levels.encode()}


if __name__ == "__main__":
    sys.exit(command.run("evaluate", main, EvaluateConfig))
