"""Environments in rsl_rl's training loop."""

import numpy as np
import pytest
import torch
from bare_loop import CONFIG, CPU, TIME_LIMIT, Bare, random_actions
from rsl_rl.runners import OnPolicyRunner

from deimos.adapters.rsl_rl import RslRlVecEnv, runner_config
from deimos.checks import SimulationError
from deimos.learn.ppo import PPOConfig
from deimos.nn.layout import seen_by
from deimos.nn.networks import Actor
from deimos.sim.envs import particle, quad


def rsl_rl_runner(env, num_steps=8):
    """A small PPO of rsl_rl, and a list that gets the losses of every update."""
    model = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    runner = OnPolicyRunner(env, {
        "num_steps_per_env": num_steps,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": model | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": CONFIG.max_force}},
        "critic": dict(model),
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2},
        "save_interval": 1000,
    }, log_dir=None, device=str(env.device))  # fmt: skip
    losses, update = [], runner.alg.update
    runner.alg.update = lambda: losses.append(update()) or losses[-1]
    return runner, losses


def test_an_adapter_keeps_no_gradient():
    """Actions that carry a gradient, as those of a learner outside of inference mode do, leave none in the worlds."""
    env = RslRlVecEnv(CONFIG.build(4, CPU, 0))
    obs, rewards, _, _ = env.step(torch.ones(4, 3, requires_grad=True) * 2.0)
    assert not any(tensor.requires_grad for tensor in (obs["policy"], rewards, *env.env.tensors.values()))


def test_runner_trains(torch_device):
    """rsl_rl's own runner trains on it: losses are finite, weights move, episodes start at random lengths."""
    torch.manual_seed(0)
    env = RslRlVecEnv(Bare(64, 0, torch_device).env)
    runner, losses = rsl_rl_runner(env)
    before = [p.detach().clone() for p in runner.alg.get_policy().parameters()]
    runner.learn(num_learning_iterations=2, init_at_random_ep_len=True)
    assert len(losses) == 2
    assert all(np.isfinite(value) for loss in losses for value in loss.values())
    after = list(runner.alg.get_policy().parameters())
    assert all(not torch.equal(old, new) for old, new in zip(before, after, strict=True))


def test_equals_the_bare_loop(torch_device):
    """Rewards, dones and observations are those of the bare loop; time-outs are the time limits and no more."""
    n, scale = 64, 0.25
    bare = Bare(n, 3, torch_device)
    env = RslRlVecEnv(CONFIG.build(n, torch_device, 3), reward_scale=scale)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (n, 3, TIME_LIMIT)
    assert torch.equal(env.get_observations()["policy"], bare.env.obs)
    length = torch.zeros(n, dtype=torch.int64, device=torch_device)
    crashes = time_outs = 0
    for action in torch.from_numpy(random_actions(40, n)).to(torch_device):
        length += 1
        obs, rewards, dones, extras = env.step(action)
        _, reward, terminated, truncated, next_obs = bare.step(action)
        assert torch.equal(rewards, scale * reward)
        assert torch.equal(dones, terminated | truncated)
        assert torch.equal(obs["policy"], next_obs)
        assert extras["time_outs"].dtype == torch.float32
        assert torch.equal(extras["time_outs"].bool(), (length == TIME_LIMIT) & ~terminated)
        length[dones] = 0
        assert torch.equal(env.episode_length_buf.long(), length)
        crashes, time_outs = crashes + terminated.sum(), time_outs + extras["time_outs"].sum()
    assert crashes > 20
    assert time_outs > 20
    assert env.loop.interactions.active.any()


def test_returns_copies(torch_device):
    """What a step gave back is the same after the next one, and writing into it changes no world."""
    env = RslRlVecEnv(CONFIG.build(16, torch_device, 0))
    actions = torch.from_numpy(random_actions(2, 16)).to(torch_device)
    obs, rewards, dones, extras = env.step(actions[0])
    kept = [obs["policy"], rewards, dones, extras["time_outs"]]
    before = [x.clone() for x in kept]
    current = env.get_observations()["policy"]
    assert current.data_ptr() != env.env.obs.data_ptr()
    env.step(actions[1])
    assert all(torch.equal(x, y) for x, y in zip(kept, before, strict=True))
    assert not torch.equal(env.get_observations()["policy"], before[0])
    env.get_observations()["policy"].fill_(7.0)
    assert not (env.env.obs == 7.0).any()


def test_setting_the_episode_length_moves_the_time_limit(torch_device):
    """A world that is told to be one step before its limit times out on the next step, alone."""
    env = RslRlVecEnv(particle.Config(time_limit=TIME_LIMIT).build(4, torch_device, 0))
    env.episode_length_buf = torch.tensor([0, TIME_LIMIT - 1, 3, 0], device=torch_device)
    *_, extras = env.step(torch.zeros(4, 3, device=torch_device))
    assert extras["time_outs"].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert env.episode_length_buf.tolist() == [1, 0, 4, 1]


def test_without_a_time_limit():
    """Episodes that never time out have the longest length there is, which rsl_rl can still draw from."""
    env = RslRlVecEnv(particle.Config().build(4, CPU, 0))
    assert env.max_episode_length == 2**31 - 1
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
    assert env.step(torch.zeros(4, 3))[3]["time_outs"].sum() == 0


def test_the_actor_does_not_see_what_is_privileged():
    """``policy`` has what the layout shows the actor, in its order, and ``critic`` all; the runner's networks fit."""
    config = quad.Config(engine="native", privileged=("linear_velocity", "heights"))
    env = RslRlVecEnv(config.build(4, CPU, 0))
    ppo = PPOConfig(hidden=(16,), activation="elu", num_steps=4, epochs=1, minibatches=1)
    runner = OnPolicyRunner(env, runner_config(ppo, env), log_dir=None, device="cpu")
    runner.learn(1)
    obs, own = env.get_observations(), env.env
    seen = seen_by("actor", own.layout, CPU)
    assert {name: part.shape for name, part in obs.items()} == {"policy": (4, 45), "critic": (4, 235)}
    assert torch.equal(obs["policy"], own.obs[:, seen])
    assert torch.equal(obs["critic"], own.obs)
    theirs = runner.alg.get_policy()
    actor = Actor(own.obs_dim, (16,), own.action_dim, "elu", 1.0, seen=seen)  # ours, for all of an observation
    actor.mean.load_state_dict(theirs.mlp.state_dict())
    with torch.no_grad():
        torch.testing.assert_close(actor(own.obs), theirs(obs))


def test_without_privileges_there_is_one_group():
    """Actor and critic see the same then, which is stored once."""
    env = RslRlVecEnv(CONFIG.build(4, CPU, 0))
    assert set(env.get_observations().keys()) == {"policy"}
    assert runner_config(PPOConfig(), env)["obs_groups"] == {"actor": ["policy"], "critic": ["policy"]}


def test_refuses_what_is_not_finite(torch_device):
    """A NaN action, which clipping may turn into a number, stops the loop."""
    env = RslRlVecEnv(CONFIG.build(4, torch_device, 0))
    action = torch.zeros(4, 3, device=torch_device)
    action[2, 1] = torch.nan
    with pytest.raises(SimulationError, match="World 2: its action is not finite"):
        env.step(action)


def test_goes_on_after_an_invalid_world(torch_device):
    """One broken world of four begins anew, though it is a quarter of the steps that were checked so far."""
    env = RslRlVecEnv(quad.Config().build(4, torch_device, 0))
    idle = torch.zeros(4, 12, device=torch_device)
    env.env.tensors["qvel"][2, 0] = 99.0
    dones = [env.step(idle)[2].tolist() for _ in range(3)]
    assert dones == [[False, False, True, False], *[[False] * 4] * 2]
    idle[1, 7] = torch.inf
    with pytest.raises(SimulationError, match="World 1: its action is not finite"):
        env.step(idle)


def test_extras_hold_the_terms_of_the_reward():
    """Every so many steps ``log`` holds the mean of each term; together they are the mean reward."""
    env = RslRlVecEnv(quad.Config(engine="native").build(4, CPU, 0), report_every=3)
    steps = [env.step(torch.full((4, 12), 0.3)) for _ in range(6)]
    assert ["log" in extras for *_, extras in steps] == [False, False, True] * 2
    for block in (steps[:3], steps[3:]):
        terms = {name: value for name, value in block[-1][3]["log"].items() if name.startswith("reward/")}
        assert len(terms) > 5
        mean = torch.stack([rewards for _, rewards, *_ in block]).mean().item()
        assert sum(terms.values()) == pytest.approx(mean, rel=1e-4, abs=1e-6)
    with pytest.raises(ValueError, match="report_every must be at least 1, got 0"):
        RslRlVecEnv(CONFIG.build(1, CPU, 0), report_every=0)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_a_bad_reward_scale(scale):
    """The message names the argument, what it must be and what it was."""
    with pytest.raises(ValueError, match=f"reward_scale must be finite and positive, got {scale}"):
        RslRlVecEnv(CONFIG.build(1, CPU, 0), reward_scale=scale)
