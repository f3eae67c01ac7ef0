"""What a reader must know of our choices: how they were made, and where they differ from the thesis."""

from deimos.study.document import Block

PILOTS = (
    "How the choices were made: those that the thesis leaves open by pilots under Uniform goals, one seed each "
    "(docs/lab/particle.md); the defaults of the new selectors and the sizes of the crash penalty by pilots on two "
    "settings that take no part in any study (docs/lab/pilots.md). Nothing was tuned for a Director."
)
DEVIATIONS = [
    ("fear's data", "`memory = 0` (`-literal`): the last 2 T steps; `-threshold`: where they hold 32 of each class; "
     "without an ending: a crash memory", "balanced batches of the rollout buffer",
     "the memory is another method; the threshold was 0.1.0's, and left fear untrained for most of the training"),
    ("reward and PPO", "chosen by pilots under Uniform", "\"based on distance\", positive", "in favour of Uniform"),
    ("force", "at most 1", "no bound is stated", "inertia; fear depends more on the state"),
    ("inputs and networks", "scaled inputs, [64, 64] ReLU, rewards x 0.01", "silent", "ours learns faster"),
    ("T, speed, goals", "100 steps, at most 10, within 1250, linear reward", "silent", "unknown"),
    ("Adversary", "`argmax`: 1500 steps of 2000 worlds under uniform goals", "1500 timesteps", "none"),
    ("other attackers", "the worst of several, the same budget for every policy", "none", "a stricter judge"),
    ("VDS", "the ensemble's mean is PPO's baseline", "\"in place of the single critic\"",
     "faithful, but confounded: `uniform-ensemble` tells apart"),
    ("RND", "whitened on uniform candidates; `rnd-raw` is not", "silent", "tames RND"),
    ("evaluation", "mean actions", "silent", "fewer crashes"),
    ("robots", "T of 100 steps, hundreds of worlds, minutes of training", "T of 500, 4096 worlds, hours",
     "no legged number here is the thesis's budget"),
]  # fmt: skip
"""What, ours, the thesis's, and the likely effect."""


def blocks() -> list[Block]:
    """The section on pilots and deviations."""
    titles = ("what", "here", "the thesis", "likely effect")
    rows = [dict(zip(titles, row, strict=True)) for row in DEVIATIONS]
    return ["## Pilots and deviations", PILOTS, rows]
