"""The effect of a promotion on the learners, as the config defines it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import optax
from jax import Array

from swarmjax.curriculum.engine import BY_BUDGET, BY_THRESHOLD, CurriculumState
from swarmjax.ppo.ppo import LearnerState
from swarmjax.training.program import Program


def carry_over(
    learners: LearnerState, program: Program, before: CurriculumState, after: CurriculumState
) -> LearnerState:
    """Prepares the learners for the stage that begins with a promotion.

    If each robot has a learner and the swarm grows beyond its largest size so far, the new robots
    copy the others' learners in turn: parameters, optimiser and normaliser. Then the optimiser and
    the exploration of all learners are reset or kept, as `config.curriculum` says. Keeping them has
    no cost.

    Args:
      learners: [L].
      program: the compiled program.
      before: state of the curriculum before the update.
      after: and after it. Without a promotion, the learners stay unchanged.

    Returns:
      The learners, [L].
    """
    options, carried = program.config.curriculum, learners
    if program.config.learners > 1:
        carried = _copied(carried, before.met, after.met)
    if options.optimizer == "reset":
        carried = replace(carried, optimizer_state=_forgotten(carried.optimizer_state))
    if options.exploration == "reset":
        carried = program.ppo.explore_anew(carried)
    if carried is learners:
        return learners
    reason = after.chosen.reason
    promoted = (reason == BY_THRESHOLD) | (reason == BY_BUDGET)
    return jax.tree.map(lambda new, old: jnp.where(promoted, new, old), carried, learners)


def _copied(learners: LearnerState, before: Array, after: Array) -> LearnerState:
    """Copies learner i % before to the place of learner i, for before <= i < after."""
    index = jnp.arange(learners.normalizer.count.shape[0])
    new = (index >= before) & (index < after)
    source = jnp.where(new, index % before, index)
    return jax.tree.map(lambda x: x[source], learners)


def _forgotten(state: optax.OptState) -> optax.OptState:
    """Sets Adam's moments, and the count that corrects their bias, to 0.

    The learning rate's schedule has its own count and goes on.
    """

    def is_adam(part: object) -> bool:
        return isinstance(part, optax.ScaleByAdamState)

    def forget(part: optax.OptState) -> optax.OptState:
        return jax.tree.map(jnp.zeros_like, part) if is_adam(part) else part

    return jax.tree.map(forget, state, is_leaf=is_adam)
