"""Makes golden.npz by running PPO-PyTorch itself, none of whose code is in this repository.

    python tests/paper/make_golden.py FOLDER

The program needs PyTorch (2.13.0 was used) and NumPy. FOLDER holds `PPO.py` of
https://github.com/nikhilbarhate99/PPO-PyTorch at commit 728cce8.

It makes two updates from the same weights. `std` is like `terminal`, but the deviation falls from
0.6 to 0.55 between the batch and the update. All numbers are float64. PPO.py asks for float32 by
name, so `torch.float32` is redefined as float64.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import golden_inputs as inputs
import numpy as np
import torch  # pyright: ignore[reportMissingImports]  # no dependency: for this recipe alone

CASES = {"terminal": inputs.STD, "std": 0.55}
EPOCHS = 80


def main(folder: Path) -> None:
    """Writes golden.npz beside this file."""
    torch.set_default_dtype(torch.float64)
    torch.float32 = torch.float64
    theirs, found = _load(folder), {}
    for case in CASES:
        found |= {f"{case}/{name}": array for name, array in _update(theirs, case).items()}
    # These arrays are left out for a smaller file; the losses of all epochs test the same update.
    for name in [name for name in found if name.startswith("std/")]:
        if name != "std/losses":
            del found[name]
    np.savez_compressed(Path(__file__).with_name("golden.npz"), **found)


def _load(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("PPO", folder / "PPO.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _update(theirs: ModuleType, case: str) -> dict[str, np.ndarray]:
    """Runs PPO-PyTorch's update, and records its returns, advantages, losses and weights."""
    std = CASES[case]
    drawn = inputs.draw()
    agent = theirs.PPO(10, 2, 3e-4, 1e-3, 0.99, EPOCHS, 0.2, True, inputs.STD)
    for policy in (agent.policy, agent.policy_old):
        _set_weights(policy, drawn.layers)
    _fill(agent, drawn)
    agent.set_action_std(std)
    values = np.array([float(value) for value in agent.buffer.state_values])
    noted: dict[str, Any] = {"losses": []}
    mse, step = agent.MseLoss, agent.optimizer.step

    def note_targets(value: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        noted["returns"] = target.numpy().copy()
        return mse(value, target)

    def note_step() -> None:
        step()
        if len(noted["losses"]) == 1:
            noted["params_1"] = _weights(agent.policy)

    backward = torch.Tensor.backward

    def note_loss(loss: torch.Tensor) -> None:
        noted["losses"].append(loss.item())
        backward(loss)

    agent.MseLoss, agent.optimizer.step = note_targets, note_step
    torch.Tensor.backward = note_loss
    try:
        agent.update()
    finally:
        torch.Tensor.backward = backward
    noted["advantages"] = (noted["returns"] - values)[::10]  # the returns determine the rest
    noted["params_80"] = _weights(agent.policy)
    return {name: np.asarray(array, np.float64) for name, array in noted.items()}


def _fill(agent: Any, drawn: inputs.Inputs) -> None:
    """Fills PPO-PyTorch's buffer with the batch, as its `select_action` and `train.py` do."""
    done = inputs.ends(inputs.ARRIVALS) | inputs.ends(inputs.TIME_OUTS)
    buffer = agent.buffer
    for seen, noise, reward, end in zip(
        drawn.observation, drawn.noise, drawn.reward, done, strict=True
    ):
        state = torch.tensor(seen)
        with torch.no_grad():
            mean = agent.policy_old.actor(state)
            action = (mean + inputs.STD * torch.tensor(noise)).unsqueeze(0)
            log_prob, value, _ = agent.policy_old.evaluate(state.unsqueeze(0), action)
        buffer.states.append(state)
        buffer.actions.append(action)
        buffer.logprobs.append(log_prob)
        buffer.state_values.append(value[0])
        buffer.rewards.append(float(reward))
        buffer.is_terminals.append(bool(end))


def _linear(policy: Any, network: str) -> list[Any]:
    return [layer for layer in getattr(policy, network) if isinstance(layer, torch.nn.Linear)]


def _set_weights(policy: Any, layers: dict[str, list[tuple[np.ndarray, np.ndarray]]]) -> None:
    with torch.no_grad():
        for network, drawn in layers.items():
            for layer, (kernel, bias) in zip(_linear(policy, network), drawn, strict=True):
                layer.weight.copy_(torch.tensor(kernel.T))
                layer.bias.copy_(torch.tensor(bias))


def _weights(policy: Any) -> np.ndarray:
    """Returns kernels [in, out] and biases of actor and critic, layer by layer, as one vector."""
    flat = []
    for network in ("actor", "critic"):
        for layer in _linear(policy, network):
            flat += [layer.weight.detach().numpy().T.ravel(), layer.bias.detach().numpy()]
    return np.concatenate(flat)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
