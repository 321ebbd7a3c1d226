"""Runs our update on the golden batch and measures its errors against the golden numbers.

As a program, `golden_update.py CASE` prints the errors as JSON. With JAX_ENABLE_X64=1, all numbers
are float64.
"""

import functools
import json
import sys
from dataclasses import replace
from pathlib import Path

import golden_inputs as inputs
import jax
import jax.numpy as jnp
import numpy as np

from swarmjax.ppo import networks
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.run.load_settings import load_train

PAPER = load_train(["algo=paper"]).algo
CONFIGS = {
    "terminal": PAPER,
    # The deviation falls to the schedule's second level, 0.55, between the batch and the update.
    "std": replace(PAPER, std_interval=inputs.STEPS),
}
TOTAL = 166  # updates of the run; constant learning rates do not depend on it


@functools.cache
def ppo(config: AlgoConfig) -> PPO:
    """Returns PPO as a run makes it."""
    return PPO.make(config, Sizes(inputs.OBSERVATION, inputs.ACTION), TOTAL)


def learner(config: AlgoConfig) -> LearnerState:
    """Returns a batch of one learner, [1], with the golden weights."""
    state = jax.jit(ppo(config).init)(jax.random.key(0))
    drawn = inputs.draw().layers
    params = {
        network: {
            "torso": {f"hidden_{i}": _layer(layers[i]) for i in range(2)},
            {"actor": "mean", "critic": "value"}[network]: _layer(layers[2]),
        }
        for network, layers in drawn.items()
    }
    log_std = jnp.log(jnp.full(inputs.ACTION, inputs.STD, float))
    params["actor"]["log_std"] = log_std
    params = jax.tree.map(lambda old, new: new.reshape(old.shape), state.params, params)
    state = jax.tree.map(
        lambda x: x.astype(float) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        replace(state, params=params),
    )
    return jax.tree.map(lambda x: x[None], state)


def _layer(drawn: tuple[np.ndarray, np.ndarray]) -> dict[str, jax.Array]:
    return {"kernel": jnp.asarray(drawn[0], float), "bias": jnp.asarray(drawn[1], float)}


def trajectory(state: LearnerState, config: AlgoConfig, idle: int = 0) -> Trajectory:
    """Returns the golden batch as a rollout of one arena, [T, 1, 1].

    Args:
      state: state of the learner, [1], that collects the batch.
      config: configuration of the learner.
      idle: number of steps for which the robot waits after each arrival. These steps lengthen the
        batch, hold NaN and must not affect the update.
    """
    drawn = inputs.draw()
    alone = jax.tree.map(lambda x: x[0], state)
    observation = jnp.asarray(drawn.observation, float)
    # `act` uses the learner's current deviation, which here is the same for the whole batch.
    noise = jnp.asarray(drawn.noise, float)
    action, log_prob, _ = jax.jit(ppo(config).act)(alone, observation, noise)
    terminated, truncated = inputs.ends(inputs.ARRIVALS), inputs.ends(inputs.TIME_OUTS)
    value, _ = jax.jit(ppo(config).value)(alone, observation)
    columns = Trajectory(
        observation=observation,
        action=action,
        log_prob=log_prob,
        value=value,
        next_value=jnp.full_like(value, jnp.nan),  # never read: nothing is bootstrapped
        reward=jnp.asarray(drawn.reward, float),
        terminated=jnp.asarray(terminated),
        truncated=jnp.asarray(truncated),
        valid=jnp.ones(inputs.STEPS, bool),
    )
    if idle:
        columns = jax.tree.map(lambda x: _insert(x, idle), columns)
    return jax.tree.map(lambda x: x[:, None, None], columns)


def _insert(column: jax.Array, idle: int) -> jax.Array:
    """Inserts `idle` steps of False or NaN after each arrival."""
    blank = False if column.dtype == bool else np.nan
    after = np.repeat(np.array(inputs.ARRIVALS) + 1, idle)
    return jnp.asarray(np.insert(np.asarray(column), after, blank, axis=0))


def flat(params: networks.Params) -> np.ndarray:
    """Returns all kernels and biases of one learner, [1, ...], in the order of golden.npz."""
    found = []
    for network, last in (("actor", "mean"), ("critic", "value")):
        torso = params[network]["torso"]
        for layer in (torso["hidden_0"], torso["hidden_1"], params[network][last]):
            found += [np.ravel(layer["kernel"]), np.ravel(layer["bias"])]
    return np.concatenate(found)


@functools.partial(jax.jit, static_argnames="epochs")
def _learn(
    state: LearnerState, batch: Batch, epochs: int
) -> tuple[LearnerState, dict[str, jax.Array]]:
    config = replace(PAPER, epochs=epochs)
    keys = jax.random.split(jax.random.key(0), 1)
    return jax.vmap(ppo(config).update)(state, batch, keys)


def _loss(metrics: dict[str, jax.Array], config: AlgoConfig) -> float:
    """Returns the total loss from the metrics, which are means over the epochs."""
    parts = metrics["policy_loss"] + config.value_cost * metrics["value_loss"]
    return float((parts - config.entropy_cost * metrics["entropy"])[0])


def _apart(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(found - expected).max())


def errors(case: str, idle: int = 0, trained: tuple[int, ...] = (1, 80)) -> dict[str, float]:
    """Returns the error of each compared quantity, after each number of epochs in `trained`."""
    with np.load(Path(__file__).with_name("golden.npz")) as archive:
        golden = {k.partition("/")[2]: archive[k] for k in archive if k.startswith(f"{case}/")}
    config = CONFIGS[case]
    state = learner(config)
    made, steps = ppo(config), inputs.STEPS + (case == "std")
    path = trajectory(state, config, idle)
    batch = jax.jit(made.batch)(path, NO_MEMORY, jnp.zeros(path.valid.shape[:2], bool))
    batch = jax.tree.map(lambda x: x[None], batch)
    state = made.explore(state, steps)
    found = {}
    if "returns" in golden:
        valid = np.asarray(batch.valid[0, 0])
        returns, advantages = (np.asarray(x[0, 0])[valid] for x in (batch.return_, batch.advantage))
        found["returns"] = _apart(returns, golden["returns"])
        found["advantages"] = _apart(advantages[::10], golden["advantages"])
    for epochs in trained:
        learned, metrics = _learn(state, batch, epochs)
        found[f"loss_{epochs}"] = abs(_loss(metrics, config) - golden["losses"][:epochs].mean())
        if f"params_{epochs}" in golden:
            params, expected = flat(learned.params), golden[f"params_{epochs}"]
            apart = np.linalg.norm(params - expected) / np.linalg.norm(expected)
            found[f"params_{epochs}"] = float(apart)
    return found


if __name__ == "__main__":
    waiting = {"idle": 50, "trained": (1,)}
    case = sys.argv[1]
    found = errors("terminal", **waiting) if case == "waiting" else errors(case)
    sys.stdout.write(json.dumps(found))
