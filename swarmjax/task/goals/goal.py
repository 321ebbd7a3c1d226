"""The interface between environment and goal: where targets are, who has arrived, what is measured.

Training and the judge in MuJoCo C call a goal in the same way, with JAX arrays of one arena or with
NumPy arrays of many. A goal takes the array module from its arguments and indexes axes from the
end, so the same code serves both. A goal of an extension always gets JAX arrays of one arena.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args

from swarmjax.task.level import Level
from swarmjax.task.observation import View

Array = Any
End = Literal["each", "all", "never"]
ENDS = get_args(End)
State = Any  # an array, or a tuple of them

# Prefix of the goal's own measures in the metrics of training.
MEASURED = "measured_"


class Measure(NamedTuple):
    """A measure with one value per level.

    Attributes:
      label: Name of the measure in a table.
      unit: Unit of the value. `%` means a share of 0 to 1 that is shown in per cent. A count has
        no unit.
      is_good: Whether larger values are better.
    """

    label: str
    unit: str
    is_good: bool = False


class GoalSizes(NamedTuple):
    """Settings that goals may use.

    Attributes:
      control_step: s.
      target_radius: distance to the target that counts as arrival, m.
      target_speed: speed of moving targets, m/s.
      hull_radius: m.
      sensor_range: m.
    """

    control_step: float
    target_radius: float
    target_speed: float
    hull_radius: float
    sensor_range: float


class Turn(NamedTuple):
    """A goal's answer after a control step.

    Attributes:
      state: the goal's state for the next step.
      target: [..., R, 2] where each robot's target is from now on, m.
      arrived: [..., R] whether the robot has arrived, bool. Success is the share of these robots.
      earns: [..., R] whether the robot earns the reward `arrival`, bool; None: as `terminates`.
      measured: current value of each of the goal's `measures`, [...] by name.
    """

    state: State
    target: Array
    arrived: Array
    earns: Any = None
    measured: Mapping[str, Array] = {}


class Goal:
    """A goal. This base class never changes the targets, and ends once all robots are at theirs.

    Attributes:
      ends: what ends an episode before the time is out. `each`: a robot that arrives stops for
        good, and the episode is over when all have. `all`: the episode is over when all robots have
        arrived in the same control step. `never`: nothing.
      moves: whether targets may change within an episode.
      measures: the goal's own measures, by name.
      sizes: settings that the goal may use.
    """

    ends: End = "all"
    moves: bool = True
    measures: Mapping[str, Measure] = MappingProxyType({})

    def __init__(self, sizes: GoalSizes) -> None:
        self.sizes = sizes

    def begin(self, level: Level) -> tuple[State, Array]:
        """Returns the state at the start of an episode, and the targets [..., R, 2], m."""
        return (), level.target

    def advance(self, state: State, level: Level, view: View) -> Turn:
        """Returns the goal's answer to a control step.

        Args:
          state: from `begin` or from the previous turn.
          level: the level, with the targets of this step.
          view: the arena after the step, except `view.arrived`, which is from before the step.
        """
        del level
        return Turn(state, view.target, view.present & self.is_near(view))

    def turn(self, state: State, level: Level, view: View) -> Turn:
        """Calls `advance`; with `ends="each"`, a robot that has arrived stays arrived."""
        found = self.advance(state, level, view)
        if self.ends != "each":
            return found
        return found._replace(arrived=view.arrived | found.arrived)

    def is_near(self, view: View) -> Array:
        """Returns whether each robot [..., R] is within `target_radius` of its target."""
        return view.distance <= self.sizes.target_radius

    def drives(self, arrived: Array) -> Array:
        """Returns which robots [..., R] obey their commands, given which have arrived."""
        return ~arrived if self.ends == "each" else ~arrived | True

    def is_under_way(self, arrived: Array) -> Array:
        """Returns which robots [..., R] still have something to do."""
        return ~arrived | True if self.ends == "never" else ~arrived

    def is_over(self, arrived: Array, present: Array) -> Array:
        """Returns whether the episode [...] ends because all robots that are present arrived."""
        either: Array = arrived | ~present
        over = either.all(axis=-1)
        return over & False if self.ends == "never" else over

    def terminates(self, before: Array, arrived: Array, present: Array) -> Array:
        """Returns for which robots [..., R] this control step is the last that can earn reward."""
        if self.ends == "each":
            return arrived & ~before
        return present & self.is_over(arrived, present)[..., None]

    def measured(self, turn: Turn) -> Array:
        """Returns the measures of a turn in the order of `measures`, [..., K] float32.

        Numbers that are not finite become 0, because the files of a run cannot hold them.
        """
        xp = turn.arrived.__array_namespace__()
        none = xp.zeros((*turn.arrived.shape[:-1], 0), xp.float32)
        values = [xp.asarray(turn.measured[name], xp.float32)[..., None] for name in self.measures]
        found = xp.concatenate([none, *values], axis=-1)
        return xp.where(xp.isfinite(found), found, 0.0)
