"""Writes the version of every dependency, direct and transitive, into pyproject.toml.

What users install has ranges there; these constraints, which no wheel holds, make this tree's
environment the same everywhere. `python .ci/pin.py` keeps to those that stand there;
`python .ci/pin.py --upgrade` takes the newest that the ranges allow: run `.ci/versions.py` then.
The lock file names the registry's host, so it is not committed.
"""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
LIST = re.compile(r"(constraint-dependencies = \[\n)(.*?)(\])", re.DOTALL)


def main(arguments: list[str]) -> int:
    """Resolves all extras and groups, and writes what came out."""
    file = PROJECT / "pyproject.toml"
    if "--upgrade" in arguments:
        file.write_text(LIST.sub(r"\1\3", file.read_text()))
    subprocess.run(["uv", "lock", "--quiet", *arguments], cwd=PROJECT, check=True)
    locked = tomllib.loads((PROJECT / "uv.lock").read_text())["package"]
    pins = sorted(f"{p['name']}=={p['version']}" for p in locked if "editable" not in p["source"])
    lines = "".join(f'  "{pin}",\n' for pin in pins)
    file.write_text(LIST.sub(lambda found: found[1] + lines + found[3], file.read_text()))
    sys.stdout.write(f"{len(pins)} versions pinned in {file.name}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
