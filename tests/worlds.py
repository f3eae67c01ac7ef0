"""What tests of any environment need of its worlds: a loop, rows and masks, and all that a step leaves behind."""

import torch

from deimos.goals.selectors import uniform
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.env import Step


def build_loop(env, candidates=3):
    """A loop with uniform goals, each picked from a few candidates."""
    return GoalLoop(env, uniform.Config(candidates=candidates).build(spaces(env), seed=0))


def rows_of(env, *rows):
    """Rows as an environment takes them; all of them if none is given."""
    return torch.tensor(rows or range(env.num_envs), dtype=torch.int64, device=env.device)


def mask_of(env, *worlds):
    """A mask of the listed worlds; of all of them if none is given."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    mask[rows_of(env, *worlds)] = True
    return mask


def step_tensors(step):
    """The tensors of a step by name; without the shares of a reward in an environment that has none."""
    return {name: tensor for name in Step.__dataclass_fields__ if (tensor := getattr(step, name)) is not None}


def played(env, loop, action, steps):
    """Copies, after each of some steps, of all that a resume needs and of all that the step gave back."""
    found = []
    for _ in range(steps):
        step = env.step(action)
        loop.advance(step)
        found.append(env.state_dict() | {name: tensor.clone() for name, tensor in step_tensors(step).items()})
    return found
