"""The settings of PPO."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.config.section import MAX_COUNT, check_options
from swarmjax.extension import Network

# Options that have an effect only with some choices of another key. Values: that key, its choices.
_READ_BY: dict[str, tuple[str, Sequence[str]]] = {
    "gae_lambda": ("advantage", ("gae",)),
    "memory_size": ("memory", ("gru",)),
    "std_decrement": ("exploration", ("scheduled",)),
    "std_interval": ("exploration", ("scheduled",)),
    "std_floor": ("exploration", ("scheduled",)),
}


@dataclass(frozen=True, kw_only=True)
class AlgoConfig(Section):
    """Settings of PPO. Names in quotes are those in Table 1 of the paper (docs/paper.md).

    Some options have an effect only with one choice of another key. Their descriptions name this
    key and choice in brackets.
    """

    name: Literal["ppo", "paper"] = setting(
        "ppo", "preset that the settings are based on", derived=True
    )
    policy: Literal["shared", "independent"] = setting(
        "shared", "shared: one policy for all robots; independent: one policy for each robot"
    )
    network: str | None = setting(
        None, "network of actor and critic: mlp or an extension's; null: the extension's, else mlp"
    )
    hidden_sizes: tuple[int, ...] = setting((64, 64), "widths of the hidden layers", 1, 4096)
    memory: Literal["none", "gru"] = setting(
        "none", "memory of the robots; gru: a gated recurrent unit after the hidden layers"
    )
    memory_size: int = setting(64, "size of the memory of each network [memory=gru]", 1, 1024)
    critic: Literal["observation", "state"] = setting(
        "observation",
        "what the critic sees; observation: the same as the policy; state: also where targets, "
        "robots and walls are, and length and direction of the path to the target",
    )
    activation: Literal["tanh", "relu", "swish"] = setting(
        "tanh", "activation of the hidden layers"
    )
    mean_activation: Literal["linear", "tanh"] = setting(
        "linear",
        "activation of the mean action; tanh: keeps it within the range of the commands",
    )
    initialization: Literal["orthogonal", "uniform"] = setting(
        "orthogonal", "initial weights; uniform: weights and biases up to +-1 / sqrt(inputs)"
    )
    normalize_observations: bool = setting(
        True, "normalise observations by running mean and deviation; clipped to +-10 in any case"
    )
    rollout_length: int = setting(32, "control steps of each arena per update", 1, MAX_COUNT)
    epochs: int = setting(1, "passes over each rollout: 'PPO K epochs'", 1, MAX_COUNT)
    num_minibatches: int = setting(8, "gradient steps per pass; must divide arenas", 1, MAX_COUNT)
    discount: float = setting(
        0.998, "discount per control step: 'discount factor (gamma)'", 0.0, 1.0
    )
    advantage: Literal["gae", "monte_carlo"] = setting(
        "gae",
        "gae: bootstraps, also at the step limit; monte_carlo: critic and advantages use "
        "normalised returns up to the end of the episode or rollout",
    )
    gae_lambda: float = setting(0.95, "GAE's lambda [advantage=gae]", 0.0, 1.0)
    clip_epsilon: float = setting(
        0.2, "largest deviation of the probability ratio from 1: 'PPO epsilon clip'", above=0.0
    )
    actor_learning_rate: float | None = setting(
        None,
        "learning rate of the policy: 'optimizer learning rate actor'; null: 3e-4, and less in a "
        "run of more than 15000 gradient steps, in inverse proportion to their number",
        above=0.0,
        high=1.0,
    )
    critic_learning_rate: float | None = setting(
        None,
        "rate of the critic: 'optimizer learning rate critic'; null: 1e-3, reduced as the actor's",
        above=0.0,
        high=1.0,
    )
    learning_rate_schedule: Literal["constant", "linear"] = setting(
        "linear", "linear: the rates fall to 0 at the end of the budget"
    )
    adam_epsilon: float = setting(1e-5, "added to the root of Adam's second moment", above=0.0)
    max_grad_norm: float | None = setting(
        0.5, "norm at which gradients are clipped; null: no clipping", above=0.0
    )
    value_cost: float = setting(
        0.5, "weight of the value loss, which is half the mean squared error", 0.0
    )
    entropy_cost: float = setting(0.0, "weight of the entropy bonus", 0.0)
    update_backend: Literal["auto", "autodiff"] = setting(
        "auto",
        "how to compute gradients; auto: GPU kernels if they support the GPU and the layers; with "
        "a memory, autodiff without the rollouts of absent robots",
    )
    exploration: Literal["learned", "scheduled"] = setting(
        "learned", "standard deviation of the action: learned, or falling in steps by a schedule"
    )
    initial_std: float = setting(
        0.6, "initial standard deviation: 'starting std of action distribution'", above=0.0
    )
    std_decrement: float = setting(
        0.05,
        "how much the deviation falls at each step of the schedule: 'the decay rate of std of "
        "action distribution' [exploration=scheduled]",
        above=0.0,
    )
    std_interval: int = setting(
        250_000,
        "control steps, summed over all arenas, between two decreases of the deviation: 'decay "
        "frequency of std of action distribution' [exploration=scheduled]",
        1,
        MAX_COUNT,
    )
    std_floor: float = setting(
        0.1,
        "smallest deviation: 'minimum std of action distribution' [exploration=scheduled]",
        above=0.0,
    )

    def _check(self) -> None:
        if not self.hidden_sizes:
            raise ConfigError("hidden_sizes is []: give at least one layer, as in [64,64].")
        check_options(self, _READ_BY)
        if self.exploration == "scheduled" and self.std_floor > self.initial_std:
            raise ConfigError(
                f"std_floor is {show(self.std_floor)}, but initial_std is "
                f"{show(self.initial_std)}: give at most {show(self.initial_std)}."
            )
        plain = self.activation == "tanh" and self.memory == "none"
        if self.mean_activation == "tanh" and not plain:
            raise ConfigError(
                f"mean_activation is tanh, but activation is {self.activation} and memory is "
                f"{self.memory}: give activation=tanh and memory=none, or mean_activation=linear."
            )
        if self.memory != "none" and self.network not in (None, "mlp"):
            raise ConfigError(
                f"network is {show(self.network)}, but memory is {self.memory}, which works only "
                "with network=mlp: give network=mlp or memory=none."
            )


def resolve(config: AlgoConfig, networks: Sequence[Network]) -> str:
    """Returns the name of the network that a config selects.

    Args:
      config: Settings; `network` names a network, or is None.
      networks: Networks of an extension.

    Raises:
      ConfigError: The name is unknown, or the extension has several networks and
        the config names none of them.
    """
    names = [piece.name for piece in networks]
    if config.network is None and len(names) > 1:
        raise ConfigError(
            f"extensions defines the networks {', '.join(names)}: choose one, as in "
            f"algo.network={names[0]}."
        )
    name = config.network or [*names, "mlp"][0]
    if name not in ("mlp", *names):
        raise ConfigError(
            f"algo.network is {show(name)}: give one of {', '.join(['mlp', *names])}, or add "
            "extensions=FILE, the Python file that defines this network."
        )
    return name
