"""How fast is each adapter, compared with the bare environment?

`python -m benchmarks.adapters_speed [who=bare,gymnasium,...] [stage=s1] [arenas=256] [steps=200]`
prints a JSON line for each adapter. The command times five calls of `steps` control steps each,
after one warm-up call, with all robots driving straight ahead. `compile_s` is the time of the first
call minus the median time of the later calls. `pettingzoo` steps a single arena in a loop on the
host. `jaxmarl` and `playground` map the step of one arena over `arenas` arenas. Adapters that run
on the device take all steps in one `scan`. The other adapters take their steps in a loop on the
host. An adapter whose library is missing is left out, and the reason is printed.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import swarmjax
from benchmarks import key_value, peers, timing
from swarmjax import provenance
from swarmjax.config import Section, about, to_dict

Call = Callable[[], Any]


@dataclass(frozen=True, kw_only=True)
class AdapterSpeedConfig(Section):
    """Settings: which adapters to time, on which stage, and how many arenas and steps."""

    who: tuple[str, ...] = field(
        default=(
            "bare",
            "gymnasium",
            "sb3",
            "pettingzoo",
            "jaxmarl",
            "brax",
            "playground",
            "torch",
        ),
        metadata=about("adapters, one after the other"),
    )
    stage: str = field(default="s1", metadata=about("stage"))
    arenas: int = field(default=256, metadata=about("arenas", 1, 2**20))
    steps: int = field(default=200, metadata=about("control steps per call", 1, 10**6))


def _scan(reset: Callable[[Any], Any], step: Callable[[Any], Any], key: Any, steps: int) -> Call:
    """Makes a call that takes all steps in one `scan` on the device.

    Each call continues from the state in which the previous call ended.
    """
    held = [jax.jit(reset)(key)]
    many = jax.jit(lambda state: jax.lax.scan(lambda s, _: (step(s), None), state, length=steps)[0])

    def call() -> None:
        held[0] = jax.block_until_ready(many(held[0]))

    return call


def _repeat(step: Callable[[], Any], steps: int) -> Call:
    """Makes a call that takes all steps in a loop on the host."""

    def call() -> None:
        for _ in range(steps):
            step()

    return call


def _straight(*shape: int) -> Any:
    return np.tile(np.array([1.0, 0.0], np.float32), (*shape, 1))


def bare(given: AdapterSpeedConfig) -> Call:
    """Makes the call for the bare environment."""
    swarm = swarmjax.make_env(given.stage, arenas=given.arenas)
    action = jnp.asarray(_straight(given.arenas, swarm.num_robots))
    return _scan(swarm.reset, lambda s: swarm.step(s, action)[0], jax.random.key(0), given.steps)


def gymnasium(given: AdapterSpeedConfig) -> Call:
    """Makes the call for Gymnasium's vector environment."""
    adapter = peers.find("swarmjax.adapters.gymnasium", "the extra gymnasium")
    env = adapter.SwarmVectorEnv(swarmjax.make_env(given.stage, arenas=given.arenas))
    env.reset(seed=0)
    action = _straight(env.num_envs)
    return _repeat(lambda: env.step(action), given.steps)


def sb3(given: AdapterSpeedConfig) -> Call:
    """Makes the call for Stable-Baselines3's vector environment."""
    adapter = peers.find("swarmjax.adapters.sb3", "the extra sb3")
    env = adapter.SwarmVecEnv(swarmjax.make_env(given.stage, arenas=given.arenas))
    env.reset()
    action = _straight(env.num_envs)
    return _repeat(lambda: env.step(action), given.steps)


def pettingzoo(given: AdapterSpeedConfig) -> Call:
    """Makes the call for one PettingZoo arena, which is reset when no robot is left."""
    adapter = peers.find("swarmjax.adapters.pettingzoo", "the extra pettingzoo")
    env = adapter.SwarmParallelEnv(swarmjax.make_env(given.stage, arenas=1))
    action = _straight(1)[0]

    def step() -> None:
        if not env.agents:
            env.reset(seed=0)
        env.step(dict.fromkeys(env.agents, action))

    return _repeat(step, given.steps)


def jaxmarl(given: AdapterSpeedConfig) -> Call:
    """Makes the call for JaxMARL: the step of one arena, mapped over `arenas` arenas."""
    adapter = peers.find("swarmjax.adapters.jaxmarl", "the extra jaxmarl")
    env = adapter.SwarmMultiAgentEnv(swarmjax.make_env(given.stage, arenas=1))
    keys = jax.random.split(jax.random.key(0), given.arenas)
    told = dict.fromkeys(env.agents, jnp.asarray(_straight(given.arenas)))
    step = jax.vmap(env.step)
    return _scan(
        lambda key: jax.vmap(env.reset)(key)[1], lambda s: step(keys, s, told)[1], keys, given.steps
    )


def brax(given: AdapterSpeedConfig) -> Call:
    """Makes the call for Brax, where each robot is one environment."""
    adapter = peers.find("swarmjax.adapters.brax_env", "the extra brax")
    env = adapter.SwarmBraxEnv(swarmjax.make_env(given.stage, arenas=given.arenas))
    keys, told = jax.random.split(jax.random.key(0), env.num_envs), _straight(env.num_envs)
    return _scan(env.reset, lambda state: env.step(state, told), keys, given.steps)


def playground(given: AdapterSpeedConfig) -> Call:
    """Makes the call for Playground, without its wrappers.

    The call maps the step of one arena over `arenas` arenas.
    """
    adapter = peers.find("swarmjax.adapters.playground", "the extra playground")
    env = adapter.SwarmMjxEnv(swarmjax.make_env(given.stage, arenas=1))
    keys = jax.random.split(jax.random.PRNGKey(0), given.arenas)
    told = _straight(given.arenas, env.action_size // 2).reshape(given.arenas, -1)
    step = jax.vmap(env.step)
    return _scan(jax.vmap(env.reset), lambda state: step(state, told), keys, given.steps)


def torch(given: AdapterSpeedConfig) -> Call:
    """Makes the call for the adapter that exchanges PyTorch tensors."""
    library = peers.find("torch", "the extra torch")
    adapter = peers.find("swarmjax.adapters.torch", "the extra torch")
    env = adapter.SwarmTorchEnv(swarmjax.make_env(given.stage, arenas=given.arenas))
    seen = env.reset(seed=0)
    action = library.from_numpy(_straight(len(env))).to(seen.device)
    held: list[Any] = []

    def call() -> None:
        for _ in range(given.steps):
            held[:] = [env.step(action)]
        held[0].reward.sum().item()  # waits for the device

    return call


WAYS: dict[str, Callable[[AdapterSpeedConfig], Call]] = {
    "bare": bare,
    "gymnasium": gymnasium,
    "sb3": sb3,
    "pettingzoo": pettingzoo,
    "jaxmarl": jaxmarl,
    "brax": brax,
    "playground": playground,
    "torch": torch,
}
_PACKAGES = {"bare": [], "sb3": ["stable-baselines3", "torch"]}


def results(given: AdapterSpeedConfig) -> Iterator[dict[str, Any]]:
    """Yields a line for each adapter."""
    for who in given.who:
        try:
            call = WAYS[who](given)
        except peers.MissingPeerError as error:
            yield {"benchmark": "adapters_speed", "who": who, "skipped": str(error)}
            continue
        began = time.perf_counter()
        call()
        first = time.perf_counter() - began
        calls_s = timing.time_calls(call)
        arenas = 1 if who == "pettingzoo" else given.arenas
        rate = arenas * given.steps / statistics.median(calls_s)
        yield {
            "benchmark": "adapters_speed",
            "who": who,
            "stage": given.stage,
            "arenas": arenas,
            "arena_steps_per_s": rate,
            "compile_s": max(0.0, first - statistics.median(calls_s)),
            **timing.spread(calls_s),
            "settings": to_dict(given),
            "device": provenance.device(),
            "versions": peers.versions(*_PACKAGES.get(who, [who])),
            "commit": provenance.commit(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    peers.write(results(key_value.parse(AdapterSpeedConfig, arguments)[0]))
    return 0


if __name__ == "__main__":
    sys.exit(peers.run("adapters_speed", main, AdapterSpeedConfig))
