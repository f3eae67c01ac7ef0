"""The evaluation of policies: what is counted, the score, and the Adversary."""

import math
from types import SimpleNamespace

import pytest
import torch

from deimos.checks import RunError, SimulationError
from deimos.goals.fear import Fear, FearConfig, auroc
from deimos.goals.interactions import Resolved
from deimos.goals.selectors import uniform
from deimos.nn.networks import mlp
from deimos.run.audit import CANDIDATES, _Explorer, _next_contexts, audit_fear
from deimos.run.evaluation import EvalConfig, _Collector, _quality, evaluate, play, train_adversary, weights_hash
from deimos.run.loop import GoalLoop, spaces
from deimos.run.oracle import Clones
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle

CPU = torch.device("cpu")
VARIANTS = ["absolute", "directional", "relative"]
SMALL = EvalConfig(
    worlds=64, steps=400, adversary_steps=300, adversary_interactions=100, adversary_crashes=10, adversary_patience=2,
    fear=FearConfig(epochs=10, min_per_class=8),
)  # fmt: skip


def naive(env):
    return uniform.Config().build(spaces(env), 0)


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
                    ended.append((issued[world], crashed, gained[world] / period))
                is_first[world], age[world], gained[world], issued[world] = crashed, 0, 0.0, t
        loop.advance(step)
    in_time = [item for item in ended if item[0] <= steps - period]
    assert 0 < first_crashes < crashes
    assert found["crashes"] == crashes
    assert found["first_goal_steps"] == first_steps
    assert found["first_goal_crashes"] == first_crashes
    assert found["interactions"] == len(in_time)
    assert found["interaction_crashes"] == sum(crashed for _, crashed, _ in in_time)
    assert found["reward"] == pytest.approx(total / (steps * worlds), rel=1e-6)
    assert found["return_per_step"] == pytest.approx(sum(gain for *_, gain in in_time) / len(in_time), rel=1e-5)


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


def test_the_adversary_finds_what_crashes_a_policy():
    """Against a follower with a blind side it learns to rank goals and crashes it more often than Naive does."""
    config = particle.Config()
    follow = config.build(1, CPU, 0).reference_policy()

    blind = config.build(1, CPU, 0).reference_policy(brake=False)

    def policy(obs):
        action = follow(obs)
        action[:, 0] = torch.where(obs[:, 9] > 0, blind(obs)[:, 0], action[:, 0])
        return action

    rows = evaluate(policy, config, EvalConfig(
        worlds=100, steps=1000, adversary_steps=1000, adversary_interactions=500, adversary_crashes=20,
        fear=FearConfig(epochs=20, min_per_class=8),
    ), CPU)  # fmt: skip
    naive_row, attacked = rows
    assert attacked["adversary_auroc"] > 0.8
    assert attacked["crash_rate"] > 1.3 * naive_row["crash_rate"] > 0


def held_out(probe, crashed):
    """Interactions of which only the kind of the goal and the outcome are known; states hold the kind."""
    probe, crashed = torch.tensor(probe), torch.tensor(crashed)
    nothing = torch.zeros(len(probe))
    return Resolved(
        env=nothing.long(), state=torch.stack([probe.float(), crashed.float()], dim=1), goal=nothing.unsqueeze(1),
        next_goal=nothing.unsqueeze(1), score=nothing, reward=nothing, tracking=nothing, probe=probe,
        note=nothing.long(), crashed=crashed, issued=nothing.long(), resolved=nothing.long(),
        horizon=nothing.long() + 1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("column", "probe", "crashed", "expected"),
    [
        (0, [True] * 6 + [False] * 6, [True] + [False] * 5 + [True] * 5 + [False], 0.5),  # it knows the kind alone
        (1, [True] * 6 + [False] * 6, [True] + [False] * 5 + [True] * 5 + [False], 1.0),
        (1, [True] * 6 + [False] * 6, [False] * 9 + [True] * 3, 1.0),  # only its own goals crash the policy
        (1, [True] * 6 + [False] * 6, [False] * 6 + [True] * 6, math.nan),  # no kind has both outcomes
        (1, [True] * 6, [False] * 6, math.nan),
    ],
)
def test_the_adversary_is_judged_within_each_kind_of_goals(column, probe, crashed, expected):
    """To know which goals are its own is worth nothing, and where one kind never crashes the other one counts."""
    network = SimpleNamespace(fitted=True, score=lambda state, goal, candidates: state[:, column : column + 1])
    assert _quality(network, held_out(probe, crashed)) == pytest.approx(expected, nan_ok=True)
    assert math.isnan(_quality(SimpleNamespace(fitted=False), held_out(probe, crashed)))


def test_the_adversarys_uniform_goals_are_marked():
    """While it collects, about half of its goals are Uniform's, and these are the ones that are marked as probes."""
    env = particle.Config().build(400, CPU, 0)
    fear = Fear(FearConfig(), env.state_dim, env.goal_dim, CPU, 0)
    fear.fitted = True
    collector, rows = _Collector(env, fear), torch.arange(400)
    candidates, draws = env.sample_goals(rows, collector.num_candidates).clone(), env.draw(rows)
    arguments = (rows, env.state(env.obs), env.goal, candidates, draws)
    proposal, free = collector.propose(*arguments), naive(env).propose(*arguments)
    same = (proposal.goal == free.goal).all(1)
    assert bool(same[proposal.probe].all())
    assert same[~proposal.probe].float().mean() < 0.1  # one of a hundred candidates, by chance
    assert abs(proposal.probe.sum().item() - 200) < 4 * 10


def test_collecting_continues_until_there_is_enough():
    """The collection ends at its steps where they suffice, and at its patience where a policy never crashes."""
    env = particle.Config(goal_period=50).build(64, CPU, 0)
    fear, facts = train_adversary(lambda obs: torch.zeros(64, 3), env, SMALL)
    assert facts["adversary_steps"] == SMALL.adversary_steps * SMALL.adversary_patience
    assert facts["adversary_crashes"] == 0
    assert math.isnan(facts["adversary_auroc"])
    assert not fear.fitted
    env = particle.Config(goal_period=50, max_speed=20.0).build(64, CPU, 0)
    fear, facts = train_adversary(env.reference_policy(brake=False), env, SMALL)
    assert facts["adversary_steps"] == SMALL.adversary_steps
    assert fear.fitted


def test_policies_meet_the_same_goals():
    """Evaluating twice gives the same numbers, and another seed gives others."""
    config = particle.Config()
    policy = config.build(1, CPU, 0).reference_policy(brake=False)
    first, again = (evaluate(policy, config, SMALL, CPU) for _ in range(2))
    assert str(first) == str(again)
    other = evaluate(policy, config, EvalConfig(**(vars(SMALL) | {"seed": 4})), CPU)
    assert other[0]["reward"] != first[0]["reward"]


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
    enough = EvalConfig(adversary_steps=1000, adversary_interactions=0, adversary_crashes=0)
    trainer.loop.selector.fear, _ = train_adversary(follow, config.env.build(256, CPU, 1), enough)
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
        ("seed", -1, "seed must be in .*, got -1"),
        ("seed", 2**32, "seed must be in .*, got 4294967296"),
    ],
)
def test_config_rejects(field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        EvalConfig(**{field: value})
