"""PyTorch: steps the robots of all arenas with tensors, without copying them."""

from typing import Any

import jax

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import RobotStep, line_up
from swarmjax.environment import Swarm, SwarmState

_torch: Any = find("torch", "torch")


class SwarmTorchEnv:
    """Steps with PyTorch tensors that share JAX's memory (DLPack), on a CPU or a GPU.

        env = SwarmTorchEnv(swarmjax.make_env("s1", arenas=64))
        observation = env.reset(seed=0)  # [N, O]
        came = env.step(policy(observation))  # [N, 2]

    Each row of a tensor belongs to one robot. All robots may share one policy. A step returns a
    `RobotStep`: act on `observation`, bootstrap from `last` where `truncated` is True, and learn
    where `valid` is True. A robot is `terminated` in the step in which it arrives. In the following
    steps it is not `valid` and its reward is 0, until its arena is `over` and starts the next
    episode automatically. In the step where the arena is `over`, `is_success` says which robots had
    arrived. Absent robots have no row.

    JAX assumes that its arrays never change. So do not write into a tensor that this class has
    returned. Do not write into an action before the step that takes it has returned.
    Actions must lie on the device on which JAX computes. Gradients of actions are ignored.

    Attributes:
      arena: [N] the arena of each row.
    """

    def __init__(self, swarm: Swarm) -> None:
        self._robots = line_up(swarm)
        self._reset = jax.jit(swarm.reset)
        self._observe, self._step = jax.jit(self._robots.observe), jax.jit(self._robots.step)
        self._state: SwarmState | None = None
        self.arena = self._robots.arena

    def __len__(self) -> int:
        return len(self._robots)

    def reset(self, seed: int) -> Any:
        """Starts an episode in every arena.

        Args:
          seed: seed of the levels, 0 or more.

        Returns:
          [N, O] tensor of observations to act on.
        """
        state: SwarmState = self._reset(jax.random.key(seed))
        self._state = state
        return to_torch(self._observe(state))

    def step(self, action: Any) -> RobotStep:
        """Makes a control step.

        Args:
          action: [N, U] float32 tensor, clipped to -1..1.

        Returns:
          The outcome, as tensors.

        Raises:
          ValueError: if the action has a wrong shape or dtype, or the environment was never reset.
        """
        if self._state is None:
            raise ValueError("step was called before reset: call reset first.")
        check(action, (len(self), self._robots.action_size))
        self._state, came = self._step(self._state, to_jax(action.float()))
        return RobotStep(*map(to_torch, came))

    def close(self) -> None:
        """Releases the state."""
        self._state = None


def to_torch(array: jax.Array) -> Any:
    """Gives PyTorch a JAX array without copying it. Do not write into the tensor."""
    return _torch.from_dlpack(array)


def to_jax(tensor: Any) -> jax.Array:
    """Gives JAX a tensor without its gradient.

    The tensor is not copied if its memory is contiguous. On a CPU the memory must also begin at a
    multiple of 64 bytes, as it does in whole PyTorch tensors.
    """
    return jax.dlpack.from_dlpack(tensor.detach().contiguous())
