"""A trained policy in one file: weights, normaliser statistics, observation scaling and layout."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor, nn

from deimos.checks import RunError
from deimos.files import load_tensors, save_tensors
from deimos.nn.host import own_settings
from deimos.nn.layout import ObsField, goal_slice, seen_by
from deimos.nn.networks import Activation, Actor, weights_of

SCHEMA = 1


class Policy(nn.Module):
    """Maps physical observations to the trained policy's deterministic (mean) actions.

    Attributes:
        layout: Fields of the observation, with units.
        goal_slice: Components of the observation that hold the goal.
        dt: Duration of a step [s]; 1 where the environment has no seconds.
    """

    scale: Tensor

    def __init__(
        self, actor: Actor, hidden: Sequence[int], activation: Activation,
        layout: Sequence[ObsField], action_bound: float, dt: float,
    ) -> None:  # fmt: skip
        super().__init__()
        self.actor = actor
        self.hidden = tuple(hidden)
        self.activation = activation
        self.layout = tuple(layout)
        self.action_bound = action_bound
        self.dt = dt
        device = actor.std.device
        scale = [torch.as_tensor(f.scale, dtype=torch.float32, device=device).expand(f.size) for f in layout]
        self.register_buffer("scale", torch.cat(scale))
        self.goal_slice = goal_slice(self.layout)

    @torch.no_grad()
    def forward(self, obs: Tensor) -> Tensor:
        """Actions, float32, shape (n, action_dim), for observations in physical units, shape (n, obs_dim)."""
        return self.scaled(obs.float() * self.scale)

    @own_settings()
    @torch.no_grad()
    def scaled(self, obs: Tensor) -> Tensor:
        """Actions for observations as the environment gives them, already scaled."""
        return self.actor(obs.float()).clamp(-self.action_bound, self.action_bound)


def save_policy(path: Path, policy: Policy) -> None:
    """Write a policy that needs nothing else to run.

    Raises:
        RunError: If it cannot be written; the previous file is untouched.
    """
    save_tensors(path, {
        "schema": SCHEMA,
        "actor": weights_of(policy.actor),
        "hidden": list(policy.hidden),
        "activation": policy.activation,
        "layout": [asdict(field) for field in policy.layout],
        "action_bound": policy.action_bound,
        "dt": policy.dt,
    })  # fmt: skip


@own_settings()
def load_policy(path: Path | str, device: str = "cpu") -> Policy:
    """Read a policy.

    Args:
        path: A ``policy.pt``, or the run folder that holds one.
        device: Torch device that it runs on.

    Raises:
        RunError: If there is no policy.
        RuntimeError, AssertionError: If there is no such device; the message is torch's.
    """
    torch.empty(0, dtype=torch.float32, device=device)  # raises here: below it would look like a fault of the file
    path = Path(path)
    path = path / "policy.pt" if path.is_dir() else path
    data = load_tensors(path, "policy", SCHEMA)
    try:
        layout = [ObsField(**field) for field in data["layout"]]
        weights = data["actor"]
        sizes = sum(field.size for field in layout), data["hidden"], len(weights["std"])
        seen = seen_by("actor", layout, torch.device(device))
        normalize = any(name.startswith("normalizer.") for name in weights)
        actor = Actor(*sizes, data["activation"], init_std=1.0, seen=seen, normalize=normalize)
        actor.load_state_dict(weights)
        actor.to(device)
        return Policy(actor, data["hidden"], data["activation"], layout, data["action_bound"], data["dt"])
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise RunError(f"{path} is not a policy of this version: {error}.") from error
