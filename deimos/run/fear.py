"""The selector of a run's goals, with what it has learnt, for use after the training."""

from dataclasses import replace

from deimos.checks import RunError, one_line
from deimos.goals.fear_selector import FearSelector, fear_selector
from deimos.goals.selector import GoalSelector
from deimos.run.folder import RunFolder
from deimos.run.loop import spaces
from deimos.run.trainer import TrainConfig
from deimos.run.training import load_checkpoint
from deimos.sim.env import Env

OLDEST_SCHEMA = 2  # of checkpoint.pt; the fear networks of earlier ones have other layers, and are not read


def load_selector(folder: RunFolder, config: TrainConfig, env: Env) -> GoalSelector | None:
    """The selector of a run with all that it has learnt; ``None`` if it has no fear network that has learnt.

    Nor has a run of Deimos 0.1.

    It may be asked to propose, but must not be told what it issued: its state belongs to the worlds of the training.

    Args:
        folder: The run.
        config: Its configuration.
        env: Worlds of its environment, on the device that the networks are to be on.

    Raises:
        RunError: If there is no checkpoint, or it does not fit.
    """
    worlds = replace(spaces(env, config.env_steps), num_envs=config.num_envs)
    selector = config.goals.build(worlds, config.seed)
    afraid = fear_selector(selector)
    if afraid is None:
        return None
    checkpoint = load_checkpoint(folder)
    if checkpoint["schema"] < OLDEST_SCHEMA:
        return None
    state = checkpoint.get("loop", {}).get("selector", {})  # some hold only networks
    try:
        _restore(selector, state)
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        what = f"What the selector of {folder.path} has learnt does not fit it"
        raise RunError(f"{what}: {one_line(error)}") from error
    return selector if learnt_fear(selector) else None


def _restore(selector: GoalSelector, state: dict) -> None:
    """Continue from a state of any version: what it lacks is left as it is."""
    for part, saved in zip(selector.parts, state.get("parts", [state]), strict=False):  # a Mix was saved as its method
        _restore(part, saved)
    own = {name: value for name, value in state.items() if name != "parts"}
    selector.load_state_dict(selector.state_dict() | own)


def learnt_fear(selector: GoalSelector | None) -> FearSelector | None:
    """The part of ``selector`` that has a fear network that has learnt; ``None`` if there is no such part."""
    afraid = None if selector is None else fear_selector(selector)
    return afraid if afraid is not None and afraid.fear.fitted else None


def load_fear(folder: RunFolder, config: TrainConfig, env: Env) -> FearSelector | None:
    """The selector with a run's fear network and its calibration; for the arguments see ``load_selector``."""
    return learnt_fear(load_selector(folder, config, env))
