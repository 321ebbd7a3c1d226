"""How fast does JaxMARL's IPPO train on JaxNav, with rollout and update in one program?

`python -m benchmarks.peer_jaxmarl_ippo [arenas=4096,16384] ...` needs the extra `jaxmarl` and
prints a JSON line for each number of arenas.

JaxMARL's scripts are not in its package and have no configuration for JaxNav. This file is a
rewrite of `baselines/IPPO/ippo_ff_mabrax.py` (commit c793d09): networks with two layers of 64, one
policy for all robots, a clipped value loss, advantages normalised in each minibatch, and samples
shuffled individually. The learning rate, the costs and the clip range come from that script's
configuration. The rollout length and the numbers of epochs and minibatches are those of swarmjax,
so batches have the same size. Episodes start from a pool of states that were drawn beforehand, as
in the best case of `benchmarks.peer_jaxnav`.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jax import Array

from benchmarks import key_value, peer_jaxnav, peers, timing
from benchmarks.peers import PeerConfig
from swarmjax import provenance
from swarmjax.config import about, to_dict

ACTION_SIZE = 2
# baselines/IPPO/config/ippo_ff_mabrax.yaml
LEARNING_RATE, DISCOUNT, GAE_LAMBDA, CLIP = 1e-3, 0.99, 0.95, 0.2
ENTROPY_COST, VALUE_COST, MAX_GRAD_NORM = 2e-6, 4.5, 0.5

Pool = tuple[Any, Any]


@dataclass(frozen=True, kw_only=True)
class IppoConfig(PeerConfig):
    """Settings for measuring JaxMARL's trainer; `steps` is not used."""

    rollout: int = field(default=32, metadata=about("control steps per update", 1, 10**4))
    epochs: int = field(default=4, metadata=about("passes over a rollout", 1, 100))
    minibatches: int = field(default=8, metadata=about("gradient steps per pass", 1, 1000))
    updates: int = field(default=4, metadata=about("updates per call", 1, 1000))
    pool: int = field(default=1024, metadata=about("number of start states in the pool", 1, 2**20))


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
    seen, states = peer_jaxnav.begin(pool, ippo.arenas)
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
    seen, states, reward, done, _ = peer_jaxnav.step(
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


def results(config: IppoConfig) -> Iterator[dict[str, Any]]:
    """Trains with each number of arenas, and yields a JSON line for each number."""
    world = peer_jaxnav.make(config)
    pool = peer_jaxnav.draw_pool(world, config.pool, config.seed)
    for arenas in config.arenas:
        ippo = load(world, config, arenas)

        def train(carry: Carry, pool: Pool, ippo: Ippo = ippo) -> tuple[Carry, Array]:
            return jax.lax.scan(partial(update, ippo, pool), carry, length=config.updates)

        carry = jax.jit(partial(init, ippo))(pool)
        program = timing.compile_program(train, carry, pool)
        calls_s, _ = timing.time_program(program, carry, pool, config.repeats)
        rate = config.updates * config.rollout * arenas / timing.spread(calls_s)["call_s"]
        yield {
            "benchmark": "peer_jaxmarl_ippo",
            "trainer": "JaxMARL IPPO, JaxNav",
            "arenas": arenas,
            "robots": config.robots,
            "arena_steps_per_s": rate,
            "robot_steps_per_s": rate * config.robots,
            "transitions_per_s": rate * config.robots,
            "compile_s": program.compile_s,
            "program_bytes": program.size,
            **timing.spread(calls_s),
            "resets": peer_jaxnav.RESETS["pool"],
            "matmul_precision": timing.matmul_precision(),
            "settings": to_dict(config) | {"task": peer_jaxnav.task(config)},
            "device": provenance.device(),
            "versions": peers.versions("jaxmarl"),
            "commit": provenance.commit(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.load(IppoConfig, arguments)))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("peer_jaxmarl_ippo", main, IppoConfig))
