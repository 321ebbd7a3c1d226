"""Fills templates of pages, and writes pages.

A template `package/name` is the file `swarmjax/package/templates/name`. Jinja2 escapes every value.
Data from a run are always values, never templates. The content security policy of each page lets
the page load and run only what its own package put into it.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from swarmjax import outputs

STYLE = "pages/page.css"


def read(name: str) -> str:
    """Reads a file from a package's templates.

    Args:
      name: `package/name`.
    """
    room, _, file = name.partition("/")
    place = resources.files("swarmjax") / room / "templates" / file
    return place.read_text(encoding="utf-8")


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


_TEMPLATES = jinja2.Environment(
    loader=jinja2.FunctionLoader(read),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters["base64"] = _base64


def render(
    template: str,
    *,
    styles: Sequence[str] = (STYLE,),
    script: str = "",
    **values: Any,
) -> str:
    """Lays out a page.

    Args:
      template: template of the page; it extends `pages/base.html`.
      styles: names of the style sheets; later rules override earlier ones.
      script: script of the page, if any. It must come from `swarmjax`, since it is not escaped.
      values: values for the template. They are escaped.

    Returns:
      HTML.
    """
    style = "".join(map(read, styles))
    policy = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": _hash_source(style),
        **({"script-src": _hash_source(script)} if script else {}),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    rules = "; ".join(f"{directive} {allowed}" for directive, allowed in policy.items())
    page = _TEMPLATES.get_template(template)
    return page.render(policy=rules, style=style, script=script, **values)


def _hash_source(text: str) -> str:
    """Writes the hash of a style or a script as a source (W3C, CSP Level 3, 2.3.1)."""
    return f"'sha256-{_base64(hashlib.sha256(text.encode()).digest())}'"


def write(out: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Writes files into a directory, which it creates if necessary.

    Args:
      out: the directory.
      files: contents by name; a name may contain subfolders.

    Returns:
      The paths of the files, in the order of `files`.

    Raises:
      ConfigError: if a file cannot be written.
    """
    paths = [out / name for name in files]
    outputs.make_room("out", out, out)
    outputs.write(dict(zip(paths, files.values(), strict=True)))
    return paths
