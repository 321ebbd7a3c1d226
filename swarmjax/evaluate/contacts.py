"""The contacts of robots, as MuJoCo's C engine finds and solves them."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from swarmjax.evaluate.judge import Judge
from swarmjax.sim import gaps


class Pushes(NamedTuple):
    """The N pushing contacts of an arena in a physics step.

    Their geoms are [N, 2], and their normal forces [N] are in newtons.
    """

    geom: np.ndarray
    force: np.ndarray


def push(model: mujoco.MjModel, data: mujoco.MjData) -> Pushes:
    """Reads the normal forces of all contacts from the solver's rows.

    A contact without friction has one row, its normal force. With an elliptic cone the first row is
    the normal force. With a pyramid, all edges push along the normal, and the sum of their forces
    is the normal force.

    Args:
      model: Model of the arena.
      data: The arena, between the two halves of a physics step.
    """
    contact = data.contact
    # MuJoCo lists a contact at a distance of exactly 0, but does not solve for it.
    solved = contact.efc_address >= 0
    address, edges = contact.efc_address[solved], 2 * (contact.dim[solved] - 1)
    if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
        edges = np.zeros_like(edges)
    force = data.efc_force[address]
    for k in range(1, np.max(edges, initial=0)):
        more = edges > k
        force[more] += data.efc_force[address[more] + k]
    return Pushes(contact.geom[solved], force)


def impulses(judge: Judge, pushes: Sequence[Pushes], arenas: int) -> np.ndarray:
    """Sums the impulses of contacts.

    Args:
      judge: Data that the arenas share.
      pushes: [A * substeps], grouped by arena.
      arenas: A.

    Returns:
      [A, R, 3] N s, in the order of `gaps.KINDS`; when two robots touch each other, the impulse
      counts for both.
    """
    shape = (arenas, judge.spacing.robots, len(gaps.KINDS))
    force, total = np.concatenate([each.force for each in pushes]), np.zeros(math.prod(shape))
    arena = np.arange(len(pushes)) // judge.substeps
    for rows, where in _meetings(judge, [each.geom for each in pushes], arena):
        flat = np.ravel_multi_index(where, shape)
        total += np.bincount(flat, weights=force[rows], minlength=len(total))
    return total.reshape(shape) * judge.model.opt.timestep


def touching(judge: Judge, data: np.ndarray) -> np.ndarray:
    """Tells which robots touch anything.

    Args:
      judge: Data that the arenas share.
      data: [A] of `MjData`, positions up to date.

    Returns:
      [A, R, 3] bool, in the order of `gaps.KINDS`.
    """
    touches = np.zeros((len(data), judge.spacing.robots, len(gaps.KINDS)), bool)
    geoms = [each.contact.geom for each in data]
    for _, where in _meetings(judge, geoms, np.arange(len(data))):
        touches[where] = True
    return touches


def _meetings(
    judge: Judge, geoms: Sequence[np.ndarray], arena: np.ndarray
) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Finds the hulls among the geoms [N, 2] of each list of contacts.

    Yields:
      For each side of a contact, the rows of contacts in which it is a hull, and their arena,
      robot and kind.
    """
    of = np.repeat(arena, [len(each) for each in geoms])
    first, second = np.concatenate(geoms).T
    for mine, other in ((first, second), (second, first)):
        rows = np.flatnonzero(judge.geom_robot[mine] >= 0)
        yield rows, (of[rows], judge.geom_robot[mine[rows]], judge.geom_kind[other[rows]])
