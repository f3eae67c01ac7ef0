"""Legged robots on rough ground: levels, where they start, and what becomes of those that leave it."""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from deimos.kernels.legged.levels import update_levels
from deimos.kernels.legged.step import evaluate_step
from deimos.terrain import Grid, Share
from deimos.terrain.shapes.flat import Shape as Flat
from deimos.terrain.shapes.stairs import Shape as Stairs
from quad_worlds import actions, build
from worlds import build_loop, mask_of, rows_of

import deimos
from deimos import terrain
from deimos.app import cli
from deimos.learn.ppo import PPOConfig
from deimos.run import training
from deimos.run.evaluation import EvalConfig
from deimos.run.folder import RunFolder
from deimos.sim.envs.quad import Config


def test_levels_follow_the_tracking(torch_device, hills):
    """A good episode lifts the level, a poor one or a crash lowers it, and one in between leaves it."""
    env = build(torch_device, num_envs=6, terrain=hills, stagger=False)
    cases = [(0.85, False, 1, 2), (0.45, False, 1, 0), (0.9, True, 1, 0), (0.65, False, 1, 1), (0.3, False, 0, 0)]
    t = env.tensors
    for i, (tracking, crashed, level, _) in enumerate(cases):
        t["tracked"][i] = torch.tensor([tracking * 40, 40.0])
        env._views["terminated"][i] = crashed
        env._views["truncated"][i] = not crashed
        t["level"][i] = level
    t["tracked"][5], t["level"][5] = torch.tensor([40.0, 40.0]), 2
    env._views["truncated"][5] = True
    env.reset(mask_of(env, *range(6)))
    assert t["level"][:5].tolist() == [case[3] for case in cases]
    assert 0 <= int(t["level"][5]) <= 2
    origin = torch.tensor(env.terrain.origins)[t["level"].cpu().long(), torch.arange(6) % 2]
    assert bool(((t["qpos"][:, :2].cpu() - origin[:, :2]).abs() <= 1.0).all())


def test_a_reset_in_the_middle_and_an_invalid_world_keep_their_level(torch_device, hills):
    """Only an episode that ended says how it went."""
    env = build(torch_device, num_envs=3, terrain=hills)
    env.tensors["level"][:] = 1
    env.tensors["tracked"][:] = torch.tensor([1.0, 40.0])
    env._views["terminated"][:] = False
    env._views["truncated"][:] = torch.tensor([False, True, True])
    env._views["invalid"][:] = torch.tensor([False, True, False])
    env.reset(mask_of(env, 0, 1, 2))
    assert env.tensors["level"].tolist() == [1, 1, 0]


def test_who_passes_the_last_level_is_sent_anywhere(torch_device, hills):
    """After the last level the next is uniform over all of them."""
    n = 600
    env = build(torch_device, num_envs=n, terrain=hills)
    env.tensors["level"][:] = 2
    env.tensors["tracked"][:] = torch.tensor([40.0, 40.0])
    env._views["truncated"][:] = True
    env.reset(mask_of(env, *range(n)))
    counts = torch.bincount(env.tensors["level"].long(), minlength=3)
    assert (counts - n / 3).abs().max() < 5 * math.sqrt(n * 2 / 9)


def walk(env, goals, follows):
    """Play an episode in which robots do what two goals say, or stand; what they do is written, not simulated.

    Gives the level that each begins the next episode on, all having begun on level 5 of ten, and the distance of the
    ends of each goal's path, shape (2, num_envs).
    """
    n, t = env.num_envs, env.tensors
    env.legged.ground.origin = wp.zeros((10, 1), dtype=wp.vec3, device=env.worlds.mask.device)
    t["level"][:] = 5
    position, yaw, lengths = np.zeros((n, 2)), np.zeros(n), []
    for k, goal in enumerate(goals):
        if k > 0:
            asked = torch.tensor(goal * [2.0, 2.0, 0.25], dtype=torch.float32, device=env.device)
            env.set_goals(rows_of(env), asked)
        else:
            t["goal"][:] = torch.tensor(goal, dtype=torch.float32)
        start = position.copy()
        for _ in range(500):
            yaw = yaw + goal[:, 2] * 0.02 * follows
            c, s = np.cos(yaw), np.sin(yaw)
            velocity = np.stack([c * goal[:, 0] - s * goal[:, 1], s * goal[:, 0] + c * goal[:, 1]], axis=1)
            position = position + 0.02 * velocity * follows
            t["qpos"][:, :2] = torch.tensor(position, dtype=torch.float32)
            zero = np.zeros(n)
            t["qpos"][:, 3:7] = torch.tensor(np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], 1))
            t["qvel"].zero_()
            t["qvel"][:, :2] = torch.tensor(velocity * follows)
            t["qvel"][:, 5] = torch.tensor(goal[:, 2] * follows)
            evaluate_step(env.legged)
        lengths.append(np.linalg.norm(position - start, axis=1))
    assert env._views["truncated"].all()
    env._views["mask"][:] = True
    update_levels(env.legged)
    return t["level"].cpu().numpy(), np.array(lengths)


@pytest.mark.parametrize("rule", ["reward", "displacement"])
def test_perfect_tracker_of_turning_goals(torch_device, rule):
    """Who follows turning goals perfectly walks in circles and never goes down by either rule; who stands does."""
    goals = np.random.default_rng(0).uniform(-1, 1, size=(2, 64, 3))
    config = {"levels": rule, "episode_steps": 1000, "goal_period": 500, "stagger": False}
    level, lengths = walk(build(torch_device, num_envs=64, **config), goals, follows=1.0)
    counts = (lengths > 0.31).any(axis=0) | (rule == "reward")
    unclear = (np.abs(lengths - 0.3) < 0.02).any(axis=0)  # the path that counts begins a step later
    np.testing.assert_array_equal(level[~unclear], np.where(counts, 6, 5)[~unclear])
    assert counts.sum() > 60
    level, _ = walk(build(torch_device, num_envs=64, **config), goals, follows=0.0)
    still = np.exp(-(goals[..., :2] ** 2).sum(-1) / 0.25).mean(0)
    down = counts if rule == "displacement" else still < 0.5
    clear = ~unclear if rule == "displacement" else still < 0.8
    np.testing.assert_array_equal(level[clear], np.where(down, 4, 5)[clear])


def test_goals_that_lead_nowhere_do_not_count(torch_device):
    """By displacements, goals that turn on the spot say nothing, and a goal that was missed halves one that was met."""
    goals = np.zeros((2, 4, 3))
    goals[:, 0, 2] = 1.0  # turns
    goals[:, 1] = [0.025, 0.0, 0.0]  # leads 0.25 m away
    goals[0, 2], goals[1, 2] = [0.5, 0.0, 0.0], [0.0, 0.0, 1.0]  # one counts
    goals[:, 3] = [0.5, 0.0, 0.2]
    config = {"levels": "displacement", "episode_steps": 1000, "goal_period": 500, "stagger": False}
    assert walk(build(torch_device, num_envs=4, **config), goals, follows=1.0)[0].tolist() == [5, 5, 6, 6]
    assert walk(build(torch_device, num_envs=4, **config), goals, follows=0.0)[0].tolist() == [5, 5, 4, 4]
    env = build(torch_device, num_envs=4, **config)
    env.tensors["progress"][:] = torch.tensor([0.9, 1.0, 0.3, 1.0])  # mean 0.6
    env.tensors["level"][:] = 5
    env._views["truncated"][:] = True
    env._views["terminated"][:2] = torch.tensor([True, False])
    env.legged.ground.origin = wp.zeros((10, 1), dtype=wp.vec3, device=env.worlds.mask.device)
    env._views["mask"][:] = True
    update_levels(env.legged)
    assert env.tensors["level"].tolist() == [4, 5, 5, 5]


def test_evaluation_puts_world_i_on_tile_i(torch_device, hills):
    """In evaluation the tile is a function of the world's number alone, and stays, whatever happens."""
    config = Config(terrain=hills, goal_period=3).for_evaluation()
    env = config.build(8, torch_device, 0)
    tiles = [("stairs-up", 0), ("stairs-down", 0), ("stairs-up", 1), ("stairs-down", 1), ("stairs-up", 2)]
    for _ in range(3):
        assert [(shape.split("_")[0], level) for shape, level in env.tiles()][:5] == tiles
        assert env.tiles()[6:] == env.tiles()[:2]
        loop = build_loop(env)
        for _ in range(7):
            loop.advance(env.step(actions(8, torch_device)))
        loop.start()
    assert not env.tensors["goal_clock"].unique().numel() > 2


def test_walking_off_the_terrain_cuts_the_episode_off(torch_device, hills):
    """Beyond the edge a robot is truncated, not terminated."""
    env = build(torch_device, terrain=hills, episode_steps=200, goal_period=100)
    env.tensors["qpos"][2, 0] += 100.0
    step = env.step(torch.zeros(6, 12, device=torch_device))
    assert step.truncated.tolist() == [False, False, True, False, False, False]
    assert not step.terminated[2]
    assert not step.invalid.any()


def test_terrain_of_fine_cells_is_refused(torch_device, tmp_path):
    """On cells finer than those that its geoms were tried on no robot is built, and the message says what to do."""
    ground = terrain.build(Grid(shapes=(Share(shape=Stairs(tile=4.0)),), levels=1, columns=1, tile=4.0, cell=0.025))
    ground.save(tmp_path / "fine.npz")
    with pytest.raises(ValueError, match=r"terrain must have cells of at least 0.05 m .*got 0.025 m.*--cell 0.05"):
        build(torch_device, terrain=str(tmp_path / "fine.npz"))


@pytest.mark.parametrize("away", [(-1e5, 0.0, 0.0), (0.0, 1e5, 0.0), (0.0, 0.0, 1e5)])
def test_terrain_far_from_the_origin_is_refused(torch_device, tmp_path, hills, away):
    """Where single precision rounds a robot's way off, none is built; nearer by, robots move as their speed says."""
    path, ground = tmp_path / "far.npz", terrain.load(hills)

    def moved(by):
        corner = ground.corner[0] + by[0], ground.corner[1] + by[1]
        origins, heights = ground.origins + np.float32(by), ground.heights + np.float32(by[2])
        replace(ground, corner=corner, origins=origins, heights=heights).save(path)
        return build(torch_device, terrain=str(path), engine="auto")

    with pytest.raises(ValueError, match=r"terrain must have the middles of its tiles within 4096 m .* got 1000\d\d m"):
        moved(away)
    env = moved(tuple(0.04 * each for each in away))
    begin, way = env.tensors["qpos"][:, :2].double(), 0.0
    for _ in range(10):
        env.step(torch.zeros(6, 12, device=torch_device))
        way = way + env.dt * env.tensors["qvel"][:, :2].double()
    found = env.tensors["qpos"][:, :2] - begin
    assert float(way.abs().max()) > 0.05
    torch.testing.assert_close(found, way, rtol=0, atol=0.02)


def test_robots_start_on_the_terrain(torch_device, tmp_path):
    """Ground that ends where robots start is refused with the border that it lacks; with it, none leaves at once."""

    def tiles(border):
        shape = Share(shape=Flat(tile=2.0, platform=1.0))
        grid = Grid(shapes=(shape,), levels=3, columns=3, tile=2.0, border=border, cell=0.1)
        terrain.build(grid).save(tmp_path / "tiles.npz")
        return build(torch_device, num_envs=64, terrain=str(tmp_path / "tiles.npz"), stagger=False)

    with pytest.raises(ValueError, match=r"terrain must reach 1.3 m .*, got 1 m; .* or its border wider by 0.3 m"):
        tiles(border=0.0)
    env = tiles(border=0.3)
    step = env.step(torch.zeros(64, env.action_dim, device=torch_device))
    assert not step.truncated.any()


def test_a_run_keeps_its_terrain(tmp_path, monkeypatch, hills):
    """A run resumes and is evaluated in any folder, with the terrain file gone and its own folder moved."""
    (tmp_path / "before").mkdir()
    (tmp_path / "after").mkdir()
    monkeypatch.chdir(tmp_path / "before")
    shutil.copy(hills, "mine.npz")
    config = deimos.TrainConfig(
        env=Config(goal_period=5, episode_steps=40, terrain="mine.npz"), method="uniform", num_envs=8, env_steps=192,
        ppo=PPOConfig(hidden=(8,)), evaluation=False, device="cpu", threads=1,
    )  # fmt: skip
    run = deimos.train(config, "run")
    run.rename(tmp_path / "after" / "run")
    Path("mine.npz").unlink()
    monkeypatch.chdir(tmp_path / "after")
    trainer, folder = training.resume(Path("run"), env_steps=384)
    assert np.array_equal(trainer.env.terrain.heights, terrain.load(hills).heights)
    training.train(trainer, folder)
    again, _ = training.resume(Path("run"), env_steps=576)  # once more: resuming wrote the configuration anew
    stored = folder.read_json("config.json")["config"]
    assert (stored["env"]["terrain"], stored["env_steps"]) == ("mine.npz", 576)  # where it came from is not forgotten
    assert again.env.terrain.shapes == ("stairs-up", "stairs-down")
    monkeypatch.chdir(tmp_path)
    naive, *_ = deimos.evaluate("after/run", worlds=4, steps=20)
    assert naive["steps"] == 20


def test_rough_ground_is_made_once():
    """Every environment on rough ground has the same terrain, which nobody can change."""
    ground = Config(terrain="rough").load_terrain()
    assert Config(terrain="rough", goal_period=7).load_terrain() is ground
    for array in (ground.heights, ground.origins):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@pytest.fixture
def grid_file(tmp_path):
    """A small grid as a TOML file."""
    path = tmp_path / "my.toml"
    shapes = 'shape = [{ name = "stairs-up", height = [0.05, 0.1] }, { name = "discrete", height = [0.03, 0.09] }]\n'
    path.write_text(f"levels = 2\ncolumns = 2\ntile = 4.0\nborder = 2.0\ncell = 0.1\nseed = 7\n{shapes}")
    return str(path)


def test_a_grid_is_taken_by_its_name_or_its_file(grid_file, monkeypatch):
    """Presets by the names of the terrain tool, rough for go1, and a TOML file are what the tool makes of them."""
    assert np.array_equal(
        Config(terrain=grid_file).load_terrain().heights, terrain.build(terrain.read_grid(grid_file)).heights
    )
    monkeypatch.setattr(terrain, "build", lambda grid: grid)
    monkeypatch.setattr("deimos.sim.legged.config._build", lambda grid: grid)
    for name, preset in (("rough", "go1"), ("go1", "go1"), ("legged-gym", "legged-gym")):
        assert Config(terrain=name).load_terrain() == terrain.preset(preset)
        assert not Config(terrain=name).files


def test_a_seed_draws_other_ground(grid_file, hills):
    """Added to the grid's own seed, it changes rectangles and not stairs; where nothing is drawn it is refused."""
    ground, other = (Config(terrain=grid_file, terrain_seed=seed).load_terrain() for seed in (0, 2))
    assert np.array_equal(other.heights, terrain.build(terrain.read_grid(grid_file, seed=9)).heights)
    assert ground.shapes == ("stairs-up", "discrete")
    stairs, rectangles = (other.heights[:, half] == ground.heights[:, half] for half in (slice(60), slice(60, None)))
    assert stairs.all()
    assert not rectangles.all()
    for fixed in ("flat", hills):
        with pytest.raises(ValueError, match=f"terrain_seed must be 0 on {fixed}, where nothing is drawn, got 1"):
            Config(terrain=fixed, terrain_seed=1)
    with pytest.raises(ValueError, match="terrain_seed must be at least 0, got -1"):
        Config(terrain="rough", terrain_seed=-1)


def test_ground_in_memory_is_refused_at_once(grid_file):
    """A configuration holds names and paths, and the message says how objects become one."""
    for ground in (terrain.flat(), terrain.read_grid(grid_file), None):
        message = f"terrain must be a name or the path of a file, got a {type(ground).__name__}; save a Terrain by"
        with pytest.raises(ValueError, match=message):
            Config(terrain=ground)


def test_a_run_is_evaluated_on_ground_that_it_has_not_met(grid_file, tmp_path, capsys):
    """Its rows stand beside those of the ground of training, in the folder and in the table, and so in Python."""
    config = deimos.TrainConfig(
        env=Config(goal_period=4, episode_steps=40, terrain=grid_file, engine="native"), method="uniform", num_envs=6,
        env_steps=4, ppo=PPOConfig(hidden=(8,), num_steps=4), eval=EvalConfig(worlds=6, steps=12, attackers=()),
        device="cpu", threads=1,
    )  # fmt: skip
    run = deimos.train(config, tmp_path / "run")
    Path(grid_file).unlink()  # the run has its own
    stored = RunFolder(run).read_json("evaluation.json")
    assert [row.pop("terrain_seed") for row in stored] == [0]  # as before there was the seed
    RunFolder(run).write_json("evaluation.json", stored)
    assert cli.main(["evaluate", str(run), "--terrain-seed", "2", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert "a goal every 4 steps, on native, ground of seed 2" in text
    assert re.search(r"^seed of the ground +2 +0$", text, re.MULTILINE)
    (own,) = deimos.evaluate(run, device="cpu")
    (other,) = deimos.evaluate(run, device="cpu", terrain_seed=2)
    assert other["reward"] != own["reward"]
    assert (other["environment"], other["terrain_seed"]) == (own["environment"], 2)
    assert RunFolder(run).read_json("evaluation.json") == [own, other]


def test_unknown_and_broken_terrains_are_refused(tmp_path):
    """A terrain that is neither a name nor a file, and a file that is not one, each give one clear line."""
    with pytest.raises(ValueError, match=r"one of flat, rough, go1, .* or the path of a terrain file, got 'moon'"):
        Config(terrain="moon").load_terrain()
    with pytest.raises(ValueError, match=r"got 'h.stl'; convert it with: deimos terrain import h.stl --out h.npz"):
        Config(terrain="h.stl").load_terrain()
    with pytest.raises(ValueError, match=r"or the path of a terrain file, got 'my.toml'"):
        Config(terrain="my.toml").load_terrain()
    (tmp_path / "x.npz").write_bytes(b"no terrain")
    with pytest.raises(ValueError, match="is not a terrain file"):
        Config(terrain=str(tmp_path / "x.npz")).load_terrain()
