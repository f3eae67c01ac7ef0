"""What a reader must know about our choices: how they were made, and where they differ from the thesis."""

from collections.abc import Sequence

from deimos.study.document import Block
from reproduction.thesis import LEGGED

PILOTS = (
    "How the choices were made: those that the thesis leaves open by pilots under Uniform goals, one seed each "
    "(docs/lab/particle.md); the defaults of the new selectors and the sizes of the crash penalty by pilots on two "
    "settings that take no part in any study (docs/lab/pilots.md). Nothing was tuned for a Director."
)
PARTICLE_DEVIATIONS = [
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
]  # fmt: skip
"""Choice, Particle Gym's, the thesis's, and the likely effect."""
LEGGED_PILOTS = (
    "How the choices were made: what is compared was declared before the first cell (reproduction/legged.md). The "
    "robots' settings are presets that were made to walk under Uniform goals within minutes of a core "
    "(docs/lab/quad.md, docs/lab/quad_arm.md). Nothing was tuned for a Director."
)
LEGGED_DEVIATIONS = [
    ("training", "methods branch off common bases after 10 M transitions under Uniform, and have 2 M each (Quad+arm: "
     "1.5 M); in pairs, on five bases (Quad+arm: three)", "every method from nothing, 295 M transitions, 30 seeds",
     "how goals change a policy that walks, not how it learns to walk; smaller effects"),
    ("first rollouts of a branch", "critics learn for ten before the policy changes, under every method", "-", "none"),
    ("T in training", "bases T10 (Quad+arm: T2), branches T2; `quad_long`: T10", "T10",
     "selectors choose nine of ten goals, not one of two"),
    ("simulator", "MuJoCo, native engine, 512 robots; `quad_warp` and `quad_on_warp`: mujoco-warp",
     "Isaac Gym, 4096 robots", "other contacts; noisier gradients"),
    ("ground", "Quad: rough; Quad+arm: flat", "rough", "Quad+arm crashes less"),
    ("robot", "Go1, gains of Legged Gym's A1 raised by half", "silent", "unknown"),
    ("reward", "Legged Gym's A1 list with the tilt squared, no reward for air time, penalties a half to a quarter as "
     "heavy, clipped at 0", "matching goals and terms for gaits, as Legged Gym", "walks in minutes; rougher gaits"),
    ("PPO and networks", "discount 0.97, [128, 64, 32] ELU (Quad+arm: [256, 128, 64])", "silent",
     "chosen under Uniform, so in its favour"),
    ("crash", "trunk, hips or head on the ground with more than 1 N", "\"any part of the robot's base\"", "a few more"),
    ("penalty-30", "30 times the largest reward of a step for a crash", "no penalty", "a baseline more"),
    ("fear's data", "a crash memory in all Directors", "balanced batches of the rollout buffer",
     "the memory is another method"),
    ("VDS", "its ensemble begins from nothing in place of the base's critic", "from the beginning",
     "against VDS; `uniform-ensemble`, where it ran, tells apart"),
    ("Adversary", "`argmax`: 2000 steps of 400 robots under uniform goals", "1500 timesteps", "none"),
    ("other attackers", "the worst of several, the same budget for every policy", "none", "a stricter judge"),
    ("evaluation", "mean actions; friction 1, no pushes, payload, noise or time-outs; two robots on every tile of the "
     "ground (mujoco-warp: one), which they keep", "no randomization of friction, pushes and terrain", "fewer crashes"),
]  # fmt: skip
"""The same for robots."""


def blocks(environments: Sequence[str]) -> list[Block]:
    """The section on pilots and deviations, for Particle Gym, robots, or both."""
    legged = [name for name in environments if name.startswith(LEGGED)]
    found: list[Block] = ["## Pilots and deviations"]
    for there, pilots, deviations in (
        (len(legged) < len(environments), PILOTS, PARTICLE_DEVIATIONS), (bool(legged), LEGGED_PILOTS, LEGGED_DEVIATIONS)
    ):  # fmt: skip
        titles = ("what", "here", "the thesis", "likely effect")
        found += [pilots, [dict(zip(titles, row, strict=True)) for row in deviations]] if there else []
    return found
