"""The ensemble of critics: against critics trained one by one, against PPO's own, and how it scores goals."""

import copy
import dataclasses
import math

import pytest
import torch
from taught_selectors import SPACES, decisions
from torch import nn

from deimos.goals import picks
from deimos.goals.interactions import Interactions
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import uniform, vds
from deimos.learn.ppo import PPO, PPOConfig
from deimos.learn.rollout import Rollout
from deimos.nn.returns import advantages
from deimos.run.loop import spaces
from deimos.sim.envs import particle

CPU = torch.device("cpu")
NUM_ENVS, NUM_STEPS = 30, 12
SMALL = {"hidden": (16, 8), "activation": "elu", "epochs": 2, "minibatches": 3}


def worlds(time_limit=100):
    return particle.Config(time_limit=time_limit).build(NUM_ENVS, CPU, seed=0)


def random_rollout(env, seed=0):
    """Transitions with crashes, time limits and rows of weight 0."""
    generator = torch.Generator().manual_seed(seed)
    rollout = Rollout(NUM_STEPS, NUM_ENVS, env.obs_dim, env.action_dim, CPU, reward_scale=0.01)
    rollout.obs.normal_(generator=generator)
    rollout.reward.uniform_(0.0, 100.0, generator=generator)
    rollout.terminated.bernoulli_(0.05, generator=generator)
    if env.time_limit:
        rollout.truncated.bernoulli_(0.05, generator=generator)
        rollout.truncated &= ~rollout.terminated
        rollout.last_obs.normal_(generator=generator).masked_fill_(~rollout.truncated.unsqueeze(2), torch.nan)
    rollout.weight.bernoulli_(0.9, generator=generator)
    return rollout


def ensemble(env, seed=0, **changes):
    return vds.Config(**(SMALL | changes)).build(spaces(env), seed)


def no_interactions(env):
    return Interactions(NUM_ENVS, env.state_dim, env.goal_dim, 5, 10, CPU)


class Alone:
    """One critic by itself, from autograd and torch's own Adam and clipping."""

    def __init__(self, net, config):
        self.net, self.config = net, config
        self.optimizer = torch.optim.Adam(net.parameters(), lr=config.learning_rate)

    def learn(self, rollout, order):
        """Move towards its own lambda-returns, in minibatches of the given order."""
        with torch.no_grad():
            value = self.net(rollout.obs).squeeze(2)
            next_value = value[1:].clone()
            step, world, obs = rollout.cut_off()
            next_value[step, world] = self.net(obs).squeeze(1)
            returns = value[:-1] + advantages(
                rollout.reward * rollout.reward_scale, value[:-1], next_value, rollout.terminated, rollout.truncated,
                discount=rollout.discount, gae_lambda=rollout.gae_lambda,
            )  # fmt: skip
        data = [t.flatten()[order] for t in (value[:-1], returns, rollout.weight)]
        data = [rollout.obs[:-1].flatten(0, 1)[order], *data]
        for _ in range(self.config.epochs):
            for obs, old, target, weight in zip(*(t.chunk(self.config.minibatches) for t in data), strict=True):
                value = self.net(obs).squeeze(1)
                clipped = old + (value - old).clamp(-self.config.clip, self.config.clip)
                loss = torch.maximum((value - target).square(), (clipped - target).square())
                self.optimizer.zero_grad()
                ((loss * weight).sum() / weight.sum()).backward()
                nn.utils.clip_grad_norm_(self.net.parameters(), self.config.max_grad_norm)
                self.optimizer.step()


def orders(selector, count):
    """The orders that its next update will draw, one per critic."""
    generator = torch.Generator()
    generator.set_state(selector.generator.get_state())
    return [torch.randperm(NUM_ENVS * NUM_STEPS, generator=generator) for _ in range(count)]


@pytest.mark.parametrize("kernel", [True, False])
@pytest.mark.parametrize("activation", ["elu", "relu"])
@pytest.mark.parametrize("max_grad_norm", [0.05, 10.0])
def test_ten_critics_together_equal_ten_separate_ones(activation, kernel, max_grad_norm):
    """Over five updates every member stays what it becomes alone, with its own returns, order and gradient clip."""
    env = worlds()
    selector = ensemble(env, max_grad_norm=max_grad_norm, activation=activation)
    selector.nets._kernel = selector.nets._kernel if kernel else None
    single = [Alone(copy.deepcopy(net), selector.config) for net in selector.nets.modules]
    start = selector.nets.parameters.clone()
    for update in range(5):
        rollout = random_rollout(env, update)
        for critic, order in zip(single, orders(selector, 10), strict=True):
            critic.learn(rollout, order)
        selector.learn(no_interactions(env), rollout)
    assert (selector.nets.parameters - start).abs().max() > 0.01
    # Thirty steps of Adam of 1e-3; it divides by the root of the mean square, so the rounding of a gradient that is
    # nearly 0 becomes a share of a step (see the test of a full update of PPO).
    for net, critic in zip(selector.nets.modules, single, strict=True):
        for ours, theirs in zip(net.parameters(), critic.net.parameters(), strict=True):
            torch.testing.assert_close(ours.data, theirs.data, rtol=1e-4, atol=5e-5)
    obs = torch.randn(200, env.obs_dim)
    together = torch.stack([critic.net(obs).squeeze(1) for critic in single]).detach()
    torch.testing.assert_close(selector.values(obs), together, rtol=1e-4, atol=5e-5)


def test_one_critic_is_ppos_own():
    """K = 1 with PPO's weights, order and learning rate has PPO's critic over five updates, with the same baseline."""
    env = worlds()
    config = PPOConfig(
        num_steps=NUM_STEPS, hidden=SMALL["hidden"], activation="elu", desired_kl=0.0, epochs=2, minibatches=3
    )  # fmt: skip
    ppo, selector = PPO(config, NUM_ENVS, env.obs_dim, 3, CPU, seed=0), ensemble(env, critics=1)
    for ours, theirs in zip(selector.nets.modules[0].parameters(), ppo.critic.parameters(), strict=True):
        ours.data.copy_(theirs.data)
    for update in range(5):
        rollout = random_rollout(env, update)
        noise = torch.randn(NUM_STEPS, NUM_ENVS, 3, generator=torch.Generator().manual_seed(update))
        for t in range(NUM_STEPS):
            ppo.act(rollout.obs[t], noise[t], rollout.action[t], rollout.mean[t])
        own, theirs = (ppo.batch(rollout, critic)[0].value[0, 2].clone() for critic in (None, selector.value))
        torch.testing.assert_close(own, theirs, rtol=1e-4, atol=1e-4)
        metrics = ppo.update(rollout, orders(selector, 1)[0])
        row = selector.learn(no_interactions(env), rollout)
        assert row["vds/loss"] == pytest.approx(metrics["value_loss"], rel=1e-3)
    for ours, theirs in zip(selector.nets.modules[0].parameters(), ppo.critic.parameters(), strict=True):
        torch.testing.assert_close(ours.data, theirs.data, rtol=1e-4, atol=5e-5)


def test_critics_with_returns_of_their_own_do_not_agree():
    """Members differ from the start, in their targets and after they have learnt from the same data."""
    env = worlds()
    selector = ensemble(env)
    rollout = random_rollout(env)
    targets = selector._targets(rollout, selector._worlds(NUM_ENVS, CPU))[1]
    assert (targets.std(0) > 1e-3).float().mean() > 0.9
    for _ in range(5):
        selector.learn(no_interactions(env), rollout)
    assert (selector.values(rollout.obs).std(0) > 1e-3).float().mean() > 0.9


@pytest.mark.parametrize("kind", [torch.uint8, torch.int64])
def test_flags_in_whole_numbers_are_flags(kind):
    """A learner that keeps flags as 0 and 1, as rsl_rl does, gives the same targets."""
    env = worlds()
    selector, rollout = ensemble(env), random_rollout(env)
    expected = selector._targets(rollout, selector._worlds(NUM_ENVS, CPU))
    rollout.terminated, rollout.truncated = rollout.terminated.to(kind), rollout.truncated.to(kind)
    for ours, theirs in zip(selector._targets(rollout, selector._worlds(NUM_ENVS, CPU)), expected, strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("rule", ["proportional", "argmax", "percentile"])
def test_goals_are_scored_by_disagreement(rule):
    """A score is the standard deviation over the members, and the rule chooses by it."""
    env = worlds()
    selector = ensemble(env, rule=rule, percentile=90.0, candidates=20)
    generator = torch.Generator().manual_seed(0)
    state, goal = torch.randn(1, env.state_dim, generator=generator), torch.randn(1, 3, generator=generator)
    candidates = torch.randn(1, 20, 3, generator=generator)
    obs = torch.cat([state.expand(20, -1), candidates[0]], dim=1)
    values = torch.stack([net(obs).squeeze(1) for net in selector.nets.modules]).detach()
    score = values.std(dim=0, correction=0)
    draws = torch.zeros(4000, 4)
    draws[:, 0] = (torch.arange(4000) + 0.5) / 4000
    proposal = selector.propose(
        torch.arange(4000), state.expand(4000, -1), goal.expand(4000, -1), candidates.expand(4000, -1, -1), draws
    )
    picked = (proposal.goal.unsqueeze(1) == candidates).all(2).float().argmax(1)
    torch.testing.assert_close(proposal.score, score[picked], rtol=1e-4, atol=1e-6)
    frequency = torch.bincount(picked, minlength=20) / 4000
    if rule == "proportional":
        torch.testing.assert_close(frequency, score / score.sum(), rtol=0, atol=1e-3)
    else:
        best = score.topk(1 if rule == "argmax" else 2).indices
        assert set(picked.tolist()) == set(best.tolist())


def test_shared_data_teach_every_critic_its_own_worlds_only():
    """With shares every world belongs to at most one critic, another part every time, and teaches only that one."""
    env = worlds()
    garbage, clean = ensemble(env, data="share", critics=4), ensemble(env, data="share", critics=4)
    generator = torch.Generator()
    generator.set_state(garbage.generator.get_state())
    shares = torch.randperm(NUM_ENVS, generator=generator)[:28].view(4, 7)
    rollout = random_rollout(env)
    clean.learn(no_interactions(env), rollout)
    rollout.reward[:, shares[2]] += 50.0
    rollout.obs[:, shares[2]] += 1.0
    garbage.learn(no_interactions(env), rollout)
    for k, (net, other) in enumerate(zip(garbage.nets.modules, clean.nets.modules, strict=True)):
        same = all(torch.equal(a, b) for a, b in zip(net.parameters(), other.parameters(), strict=True))
        assert same == (k != 2)
    assert not torch.equal(garbage._worlds(NUM_ENVS, CPU), shares)


def test_a_goal_in_the_middle_of_the_observation_is_found():
    """Wherever the goal stands in the observation, critics see the state and then the goal."""
    middle = Spaces(NUM_ENVS, 9, 3, 5, CPU, goal_start=4)
    obs = torch.arange(24.0).view(2, 12)
    state, goal = torch.cat([obs[:, :4], obs[:, 7:]], dim=1), obs[:, 4:7]
    assert torch.equal(middle.state_then_goal(obs), torch.cat([state, goal], dim=1))
    selector = vds.Config(**SMALL).build(middle, 0)
    behind = torch.cat([state, goal], dim=1)
    expected = torch.stack([net(behind).squeeze(1) for net in selector.nets.modules]).detach()
    torch.testing.assert_close(selector.values(obs), expected, rtol=1e-4, atol=1e-5)
    assert Spaces(NUM_ENVS, 9, 3, 5, CPU, goal_start=9).state_then_goal(obs) is obs


def test_roles():
    """In the role ``replace`` the mean of the ensemble is the baseline, and as an auxiliary it is nobody's."""
    env = worlds()
    selector = ensemble(env)
    assert ensemble(env, role="auxiliary").critic() is None
    assert selector.critic() == selector.value
    obs = random_rollout(env).obs
    expected = torch.stack([net(obs).squeeze(2) for net in selector.nets.modules]).mean(0).detach()
    torch.testing.assert_close(selector.value(obs), expected, rtol=1e-5, atol=1e-6)


def test_values_that_the_learner_asked_for_are_not_stale():
    """An update after the learner's question equals one without, also when the rollout's memory holds new numbers."""
    env = worlds(time_limit=0)
    asked, silent = ensemble(env), ensemble(env)
    rollout = random_rollout(env)
    for seed in (0, 1, 2):
        rollout.obs.copy_(random_rollout(env, seed).obs)
        if seed != 1:  # the learner of a later rollout may have a critic of its own
            asked.value(rollout.obs)
        asked.learn(no_interactions(env), rollout)
        silent.learn(no_interactions(env), rollout)
    assert torch.equal(asked.nets.parameters, silent.nets.parameters)


def test_it_needs_the_learners_rollout():
    """Without one, and with more critics than worlds to share, it says what is wrong."""
    env = worlds()
    with pytest.raises(ValueError, match="vds learns values, so it needs the learner's rollout, got None"):
        ensemble(env).learn(no_interactions(env), None)
    with pytest.raises(
        ValueError, match="critics must be at most the 30 worlds that they share, got 31; use data 'all'"
    ):
        ensemble(env, data="share", critics=31)
    assert math.isnan(
        ensemble(env, data="share").learn(no_interactions(env), random_rollout(env))["vds/deviation"]
    )  # members that saw different worlds have no common value to disagree about


def test_uniform_ensemble_differs_from_uniform_in_the_baseline_alone():
    """Its goals are the ones that Uniform picks, and PPO's baseline is VDS's ensemble."""
    selector = method("uniform-ensemble").build(SPACES, 0)
    arguments = decisions(count=200, candidates=1)
    chosen = selector.propose(*arguments)
    assert torch.equal(chosen.goal, uniform.Config().build(SPACES, 0).propose(*arguments).goal)
    assert selector.num_candidates == 1
    assert selector.critic() is not None
    assert method("uniform-ensemble") == dataclasses.replace(method("vds"), rule="uniform")


def test_vds_argmax_takes_the_largest_deviation():
    """Of all candidates it takes the one that the critics disagree about most."""
    selector = method("vds-argmax").build(SPACES, 0)
    rows, state, goal, options, draws = decisions(count=50)
    chosen = selector.propose(rows, state, goal, options, draws)
    inputs = torch.cat([state.unsqueeze(1).expand(-1, 20, -1), options], dim=2)
    deviation = selector.values(inputs).std(dim=0, correction=0)
    assert torch.equal(chosen.goal, picks.take(options, deviation.argmax(1)))


def test_vds_needs_no_candidates_for_uniform_goals():
    """The rule is checked, and only ``uniform`` asks for one candidate."""
    assert [vds.Config(rule=rule).build(SPACES, 0).num_candidates for rule in ("uniform", "argmax")] == [1, 100]
