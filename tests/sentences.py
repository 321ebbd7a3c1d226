"""Checks that a refusal is one sentence."""

import pytest

from swarmjax.config import ConfigError


def refusal(function, *arguments) -> str:
    """Returns the message with which a call is refused, and checks that it is one sentence."""
    with pytest.raises(ConfigError) as caught:
        function(*arguments)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence[-1] in ".?"
    return sentence
