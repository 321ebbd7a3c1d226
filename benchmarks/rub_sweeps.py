"""How many solver sweeps do hull contacts with friction need, in our solver and in alternatives?

`python -m benchmarks.rub_sweeps [stages=A,...] [designs=A,...] [driver=random] [key=value ...]`
also takes the keys of `swarmjax.train`. It drives the robots of many arenas of each stage, either
straight to the targets with noise or at random, and keeps the state at every `EVERY`-th control
step. It then solves the contacts of each state with every design. The design `built` is the solver
in `sim/fast/rubbing_jax.py`. The other designs, `DESIGNS`, are written in NumPy. All designs use
float32 and get the same contacts.

For each stage and design it prints a JSON line with the number of sweeps and the error of the
accelerations. The reference accelerations come from at most `CONVERGED` plain sweeps in float64. A
warp of a GPU needs as many sweeps as the slowest of its 32 arenas.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import key_value
from swarmjax import command, environment, provenance
from swarmjax.config import ConfigError, Section, about
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch, drive, physics
from swarmjax.sim import model as sim_model
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast import rubbing_jax
from swarmjax.sim.fast.discs import TOLERANCE, DiscRobots, Discs

STAGES = "s6", "fence", "world_fence", "world_door", "crowd", "world_crowd"
DEFAULTS = ("robot.hull_friction=1", "arenas=512")
STEPS, EVERY = 480, 24  # control steps per arena, and between two kept states
CONVERGED, EXACT = 2000, 1e-13  # limit of float64 sweeps; change of forces that ends them
NOISE = 0.5  # standard deviation of the noise on actions that head for the target
WARP = 32  # number of GPU threads that wait for each other


@dataclass(frozen=True, kw_only=True)
class RubSweepsConfig(Section):
    """Settings: which contacts to solve, and how."""

    stages: tuple[str, ...] = field(default=STAGES, metadata=about("stages of the arenas"))
    driver: Literal["target", "random"] = field(
        default="target", metadata=about("robots head for their targets, or drive at random")
    )
    designs: tuple[str, ...] = field(default=(), metadata=about("designs to try; none: all"))


class States(NamedTuple):
    """S states whose contacts are solved; states of the same control step are next to each other.

    Attributes:
      discs: the parameters of the discs, which are equal in all states.
      robots: [S] the robots of each state.
      side: [S] side of the arena, m.
      obstacle: [S, M, 5] x (m), y (m), yaw (rad), half edges (m).
      arenas: number of states per control step.
    """

    discs: Discs
    robots: DiscRobots
    side: np.ndarray
    obstacle: np.ndarray
    arenas: int


class Contacts(NamedTuple):
    """The contacts of states, at most K per state; entries of missing contacts have no effect.

    Attributes:
      x: [K, S] x of the unit vector along which the first robot is pushed.
      y: [K, S] y of the unit vector that `x` belongs to.
      arm: [K, S] lever arm, m.
      give: [K, S] regularisation R, 1 / kg.
      demand: [K, S, 2] MuJoCo's aref of the normal force and of the friction force, m/s^2.
      stiffness: [K, S, 2] J M^-1 J' + R of both forces, 1 / kg.
      first: [K, S] index of the first robot.
      second: [K, S] index of the second robot; R for a fixture, which does not move.
      there: [K, S] whether the contact exists.
      kick: [R + 1, S, 3] 1 / mass for x and for y, and 1 / moment of inertia; 0 for index R.
      free: [R + 1, S, 3] acceleration without contacts.
      before: [R + 1, S, 3] acceleration in the previous step.
      friction: [S] coefficient of friction.
    """

    x: np.ndarray
    y: np.ndarray
    arm: np.ndarray
    give: np.ndarray
    demand: np.ndarray
    stiffness: np.ndarray
    first: np.ndarray
    second: np.ndarray
    there: np.ndarray
    kick: np.ndarray
    free: np.ndarray
    before: np.ndarray
    friction: np.ndarray


class Design(NamedTuple):
    """A way to sweep over contacts, and to accelerate convergence between sweeps.

    Attributes:
      over: how far a force moves (relaxation), as a share of the distance to its best value.
      since: number of sweeps before relaxation or acceleration starts.
      turns: whether every second sweep goes from the last contact to the first.
      momentum: whether forces have Nesterov's momentum, which restarts when it leads uphill in the
        objective.
      memory: number of past sweeps that Anderson acceleration uses.
    """

    over: float = 1.0
    since: int = 0
    turns: bool = False
    momentum: bool = False
    memory: int = 0


DESIGNS = {
    "plain": Design(),
    "over-1.3-after-6": Design(over=1.3, since=6),
    "over-1.4-after-4": Design(over=1.4, since=4),
    "over-1.5-after-6": Design(over=1.5, since=6),
    "over-1.6-after-2": Design(over=1.6, since=2),
    "to-and-fro": Design(turns=True),
    "momentum-after-2": Design(momentum=True, since=2),
    "leaps-1": Design(memory=1, since=2),
    "leaps-2": Design(memory=2, since=3),
    "leaps-3": Design(memory=3, since=4),
    "leaps-2-over-1.1": Design(memory=2, since=3, over=1.1),
}
BUILT = "built"


class Trail(NamedTuple):
    """The results of the sweeps so far, for states that have not converged.

    Attributes:
      row: [S] index of each state among all states.
      contacts: contacts of these states.
      motion: [R + 1, S, 3] accelerations.
      force: [K, S, 2] current forces.
      past: forces after the last sweeps and the changes in these sweeps, the newest first.
      pace: [S] Nesterov's momentum parameter t.
    """

    row: np.ndarray
    contacts: Contacts
    motion: np.ndarray
    force: np.ndarray
    past: list[tuple[np.ndarray, np.ndarray]]
    pace: np.ndarray


def record(settings: TrainConfig, driver: str, steps: int = STEPS, every: int = EVERY) -> States:
    """Drives the robots of arenas, and keeps states whose contacts can be solved.

    Args:
      settings: settings of training, with hull friction and one physics step per control step.
      driver: `target` or `random`.
      steps: number of control steps.
      every: number of control steps between two kept states.

    Returns:
      The kept states, `steps // every` per arena.
    """
    swarm = environment.load(settings)
    assert swarm.world.physics.substeps == 1
    discs = _discs(swarm.world.physics, rubbing_jax.push_apart)

    def go_on(state: Any, key: Any) -> tuple[Any, Any]:
        def move(state: Any, key: Any) -> tuple[Any, None]:
            return swarm.step(state, _act(swarm, state, key, driver))[0], None

        *keys, last = jax.random.split(key, every + 1)
        state, _ = jax.lax.scan(move, state, jnp.stack(keys))
        level, action = state.arenas.level, _act(swarm, state, last, driver)
        robots = jax.vmap(partial(_robots, swarm))(
            state.arenas.sim, level.side, level.obstacle, action
        )
        return state, (robots, level.side, level.obstacle)

    start, *keys = jax.random.split(jax.random.key(0), 1 + steps // every)
    _, kept = jax.jit(partial(jax.lax.scan, go_on))(swarm.reset(start), jnp.stack(keys))
    flat = jax.tree.map(lambda a: np.asarray(a).reshape(-1, *a.shape[2:]), kept)
    robots, side, obstacle = flat
    return States(discs, robots, side, obstacle, swarm.num_arenas)


def _discs(loaded: physics.Physics, solve: sim_discs.Solve) -> Discs:
    return sim_discs.load(loaded.host, loaded.ids, loaded.robot.hull_radius, solve)


def _robots(swarm: environment.Swarm, sim: Any, side: Any, obstacle: Any, action: Any) -> Any:
    """Returns the `robots` argument of the solver for one arena's next physics step."""
    given = []

    def take(_discs: Discs, robots: DiscRobots, _side: Any, _obstacle: Any) -> Any:
        given.append(robots)
        return robots.free

    loaded = swarm.world.physics
    engine = replace(loaded.engine, step=partial(sim_discs.step, _discs(loaded, take)))
    told = drive.command(action, swarm.world.drive, jnp)
    wheels = drive.wheel_speeds(told, swarm.world.drive, jnp)
    physics.step(
        replace(loaded, engine=engine), physics.unpack(loaded, sim), side, obstacle, wheels
    )
    return given[0]


def _act(swarm: environment.Swarm, state: Any, key: Any, driver: str) -> Any:
    """Draws actions [A, R, 2]."""
    shape = (swarm.num_arenas, swarm.num_robots, 2)
    if driver == "random":
        return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    pose, target = swarm.pose(state), state.arenas.level.target
    away = target - pose[..., :2]
    bearing = jnp.arctan2(away[..., 1], away[..., 0]) - pose[..., 2]
    bearing = (bearing + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    action = jnp.stack([1.0 - 2.0 * jnp.abs(bearing), 2.0 * bearing], axis=-1)
    return jnp.clip(action + NOISE * jax.random.normal(key, shape), -1.0, 1.0)


def contacts_of(states: States) -> Contacts:
    """Lists the contacts of all states, in the order of the JAX solver."""

    def one(robots: DiscRobots, side: Any, obstacle: Any) -> rubbing_jax.Touch:
        fixture = sim_model.fixture_rectangles(side, obstacle, jnp)
        return rubbing_jax.touches(states.discs, robots, fixture)

    touch = jax.jit(jax.vmap(one))(states.robots, states.side, states.obstacle)
    touch, robots = jax.tree.map(np.asarray, (touch, states.robots))
    distance, opponent = touch.push.gap.distance, states.discs.opponent
    _, rows, count = distance.shape
    still = np.full((rows - len(opponent), count), count)
    second = np.concatenate([still, opponent])
    closed = ((distance < 0.0) & (second > np.arange(count))).reshape(len(distance), -1)
    place = np.argsort(~closed, axis=1, kind="stable")[:, : max(1, closed.sum(axis=1).max())]
    there = np.take_along_axis(closed, place, axis=1)

    def pick(of: np.ndarray, without: float) -> np.ndarray:
        found = np.take_along_axis(of.reshape(len(of), -1), place, axis=1)
        return np.where(there, found, without).T

    return Contacts(
        *(pick(a, 0.0) for a in (touch.push.gap.x, touch.push.gap.y, touch.rub.arm)),
        give=pick(touch.push.give, 1.0),
        demand=np.stack([pick(a, 0.0) for a in (touch.push.demand, touch.rub.demand)], axis=-1),
        stiffness=np.stack([pick(a.stiffness, 1.0) for a in touch], axis=-1),
        first=(place % count).T,
        second=np.where(there, second.reshape(-1)[place], count).T,
        there=there.T,
        kick=_with_nobody(np.stack([robots.mobility] * 2 + [robots.rubbing.agility], axis=-1)),
        free=_with_nobody(robots.free),
        before=_with_nobody(robots.before),
        friction=robots.rubbing.friction,
    )


def _with_nobody(of_robots: np.ndarray) -> np.ndarray:
    """Rearranges an array [S, R, 3] to [R + 1, S, 3], with zeros for index R."""
    return np.pad(of_robots.transpose(1, 0, 2), ((0, 1), (0, 0), (0, 0)))


def search(
    contacts: Contacts,
    design: Design,
    most: int,
    dtype: Any = np.float32,
    tolerance: float = TOLERANCE,
) -> tuple[np.ndarray, np.ndarray]:
    """Sweeps over the contacts of each state until its forces have converged.

    Args:
      contacts: contacts of states.
      design: the way to sweep.
      most: maximum number of sweeps.
      dtype: type of all numbers.
      tolerance: a state has converged if no force changes by more than this share of the state's
        largest push.

    Returns:
      Accelerations [S, R, 3] of x, y (m/s^2) and yaw (rad/s^2), and numbers of sweeps [S].
    """
    whole = Contacts(*(a.astype(dtype) if a.dtype.kind == "f" else a for a in contacts))
    final = _first_force(whole)
    sweeps, states = np.zeros(len(whole.friction), int), np.arange(len(whole.friction))
    motion = _moved(whole, whole.free, final)
    trail = Trail(states, whole, motion, final, [], np.ones(len(states), dtype))
    trail = _keep(trail, whole.there.any(axis=0))
    for done in range(1, most + 1):
        if not len(trail.row):
            break
        trail, change = _go_on(trail, design, done)
        sweeps[trail.row] = done
        final[:, trail.row] = trail.past[0][0]
        trail = _keep(trail, change > tolerance * trail.past[0][0][..., 0].max(axis=0))
    found = _moved(whole, whole.free, final)
    return found[:-1].transpose(1, 0, 2), sweeps


def _keep(trail: Trail, which: np.ndarray) -> Trail:
    """Keeps the states of a trail that `which` [S] marks as not yet converged."""
    if which.all():
        return trail
    along_second = Contacts(*(a if a.ndim == 1 else a[:, which] for a in trail.contacts))
    return Trail(
        trail.row[which],
        along_second._replace(friction=trail.contacts.friction[which]),
        trail.motion[:, which],
        trail.force[:, which],
        [(force[:, which], change[:, which]) for force, change in trail.past],
        trail.pace[which],
    )


def _go_on(trail: Trail, design: Design, done: int) -> tuple[Trail, np.ndarray]:
    """Runs sweep number `done`; also returns the largest distance [S] of a force to its optimum."""
    over = design.over if done > design.since else 1.0
    order = range(len(trail.force))
    ordered = order[::-1] if design.turns and done % 2 == 0 else order
    force, motion, best = _sweep(trail, ordered, over)
    change = force - trail.force
    past = [(force, change), *trail.past][: design.memory + 1 if design.memory else 2]
    leapt, pace = force, trail.pace
    if done >= design.since and len(past) > 1:
        if design.memory:
            leapt = _leap(trail.contacts, past)
        elif design.momentum:
            leapt, pace = _coast(trail, past)
    motion = _moved(trail.contacts, motion, leapt - force)
    return trail._replace(motion=motion, force=leapt, past=past, pace=pace), best


def _sweep(
    trail: Trail, order: Sequence[int], over: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns forces [K, S, 2], accelerations, and the largest distance [S] to the best force."""
    contacts, motion, force = trail.contacts, trail.motion.copy(), trail.force.copy()
    largest = np.zeros(len(trail.row), force.dtype)
    for k in order:
        one = _contact(contacts, k)
        short = one.demand - _slide(one, motion) - one.give[:, None] * force[k]
        best = project(force[k] + short / one.stiffness, one.stiffness, one.friction)
        largest = np.maximum(largest, np.abs(best - force[k]).max(axis=-1))
        if over != 1.0:
            way = force[k] + np.array(over, force.dtype) * (best - force[k])
            best = project(way, one.stiffness, one.friction)
        _push(one, motion, best - force[k])
        force[k] = best
    return force, motion, largest


def _leap(contacts: Contacts, past: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Applies Anderson acceleration: mixes past forces so that their mixed changes are smallest.

    Forces stay unchanged in states where the last change is larger than the change before it.
    """
    forces, changes = (np.stack(each) for each in zip(*past, strict=True))
    steps, turns = forces[:-1] - forces[1:], changes[:-1] - changes[1:]
    gram = np.einsum("iksc,jksc->sij", turns, turns)
    ridge = rubbing_jax.ROUNDING * np.einsum("sii->si", gram)
    ridge = np.maximum(ridge, np.finfo(gram.dtype).tiny)
    gram += ridge[:, :, None] * np.eye(gram.shape[1], dtype=gram.dtype)
    wanted = np.einsum("iksc,ksc->si", turns, changes[0])
    weight = np.linalg.solve(gram, wanted[..., None])[..., 0]
    size = np.einsum("iksc,iksc->is", changes[:2], changes[:2])
    weight = np.where(size[0] <= size[1], weight.T, 0.0).astype(gram.dtype)
    mixed = forces[0] - np.einsum("is,iksc->ksc", weight, steps)
    return project(mixed, contacts.stiffness, contacts.friction)


def _coast(
    trail: Trail, past: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Continues the forces' last change (Nesterov's momentum); also returns the new `pace`."""
    (force, change), (before, _) = past
    uphill = np.einsum("ksc,ksc->s", change, force - before) < 0.0
    pace = np.where(uphill, 1.0, trail.pace)
    after = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * pace * pace))
    share = ((pace - 1.0) / after).astype(force.dtype)
    on = force + share[:, None] * (force - before)
    return project(on, trail.contacts.stiffness, trail.contacts.friction), after


def project(force: np.ndarray, cost: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Projects forces [..., 2] to the cone |rub| <= friction * push, like `rubbing_jax.project`."""
    push, rub, size = force[..., 0], force[..., 1], np.abs(force[..., 1])
    edge = cost[..., 0] * push + friction * cost[..., 1] * size
    edge = np.maximum(edge / (cost[..., 0] + friction * friction * cost[..., 1]), 0.0)
    sticks = size <= friction * push
    slips = np.stack([edge, np.sign(rub) * friction * edge], axis=-1)
    return np.where(sticks[..., None], force, slips)


def _first_force(contacts: Contacts) -> np.ndarray:
    """Returns the contact forces [K, S, 2] that belong to the previous step's accelerations."""
    found = np.zeros_like(contacts.demand)
    for k in range(len(found)):
        one = _contact(contacts, k)
        give = np.stack([one.give] * 2, axis=-1)
        wanted = (one.demand - _slide(one, contacts.before)) / give
        found[k] = np.where(one.there[:, None], project(wanted, give, one.friction), 0.0)
    return found


def _contact(contacts: Contacts, k: int) -> Contacts:
    """Selects contact `k` of each state."""
    rest = dict.fromkeys(("kick", "free", "before", "friction"))
    named = contacts._asdict()
    return Contacts(**{name: a if name in rest else a[k] for name, a in named.items()})


def _moved(contacts: Contacts, motion: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Returns `motion` plus the accelerations that forces [K, S, 2] cause."""
    moved = motion.copy()
    for k in range(len(force)):
        _push(_contact(contacts, k), moved, force[k])
    return moved


def _slide(one: Contacts, motion: np.ndarray) -> np.ndarray:
    """Computes the relative accelerations J a [S, 2] at one contact of each state."""
    state = np.arange(len(one.friction))
    a, b = motion[one.first, state], motion[one.second, state]
    x, y, turn = a[:, 0] - b[:, 0], a[:, 1] - b[:, 1], a[:, 2] + b[:, 2]
    return np.stack([one.x * x + one.y * y, one.x * y - one.y * x - one.arm * turn], axis=-1)


def _push(one: Contacts, motion: np.ndarray, force: np.ndarray) -> None:
    """Adds, in place, the accelerations that the forces [S, 2] at one contact per state cause."""
    state, (push, rub) = np.arange(len(one.friction)), force.T
    x, y, turn = one.x * push - one.y * rub, one.y * push + one.x * rub, -one.arm * rub
    pulls = np.stack([x, y, turn], axis=-1)
    motion[one.first, state] += one.kick[one.first, state] * pulls
    pulls[:, :2] *= -1.0
    motion[one.second, state] += one.kick[one.second, state] * pulls


def built(states: States) -> tuple[np.ndarray, np.ndarray]:
    """Returns accelerations [S, R, 3] and numbers of sweeps [S] of `rubbing_jax.solve`."""
    solve = jax.jit(jax.vmap(partial(rubbing_jax.solve, states.discs)))
    found, sweeps = solve(states.robots, states.side, states.obstacle)
    return np.asarray(found), np.asarray(sweeps)


def figures(
    sweeps: np.ndarray, found: np.ndarray, expected: np.ndarray, touching: np.ndarray, arenas: int
) -> dict[str, Any]:
    """Summarises the results of a design.

    Args:
      sweeps: [S] numbers of sweeps.
      found: [S, R, 3] accelerations.
      expected: [S, R, 3] converged accelerations.
      touching: [S] whether the state has a contact.
      arenas: number of states per control step, a multiple of `WARP`.

    Returns:
      Statistics of the numbers of sweeps of all states, and of the errors of states with contacts.
      A state's error is its largest deviation as a share of its largest acceleration.
    """
    size = np.abs(expected).max(axis=(1, 2))
    off = (np.abs(found - expected).max(axis=(1, 2)) / size)[touching]
    slowest = sweeps.reshape(-1, min(WARP, arenas)).max(axis=1)
    return {
        "sweeps_mean": float(sweeps.mean()),
        "sweeps_p99": float(np.percentile(sweeps, 99)),
        "sweeps_most": int(sweeps.max()),
        "sweeps_of_warp": float(slowest.mean()),
        "sweeps_of_step": float(sweeps.reshape(-1, arenas).max(axis=1).mean()),
        "off_p99": float(np.percentile(off, 99)),
        "off_most": float(off.max()),
    }


def results(
    settings: RubSweepsConfig, words: Sequence[str], steps: int = STEPS
) -> Iterator[dict[str, Any]]:
    """Tries every design on the states of every stage; yields one line per stage and design.

    Args:
      settings: the stages, designs and driver.
      words: `key=value` arguments for `swarmjax.train`.
      steps: number of control steps for which arenas are driven.

    Yields:
      Lines for JSON.
    """
    for stage in settings.stages:
        config = load_train([f"stage={stage}", *DEFAULTS, *words])
        states = record(config, settings.driver, steps)
        contacts = contacts_of(states)
        expected, _ = search(contacts, DESIGNS["plain"], CONVERGED, np.float64, EXACT)
        for name in settings.designs or (*DESIGNS, BUILT):
            if name == BUILT:
                found, sweeps = built(states)
            else:
                found, sweeps = search(contacts, DESIGNS[name], states.discs.sweeps)
            touching = contacts.there.any(axis=0)
            yield {
                "benchmark": "rub_sweeps",
                "stage": stage,
                "driver": settings.driver,
                "design": name,
                "hull_friction": config.robot.hull_friction,
                "arenas": states.arenas,
                "states": len(sweeps),
                "touching": float(touching.mean()),
                "contacts_most": len(contacts.there),
                **figures(sweeps, found, expected, touching, states.arenas),
                "device": provenance.device(),
                "versions": provenance.versions(),
                "commit": provenance.commit(),
            }


def _check(settings: RubSweepsConfig, words: Sequence[str]) -> None:
    """Checks that the benchmark can run with these settings; raises ConfigError otherwise."""
    known = *DESIGNS, BUILT
    for name in settings.designs:
        if name not in known:
            raise ConfigError(f"designs has '{name}': give some of {', '.join(known)}.")
    config = load_train([*DEFAULTS, *words])
    if config.arenas % WARP:
        raise ConfigError(f"arenas is {config.arenas}: give a multiple of {WARP}, a GPU's warp.")
    rubs, body = config.robot.hull_friction > 0.0, config.robot.body
    if not rubs or dispatch.choose(config.sim, config.robot).solver != "swarm" or body != "planar":
        raise ConfigError(
            "rub_sweeps measures discs with friction: give robot=planar, sim.solver=swarm and a "
            "robot.hull_friction above 0."
        )


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, words = key_value.parse(RubSweepsConfig, arguments)
    _check(settings, words)
    for line in results(settings, words):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("rub_sweeps", main, TrainConfig))
