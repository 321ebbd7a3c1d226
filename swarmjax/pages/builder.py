"""Fills templates of pages, and writes them.

A template `room/name` is the file `swarmjax/room/templates/name`. Jinja2 escapes every value. What
comes from a run is only ever a value, never a template, and each page carries a policy that lets it
load and run nothing but what its own room put into it.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from swarmjax.config import ConfigError

STYLE = "pages/page.css"


def read(name: str) -> str:
    """Reads a file of a room's templates.

    Args:
      name: `room/name`.
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
    sources: Mapping[str, str] | None = None,
    **values: Any,
) -> str:
    """Lays a page out.

    Args:
      template: of the page, which extends `pages/base.html`.
      styles: names of its style sheets; of two rules the later one counts.
      script: that it runs, if any; from this package, since it is not escaped.
      sources: what it may load beside its own style and script and pictures inside it, by the
        directive of its policy.
      values: that the template names. They are escaped.

    Returns:
      HTML.
    """
    style = "".join(map(read, styles))
    policy = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": _hash_source(style),
        **({"script-src": _hash_source(script)} if script else {}),
        **(sources or {}),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    rules = "; ".join(f"{directive} {allowed}" for directive, allowed in policy.items())
    page = _TEMPLATES.get_template(template)
    return page.render(policy=rules, style=style, script=script, **values)


def _hash_source(text: str) -> str:
    """Names a style or a script in a policy (W3C, Content Security Policy Level 3, 2.3.1)."""
    return f"'sha256-{_base64(hashlib.sha256(text.encode()).digest())}'"


def write(out: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Writes files into a directory, which is made.

    Args:
      out: the directory.
      files: contents by name, which may lead into folders of it.

    Returns:
      The files, in their order.

    Raises:
      ConfigError: if one cannot be written.
    """
    try:
        for name, content in files.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_bytes(content)
    except OSError as error:
        raise ConfigError(f"out is {out}, which cannot be written: {error.strerror}.") from None
    return [out / name for name in files]
