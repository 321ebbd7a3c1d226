"""Trains s1 with a small PPO in PyTorch until 90 % of targets are reached: python torch_ppo.py.

All robots share the policy. An argument limits the number of updates. Install the extra `torch`.
"""

import sys
import time

import torch  # pyright: ignore[reportMissingImports]  # an extra
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]

import swarmjax
from swarmjax.adapters.torch import SwarmTorchEnv

ARENAS, STEPS, EPOCHS, PARTS = 64, 32, 6, 4
DISCOUNT, TRACE, CLIP, RATE = 0.99, 0.95, 0.2, 1e-3
TARGET = 0.9


class ActorCritic(nn.Module):
    """A Gaussian policy and a value function; running statistics normalise their observations."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(size, affine=False, momentum=None)
        self.actor = nn.Sequential(
            nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 2)
        )
        self.critic = nn.Sequential(
            nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
        )
        self.log_std = nn.Parameter(torch.full((2,), -0.5))

    def forward(self, seen: Tensor) -> tuple[torch.distributions.Distribution, Tensor]:
        """Maps [..., O] to the distribution of actions [..., 2] and the value [...]."""
        seen = self.norm(seen.reshape(-1, seen.shape[-1])).reshape(seen.shape)
        chosen = torch.distributions.Normal(self.actor(seen), self.log_std.exp())
        return torch.distributions.Independent(chosen, 1), self.critic(seen)[..., 0]


@torch.no_grad()
def collect(env: SwarmTorchEnv, model: ActorCritic, seen: Tensor) -> tuple[dict, Tensor]:
    """Steps all robots STEPS times; returns transitions [T, N, ...] and the next observation."""
    rows = []
    for _ in range(STEPS):
        policy, value = model(seen)
        action = policy.sample()
        came = env.step(action)
        row = {"seen": seen, "action": action, "log_prob": policy.log_prob(action), "value": value}
        rows.append(row | came._asdict() | {"next_value": model(came.last)[1]})
        seen = came.observation
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}, seen


def advantages(batch: dict) -> Tensor:
    """Computes generalised advantages [T, N]; time-outs are bootstrapped, arrivals are not."""
    goes_on = ~batch["terminated"]
    delta = batch["reward"] + DISCOUNT * batch["next_value"] * goes_on - batch["value"]
    linked, found, ahead = goes_on & ~batch["over"], torch.zeros_like(delta), 0.0
    for t in reversed(range(STEPS)):
        ahead = delta[t] + DISCOUNT * TRACE * linked[t] * ahead
        found[t] = ahead
    return found


def update(model: ActorCritic, optimizer: torch.optim.Optimizer, batch: dict) -> None:
    """Learns from the robots that had not arrived."""
    gain = advantages(batch)
    learn = batch["valid"]
    flat = {name: batch[name][learn] for name in ("seen", "action", "log_prob")}
    aim, gain = (gain + batch["value"])[learn], gain[learn]
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    for _ in range(EPOCHS):
        for part in torch.randperm(len(gain)).chunk(PARTS):
            policy, value = model(flat["seen"][part])
            ratio = (policy.log_prob(flat["action"][part]) - flat["log_prob"][part]).exp()
            bounded = ratio.clamp(1 - CLIP, 1 + CLIP)
            actor = -torch.min(ratio * gain[part], bounded * gain[part]).mean()
            loss = actor + 0.5 * (value - aim[part]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 0.5)
            optimizer.step()
    model.norm.train()(flat["seen"])  # last, since ratios need the policy that acted
    model.norm.eval()


def train(updates: int) -> tuple[float, int, float]:
    """Trains until at least TARGET of the last 200 robots reached their targets.

    Returns:
      This share, robot steps, and seconds without the first step, which compiles.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)  # with small networks, more threads are slower beside JAX's
    env = SwarmTorchEnv(swarmjax.make_env("s1", arenas=ARENAS))
    seen = env.reset(seed=0)
    model = ActorCritic(seen.shape[1]).eval()
    optimizer = torch.optim.Adam(model.parameters(), RATE)
    env.step(torch.zeros(len(env), 2))
    seen, began, recent, share = env.reset(seed=0), time.perf_counter(), [], 0.0
    steps = 0
    for _ in range(updates):
        batch, seen = collect(env, model, seen)
        steps += STEPS * len(env)
        update(model, optimizer, batch)
        recent = (recent + (~batch["truncated"])[batch["over"]].tolist())[-200:]
        share = sum(recent) / max(len(recent), 1)
        if len(recent) == 200 and share >= TARGET:
            break
    return share, steps, time.perf_counter() - began


if __name__ == "__main__":
    share, steps, seconds = train(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
    print(f"{share:.3f} of the targets after {steps:,} robot steps, {seconds:.1f} s")  # noqa: T201
