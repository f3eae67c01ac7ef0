"""What a run's selector has learnt, for whoever asks it after the training: all of it, in worlds of another number."""

from dataclasses import replace

import pytest
import torch
from short_training import CONFIG
from states import assert_same

from deimos.app.view import caption
from deimos.app.viewer_panel import Moment
from deimos.app.viewer_scene import build_scene
from deimos.app.viewer_session import BY_HAND, UNIFORM, Session
from deimos.checks import RunError
from deimos.goals.fear_selector import fear_selector
from deimos.goals.methods import method
from deimos.goals.selector import Spaces
from deimos.goals.selectors import mix, schedule
from deimos.run import training
from deimos.run.evaluation import EvalConfig
from deimos.run.fear import load_fear
from deimos.run.saved import SavedRun
from deimos.run.shield import ShieldConfig, shield_run

METHODS = {
    name: method(name)
    for name in ("p25", "boltzmann", "swapped", "fear-novelty", "q-fear", "weighted", "p75-penalty", "vds+p75")
} | {"mix": mix.Config(base="p75")}


def finished(config, path):
    """A run of some rollouts, and its trainer."""
    trainer, folder = training.start(config, path)
    assert training.train(trainer, folder)
    return trainer


@pytest.fixture(scope="module", params=METHODS)
def run(request, tmp_path_factory):
    """A run under a method with a fear network, and its trainer."""
    config = replace(CONFIG, selector=METHODS[request.param], env_steps=120)
    path = tmp_path_factory.mktemp("learnt") / "run"
    return path, finished(config, path)


def changed(path, change):
    """Change what the checkpoint of a run has of its selector."""
    state = torch.load(path / "checkpoint.pt", weights_only=True)
    state["loop"]["selector"] = change(state["loop"]["selector"])
    torch.save(state, path / "checkpoint.pt")


def test_all_that_was_learnt_is_there(run):
    """Every number that the selector saves is that of the training, and so are the choices, whoever made them."""
    path, trainer = run
    saved = SavedRun.open(path)
    env = saved.build(4, seed=0, world=0)
    found, there = saved.selector(env), trainer.loop.selector
    assert type(found) is type(there)
    assert_same(found.state_dict(), there.state_dict())
    rows = torch.arange(4)
    arguments = env.state(env.obs), env.goal, env.sample_goals(rows, found.num_candidates), env.draw(rows)
    assert torch.equal(found.propose(rows, *arguments).goal, there.propose(rows, *arguments).goal)
    afraid = load_fear(saved.folder, saved.config, env)
    assert torch.equal(afraid.score(*arguments[:3]), fear_selector(there).score(*arguments[:3]))


def test_the_viewer_shows_its_fear_and_lets_it_choose(run):
    """A run whose fear network is a part of its selector has a map, and the selector itself can choose."""
    path, trainer = run
    session = Session(SavedRun.open(path), 2, seed=0)
    label = trainer.config.label
    assert session.names == [UNIFORM, label, BY_HAND]
    assert type(session.goals.choices[label]) is type(trainer.loop.selector)
    assert session.fear_map().probability.isfinite().all()
    name = "predicted crash probability" if label != "q_fear" else "fear (no probability)"
    assert f"\n{name} " in caption(Moment.of(session, build_scene(session)))
    session.choose(label)
    assert len(session.next_goal()) == 3


def test_a_curriculum_keeps_its_range_in_the_viewer(tmp_path):
    """Before its switch, a schedule that begins with a curriculum draws its goals from the curriculum's range."""
    config = replace(CONFIG, selector=schedule.Config(first="cl", second="p75"))
    trainer, folder = training.start(config, tmp_path / "run")
    for _ in range(4):
        trainer.iterate()
    training.save(trainer, folder)
    session = Session(SavedRun.open(tmp_path / "run"), 1, seed=0)
    high = session.bounds()[1].tolist()
    reach = {}
    for name in (UNIFORM, "schedule"):
        session.choose(name)
        goals = []
        for world in range(30):
            session.go_to(world)
            goals.append(session.next_goal())
        reach[name] = max(abs(value) / side for goal in goals for value, side in zip(goal, high, strict=True))
    assert reach["schedule"] <= 0.25 < reach[UNIFORM]


def test_what_earlier_versions_saved_is_read(tmp_path):
    """What a state lacks is as in a new selector, a mix may be saved as its method, and networks alone are none."""
    path, config = tmp_path / "run", replace(CONFIG, selector=METHODS["boltzmann"], env_steps=120)
    trainer, saved = finished(config, path), SavedRun.open(path)
    env = saved.build(1, seed=0, world=0)
    changed(path, lambda state: {name: state[name] for name in ("fear", "calibration", "learnt_at")})
    found = saved.fear(env)
    assert_same(found.fear.state_dict(), trainer.loop.selector.fear.state_dict())
    assert found.beta == 0.0 != trainer.loop.selector.beta
    mixed = SavedRun(saved.folder, replace(saved.config, selector=mix.Config(base="boltzmann")))
    assert_same(mixed.fear(env).calibration.state_dict(), found.calibration.state_dict())
    torch.save({"schema": 2, "ppo": {}}, path / "checkpoint.pt")
    assert saved.selector(env) is None


def test_a_run_of_0_1_has_no_fear(tmp_path):
    """Its fear network had other layers: the run can be watched without, and a shield says why it needs another."""
    path = tmp_path / "run"
    finished(replace(CONFIG, env_steps=48), path)
    state = torch.load(path / "checkpoint.pt")
    state["loop"]["selector"] = {"fear": {"weights": torch.zeros(1, 3)}}
    torch.save(state | {"schema": 1}, path / "checkpoint.pt")
    saved = SavedRun.open(path)
    assert saved.selector(saved.build(1, seed=0, world=0)) is None
    assert BY_HAND in Session(saved, 1, seed=0).names
    with pytest.raises(RunError, match=r"has no fear network that has learnt \(those of Deimos 0\.1 are not read\)"):
        shield_run(saved.folder, saved.config, ShieldConfig(), EvalConfig(worlds=2), torch.device("cpu"))


def test_what_does_not_fit_is_one_line(tmp_path):
    """A state of other sizes is refused with the folder."""
    path = tmp_path / "run"
    finished(replace(CONFIG, env_steps=48), path)
    changed(path, lambda state: state | {"memory": state["memory"] | {"crash": torch.zeros(3, 3)}})
    saved = SavedRun.open(path)
    with pytest.raises(RunError, match=r"What the selector of .*run has learnt does not fit it: A tensor of shape"):
        saved.fear(saved.build(1, seed=0, world=0))


def test_fear_is_that_of_who_chooses():
    """After its switch a schedule of two Directors has the fear of the second; the first one's learns no more."""
    spaces = Spaces(4, 3, 2, 5, torch.device("cpu"), total_steps=96)
    selector = schedule.Config(first="p25", second="p75").build(spaces, 0)
    assert fear_selector(selector) is selector.parts[0]
    selector.switched = True
    assert fear_selector(selector) is selector.parts[1]
    assert fear_selector(mix.Config(base="uniform").build(spaces, 0)) is None
