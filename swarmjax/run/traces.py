"""Keeps traced programs between runs, so that a second start need not trace them again.

JAX finds a compiled program in its cache (`compile_cache`) by the traced and lowered program, so a
start must trace even if the cache holds the compiled program. Therefore the lowered program is kept
in the same directory, under a digest of all that a trace depends on: the files of this package,
versions, device, JAX's options, settings, world and earlier calls of Warp. XLA then compiles the
kept program, or loads the compiled program from its cache.
"""

import contextlib
import functools
import hashlib
import pickle
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
from jax import export

from swarmjax import provenance
from swarmjax.config import to_dict
from swarmjax.outputs import replacing
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch
from swarmjax.training.rollout import Program

# Only the versions that made a trace use it, so its custom calls need not be stable.
_ANY_CALL = [export.DisabledSafetyCheck.custom_call("ALL")]
# Settings on which no trace depends. The seed is an argument of `mesh.init`.
_NOT_TRACED = ("run", "resume", "init_from", "seed")


def keep(
    program: Program[TrainConfig],
    name: str,
    jitted: Any,
    given: tuple,
    donated: tuple[int, ...] = (),
) -> Any:
    """Returns a jitted function from its kept trace, or traces it now and keeps the trace.

    Args:
      program: the run's program, whose settings and world the function closes over.
      name: what the function does, for the name of the trace's file.
      jitted: the function.
      given: its arguments, or their shapes.
      donated: indices of the arguments that the function donates.

    Returns:
      A function of the same arguments, to call or to lower.
    """
    folder = jax.config.jax_compilation_cache_dir
    if not folder or not jax.config.jax_enable_compilation_cache or not _can_keep(program):
        return jitted
    shapes = [(each.shape, each.dtype) for each in jax.tree.leaves(given)]
    fast = dispatch.load_fast("arenas_warp", program.world.physics.engine.impl)
    before = [] if fast is None else list(fast.CALLS)  # the next trace adds to these
    # Pickled call by call, because `pickle` writes what calls share only once, and a call that was
    # repeated shares other things than a call that was traced.
    calls = [pickle.dumps(solve) + repr(given).encode() for solve, given in before]
    key = hashlib.sha256(b"".join([f"{_digest(program)} {shapes}".encode(), *calls]))
    path = Path(folder) / f"{name}-{key.hexdigest()}.trace"
    try:
        traced, calls = pickle.loads(zlib.decompress(path.read_bytes()))
    except Exception:  # missing, or damaged in any way
        trace = export.export(jitted, disabled_checks=_ANY_CALL)
        traced = replace(trace(*given), _get_vjp=None)  # `pickle` refuses this closure
        calls = [] if fast is None else fast.CALLS[len(before) :]
        with contextlib.suppress(OSError), replacing(path) as file:
            file.write_bytes(zlib.compress(pickle.dumps((traced, calls))))
    else:
        if fast is not None:
            fast.repeat(calls)
    return jax.jit(traced.call, donate_argnums=donated)


def _can_keep(program: Program[TrainConfig]) -> bool:
    """Returns whether the key covers all of the trace, and a call needs only the trace."""
    config, engine = program.config, program.world.physics.engine
    # Tracing also registers Warp's kernels. Only those for planar robots can be registered again.
    # An extension may import any file, and the key does not cover these files.
    again = engine.impl == "jax" or (engine.solver, config.robot.body) == ("swarm", "planar")
    return again and config.devices == 1 and config.extensions is None


@functools.lru_cache(1)  # tracing fills the world's caches, which changes its bytes
def _digest(program: Program[TrainConfig]) -> str:
    """Returns a hexadecimal digest of all that a trace depends on except for its arguments."""
    config = {k: v for k, v in to_dict(program.config).items() if k not in _NOT_TRACED}
    machine = provenance.versions(), provenance.device(), jax.config.values
    made = repr((config, program.rows, program.by_robot, machine)).encode()
    found = hashlib.sha256(made + pickle.dumps(program.world))
    for path in sorted(Path(provenance.__file__).parent.rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()
