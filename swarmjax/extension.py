"""Your own pieces: rewards, observations, level drawings, networks and curricula, from a file.

A piece is a function with one of the decorators below; a network is a Flax module. Commands take
the file as `extensions=FILE`. `make_env` and `train_policy` also take a module or a list of pieces.
All pieces of a file are used unless a setting says otherwise. docs/extending.md has an example of
each kind. Loading a file executes it. Importing this module does not import JAX.
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

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_LARGEST = 3.4e38  # as in `config.section`: float32 holds nothing beyond
_CONSTANTS = (bool, int, float, str, bytes, tuple, frozenset, type(None))


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """A function or class of the user, with its name.

    Attributes:
      kind: the kind of piece, as messages and policy files call it.
      taken: names of this kind that the package itself uses.
      name: name of the piece in settings and policy files.
      function: the function.
    """

    kind: ClassVar[str] = ""
    taken: ClassVar[tuple[str, ...]] = ()

    name: str
    function: Callable[..., Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the piece's code and of what it uses from its file, without comments."""
        texts = sorted(_sources(self.function, {}).items())
        return hashlib.sha256(repr(texts).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True, eq=False)
class RewardTerm(Piece):
    """A term of the reward: `(swarmjax.task.reward.Step) -> [R]`, multiplied by its weight."""

    kind: ClassVar[str] = "reward"
    taken: ClassVar[tuple[str, ...]] = (
        "progress",
        "path_progress",
        "proximity",
        "arrival",
        "contact",
        "touching",
        "step_penalty",
    )

    weight: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation(Piece):
    """Extra entries of the observation: `(swarmjax.task.observation.View) -> [R]` or `[R, size]`.

    The policy receives (value - offset) / scale.
    """

    kind: ClassVar[str] = "observation"
    taken: ClassVar[tuple[str, ...]] = ("infrared", "target_distance", "target_bearing")

    size: int
    unit: str
    offset: float
    scale: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its entries."""
        return (
            (self.name,) if self.size == 1 else tuple(f"{self.name}_{i}" for i in range(self.size))
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class LevelDrawing(Piece):
    """A way to draw a level of one arena: `(swarmjax.task.level.Level, key) -> Level`."""

    kind: ClassVar[str] = "level"
    taken: ClassVar[tuple[str, ...]] = (
        *("random", "fixed", "map"),
        *("trap", "fence", "bay", "row", "door", "maze", "circle", "crowd"),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Network(Piece):
    """A Flax module for actor and critic; it takes [..., O] and returns features [..., F]."""

    kind: ClassVar[str] = "network"
    taken: ClassVar[tuple[str, ...]] = ("mlp",)


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnCurriculum(Piece):
    """A curriculum: `(Schedule) -> Curriculum`, both of `swarmjax.curriculum.engine`."""

    kind: ClassVar[str] = "curriculum"
    taken: ClassVar[tuple[str, ...]] = ("sequential", "mixed", "adaptive")


KINDS = (RewardTerm, Observation, LevelDrawing, Network, OwnCurriculum)


def reward_term(weight: float, name: str | None = None) -> Callable[[Callable], RewardTerm]:
    """Turns a function into a term of the reward.

    Args:
      weight: factor on the function's value. `task.reward.extra.NAME` overrides it.
      name: name of the term; None: the function's name.
    """

    def make(function: Callable) -> RewardTerm:
        return RewardTerm(name=name or function.__name__, function=function, weight=weight)

    return make


def observation(
    size: int = 1,
    unit: str = "1",
    offset: float = 0.0,
    scale: float = 1.0,
    name: str | None = None,
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

    def make(function: Callable) -> Observation:
        return Observation(name=name or function.__name__, function=function, **numbers)

    return make


def level_drawing(function: Callable) -> LevelDrawing:
    """Turns a function into a way to draw levels.

    A stage uses this drawing if the stage's `level` is the name of the drawing.
    """
    return LevelDrawing(name=function.__name__, function=function)


def network(module: type) -> Network:
    """Turns a Flax module into a network for actor and critic; `algo.network` selects it.

    The name is that of the class in lower case, so that ResidualNet is residual_net.
    """
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", module.__name__).lower()
    return Network(name=name, function=module)


def curriculum(function: Callable) -> OwnCurriculum:
    """Turns a function into a curriculum; `curriculum.mode` selects it."""
    return OwnCurriculum(name=function.__name__, function=function)


class Extensions(NamedTuple):
    """The pieces of a file, a module or a list.

    Attributes:
      rewards: terms of the reward.
      observations: extra entries of the observation.
      levels: ways to draw levels.
      networks: networks of actor and critic.
      curricula: ways to choose the next episodes.
    """

    rewards: tuple[RewardTerm, ...] = ()
    observations: tuple[Observation, ...] = ()
    levels: tuple[LevelDrawing, ...] = ()
    networks: tuple[Network, ...] = ()
    curricula: tuple[OwnCurriculum, ...] = ()

    def digests(self) -> ByName:
        """Returns the digest of each piece, by kind and name."""
        every = {pieces[0].kind: pieces for pieces in self if pieces}
        return ByName(
            {
                kind: ByName({each.name: each.digest for each in pieces})
                for kind, pieces in every.items()
            }
        )


NONE = Extensions()


# Loading

_files: dict[tuple[str, str], Extensions] = {}  # keys: path, and SHA-256 of the content
_handed: dict[str, Extensions] = {}  # pieces from `hand_over`; keys: the words that stand for them
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
        if source not in _handed:
            raise ConfigError(
                f"extensions is {source}, which stands for pieces that were defined only in a "
                "Python program: put them into a file and give extensions=FILE."
            )
        return _handed[source]
    path = Path(source)
    try:
        content = reading.read_bytes(path)
    except ConfigError as error:
        _, _, reason = str(error).partition(" cannot be read: ")
        raise ConfigError(f"extensions is {show(source)}, which cannot be read: {reason}") from None
    key = (str(path.resolve()), hashlib.sha256(content).hexdigest())
    if key not in _files:
        _files[key] = collect(_pieces(vars(_import(path, content, key[1]))), source)
    return _files[key]


def hand_over(given: object) -> str | None:
    """Returns the value of the key `extensions` for pieces from a Python program.

    Args:
      given: None, a path, a module, a piece, or several pieces.

    Raises:
      ConfigError: if `given` is anything else, or a piece is invalid.
    """
    if given is None or isinstance(given, str):
        return given
    if isinstance(given, Path):
        return str(given)
    if isinstance(given, types.ModuleType):
        given = _pieces(vars(given))
    pieces: list[Any] = list(given) if isinstance(given, Iterable) else [given]
    for piece in pieces:
        if not isinstance(piece, Piece):
            raise ConfigError(
                f"extensions holds {show(str(piece))}: give a file, a module, or functions with a "
                "decorator of swarmjax.extension."
            )
    found = collect(pieces, "extensions")
    digest = hashlib.sha256(repr(found.digests()).encode()).hexdigest()
    word = f"{_HANDED}{digest[:12]}"
    _handed[word] = found
    return word


def _import(path: Path, content: bytes, digest: str) -> types.ModuleType:
    """Runs a file as a module with a unique name, so that it cannot shadow another module."""
    name = f"_swarmjax_extension_{digest[:16]}"
    if path.suffix != ".py":
        raise ConfigError(f"extensions is {show(str(path))}: give a file that ends in .py.")
    module = types.ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module
    try:
        # Do not use cached bytecode or lines. Both caches may be out of date, since they compare
        # only a file's size and its modification time in whole seconds.
        linecache.cache.pop(str(path), None)
        with explained(f"{path} does not import"):
            exec(compile(content, str(path), "exec"), vars(module))
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _pieces(names: Mapping[str, object]) -> list[Piece]:
    """Lists the pieces among a module's names, without repeats."""
    return list(dict.fromkeys(value for value in names.values() if isinstance(value, Piece)))


def collect(pieces: Iterable[Piece], where: str) -> Extensions:
    """Checks each piece and sorts the pieces by kind.

    Args:
      pieces: the pieces, in any order.
      where: name of the pieces' source in messages.

    Raises:
      ConfigError: if a name is invalid or used twice, or a number is out of range.
    """
    found: dict[str, dict[str, Any]] = {kind.kind: {} for kind in KINDS}
    for piece in pieces:
        _check(piece, where)
        if piece.name in found[piece.kind]:
            raise ConfigError(f"{where}: {piece.kind} {piece.name} is there twice: rename one.")
        found[piece.kind][piece.name] = piece
    if not any(found.values()):
        raise ConfigError(
            f"{where} holds no piece: put a decorator of swarmjax.extension before a function."
        )
    return Extensions(*(tuple(each.values()) for each in found.values()))


def _check(piece: Piece, where: str) -> None:
    label = f"{where}: {piece.kind} {piece.name}"
    if not isinstance(piece.name, str) or not _NAME.fullmatch(piece.name):
        raise ConfigError(
            f"{label} is not a valid name: give 1 to 40 lower-case letters, digits and _, a letter "
            "first."
        )
    if piece.name in piece.taken:
        raise ConfigError(f"{label} is the name of a built-in {piece.kind}: rename it.")
    for key in ("weight", "offset", "scale"):
        value = getattr(piece, key, 0.0)
        if type(value) not in (int, float) or not abs(value) <= _LARGEST:
            raise ConfigError(f"{label} has {key} {show(value)}: give a number that float32 holds.")
    if isinstance(piece, Observation) and not (
        isinstance(piece.size, int) and 1 <= piece.size <= 1000 and piece.scale
    ):
        raise ConfigError(
            f"{label} has size {show(piece.size)} and scale {show(piece.scale)}: give a size of 1 "
            "to 1000, and a scale other than 0, by which values are divided."
        )
    if isinstance(piece, Network) and not isinstance(piece.function, type):
        raise ConfigError(f"{label} is not a class: decorate a flax.linen.Module.")


# Digests


def _sources(thing: Any, found: dict[str, str]) -> dict[str, str]:
    """Returns the syntax trees of a function or class, and of all that it uses from its file."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(thing)))
    except (OSError, TypeError, SyntaxError):
        raise ConfigError(
            f"{getattr(thing, '__name__', thing)} has no source that can be read: define it in a "
            "file or a notebook."
        ) from None
    found[thing.__name__] = ast.dump(_bare(tree))
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


def _bare(tree: ast.Module) -> ast.Module:
    """Removes the decorator and all docstrings.

    The decorator's arguments are already recorded in settings and observation layouts.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if node in tree.body:
                node.decorator_list = []
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                del node.body[0]
    return tree


# What a policy needs


def check_needs(
    needs: Mapping[str, Mapping[str, str]],
    pieces: Extensions,
    where: str,
    kinds: Iterable[str] = tuple(kind.kind for kind in KINDS),
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
    wanted = ((kind, name) for kind in kinds for name in needs.get(kind, {}))
    for kind, name in wanted:
        digest, there = needs[kind][name], held.get(kind, {}).get(name)
        if there is None:
            raise ConfigError(
                f"{where} was trained with the {kind} {name}, which is not part of swarmjax: give "
                "extensions=FILE, the file that defines it."
            )
        if there != digest:
            raise ConfigError(
                f"{where} was trained with the {kind} {name} of digest {digest[:12]}, but the "
                f"{kind} in extensions has digest {there[:12]}: give the version of the file that "
                "was used for training."
            )
