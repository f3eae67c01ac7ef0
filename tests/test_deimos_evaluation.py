"""The evaluation of policies: what is counted, the score, the worst attacker, and audits of fear."""

import math

import pytest
import torch

from deimos.checks import RunError, SimulationError
from deimos.goals.fear import FearConfig, auroc
from deimos.goals.selectors import uniform
from deimos.nn.networks import mlp
from deimos.run.attack import learn_fear
from deimos.run.audit import CANDIDATES, _Explorer, _next_contexts, audit_fear
from deimos.run.evaluation import EvalConfig, evaluate, make_target, play, weights_hash, worst
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
VARIANTS = ["absolute", "directional", "relative"]
SMALL = EvalConfig(worlds=64, steps=400, adversary_steps=300, fear=FearConfig(epochs=10, min_per_class=8))


def naive(env):
    return uniform.Config().build(spaces(env), 0)


def test_goals_without_time_to_end_before_the_limit_do_not_count():
    """Of goals that the time limit cuts off only crashes could be known: neither crash nor survival counts."""
    env = particle.Config(goal_period=10, time_limit=25).build(3, CPU, 0)

    def act(obs):
        """World 0 crashes on step 22 of every episode, under such a goal, world 1 on step 16, and world 2 lives."""
        for world, age in ((0, 22), (1, 16)):
            if env.episode_step[world] == age - 1:
                env.tensors["position"][world] = 2 * particle.HALF_SIDE
        return torch.zeros(3, 3)

    row = play(env, act, naive(env), 75)
    assert row["crashes"] == 3 + 4
    assert (row["interaction_crashes"], row["interactions"]) == (4, 3 + 4 + 3)
    assert row["first_goal_steps"] == 3 * 75 - sum((3 * 12, 4 * 6 + 1, 3 * 15))


def test_where_doing_nothing_is_as_good_as_the_reference_there_is_no_score():
    """Forces that move nothing leave no scale to place a policy on."""
    still = evaluate(lambda obs: torch.zeros(8, 3), particle.Config(goal_period=5, max_force=1e-9), EvalConfig(
        worlds=8, steps=10, attackers=()), CPU)[0]  # fmt: skip
    assert math.isnan(still["score"])
    assert still["return_per_step"] > 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_crashing_does_not_pay_on_the_score(variant):
    """The follower that brakes for the wall scores 1, the one that does not scores less, doing nothing scores 0."""
    config = particle.Config(variant=variant)
    env = config.build(64, CPU, SMALL.seed)
    braking, blind = (evaluate(env.reference_policy(brake=brake), config, SMALL, CPU)[0] for brake in (True, False))
    still = evaluate(lambda obs: torch.zeros(64, 3), config, SMALL, CPU)[0]
    assert braking["score"] == pytest.approx(1.0)
    assert still["score"] == pytest.approx(0.0)
    assert braking["crashes"] == still["crashes"] == 0
    assert blind["crashes"] > 0
    assert blind["score"] < 0.9


def test_a_scale_without_a_length_gives_no_score():
    """Where doing nothing is as good as the reference, the evaluation ends, and the score is not a number."""
    config = EvalConfig(worlds=4, steps=200, attackers=())
    (row,) = evaluate(
        lambda obs: torch.zeros(4, 3), particle.Config(), config, CPU, once=lambda task, compute: ("reward", 0.5, 0.5)
    )
    assert math.isnan(row["score"])


def test_the_mean_reward_pays_for_crashing():
    """Why there is a score: the reward per transition puts the blind follower above the braking one."""
    config = particle.Config()
    braking, blind = (
        play(env := config.build(64, CPU, 5), env.reference_policy(brake=brake), naive(env), 2000)
        for brake in (True, False)
    )
    assert blind["reward"] > braking["reward"]
    assert blind["return_per_step"] < braking["return_per_step"]


def test_play_counts_what_a_plain_loop_counts():
    """Rewards, crashes, first goals, interactions and returns equal a bookkeeping world by world."""
    period, steps, worlds = 7, 60, 9
    config = particle.Config(goal_period=period, max_speed=300.0, max_force=80.0)
    probe = config.build(worlds, CPU, 3)
    found = play(config.build(worlds, CPU, 3), probe.reference_policy(brake=False), naive(probe), steps)
    env = config.build(worlds, CPU, 3)
    loop, act = GoalLoop(env, naive(env)), probe.reference_policy(brake=False)
    age, is_first, gained, issued = [0] * worlds, [True] * worlds, [0.0] * worlds, [0] * worlds
    crashes = first_steps = first_crashes = 0
    total, ended = 0.0, []
    for t in range(1, steps + 1):
        step = env.step(act(env.obs))
        for world in range(worlds):
            crashed, reward = bool(step.terminated[world]), float(step.reward[world])
            total += reward
            crashes += crashed
            first_steps += is_first[world]
            first_crashes += crashed and is_first[world]
            gained[world] += 0.0 if crashed else reward
            age[world] += 1
            if crashed or age[world] == period:
                if not is_first[world]:
                    ended.append((issued[world], crashed, gained[world] / period, world))
                is_first[world], age[world], gained[world], issued[world] = crashed, 0, 0.0, t
        loop.advance(step)
    in_time = [item for item in ended if item[0] <= steps - period]
    assert 0 < first_crashes < crashes
    assert found["crashes"] == crashes
    assert found["first_goal_steps"] == first_steps
    assert found["first_goal_crashes"] == first_crashes
    assert found["interactions"] == len(in_time)
    assert found["interaction_crashes"] == sum(crashed for _, crashed, _, _ in in_time)
    even = [crashed for _, crashed, _, world in in_time if world % 2 == 0]
    assert 0 < sum(even) < found["interaction_crashes"]
    assert (found["even_interactions"], found["even_interaction_crashes"]) == (len(even), sum(even))
    assert found["reward"] == pytest.approx(total / (steps * worlds), rel=1e-6)
    assert found["return_per_step"] == pytest.approx(sum(gain for _, _, gain, _ in in_time) / len(in_time), rel=1e-5)


@pytest.mark.parametrize(("kinds", "even"), [([], 3), (["stairs", "flat", "flat", "slope", "slope"], 3),
                                             (["stairs", "flat", "slope", "waves", "waves"], 4)])  # fmt: skip
def test_halves_are_of_the_same_kinds(kinds, even):
    """Where there are kinds of worlds, every second one of each kind belongs to the half that chooses the attacker."""
    env = particle.Config(goal_period=7).for_evaluation().build(5, torch.device("cpu"), 0)
    env.strata = lambda: kinds
    row = play(env, lambda obs: torch.zeros(5, 3), uniform.Config().build(spaces(env), 0), 30)
    assert row["interactions"] % 5 == 0 < row["interactions"]
    assert row["even_interactions"] == even * row["interactions"] // 5


def test_errors_are_read_at_the_end_of_goals():
    """What an environment calls an error is read where a goal has been active for T steps, and not elsewhere."""
    env = particle.Config(goal_period=7).for_evaluation().build(5, torch.device("cpu"), 0)
    env.errors = {"clock [steps]": env.tensors["goal_clock"]}
    row = play(env, lambda obs: torch.zeros(5, 3), uniform.Config().build(spaces(env), 0), 30)
    assert row["errors"] == {"clock [steps]": 7}


def test_errors_of_nobody_are_nan():
    """Where no goal is survived there is no error to report."""
    env = particle.Config(goal_period=7).for_evaluation().build(5, torch.device("cpu"), 0)
    env.errors = {"clock [steps]": env.tensors["goal_clock"].float()}
    row = play(env, lambda obs: torch.zeros(5, 3), uniform.Config().build(spaces(env), 0), 6)
    assert math.isnan(row["errors"]["clock [steps]"])


def test_policies_meet_the_same_goals():
    """Evaluating twice gives the same numbers, and another seed gives others."""
    config = particle.Config()
    policy = config.build(1, CPU, 0).reference_policy(brake=False)
    first, again = (evaluate(policy, config, SMALL, CPU) for _ in range(2))
    assert str(first) == str(again)
    other = evaluate(policy, config, EvalConfig(**(vars(SMALL) | {"seed": 4})), CPU)
    assert other[0]["reward"] != first[0]["reward"]


def attacked(goals, even, odd, count=100):
    """A row: crashes of 100 interactions each in worlds of even and of odd number."""
    return {
        "goals": goals, "interactions": 2 * count, "interaction_crashes": even + odd, "even_interactions": count,
        "even_interaction_crashes": even,
    }  # fmt: skip


def test_the_worst_is_chosen_on_some_worlds_and_reported_on_others():
    """It is the attacker that crashes most in even worlds; the rate is that in odd ones, which may be a smaller one."""
    rows = [attacked("naive", 99, 99), attacked("argmax", 30, 10), attacked("scripted", 20, 40)]
    assert worst([rows]) == [{"attacker": "argmax", "crash_rate": 0.1, "interactions": 100}]
    assert worst([rows, [attacked("scripted", 0, 1)]]) == [
        {"attacker": "scripted", "crash_rate": 0.4, "interactions": 100},
        {"attacker": "scripted", "crash_rate": 0.01, "interactions": 100},
    ]


def test_there_is_no_worst_of_nothing():
    """Policies that met no attacker in common have none, nor have rows of 0.1.0, which do not tell worlds apart."""
    assert worst([[attacked("argmax", 1, 1)], [attacked("scripted", 1, 1)]]) == []
    assert worst([[{"goals": "adversary", "interactions": 10, "interaction_crashes": 1}]]) == []
    assert worst([]) == []


def test_the_worst_of_equals_is_not_too_large():
    """The larger of two noisy rates of the same size is too large; the one that is reported is not."""
    generator = torch.Generator().manual_seed(0)
    crashes = torch.binomial(torch.full((1000, 4), 100.0), torch.full((1000, 4), 0.1), generator).long().tolist()
    rows = [[attacked("argmax", a, b), attacked("scripted", c, d)] for a, b, c, d in crashes]
    rates = torch.tensor([found["crash_rate"] for found in worst(rows)])
    largest = torch.tensor([max(a + b, c + d) / 200 for a, b, c, d in crashes])
    assert largest.mean() > 0.11 > 0.103 > rates.mean() > 0.097


def test_steps_must_fit_an_interaction():
    """Fewer than 2 T steps hold no whole interaction and are refused with the number needed."""
    with pytest.raises(ValueError, match="steps must be at least 2 T = 1000, got 400"):
        evaluate(lambda obs: obs[:, :3], particle.Config(goal_period=500), SMALL, CPU)


def test_a_policy_that_gives_nan_is_no_policy():
    """NaN actions stop the evaluation; they are not clipped into something finite."""
    with pytest.raises(SimulationError, match="action is not finite"):
        evaluate(lambda obs: torch.full((64, 3), torch.nan), particle.Config(), SMALL, CPU)


def test_the_hash_tells_weights_apart():
    """Equal weights have equal hashes; the smallest change gives another."""
    torch.manual_seed(0)
    net = mlp(3, (4,), 1, "relu", torch.default_generator)
    before = weights_hash(net)
    assert weights_hash(net) == before
    net[0].weight.data[0, 0] += 1e-6
    assert weights_hash(net) != before


def test_the_audit_ranks_within_contexts():
    """A network that has learnt where a policy crashes ranks goals within contexts; one without opinion is refused."""
    config = TrainConfig(env=particle.Config(max_speed=20.0, goal_period=50), num_envs=64, method="p25", threads=1)
    trainer = Trainer(config, CPU)
    with pytest.raises(RunError, match="no fear network that has learnt"):
        audit_fear(trainer, 4)
    follow = trainer.env.reference_policy(brake=False)
    trainer.ppo.actor.forward = follow
    trainer.ppo.actor.std.data.fill_(0.0)
    target = make_target(follow, config.env, EvalConfig(worlds=256, adversary_steps=1000), CPU)
    trainer.loop.selector.fear, _ = learn_fear(target, target.steps, own_goals=True)
    audit = audit_fear(trainer, 20)
    assert audit["contexts"] >= 20
    assert 0.8 < audit["low"] <= audit["auroc"] <= audit["high"] <= 1.0


def test_the_audit_is_exact():
    """Its labels are those of worlds that really live through the candidate: the true outcome ranks perfectly."""
    config = TrainConfig(
        env=particle.Config(max_speed=20.0, goal_period=50), num_envs=64, env_steps=24, method="uniform", threads=1
    )
    trainer = Trainer(config, CPU)
    follow = trainer.env.reference_policy(brake=False)
    trainer.ppo.actor.forward = follow  # a deterministic policy whose outcome can be worked out
    trainer.ppo.actor.std.data.fill_(0.0)
    clones = Clones(lambda count: config.env.build(count, CPU, 0), trainer.ppo.actor)
    _, state, _, candidates, survived = _next_contexts(trainer, _Explorer(trainer), clones)
    crashed = survived < config.env.goal_period
    velocity, position = state[:, None, 0:3] * 20.0, state[:, None, 3:6] * 1000.0
    velocity = velocity.expand(-1, CANDIDATES, -1).clone()
    position = position.expand(-1, CANDIDATES, -1).clone()
    left = torch.zeros_like(crashed)
    for _ in range(50):
        velocity += 0.5 * (2.0 * (candidates * 20.0 - velocity)).clamp(-1.0, 1.0)
        position += velocity
        left |= (position.abs() > 1000.0).any(-1)
    assert left.any()
    assert (left != crashed).float().mean() < 1e-3  # float32 may differ on the very wall
    assert auroc(left.float().flatten(), crashed.flatten()) > 0.999


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("worlds", 0, "worlds must be at least 1, got 0"),
        ("steps", -1, "steps must be at least 1, got -1"),
        ("seed", -1, r"seed must be in \[0, 2\^32 - 2\), got -1"),
        ("seed", 2**32 - 2, r"seed must be in \[0, 2\^32 - 2\), got 4294967294"),  # the shield's would be 2^32
        ("oracle_worlds", 0, "oracle_worlds must be at least 1, got 0"),
        ("attackers", ("nobody",), "Unknown attacker 'nobody'; choose from: argmax, argmax-long, .*scripted"),
        ("attackers", ("argmax", "argmax"), "attackers must be different, got argmax, argmax"),
    ],
)
def test_config_rejects(field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        EvalConfig(**{field: value})
