"""How long does the gradient of a minibatch take with autodiff and with the fused kernels?

`python -m benchmarks.gradient_speed [batch=N,N] [tile=N,N] [programs=N,N] [warps=N,N] [key=value
...]` also takes the keys of `swarmjax.train`, of which only `algo.*` have an effect. For each batch
size the command compiles the gradient with autodiff and with the kernels in every launch setting,
and times these methods alternately. For each method it prints a JSON line. The line has the seconds
per gradient, and the difference from autodiff's gradient at the same and at full precision.

The time of a kernel gradient includes converting the networks to vectors and back, which learners
do only once per update. With `algo.memory=gru` the samples are sequences as long as a rollout. With
`algo.critic=state` the critic has the same inputs as in training. Both options work only with
autodiff.
"""

import functools
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jax.errors import JaxRuntimeError

from benchmarks import key_value, timing
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about
from swarmjax.ppo import losses, networks
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.fast import fused
from swarmjax.ppo.fast.kernel import Launch
from swarmjax.ppo.losses import Minibatch
from swarmjax.ppo.networks import Params
from swarmjax.run.load_settings import load_train
from swarmjax.task import observation, surroundings
from swarmjax.training import program as programs

_STEP = 1e-6  # step along each gradient, so that no gradient can be reused
_VALID = 0.75  # share of the samples that are valid

Gradient = Callable[[Params, Minibatch], Params]


@dataclass(frozen=True, kw_only=True)
class SpeedConfig(Section):
    """Settings: which batch sizes and launches to time, and how many calls."""

    batch: tuple[int, ...] = field(
        default=(1_310_720,), metadata=about("samples of the minibatch", 1, 10**9)
    )
    tile: tuple[int, ...] = field(
        default=(fused.LARGE.tile,), metadata=about("samples of a tile, a power of two", 16, 1024)
    )
    programs: tuple[int, ...] = field(
        default=(fused.LARGE.programs,), metadata=about("programs of the grid", 1, 10**6)
    )
    warps: tuple[int, ...] = field(
        default=(fused.LARGE.warps,), metadata=about("warps of a program, a power of two", 1, 32)
    )
    steps: int = field(default=20, metadata=about("gradients per call", 1, 10**6))
    repeats: int = field(default=10, metadata=about("timed calls of each method", 1, 10**6))
    kernels: Literal["triton", "interpret", "none"] = field(
        default="triton",
        metadata=about("interpret: as JAX, on any device; none: only autodiff"),
    )


def minibatch(key: jax.Array, params: Params, algo: AlgoConfig, size: int) -> Minibatch:
    """Draws samples with probability ratios near 1, so that some ratios are clipped."""
    keys = jax.random.split(key, 7)
    memory = networks.begin_memory(algo, (size // algo.rollout_length,))
    state = jax.random.normal(keys[6], (size, surroundings.SIZE))
    drawn = Minibatch(
        observation=jax.random.normal(keys[0], (size, observation.SIZE)),
        action=jax.random.normal(keys[1], (size, programs.ACTION_SIZE)),
        log_prob=0.1 * jax.random.normal(keys[2], (size,)),
        advantage=jax.random.normal(keys[3], (size,)),
        return_=jax.random.normal(keys[4], (size,)),
        valid=jax.random.uniform(keys[5], (size,)) < _VALID,
        memory=memory,
        begins=None if memory is None else jnp.zeros(size, bool),
        state=state if algo.critic == "state" else None,
    )
    (mean, std, *_), _ = losses.evaluate(params, algo, drawn)
    return replace(drawn, log_prob=drawn.log_prob + networks.log_prob(mean, std, drawn.action))


def methods(given: SpeedConfig, algo: AlgoConfig) -> dict[Launch | None, Gradient]:
    """Makes the methods to time: autodiff under None, and the kernels under each launch."""
    autodiff = jax.grad(losses.ppo_loss, has_aux=True)
    made: dict[Launch | None, Gradient] = {None: _of_samples(autodiff, algo)}
    if given.kernels != "none" and algo.memory == "none" and algo.critic == "observation":
        for launch in itertools.starmap(
            Launch, itertools.product(given.tile, given.programs, given.warps)
        ):
            by_kernel = functools.partial(
                fused.gradient, launch=launch, interpret=given.kernels == "interpret"
            )
            made[launch] = _of_samples(by_kernel, algo)
    return made


def _of_samples(gradient: Callable[..., Any], algo: AlgoConfig) -> Gradient:
    def of_samples(params: Params, samples: Minibatch) -> Params:
        return gradient(params, samples, algo, jnp.sum(samples.valid, dtype=jnp.float32))[0]

    return of_samples


def _compile(
    gradient: Gradient, steps: int, params: Params, samples: Minibatch
) -> timing.TimedProgram | str:
    """Compiles `steps` steps along the gradient; returns the error's first line on failure."""

    def descend(params: Params, samples: Minibatch) -> tuple[Params, None]:
        def step(_: jax.Array, params: Params) -> Params:
            found = gradient(params, samples)
            return jax.tree.map(lambda x, slope: x - _STEP * slope, params, found)

        return jax.lax.fori_loop(0, steps, step, params), None

    try:
        return timing.compile_program(descend, params, samples)
    except JaxRuntimeError as error:  # too few registers or too little memory on the chip
        return str(error).splitlines()[0]


def _time(
    programs: Sequence[timing.TimedProgram], repeats: int, params: Params, samples: Any
) -> Any:
    """Times the programs' calls alternately, s; leaves out each program's first call, a warm-up."""
    taken: list[list[float]] = [[] for _ in programs]
    for _ in range(1 + repeats):
        for program, seconds in zip(programs, taken, strict=True):
            begun = jax.block_until_ready(jax.tree.map(jnp.copy, params))
            began = time.perf_counter()
            jax.block_until_ready(program.call(begun, samples))
            seconds.append(time.perf_counter() - began)
    return [seconds[1:] for seconds in taken]


def _difference(one: Params, other: Params) -> float:
    """Returns the norm of the difference, divided by the norm of the second gradient."""
    apart = jax.tree.map(jnp.subtract, one, other)
    return float(optax.tree.norm(apart) / optax.tree.norm(other))


def lines(given: SpeedConfig, algo: AlgoConfig, size: int) -> Iterator[dict[str, Any]]:
    """Times all methods on one size of the minibatch; yields one line per method."""
    init_key, key = jax.random.split(jax.random.key(0))
    sizes = observation.SIZE, programs.ACTION_SIZE
    more = surroundings.SIZE if algo.critic == "state" else 0
    params = networks.init_params(init_key, algo, *sizes, more)
    samples = jax.jit(minibatch, static_argnums=(2, 3))(key, params, algo, size)
    made = methods(given, algo)
    built = {
        launch: _compile(gradient, given.steps, params, samples)
        for launch, gradient in made.items()
    }
    sound = {k: program for k, program in built.items() if not isinstance(program, str)}
    taken = dict(zip(sound, _time([*sound.values()], given.repeats, params, samples), strict=True))
    with jax.default_matmul_precision("highest"):
        exact = jax.jit(made[None])(params, samples)
    plain = jax.jit(made[None])(params, samples)
    for launch, program in built.items():
        line = _about(given, algo, size, launch)
        if isinstance(program, str):
            yield line | {"error": program}
            continue
        found = jax.jit(made[launch])(params, samples)
        yield line | {
            **timing.spread([seconds / given.steps for seconds in taken[launch]]),
            "difference": _difference(found, plain),
            "difference_from_highest": _difference(found, exact),
            "compile_s": program.compile_s,
            "bytes": program.size,
        }


def _about(
    given: SpeedConfig, algo: AlgoConfig, size: int, launch: Launch | None
) -> dict[str, Any]:
    return {
        "benchmark": "gradient_speed",
        "batch": size,
        "gradient": "autodiff" if launch is None else "fused",
        **(dict.fromkeys(Launch._fields) if launch is None else launch._asdict()),
        "hidden": algo.hidden_sizes,
        "activation": algo.activation,
        "memory": algo.memory_size,
        "critic": algo.critic,
        "steps": given.steps,
        "kernels": given.kernels,
        "matmul_precision": timing.matmul_precision(),
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = key_value.parse(SpeedConfig, arguments)
    algo = load_train(words).algo
    for size in given.batch:
        if algo.memory != "none" and size % algo.rollout_length:
            raise ConfigError(
                f"batch is {size}, but algo.memory is {algo.memory}: give a multiple of "
                f"algo.rollout_length, which is {algo.rollout_length}."
            )
    for size in given.batch:
        for line in lines(given, algo, size):
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("gradient_speed", main, SpeedConfig))
