"""PyTorch: the robots of all arenas, stepped with tensors that are never copied."""

from typing import Any

import jax

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import RobotStep, line_up
from swarmjax.environment import Swarm, SwarmState

_torch: Any = find("torch", "torch")


class SwarmTorchEnv:
    """Steps with PyTorch's tensors, which are JAX's own memory (DLPack), on a CPU and on a GPU.

        env = SwarmTorchEnv(swarmjax.make_env("s1", arenas=64))
        observation = env.reset(seed=0)  # [N, O]
        came = env.step(policy(observation))  # [N, 2]

    Each robot is a row; all may share a policy. A step returns `RobotStep`: act on `observation`,
    bootstrap from `last` where `truncated`, learn where `valid`. A robot is `terminated` in the
    step in which it arrives; from then on it is not `valid` and its reward is 0, until its arena is
    `over` and starts the next episode by itself. Absent robots are left out.

    JAX takes its arrays for unchangeable: do not write into a tensor that came from here, and not
    into an action before the next step has returned. Actions are read without gradients, and from
    the device on which JAX computes.

    Attributes:
      arena: [N] the arena of each row.
    """

    def __init__(self, swarm: Swarm) -> None:
        self._robots = line_up(swarm)
        self._reset = jax.jit(swarm.reset)
        self._observe, self._step = jax.jit(self._robots.observe), jax.jit(self._robots.step)
        self._state: SwarmState | None = None
        self._closed = False
        self.arena = self._robots.arena

    def __len__(self) -> int:
        return len(self._robots)

    def reset(self, seed: int) -> Any:
        """Starts an episode in every arena.

        Args:
          seed: of the levels, not negative.

        Returns:
          [N, O] a tensor to act on.

        Raises:
          ValueError: it was closed.
        """
        self._check_open()
        state: SwarmState = self._reset(jax.random.key(seed))
        self._state = state
        return to_torch(self._observe(state))

    def step(self, action: Any) -> RobotStep:
        """Makes a control step.

        Args:
          action: [N, U] float32 tensor; what is beyond -1..1 is clipped.

        Returns:
          Tensors.

        Raises:
          ValueError: the action has a wrong shape, or it was closed or never reset.
          TypeError: the action is of a wrong dtype.
        """
        self._check_open()
        if self._state is None:
            raise ValueError("step was called before reset: call reset first.")
        check(action, (len(self), self._robots.action_size))
        self._state, came = self._step(self._state, to_jax(action.float()))
        return RobotStep(*map(to_torch, came))

    def close(self) -> None:
        """Lets go of the state; nothing else may be called afterwards."""
        self._state, self._closed = None, True

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError("The environment was closed: make another one.")


def to_torch(array: jax.Array) -> Any:
    """Shows an array of JAX's to PyTorch, without a copy: do not write into the tensor."""
    return _torch.from_dlpack(array)


def to_jax(tensor: Any) -> jax.Array:
    """Shows a tensor to JAX, without its gradient.

    It is not copied if its memory is in one piece and, on a CPU, begins at a multiple of 64 bytes,
    as that of whole tensors of PyTorch's does.
    """
    return jax.dlpack.from_dlpack(tensor.detach().contiguous())
