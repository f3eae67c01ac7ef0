"""Return and length of the episodes of training: the curves that other libraries plot."""

import torch

from deimos.learn.rollout import Rollout
from deimos.nn.ranks import sum_over_ranks
from deimos.nn.stateful import Stateful


class Episodes(Stateful):
    """Means over the episodes that end in a rollout, which may have begun in earlier ones.

    Only sums are needed: what a world's ended episodes gave together is what it gave up to the last end. So a rollout
    is summed up at once, after its steps.

    Args:
        num_envs: Number of worlds.
        device: Where their rollouts are.
    """

    saved = unknown = by_world = ("so_far",)

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.so_far = torch.zeros(num_envs, 2, dtype=torch.float64, device=device)
        """Return and length [steps] of the episodes that go on, shape (num_envs, 2); NaN where nobody counted."""

    def load_state_dict(self, state: dict | None) -> None:
        """Continue from ``state_dict()``; with ``None``, of a version that did not count, without these episodes."""
        if state is None:
            self.so_far.fill_(torch.nan)
        else:
            super().load_state_dict(state)

    @torch.no_grad()
    def add(self, rollout: Rollout, crash_penalty: float) -> dict[str, float]:
        """Count a rollout, once, after its last step.

        Args:
            rollout: What happened.
            crash_penalty: What was subtracted from the reward of a step that ended in a crash; returns are without it.

        Returns:
            Columns ``episode/...`` over the episodes that ended in it, on all ranks, NaN where none did: mean
            ``return``, the sum of the rewards; mean ``length`` [steps]; ``timeout_fraction``, the share that was cut
            off without a crash, by the time limit or the edge of the terrain.
        """
        ended = rollout.terminated | rollout.truncated
        number = torch.arange(1, rollout.num_steps + 1, device=ended.device).unsqueeze(1)
        last = (number * ended).amax(0)  # steps up to the last end, shape (num_envs,); 0 where no episode ended
        before = number <= last
        reward = rollout.reward.double() + crash_penalty * rollout.terminated
        timeouts = (rollout.truncated & ~rollout.invalid).sum(0)
        found = torch.stack([(reward * before).sum(0), last, timeouts, ended.sum(0)], dim=1)
        rest = torch.stack([(reward * ~before).sum(0), rollout.num_steps - last], dim=1)
        found[:, :2] += self.so_far
        goes_on = (last == 0).unsqueeze(1)
        sums = sum_over_ranks(found.where(~goes_on & ~self.so_far[:, :1].isnan(), 0.0).sum(0))
        self.so_far.copy_(rest + self.so_far.where(goes_on, 0.0))
        names = ("return", "length", "timeout_fraction")
        return {f"episode/{name}": mean for name, mean in zip(names, (sums[:3] / sums[3]).tolist(), strict=True)}
