"""The learner against textbook sums, autograd, torch's own Adam, and rsl_rl on the same data."""

import copy
import math

import pytest
import torch
from rsl_rl.algorithms import PPO as RslPPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from deimos.checks import SimulationError
from deimos.goals.selectors import uniform
from deimos.learn.ppo import PPO, PPOConfig
from deimos.nn.adam import Adam
from deimos.nn.returns import advantages
from deimos.run.loop import GoalLoop, spaces
from deimos.sim.envs import particle

NUM_ENVS, NUM_STEPS = 50, 24


def advantages_reference(reward, value, next_value, terminated, truncated, discount, gae_lambda):
    """Equation 16 of the paper, summed term by term up to the end of the episode or of the rollout."""
    steps, envs = reward.shape
    result = torch.zeros(steps, envs, dtype=torch.float64)
    for env in range(envs):
        for t in range(steps):
            weight = 1.0
            for k in range(t, steps):
                future = 0.0 if terminated[k, env] else next_value[k, env].item()
                result[t, env] += weight * (reward[k, env].item() + discount * future - value[k, env].item())
                weight *= discount * gae_lambda
                if terminated[k, env] or truncated[k, env]:
                    break
    return result


def test_advantages_match_the_sum():
    """Advantages equal the paper's sum over random rollouts with terminations and truncations everywhere."""
    generator = torch.Generator().manual_seed(0)
    reward, value, next_value = (torch.randn(12, 40, generator=generator) for _ in range(3))
    terminated = torch.rand(12, 40, generator=generator) < 0.1
    truncated = (torch.rand(12, 40, generator=generator) < 0.1) & ~terminated
    found = advantages(reward, value, next_value, terminated, truncated, discount=0.9, gae_lambda=0.8)
    expected = advantages_reference(reward, value, next_value, terminated, truncated, 0.9, 0.8)
    # Twelve additions of numbers of order 1 in float32.
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=12 * 2**-22)


@pytest.mark.parametrize(("terminated", "truncated", "target"), [(True, False, 1.0), (False, True, 3.0)])
def test_a_time_limit_keeps_its_future(terminated, truncated, target):
    """With reward 1, next value 4 and discount 0.5 the target is 1 after a crash and 3 at a time limit."""
    one = torch.ones(1, 1)
    found = advantages(
        one, 0 * one, 4 * one, torch.full((1, 1), terminated), torch.full((1, 1), truncated),
        discount=0.5, gae_lambda=0.95,
    )  # fmt: skip
    assert found.item() == target


def test_advantages_reject_another_shape():
    """The message names the argument, what it must be and what it was."""
    one = torch.ones(2, 3)
    with pytest.raises(ValueError, match=r"next_value must have the shape of reward, \(2, 3\), got \(3, 2\)"):
        advantages(one, one, one.t(), one.bool(), one.bool(), discount=0.5, gae_lambda=0.5)


def test_adam_is_torchs():
    """Fifty steps over changing gradients and learning rates end where torch.optim.Adam ends."""
    generator = torch.Generator().manual_seed(0)
    ours, theirs, grad, rate = torch.ones(33), torch.nn.Parameter(torch.ones(33)), torch.zeros(33), torch.tensor(1e-2)
    theirs.grad = torch.zeros(33)
    adam, reference = Adam(ours, grad, rate), torch.optim.Adam([theirs], lr=1e-2)
    for step in range(50):
        gradient = torch.randn(33, generator=generator) * 10.0 ** (step % 5 - 3)
        grad.copy_(gradient)
        theirs.grad.copy_(gradient)
        rate.fill_(1e-2 / (1 + step))
        reference.param_groups[0]["lr"] = rate.item()
        adam.step()
        reference.step()
    # Each step rounds a handful of operations on numbers of order 1.
    torch.testing.assert_close(ours, theirs.data, rtol=1e-5, atol=1e-6)


def test_who_begins_to_learn_later_takes_steps_of_the_same_size():
    """Parameters that stay for the first fifty steps then move as under an Adam that begins with them, also resumed."""
    generator = torch.Generator().manual_seed(0)
    rate, late = torch.tensor(1e-2), 20
    ours, grad, apart = torch.ones(33), torch.zeros(33), torch.ones(33)
    adam = Adam(ours, grad, rate, late=late)
    alone = [Adam(apart[part], grad[part], rate) for part in (slice(late), slice(late, None))]
    for step in range(70):
        grad.normal_(generator=generator)
        warming_up = step < 50
        adam.step(without_late=warming_up)
        for part in alone[warming_up:]:
            part.step()
        if step in (30, 60):  # what it has learnt is gone on with by another one
            state = adam.state_dict()
            adam = Adam(ours, grad, rate, late=late)
            adam.load_state_dict(state)
    torch.testing.assert_close(ours, apart, rtol=1e-6, atol=1e-6)


def test_a_state_of_adam_from_before_there_was_waiting_can_be_loaded():
    """It is gone on with as it was: all parameters have made the same number of steps."""
    parameters, grad, rate = torch.ones(5), torch.ones(5), torch.tensor(1e-2)
    first, second = (Adam(parameters.clone(), grad, rate.clone(), late=2) for _ in range(2))
    first.step()
    state = first.state_dict()
    del state["waited"]
    second.load_state_dict(state)
    second._parameters.copy_(first._parameters)
    for adam in (first, second):
        adam.step(without_late=True)
        adam.step()
    assert torch.equal(first._parameters, second._parameters)


def filled(ppo, seed=1, *, truncations=False):
    """A rollout of random transitions that the policy might have made."""
    generator = torch.Generator().manual_seed(seed)
    rollout = ppo.new_rollout()
    for tensor in (rollout.obs, rollout.noise):
        tensor.normal_(generator=generator)
    for t in range(rollout.num_steps):
        ppo.act(rollout.obs[t], rollout.noise[t], rollout.action[t], rollout.mean[t])
    rollout.reward.uniform_(0.0, 100.0, generator=generator)
    rollout.terminated.bernoulli_(0.05, generator=generator)
    if truncations:
        rollout.truncated.bernoulli_(0.05, generator=generator)
        rollout.truncated &= ~rollout.terminated
        end_in(rollout, torch.randn(rollout.obs[1:].shape, generator=generator))
    return rollout


def end_in(rollout, final_obs):
    """Let the truncated steps end in these observations, shape (num_steps, num_envs, obs_dim)."""
    rollout.last_obs.copy_(torch.where(rollout.truncated.unsqueeze(2), final_obs, torch.nan))


def statistics(normalizer):
    """What our normaliser has gathered, as the state of rsl_rl's."""
    mean, variance = normalizer.mean.unsqueeze(0), normalizer.variance.unsqueeze(0)
    return {"_mean": mean, "_var": variance, "_std": variance.sqrt(), "count": normalizer.count.long()}


def rsl_rl_like(ppo, rollout):
    """rsl_rl's learner with the same weights and the same data, after it has computed its returns."""
    config = ppo.config
    obs = TensorDict({"policy": rollout.obs[0]}, batch_size=[NUM_ENVS])
    groups = {"actor": ["policy"], "critic": ["policy"]}
    spread = {"class_name": "GaussianDistribution", "init_std": config.init_std, "std_type": "scalar"}
    shape = list(config.hidden), config.activation, config.normalize_observations
    actor = MLPModel(obs, groups, "actor", 3, *shape, distribution_cfg=spread)
    critic = MLPModel(obs, groups, "critic", 1, *shape)
    for theirs in (actor.obs_normalizer, critic.obs_normalizer) if ppo.actor.normalizer else ():
        theirs.load_state_dict(statistics(ppo.actor.normalizer))
        theirs.until = 0  # ours are renewed after an update, theirs in the middle of a rollout
    for theirs, ours in ((actor.mlp, ppo.actor.mean), (critic.mlp, ppo.critic)):
        theirs.load_state_dict(dict(zip(theirs.state_dict(), ours.state_dict().values(), strict=True)))
    storage = RolloutStorage("rl", NUM_ENVS, NUM_STEPS, obs, [3])
    learner = RslPPO(
        actor, critic, storage, num_learning_epochs=config.epochs, num_mini_batches=config.minibatches,
        clip_param=config.clip, gamma=config.discount, lam=config.gae_lambda, value_loss_coef=config.value_coef,
        entropy_coef=config.entropy_coef, learning_rate=config.learning_rate, max_grad_norm=config.max_grad_norm,
        use_clipped_value_loss=config.clip_value, schedule="adaptive", desired_kl=config.desired_kl,
    )  # fmt: skip
    with torch.no_grad():
        for t in range(NUM_STEPS):
            obs = TensorDict({"policy": rollout.obs[t]}, batch_size=[NUM_ENVS])
            learner.act(obs)
            learner.transition.actions = rollout.action[t]
            learner.transition.actions_log_prob = actor.get_output_log_prob(rollout.action[t])
            done = rollout.terminated[t] | rollout.truncated[t]
            learner.process_env_step(
                obs, rollout.reward[t] * config.reward_scale, done, {"time_outs": rollout.truncated[t].float()}
            )
        learner.compute_returns(TensorDict({"policy": rollout.obs[-1]}, batch_size=[NUM_ENVS]))
    return learner


def small_learner(seed=0, **changes):
    config = PPOConfig(num_steps=NUM_STEPS, hidden=(32, 16), activation="elu", **changes)
    return PPO(config, NUM_ENVS, 12, 3, torch.device("cpu"), seed)


def test_returns_and_advantages_are_rsl_rls():
    """Returns and normalised advantages agree with rsl_rl's to float32 rounding where nothing is truncated."""
    ppo = small_learner()
    rollout = filled(ppo)
    storage = rsl_rl_like(ppo, rollout).storage
    batch, _ = ppo.batch(rollout)
    torch.testing.assert_close(batch.value[0, 2], storage.returns.flatten(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(batch.policy[0, -2], storage.advantages.flatten(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(batch.policy[0, -3], storage.actions_log_prob.flatten(), rtol=1e-5, atol=1e-5)


def test_returns_differ_from_rsl_rls_at_time_limits_only_by_the_value():
    """rsl_rl continues a truncated episode with V of the observation before; given that one, returns agree."""
    ppo = small_learner()
    rollout = filled(ppo, truncations=True)
    storage = rsl_rl_like(ppo, rollout).storage
    assert rollout.truncated.any()
    apart = (ppo.batch(rollout)[0].value[0, 2] - storage.returns.flatten()).abs().max()
    assert apart > 1e-3
    end_in(rollout, rollout.obs[:-1])
    torch.testing.assert_close(ppo.batch(rollout)[0].value[0, 2], storage.returns.flatten(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("clip_value", [True, False])
def test_a_full_update_is_rsl_rls(monkeypatch, clip_value, normalize):
    """After 5 x 4 minibatches in the same order, losses, learning rate and all weights agree to float32 rounding."""
    ppo = small_learner(clip_value=clip_value, normalize_observations=normalize)
    if normalize:
        earlier = torch.randn(500, 12, generator=torch.Generator().manual_seed(2))
        ppo.actor.normalizer.update(3.0 + 2.0 * earlier, torch.ones(500))
    rollout = filled(ppo)
    learner = rsl_rl_like(ppo, rollout)
    order = torch.randperm(NUM_ENVS * NUM_STEPS, generator=torch.Generator().manual_seed(3))
    monkeypatch.setattr(torch, "randperm", lambda *args, **kwargs: order)
    theirs = learner.update()
    ours = ppo.update(rollout, order)
    assert ours["value_loss"] == pytest.approx(theirs["value"], rel=1e-4)
    assert ours["surrogate_loss"] == pytest.approx(theirs["surrogate"], rel=1e-3, abs=1e-5)
    assert ours["learning_rate"] == pytest.approx(learner.learning_rate, rel=1e-5)
    # Adam divides by the root of the mean square, so where a gradient is nearly 0 its rounding is blown up to a share
    # of the step; twenty steps of at most 1e-2 each then differ by a few 1e-4 at the very worst.
    pairs = [*zip(ppo.actor.mean.state_dict().values(), learner.actor.mlp.state_dict().values(), strict=True)]
    pairs += zip(ppo.critic.state_dict().values(), learner.critic.mlp.state_dict().values(), strict=True)
    pairs.append((ppo.actor.std.data, learner.actor.distribution.std_param.data))
    for mine, other in pairs:
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=5e-5)


def test_transitions_of_weight_zero_teach_nothing():
    """What stands in a transition of weight 0 changes no weight of the networks."""
    results = []
    for garbage in (1.0, 50.0):
        ppo = small_learner()
        rollout = filled(ppo)
        rollout.weight[:, 7] = 0.0
        rollout.reward[:, 7] = garbage
        order = torch.arange(NUM_ENVS * NUM_STEPS)
        ppo.update(rollout, order)
        results.append([value.clone() for value in ppo.actor.state_dict().values()])
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("counting", [0, 1, NUM_ENVS * NUM_STEPS // 4 - 1])  # a minibatch has one more
def test_too_few_transitions_teach_nothing(counting):
    """Where fewer transitions count than a minibatch has, weights and learning rate stay, whatever Adam remembers."""
    ppo = small_learner()
    ppo.update(filled(ppo))
    rollout = filled(ppo, seed=2)
    rollout.weight.zero_()
    rollout.weight.view(-1)[:counting] = 1.0
    before = copy.deepcopy(ppo.state_dict() | {"generator": None})
    row = ppo.update(rollout)
    after = ppo.state_dict() | {"generator": None}
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    assert all(math.isnan(row[name]) for name in ("value_loss", "surrogate_loss", "kl"))
    ppo.check()


@pytest.mark.parametrize("weight", [0.5, 0.01])
def test_transitions_of_small_weight_teach(weight):
    """What all count alike for, however little, is learnt as if all weighed 1: even from one minibatch of all."""
    learnt = []
    for each in (1.0, weight):
        ppo = small_learner(minibatches=1)
        rollout = filled(ppo)
        rollout.weight.fill_(each)
        row = ppo.update(rollout, torch.arange(NUM_ENVS * NUM_STEPS))
        learnt.append([row["value_loss"], row["kl"]])
    assert learnt[1] == pytest.approx(learnt[0], rel=0.2)  # the divisor of a variance is the sum of weights, less 1


def test_rows_that_do_not_divide_are_left_out():
    """A rollout that does not split evenly is learnt from without its remainder, on equal minibatches."""
    ppo = small_learner(minibatches=7)
    metrics = ppo.update(filled(ppo))
    assert all(math.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize(("kl", "factor"), [(0.021, 1 / 1.5), (0.0049, 1.5), (0.01, 1.0), (0.0, 1.0)])
def test_the_step_size_follows_the_divergence(kl, factor):
    """Above twice the desired divergence the step shrinks, below half of it grows, and at 0 it stays."""
    ppo = small_learner()
    ppo._adapt_learning_rate(torch.tensor(kl))
    assert ppo.learning_rate.item() == pytest.approx(1e-3 * factor)


def test_the_step_size_stays_in_its_range():
    """However often it is adapted, the learning rate stays in [1e-5, 1e-2]."""
    ppo = small_learner()
    for kl, limit in ((1.0, 1e-5), (1e-6, 1e-2)):
        for _ in range(40):
            ppo._adapt_learning_rate(torch.tensor(kl))
        assert ppo.learning_rate.item() == pytest.approx(limit)


def test_weights_depend_on_the_seed_alone():
    """Two learners of one seed start alike whatever torch's global generator has done; another seed differs."""
    first = small_learner()
    torch.rand(17)
    second, third = small_learner(), small_learner(seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first.actor.parameters(), second.actor.parameters(), strict=True))
    assert not torch.equal(first.actor.mean[0].weight, third.actor.mean[0].weight)


def test_a_learner_continues_from_its_state_bit_for_bit():
    """Saved, loaded into a fresh learner and updated, it has the weights of the one that never stopped."""
    ppo = small_learner()
    rollout = filled(ppo)
    ppo.update(rollout)
    state = ppo.state_dict()
    state = {k: v if not isinstance(v, dict) else {n: w.clone() if isinstance(w, torch.Tensor) else w
             for n, w in v.items()} for k, v in state.items()}  # fmt: skip
    ppo.update(rollout)
    other = small_learner(seed=9)
    other.load_state_dict(state)
    other.update(rollout)
    assert all(torch.equal(a, b) for a, b in zip(ppo.actor.parameters(), other.actor.parameters(), strict=True))
    assert torch.equal(ppo.learning_rate, other.learning_rate)


def test_exploration_belongs_to_seed_world_and_step():
    """Two shards explore as the whole does, a rollout continues where the last one ended, and seeds differ."""
    ppo, noise = small_learner(), torch.empty(2 * NUM_STEPS, NUM_ENVS, 3)
    ppo.draw_noise(noise, 0)
    later = torch.empty(NUM_STEPS, NUM_ENVS, 3)
    ppo.draw_noise(later, NUM_STEPS)
    assert torch.equal(later, noise[NUM_STEPS:])
    shard = PPO(ppo.config, 20, 12, 3, torch.device("cpu"), 0)
    part = torch.empty(2 * NUM_STEPS, 20, 3)
    shard.draw_noise(part, 0, env_offset=30)
    assert torch.equal(part, noise[:, 30:])
    small_learner(seed=1).draw_noise(later, NUM_STEPS)
    assert not (later == noise[NUM_STEPS:]).any()


def test_whoever_truncates_ends_the_episode():
    """No advantage runs across a reset that an environment without a time limit makes; its last state is valued."""
    env = particle.Config().build(4, torch.device("cpu"), seed=0)
    assert env.time_limit == 0
    ppo = PPO(PPOConfig(num_steps=3, hidden=(8,)), 4, env.obs_dim, 3, env.device, 0)
    loop, rollout = GoalLoop(env, uniform.Config().build(spaces(env), 0)), ppo.new_rollout()
    for _ in range(2):  # what the first rollout cut off is forgotten in the second
        for t in range(3):
            rollout.obs[t] = env.obs
            step = env.step(torch.ones(4, 3))
            step.truncated[2] = t == 1
            if t == 1:
                final = step.obs.clone()
            changes = loop.resolve(step)
            rollout.record(
                t, obs=step.obs, reward=step.reward, terminated=step.terminated, truncated=step.truncated,
                invalid=step.invalid, weight=loop.weight, cut_off=changes.cut_off,
            )  # fmt: skip
            loop.renew(step, changes)
        rollout.obs[3] = env.obs
    assert rollout.truncated.nonzero().tolist() == [[1, 2]]
    step, world, obs = rollout.cut_off()
    assert (step.tolist(), world.tolist()) == ([1], [2])
    assert torch.equal(obs, final[2:3])
    assert not torch.equal(obs[0], rollout.obs[2, 2])
    value = rollout.estimate(ppo.value)
    scaled = rollout.reward * ppo.config.reward_scale
    expected = scaled[1, 2] + ppo.config.discount * ppo.value(obs)[0] - value[1, 2]
    torch.testing.assert_close(rollout.advantage[1, 2], expected, rtol=1e-5, atol=1e-6)


def test_somebody_elses_critic_is_the_baseline():
    """With a critic of a selector its values give the advantages, the actor learns and PPO's own critic does not."""

    def constant(obs):
        return torch.full(obs.shape[:-1], 0.25)

    ppo = small_learner()
    rollout = filled(ppo)
    batch, _ = ppo.batch(rollout, constant)
    assert (batch.value[0, 1] == 0.25).all()
    before = [parameter.clone() for parameter in (*ppo.actor.parameters(), *ppo.critic.parameters())]
    metrics = ppo.update(rollout, critic=constant)
    same = [torch.equal(a, b) for a, b in zip(before, (*ppo.actor.parameters(), *ppo.critic.parameters()), strict=True)]
    actors = len(list(ppo.actor.parameters()))
    assert not any(same[:actors])
    assert all(same[actors:])
    assert metrics["value_loss"] == 0.0


def test_a_weight_that_is_not_finite_is_named():
    """The check names the weight."""
    ppo = small_learner()
    ppo.check()
    ppo.critic[0].bias.data[3] = torch.nan
    with pytest.raises(SimulationError, match=r"critic\.0\.bias is not finite"):
        ppo.check()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("num_steps", 0, "num_steps must be at least 1, got 0"),
        ("learning_rate", math.nan, "learning_rate must be finite and positive, got nan"),
        ("discount", 1.5, r"discount must be in \[0, 1\], got 1.5"),
        ("hidden", (), "hidden must be one or more positive layer sizes"),
        ("activation", "gelu", "activation must be one of relu, elu, tanh, got 'gelu'"),
        ("entropy_coef", math.nan, "entropy_coef must be in"),
    ],
)
def test_config_rejects(field, value, message):
    """The message names the field, what it must be and what it was."""
    with pytest.raises(ValueError, match=message):
        PPOConfig(**{field: value})
