"""Several processes that share one run: two of 64 worlds against one of 128.

The module is its own program: torchrun starts it, and every rank writes down what it has come to (``_work``).
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from states import assert_same
from taught_selectors import SPACES

import deimos
from deimos.checks import RunError, SimulationError
from deimos.goals import interactions, methods
from deimos.goals.core import GoalCore
from deimos.goals.fear import FearConfig
from deimos.goals.selectors import director
from deimos.learn.ppo import PPOConfig
from deimos.nn import ranks
from deimos.run import training
from deimos.run.folder import RunFolder
from deimos.run.trainer import TrainConfig, Trainer
from deimos.sim.envs import particle, quad

HOME = Path(deimos.__file__).resolve().parent.parent
RANKS, WORLDS = 2, 128
METHODS = (
    "uniform", "p25", "p25-literal", "vds", "vds-auxiliary", "rnd", "cl", "plr", "grid", "q-fear", "weighted",
    "swapped", "fear-novelty", "vds+p75",
)  # fmt: skip
CASES = (*METHODS, "robots")
ITERATIONS = 3
PATIENCE = 120.0  # [s] for processes on a machine that does other things

# Fast particles that start anywhere and get a goal every 8 steps: from the first rollout on some crash.
CONFIG = TrainConfig(
    env=particle.Config(goal_period=8, max_speed=60.0, max_force=20.0, spawn_range=980.0),
    ppo=PPOConfig(hidden=(16, 16), num_steps=16, minibatches=3, epochs=2),
    evaluation=False, seed=3, num_envs=WORLDS, env_steps=16 * ITERATIONS, device="cpu", threads=1, log=(),
)  # fmt: skip
ROBOTS = replace(CONFIG, env=quad.Config(engine="native", goal_period=8), num_envs=16, method="p25")


def learn(case):
    """A few iterations: the first rollout, the first gradient and its minibatches, all rows, and the last state."""
    ppo = replace(CONFIG.ppo, normalize_observations=case == "uniform")
    of_particles = replace(CONFIG, method=case, ppo=ppo, critic_warmup=int(case == "cl")) if case in METHODS else None
    config = of_particles or ROBOTS
    trainer = Trainer(config, torch.device("cpu"))
    ppo, found = trainer.ppo, {"rows": []}
    minibatches, step = ppo._minibatches, ppo.optimizer.step

    def note_minibatches(batch, order):
        rollout = trainer.rollout
        found.setdefault("rollout", {name: getattr(rollout, name).clone() for name in ("obs", "action", "reward")})
        found.setdefault("order", order.clone())
        found.setdefault("minibatches", [])
        parts = minibatches(batch, order)
        if not found["minibatches"]:
            found["minibatches"] = [part.table[:, part.table[-3] > 0].clone() for part in parts]
        return parts

    def note_gradient(**options):
        found.setdefault("gradient", ppo._grad.clone())
        step(**options)

    ppo._minibatches, ppo.optimizer.step = note_minibatches, note_gradient
    for _ in range(ITERATIONS):
        found["rows"].append(trainer.iterate())
    return found | {"state": trainer.state_dict()}


def said(call, *arguments, **options):
    """What a call is refused by."""
    try:
        call(*arguments, **options)
    except (RunError, SimulationError) as error:
        return type(error).__name__, str(error)
    return None


def poison(trainer, rank, iteration):
    """Let an observation of one rank be no number in an iteration."""
    collect = trainer.collect

    def poisoned():
        collect()
        if ranks.place().rank == rank and trainer.iteration + 1 == iteration:
            trainer.rollout.obs[-1, 5, 0] = torch.nan

    trainer.collect = poisoned


def _work(out):
    """What every rank does; nothing that is compared needs a clock."""
    place, found = ranks.place(), {}
    config = replace(CONFIG, selector=director.Config(candidates=20, fear=FearConfig(min_per_class=4)), env_steps=160)
    training.train(*training.start(config, out / "straight"))
    trainer, folder = training.start(replace(config, env_steps=80), out / "resumed")
    training.train(trainer, folder, stopped=lambda: place.rank == 1 and trainer.iteration == 3)  # one of them is asked
    found["stopped"] = trainer.iteration
    training.train(*training.resume(folder.path, 160))

    found["uneven"] = said(training.start, replace(CONFIG, num_envs=127), out / "uneven")
    found["taken"] = said(training.start, CONFIG, out / "resumed")
    found["alone"] = said(training.resume, out / "alone")
    trainer, folder = training.start(CONFIG, out / "poisoned")
    poison(trainer, 1, 2)
    found["poisoned"] = said(training.train, trainer, folder)
    trainer, folder = training.start(CONFIG, out / "full")
    folder.append_csv = lambda name, row: (_ for _ in ()).throw(RunError("The disk is full."))
    found["full"] = said(training.train, trainer, folder)
    trainer, folder = training.start(CONFIG, out / "broken")
    trainer.env.check = lambda: 1 / (1 - place.rank)  # a fault of the program, on one rank
    try:
        training.train(trainer, folder)
    except (ArithmeticError, RunError) as error:
        found["broken"] = str(error)
    torch.save(found | {case: learn(case) for case in CASES}, out / f"{place.rank}.pt")


def environment(**more):
    """That of a process of Deimos."""
    return os.environ | {"PYTHONPATH": str(HOME), "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"} | more


def torchrun(*command):
    """A command that starts two ranks."""
    run = (sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={RANKS}")
    return [*run, *map(str, command)]


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """What two ranks have come to, and the folder of their runs."""
    out = tmp_path_factory.mktemp("ranks")
    training.start(CONFIG, out / "alone")
    command = torchrun(Path(__file__).resolve(), out)
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        errors = process.communicate(timeout=PATIENCE)[1]
    finally:
        end(process)
    assert process.returncode == 0, errors
    return [torch.load(out / f"{rank}.pt", weights_only=False) for rank in range(RANKS)], out


@pytest.fixture(scope="module")
def one(both):
    """What one process comes to, by the case."""
    return {case: learn(case) for case in CASES}


@pytest.mark.parametrize("case", CASES)
def test_the_first_rollout_is_that_of_one_process(both, one, case):
    """Worlds draw by their global numbers: the halves of the first rollout are the whole, bit for bit."""
    for name, whole in one[case]["rollout"].items():
        halves = [found[case]["rollout"][name] for found in both[0]]
        assert torch.equal(torch.cat(halves, dim=1), whole), name


@pytest.mark.parametrize("case", CASES)
def test_the_first_update_is_that_of_one_process(both, one, case):
    """The same order is drawn, each minibatch holds the same transitions, and the gradients differ by rounding."""
    first, second = (found[case] for found in both[0])
    whole = one[case]
    for found in (first, second):
        assert torch.equal(found["order"], whole["order"])
        torch.testing.assert_close(found["gradient"], whole["gradient"], rtol=1e-5, atol=1e-6)
    for left, right, expected in zip(first["minibatches"], second["minibatches"], whole["minibatches"], strict=True):
        together, size = torch.cat([left, right], dim=1), whole["rollout"]["obs"].shape[2]
        assert left.shape[1] != right.shape[1]  # of a random part, no rank has exactly the half
        rows = [sorted(part[: size + 3].t().tolist()) for part in (together, expected)]  # observation and action
        assert rows[0] == rows[1]


@pytest.mark.parametrize("case", CASES)
def test_ranks_hold_the_same_networks(both, case):
    """After some iterations both have the same state, of learner and selector, and have seen the same numbers."""
    first, second = (found[case] for found in both[0])
    assert_same(first["state"], second["state"])
    assert_same(first["rows"], second["rows"])
    worlds = {"robots": ROBOTS.num_envs}.get(case, WORLDS)
    assert len(first["state"]["loop"]["env"]["goal_count"]) == worlds


@pytest.mark.parametrize("case", CASES)
def test_the_first_row_is_that_of_one_process(both, one, case):
    """What is logged of the first iteration, forecasts and what selectors learn included, is of all worlds."""
    row, expected = both[0][0][case]["rows"][0], one[case]["rows"][0]
    assert row.keys() == expected.keys()
    # Every rank draws the minibatches of VDS from its own worlds, and the parts of these that critics share.
    drawn = {"vds": {"vds/loss"}, "vds+p75": {"vds/loss"}, "vds-auxiliary": {"vds/loss", "vds/value", "vds/deviation"}}
    for name in row.keys() - drawn.get(case, set()):
        assert row[name] == pytest.approx(expected[name], rel=2e-4, abs=1e-6, nan_ok=True), name


def test_something_was_learnt(one):
    """The rows that were compared are of runs in which crashes are seen and selectors learn from the start."""
    rows = {method: found["rows"] for method, found in one.items()}
    assert all(rows[method][0]["crashes"] for method in METHODS)
    assert rows["robots"][0]["reward"] > 0
    for method in ("p25", "p25-literal", "q-fear", "weighted", "swapped", "fear-novelty"):
        assert rows[method][0]["fear/loss"] > 0
        assert rows[method][-1]["fear/auroc"] > 0
    assert rows["rnd"][0]["rnd/loss"] > 0
    assert rows["plr"][0]["plr/filled"] > 0
    assert rows["grid"][1]["grid/weight_0"] != rows["grid"][0]["grid/weight_0"]


@pytest.mark.parametrize(("name", "times"), [("uniform", 0), ("cl", 2), ("p25", 3), ("rnd", 5)])
def test_only_what_a_selector_reads_is_sent(name, times, monkeypatch):
    """Ranks exchange those parts of the interactions that a selector reads, once in an update, and Uniform none."""
    sent = []
    monkeypatch.setattr(interactions, "gather_rows", lambda rows: sent.append(rows) or rows)
    core = GoalCore(methods.method(name).build(SPACES, 0), SPACES)
    core.learn(None)
    assert len(sent) == times
    every = core.interactions.of_all_ranks()
    every.resolved()
    every.without_scores().resolved()
    assert len(sent) == times + 2


def test_a_resumed_run_is_the_undisturbed_one(both):
    """Asked on one rank, both stop after the same iteration; resumed, table and checkpoint are bit for bit the same."""
    (first, second), out = both
    assert first["stopped"] == second["stopped"] == 3
    tables = [(out / name / "progress.csv").read_bytes() for name in ("straight", "resumed")]
    assert tables[0] == tables[1]
    assert tables[0].count(b"\n") == 11
    states = [training.load_checkpoint(RunFolder.open(out / name)) for name in ("straight", "resumed")]
    assert_same(*states)


def test_another_number_of_ranks_is_refused(both):
    """One process does not resume what two have trained, nor two what one has, and each is told how."""
    (first, second), out = both
    with pytest.raises(RunError, match=r"must be 2, .* got 1: torchrun --nproc_per_node=2 train.py --resume"):
        training.resume(out / "straight")
    for found in (first, second):
        assert re.search(r"must be 1, as in its training, got 2: python train.py --resume", found["alone"][1])


def test_what_two_have_trained_one_can_read(both):
    """A checkpoint holds the worlds of both like those of one process: whoever asks it needs no ranks."""
    folder = RunFolder.open(both[1] / "straight")
    trainer = training.load(folder, training.read_config(folder))
    assert (trainer.env.num_envs, trainer.iteration) == (WORLDS, 10)
    trainer.iterate()


def test_a_fault_on_one_rank_ends_both(both):
    """Both say what one has met, and its name; the report of a number that is none is about its worlds."""
    (first, second), out = both
    for found in (first, second):
        kind, text = found["poisoned"]
        assert kind == "SimulationError"
        assert re.search(r"Iteration 2: Rank 1: World 5: its observation is not finite", text)
        assert found["full"] == ("RunError", "Rank 0: The disk is full.")
        assert "num_envs must be divisible by the 2 ranks" in found["uneven"][1]
        assert "exists and is not overwritten" in found["taken"][1]
    assert first["broken"] == "Rank 1: ZeroDivisionError('division by zero')"
    assert second["broken"] == "division by zero"
    report = json.loads((out / "poisoned" / "failure.json").read_text())
    assert report["rank"] == 1
    (rows,) = [entry for entry in report["not_finite"] if entry["name"] == "rollout.obs"]
    assert rows["worlds"] == [5]


def test_a_program_of_torchruns_trains_on_all_ranks(tmp_path):
    """``deimos.train`` joins the ranks as the command does: each has its share, and the first one evaluates."""
    program = tmp_path / "program.py"
    program.write_text(
        "import sys\nimport deimos\n"
        "from deimos.learn.ppo import PPOConfig\nfrom deimos.run.evaluation import EvalConfig\n"
        "config = deimos.TrainConfig(\n"
        "    num_envs=16, env_steps=48, device='cpu', threads=1, log=(), save_every=1, ppo=PPOConfig(hidden=(8,)),\n"
        "    eval=EvalConfig(worlds=8, steps=200, adversary_steps=200),\n"
        ")\n"
        "sys.stdout.write(f'{deimos.train(config, out=sys.argv[1])}\\n')\n"
    )
    run = tmp_path / "run"
    done = subprocess.run(
        torchrun(program, run), env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines().count(str(run)) == RANKS  # Warp speaks too
    state = training.load_checkpoint(RunFolder.open(run))
    assert (state["iteration"], state["ranks"], len(rows(run))) == (2, RANKS, 2)
    assert len(state["loop"]["env"]["goal_count"]) == 16
    assert json.loads((run / "evaluation.json").read_text())
    assert sorted(path.name for path in (run / "policies").iterdir()) == ["000001.pt", "000002.pt"]


def test_a_signal_stops_all_ranks(tmp_path):
    """What Slurm sends torchrun lets all of them end with a checkpoint; the first one alone speaks."""
    command = torchrun("--", HOME / "train.py", *flags(tmp_path / "run"))
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: len(rows(tmp_path / "run")) >= 2, process)
        children = children_of(process.pid)
        process.send_signal(signal.SIGTERM)
        errors = process.communicate(timeout=PATIENCE)[1]
    finally:
        end(process)
    assert errors.count("Stopped after iteration") == 1, errors
    assert len(children) == RANKS
    assert not any(map(is_alive, children))
    state = training.load_checkpoint(RunFolder.open(tmp_path / "run"))
    assert (state["iteration"], state["ranks"]) == (len(rows(tmp_path / "run")), RANKS)


def test_a_rank_ends_when_another_is_killed(tmp_path):
    """Without torchrun, which would end it, a rank notices by itself, at once, and says so in one line."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    command = [sys.executable, str(HOME / "train.py"), *flags(tmp_path / "run")]
    processes = [
        subprocess.Popen(
            command, env=environment(RANK=str(rank), LOCAL_RANK=str(rank), **shared), stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )
        for rank in range(RANKS)
    ]  # fmt: skip
    try:
        wait_for(lambda: len(rows(tmp_path / "run")) >= 2, *processes)
        processes[1].kill()
        errors = processes[0].communicate(timeout=PATIENCE)[1]
    finally:
        for process in processes:
            end(process)
    assert processes[0].returncode == 2, errors
    (line,) = [line for line in errors.splitlines() if line.startswith("deimos: ")]
    assert line.startswith("deimos: Rank 0 has lost another rank, ")


def flags(out):
    """A run of particles that would last for hours."""
    return [
        "--out", str(out), "--num-envs", str(WORLDS), "--env-steps", "1000000", "--ppo.hidden", "16", "16", "--threads",
        "1", "--device", "cpu", "--log", "--no-evaluation",
    ]  # fmt: skip


def rows(folder):
    """The rows of a run so far."""
    return RunFolder(folder).read_csv("progress.csv")


def wait_for(condition, *processes):
    """Wait until something has happened in processes that go on meanwhile."""
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until
        for process in processes:
            assert process.poll() is None, process.communicate()[1]
        time.sleep(0.1)


def end(process):
    """Leave no process behind; torchrun ends those that it has started when it is asked to."""
    if process.returncode is not None:
        return
    process.terminate()
    try:
        process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def children_of(pid):
    """The processes that a process has started."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid):
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


if __name__ == "__main__":
    with ranks.joined():
        _work(Path(sys.argv[1]))
