"""How fast do other projects train robots?

`python -m benchmarks.peers who=benchmarl|jaxmarl_ippo|sb3 [arenas=4096] [key=value ...]` prints a
JSON line for each number of arenas. The networks, the rollout length and the numbers of epochs and
minibatches are those of swarmjax, so batches have the same size.

- `benchmarl` trains VMAS's navigation scenario with BenchMARL's IPPO, which uses PyTorch
  (`torch-peers.txt`). All other settings are BenchMARL's defaults. The line has the seconds of all
  iterations except the first two. An iteration collects a rollout and learns from it, without
  logging or evaluation.
- `jaxmarl_ippo` trains JaxNav with JaxMARL's IPPO (the extra `jaxmarl`), with rollout and update in
  one program. JaxMARL's scripts are not in its package and have no configuration for JaxNav. This
  file is a rewrite of `baselines/IPPO/ippo_ff_mabrax.py` (commit c793d09): networks with two layers
  of 64, one policy for all robots, a clipped value loss, advantages normalised in each minibatch,
  and samples shuffled individually. The learning rate, the costs and the clip range come from that
  script's configuration. Episodes start from a pool of states, as with `jaxnav step=pool`.
- `sb3` trains with Stable-Baselines3's PPO (`torch-peers.txt`) on swarmjax's environment, through
  the adapter `SwarmVecEnv`: every robot is one environment, and all robots share one policy. It
  takes the keys of `swarmjax.train`. Observations are not normalised. Robots that have arrived stay
  in the batch, so all robot steps count. The first rollout and update are not timed.
"""

import contextlib
import itertools
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jax import Array

from benchmarks import lines, peer_environments, peers, timing
from benchmarks.lines import Line
from benchmarks.peers import PeerConfig
from swarmjax import environment
from swarmjax.config import Section, about, to_dict
from swarmjax.ppo import optimizer
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

_WARM = 2  # warm-up iterations of BenchMARL
ACTION_SIZE = 2
# baselines/IPPO/config/ippo_ff_mabrax.yaml
LEARNING_RATE, DISCOUNT, GAE_LAMBDA, CLIP = 1e-3, 0.99, 0.95, 0.2
ENTROPY_COST, VALUE_COST, MAX_GRAD_NORM = 2e-6, 4.5, 0.5

_OURS = AlgoConfig()
Pool = tuple[Any, Any]


@dataclass(frozen=True, kw_only=True)
class TrainerConfig(PeerConfig):
    """Settings for measuring a trainer; `steps` is not used."""

    rollout: int = field(
        default=_OURS.rollout_length, metadata=about("control steps per update", 1, 10**4)
    )
    epochs: int = field(default=_OURS.epochs, metadata=about("passes over a rollout", 1, 100))
    minibatches: int = field(
        default=_OURS.num_minibatches, metadata=about("gradient steps per pass", 1, 1000)
    )


@dataclass(frozen=True, kw_only=True)
class BenchmarlConfig(TrainerConfig):
    """Settings for measuring BenchMARL."""

    device: Literal["auto", "cuda", "cpu"] = field(
        default="auto", metadata=about("device of PyTorch; auto: cuda if there is one")
    )


@dataclass(frozen=True, kw_only=True)
class IppoConfig(TrainerConfig):
    """Settings for measuring JaxMARL's trainer."""

    updates: int = field(default=4, metadata=about("updates per call", 1, 1000))
    pool: int = field(default=1024, metadata=about("number of start states in the pool", 1, 2**20))


# BenchMARL


def experiment(
    config: BenchmarlConfig, arenas: int, device: str, folder: str, callback: Any
) -> Any:
    """Makes BenchMARL's experiment.

    Args:
      config: the settings.
      arenas: number of arenas.
      device: device of PyTorch.
      folder: folder for the files that BenchMARL always writes.
      callback: a BenchMARL callback.

    Returns:
      The experiment, ready to run.
    """
    algorithms = peers.find("benchmarl.algorithms", peers.TORCH)
    environments = peers.find("benchmarl.environments", peers.TORCH)
    experiments = peers.find("benchmarl.experiment", peers.TORCH)
    models = peers.find("benchmarl.models.mlp", peers.TORCH)
    torch = peers.find("torch", peers.TORCH)
    task = environments.VmasTask.NAVIGATION.get_from_yaml()
    task.config |= {
        key: value
        for key, value in peer_environments.vmas_task(config).items()
        if key not in ("scenario", "continuous_actions")
    }
    model = models.MlpConfig(
        num_cells=[64, 64], activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear
    )
    chosen = experiments.ExperimentConfig.get_from_yaml()
    for name, value in changes(config, arenas, device, folder).items():
        setattr(chosen, name, value)
    return experiments.Experiment(
        task=task,
        algorithm_config=algorithms.IppoConfig.get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=config.seed,
        config=chosen,
        callbacks=[callback],
    )


def changes(config: BenchmarlConfig, arenas: int, device: str, folder: str) -> dict[str, Any]:
    """Returns our changes to BenchMARL's defaults: batch, device, no files and no evaluation."""
    frames = arenas * config.rollout
    return {
        "sampling_device": device,
        "train_device": device,
        "buffer_device": device,
        "on_policy_n_envs_per_worker": arenas,
        "on_policy_collected_frames_per_batch": frames,
        "on_policy_n_minibatch_iters": config.epochs,
        "on_policy_minibatch_size": frames // config.minibatches,
        "max_n_frames": None,
        "max_n_iters": _WARM + config.repeats,
        "evaluation": False,
        "render": False,
        "loggers": [],
        "create_json": False,
        "checkpoint_interval": 0,
        "checkpoint_at_end": False,
        "save_folder": folder,
    }


def clock(torch: Any, ends: list[float]) -> Any:
    """Makes a callback that appends the time at the end of each iteration's learning to `ends`."""

    def note(self: Any, training_td: Any, group: str) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        ends.append(time.perf_counter())

    base = peers.find("benchmarl.experiment.callback", peers.TORCH).Callback
    # BenchMARL pickles its callbacks, and cannot find a class defined in a function.
    members = {"on_train_end": note, "__reduce__": lambda self: (object, ())}
    return type("Clock", (base,), members)()


def benchmarl(words: Sequence[str]) -> Iterator[Line]:
    """Trains with BenchMARL; yields a JSON line for each number of arenas."""
    config = lines.load(BenchmarlConfig, words)
    torch = peers.find("torch", peers.TORCH)
    device = peers.torch_device(torch, config.device)
    for arenas in config.arenas:
        ends: list[float] = []
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
            experiment(config, arenas, device, folder, clock(torch, ends)).run()
        calls_s = [after - before for before, after in itertools.pairwise(ends[_WARM - 1 :])]
        rate = config.rollout * arenas / timing.spread(calls_s)["call_s"]
        yield {
            "benchmark": "peer_benchmarl",
            "trainer": "BenchMARL IPPO, VMAS navigation",
            **peers.training(config.robots, arenas, rate, calls_s),
            "settings": to_dict(config) | {"task": peer_environments.vmas_task(config)},
            **peers.with_torch(torch, device, "vmas", "benchmarl", "torchrl", "tensordict"),
        }


# JaxMARL


class ActorCritic(nn.Module):
    """Maps observations [B, O] to mean actions [B, U], log standard deviations [U], values [B]."""

    @nn.compact
    def __call__(self, seen: Array) -> tuple[Array, Array, Array]:
        """Applies both networks."""
        mean = _layer(ACTION_SIZE, 0.01)(_torso(seen))
        log_std = self.param("log_std", nn.initializers.zeros, (ACTION_SIZE,))
        return mean, log_std, _layer(1, 1.0)(_torso(seen))[..., 0]


def _layer(width: int, gain: float) -> nn.Dense:
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain))


def _torso(seen: Array) -> Array:
    for _ in range(2):
        seen = nn.tanh(_layer(64, np.sqrt(2.0))(seen))
    return seen


class Transition(NamedTuple):
    """The observations, actions and results of control steps, [T, B, ...] or [B, ...]."""

    seen: Array
    action: Array
    log_prob: Array
    value: Array
    reward: Array
    done: Array


class Carry(NamedTuple):
    """The changing state: parameters, optimiser, arenas, observations [R A, O] and random key."""

    params: Any
    optimizer: Any
    states: Any
    seen: Array
    key: Array


@dataclass(frozen=True, eq=False)
class Ippo:
    """The parts of the training program that no update changes."""

    world: Any
    config: IppoConfig
    arenas: int
    network: ActorCritic
    optimizer: optax.GradientTransformation


def load(world: Any, config: IppoConfig, arenas: int) -> Ippo:
    """Makes the trainer for a number of arenas."""
    optimizer = optax.chain(
        optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adam(LEARNING_RATE, eps=1e-5)
    )
    return Ippo(world, config, arenas, ActorCritic(), optimizer)


def init(ippo: Ippo, pool: Pool) -> Carry:
    """Starts networks and arenas."""
    key, network_key = jax.random.split(jax.random.key(ippo.config.seed))
    seen, states = peer_environments.begin(pool, ippo.arenas)
    flat = _flat(ippo, seen)
    params = ippo.network.init(network_key, flat[:1])
    return Carry(params, ippo.optimizer.init(params), states, flat, key)


def _flat(ippo: Ippo, by_robot: dict[str, Array]) -> Array:
    """Concatenates the arrays [A, ...] of all robots, given by name, to one array [R A, ...]."""
    return jnp.concatenate([by_robot[name] for name in ippo.world.agents])


def _apply(network: ActorCritic, params: Any, seen: Array) -> tuple[Array, Array, Array]:
    return cast("tuple[Array, Array, Array]", network.apply(params, seen))


def _log_prob(mean: Array, log_std: Array, action: Array) -> Array:
    return jnp.sum(jax.scipy.stats.norm.logpdf(action, mean, jnp.exp(log_std)), axis=-1)


def _step(ippo: Ippo, pool: Pool, carry: Carry, _: None) -> tuple[Carry, Transition]:
    """Takes one control step in all arenas."""
    key, action_key, step_key = jax.random.split(carry.key, 3)
    mean, log_std, value = _apply(ippo.network, carry.params, carry.seen)
    action = mean + jnp.exp(log_std) * jax.random.normal(action_key, mean.shape)
    robots = len(ippo.world.agents)
    by_robot = dict(zip(ippo.world.agents, action.reshape(robots, -1, ACTION_SIZE), strict=True))
    keys = jax.random.split(step_key, ippo.arenas)
    seen, states, reward, done, _ = peer_environments.step(
        ippo.world, "pool", pool, keys, carry.states, by_robot
    )
    transition = Transition(
        seen=carry.seen,
        action=action,
        log_prob=_log_prob(mean, log_std, action),
        value=value,
        reward=_flat(ippo, reward),
        done=_flat(ippo, done).astype(jnp.float32),
    )
    return carry._replace(states=states, seen=_flat(ippo, seen), key=key), transition


def _advantages(path: Transition, last: Array) -> Array:
    """Computes generalised advantages [T, B]; `last` has the values [B] after the last step."""

    def back(carry: tuple[Array, Array], step: Transition) -> tuple[tuple[Array, Array], Array]:
        gae, following = carry
        goes_on = 1.0 - step.done
        delta = step.reward + DISCOUNT * following * goes_on - step.value
        gae = delta + DISCOUNT * GAE_LAMBDA * goes_on * gae
        return (gae, step.value), gae

    _, found = jax.lax.scan(back, (jnp.zeros_like(last), last), path, reverse=True, unroll=8)
    return found


Sample = tuple[Transition, Array, Array]  # with advantage and return


def _loss(network: ActorCritic, params: Any, sample: Sample) -> Array:
    """Computes the loss of a minibatch [B]."""
    path, advantage, target = sample
    mean, log_std, value = _apply(network, params, path.seen)
    near = path.value + jnp.clip(value - path.value, -CLIP, CLIP)
    error = 0.5 * jnp.maximum((value - target) ** 2, (near - target) ** 2).mean()
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    ratio = jnp.exp(_log_prob(mean, log_std, path.action) - path.log_prob)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage).mean()
    entropy = jnp.sum(log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))
    return VALUE_COST * error - gain - ENTROPY_COST * entropy


def _epoch(ippo: Ippo, batch: Sample, progress: tuple[Any, Any], key: Array) -> tuple[Any, Array]:
    """Trains on all samples [B] once, in minibatches of individually shuffled samples."""
    order = jax.random.permutation(key, len(batch[1]))
    parts = jax.tree.map(
        lambda x: x[order].reshape(ippo.config.minibatches, -1, *x.shape[1:]), batch
    )

    def learn(progress: tuple[Any, Any], part: Sample) -> tuple[tuple[Any, Any], Array]:
        params, state = progress
        loss, gradient = jax.value_and_grad(partial(_loss, ippo.network))(params, part)
        steps, state = ippo.optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, steps), state), loss

    progress, losses = jax.lax.scan(learn, progress, parts)
    return progress, jnp.mean(losses)


def update(ippo: Ippo, pool: Pool, carry: Carry, _: None) -> tuple[Carry, Array]:
    """Runs one update: a rollout of all arenas, then the epochs. Also returns the mean loss."""
    carry, path = jax.lax.scan(partial(_step, ippo, pool), carry, length=ippo.config.rollout)
    last = _apply(ippo.network, carry.params, carry.seen)[2]
    advantage = _advantages(path, last)
    batch = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (path, advantage, advantage + path.value)
    )
    key, learn_key = jax.random.split(carry.key)
    keys = jax.random.split(learn_key, ippo.config.epochs)
    epoch = partial(_epoch, ippo, batch)
    (params, state), losses = jax.lax.scan(epoch, (carry.params, carry.optimizer), keys)
    return carry._replace(params=params, optimizer=state, key=key), jnp.mean(losses)


def jaxmarl_ippo(words: Sequence[str]) -> Iterator[Line]:
    """Trains with JaxMARL's IPPO; yields a JSON line for each number of arenas."""
    config = lines.load(IppoConfig, words)
    world = peer_environments.make_jaxnav(config)
    pool = peer_environments.draw_pool(world, config.pool, config.seed)
    for arenas in config.arenas:
        ippo = load(world, config, arenas)

        def train(carry: Carry, pool: Pool, ippo: Ippo = ippo) -> tuple[Carry, Array]:
            return jax.lax.scan(partial(update, ippo, pool), carry, length=config.updates)

        carry = jax.jit(partial(init, ippo))(pool)
        calls_s, compiled = peers.timed(train, carry, pool, config.repeats)
        rate = config.updates * config.rollout * arenas / timing.spread(calls_s)["call_s"]
        yield {
            "benchmark": "peer_jaxmarl_ippo",
            "trainer": "JaxMARL IPPO, JaxNav",
            **peers.training(config.robots, arenas, rate, calls_s),
            **compiled,
            "resets": peer_environments.RESETS["pool"],
            "settings": to_dict(config) | {"task": peer_environments.jaxnav_task(config)},
            **peers.with_jax("jaxmarl"),
        }


# Stable-Baselines3


@dataclass(frozen=True, kw_only=True)
class Sb3Config(Section):
    """Settings for measuring Stable-Baselines3."""

    arenas: tuple[int, ...] = field(
        default=(128,), metadata=about("numbers of arenas, one after the other", 1, 2**20)
    )
    repeats: int = field(default=16, metadata=about("timed updates; 16 span an episode", 1, 1000))


def sb3_settings(trained: TrainConfig, robots: int) -> dict[str, Any]:
    """Returns our settings under the names of Stable-Baselines3, for `robots` robots in total."""
    algo = trained.algo
    return {
        "n_steps": algo.rollout_length,
        "batch_size": robots * algo.rollout_length // algo.num_minibatches,
        "n_epochs": algo.epochs,
        "gamma": algo.discount,
        "gae_lambda": algo.gae_lambda,
        "clip_range": algo.clip_epsilon,
        "learning_rate": optimizer.learning_rates(algo, trained.updates)["actor"],
        "vf_coef": algo.value_cost,
        "ent_coef": algo.entropy_cost,
        "max_grad_norm": algo.max_grad_norm,
        "policy_kwargs": {
            "net_arch": list(algo.hidden_sizes),
            "log_std_init": np.log(algo.initial_std),
        },
        "seed": trained.seed,
    }


def sb3(words: Sequence[str]) -> Iterator[Line]:
    """Trains with Stable-Baselines3; yields a JSON line for each number of arenas."""
    config, rest = lines.parse(Sb3Config, words)
    library, torch = peers.find("stable_baselines3", peers.TORCH), peers.find("torch", peers.TORCH)
    adapter = peers.find("swarmjax.adapters.sb3", peers.TORCH)
    for arenas in config.arenas:
        trained = load_train(["stage=s6", *rest, f"arenas={arenas}"])
        robots = adapter.SwarmVecEnv(environment.load(trained))
        chosen = sb3_settings(trained, robots.num_envs)
        model = library.PPO("MlpPolicy", robots, device="cpu", **chosen)
        batch = robots.num_envs * chosen["n_steps"]
        learn = partial(model.learn, batch, reset_num_timesteps=False)
        calls_s = timing.time_calls(learn, config.repeats)
        rate = chosen["n_steps"] * arenas / timing.spread(calls_s)["call_s"]
        yield {
            "benchmark": "peer_sb3",
            "trainer": "Stable-Baselines3 PPO, swarmjax's environment",
            "robot": trained.robot.body,
            **peers.training(trained.stage[-1].robots, arenas, rate, calls_s),
            "settings": to_dict(config) | {"ppo": chosen},
            **peers.with_torch(torch, "cpu", "stable-baselines3", "gymnasium"),
        }
