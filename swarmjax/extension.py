"""Loads your own pieces from a file: rewards, observations, levels, networks, curricula and goals.

A piece is a function with one of the decorators below; a network is a Flax module, and a goal a
class. Commands take the file as `extensions=FILE`. `make_env` and `train_policy` also take a module
or a list of pieces. All pieces of a file are used unless a setting says otherwise.
docs/extending.md and examples/own_pieces.py have an example of each kind. Loading a file executes
the code in the file. Importing this module does not import JAX.
"""

import ast
import hashlib
import inspect
import linecache
import re
import sys
import textwrap
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from swarmjax.config import ConfigError, reading, show
from swarmjax.config.foreign_code import explained
from swarmjax.config.section import ByName

# Names that the package itself uses, by kind of piece.
TAKEN = {
    "reward": (
        *("progress", "path_progress", "proximity", "arrival"),
        *("contact", "touching", "step_penalty"),
    ),
    "observation": ("infrared", "target_distance", "target_bearing"),
    "level": (
        *("random", "fixed", "map"),
        *("trap", "fence", "bay", "row", "door", "maze", "blocks", "circle", "crowd", "plots"),
    ),
    "network": ("mlp",),
    "curriculum": ("sequential", "mixed", "adaptive", "frontier"),
    "goal": ("navigate", "lifelong", "gather", "cover"),
}
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_LARGEST = 3.4e38  # as in `config.section`: float32 holds no larger number
_CONSTANTS = (bool, int, float, str, bytes, tuple, frozenset, type(None))


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """A function or class of the user, with its name.

    Attributes:
      kind: the kind of piece, as messages and policy files call it.
      name: name of the piece in settings and policy files.
      function: the function or class.
    """

    kind: ClassVar[str] = ""

    name: str
    function: Callable[..., Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the piece's code and of all that it uses from its file, without comments."""
        texts = sorted(_sources(self.function, {}).items())
        return hashlib.sha256(repr(texts).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True, eq=False)
class RewardTerm(Piece):
    """A term of the reward: `(swarmjax.task.reward.Step) -> [R]`, multiplied by its weight."""

    kind: ClassVar[str] = "reward"

    weight: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation(Piece):
    """Extra entries of the observation: `(swarmjax.task.observation.View) -> [R]` or `[R, size]`.

    The policy receives (value - offset) / scale.
    """

    kind: ClassVar[str] = "observation"

    size: int
    unit: str
    offset: float
    scale: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries."""
        if self.size == 1:
            return (self.name,)
        return tuple(f"{self.name}_{i}" for i in range(self.size))


class LevelDrawing(Piece):
    """A way to draw a level of one arena: `(swarmjax.task.level.Level, key) -> Level`."""

    kind: ClassVar[str] = "level"


class Network(Piece):
    """A Flax module for actor and critic; it takes [..., O] and returns features [..., F]."""

    kind: ClassVar[str] = "network"


class OwnCurriculum(Piece):
    """A curriculum: `(Schedule) -> Curriculum`, both of `swarmjax.curriculum.engine`."""

    kind: ClassVar[str] = "curriculum"


class OwnGoal(Piece):
    """A goal: a subclass of `swarmjax.task.goals.goal.Goal`."""

    kind: ClassVar[str] = "goal"


def reward_term(weight: float, name: str | None = None) -> Callable[[Callable], RewardTerm]:
    """Turns a function into a term of the reward.

    Args:
      weight: factor on the function's value. `task.reward.extra.NAME` overrides it.
      name: name of the term; None: the function's name.
    """
    return lambda function: RewardTerm(
        name=name or function.__name__, function=function, weight=weight
    )


def observation(
    size: int = 1, unit: str = "1", offset: float = 0.0, scale: float = 1.0, name: str | None = None
) -> Callable[[Callable], Observation]:
    """Turns a function into an observation.

    Args:
      size: number of entries for each robot.
      unit: unit of the values, for the policy file.
      offset: subtracted from the values, in that unit.
      scale: divisor of the values, in that unit.
      name: name of the observation; None: the function's name.
    """
    numbers = {"size": size, "unit": unit, "offset": offset, "scale": scale}
    return lambda function: Observation(
        name=name or function.__name__, function=function, **numbers
    )


def level_drawing(function: Callable) -> LevelDrawing:
    """Turns a function into a way to draw levels.

    A stage uses this drawing if the stage's `level` is the name of the drawing.
    """
    return LevelDrawing(name=function.__name__, function=function)


def network(module: type) -> Network:
    """Turns a Flax module into a network for actor and critic; `algo.network` selects it.

    The network has the name of the class in snake case: ResidualNet becomes residual_net.
    """
    return Network(name=_snake_case(module), function=module)


def curriculum(function: Callable) -> OwnCurriculum:
    """Turns a function into a curriculum; `curriculum.mode` selects it."""
    return OwnCurriculum(name=function.__name__, function=function)


def goal(goal: type) -> OwnGoal:
    """Turns a subclass of `swarmjax.task.goals.goal.Goal` into a goal; `task.goal` selects it.

    The goal has the name of the class in snake case: KeepApart becomes keep_apart.
    """
    return OwnGoal(name=_snake_case(goal), function=goal)


def _snake_case(cls: type) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


class Extensions(NamedTuple):
    """The pieces of a file, a module or a list.

    Attributes:
      rewards: terms of the reward.
      observations: extra entries of the observation.
      levels: ways to draw levels.
      networks: networks of actor and critic.
      curricula: ways to choose the next episodes.
      goals: goals of robots.
    """

    rewards: tuple[RewardTerm, ...] = ()
    observations: tuple[Observation, ...] = ()
    levels: tuple[LevelDrawing, ...] = ()
    networks: tuple[Network, ...] = ()
    curricula: tuple[OwnCurriculum, ...] = ()
    goals: tuple[OwnGoal, ...] = ()

    def digests(self) -> ByName:
        """Returns the digest of each piece, by kind and name."""
        return ByName(
            {
                pieces[0].kind: ByName({each.name: each.digest for each in pieces})
                for pieces in self
                if pieces
            }
        )


NONE = Extensions()


# Loading

# The pieces that were loaded. The key is the path of a file and the SHA-256 of its content, or a
# word of `hand_over`.
_loaded: dict[str, Extensions] = {}
_HANDED = "python:"  # prefix of the words that `hand_over` returns


def load(source: str | None) -> Extensions:
    """Returns the pieces that the key `extensions` names.

    Args:
      source: path of a Python file, a word from `hand_over`, or None for no pieces.

    Raises:
      ConfigError: if the file is missing or does not import, or a piece is invalid.
    """
    if source is None:
        return NONE
    if source.startswith(_HANDED):
        if source not in _loaded:
            raise ConfigError(
                f"extensions is {source}, which stands for pieces that only a Python program "
                "defined: put these pieces into a file, and give extensions=FILE."
            )
        return _loaded[source]
    path = Path(source)
    try:
        content = reading.read_bytes(path)
    except ConfigError as error:
        raise ConfigError(f"extensions is {show(source)}, but {error}") from None
    digest = hashlib.sha256(content).hexdigest()
    key = f"{path.resolve()} {digest}"
    if key not in _loaded:
        _loaded[key] = collect(_pieces(_import(path, content, digest)), source)
    return _loaded[key]


def hand_over(given: Any) -> str | None:
    """Returns the value of the key `extensions` for pieces from a Python program.

    Args:
      given: None, a path, a module, a piece, or several pieces.

    Raises:
      ConfigError: if `given` is anything else, or a piece is invalid.
    """
    if given is None:
        return None
    if isinstance(given, str | Path):
        return str(given)
    if isinstance(given, types.ModuleType):
        given = _pieces(given)
    pieces = collect(given if isinstance(given, Iterable) else [given], "extensions")
    word = _HANDED + hashlib.sha256(repr(pieces.digests()).encode()).hexdigest()[:12]
    _loaded[word] = pieces
    return word


def _import(path: Path, content: bytes, digest: str) -> types.ModuleType:
    """Runs a file as a module with a unique name, so that it cannot shadow another module."""
    module = types.ModuleType(f"_swarmjax_extension_{digest[:16]}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        # Do not use cached bytecode or lines. Both caches may be out of date, since they compare
        # only a file's size and its modification time in whole seconds.
        linecache.cache.pop(str(path), None)
        with explained(f"{path} cannot be imported"):
            exec(compile(content, str(path), "exec"), vars(module))
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module


def _pieces(module: types.ModuleType) -> list[Piece]:
    """Lists the pieces of a module, without repeats."""
    return list(dict.fromkeys(each for each in vars(module).values() if isinstance(each, Piece)))


def collect(pieces: Iterable[object], where: str) -> Extensions:
    """Checks each piece and sorts the pieces by kind.

    Args:
      pieces: the pieces, in any order.
      where: name of the pieces' source in messages.

    Raises:
      ConfigError: if there is no piece, if something is not a piece, or if a name or a number of a
        piece is invalid.
    """
    by_kind: dict[str, dict[str, Any]] = {kind: {} for kind in TAKEN}
    for piece in pieces:
        if not isinstance(piece, Piece):
            raise ConfigError(
                f"{where} holds {show(str(piece))}: give a file, a module, or functions with a "
                "decorator of swarmjax.extension."
            )
        _check(piece, where)
        if piece.name in by_kind[piece.kind]:
            raise ConfigError(f"{where}: {piece.kind} {piece.name} is defined twice: rename one.")
        by_kind[piece.kind][piece.name] = piece
    if not any(by_kind.values()):
        raise ConfigError(
            f"{where} defines no piece: put a decorator of swarmjax.extension before a function."
        )
    return Extensions(*(tuple(each.values()) for each in by_kind.values()))


def _check(piece: Piece, where: str) -> None:
    label = f"{where}: {piece.kind} {piece.name}"
    if not isinstance(piece.name, str) or not _NAME.fullmatch(piece.name):
        raise ConfigError(
            f"{label} does not have a valid name: give 1 to 40 lower-case letters, digits or _, "
            "beginning with a letter."
        )
    if piece.name in TAKEN[piece.kind]:
        raise ConfigError(f"{label} has the name of a built-in {piece.kind}: give it another name.")
    for key in ("weight", "offset", "scale"):
        value = getattr(piece, key, 0.0)
        if type(value) not in (int, float) or not abs(value) <= _LARGEST:
            raise ConfigError(f"{label} has {key} {show(value)}: give a number that float32 holds.")
    if isinstance(piece, Observation) and (type(piece.size) is not int or piece.size < 1):
        raise ConfigError(f"{label} has size {show(piece.size)}: give a whole number, 1 or more.")
    if isinstance(piece, Observation) and not piece.scale:
        raise ConfigError(f"{label} has scale 0, but scale is a divisor: give another number.")


# Digests


def _sources(thing: Any, found: dict[str, str]) -> dict[str, str]:
    """Returns the syntax trees of a function or class, and of all that it uses from its file.

    The trees lack docstrings. They also lack the decorator, whose arguments settings and layouts
    already have.
    """
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(thing)))
    except (OSError, TypeError, SyntaxError):
        raise ConfigError(
            f"the source of {getattr(thing, '__name__', thing)} cannot be read: define it in a "
            "file or a notebook."
        ) from None
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            node.decorator_list = [] if node in tree.body else node.decorator_list
            del node.body[: ast.get_docstring(node) is not None]
    found[thing.__name__] = ast.dump(tree)
    names = vars(sys.modules[thing.__module__]) if thing.__module__ in sys.modules else {}
    for name in sorted({node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}):
        value = names.get(name)
        value = value.function if isinstance(value, Piece) else value
        if name in found or value is thing:
            continue
        if isinstance(value, _CONSTANTS) and name in names:
            found[name] = repr(value)
        elif getattr(value, "__module__", None) == thing.__module__ and hasattr(value, "__name__"):
            _sources(value, found)
    return found


# What a policy needs


def check_needs(
    needs: Mapping[str, Mapping[str, str]],
    pieces: Extensions,
    where: str,
    kinds: Iterable[str] = tuple(TAKEN),
) -> None:
    """Refuses to run a policy without the pieces that it was trained with.

    Args:
      needs: the digests by kind and name, as the policy's `meta.extensions` holds them.
      pieces: the available pieces.
      where: name of the policy in messages.
      kinds: the kinds of pieces to check.

    Raises:
      ConfigError: if a piece is missing or has changed.
    """
    held = pieces.digests()
    wanted = [
        (kind, name, digest) for kind in kinds for name, digest in needs.get(kind, {}).items()
    ]
    for kind, name, digest in wanted:
        there = held.get(kind, {}).get(name)
        if there != digest:
            holds = "no such piece" if there is None else f"one of digest {there[:12]}"
            raise ConfigError(
                f"{where} was trained with the {kind} {name} of digest {digest[:12]}, but "
                f"extensions has {holds}: give extensions=FILE, the file of that training."
            )
