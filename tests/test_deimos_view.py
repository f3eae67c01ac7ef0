"""``deimos view``: what a person can ask of a session, what is drawn of it, and the lines that say why not."""

import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from deimos.app import cli
from deimos.app.view import ViewOptions, caption
from deimos.app.viewer_panel import Moment, Panel
from deimos.app.viewer_scene import BoxScene, build_scene
from deimos.app.viewer_session import BY_HAND, SIDE, UNIFORM, Session, prepare
from deimos.checks import RunError
from deimos.learn.policy import load_policy, save_policy
from deimos.run import saved
from deimos.run.fear import load_selector
from deimos.run.saved import SavedRun

WALK = Path(__file__).parent.parent / "docs" / "results" / "quad_flat"


@pytest.fixture(scope="module")
def scared(tmp_path_factory):
    """Folder of a run in Particle Gym so fast that particles crash, and its fear network has learnt from that."""
    path = tmp_path_factory.mktemp("view") / "run"
    budget = "--no-evaluation --num-envs 256 --env-steps 96 --threads 1 --device cpu --ppo.hidden 16 --method p75"
    fast = "--env.max-speed 200 --env.max-force 100 --ppo.init-std 100 --env.goal-period 10"
    assert cli.main(["train", *budget.split(), *fast.split(), "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def bold(tmp_path_factory):
    """Folder of a run in Particle Gym without a fear network."""
    path = tmp_path_factory.mktemp("view") / "run"
    budget = "--no-evaluation --num-envs 16 --env-steps 24 --threads 1 --device cpu --ppo.hidden 8 --method uniform"
    assert cli.main(["train", *budget.split(), "--env.goal-period", "10", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def shielded(scared, tmp_path_factory):
    """Folder of the first run, with a shield."""
    path = Path(shutil.copytree(scared, tmp_path_factory.mktemp("view") / "shielded"))
    small = "--attackers scripted --eval.worlds 16 --eval.steps 100 --alpha 0.3 --alphas 0.3 --device cpu"
    assert cli.main(["shield", str(path), "--worlds", "40000", *small.split()]) == 0
    return path


def write_another_policy(path):
    """Write a policy and a checkpoint as a training does that goes on: with iteration 7, and the log is ahead of it."""
    policy = load_policy(path)
    with torch.no_grad():
        for weights in policy.actor.parameters():
            weights.add_(1.0)
    save_policy(path / "policy.pt", policy)
    state = torch.load(path / "checkpoint.pt", weights_only=True)
    for weights in state["loop"]["selector"]["fear"]["network"].values():
        weights.add_(1.0)
    torch.save(state | {"iteration": 7}, path / "checkpoint.pt")


def session_of(path, worlds=3, world=0, **options):
    """A session with the policy of a run."""
    return Session(SavedRun.open(path, **options), worlds, seed=5, world=world)


def steps_to_next_goal(session):
    """Steps from now until the first world has another goal."""
    before, count = session.goal, 0
    while session.goal == before:
        session.step()
        count += 1
    return count


def test_the_next_goal_is_announced(scared):
    """Under uniform goals, what is announced as the next goal is the next goal, and announcing changes nothing."""
    session, silent = session_of(scared), session_of(scared)
    announced = session.next_goal()
    assert announced == session.next_goal() != session.goal
    assert steps_to_next_goal(session) == steps_to_next_goal(silent)
    assert not session.crashes
    assert session.goal == pytest.approx(announced)
    assert session.goal == silent.goal


def test_a_goal_by_hand_stays(scared):
    """A goal given by hand is active at once, in physical units, and again when the next one is due."""
    session = session_of(scared)
    session.ask([20.0, -30.0, 10.0])
    for _ in range(25):
        assert session.goal == pytest.approx([20.0, -30.0, 10.0])
        session.step()
        if session.episodes:  # the first goal of an episode is uniform
            break
    assert session.goals.current == BY_HAND
    session.choose(UNIFORM)
    steps_to_next_goal(session)
    assert session.goal != pytest.approx([20.0, -30.0, 10.0])


def test_the_shield_looks_at_every_goal(shielded, monkeypatch):
    """What the run's shield refuses, by whomever it was asked for, the policy does not get; each file is read once."""
    read = []
    monkeypatch.setattr(saved, "load_policy", lambda path: read.append("policy") or load_policy(path))
    monkeypatch.setattr(saved, "load_selector", lambda *run: read.append("selector") or load_selector(*run))
    session = Session(SavedRun.open(shielded), 3, seed=5, shield="stop")
    assert sorted(read) == ["policy", "selector"]
    corners = [[x, y, z] for x in (-200.0, 200.0) for y in (-200.0, 200.0) for z in (-200.0, 200.0)]
    for goal, refused in ((min(corners, key=session.risk), 0.0), (max(corners, key=session.risk), 0.5)):
        session.ask(goal)
        assert session.refused == refused
    assert session.goal == [0.0, 0.0, 0.0]
    assert session.refused == 0.5
    shown = Moment.of(session, build_scene(session))
    assert "the shield has refused 50 % of the goals" in caption(shown)


def test_a_policy_stays_with_its_shield(shielded, tmp_path, caplog):
    """Beside a training whose policy has outgrown the shield, the policy and the fear that it fits stay; said once."""
    path = Path(shutil.copytree(shielded, tmp_path / "run"))
    session = Session(SavedRun.open(path), 3, seed=5, shield="stop")
    session.step()
    acted, feared = session._policy.scaled(session.env.obs), session.risk([200.0, 0.0, 0.0])
    for _ in range(2):
        write_another_policy(path)
        assert not session.reload()
    assert [record.message for record in caplog.records] == [
        "The run has written another policy, which its shield is not made for: the one of iteration 4 stays."
    ]
    assert torch.equal(session._policy.scaled(session.env.obs), acted)
    assert session.risk([200.0, 0.0, 0.0]) == feared
    session.go_to(7)  # and in other worlds
    session.ask([200.0, 200.0, 200.0])
    other = Session(SavedRun.open(shielded), 3, seed=5, world=7, shield="stop")
    other.ask([200.0, 200.0, 200.0])
    for each in (session, other):
        each.step()
    assert torch.equal(session.env.obs, other.env.obs)
    with pytest.raises(RunError, match="was made for an earlier policy; make it again with deimos shield"):
        Session(SavedRun.open(path), 1, seed=5, shield="stop")


def test_a_shield_that_is_not_there_is_one_line(bold):
    """A run without a shield says how to make one."""
    with pytest.raises(RunError, match=r"has no shield; make one with deimos shield\."):
        Session(SavedRun.open(bold), 1, seed=5, shield="stop")


def test_to_choose_by_hand_begins_with_the_active_goal(scared):
    """Who takes over by hand keeps the goal that is active; somebody unknown is refused."""
    session = session_of(scared)
    goal = session.goal
    session.choose(BY_HAND)
    assert session.next_goal() == pytest.approx(goal)
    with pytest.raises(ValueError, match="goals must be one of uniform, p75, by hand, got 'nobody'"):
        session.choose("nobody")


def test_the_director_of_the_run_chooses_feared_goals(scared):
    """The method of the run is among those who can choose, and its goals are feared more than uniform ones."""
    session = session_of(scared, worlds=1)
    assert session.names == [UNIFORM, "p75", BY_HAND]
    risks = {name: [] for name in (UNIFORM, "p75")}
    for _ in range(40):
        for name in risks:
            session.choose(name)
            risks[name].append(session.risk(session.next_goal()))
        session.choose(UNIFORM)
        steps_to_next_goal(session)
    assert np.mean(risks["p75"]) > np.mean(risks[UNIFORM])


def test_the_map_holds_the_risk_of_every_goal(scared):
    """A point of the map is the risk of the active goal with those two components, within the bounds of goals."""
    session = session_of(scared)
    session.axes = (2, 0)
    fear = session.fear_map()
    low, high = session.bounds()
    assert fear.axes == (2, 0)
    assert (fear.low, fear.high) == ((low[2], low[0]), (high[2], high[0]))
    assert fear.probability.shape == (SIDE, SIDE)
    assert float(fear.probability.min()) < float(fear.probability.max())
    for row, column in ((0, 0), (3, 17), (SIDE - 1, 8)):
        goal = session.goal
        goal[2] = float(low[2] + (high[2] - low[2]) * column / (SIDE - 1))
        goal[0] = float(low[0] + (high[0] - low[0]) * row / (SIDE - 1))
        assert session.risk(goal) == pytest.approx(float(fear.probability[row, column]), rel=1e-4)


def test_a_run_without_fear_has_no_map(bold):
    """Without a fear network there is no map and no risk, and the rest works."""
    session = session_of(bold)
    assert session.fear_map() is None
    assert session.risk(session.goal) is None
    assert session.names == [UNIFORM, BY_HAND]
    session.step()
    assert "predicted" not in caption(Moment.of(session, build_scene(session)))


def test_an_attacker_can_choose_and_lends_its_fear(scared, tmp_path):
    """An attacker learns about the policy first; where the run has no fear network, the map is the attacker's."""
    run = tmp_path / "run"
    shutil.copytree(scared, run)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    del state["loop"]["selector"]["fear"]
    torch.save(state, run / "checkpoint.pt")
    told = []
    with pytest.raises(RunError, match="goal_period must be at least 1, got 0"):
        SavedRun.open(run, goal_period=0)
    saved = SavedRun.open(run)
    attacks, afraid = prepare(saved, ["argmax", "scripted"], 32, lambda stage, share: told.append((stage, share)))
    assert told[-1][0] == "argmax"
    session = Session(saved, 1, 5, attacks=attacks, afraid=afraid)
    assert session.names == [UNIFORM, "argmax", "scripted", BY_HAND]
    assert session.fear_map().probability.max() > session.fear_map().probability.min()
    session.choose("argmax")
    chosen = session.risk(session.next_goal())
    uniform = session.env.sample_goals(torch.zeros(1, dtype=torch.int64), 50)[0]
    assert chosen >= np.mean([session.risk((goal / session._scale).tolist()) for goal in uniform])


def test_a_pool_may_choose_the_goals(scared, tmp_path):
    """The attacker whose file is named chooses goals, and has learnt nothing meanwhile."""
    path, run = tmp_path / "pool.pt", str(scared)
    make = ["pool", run, run, "--out", str(path), "--worlds", "64", "--adversary-steps", "100", "--device", "cpu"]
    assert cli.main(make) == 0
    saved = SavedRun.open(scared)
    attacks, afraid = prepare(saved, ["pooled"], 32, lambda stage, share: None, path)
    assert afraid is None
    session = Session(saved, 1, 5, attacks=attacks)
    session.choose("pooled")
    assert session.goals.current == "pooled"
    session.step()


def test_goals_may_last_longer_than_an_evaluation(scared):
    """T may be whatever one wants to watch: that the run was evaluated for fewer steps is no matter."""
    steps = SavedRun.open(scared).config.eval.steps
    assert session_of(scared, goal_period=steps).env.goal_period == steps


def test_reset_and_world(scared):
    """Reset counts anew; another world is the one that a session of that number begins with, goals and all."""
    session = session_of(scared)
    for _ in range(30):
        session.step()
    assert session.steps == 30
    session.reset()
    assert (session.steps, session.crashes, session.episodes) == (0, 0, 0)
    assert session.env.episode_step.tolist() == [0, 0, 0]
    session.go_to(7)
    other = session_of(scared, world=7)
    assert torch.equal(session.env.obs, other.env.obs)
    assert not torch.equal(session.env.obs, session_of(scared).env.obs)
    with pytest.raises(ValueError, match="world must be at least 0, got -1"):
        session.go_to(-1)


def test_a_new_checkpoint_is_loaded_where_the_worlds_are(scared, tmp_path):
    """When the run writes another policy it acts from then on, in the same worlds and under the same chooser."""
    run = tmp_path / "run"
    shutil.copytree(scared, run)
    session = session_of(run)
    session.choose("p75")
    for _ in range(5):
        session.step()
    assert not session.reload()
    place, before = session.env.obs.clone(), session._policy.scaled(session.env.obs)
    write_another_policy(run)
    assert session.reload()
    assert (session.steps, session.goals.current) == (5, "p75")
    assert session.iteration == 7
    assert torch.equal(session.env.obs, place)
    assert not torch.equal(session._policy.scaled(session.env.obs), before)
    assert not session.reload()


def test_particles_are_shown_where_they_are(scared):
    """Every particle is where its sketch says, with a goal, a line to it, its velocity, and marks of the crashes."""
    session = session_of(scared, worlds=3)
    scene = build_scene(session)
    assert isinstance(scene, BoxScene)
    for _ in range(20):
        session.step()
        scene.update()
    session.env.tensors["position"][1] = torch.tensor([999.0, 0.0, 0.0])
    session.env.tensors["velocity"][1] = torch.tensor([200.0, 0.0, 0.0])
    scene.update()
    for _ in range(3):
        session.step()
        scene.update()
    np.testing.assert_allclose(scene._ends[-1], [0.999, 0.0, 0.0], atol=1e-6)  # the last place that it was seen at
    places = session.env.tensors["position"].numpy() / 1000.0
    np.testing.assert_allclose(scene.data.mocap_pos, places, atol=1e-6)
    for world in range(3):
        np.testing.assert_allclose(scene.data.xpos[scene.model.body(f"particle {world}").id], places[world], atol=1e-6)
        if session.env.episode_step[world] > 0:
            speed = session.env.tensors["velocity"].numpy()[world] / 1000.0
            np.testing.assert_allclose(scene._velocity[world], speed, atol=1e-5)
    goal = scene.shapes(None)[0]
    np.testing.assert_allclose(goal.pos, session.env.sketch(0).target / 1000.0, atol=1e-6)
    assert len(scene._ends) == session.episodes


@pytest.mark.parametrize("again", [Session.reset, lambda session: session.go_to(7)], ids=["reset", "another world"])
@pytest.mark.parametrize("steps", [0, 1], ids=["paused", "running"])
def test_what_begins_again_has_no_ends(scared, again, steps):
    """A reset and another world end no episode: marks, trail and velocities are gone."""
    session = session_of(scared, worlds=3)
    scene = build_scene(session)
    for step in range(9):
        if step == 6:
            session.env.tensors["position"][1] = torch.tensor([999.0, 0.0, 0.0])
            session.env.tensors["velocity"][1] = torch.tensor([200.0, 0.0, 0.0])
        session.step()
        scene.update()
    assert scene._ends
    assert scene._trail
    again(session)
    for _ in range(steps):
        session.step()
    scene.update()
    assert scene._ends == scene._trail == []
    assert not scene._velocity.any()


def test_a_panel_keeps_what_is_asked_for_in_order(scared):
    """What a person asks for reaches the session once, in order."""
    session = session_of(scared)
    panel = Panel(build_scene(session))
    panel.ask(lambda session: session.choose("p75"))
    panel.ask(Session.step)
    for command in panel.commands():
        command(session)
    assert (session.goals.current, session.steps) == ("p75", 1)
    assert list(panel.commands()) == []


def test_a_video_is_recorded_meanwhile(scared, tmp_path):
    """A recording has the pictures per second that it was asked for; MuJoCo renders them, without a display."""
    path = tmp_path / "x.webp"
    command = [sys.executable, "-m", "deimos", "view", scared, "--record", path]
    size = "--width 160 --height 120 --fps 10 --seconds 0.5".split()
    done = subprocess.run([*command, *size], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()) == (0, [str(path)]), done.stderr
    with Image.open(path) as image:
        assert (image.size, image.n_frames) == ((160, 120), 5)
        pictures = [frame.convert("RGB").tobytes() for frame in ImageSequence.Iterator(image)]
    assert len(set(pictures)) == 5
    assert re.search(r"http://127\.0\.0\.1:\d+/", done.stderr)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--goals", "argmax"], "Unknown value 'argmax' for --goals; choose from: uniform, p75, and with --attackers"),
        (["--attackers", "nobody"], "Unknown attacker 'nobody'"),
        (["--pool", "a.pt"], "pool is the file of the attacker pooled; add --attackers pooled"),
        (["--attackers", "argmax", "pooled", "--pool", "a.pt"], "a.pt cannot be read (No such file or directory)"),
        (["--attackers", "pooled"], "pool must be a file of deimos pool for the attacker pooled, got none"),
        (["--attackers", "argmax", "argmax"], "attackers must be different, got argmax, argmax"),
        (["--terrain", "rough"], "terrain is for legged robots"),
        (["--port", "70000"], r"port must be in [0, 65535], got 70000"),
    ],
)
def test_what_cannot_be_shown_is_one_line(scared, tmp_path, monkeypatch, capsys, arguments, message):
    """A wrong option is one line with what it must be, before anything is served; nothing is left behind."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["view", str(scared), *arguments]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("deimos: ")]
    assert message in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--goals argmx --attackers argmax", "Unknown value 'argmx' for --goals"),
        ("--shield stop --attackers argmax", "has no shield; make one with deimos shield"),
        ("--record none/x.mp4 --attackers argmax", "The folder none does not exist; make it first"),
        ("--record x.avi --attackers argmax", "video must end in one of .mp4,"),
    ],
)
def test_what_is_missing_is_said_before_attackers_learn(scared, tmp_path, monkeypatch, capsys, arguments, message):
    """Attackers learn for minutes: whatever else cannot be had is refused first."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delattr("deimos.app.view.prepare")
    assert cli.main(["view", str(scared), *arguments.split()]) == 2
    assert message in capsys.readouterr().err


def test_a_mujoco_without_its_viewer_is_one_line(scared, capsys, monkeypatch):
    """Where MuJoCo is installed and lacks the web viewer, as on Windows, nobody is told to install it."""
    monkeypatch.setitem(sys.modules, "mujoco.studio", None)
    assert cli.main(["view", str(scared), "--seconds", "1"]) == 2
    line = "deimos: This needs mujoco.studio, which the installed mujoco does not have.\n"
    assert capsys.readouterr().err == line


def test_a_port_in_use_is_one_line(scared, capsys, monkeypatch):
    """A port that another program listens on is refused in one line with the way out, before attackers learn."""
    monkeypatch.delattr("deimos.app.view.prepare")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert cli.main(["view", str(scared), "--port", str(port), "--seconds", "1"]) == 2
    assert f"deimos: Port {port} is in use on 127.0.0.1; choose another --port" in capsys.readouterr().err


def test_a_policy_of_another_environment_is_one_line(scared, bold, tmp_path):
    """A policy that observes other things than its environment shows is refused with both named."""
    run = tmp_path / "run"
    shutil.copytree(scared, run)
    shutil.copy(WALK / "policy.pt", run / "policy.pt")
    with pytest.raises(RunError, match=r"belongs to another environment: it observes linear_velocity.*not velocity"):
        session_of(run)


def test_options_are_checked():
    """The message names the option, what it must be and what it was."""
    for options, message in (
        ({"worlds": 0}, "worlds must be at least 1, got 0"),
        ({"world": -1}, "world must be at least 0, got -1"),
        ({"goal_period": 0}, "goal_period must be at least 1, got 0"),
        ({"seconds": 0.0}, "seconds must be finite and positive, got 0.0"),
        ({"seed": -1}, "seed must be in"),
        ({"width": 8}, r"width must be in \[16, 8192\], got 8"),
    ):
        with pytest.raises(ValueError, match=message):
            ViewOptions(run=Path("run"), **options)
