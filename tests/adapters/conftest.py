"""Small swarms and their courses: reference rollouts that every adapter must reproduce."""

import pytest
from courses import ARENA_SEED, ONE, PAIR, SEED, TASK, Course, drawn_key, follow

import swarmjax
from swarmjax.environment import Swarm


@pytest.fixture(scope="session")
def swarm() -> Swarm:
    """Returns four arenas, alternately of two robots and one: six robots in eight places."""
    return swarmjax.make_env([PAIR, ONE], task=TASK, arenas=4)


@pytest.fixture(scope="session")
def arena() -> Swarm:
    return swarmjax.make_env(PAIR, task=TASK, arenas=1)


@pytest.fixture(scope="session")
def course(swarm: Swarm) -> Course:
    return follow(swarm, drawn_key(SEED))


@pytest.fixture(scope="session")
def arena_course(arena: Swarm) -> Course:
    return follow(arena, drawn_key(ARENA_SEED))
