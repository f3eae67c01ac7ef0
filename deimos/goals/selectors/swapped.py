"""The Director's goals in wrong states: is it the goals that teach, or that they fit the state?

Source: a control that readers of the thesis ask for. Hypothesis: if this is as good as the Director, the network's
knowledge of the state is worth nothing.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from deimos.goals import picks
from deimos.goals.interactions import Interactions
from deimos.goals.selector import Spaces, Transitions
from deimos.goals.selectors import director
from deimos.nn import ranks


@dataclass(frozen=True, kw_only=True)
class Config(director.Config):
    """A Director that ranks a world's candidates as they would be ranked in another world's state."""

    percentile: float = 75.0
    """p, in [0, 100]: the share of candidates that is discarded as too easy [%]."""

    def build(self, spaces: Spaces, seed: int) -> "Swapped":
        """See ``SelectorConfig.build``."""
        return Swapped(self, spaces, seed)


class Swapped(director.Director):
    """See ``Config``. The other state is from one of the last decisions, of which as many count as there are worlds.

    So a goal is as likely as under the Director, whatever the state that it is issued in. Candidates stay the world's
    own, since what is valid may depend on the state.
    """

    saved = (*director.Director.saved, "_state", "_goal", "_count")

    def __init__(self, config: Config, spaces: Spaces, seed: int) -> None:
        super().__init__(config, spaces, seed)
        worlds, sizes = spaces.num_envs * ranks.place().size, (spaces.state_dim, spaces.goal_dim)
        self._state, self._goal = (
            torch.zeros(worlds, size, dtype=torch.float32, device=spaces.device) for size in sizes
        )
        self._count = torch.zeros((), dtype=torch.int64, device=spaces.device)  # decisions seen so far

    def ranking(self, state: Tensor, goal: Tensor, candidates: Tensor, score: Tensor, draws: Tensor) -> Tensor:
        """See ``FearSelector.ranking``."""
        other = picks.uniformly(draws[:, 3], self._count.clamp(max=len(self._state)))
        swapped = self.score(self._state[other], self._goal[other], candidates)
        return super().ranking(state, goal, candidates, swapped, draws)

    def learn(self, interactions: Interactions, rollout: Transitions | None) -> dict[str, float]:
        """See ``FearSelector.learn``."""
        _, state, goal, _ = interactions.issued(self._learnt_at)
        size = len(self._state)
        place = (self._count + torch.arange(len(state), device=state.device)[-size:]) % size
        self._state[place], self._goal[place] = state[-size:].float(), goal[-size:].float()
        self._count += len(state)
        return super().learn(interactions, rollout)
