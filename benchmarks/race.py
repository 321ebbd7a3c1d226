"""With which PPO does the same swarm learn to reach its targets sooner, swarmjax's or Brax's?

`python -m benchmarks.race trainer=swarmjax|brax [seed=0,1,2] [points=30] [key=value ...]` takes the
keys of `swarmjax.train` and prints a JSON line for each seed. Both trainers use the same physics,
task and distribution of levels, and the same networks, batch, minibatches, epochs, discount, clip
range, costs and gradient clipping. They also initialise weights in the same way.
The policies of both are evaluated with their mean actions on the same levels, at `points` points
evenly spaced over the budget.

Brax differs in these points:

- it steps the environment through the adapter `SwarmBraxEnv`;
- one constant learning rate for actor and critic, our actor's with `settings=ours`;
- Adam's epsilon;
- minibatches of robots instead of arenas or tiles of samples;
- no bound on normalised observations;
- no loss that keeps mean actions within the range of commands;
- values and advantages are computed and normalised again in each minibatch;
- the advantage discounts the next step's return fully (`brax/training/agents/ppo/losses.py`,
  `compute_gae`), where that of the GAE paper (equation 16) has a factor lambda;
- steps at the time limit have no advantage, where ours are bootstrapped;
- no mask, so robots that have arrived stay in its batch (docs/adapters.md).

Brax gets our option for XLA (`program.compiler_options`) only through the environment variable
`XLA_FLAGS`, as in `suites.yaml`. All of Brax's robot steps count as transitions. Our trainer's
transitions are only the robot steps that it learns from.

`settings=bounded` gives Brax its own default for actions: the tanh of a normal sample, whose
standard deviation depends on the observation. `settings=playground` gives Brax the settings and
networks that MuJoCo Playground uses for walking robots (`PLAYGROUND`), and Brax's initialisation.

The reported seconds are training time alone. Brax compiles during its first two calls. For each of
these two calls, the median time of the later calls counts as training, and the rest of the call
counts as compiling. Evaluation is not timed.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from benchmarks import lines, peers, steps_per_second, timing
from swarmjax import environment
from swarmjax.config import ConfigError, Section, about, to_dict
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells, engine_mjx
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.ppo import optimizer
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.run.compiled import compile_chunk
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import drive
from swarmjax.task import world as task_world
from swarmjax.task.level import Level
from swarmjax.training import mesh
from swarmjax.training import program as programs

SHARES = (0.90, 0.95)
# From MuJoCo Playground 0.2.0, `config/locomotion_params.py`, `brax_ppo_config`. Its minibatches
# hold 256 of 8,192 robots. Settings that Playground leaves out are the defaults of Brax 0.14.2,
# such as the activation, the distribution of actions, and how networks are initialised.
PLAYGROUND: dict[str, Any] = {
    "unroll_length": 20,
    "num_minibatches": 32,
    "num_updates_per_batch": 4,
    "discounting": 0.97,
    "gae_lambda": 0.95,
    "clipping_epsilon": 0.3,
    "entropy_cost": 1e-2,
    "vf_loss_coefficient": 0.5,
    "learning_rate": 3e-4,
    "max_grad_norm": 1.0,
}
PLAYGROUND_NETWORKS = {
    "policy_hidden_layer_sizes": (128,) * 4,
    "value_hidden_layer_sizes": (256,) * 5,
}
# Names of Brax's results in tables, by the value of `settings`.
BRAX = {
    "ours": "Brax PPO, our settings",
    "bounded": "Brax PPO, our settings and its bounded actions",
    "playground": "Brax PPO, Playground's settings",
}
BRAX_RESETS = "at once, each on a level drawn after a sixteenth of the arenas has ended an episode"
_COMPILING = 2  # Brax may compile in this many first calls; the second takes the first's results
_ACTIVATIONS = {"tanh": linen.tanh, "relu": linen.relu, "swish": linen.swish}


@dataclass(frozen=True, kw_only=True)
class RaceConfig(Section):
    """Settings: which trainer, and how to evaluate it."""

    trainer: Literal["swarmjax", "brax"] = field(
        default="swarmjax", metadata=about("whose PPO trains")
    )
    seed: tuple[int, ...] = field(
        default=(0,), metadata=about("random seeds, one after the other", 0, MAX_COUNT)
    )
    points: int = field(default=30, metadata=about("points at which to judge", 4, 1000))
    levels: int = field(default=256, metadata=about("levels to judge on", 1, 2**20))
    level_seed: int = field(default=2, metadata=about("of these", 0, MAX_COUNT))
    settings: Literal["ours", "bounded", "playground"] = field(
        default="ours",
        metadata=about("settings of Brax: ours, with its bounded actions, or MuJoCo Playground's"),
    )


class Course(NamedTuple):
    """A trainer's results at the points where it was evaluated.

    Attributes:
      train_s: [P] seconds of training up to each point.
      share: [P] share of targets reached at each point.
      transitions: [P] transitions trained on up to each point.
      arena_steps: [P] arena steps up to each point.
      compile_s: compile time, s.
    """

    train_s: np.ndarray
    share: np.ndarray
    transitions: np.ndarray
    arena_steps: np.ndarray
    compile_s: float


Judge = Callable[[Any], float]
# Takes a policy's parameters and observations [E, R, O]; returns the mean actions [E, R, U].
Act = Callable[[Any, jax.Array], jax.Array]


def load_judge(race: RaceConfig, trained: TrainConfig, act: Act) -> Judge:
    """Makes a judge, which maps the parameters of a policy to the share of targets reached."""
    *_, stage = trained.stage
    sim = replace(trained.sim, max_robots=stage.robots, max_obstacles=stage.obstacles)
    parts = trained.robot, trained.task, trained.realism, sim
    world = task_world.load((stage,), *parts, arenas=race.levels)
    judged = EvaluateConfig(
        policy="none", stage=stage, robot=trained.robot, task=trained.task, seed=race.level_seed
    )
    levels = cells.draw_stage(judged, range(race.levels)).levels

    @jax.jit
    def share(params: Any, levels: Level) -> jax.Array:
        steps = trained.task.step_limit
        arenas, *_ = engine_mjx.run(
            world, lambda _, seen: (None, act(params, seen.observation)), levels, steps, None
        )
        return jnp.mean(jnp.mean(arenas.arrived, axis=-1))

    return lambda params: float(share(params, levels))


def act_ours(ppo: PPO, learners: LearnerState, seen: jax.Array) -> jax.Array:
    """Returns the mean actions of our learners [N=1, L=1], as an `Act` with `ppo` bound."""
    still = jnp.zeros((*seen.shape[:-1], ppo.sizes.action))
    return ppo.act(jax.tree.map(lambda x: x[0, 0], learners), seen, still)[0]


def points(race: RaceConfig, trained: TrainConfig) -> np.ndarray:
    """Returns the evenly spaced updates [P] after which our trainer is evaluated."""
    return _evenly(race, trained.updates)


def _evenly(race: RaceConfig, updates: int) -> np.ndarray:
    """Returns evenly spaced updates [P], up to `updates`."""
    return max(1, updates // race.points) * np.arange(1, race.points + 1)


def run_ours(race: RaceConfig, trained: TrainConfig) -> Course:
    """Trains with swarmjax."""
    program, schedule = programs.load(trained)
    state = jax.jit(mesh.init(program))(schedule)
    compiled = compile_chunk(program, schedule, state)
    judge, updates = (
        load_judge(race, trained, partial(act_ours, program.ppo)),
        points(race, trained),
    )
    judge(jax.device_get(state.learners))  # compiles, and lets Warp build its kernels
    seconds, shares, transitions = [], [], []
    for n in np.diff(updates, prepend=0):
        began, count = time.perf_counter(), 0
        for done in range(0, int(n), program.rows):
            size = min(program.rows, int(n) - done)
            state, metrics = compiled.call(schedule, state, np.int32(size))
            count += int(np.asarray(metrics["transitions"])[:, :size].sum(dtype=np.int64))
        jax.block_until_ready(state)
        seconds.append(time.perf_counter() - began)
        transitions.append(count)
        shares.append(judge(jax.device_get(state.learners)))
    return Course(
        train_s=np.cumsum(seconds),
        share=np.array(shares),
        transitions=np.cumsum(transitions),
        arena_steps=updates * trained.arenas * trained.algo.rollout_length,
        compile_s=compiled.seconds,
    )


# Brax


def brax_settings(race: RaceConfig, trained: TrainConfig) -> dict[str, Any]:
    """Returns the arguments of Brax's `ppo.train`.

    Args:
      race: settings of the race: number of points, and kind of Brax's settings.
      trained: our config, with bootstrapped advantages and clipped gradients.

    Returns:
      Plain data.
    """
    robots = trained.arenas * trained.sim.robots
    given = PLAYGROUND if race.settings == "playground" else _our_settings(trained)
    updates = _evenly(race, _brax_updates(trained, given))
    return given | {
        "num_timesteps": int(updates[-1]) * robots * given["unroll_length"],
        "num_envs": robots,
        "batch_size": robots // given["num_minibatches"],
        "normalize_observations": trained.algo.normalize_observations,
        "seed": trained.seed,
        "num_evals": race.points + 1,
        "episode_length": trained.task.step_limit,
    }


def _brax_updates(trained: TrainConfig, given: dict[str, Any]) -> int:
    """Returns the number of Brax's rollouts that fit into our budget of control steps."""
    return trained.updates * trained.algo.rollout_length // given["unroll_length"]


def _our_settings(trained: TrainConfig) -> dict[str, Any]:
    """Returns our settings under Brax's names."""
    algo = trained.algo
    return {
        "unroll_length": algo.rollout_length,
        "num_minibatches": algo.num_minibatches,
        "num_updates_per_batch": algo.epochs,
        "discounting": algo.discount,
        "gae_lambda": algo.gae_lambda,
        "clipping_epsilon": algo.clip_epsilon,
        "entropy_cost": algo.entropy_cost,
        "vf_loss_coefficient": algo.value_cost,
        "learning_rate": optimizer.learning_rates(algo, trained.updates)["actor"],
        "max_grad_norm": algo.max_grad_norm,
    }


def network_factory(race: RaceConfig, trained: TrainConfig) -> Callable[..., Any]:
    """Makes Brax's networks: ours, ours with bounded actions, or those of Playground."""
    networks = peers.find("brax.training.agents.ppo.networks", "the extra brax")
    if race.settings == "playground":
        return partial(networks.make_ppo_networks, **PLAYGROUND_NETWORKS)
    algo, bounded = trained.algo, race.settings == "bounded"
    return partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=algo.hidden_sizes,
        value_hidden_layer_sizes=algo.hidden_sizes,
        activation=_ACTIVATIONS[algo.activation],
        distribution_type="tanh_normal" if bounded else "normal",
        noise_std_type="log",
        init_noise_std=algo.initial_std,
        policy_network_kernel_init_fn=lambda: partial(_kernel, (1 + bounded) * drive.ACTION_SIZE),
        value_network_kernel_init_fn=lambda: partial(_kernel, 1),
        mean_kernel_init_fn=lambda: partial(_kernel, drive.ACTION_SIZE),
    )


def _kernel(outputs: int, key: jax.Array, shape: tuple[int, ...], dtype: Any = None) -> jax.Array:
    """Initialises a layer of Brax's networks as ours; the last layer has `outputs` outputs."""
    gain = 0.01 if shape[-1] == outputs else math.sqrt(2.0)
    return jax.nn.initializers.orthogonal(gain)(key, shape, dtype)


def act_brax(race: RaceConfig, trained: TrainConfig, observation_size: int) -> Act:
    """Makes the function that acts for the parameters that Brax trained."""
    networks = peers.find("brax.training.agents.ppo.networks", "the extra brax")
    statistics = peers.find("brax.training.acme.running_statistics", "the extra brax")
    wide = trained.algo.normalize_observations
    normal = {"preprocess_observations_fn": statistics.normalize} if wide else {}
    made = network_factory(race, trained)(observation_size, drive.ACTION_SIZE, **normal)
    choose, key = networks.make_inference_fn(made), jax.random.key(0)
    return lambda params, seen: choose(params, deterministic=True)(seen, key)[0]


def run_brax(race: RaceConfig, trained: TrainConfig) -> Course:
    """Trains with Brax's PPO; raises MissingPeerError if Brax is not installed."""
    brax_ppo = peers.find("brax.training.agents.ppo.train", "the extra brax")
    adapter = peers.find("swarmjax.adapters.brax_env", "the extra brax")
    swarm = adapter.SwarmBraxEnv(environment.load(trained))
    judge = load_judge(race, trained, act_brax(race, trained, swarm.observation_size))
    given = brax_settings(race, trained)
    shares: list[float] = []
    seconds: list[float] = []

    def look(step: int, _: Any, params: Any) -> None:
        """Evaluates the policy; the first call comes before training and compiles the judge."""
        shares.append(judge(params))

    with adapter.mended_jax():
        brax_ppo.train(
            environment=swarm,
            wrap_env=False,
            max_devices_per_host=1,
            run_evals=False,
            num_eval_envs=given["num_envs"],
            network_factory=network_factory(race, trained),
            policy_params_fn=look,
            progress_fn=lambda _, metrics: seconds.append(metrics["training/walltime"]),
            **given,
        )
    calls = np.diff(seconds, prepend=0.0)
    usual = np.median(calls[_COMPILING:])
    compile_s = np.sum(calls[:_COMPILING] - usual)
    calls[:_COMPILING] = usual
    transitions = given["num_timesteps"] / race.points * np.arange(1, race.points + 1)
    return Course(
        train_s=np.cumsum(calls),
        share=np.array(shares[1:]),
        transitions=transitions,
        arena_steps=transitions / trained.sim.robots,
        compile_s=float(compile_s),
    )


# Both


def line(race: RaceConfig, trained: TrainConfig, course: Course) -> dict[str, Any]:
    """Summarises a course.

    Args:
      race: settings of the race.
      trained: our config.
      course: results of the trainer.

    Returns:
      The JSON line. Speeds are medians over all calls except the first.
    """
    calls_s = np.diff(course.train_s)
    speed = np.median(np.diff(course.transitions) / calls_s)
    ours = race.trainer == "swarmjax"
    return {
        "benchmark": "race",
        "trainer": "swarmjax" if ours else BRAX[race.settings],
        "seed": trained.seed,
        **steps_per_second.about(trained),
        **({} if ours else {"resets": BRAX_RESETS}),
        "arena_steps_per_s": float(np.median(np.diff(course.arena_steps) / calls_s)),
        "transitions_per_s": float(speed),
        "compile_s": course.compile_s,
        **seconds_to(course),
        "curve": np.stack([course.train_s, course.share], axis=1).round(4).tolist(),
        "arena_steps_per_call": float(course.arena_steps[0]),
        **timing.spread(calls_s.tolist()),
        "levels": race.levels,
        "settings": to_dict(trained.algo) if ours else brax_settings(race, trained),
        **lines.made_with(),
        "versions": peers.versions("brax"),
    }


def seconds_to(course: Course) -> dict[str, float | None]:
    """Returns the seconds of training until each of `SHARES` is reached; None if it never is."""
    found = {}
    for share in SHARES:
        there = course.train_s[course.share >= share]
        found[f"seconds_to_{share:.2f}"] = float(there[0]) if len(there) else None
    return found


def parse(words: Sequence[str]) -> tuple[RaceConfig, TrainConfig]:
    """Splits the arguments into those of the race and those of training; raises ConfigError."""
    race, rest = lines.parse(RaceConfig, words)
    trained = load_train(["stage=s6", *rest])
    _check(race, trained)
    return race, trained


def _check(race: RaceConfig, trained: TrainConfig) -> None:
    *others, stage = trained.stage
    if others:
        raise ConfigError(f"stage is {trained.stage_name}: give one stage, as in stage=s6.")
    if stage.robots < trained.sim.robots:
        raise ConfigError(
            f"sim.max_robots is {trained.sim.robots}, but stage {stage.name} has "
            f"{stage.robots} robots, and Brax does not support absent ones: give "
            f"sim.max_robots={stage.robots}."
        )
    for key, most in (("policy", "shared"), ("memory", "none")):
        if (value := getattr(trained.algo, key)) != most:
            raise ConfigError(f"algo.{key} is {value}, and Brax has only {most}: give that.")
    updates = trained.updates
    if race.trainer == "brax" and race.settings == "playground":
        _check_playground(trained)
        updates = _brax_updates(trained, PLAYGROUND)
    if updates < race.points:
        raise ConfigError(
            f"points is {race.points}, but the budget is {updates} updates: give at most {updates}."
        )


def _check_playground(trained: TrainConfig) -> None:
    robots, parts = trained.arenas * trained.sim.robots, PLAYGROUND["num_minibatches"]
    if robots % parts:
        raise ConfigError(
            f"arenas is {trained.arenas}, which makes {robots} robots: settings=playground needs a "
            f"multiple of {parts} robots."
        )


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    race, trained = parse(arguments)
    run = {"swarmjax": run_ours, "brax": run_brax}[race.trainer]
    seeded = (replace(trained, seed=seed) for seed in race.seed)
    lines.write(line(race, each, run(race, each)) for each in seeded)
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("race", main, RaceConfig))
