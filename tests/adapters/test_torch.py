"""Tests that PyTorch tensors share JAX's memory and that the environment acts as in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from courses import ARENAS, SEED, Course, assert_close, robots

from swarmjax.environment import Swarm

pytestmark = pytest.mark.torch
torch = pytest.importorskip("torch")
adapter = pytest.importorskip("swarmjax.adapters.torch", exc_type=ImportError)


@pytest.fixture(scope="module")
def env(swarm: Swarm):
    return adapter.SwarmTorchEnv(swarm)


def test_it_follows_the_course(env, course: Course) -> None:
    # The course starts from the key that the NumPy adapters derive from the seed.
    seen = env.reset(int(np.random.default_rng(SEED).integers(2**31)))
    assert_close(seen.numpy(), robots(course.seen[0]))
    for t, action in enumerate(course.action):
        came = env.step(torch.from_numpy(robots(action)))
        then = jax.tree.map(lambda x: x[t], course.came)  # noqa: B023
        assert_close(came.observation.numpy(), robots(course.after[t]))
        assert_close(came.last.numpy(), robots(then.observation))
        assert_close(came.reward.numpy(), robots(then.reward))
        for name in ("terminated", "truncated", "valid"):
            found = getattr(came, name)
            assert found.dtype is torch.bool
            np.testing.assert_array_equal(found.numpy(), robots(getattr(then, name)))
        np.testing.assert_array_equal(came.over.numpy(), then.done[ARENAS])
        success = then.done[ARENAS] & ~robots(then.truncated)
        np.testing.assert_array_equal(came.is_success.numpy(), success)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bool_])
def test_a_tensor_is_the_array_on_a_cpu(dtype) -> None:
    array = jnp.ones((6, 10), dtype)
    assert adapter.to_torch(array).data_ptr() == array.unsafe_buffer_pointer()


@pytest.mark.parametrize("requires_grad", [False, True])
def test_an_array_is_the_tensor_on_a_cpu(requires_grad: bool) -> None:
    tensor = torch.ones(6, 2, requires_grad=requires_grad)
    assert adapter.to_jax(tensor).unsafe_buffer_pointer() == tensor.data_ptr()


def test_both_are_one_on_a_gpu() -> None:
    if not torch.cuda.is_available() or jax.default_backend() != "gpu":
        pytest.skip("needs a GPU that PyTorch and JAX both see")
    array, tensor = jnp.ones((6, 10)), torch.ones(6, 2, device="cuda")
    assert adapter.to_torch(array).data_ptr() == array.unsafe_buffer_pointer()
    assert adapter.to_jax(tensor).unsafe_buffer_pointer() == tensor.data_ptr()


def test_steps_hand_over_the_memory_itself(env, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = []
    original = adapter.to_torch
    monkeypatch.setattr(adapter, "to_torch", lambda x: (arrays.append(x), original(x))[1])
    env.reset(0)
    came = env.step(torch.zeros(6, 2))
    pointers = [array.unsafe_buffer_pointer() for array in arrays[1:]]
    assert [tensor.data_ptr() for tensor in came] == pointers


def test_seeds_reproduce(env) -> None:
    first = env.reset(3)
    assert torch.equal(env.reset(3), first)
    assert not torch.equal(env.reset(4), first)


def test_bad_use_is_refused(swarm: Swarm) -> None:
    made = adapter.SwarmTorchEnv(swarm)
    with pytest.raises(ValueError, match=r"^step was called before reset"):
        made.step(torch.zeros(6, 2))
    made.reset(0)
    with pytest.raises(ValueError, match=r"^action has the shape \(5, 2\): give \(6, 2\)"):
        made.step(torch.zeros(5, 2))
    with pytest.raises(ValueError, match=r"^action is of dtype torch\.int64: give float32"):
        made.step(torch.zeros(6, 2, dtype=torch.int64))
    made.close()
    with pytest.raises(ValueError, match=r"^step was called before reset"):
        made.step(torch.zeros(6, 2))
