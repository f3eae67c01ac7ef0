"""The fear network that a run has learnt, for whoever asks it after the training."""

from deimos.goals.fear_selector import FearSelector, fear_selector
from deimos.run.folder import RunFolder
from deimos.run.loop import spaces
from deimos.run.trainer import TrainConfig
from deimos.run.training import load_checkpoint
from deimos.sim.env import Env


def load_fear(folder: RunFolder, config: TrainConfig, env: Env) -> FearSelector | None:
    """The selector with a run's fear network and its calibration; ``None`` where there is none that has learnt.

    Args:
        folder: The run.
        config: Its configuration.
        env: Worlds of its environment, where the network shall be.
    """
    afraid = fear_selector(config.goals.build(spaces(env, config.env_steps), config.seed))
    if afraid is None or afraid.parts:
        return None
    state = load_checkpoint(folder)["loop"]["selector"]
    if "fear" not in state:  # it is a part of another selector
        return None
    for name in ("fear", "calibration"):  # what else there is depends on the version that wrote it
        getattr(afraid, name).load_state_dict(state[name])
    return afraid if afraid.fear.fitted else None
