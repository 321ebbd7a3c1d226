"""A refusal is one sentence."""

import pytest

from swarmjax.config import ConfigError


def refusal(function, *arguments) -> str:
    """Return the sentence with which a call is refused, and hold it to being one."""
    with pytest.raises(ConfigError) as caught:
        function(*arguments)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence[-1] in ".?"
    return sentence
