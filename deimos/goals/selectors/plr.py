"""Prioritized level replay over goals (Jiang et al. 2021, arXiv:2010.03934; robust: arXiv:2110.02439).

A level is a goal; the state that it was issued in cannot be restored, so it is left out: compared with the
Director, this tests whether it matters. A level's score is its positive value loss, the mean over the
interaction of max(advantage, 0).
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from deimos.checks import check_at_least, check_positive, check_range
from deimos.goals import picks
from deimos.goals.interactions import Interactions, Resolved
from deimos.goals.selector import GoalSelector, Proposal, SelectorConfig, Spaces, Transitions
from deimos.nn.ranks import gather_rows, own_rows


@dataclass(frozen=True, kw_only=True)
class Config(SelectorConfig):
    """Replays goals whose values the critic underestimated; the others are uniform."""

    replay: float = 0.8
    """Share of decisions that replay a level, in [0, 1], once the buffer holds enough."""
    robust: bool = False
    """Whether the learner takes gradients only on replayed goals, and on first goals, which no selector chooses."""
    capacity: int = 4000
    """Levels in the buffer, at least 1."""
    fill: float = 0.5
    """Share of the capacity that must be filled before anything is replayed, in (0, 1]."""
    staleness: float = 0.3
    """Weight of how long ago a level was seen, in [0, 1]."""
    temperature: float = 0.3
    """Levels are replayed in proportion to rank^(-1 / temperature), positive."""
    candidates: int = 100
    """N: a replayed level is the nearest of N uniform candidates, so that it is valid here; at least 1."""

    def __post_init__(self) -> None:
        for name in ("replay", "staleness"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        if not 0.0 < self.fill <= 1.0:
            raise ValueError(f"fill must be in (0, 1], got {self.fill}.")
        check_positive("temperature", self.temperature, finite=True)
        check_at_least("capacity", self.capacity, 1)
        check_at_least("candidates", self.candidates, 1)
        if self.capacity >= 2**24:
            raise ValueError(f"capacity must be below 2^24, got {self.capacity}.")

    def build(self, spaces: Spaces, seed: int) -> "PLR":
        """See ``SelectorConfig.build``."""
        return PLR(self, spaces)


class PLR(GoalSelector):
    """See ``Config``."""

    needs_rollout = True
    dense = True
    saved = ("_level", "_score", "_made", "_seen", "_upto", "_carry", "_learnt_at", "replaying")
    by_world = ("_carry",)

    def __init__(self, config: Config, spaces: Spaces) -> None:
        self.config = config
        self.num_candidates = config.candidates
        device = spaces.device
        zeros = partial(torch.zeros, dtype=torch.float32, device=device)
        self._level = zeros(config.capacity, spaces.goal_dim)
        self._score = zeros(config.capacity).fill_(-torch.inf)  # -inf marks a free place
        self._made, self._seen = torch.zeros(2, config.capacity, dtype=torch.int64, device=device)  # steps
        self._upto = zeros(config.capacity)  # cumulative chance of being replayed
        self._carry = zeros(spaces.num_envs)  # of the pending interaction, up to the last rollout
        self._learnt_at = 0  # step of the last call of learn
        self.replaying = False
        """Whether the buffer holds enough."""

    def graph_key(self) -> Hashable:
        """See ``GoalSelector.graph_key``."""
        return (self.replaying,)

    def propose(self, rows: Tensor, state: Tensor, goal: Tensor, candidates: Tensor, draws: Tensor) -> Proposal:
        """See ``GoalSelector.propose``; scores are those of the replayed levels."""
        pick = picks.uniformly(draws[:, 0], candidates.shape[1])
        replayed = torch.zeros_like(pick, dtype=torch.bool)
        place = torch.zeros_like(pick)
        score = torch.full_like(draws[:, 0], torch.nan)
        if self.replaying:
            replayed = draws[:, 1] < self.config.replay
            place = torch.searchsorted(self._upto, draws[:, 2] * self._upto[-1], right=True)
            # Rounding may put the number beyond the last level.
            place = torch.minimum(place, (self._upto < self._upto[-1]).sum())
            distance = (candidates - self._level[place].unsqueeze(1)).square().sum(2)
            pick = torch.where(replayed, distance.argmin(1), pick)
            score = torch.where(replayed, self._score[place], score)
        weight = replayed.float() if self.config.robust else None
        note = (place + 1) * replayed
        return Proposal(picks.take(candidates, pick), score, weight, probe=~replayed, note=note)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """Score what has resolved, refresh the levels that were replayed, and keep the best new ones."""
        if rollout is None:
            raise ValueError("plr scores goals by advantages, so it needs the learner's rollout, got None.")
        done = interactions.resolved(self._learnt_at)
        loss = self._positive_value_loss(interactions, done, rollout)
        self._learnt_at = interactions.now
        self._refresh(done, loss)
        self._insert(done.where(done.probe), loss[done.probe], interactions.now)
        self._weigh(interactions.now)
        return {
            "plr/value_loss": loss.mean().item(),
            "plr/filled": (self._score > -torch.inf).float().mean().item(),
            "plr/replayed": (~done.probe).float().mean().item(),
        }

    def must_be_sound(self) -> Mapping[str, Any]:
        """See ``Stateful``; free places have no score."""
        return {**super().must_be_sound(), "score": self._score[self._score > -torch.inf]}

    def _positive_value_loss(self, interactions: Interactions, done: Resolved, rollout: Transitions) -> Tensor:
        """Mean of max(advantage, 0) over every resolved interaction, shape (n,); interactions span rollouts."""
        begin = interactions.now - rollout.num_steps
        advantage, carry = gather_rows(rollout.advantage, dim=1), gather_rows(self._carry)
        upto = torch.nn.functional.pad(advantage.clamp(min=0).cumsum(0), (0, 0, 1, 0))

        def gained(env: Tensor, first: Tensor, last: Tensor) -> Tensor:
            before = carry[env] * (first < begin)
            return before + upto[last - begin, env] - upto[(first - begin).clamp(min=0), env]

        loss = gained(done.env, done.issued, done.resolved) / (done.resolved - done.issued)
        every = torch.arange(len(carry), device=loss.device)
        issued = interactions.issued_at
        pending = gained(every, issued, torch.full_like(issued, interactions.now))
        self._carry = own_rows(torch.where(interactions.active, pending, 0.0))
        return loss

    def _refresh(self, done: Resolved, loss: Tensor) -> None:
        """Write the new scores of replayed levels, unless another level has taken their place meanwhile.

        Many worlds replay the same level at once: its score is the mean over them.
        """
        place = (done.note - 1).clamp(min=0)
        # What was issued on the step of an update was issued before it, from the previous levels.
        valid = (done.note > 0) & (self._made[place] < done.issued)
        place = place[valid]
        self._score.scatter_reduce_(0, place, loss[valid], "mean", include_self=False)
        self._seen.scatter_reduce_(0, place, done.resolved[valid], "amax")

    def _insert(self, new: Resolved, loss: Tensor, now: int) -> None:
        """Let the best new levels take the places of the worst old ones."""
        count = min(len(new), self.config.capacity)
        best = loss.topk(count)
        worst = self._score.topk(count, largest=False)
        better = best.values > worst.values
        place, source = worst.indices[better], best.indices[better]
        self._level[place], self._score[place] = new.next_goal[source], loss[source]
        self._made[place] = self._seen[place] = now

    def _weigh(self, now: int) -> None:
        """Accumulate the chances of being replayed: by rank of the score and by staleness."""
        filled = self._score > -torch.inf
        self.replaying = int(filled.sum()) >= self.config.fill * self.config.capacity
        rank = self._score.argsort(descending=True, stable=True).argsort() + 1
        by_score = rank.double().pow(-1.0 / self.config.temperature) * filled
        by_age = (now - self._seen).double() * filled
        mix = self.config.staleness if float(by_age.sum()) > 0 else 0.0
        weight = (1 - mix) * by_score / by_score.sum().clamp(min=1e-300)
        weight += mix * by_age / by_age.sum().clamp(min=1.0)
        self._upto.copy_(weight.cumsum(0))
