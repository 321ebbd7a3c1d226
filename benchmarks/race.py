"""Who brings the same swarm to its targets sooner, our trainer or Brax's PPO?

`python -m benchmarks.race trainer=swarmjax|brax [points=30] [levels=256] [key=value ...]` takes the
keys of `swarmjax.train` and prints one JSON line. Both train on the same compiled environment, with
the same networks, initial weights but for the critic's last layer, batch, minibatches, epochs,
discount, clip, costs and clipped gradients; both are judged by the same policy's mean on the same
levels, at `points` evenly spaced over the budget. What differs is what is Brax's own: one learning
rate for actor and critic, which does not fall (`learning_rate`, that of our actor unless given),
Adam's epsilon, a critic whose last layer begins as large as the others (Brax takes one
initialisation for all), minibatches of robots instead of arenas, no bound on normalised
observations, and no mask, so that robots that have arrived stay in its batch
(benchmarks/brax_env.py). All of its robot steps are counted as transitions, of ours those that were
learned from.

Seconds are of training alone. Brax compiles within its first two calls: these are taken to be as
long as the median of the others, and the rest is its compile time. Judging is outside the clock of
both.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from flax import linen

from benchmarks import curriculum, peers, steps_per_second, timing
from benchmarks.curriculum_arms import StudyConfig
from swarmjax import config
from swarmjax import curriculum as curricula
from swarmjax.config import TrainConfig
from swarmjax.ppo import learner as ppo
from swarmjax.ppo.learner import LearnerState
from swarmjax.settings import Section, about
from swarmjax.task import env, observation

SHARES = (0.90, 0.95)
_COMPILING = 2  # calls of Brax that may compile: the second finds its own results as arguments
_ACTIVATIONS = {"tanh": linen.tanh, "relu": linen.relu, "swish": linen.swish}


@dataclass(frozen=True, kw_only=True)
class RaceConfig(Section):
    """Who trains, and how it is judged."""

    trainer: Literal["swarmjax", "brax"] = field(
        default="swarmjax", metadata=about("whose PPO trains")
    )
    points: int = field(default=30, metadata=about("points at which it is judged", 4, 1000))
    levels: int = field(default=256, metadata=about("that it is judged on", 1, 2**20))
    level_seed: int = field(default=2, metadata=about("of these", 0, config.MAX_COUNT))
    learning_rate: float | None = field(
        default=None, metadata=about("of Brax; null: that of our actor", above=0.0, high=1.0)
    )


class Course(NamedTuple):
    """What came of a trainer.

    Attributes:
      train_s: [P] seconds of training until each point.
      share: [P] of targets reached there.
      transitions: [P] that were trained on until then.
      compile_s: seconds.
    """

    train_s: np.ndarray
    share: np.ndarray
    transitions: np.ndarray
    compile_s: float


Judge = Callable[[LearnerState], float]


def load_judge(race: RaceConfig, trained: TrainConfig) -> Judge:
    """Makes the judge of either trainer: from learners [N=1, L=1] to the share of targets."""
    study = StudyConfig(levels=race.levels, level_seed=race.level_seed)
    judge = curriculum.load_judge(study, trained, {"goal": trained.stage[-1]})
    return lambda learners: float(judge(learners)["goal"]["targets_reached"][0])


def points(race: RaceConfig, trained: TrainConfig) -> np.ndarray:
    """Updates [P] after which it is judged: whole numbers, as far apart as Brax makes them."""
    each = max(1, trained.updates // race.points)
    return each * np.arange(1, race.points + 1)


def run_ours(race: RaceConfig, trained: TrainConfig) -> Course:
    """Trains with swarmjax."""
    judge = load_judge(race, trained)

    def measured(learners: LearnerState) -> dict[str, dict[str, np.ndarray]]:
        return {"goal": {"targets_reached": np.array([judge(learners)])}}

    curves = curriculum.measure(trained, points(race, trained), measured)
    return Course(
        train_s=np.array(curves.train_s),
        share=np.array(curves.judged["goal"]["targets_reached"][0]),
        transitions=np.array(curves.transitions[0]),
        compile_s=curves.compile_s,
    )


# Brax


def brax_settings(race: RaceConfig, trained: TrainConfig) -> dict[str, Any]:
    """Our numbers under the names that Brax's `ppo.train` has for them.

    Args:
      race: how often it is judged, and its learning rate.
      trained: our config; its advantages are bootstrapped, its gradients clipped.

    Returns:
      Plain data.
    """
    algo, robots = trained.algo, trained.arenas * trained.sim.max_robots
    updates = int(points(race, trained)[-1])
    return {
        "num_timesteps": updates * robots * algo.rollout,
        "num_envs": robots,
        "unroll_length": algo.rollout,
        "batch_size": robots // algo.minibatches,
        "num_minibatches": algo.minibatches,
        "num_updates_per_batch": algo.epochs,
        "discounting": algo.discount,
        "gae_lambda": algo.gae_lambda,
        "clipping_epsilon": algo.clip,
        "entropy_cost": algo.entropy_cost,
        "vf_loss_coefficient": algo.value_cost,
        "learning_rate": race.learning_rate or algo.actor_learning_rate,
        "max_grad_norm": algo.max_grad_norm,
        "normalize_observations": algo.normalize_observations,
        "seed": trained.seed,
        "num_evals": race.points + 1,
        "episode_length": trained.task.step_limit,
    }


def network_factory(trained: TrainConfig) -> Callable[..., Any]:
    """Makes Brax's networks like ours: layers, activation, Gaussian, and how they begin."""
    networks = peers.find("brax.training.agents.ppo.networks", "the extra brax")
    algo, orthogonal = trained.algo, jax.nn.initializers.orthogonal
    return partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=algo.hidden,
        value_hidden_layer_sizes=algo.hidden,
        activation=_ACTIVATIONS[algo.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=algo.initial_std,
        policy_network_kernel_init_fn=orthogonal,
        policy_network_kernel_init_kwargs={"scale": math.sqrt(2.0)},
        value_network_kernel_init_fn=orthogonal,
        value_network_kernel_init_kwargs={"scale": math.sqrt(2.0)},
        mean_kernel_init_fn=orthogonal,
        mean_kernel_init_kwargs={"scale": 0.01},
    )


def as_learners(trained: TrainConfig, params: Any) -> LearnerState:
    """Puts the policy that Brax trained into learners [N=1, L=1] of ours, for the judge.

    Args:
      trained: our config, whose networks have the shapes of Brax's.
      params: its moments, and its policy's and critic's parameters.

    Returns:
      Learners that act as Brax's policy does where no observation is beyond our limit; their
      critic is not Brax's.
    """
    moments, policy, _ = params
    mine = ppo.init(jax.random.key(0), trained.algo, observation.SIZE, 2, 1)
    layers = policy["params"]
    torso = {name: layers["MLP_0"][name] for name in mine.params["actor"]["torso"]}
    actor = {
        "torso": torso,
        "mean": layers["Dense_0"],
        "log_std": layers["std_logparam"]["log_value"],
    }
    made = replace(
        mine,
        params=mine.params | {"actor": actor},
        normalizer=replace(mine.normalizer, mean=moments.mean, variance=moments.std**2),
    )
    return jax.tree.map(lambda x: jax.numpy.asarray(x)[None, None], made)


def run_brax(race: RaceConfig, trained: TrainConfig) -> Course:
    """Trains with Brax's PPO; raises MissingPeerError where Brax is not installed."""
    brax_ppo = peers.find("brax.training.agents.ppo.train", "the extra brax")
    adapter = peers.find("benchmarks.brax_env", "the extra brax")
    judge, given = load_judge(race, trained), brax_settings(race, trained)
    shares: list[float] = []
    seconds: list[float] = []

    def look(step: int, _: Any, params: Any) -> None:
        """Judges; the first time, before training, is for compiling the judge."""
        shares.append(judge(as_learners(trained, params)))

    _mend_jax()
    brax_ppo.train(
        environment=adapter.SwarmEnv(env.load(trained), curricula.schedule(trained).stages),
        wrap_env=False,
        max_devices_per_host=1,
        run_evals=False,
        network_factory=network_factory(trained),
        policy_params_fn=look,
        progress_fn=lambda _, metrics: seconds.append(metrics["training/walltime"]),
        **given,
    )
    calls = np.diff(seconds, prepend=0.0)
    usual = np.median(calls[_COMPILING:])
    compile_s = np.sum(calls[:_COMPILING] - usual)
    calls[:_COMPILING] = usual
    each = given["num_timesteps"] / race.points
    return Course(
        train_s=np.cumsum(calls),
        share=np.array(shares[1:]),
        transitions=each * np.arange(1, race.points + 1),
        compile_s=float(compile_s),
    )


def _mend_jax() -> None:
    """Gives JAX back `device_put_replicated`, which Brax 0.14.2 calls and JAX 0.10 has dropped.

    It put a copy on each device, behind a new first axis, as `pmap` does.
    """

    def replicate(tree: Any, devices: Sequence[Any]) -> Any:
        copy = jax.pmap(lambda _, one: one, axis_name="i", in_axes=(0, None), devices=devices)
        return copy(np.arange(len(devices)), tree)

    setattr(jax, "device_put_replicated", replicate)  # noqa: B010  # JAX's types do not have it


# Both


def line(race: RaceConfig, trained: TrainConfig, course: Course) -> dict[str, Any]:
    """Sums a course up.

    Args:
      race: who trained.
      trained: on what.
      course: how it went.

    Returns:
      The JSON line; speeds are medians over the calls but the first.
    """
    calls_s = np.diff(course.train_s)
    updates = int(points(race, trained)[0])
    arena_steps = updates * trained.arenas * trained.algo.rollout
    speed = np.median(np.diff(course.transitions) / calls_s)
    ours = race.trainer == "swarmjax"
    return {
        "benchmark": "race",
        "trainer": {"swarmjax": "swarmjax", "brax": "Brax PPO, this environment"}[race.trainer],
        **steps_per_second.about(trained),
        "arena_steps_per_s": float(arena_steps / np.median(calls_s)),
        "transitions_per_s": float(speed),
        "compile_s": course.compile_s,
        **seconds_to(course),
        "curve": np.stack([course.train_s, course.share], axis=1).round(4).tolist(),
        "updates_per_call": updates,
        **timing.spread(calls_s.tolist()),
        "levels": race.levels,
        "settings": config.to_dict(trained.algo) if ours else brax_settings(race, trained),
        **steps_per_second.made_with(),
        "versions": peers.versions("brax"),
    }


def seconds_to(course: Course) -> dict[str, float | None]:
    """Seconds of training until each of `SHARES` was first judged; None if it never was."""
    found = {}
    for share in SHARES:
        there = course.train_s[course.share >= share]
        found[f"seconds_to_{share:.2f}"] = float(there[0]) if len(there) else None
    return found


def parse(words: Sequence[str]) -> tuple[RaceConfig, TrainConfig]:
    """Tells the words of the race from those of training; raises ConfigError."""
    race, rest = peers.parse(RaceConfig, words)
    trained = config.load_train(["stage=s6", *rest])
    *others, stage = trained.stage
    if others:
        raise config.ConfigError(f"stage is {trained.stage_name}: give one stage, as in stage=s6.")
    if stage.robots < trained.sim.max_robots:
        raise config.ConfigError(
            f"sim.max_robots is {trained.sim.max_robots}, but stage {stage.name} has "
            f"{stage.robots} robots, and Brax has no place for absent ones: give "
            f"sim.max_robots={stage.robots}."
        )
    if trained.updates < race.points:
        raise config.ConfigError(
            f"points is {race.points}, but the budget is {trained.updates} updates: give at most "
            "as many."
        )
    return race, trained


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    race, trained = parse(arguments)
    run = {"swarmjax": run_ours, "brax": run_brax}[race.trainer]
    peers.write([line(race, trained, run(race, trained))])
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("race", main, RaceConfig))
