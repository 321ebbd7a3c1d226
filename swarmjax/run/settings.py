"""What a run was trained with, as its directory tells."""

import json
from pathlib import Path

from swarmjax.config import ConfigError


def read_config(run: Path) -> dict:
    """Reads the config that a run directory was trained with.

    Args:
      run: the directory.

    Returns:
      The config as plain data, unchecked.

    Raises:
      ConfigError: if there is none, or it is no JSON object.
    """
    path = run / "config.json"
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"{run} is no run directory: it has no config.json.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{path} is no run's config: it holds no JSON object.")
    return found
